from __future__ import annotations

import math

from imitarm.benchmark.experiment import Experiment, Result, count_failures
from imitarm.benchmark.mapping import tables
from imitarm.benchmark.mapping_report import mapping_report_html
from imitarm.benchmark.mapping_tables import (
    TEST,
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
from imitarm.evaluation.intervals import Interval
from mapping_results import captured, live, replay


def test_no_average_over_failures_without_the_successes_beside_it():
    results = [live("modern", p, r, success=p > 0, time=40.0 if p else 999.0) for p in range(4) for r in range(2)]
    (row,) = success_table(Results(results)).rows
    assert row[1] == "6 of 8"
    assert row[3].startswith("40")  # the failures' 999 s are not in it
    assert row[-1] == "dropped: 2"
    assert count_failures(["", "dropped", "tower fell", "dropped", ""]) == "dropped: 2, tower fell: 1"
    assert count_failures(["", ""]) == "none"
    assert written(Interval(0.0412, 0.04, 0.05, 3, 5, 8), Figure("x", "", 1e3)) == "41.2 (40.0 to 50.0), 5 of 8"
    assert written(Interval(math.nan, math.nan, math.nan, 0, 0, 8), Figure("x", "")) == "– (0 of 8)"


def test_the_captured_arm_is_one_person_and_has_no_interval():
    results = [captured(m, camera, lag) for m in ("modern", "m3") for camera, lag in ((0, 0.044), (1, 0.075))]
    table = accuracy_table(Results(results), CAPTURED)
    lag = table.columns.index("lag [ms]>")
    assert [row[lag] for row in table.rows] == ["60 (44 … 75)"] * 2
    assert not any(" to " in cell for row in table.rows for cell in row)
    assert "the motion of one person" in table.note
    ((kind, n, who, *facts),) = recordings_table(Results(results)).rows
    assert (kind, n, who, facts[0]) == (CAPTURED, "2", "1 person, 2 cameras", "43.0 (43.0 … 43.0)")
    titles = [t.title for t in tables(Results(results))]
    assert not any(title.startswith(("Paired", "Where another", "Claims of the thesis")) for title in titles)
    other = [captured("modern", 0, 0.04, seed=0), captured("modern", 1, 0.04, seed=1)]
    assert {person for person, _ in Results(other).values("modern", [CAPTURED], "lag")} == {-1}
    assert written_each({(-1, 0): 1.0, (-1, 1): math.nan}, Figure("x", "")) == "1.0, 1 of 2"
    assert written_each({(-1, 0): math.nan}, Figure("x", "")) == "– (0 of 1)"


def test_a_rates_interval_is_over_persons_and_honest_where_all_are_alike():
    alike = [live("modern", p, r) for p in range(10) for r in range(5)]
    ((_, rate, within, *_),) = success_table(Results(alike)).rows
    assert (rate, within) == ("50 of 50", "86 to 100")  # Wilson's of 50 of 50 has 93
    all_but_one = [live("modern", p, r, success=p + r > 0) for p in range(10) for r in range(5)]
    ((_, rate, within, *_),) = success_table(Results(all_but_one)).rows
    assert (rate, within) == ("49 of 50", "86 to 100")
    halves = [live("modern", p, r, success=p < 5) for p in range(10) for r in range(5)]
    ((_, rate, within, *_),) = success_table(Results(halves)).rows
    low, high = (float(word) for word in within.split(" to "))
    assert rate == "25 of 50"
    assert low <= 25.0 < 75.0 <= high  # as five of ten, not as 25 of 50, which Wilson has at 37 to 63


def test_a_recording_that_cant_be_made_is_missing_and_said():
    results = [replay(m, p, 1.0) for m in ("modern", "m3") for p in range(TEST, TEST + 3)]
    results = [Result(r.experiment, "0", {**r.values, "recorded": 12.0, "beyond_reach": 0.0}, "", 1.0) for r in results]
    results += [
        Result(
            Experiment("stacking", m, seed=TEST + 3),
            "0",
            {},
            "TaskFailedError: the recording could not be made: no",
            1.0,
        )
        for m in ("modern", "m3")
    ]
    table = recordings_table(Results(results))
    assert table.rows[0][:4] == ("stacking", "3 of 4", "4 simulated", "12.0 (12.0 to 12.0)")
    found = tables(Results(results))
    assert all(len(row) == len(t.columns) for t in found for row in t.rows)
    (limits,) = (t for t in found if t.title.startswith("Limit violations"))
    assert {row[1] for row in limits.rows} == {"3 of 3"}  # nothing that the methods did
    page = mapping_report_html(Results(results[-2:]), [], provenance={}, folder=None)
    assert "modern was not run" in page
    lost = Result(Experiment("stacking", "modern", seed=TEST), "0", {}, "TaskFailedError: it gave up", 1.0)
    assert limits_table(Results([lost]), ["stacking"]).rows[0][1] == "0 of 1"  # what it did
    assert recordings_table(Results([lost])).rows[0][1] == "1"


def test_it_is_said_which_persons_they_were():
    judged = [replay("modern", p, 1.0) for p in (TEST, TEST + 1)]
    assert recordings_table(Results(judged)).note.endswith("Persons 200 to 201.")
    seen = [live("modern", 0, 0)]
    assert success_table(Results(seen)).note.endswith(
        "Persons with numbers below 200 were used for developing the methods."
    )
