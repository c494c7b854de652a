from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from imitarm.benchmark import thesis_table
from imitarm.benchmark.experiment import LIVE, Experiment, Result
from imitarm.benchmark.fingerprint import code_version, tables_version
from imitarm.benchmark.intervals import Comparison, Interval
from imitarm.benchmark.mapping import BEGIN, CAMERAS, END, MappingBenchmark, fill_document, tables, write_tables
from imitarm.benchmark.mapping_methods import MAIN, METHODS
from imitarm.benchmark.mapping_pairs import COMPARED, comparison_table, rivals_table
from imitarm.benchmark.mapping_report import mapping_report_html
from imitarm.benchmark.mapping_tables import (
    ACCURACY,
    EFFORT,
    JUDGED,
    SMOOTHNESS,
    Figure,
    Results,
    accuracy_table,
    limits_table,
    recordings_table,
    success_table,
    written,
    written_each,
)
from imitarm.benchmark.recordings import CAPTURED
from imitarm.benchmark.running import run_all
from imitarm.benchmark.stacking import failures
from imitarm.benchmark.tables import Table
from imitarm.benchmark.thesis_table import PATH, TIME, TORQUES, claims_table, verdict
from imitarm.errors import InputError, UnknownNameError

ME = ("thesis", "modern")


def live(method, person, repeat, success=True, time=40.0):
    """A made-up result of a closed-loop trial."""
    values = {
        **{"success": success, "failure": "" if success else "dropped", "time": time, "path_length": 5.0},
        **{"mean_torque": [1.0] * 7},
    }
    return Result(Experiment(LIVE, method, seed=person, repeat=repeat), "0", values, "", 1.0)


def replay(method, person, torque, path=3.0, singular=0.05, kind="stacking"):
    values = {
        **{"mean_torque": [torque] * 7, "path_length": path, "least_singular": singular, "led_share": 1.0},
        **{f"{kind_}_violations": 0 for kind_ in ("position", "velocity", "acceleration")},
        "failures": 0,
    }
    return Result(Experiment(kind, method, seed=person), "0", values, "", 1.0)


def held(results, claim, me):
    table = claims_table(Results(results), ["stacking"])
    (row,) = (row for row in table.rows if row[0].startswith(claim))
    return row[2 + 2 * ME.index(me)]


def world(mine, theirs, persons=8):
    """Results in which Me has one torque and all rivals another, persons differing more than methods."""
    rng = np.random.default_rng(0)
    found = []
    for person in range(persons):
        own = rng.uniform(5.0, 15.0)
        found += [replay(me, person, own + mine) for me in ME]
        found += [replay(rival, person, own + theirs) for rival in ("m1", "m2", "m3")]
    return found


def test_a_claim_holds_only_when_the_data_say_so():
    assert held(world(-1.0, 0.0), "less torque", "modern") == "yes"
    assert held(world(1.0, 0.0), "less torque", "modern") == "no"
    assert held(world(0.0, 0.0), "less torque", "modern") == "not shown"
    assert held(world(-1.0, 0.0, persons=2), "less torque", "modern") == "not shown"  # two persons show nothing


def test_a_claim_against_all_rivals_falls_with_one_of_them():
    results = [r for r in world(-1.0, 0.0) if r.experiment.method != "m2"]
    assert held(results, "less torque", "thesis") == "yes"
    better = [replay("m2", person, 0.1) for person in range(8)]
    assert held([*results, *better], "less torque", "thesis") == "no"


def test_times_are_compared_only_where_both_succeeded():
    results = world(0.0, 0.0)
    for person in range(8):
        for repeat in range(3):
            results += [live(me, person, repeat, time=30.0 + person) for me in ME]
            for rival in ("m1", "m2", "m3"):
                results.append(live(rival, person, repeat, success=repeat > 0, time=35.0 + person + repeat))
    assert held(results, "done in less time", "modern") == "yes"
    assert held(world(0.0, 0.0), "done in less time", "modern") == "not run"
    nobody = [*world(0.0, 0.0), *(live(m, p, 0, success=m in ME) for m in MAIN for p in range(8))]
    assert held(nobody, "done in less time", "modern") == "not shown"  # no rival to compare with


def comparison(low, mean, high, p):
    return Comparison(Interval(mean, low, high, 10, 10, 10), 0.0, p)


def test_a_verdict_needs_the_interval_and_the_probability():
    sure, unsure = comparison(-3.0, -2.0, -1.0, 0.002), comparison(-3.0, -2.0, -1.0, 0.2)
    assert verdict([sure, sure], -1.0) == "yes"
    assert verdict([sure, unsure], -1.0) == "not shown"
    assert verdict([sure, sure], 1.0) == "no"
    assert verdict([], 1.0) == "not shown"
    assert verdict([comparison(math.nan, math.nan, math.nan, 1.0)], 1.0) == "not shown"


def test_the_printed_table_is_the_thesiss():
    """Means that METHODS A.10 gives; every row has seven torques."""
    assert TORQUES.shape == (10, 7)
    assert PATH.mean() == pytest.approx(8.53, abs=0.01)
    assert TIME.mean() == pytest.approx(15.1, abs=0.05)
    assert (TORQUES[:, 4].min(), TORQUES[:, 4].max()) == (10.23, 19.34)
    assert (TORQUES[:, 6].min(), TORQUES[:, 6].max()) == (20.35, 41.8)
    assert np.corrcoef(np.arange(10), TIME)[0, 1] < -0.8  # it falls from experiment to experiment


def test_no_average_over_failures_without_the_successes_beside_it():
    results = [live("modern", p, r, success=p > 0, time=40.0 if p else 999.0) for p in range(4) for r in range(2)]
    (row,) = success_table(Results(results)).rows
    assert row[1] == "6 of 8"
    assert row[3].startswith("40")  # the failures' 999 s are not in it
    assert row[-1] == "2 dropped"
    assert failures(["", "dropped", "tower fell", "dropped", ""]) == "2 dropped, 1 tower fell"
    assert failures(["", ""]) == "none"
    assert written(Interval(0.0412, 0.04, 0.05, 3, 5, 8), Figure("x", "", 1e3)) == "41.2 (40.0 to 50.0), 5 of 8"
    assert written(Interval(math.nan, math.nan, math.nan, 0, 0, 8), Figure("x", "")) == "– (0 of 8)"


def test_where_a_rival_is_better_it_is_said():
    results = [*world(0.0, -1.0), *(live("modern", p, 0, success=p > 3) for p in range(8))]
    results += [live("m3", p, 0) for p in range(8)]
    table = rivals_table(Results(results), ["stacking"])
    assert {row[2] for row in table.rows if row[1].startswith("mean torque")} == {"M1", "M2", "M3"}
    ((measure, better, difference),) = [row[1:4] for row in table.rows if row[0] == LIVE]
    assert (measure, better) == ("stacked [%] ↑", "M3")
    assert difference.startswith("-50 (-")
    assert rivals_table(Results(world(-1.0, 0.0)), ["stacking"]).rows == ()


def test_a_method_that_stacks_more_often_is_named_also_when_chance_could_do_it():
    results = [live("modern", p, r, success=p + r > 0) for p in range(8) for r in range(5)]
    results += [live("m3", p, r) for p in range(8) for r in range(5)]
    ((measure, better, difference),) = [row[1:4] for row in rivals_table(Results(results), []).rows]
    assert (measure, better) == ("stacked [%] ↑", "M3")
    assert difference.startswith("-2 (")
    results = [live(method, p, 0, success=p > 0 or method == "m3") for method in ("modern", "m3") for p in range(2)]
    assert rivals_table(Results(results), []).rows[0][3].startswith("-50 (-100 to ")  # rates are no farther apart


def one_measure(name, mine, theirs):
    """Results of eight persons that differ in one measure alone."""
    rng = np.random.default_rng(1)
    found = []
    for person in range(8):
        for method, value in (("modern", mine), ("m3", theirs)):
            result = replay(method, person, 1.0)
            found.append(Result(result.experiment, "0", {**result.values, name: value + rng.normal(0, 0.01)}, "", 1.0))
    return Results(found)


MEASURED = sorted({figure.name for figure in COMPARED} - {"broken_limits", "mean_torque"})


@pytest.mark.parametrize("name", MEASURED)
def test_in_every_measure_a_better_rival_is_named_and_a_worse_one_is_not(name):
    more = name in {"led_share", "spectral_arc_length", "least_singular"}
    low, high = (-5.0, -4.0)
    better, worse = (high, low) if more else (low, high)
    named = rivals_table(one_measure(name, worse, better), ["stacking"]).rows
    assert [row[1].removesuffix(" ↑") for row in named] == [f.title for f in COMPARED if f.name == name]
    assert named[0][1].endswith("↑") == more
    assert float(named[0][4]) * (1 if not more else -1) > 0  # the sign says it, too, whatever sign the numbers have
    assert rivals_table(one_measure(name, better, worse), ["stacking"]).rows == ()


def test_nothing_that_the_tables_show_is_left_out_of_the_comparison():
    assert {f.name for f in (*ACCURACY, *EFFORT, *SMOOTHNESS)} <= {f.name for f in COMPARED}
    for name in ("led_share", "mean_torque", "rms_torque", "mean_motion_torque", "broken_limits"):
        assert name in {f.name for f in COMPARED}
    for figure in COMPARED:
        if figure.name in {"spectral_arc_length", "least_singular", "led_share"}:
            assert figure.more


def test_probabilities_are_corrected_within_a_measure_and_not_beyond():
    """Each of three rivals differs from modern with the least probability that eight persons can give."""
    results = [r for r in world(-1.0, 0.0) if r.experiment.method != "thesis"]
    least = pytest.approx(3 * 2 / 2**8, abs=1e-3)
    rows = comparison_table(Results(results), ["stacking"]).rows
    assert [float(row[5]) for row in rows if row[0] == "mean torque [N m]"] == [least] * 3
    alone = [r for r in results if r.experiment.method in {"modern", "m1"}]
    rows = comparison_table(Results(alone), ["stacking"]).rows
    assert [float(row[5]) for row in rows if row[0] == "mean torque [N m]"] == [pytest.approx(2 / 2**8, abs=1e-3)]


def captured(method, camera, lag, seed=JUDGED):
    values = {"lag": lag, "led_share": 1.0, "recorded": 43.0, "beyond_reach": 0.0}
    values |= {f"{kind}_violations": 0 for kind in ("position", "velocity", "acceleration")} | {"failures": 0}
    return Result(Experiment(CAPTURED, method, seed=seed, repeat=camera, data="x"), "0", values, "", 1.0)


def test_the_captured_arm_is_one_person_and_has_no_interval():
    results = [captured(m, camera, lag) for m in ("modern", "m3") for camera, lag in ((0, 0.044), (1, 0.075))]
    table = accuracy_table(Results(results), CAPTURED)
    lag = table.columns.index("lag [ms]>")
    assert [row[lag] for row in table.rows] == ["60 (44 and 75)"] * 2
    assert not any(" to " in cell for row in table.rows for cell in row)
    assert "One person's" in table.note
    ((kind, n, who, *facts),) = recordings_table(Results(results)).rows
    assert (kind, n, who, facts[0]) == (CAPTURED, "2", "1 person, 2 cameras", "43.0 (43.0 and 43.0)")
    titles = [t.title for t in tables(Results(results))]
    assert not any(title.startswith(("Paired", "Where another", "What the thesis")) for title in titles)
    other = [captured("modern", 0, 0.04, seed=100), captured("modern", 1, 0.04, seed=101)]
    assert {person for person, _ in Results(other).values("modern", [CAPTURED], "lag")} == {-1}
    assert written_each({(-1, 0): 1.0, (-1, 1): math.nan}, Figure("x", "")) == "1.0, 1 of 2"
    assert written_each({(-1, 0): math.nan}, Figure("x", "")) == "– (0 of 1)"


def test_a_rates_interval_is_over_persons_and_honest_where_all_are_alike():
    alike = [live("modern", p, r) for p in range(10) for r in range(5)]
    ((_, rate, within, *_),) = success_table(Results(alike)).rows
    assert (rate, within) == ("50 of 50", "72 to 100")  # Wilson's of 10 of 10, not of 50 of 50
    halves = [live("modern", p, r, success=p < 5) for p in range(10) for r in range(5)]
    ((_, rate, within, *_),) = success_table(Results(halves)).rows
    low, high = (float(word) for word in within.split(" to "))
    assert rate == "25 of 50"
    assert low < 25.0 < 75.0 < high  # as five of ten, not as 25 of 50, which Wilson has at 37 to 63


def test_a_recording_that_cant_be_made_is_missing_and_said():
    results = [replay(m, p, 1.0) for m in ("modern", "m3") for p in range(JUDGED, JUDGED + 3)]
    results = [Result(r.experiment, "0", {**r.values, "recorded": 12.0, "beyond_reach": 0.0}, "", 1.0) for r in results]
    results += [
        Result(
            Experiment("stacking", m, seed=JUDGED + 3), "0", {}, "TaskFailedError: the recording can't be made: no", 1.0
        )
        for m in ("modern", "m3")
    ]
    table = recordings_table(Results(results))
    assert table.rows[0][:4] == ("stacking", "3 of 4", "4 made up", "12.0 (12.0 to 12.0)")
    found = tables(Results(results))
    assert all(len(row) == len(t.columns) for t in found for row in t.rows)
    (limits,) = (t for t in found if t.title.startswith("Limits broken"))
    assert {row[1] for row in limits.rows} == {"3 of 3"}  # nothing that the methods did
    page = mapping_report_html(Results(results[-2:]), [], provenance={}, folder=None)
    assert "modern was not run" in page
    lost = Result(Experiment("stacking", "modern", seed=JUDGED), "0", {}, "TaskFailedError: it gave up", 1.0)
    assert limits_table(Results([lost]), ["stacking"]).rows[0][1] == "0 of 1"  # what it did
    assert recordings_table(Results([lost])).rows[0][1] == "1"


def test_it_is_said_which_persons_they_were():
    judged = [replay("modern", p, 1.0) for p in (JUDGED, JUDGED + 1)]
    assert recordings_table(Results(judged)).note.endswith("Persons 100 to 101.")
    seen = [live("modern", 0, 0)]
    assert success_table(Results(seen)).note.endswith("Those below 100 were in sight while methods were worked on.")


def test_every_experiment_of_a_recording_has_the_same_recording():
    benchmark = MappingBenchmark(people=3, repeats=2, data="somewhere")
    found = benchmark.experiments()
    assert len(set(found)) == len(found)
    plans = {e.plan for e in found if e.task != LIVE}
    for name in METHODS:
        assert {e.plan for e in found if e.task != LIVE and e.method == name} == plans
    assert {e.method for e in found if e.task == LIVE} == set(MAIN)
    assert sum(e.task == LIVE for e in found) == 3 * 2 * len(MAIN)
    full = {e.plan for e in MappingBenchmark().experiments() if e.task != LIVE}
    assert len(full) >= 30
    assert {plan.person for plan in full} == set(range(JUDGED, JUDGED + 10))


def test_nobody_whom_the_methods_were_tuned_with_judges_them_unless_asked():
    found = MappingBenchmark(data="somewhere").experiments()
    assert {e.seed for e in found} == set(range(100, 110))
    assert {(e.seed, e.repeat) for e in found if e.task == CAPTURED} == {(100, camera) for camera in range(CAMERAS)}
    again = MappingBenchmark(people=2, first=3, data="somewhere").experiments()
    assert {e.seed for e in again if e.task != CAPTURED} == {3, 4}
    seeds = {e.plan.number for e in found if e.task != LIVE}
    assert seeds.isdisjoint(e.plan.number for e in MappingBenchmark(people=100, first=0).experiments())
    assert len(seeds) == len({e.plan for e in found if e.task != LIVE})


@pytest.mark.parametrize(
    "bad", [{"people": 0}, {"repeats": 0}, {"first": -1}, {"methods": ()}, {"kinds": (), "live": False}]
)
def test_what_is_no_benchmark_is_refused(bad):
    with pytest.raises(InputError):
        MappingBenchmark(**bad)


def test_an_unknown_method_is_refused_by_name():
    with pytest.raises(UnknownNameError, match="modern"):
        MappingBenchmark(methods=("magic",)).experiments()


def test_tables_go_between_the_marks_and_nothing_else_changes(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\nbefore\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    table = Table("T", ("a", "b>"), (("x|y", "1"),), "note")
    for _ in range(2):
        fill_document(page, [table], "imitarm benchmark mapping", "0+abc", "0+def")
        text = page.read_text()
        assert text.startswith(f"# Title\n\nbefore\n\n{BEGIN}\n")
        assert text.endswith(f"{END}\n\nafter\n")
        assert "old" not in text
        assert "Printed by `imitarm benchmark mapping`, code 0+abc, tables 0+def.\n" in text
        assert "| x\\|y | 1 |" in text
        assert text.count("**T**") == 1
    for wrong in ("no marks\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{BEGIN}\n{END}\n"):
        page.write_text(wrong)
        with pytest.raises(InputError, match="between"):
            fill_document(page, [table], "", "", "")
        assert page.read_text() == wrong


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small but real benchmark: two people, two methods, the edge of reach."""
    folder = tmp_path_factory.mktemp("mapping")
    benchmark = MappingBenchmark(
        people=2, repeats=1, methods=("modern", "m3"), kinds=("inside", "edge"), seconds=4.0, live=False
    )
    return folder, Results(run_all(benchmark.experiments(), folder, jobs=1))


@pytest.mark.slow
def test_a_small_benchmark_fills_its_tables(small, tmp_path):
    _, results = small
    assert not any(r.failure for r in results.all)
    found = tables(results)
    titles = [table.title for table in found]
    assert any(title.startswith("Accuracy, edge") for title in titles)
    assert any(title.startswith("Limits broken") for title in titles)
    for table in found:
        assert table.rows or table.title.startswith("Where another")
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert "nan" not in table.markdown()
    (limits,) = (t for t in found if t.title.startswith("Limits broken: inside, edge"))
    modern = next(row for row in limits.rows if row[0] == "modern")
    assert modern[1:5] == ("4 of 4", "0", "0", "0")
    document, data = write_tables(results, found, tmp_path)
    assert document.read_text().count("**") >= 2 * len(found)
    content = json.loads(data.read_text())
    assert len(content["results"]) == 8
    assert content["results"][0]["values"]["tool_rms"] > 0.0


@pytest.mark.slow
def test_the_report_is_complete_and_asks_nothing_of_the_network(small):
    folder, results = small
    page = mapping_report_html(results, tables(results), provenance={"command": "x"}, folder=folder / "recordings")
    assert page.count("<svg") >= 3
    assert "default-src 'none'" in page
    assert "Show in 3-D" in page
    assert 'id="method-modern"' in page
    assert 'id="method-m3"' in page
    assert "0 of 4 recordings" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?:https?:)?//""", page)


def test_every_claim_is_judged_by_the_data():
    """With nothing run there is nothing that held."""
    table = claims_table(Results([]), [])
    assert len(table.rows) == len(thesis_table.CLAIMS)
    assert {row[2] for row in table.rows} == {"not run"}


def test_the_documents_tables_are_of_this_code_or_it_says_that_they_are_not():
    text = (Path(__file__).parents[1] / "docs" / "mapping_benchmark.md").read_text(encoding="utf-8")
    printed = text.split(f"{BEGIN}\n")[1].split("\n")[0]
    code = f"code {code_version()}, tables {tables_version()}"
    present = printed.endswith(f", {code}.")
    told = re.search(r"Printed [^.]*at commit [0-9a-f]{7,40}\b.*has to be run again", " ".join(text.split()))
    assert present or told, (
        f"docs/mapping_benchmark.md: {printed!r} is not {code}. Print it anew with --fill, or say in it that it was "
        "printed at commit ... and that the command has to be run again"
    )
    assert not (present and told), "docs/mapping_benchmark.md: these tables are of this code; take the paragraph out"
