from __future__ import annotations

import pytest

from imitarm.benchmark import retarget_rows, speed_rows, stacking
from imitarm.tasks.stack import FAILURES


@pytest.mark.slow
def test_a_trial_is_the_same_every_time_and_gives_its_row():
    first, second = (stacking.run_trial(("modern", 0, 0, 0.005)) for _ in range(2))
    assert (first.success, first.time, first.path_length) == (second.success, second.time, second.path_length)
    assert first.success or first.failure in FAILURES
    row = stacking.summary("modern", [first, second])
    assert row[1] == f"{2 * first.success} of 2"


def test_what_is_no_benchmark_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        stacking.main(["--people", "0"])
    assert stop.value.code == 2
    with pytest.raises(SystemExit):
        stacking.main(["--methods", "magic"])
    assert "modern" in capsys.readouterr().err


def test_the_step_that_is_timed_follows_the_person():
    row = retarget_rows.skeleton_to_command()
    assert row.ours().shape == (7,)
    good, note = row.check()
    assert good, note
    assert set(retarget_rows.ROWS) <= set(speed_rows.ROWS)
