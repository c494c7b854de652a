from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills import GMR, GaussianMixture
from imitarm.skills.selection import Candidate, choose, try_numbers_of_components
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
MIN_STD = np.array([0.0, 1e-4, 1e-4, 1e-4])


def tables(seed: int = 0, n: int = 6, spread: float = 0.01) -> list[Array]:
    """A polyline of four straight pieces, shown n times."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 4.0, 100)
    corners = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.1], [0.3, 0.3, 0.0], [0.0, 0.3, 0.1], [-0.2, 0.0, 0.3]])
    x = np.column_stack([np.interp(t, np.arange(5.0), c) for c in corners.T])
    return [
        np.column_stack([t, x + spread * rng.standard_normal(3) + 1e-3 * rng.standard_normal(x.shape)])
        for _ in range(n)
    ]


def row(k: int, held_out: float, bias: float, bic: float = 0.0) -> Candidate:
    return Candidate(k, bic, bic, held_out, bias)


def test_the_smallest_number_that_generalises_and_rounds_off_little() -> None:
    rows = [row(2, 40.0, 20.0), row(3, 30.4, 5.0), row(4, 30.3, 2.9), row(5, 30.0, 2.0), row(6, 33.0, 1.0)]
    assert choose(rows) == 4
    assert choose(rows[::-1]) == 4


def test_without_a_good_one_the_least_held_out_error() -> None:
    assert choose([row(2, 40.0, 20.0), row(3, 30.0, 9.0), row(4, 31.0, 1.0)]) == 3


def test_below_the_repeatability_of_arms_errors_do_not_count() -> None:
    assert choose([row(2, 0.09, 0.05), row(3, 0.02, 0.01)]) == 2


def test_bic_decides_for_one_demonstration() -> None:
    assert choose([row(2, np.nan, 3.0, -10.0), row(3, np.nan, 2.0, -30.0), row(4, np.nan, 1.0, -20.0)]) == 3


def test_four_pieces_need_four_components() -> None:
    assert choose(try_numbers_of_components(tables(spread=0.03), range(1, 11), MIN_STD, 1e-6)) == 4


def test_held_out_error_is_that_of_learning_without_each() -> None:
    demonstrations = tables()
    (evaluated,) = try_numbers_of_components(demonstrations, [4], MIN_STD, 1e-6)
    squares = []
    for i, left_out in enumerate(demonstrations):
        rest = [Trajectory(d[:, 0], d[:, 1:]) for j, d in enumerate(demonstrations) if j != i]
        squares.append(np.sum((GMR(4).fit(rest).predict(left_out[:, 0])[0] - left_out[:, 1:]) ** 2, axis=1))
    assert evaluated.held_out_rmse_mm == pytest.approx(1e3 * np.sqrt(np.mean(squares)), rel=0.02)


def test_criteria_are_those_of_the_mixture() -> None:
    demonstrations = tables()
    (evaluated,) = try_numbers_of_components(demonstrations, [4], MIN_STD, 1e-6)
    X = np.concatenate(demonstrations)
    mixture = GaussianMixture(4, tol=1e-3).fit(X)
    assert evaluated.bic == pytest.approx(mixture.bic(X), rel=2e-3)
    assert evaluated.aic - evaluated.bic == pytest.approx(mixture.aic(X) - mixture.bic(X), rel=1e-9)


def test_a_still_axis_is_left_out_but_counts_in_the_error() -> None:
    flat = tables()
    for i, table in enumerate(flat):
        table[:, 3] = 0.2 + 1e-5 * i
    (evaluated,) = try_numbers_of_components(flat, [4], MIN_STD, 1e-6)
    assert np.isfinite([evaluated.bic, evaluated.held_out_rmse_mm]).all()


def test_large_numbers_are_not_tried_in_vain() -> None:
    evaluated = try_numbers_of_components(tables(spread=0.03), range(1, 41), MIN_STD, 1e-6)
    assert len(evaluated) == 8  # 4, and four more that are no better


def test_numbers_beyond_the_samples_are_skipped_or_refused() -> None:
    few = [table[::20] for table in tables(n=3)]  # 5 samples each
    evaluated = try_numbers_of_components(few, [2, 4, 90], MIN_STD, 1e-6)
    assert [c.n_components for c in evaluated] == [2, 4]
    with pytest.raises(InputError, match="too few"):
        try_numbers_of_components(few, [90], MIN_STD, 1e-6)
