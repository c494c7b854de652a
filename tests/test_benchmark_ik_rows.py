from __future__ import annotations

import pytest

from imitarm.benchmark import ik_rows, speed_rows


@pytest.mark.parametrize("row", [ik_rows.damped_step, ik_rows.quadratic_step, ik_rows.self_clearance_rows])
def test_a_step_does_what_it_is_timed_for(row):
    made = row()
    assert made.most_seconds < 1e-3
    assert made.ours() is not None
    good, note = made.check()
    assert good and note


def test_the_peer_is_asked_for_the_same_motion():
    row = ik_rows.steps_against_mink()
    assert row.peer_name.startswith("mink ")
    assert row.ours().shape == (7,) and row.peer().shape == (9,)  # theirs moves the fingers too
    good, note = row.check()
    assert good, note


def test_all_rows_are_run():
    assert set(ik_rows.ROWS) <= set(speed_rows.ROWS)
