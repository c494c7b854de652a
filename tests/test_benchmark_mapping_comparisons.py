from __future__ import annotations

import math

import numpy as np
import pytest

from imitarm.benchmark.experiment import LIVE, MAIN, Result
from imitarm.benchmark.mapping_comparisons import (
    CLAIMS,
    COMPARED,
    PRINTED_PATH,
    PRINTED_TIME,
    PRINTED_TORQUES,
    better_methods_table,
    claims_table,
    comparison_table,
    verdict,
)
from imitarm.benchmark.mapping_tables import (
    ACCURACY,
    EFFORT,
    SMOOTHNESS,
    Results,
)
from imitarm.evaluation.intervals import Comparison, Interval
from mapping_results import ME, live, replay, world


def test_where_a_baseline_is_better_it_is_said():
    results = [*world(0.0, -1.0), *(live("modern", p, 0, success=p > 3) for p in range(8))]
    results += [live("m3", p, 0) for p in range(8)]
    table = better_methods_table(Results(results), ["stacking"])
    assert {row[2] for row in table.rows if row[1].startswith("mean torque")} == {"M1", "M2", "M3"}
    ((measure, better, difference),) = [row[1:4] for row in table.rows if row[0] == LIVE]
    assert (measure, better) == ("stacked [%] ↑", "M3")
    assert difference.startswith("-50 (-")
    assert better_methods_table(Results(world(-1.0, 0.0)), ["stacking"]).rows == ()


def test_a_method_that_stacks_more_often_is_named_also_when_chance_could_do_it():
    results = [live("modern", p, r, success=p + r > 0) for p in range(8) for r in range(5)]
    results += [live("m3", p, r) for p in range(8) for r in range(5)]
    ((measure, better, difference),) = [row[1:4] for row in better_methods_table(Results(results), []).rows]
    assert (measure, better) == ("stacked [%] ↑", "M3")
    assert difference.startswith("-2 (")
    results = [live(method, p, 0, success=p > 0 or method == "m3") for method in ("modern", "m3") for p in range(2)]
    assert (
        better_methods_table(Results(results), []).rows[0][3].startswith("-50 (-100 to ")
    )  # rates are no farther apart


def one_measure(name, mine, theirs):
    """Results of eight persons that differ in one measure alone."""
    rng = np.random.default_rng(1)
    found = []
    for person in range(8):
        for method, value in (("modern", mine), ("m3", theirs)):
            result = replay(method, person, 1.0)
            found.append(Result(result.experiment, "0", {**result.values, name: value + rng.normal(0, 0.01)}, "", 1.0))
    return Results(found)


MEASURED = sorted({figure.name for figure in COMPARED} - {"limit_violations", "mean_torque"})


@pytest.mark.parametrize("name", MEASURED)
def test_in_every_measure_a_better_baseline_is_named_and_a_worse_one_is_not(name):
    more = name in {"engaged_fraction", "spectral_arc_length", "least_singular"}
    low, high = (-5.0, -4.0)
    better, worse = (high, low) if more else (low, high)
    named = better_methods_table(one_measure(name, worse, better), ["stacking"]).rows
    assert [row[1].removesuffix(" ↑") for row in named] == [f.title for f in COMPARED if f.name == name]
    assert named[0][1].endswith("↑") == more
    assert float(named[0][4]) * (1 if not more else -1) > 0  # the sign says it, too, whatever sign the numbers have
    assert better_methods_table(one_measure(name, better, worse), ["stacking"]).rows == ()


def test_nothing_that_the_tables_show_is_left_out_of_the_comparison():
    assert {f.name for f in (*ACCURACY, *EFFORT, *SMOOTHNESS)} <= {f.name for f in COMPARED}
    for name in ("engaged_fraction", "mean_torque", "rms_torque", "mean_motion_torque", "limit_violations"):
        assert name in {f.name for f in COMPARED}
    for figure in COMPARED:
        if figure.name in {"spectral_arc_length", "least_singular", "engaged_fraction"}:
            assert figure.more


def test_probabilities_are_corrected_within_a_measure_and_not_beyond():
    """Each of three baselines differs from modern with the least probability that eight persons can give."""
    results = [r for r in world(-1.0, 0.0) if r.experiment.method != "thesis"]
    least = pytest.approx(3 * 2 / 2**8, abs=1e-3)
    rows = comparison_table(Results(results), ["stacking"]).rows
    assert [float(row[5]) for row in rows if row[0] == "mean torque [N m]"] == [least] * 3
    alone = [r for r in results if r.experiment.method in {"modern", "m1"}]
    rows = comparison_table(Results(alone), ["stacking"]).rows
    assert [float(row[5]) for row in rows if row[0] == "mean torque [N m]"] == [pytest.approx(2 / 2**8, abs=1e-3)]


def held(results, claim, me):
    table = claims_table(Results(results), ["stacking"])
    (row,) = (row for row in table.rows if row[0].startswith(claim))
    return row[2 + 2 * ME.index(me)]


def test_a_claim_holds_only_when_the_data_say_so():
    assert held(world(-1.0, 0.0), "less torque", "modern") == "yes"
    assert held(world(1.0, 0.0), "less torque", "modern") == "no"
    assert held(world(0.0, 0.0), "less torque", "modern") == "not shown"
    assert held(world(-1.0, 0.0, persons=2), "less torque", "modern") == "not shown"  # two persons show nothing


def test_a_claim_against_all_baselines_falls_with_one_of_them():
    results = [r for r in world(-1.0, 0.0) if r.experiment.method != "m2"]
    assert held(results, "less torque", "thesis") == "yes"
    better = [replay("m2", person, 0.1) for person in range(8)]
    assert held([*results, *better], "less torque", "thesis") == "no"


def test_times_are_compared_only_where_both_succeeded():
    results = world(0.0, 0.0)
    for person in range(8):
        for repeat in range(3):
            results += [live(me, person, repeat, time=30.0 + person) for me in ME]
            for baseline in ("m1", "m2", "m3"):
                results.append(live(baseline, person, repeat, success=repeat > 0, time=35.0 + person + repeat))
    assert held(results, "shorter time", "modern") == "yes"
    assert held(world(0.0, 0.0), "shorter time", "modern") == "not run"
    nobody = [*world(0.0, 0.0), *(live(m, p, 0, success=m in ME) for m in MAIN for p in range(8))]
    assert held(nobody, "shorter time", "modern") == "not shown"  # no baseline to compare with


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
    """Means of the printed values; every row has seven torques."""
    assert PRINTED_TORQUES.shape == (10, 7)
    assert PRINTED_PATH.mean() == pytest.approx(8.53, abs=0.01)
    assert PRINTED_TIME.mean() == pytest.approx(15.1, abs=0.05)
    assert (PRINTED_TORQUES[:, 4].min(), PRINTED_TORQUES[:, 4].max()) == (10.23, 19.34)
    assert (PRINTED_TORQUES[:, 6].min(), PRINTED_TORQUES[:, 6].max()) == (20.35, 41.8)
    assert np.corrcoef(np.arange(10), PRINTED_TIME)[0, 1] < -0.8  # it falls from experiment to experiment


def test_every_claim_is_judged_by_the_data():
    """With nothing run there is nothing that held."""
    table = claims_table(Results([]), [])
    assert len(table.rows) == len(CLAIMS)
    assert {row[2] for row in table.rows} == {"not run"}
