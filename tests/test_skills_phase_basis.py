from __future__ import annotations

import numpy as np
import pytest

from imitarm.skills.phase_basis import DECAY, PhaseBasis, on_grid, phase_basis


@pytest.mark.parametrize(("n", "until"), [(2, 3.0), (10, 3.0), (40, 3.0), (300, 1.0)])
def test_the_functions_sum_to_the_phase(n: int, until: float) -> None:
    s = np.exp(-DECAY * np.linspace(0.0, until, 200))
    np.testing.assert_allclose(phase_basis(n).at(s).sum(axis=1), s, rtol=1e-12)


def test_far_past_the_end_nothing_is_left() -> None:
    values = phase_basis(300).at(np.array([1e-9, 0.0]))
    assert np.isfinite(values).all()
    assert np.abs(values).max() < 1e-8


def test_centers_are_equally_spread_in_time() -> None:
    basis = PhaseBasis(11)
    np.testing.assert_allclose(-np.log(basis.centers) / DECAY, np.linspace(0.0, 1.0, 11), atol=1e-12)


def test_every_function_is_largest_at_its_own_center() -> None:
    basis = phase_basis(20)
    relative = basis.at(basis.centers) / basis.centers[:, None]
    np.testing.assert_array_equal(np.argmax(relative, axis=1), np.arange(20))


def test_the_grid_holds_begin_middle_and_end_of_steps() -> None:
    s, basis = on_grid(10, 4)
    assert s.shape == (9,)
    assert s[-1] == pytest.approx(0.01)
    np.testing.assert_allclose(basis, phase_basis(10).at(np.array(s)))
    assert not basis.flags.writeable
