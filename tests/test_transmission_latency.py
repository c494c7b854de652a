from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError, UnknownNameError
from imitarm.files.table import read_table
from imitarm.transmission.latency import STAGES, LatencyLog


def filled(n=5000):
    log, rng = LatencyLog(), np.random.default_rng(0)
    values = rng.exponential(0.002, n)
    for value in values:
        log.record(log.add(), wait=value)
    return log, values


def test_percentiles_are_those_of_what_was_noted():
    log, values = filled()
    log.record(7, total=0.5)
    (stage, n, *figures), (last, one, *alike) = log.statistics()
    assert (stage, n, last, one) == ("wait", 5000, "total", 1)
    np.testing.assert_allclose(figures, [*np.percentile(values, (50, 95, 99)), values.max()])
    assert alike == [0.5] * 4
    assert len(log) == 5000


def test_nothing_noted_is_no_row():
    log = LatencyLog()
    log.add()
    assert log.statistics() == [] and np.isnan(log.values).all()


def test_a_stage_that_does_not_exist_is_an_error():
    with pytest.raises(UnknownNameError, match="unknown stage 'lunch'"):
        LatencyLog().record(0, lunch=1.0)


def test_it_is_saved_frame_by_frame(tmp_path):
    log, values = filled(10)
    log.save(tmp_path / "latency.csv")
    table = read_table(tmp_path / "latency.csv")
    assert table.names == ("frame", *STAGES) and table.remarks["units"] == "s"
    np.testing.assert_array_equal(table.values[:, 0], np.arange(10))
    np.testing.assert_array_equal(table.values[:, 1 + list(STAGES).index("wait")], values)
    with pytest.raises(InputError, match="can't be written"):
        log.save(tmp_path / "no" / "latency.csv")
