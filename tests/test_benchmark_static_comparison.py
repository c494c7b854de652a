from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest, wilcoxon

from imitarm import cli
from imitarm.benchmark import static_tuning
from imitarm.benchmark.running import Workers
from imitarm.benchmark.static import RESULTS, StaticExperiment, StaticResult, policy_class
from imitarm.benchmark.static_claims import claims_table, cost_law, static_tables
from imitarm.benchmark.static_comparison import (
    PRINTED,
    mcnemar,
    pairing,
    pairings,
    printed_table,
    signed_rank,
    skills_table,
    task_of,
    teachers_table,
)
from imitarm.benchmark.static_scaling import Plan, exponent, plan_once, scaling_case
from imitarm.benchmark.static_scenes import ANY_SKILL, learned_skill
from imitarm.benchmark.static_tables import (
    StaticResults,
    checked_refusals_table,
    obstacles_table,
    refusals_table,
    row_name,
    scenes_table,
    success_table,
)
from imitarm.benchmark.static_tuning import Search, score, tune, write_tuned
from imitarm.benchmark.tables import END
from imitarm.errors import FileFormatError, InputError
from imitarm.tasks.sweep import NUMBERED_SCENES


def result(method, seed, outcome, family="S1", dimension=2, teachers=1, options=(), skill="", **values):
    experiment = StaticExperiment(family, dimension, seed, method, teachers, options, skill=skill)
    known = {"n_obstacles": 2, "must_refuse": None, "rmse": 0.05, "plan_cpu": 0.01, "plan_seconds": 0.01}
    return StaticResult(experiment, "commit 1", outcome, "", {**known, **values})


def oracle(seed, answer="possible", **more):
    return result("oracle", seed, "success" if answer == "possible" else "refused", answer=answer, **more)


def rows_of(table):
    return {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}


@pytest.mark.parametrize(("b", "c"), [(0, 0), (0, 1), (3, 9), (10, 10), (400, 300), (0, 2000)])
def test_mcnemar_is_the_exact_sign_test(b, c):
    expected = 1.0 if b + c == 0 else binomtest(b, b + c).pvalue
    assert mcnemar(b, c) == mcnemar(c, b) == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_the_signed_rank_test_is_scipys_and_ignores_ties():
    d = np.random.default_rng(0).normal(0.3, 1.0, 40)
    assert signed_rank(np.append(d, [0.0, 0.0])) == pytest.approx(float(wilcoxon(d).pvalue))
    assert signed_rank(np.zeros(5)) == 1.0


def test_pairs_are_counted_in_common_solvable_scenes():
    found = [oracle(s) for s in range(6)] + [oracle(6, "impossible")]
    ours = ["success", "success", "too near", "contact", "refused", "success", "contact"]
    other = ["success", "contact", "success", "success", "refused", "late", "success"]
    found += [result("acfra", s, o, rmse=0.03) for s, o in enumerate(ours)]
    found += [result("apf", s, o, rmse=0.04) for s, o in enumerate(other)]
    found.append(result("acfra", 7, "success"))  # the other was not run there
    p = pairing(StaticResults(found), "apf", lambda s: True)
    assert (p.scenes, p.only_ours, p.only_other, p.both) == (6, 2, 1, 2)
    assert p.difference == pytest.approx(-0.01)
    assert p.p_success == pytest.approx(binomtest(1, 3).pvalue)


def test_p_values_are_corrected_for_the_number_of_methods():
    found = [oracle(s) for s in range(8)] + [result("acfra", s, "success") for s in range(8)]
    found += [result(m, s, "contact") for m in ("apf", "barrier") for s in range(8)]
    alone = mcnemar(8, 0)
    assert [p.p_success for p in pairings(StaticResults(found), lambda s: True)] == pytest.approx([2 * alone] * 2)


def test_only_scenes_that_the_oracle_solves_count():
    found = [oracle(0), oracle(1, "impossible"), oracle(2, "undecided")]
    found += [result("acfra", s, o) for s, o in enumerate(("success", "refused", "refused"))]
    found += [result("no-avoidance", s, "contact") for s in range(3)]
    results = StaticResults(found)
    assert results.rows == ("acfra", "no-avoidance", "oracle")
    success = {row[1]: row for row in success_table(results).rows}
    assert success["acfra"][2:4] == ("1", "100.0 (20.7 to 100.0)")
    assert success["no-avoidance"][3].startswith("0.0")
    refused = rows_of(refusals_table(results))["acfra"]
    assert refused["impossible scenes>"] == "1"
    assert refused["refused, rightly % (95 %)>"].startswith("100.0")
    assert refused["refused, but possible % (95 %)>"].startswith("0.0")
    assert refused["refused undecided scenes>"] == "1 of 1"
    assert scenes_table(results).rows[-1] == ("all", "3", "1", "1", "1", "0")


def test_without_the_oracle_the_construction_of_the_scene_decides():
    found = [result("acfra", s, "refused", must_refuse=m) for s, m in enumerate((True, False, None))]
    found += [result("apf", 2, "success")]
    assert list(StaticResults(found).answers.values()) == ["impossible", "possible", "possible"]


def test_a_method_that_solves_the_impossible_is_listed():
    results = StaticResults([oracle(4, "impossible"), result("acfra", 4, "success")])
    assert [r.experiment.seed for r in results.beyond_proof(exact=True)] == [4]
    note = scenes_table(results).note
    assert "The oracle is wrong" in note and "acfra in S1, 2-D, seed 4" in note
    assert proof_holds(results) == "no"


def test_a_path_that_ends_beside_the_goal_does_not_contradict_a_proof_for_the_exact_goal():
    beside = StaticResults([oracle(4, "impossible"), result("apf", 4, "success", start_error=0.0, goal_error=0.0039)])
    assert beside.beyond_proof(exact=True) == [] and len(beside.beyond_proof(exact=False)) == 1
    note = scenes_table(beside).note
    assert "The oracle is wrong" not in note and "by up to 5 mm" in note and "apf in S1, 2-D, seed 4" in note
    assert proof_holds(beside) == "yes"


def proof_holds(results):
    """The verdict on the oracle's proofs in the table of claims."""
    held = {row[0]: row[2] for row in claims_table(results).rows}
    return next(v for k, v in held.items() if "proof of the oracle" in k)


@pytest.mark.parametrize(("method", "part"), [("aims-at-obstacle", "aims at"), ("no-avoidance", "without avoidance")])
def test_a_toy_that_succeeds_is_noticed(method, part):
    good = [oracle(s) for s in range(10)] + [result(method, s, "contact") for s in range(10)]
    bad = [*good[:-1], result(method, 9, "success")]
    for found, held in ((good, "yes"), (bad, "no")):
        rows = {row[0]: row[2] for row in claims_table(StaticResults(found)).rows}
        assert next(v for k, v in rows.items() if part in k) == held


def test_the_cost_law_is_that_of_the_times():
    found = [result("acfra", s, "success", n_obstacles=n, plan_cpu=0.002 * n**1.5) for s, n in enumerate((1, 2, 4, 8))]
    slope, error, n = cost_law(StaticResults(found))
    assert slope == pytest.approx(1.5)
    assert error == pytest.approx(0.0, abs=1e-7)
    assert n == 4
    assert math.isnan(cost_law(StaticResults(found[:1]))[0])


def test_claims_are_judged_by_the_results():
    found = []
    for s in range(40):
        n = 2 if s < 20 else 5
        found.append(oracle(s, n_obstacles=n))
        # ours is better with many obstacles, and worse with two
        found.append(result("acfra", s, "success", n_obstacles=n, rmse=0.03 + 1e-4 * s))
        found.append(result("dmp-steering", s, "success", n_obstacles=n, rmse=(0.02 if n == 2 else 0.05) + 1e-4 * s))
    rows = {row[0]: row for row in claims_table(StaticResults(found)).rows}
    two = next(row for claim, row in rows.items() if "with two obstacles" in claim)
    more = next(row for claim, row in rows.items() if "more than two" in claim)
    assert two[2] == "yes" and "succeed in 20 scenes" in two[1] and "+10.0 mm" in two[1]
    assert more[2] == "yes" and "succeed in 20 scenes" in more[1] and "-20.0 mm" in more[1]
    turned = StaticResults([replace(r, values={**r.values, "n_obstacles": 7 - r.values["n_obstacles"]}) for r in found])
    rows = {row[0]: row for row in claims_table(turned).rows}
    assert next(row for claim, row in rows.items() if "more than two" in claim)[2] == "no"
    few = StaticResults([r for r in found if 18 <= r.experiment.seed < 25])
    rows = {row[0]: row for row in claims_table(few).rows}
    assert next(row for claim, row in rows.items() if "more than two" in claim)[2] == "–"


def test_the_table_of_the_thesis_has_its_printed_values():
    assert len(NUMBERED_SCENES) == 8
    assert {task_of(("S7", 2, seed, 1)) for seed in range(2000, 2008)} == {f"T{i}" for i in range(1, 9)}
    assert task_of(("S7", 2, 2000, 1)) == "T1"
    found = [result("acfra", s, "success", "S7", rmse=0.001 * (1 + s % 8)) for s in range(2000, 2016)]
    rows = rows_of(printed_table(StaticResults(found)))
    assert rows["ACFRA, printed"]["T4>"] == "0.0100"
    assert rows["ACFRA, printed"]["average>"] == f"{np.mean(PRINTED['ACFRA']):.4f}"
    assert rows["acfra"]["T3>"] == "0.0030 (2 of 2)"
    assert rows["acfra"]["average>"] == "0.0045"


def test_tables_by_obstacles_and_teachers():
    found = [oracle(s, teachers=t) for s in range(4) for t in (1, 3)]
    found += [
        result("acfra", s, "success" if t == 3 or s < 2 else "contact", teachers=t) for s in range(4) for t in (1, 3)
    ]
    results = StaticResults(found)
    row = rows_of(teachers_table(results))["acfra"]
    assert row["1 teacher: success % (95 %)>"].startswith("50.0")
    assert row["3 teachers: success % (95 %)>"].startswith("100.0")
    assert obstacles_table(results).columns == ("method", "2>")
    assert all(len(r) == len(t.columns) for t in static_tables(results) for r in t.rows)


def test_scenes_with_skills_from_files_have_their_own_table():
    found = [oracle(s, skill=skill) for s in range(4) for skill in ("a/pour.json", "b/draw.json")]
    found += [oracle(9, "impossible", skill="a/pour.json"), result("acfra", 9, "refused", skill="a/pour.json")]
    found += [
        result("acfra", s, "success" if s or "b" in skill else "contact", skill=skill)
        for s in range(4)
        for skill in ("a/pour.json", "b/draw.json")
    ]
    rows = {row[:2]: row for row in skills_table(StaticResults(found)).rows}
    assert rows["pour", "acfra"][2:4] == ("4", "75.0 (30.1 to 95.4)")
    assert rows["pour", "acfra"][7] == "1 of 1"
    assert rows["draw", "acfra"][3].startswith("100.0")
    alone = StaticResults(found)
    assert rows_of(scenes_table(alone))["all"]["scenes>"] == "9"
    mixed = StaticResults([*found, oracle(0), result("acfra", 0, "success"), oracle(0, teachers=3)])
    assert rows_of(scenes_table(mixed))["all"]["scenes>"] == "1"
    assert "Skills from files" in [t.title for t in static_tables(mixed)]
    assert all(len(r) == len(t.columns) for t in static_tables(mixed) for r in t.rows)


def test_a_row_says_whether_its_options_are_tuned(monkeypatch):
    monkeypatch.setattr(static_tuning, "_shipped", lambda: {"apf": (("influence", 0.1),)})
    assert row_name(StaticExperiment("S1", 2, 0, "apf")) == "apf"
    assert row_name(StaticExperiment("S1", 2, 0, "apf", options=(("influence", 0.1),))) == "apf, tuned"
    assert row_name(StaticExperiment("S1", 2, 0, "apf", options=(("influence", 0.2),))) == "apf, influence=0.2"


# --- tuning ------------------------------------------------------------------------------------------------------


def test_draws_are_the_same_every_time_and_within_the_search_space():
    search = Search((("S1", 2, 1000),), draws=64)
    drawn = search.options("apf")
    assert drawn == search.options("apf")
    assert drawn[0] == () and len(drawn) == 64
    space = policy_class("apf").search_space
    for options in drawn[1:]:
        assert {name for name, _ in options} == set(space)
        assert all(space[name][0] * 0.999 <= value <= space[name][1] * 1.001 for name, value in options)
    logs = np.log([dict(options)["repulsion"] for options in drawn[1:]])
    low, high = np.log(space["repulsion"])
    assert abs((logs.mean() - low) / (high - low) - 0.5) < 0.15  # log-uniform
    assert search.options("no-avoidance") == [()]
    with pytest.raises(InputError):
        Search(())


def test_success_decides_and_then_the_rmse():
    def draw(*outcomes, rmse):
        return score("apf", 0, (), [result("apf", s, o, rmse=rmse) for s, o in enumerate(outcomes)])

    best = draw("success", "too near", rmse=0.05)
    assert best.success == 1.0
    assert min([draw("success", "contact", rmse=0.01), best], key=lambda d: d.order) is best
    assert draw("success", "success", rmse=0.04).order < best.order
    assert math.isnan(draw("contact", rmse=0.1).rmse)


def test_a_search_is_logged_resumed_and_saved(tmp_path):
    search = Search((("S1", 2, 1000), ("S1", 2, 1001)), draws=2)
    store, log = RESULTS.store(tmp_path), tmp_path / "log"
    told = []
    best = tune(["acfra", "no-avoidance"], search, store, Workers(1), log=log, on_done=lambda *n: told.append(n))
    assert told[-1][0] == told[-1][1]
    assert len(log.read_text().splitlines()) >= 2
    told.clear()
    assert tune(["acfra", "no-avoidance"], search, store, Workers(1), on_done=lambda *n: told.append(n)) == best
    assert told == [told[-1]]  # nothing was run again
    path = tmp_path / "tuned.json"
    write_tuned({"acfra": best["acfra"]}, search, path)
    write_tuned({"no-avoidance": best["no-avoidance"]}, search, path)
    content = json.loads(path.read_text())
    assert set(content["methods"]) == {"acfra", "no-avoidance"}
    assert content["methods"]["acfra"]["search"]["seeds"] == [1000, 1001]
    path.write_text("{}")
    with pytest.raises(FileFormatError, match="tune again"):
        write_tuned(best, search, path)


def test_shipped_options_can_be_given_to_their_methods():
    for method, options in static_tuning._shipped().items():
        space = policy_class(method).search_space
        assert all(space[name][0] * 0.999 <= value <= space[name][1] * 1.001 for name, value in options)


# --- many obstacles and spheres ----------------------------------------------------------------------------------


def test_the_exponent_is_that_of_a_power_law():
    plans = [Plan(n, 0.01 * n**0.7, "success") for n in (1, 2, 4, 8, 16)]
    slope, error = exponent(plans)
    assert slope == pytest.approx(0.7)
    assert error == pytest.approx(0.0, abs=1e-7)
    assert math.isnan(exponent(plans[:1])[0])


def test_scenes_of_more_obstacles_contain_those_of_fewer():
    few, many = (scaling_case(n, 4, 1000) for n in (4, 20))
    assert len(many.scene.obstacles) == 20
    assert all(
        (a.bounds() == b.bounds()).all() for a, b in zip(few.scene.obstacles, many.scene.obstacles[:4], strict=True)
    )
    assert few.tool_spheres.shape == (4, 4)
    blocked = scaling_case(1, 1, 1000)
    assert StaticResults([]).all == [] and plan_once("no-avoidance", blocked, 1).outcome == "contact"
    assert plan_once("acfra", blocked, 1).outcome == "success"


def test_the_scaling_command_prints_exponents(capsys):
    words = ["benchmark", "static", "scaling", "--methods"]
    assert cli.main([*words, "no-avoidance", "--count", "1", "--first", "1000"]) == 0
    printed = capsys.readouterr().out
    assert "number of obstacles" in printed and "number of spheres" in printed and "exponent" in printed
    assert cli.main([*words, "magic"]) == 2


def test_every_refusal_is_checked_and_counted_in_its_family():
    found = [result("acfra", s, o, family="S4") for s, o in enumerate(["refused", "refused", "refused", "success"])]
    found += [
        replace(oracle(s, a, plan_cpu=0.1 + s), experiment=replace(found[s].experiment, method="oracle"))
        for s, a in enumerate(["impossible", "possible", "undecided"])
    ]
    found.append(result("acfra", 9, "success"))
    table = checked_refusals_table(StaticResults(found))
    rows = rows_of(table)
    for family, scenes in (("S4, 2-D", "4"), ("all", "5")):
        row = rows[family]
        assert [row[c] for c in ("scenes>", "refused>", "right>", "wrong>", "undecided>")] == [
            scenes,
            "3",
            "1",
            "1",
            "1",
        ]
        assert row["right % (95 %)>"].startswith("33.3")
        assert row["oracle, longest [s]>"] == "2.10"
    assert rows["S1, 2-D"]["refused>"] == "0"
    assert "S4, 2-D, seed 1 (possible); S4, 2-D, seed 2 (undecided)" in table.note


def test_the_command_checks_every_refusal(tmp_path, capsys):
    words = ["benchmark", "static", "refusals", "--count", "1", "--first", "1000", "--dimensions", "2"]
    out = ["--out", str(tmp_path / "out")]
    document = tmp_path / "doc.md"
    document.write_text(f"<!-- imitarm benchmark static refusals -->\n{END}\n")
    assert cli.main([*words, *out, "--families", "S1", "S6", "--fill", str(document)]) == 0
    assert "| S6, 2-D | 1 | 1 | 1 | 0 | 0 |" in document.read_text()
    assert cli.main([*words, *out, "--families", "S1"]) == 0  # nothing is refused
    assert "none" in capsys.readouterr().out


# --- a small part, against saved results -------------------------------------------------------------------------

SAVED = Path(__file__).parent / "static_results"
RENEW = (
    "if the change is intended, delete the saved results and make them again: imitarm benchmark static --first 1190 "
    "--count 1 --families S1 S3 S4 S7 --settings default --methods METHOD --out tests/static_results"
)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in SAVED.glob("*.jsonl")))
def test_a_small_part_gives_the_saved_results(name):
    for saved in RESULTS.read(SAVED / f"{name}.jsonl"):
        found = saved.experiment.run()
        where = f"{saved.experiment}; {RENEW}"
        assert (found.outcome, set(found.values)) == (saved.outcome, set(saved.values)), where
        for key, value in saved.values.items():
            if key not in {"build_seconds", "plan_seconds", "plan_cpu"} and isinstance(value, float):
                assert found.values[key] == pytest.approx(value, rel=1e-4, abs=1e-6), f"{key}: {where}"


# --- the command -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_runs_resumes_compares_and_draws(tmp_path, capsys):
    out, page, document = tmp_path / "out", tmp_path / "pages" / "page.html", tmp_path / "doc.md"
    document.write_text(f"before\n<!-- imitarm benchmark static -->\n{END}\nafter\n")
    run = [
        "benchmark",
        "static",
        "--first",
        "1000",
        "--count",
        "1",
        "--methods",
        "acfra",
        "acfra-literal",
        "no-avoidance",
    ]
    run += ["no-avoidance", "--families", "S1", "S7", "--out", str(out), "--jobs", "1", "--torque", "1"]
    assert cli.main(run) == 0
    printed = capsys.readouterr().out
    assert "12 experiments" in printed and "per minute" in printed
    assert cli.main(run) == 0
    assert "0 experiments" in capsys.readouterr().out
    words = ["--report", str(page), "--fill", str(document), "--json", str(tmp_path / "t.json")]
    page.parent.mkdir()
    assert cli.main(["benchmark", "static", "compare", str(out), *words, "--markdown", str(tmp_path / "t.md")]) == 0
    printed = capsys.readouterr().out
    for said in ("Claims of the thesis", "Table 4.1", "Fig 4.9", "Paired comparison", "Refusals"):
        assert said in printed
        assert said in document.read_text()
    assert str(tmp_path) not in document.read_text()
    assert json.loads((tmp_path / "t.json").read_text())["tables"]
    text = page.read_text()
    assert text.count("<svg") >= 4 and "acfra-literal: S" in text
    assert cli.main(["benchmark", "static", "compare", str(out), "--report", str(page), "--play", "S1,2,1000"]) == 0
    assert "acfra: S1, 2-D, seed 1000" in page.read_text()


def test_obstacles_can_be_placed_on_the_paths_of_skills_from_files(tmp_path, capsys):
    file = tmp_path / "short.json"
    reach = learned_skill("S1", 3)
    reach.save(file)
    out = tmp_path / "out"
    words = ["benchmark", "static", "--first", "1000", "--count", "1", "--methods", "acfra", "oracle", "--jobs", "1"]
    assert cli.main([*words, "--skill", str(file), "--out", str(out)]) == 0
    found = RESULTS.read_folders([out])
    assert len(found) == 4 * 2 * len(ANY_SKILL) / 2
    assert {r.experiment.skill for r in found} == {str(file)}
    capsys.readouterr()
    assert cli.main(["benchmark", "static", "compare", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "Skills from files" in printed and "short" in printed
    for more, said in ((["--families", "S4"], "choose from"), (["--teachers", "3"], "either --teachers or --skill")):
        assert cli.main([*words, "--skill", str(file), *more]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "--count"),
        (["--methods", "magic"], "unknown method"),
        (["--jobs", "0"], "--jobs"),
        (["--scheduler", "tcp://127.0.0.1:1"], "--backend dask"),
        (["compare", "nowhere"], "no such folder"),
        (["compare", ".", "--play", "S1"], "name this page with --report"),
        (["compare", ".", "--play", "S1", "--report", "page.html"], "write family, dimension and seed"),
        (["compare", "."], "no results"),
    ],
)
def test_what_is_wrong_is_said(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["benchmark", "static", *words]) == 2
    assert said in capsys.readouterr().err


def test_tuning_is_a_command(tmp_path, capsys):
    words = [
        "benchmark",
        "static",
        "tune",
        "--methods",
        "acfra",
        "--families",
        "S1",
        "--dimensions",
        "2",
        "--count",
        "1",
    ]
    assert cli.main([*words, "--draws", "1", "--out", str(tmp_path), "--jobs", "1"]) == 0
    assert "acfra: 100.0 % success" in capsys.readouterr().out
    assert cli.main([*words, "--draws", "1", "--out", str(tmp_path), "--jobs", "1", "--first", "2000"]) == 0
    assert "must not be tested" in capsys.readouterr().err


def test_lines_of_results_are_read_back_by_the_comparison(tmp_path):
    store = RESULTS.store(tmp_path)
    for r in (oracle(0), result("acfra", 0, "success")):
        store.save(r.experiment, r)
        assert RESULTS.line(store.save(r.experiment, r)) == RESULTS.line(r)
