from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark import speed_rows, transmission_rows
from imitarm.benchmark.transmission_rows import complete
from imitarm.transmission.latency import LatencyLog


def test_only_skeletons_whose_whole_way_is_known_count():
    log = LatencyLog()
    stages = dict.fromkeys(("expose", "arrive", "wait", "retarget", "send", "robot"), 0.001)
    log.note(log.begin(), **stages, apply=5.0, total=9.0)
    log.note(log.begin(), **{name: value for name, value in stages.items() if name != "robot"})
    log.note(log.begin(), **(stages | {"wait": 0.004}))
    np.testing.assert_allclose(complete(log), [0.006, 0.009])


def test_the_row_is_run_and_fails_when_it_is_slow_or_hardly_led(monkeypatch):
    assert set(transmission_rows.ROWS) <= set(speed_rows.ROWS)
    ways = [np.linspace(0.0, 0.01, 500), np.full(3, 0.001)]
    monkeypatch.setattr(transmission_rows, "three_processes", lambda: (ways.pop(0), 0.9))
    row = transmission_rows.capture_to_command()
    assert row.ours() == pytest.approx(0.0099) and row.most_seconds == 5e-3
    good, note = row.check()
    assert good and "median 5 ms of 500" in note and "90 %" in note
    row.ours()  # too few came through
    assert not row.check()[0]
