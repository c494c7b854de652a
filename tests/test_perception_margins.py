"""CoverageMargin: the promised share of whole windows stays within the margin."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.perception import CoverageMargin

TIMES = np.linspace(0.0, 1.0, 6)


def windows(rng, n):
    """Errors of predictions whose position and velocity are both uncertain."""
    position, velocity = rng.normal(0.0, 0.005, (n, 1, 3)), rng.normal(0.0, 0.1, (n, 1, 3))
    return np.linalg.norm(position + TIMES[:, None] * velocity, axis=2)


def test_margins_grow_linearly():
    margin = CoverageMargin(0.01, 0.2)
    np.testing.assert_allclose(margin.at([0.0, 0.5, 1.0]), [0.01, 0.11, 0.21])
    assert margin.at(0.5).shape == ()
    assert margin.at(-1.0) == 0.01
    zero = CoverageMargin.none()
    assert zero.is_zero
    assert not margin.is_zero
    np.testing.assert_array_equal(zero.at(TIMES), np.zeros(len(TIMES)))


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), coverage=st.sampled_from([0.8, 0.9, 0.95]))
def test_new_windows_are_covered(seed, coverage):
    rng = np.random.default_rng(seed)
    margin = CoverageMargin.calibrate(windows(rng, 4000), coverage, times=TIMES)
    covered = margin.covered(windows(rng, 4000), TIMES).mean()
    assert abs(covered - coverage) < 0.035


def test_the_rank_is_that_of_split_conformal_prediction():
    errors = np.arange(1.0, 20.0)[:, None]  # 19 scores: (19 + 1) 0.95 = 19
    margin = CoverageMargin.calibrate(errors, 0.95, times=[0.0], shape=(1.0, 0.0))
    assert margin.offset == 19.0
    with pytest.raises(InputError, match="at least 19"):
        CoverageMargin.calibrate(errors[1:], 0.95, times=[0.0], shape=(1.0, 0.0))


def test_alpha_is_divided_over_the_obstacles():
    rng = np.random.default_rng(3)
    errors = windows(rng, 8000)
    one, five = (CoverageMargin.calibrate(errors, 0.95, n, times=TIMES) for n in (1, 5))
    assert five.at(0.5) > one.at(0.5)
    together = windows(rng, 5 * 2000).reshape(2000, 5, len(TIMES))
    every = (together <= five.at(TIMES)).all(axis=(1, 2)).mean()
    assert every > 0.94


def test_invalid_windows_are_refused():
    good = np.ones((100, 6))
    for wrong, message in (
        (lambda: CoverageMargin(-1.0), "offset"),
        (lambda: CoverageMargin(0.0, np.nan), "growth"),
        (lambda: CoverageMargin.calibrate(good, 1.0, times=TIMES), "coverage"),
        (lambda: CoverageMargin.calibrate(good, 0.9, 0, times=TIMES), "n_obstacles"),
        (lambda: CoverageMargin.calibrate(good, times=TIMES[:-1]), "windows"),
        (lambda: CoverageMargin.calibrate(-good, times=TIMES), "negative"),
        (lambda: CoverageMargin.calibrate(good, times=-TIMES), "times"),
        (lambda: CoverageMargin.calibrate(np.full((100, 6), np.nan), times=TIMES), "windows"),
        (lambda: CoverageMargin.calibrate(good, times=TIMES, shape=(0.0, 1.0)), "positive"),
        (lambda: CoverageMargin(0.1).at("now"), "tau"),
    ):
        with pytest.raises(InputError, match=message):
            wrong()
