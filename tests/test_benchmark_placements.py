"""Saved placements: nothing is measured twice, a killed run goes on, and comparisons come from the saved lines."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from imitarm import InputError, cli
from imitarm.benchmark import placements
from imitarm.benchmark.placement_comparison import comparison_tables
from imitarm.benchmark.placement_results import PlacementResult, Setup, append_result, load_results, repaired
from imitarm.benchmark.placement_tables import placement_tables
from imitarm.benchmark.tables import END
from imitarm.errors import FileFormatError
from imitarm.scene import Scene, Sphere

SETUP = Setup("skill.json", "panda", None)


def result(policy="acfra", seed=0, outcome="arrived", max_tilt=None, **values):
    found = PlacementResult(policy, SETUP, seed, outcome, 0.03, 1.0, 0.1, "", max_tilt, code="here")
    return replace(found, **({"computing": 0.1, "rmse": 0.05, "deviation": 4.0, "tilt": 0.1} | values))


def pretended(monkeypatch):
    ran = []

    def run_placement(policy, setup, seed, max_tilt=None):
        ran.append((policy, seed))
        return replace(result(policy, seed), setup=setup, max_tilt=max_tilt, code=placements.code_version())

    monkeypatch.setattr(placements, "run_placement", run_placement)
    return ran


def test_results_are_read_as_they_were_saved(tmp_path):
    file = tmp_path / "results.jsonl"
    refused = result(outcome="refused", clearance=math.nan, rmse=math.nan, reason='no "way"')
    saved = [refused, result(seed=1, max_tilt=0.5), result("other", seed=1)]
    for one in saved:
        append_result(file, one)
    found = list(load_results([file]).values())
    assert found[1:] == saved[1:]
    assert math.isnan(found[0].rmse)
    assert found[0].max_tilt is None
    assert found[0].reason == refused.reason
    assert "NaN" not in file.read_text()
    append_result(file, result(rmse=0.01))
    assert load_results([file])[refused.run].rmse == 0.01  # the last line counts


def test_a_killed_run_goes_on_where_it_stopped(tmp_path, monkeypatch):
    file, ran = tmp_path / "results.jsonl", pretended(monkeypatch)
    first = placements.run_placements(["acfra", "other"], [SETUP], range(2), out=file)
    assert len(ran) == 4
    with file.open("a") as text:
        text.write('{"policy": "acf')
    again = placements.run_placements(["acfra", "other"], [SETUP], range(3), out=file)
    assert ran[4:] == [("acfra", 2), ("other", 2)]
    assert again[:4] == first
    assert len(load_results([file])) == 6
    placements.run_placements(["acfra"], [SETUP], range(3), max_tilt=0.5, out=file)
    assert len(ran) == 9  # another limit is another run


def test_results_of_other_code_are_used_only_on_request(tmp_path, monkeypatch):
    file, ran = tmp_path / "results.jsonl", pretended(monkeypatch)
    append_result(file, result())
    placements.run_placements(["acfra"], [SETUP], range(1), out=file, reuse=True)
    assert not ran
    placements.run_placements(["acfra"], [SETUP], range(1), out=file)
    assert len(ran) == 1


@pytest.mark.parametrize("line", ["no JSON", "[1]", '{"policy": 3}'])
def test_what_is_not_a_result_is_rejected_with_its_line(tmp_path, line):
    file = tmp_path / "results.jsonl"
    append_result(file, result())
    with file.open("a") as text:
        text.write(line + "\n")
    with pytest.raises(FileFormatError, match="line 2"):
        load_results([file])
    with pytest.raises(InputError, match="can't be read"):
        load_results([tmp_path / "none.jsonl"])
    repaired(tmp_path / "none.jsonl")
    with pytest.raises(InputError, match="can't be saved"):
        append_result(tmp_path / "no folder" / "results.jsonl", result())


def test_pairs_count_only_what_the_baseline_solves():
    results = [
        *(result(seed=seed) for seed in range(4)),
        replace(result(seed=4, outcome="refused", computing=0.4), rmse=math.nan),
        *(result("baseline", seed, computing=0.2, rmse=0.1, deviation=10.0) for seed in range(2, 5)),
        replace(result("baseline", 1, "refused"), rmse=math.nan),
        result("baseline", 99),  # acfra was not run there
    ]
    style, pairs = comparison_tables(results)
    assert [row[2] for row in style.rows] == ["5", "5"]
    (row,) = pairs.rows
    assert row[:5] == ("default", "baseline", "default", "skill", "3")
    assert row[5].startswith("2 (66.7 %")
    assert row[7:] == ("0.50", "0.50", "0.40")
    other = replace(SETUP, skill="folder/other.json")
    more = [replace(one, setup=other) for one in (result(seed=7), result("baseline", 7, computing=0.1))]
    rows = comparison_tables([*results, *more])[1].rows
    assert [row[3:5] for row in rows] == [("all", "4"), ("skill", "3"), ("other", "1")]
    with pytest.raises(InputError, match="another policy"):
        comparison_tables(results[:4])


def test_the_comparison_is_printed_from_files_and_put_into_a_document(tmp_path, capsys):
    file, document = tmp_path / "results.jsonl", tmp_path / "doc.md"
    document.write_text(f"before\n<!-- imitarm benchmark comparison -->\n{END}\nafter\n")
    for one in (result(max_tilt=math.radians(30)), result("rrt-connect")):
        append_result(file, one)
    assert cli.main(["benchmark", "comparison", str(file), "--fill", str(document)]) == 0
    assert "acfra in the placements that a baseline solves" in capsys.readouterr().out
    assert "| 30° | rrt-connect | default | skill | 1 |" in document.read_text()
    assert cli.main(["benchmark", "comparison", str(tmp_path / "none")]) == 2
    assert cli.main(["benchmark", "placements", "--out", str(file)]) == 2
    assert "--out needs --skill" in capsys.readouterr().err


def test_motions_that_arrived_late_are_listed():
    results = [result(seed=seed, duration=1.0) for seed in range(2)]
    (outcomes,) = placement_tables(results)
    assert outcomes.rows[0][8].startswith("2 (100.0 %")
    results += [result(seed=2, duration=1.6), result(seed=3, duration=2.5), result(seed=4, outcome="refused")]
    outcomes, late = placement_tables(results)
    assert outcomes.rows[0][8].startswith("2 (50.0 %")  # of the accepted
    assert [row[3:] for row in late.rows] == [("3", "2.50"), ("2", "1.60")]


def test_the_rmse_is_compared_with_the_tool_alone_where_both_solve():
    results = [
        *(result(seed=seed, rmse=0.060, tool_rmse=0.050) for seed in range(3)),
        result(seed=3, rmse=0.9, tool_rmse=math.nan),  # the tool alone is refused
        result(seed=4, outcome="refused", rmse=math.nan),
    ]
    _, compared = placement_tables(results)
    assert compared.rows == (("acfra", "skill", "3", "60.0", "50.0", "1.200 (1.200 to 1.200)"),)
    other = replace(result(seed=5, rmse=0.01, tool_rmse=0.02), setup=replace(SETUP, skill="folder/other.json"))
    _, compared = placement_tables([*results, other])
    assert [row[1:3] for row in compared.rows] == [("all", "4"), ("skill", "3"), ("other", "1")]


def packaged(folder, robot="sawyer"):
    """The packaged skill on an arm with the brush."""
    return Setup(str(placements.packaged_skill(folder)), robot, "brush")


@pytest.mark.parametrize(
    ("options", "expected"),
    [([], [("sawyer", "brush")]), (["--robots", "panda", "sawyer"], [("panda", "brush"), ("sawyer", "brush")])],
)
def test_the_packaged_skill_is_used_with_the_named_arms(options, expected, monkeypatch):
    used = []
    monkeypatch.setattr(placements, "run_placements", lambda policies, setups, *_, **__: used.extend(setups) or [])
    monkeypatch.setattr("imitarm.cli.benchmark_placements.placement_tables", lambda results: [])
    assert cli.main(["benchmark", "placements", "--seeds", "1", *options]) in (0, 1)
    assert [(setup.robot, setup.tool) for setup in used] == expected


def test_the_path_of_the_tool_alone_has_the_same_ends_and_leaves_out_the_links(tmp_path):
    setup = packaged(tmp_path)
    _, arm, start = placements._prepared(setup)
    path = placements._tool_path(setup).nominal
    assert path.positions[0] == pytest.approx(arm.tool_pose(start).position, abs=1e-9)
    learned, _ = placements._demonstrated(setup)
    assert path.positions[-1] == pytest.approx(learned.positions[-1], abs=1e-3)
    alone = placements.tool_alone(setup, Scene())
    assert alone < 1e-3  # the learned path itself
    centers, _ = arm.collision_spheres(start)
    at_a_link = Sphere(centers[0], 0.05)
    assert placements.tool_alone(setup, Scene(None, (at_a_link,))) == alone
    on_the_path = Sphere(path.positions[100], 0.03)
    assert 0.005 < placements.tool_alone(setup, Scene(None, (on_the_path,))) < 0.2
    at_the_goal = Sphere(path.positions[-1], 0.03)
    assert math.isnan(placements.tool_alone(setup, Scene(None, (at_the_goal,))))


def test_a_placement_that_is_solved_has_both_distances(tmp_path):
    found = placements.run_placement("acfra", packaged(tmp_path), 0)
    assert found.outcome == "arrived"
    assert 0.0 < found.tool_rmse < 2.0 * found.rmse
