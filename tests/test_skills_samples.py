from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.skills.samples import UnalignedWarning, samples_of
from imitarm.trajectory import Trajectory
from skill_samples import shown


def test_times_are_counted_from_each_first_sample() -> None:
    tables, reference, duration = samples_of(shown(n=3, turn=None))  # they start at 0, 100 and 200 s
    assert reference is None
    assert duration == pytest.approx(2.0)
    for table in tables:
        assert table.shape == (120, 4)
        assert table[0, 0] == 0.0
        assert table[-1, 0] == pytest.approx(2.0)


def test_rotations_become_vectors_near_one_reference() -> None:
    demonstrations = shown(n=2, turn=1.0)
    tables, reference, _ = samples_of(demonstrations)
    assert reference is not None
    assert [table.shape for table in tables] == [(120, 7)] * 2
    q = demonstrations[1].trajectory.quaternions
    assert q is not None
    back = reference.to_quaternions(tables[1][:, 0], tables[1][:, 4:])
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-12)


def test_durations_are_scaled_to_their_median_with_a_warning() -> None:
    a, b, c = (d.trajectory for d in shown(n=3, turn=None))
    slow = Trajectory(2.0 * b.times, b.positions)
    with pytest.warns(UnalignedWarning, match=r"from 2 to 4 s.*Align them first"):
        tables, _, duration = samples_of([a, slow, c])
    assert duration == pytest.approx(2.0)
    np.testing.assert_allclose(tables[1][:, 0], tables[0][:, 0], atol=1e-6)


def test_what_cannot_be_learnt_from_is_named() -> None:
    with pytest.raises(InputError, match="no demonstrations"):
        samples_of([])
    with pytest.raises(InputError, match="give a list"):
        samples_of(shown(n=1)[0])  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"demonstrations \[1\] have no quaternions"):
        samples_of([shown(n=1)[0], shown(n=1, turn=None)[0]])
    with pytest.raises(InputError, match="demonstration 1 is a str"):
        samples_of([shown(n=1)[0], "sweep.csv"])  # type: ignore[list-item]
