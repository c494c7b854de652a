from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.experiment import LIVE, Result
from imitarm.benchmark.mapping_pairs import COMPARED, comparison_table, rivals_table
from imitarm.benchmark.mapping_tables import (
    ACCURACY,
    EFFORT,
    SMOOTHNESS,
    Results,
)
from mapping_results import live, replay, world


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
    more = name in {"engaged_fraction", "spectral_arc_length", "least_singular"}
    low, high = (-5.0, -4.0)
    better, worse = (high, low) if more else (low, high)
    named = rivals_table(one_measure(name, worse, better), ["stacking"]).rows
    assert [row[1].removesuffix(" ↑") for row in named] == [f.title for f in COMPARED if f.name == name]
    assert named[0][1].endswith("↑") == more
    assert float(named[0][4]) * (1 if not more else -1) > 0  # the sign says it, too, whatever sign the numbers have
    assert rivals_table(one_measure(name, better, worse), ["stacking"]).rows == ()


def test_nothing_that_the_tables_show_is_left_out_of_the_comparison():
    assert {f.name for f in (*ACCURACY, *EFFORT, *SMOOTHNESS)} <= {f.name for f in COMPARED}
    for name in ("engaged_fraction", "mean_torque", "rms_torque", "mean_motion_torque", "broken_limits"):
        assert name in {f.name for f in COMPARED}
    for figure in COMPARED:
        if figure.name in {"spectral_arc_length", "least_singular", "engaged_fraction"}:
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
