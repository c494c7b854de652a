from __future__ import annotations

import math

import numpy as np
import pytest

from imitarm.benchmark import thesis_table
from imitarm.benchmark.mapping_methods import MAIN
from imitarm.benchmark.mapping_tables import (
    Results,
)
from imitarm.benchmark.thesis_table import PATH, TIME, TORQUES, claims_table, verdict
from imitarm.evaluation.intervals import Comparison, Interval
from mapping_results import ME, live, replay, world


def held(results, claim, me):
    table = claims_table(Results(results), ["stacking"])
    (row,) = (row for row in table.rows if row[0].startswith(claim))
    return row[2 + 2 * ME.index(me)]


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


def test_every_claim_is_judged_by_the_data():
    """With nothing run there is nothing that held."""
    table = claims_table(Results([]), [])
    assert len(table.rows) == len(thesis_table.CLAIMS)
    assert {row[2] for row in table.rows} == {"not run"}
