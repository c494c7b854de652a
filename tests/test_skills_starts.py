from __future__ import annotations

import itertools

import numpy as np
import pytest

from imitarm.skills import starts
from imitarm.skills.em import quadratic_features


def test_segments_are_hard_and_in_order() -> None:
    t = np.linspace(0.0, 1.0, 400)
    Z = np.column_stack([t, np.sin(6.0 * t)])
    (cut,) = starts.responsibilities_by_segments(quadratic_features(Z), t, [5])
    assert set(np.unique(cut)) == {0.0, 1.0}
    np.testing.assert_array_equal(cut.sum(axis=0), 1.0)
    assert np.all(np.diff(np.argmax(cut, axis=0)) >= 0)


def test_segments_find_the_corners_of_a_polyline() -> None:
    rng = np.random.default_rng(0)
    t = np.tile(np.linspace(0.0, 1.0, 401), 3)
    x = np.interp(t, [0.0, 0.2, 0.75, 1.0], [0.0, 1.0, -1.0, 0.5]) + 0.01 * rng.standard_normal(len(t))
    Z = np.column_stack([t - 0.5, x])
    (cut,) = starts.responsibilities_by_segments(quadratic_features(Z), t, [3])
    labels = np.argmax(cut, axis=0)
    corners = [t[labels == k].min() for k in (1, 2)]
    np.testing.assert_allclose(corners, [0.2, 0.75], atol=1.1 / 40)  # one slot


def test_dynamic_programming_equals_trying_all_cuts() -> None:
    rng = np.random.default_rng(1)
    t = np.repeat(np.arange(40), 10) + 0.5
    Z = np.column_stack([(t - 20.0) / 11.5, rng.standard_normal(len(t)).cumsum() / 10.0])
    features = quadratic_features(Z)
    (cut,) = starts.responsibilities_by_segments(features, t, [3])

    def cost(labels: np.ndarray) -> float:
        sums = np.stack([features[:, labels == k].sum(axis=1) for k in range(3)])
        return float(starts._segment_costs(sums, len(t)).sum())

    slot = np.repeat(np.arange(40), 10)
    least = min(cost(np.searchsorted([a, b], slot, side="right")) for a, b in itertools.combinations(range(1, 40), 2))
    assert cost(np.argmax(cut, axis=0)) == pytest.approx(least, rel=1e-9)


def test_several_numbers_at_once_equal_each_alone() -> None:
    t = np.linspace(0.0, 1.0, 500)
    features = quadratic_features(np.column_stack([t, np.cos(9.0 * t)]))
    together = starts.responsibilities_by_segments(features, t, [1, 4, 10])
    for k, cut in zip((1, 4, 10), together, strict=True):
        np.testing.assert_array_equal(cut, starts.responsibilities_by_segments(features, t, [k])[0])
        assert cut.shape == (k, 500)


def test_few_samples_fall_back_to_bins_of_equal_number() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 5.0, 9.0])
    features = quadratic_features(np.column_stack([t, t**2]))
    (cut,) = starts.responsibilities_by_segments(features, t, [3])
    np.testing.assert_array_equal(cut.sum(axis=1), 2.0)


def test_seeds_reach_every_far_cluster() -> None:
    rng = np.random.default_rng(2)
    centers = np.array([[0.0, 0.0], [20.0, 0.0], [0.0, 20.0], [20.0, 20.0]])
    Z = np.concatenate([c + 0.1 * rng.standard_normal((30, 2)) for c in centers])
    labels = np.argmax(starts.responsibilities_by_seeds(Z, 4, rng), axis=0).reshape(4, 30)
    assert np.all(labels == labels[:, :1])
    assert len(set(labels[:, 0])) == 4


def test_seeds_of_equal_samples_do_not_divide_by_zero() -> None:
    cut = starts.responsibilities_by_seeds(np.zeros((5, 2)), 3, np.random.default_rng(0))
    assert np.isfinite(cut).all()
