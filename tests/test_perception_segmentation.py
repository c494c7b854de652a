"""Segmentation: planes are found, mixed pixels are removed, and points are grouped as their gaps say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.perception.segmentation import (
    best_cut,
    concavity,
    connected,
    depth_in_hull,
    fit_plane,
    mixed_pixels,
    voxel_means,
    voxels,
)


def test_a_mixed_pixel_is_between_its_neighbours_and_an_edge_or_a_thin_object_is_not():
    row = np.array([1.0, 1.0, 1.5, 2.0, 2.0, 1.0, 2.0, np.nan, 1.0, 1.02, 1.04])
    for depth in (np.tile(row, (3, 1)), np.tile(row, (3, 1))[:, ::-1]):
        found = mixed_pixels(depth)
        assert (found == (depth == 1.5)).all()
        assert (mixed_pixels(depth.T) == found.T).all()


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_clusters_are_those_of_a_direct_search(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 1.0, (60, 3))
    gaps = rng.uniform(0.05, 0.2, 60)
    owner = connected(points, gaps)
    near = np.linalg.norm(points[:, None] - points, axis=2) <= np.maximum(gaps[:, None], gaps)
    reach = np.linalg.matrix_power(near.astype(float), 60) > 0.0
    assert ((owner[:, None] == owner) == reach).all()


def test_voxels_average_what_is_in_them():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (500, 3))
    index, n = voxels(points, 0.25)
    means = voxel_means(points, index, n)
    assert index.min() == 0
    assert index.max() == n - 1
    for i in range(n):
        own = points[index == i]
        np.testing.assert_allclose(means[i], own.mean(axis=0), atol=1e-12)
        assert np.ptp(own, axis=0).max() <= 0.25


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_tilted_table_is_found_among_objects(seed):
    rng = np.random.default_rng(seed)
    normal = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    normal /= np.linalg.norm(normal)
    flat = rng.uniform(-0.5, 0.5, (600, 3))
    flat -= (flat @ normal)[:, None] * normal
    table = flat + rng.normal(0.0, 0.003, (600, 1)) * normal + [0.0, 0.0, 0.3]
    clutter = rng.uniform([-0.5, -0.5, 0.4], [0.5, 0.5, 0.8], (300, 3))
    found = fit_plane(np.concatenate([table, clutter]), normal=[0, 0, 1], seed=seed % 7)
    assert np.arccos(found.normal @ normal) < 0.02
    assert abs(found.signed_distance([0.0, 0.0, 0.3])) < 0.005


def test_no_plane_is_found_where_there_is_none():
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 3))
    assert fit_plane(points) is None
    assert fit_plane(points[:2]) is None
    wall = points * [0.0, 1.0, 1.0]
    assert fit_plane(wall, normal=[0, 0, 1]) is None
    assert abs(fit_plane(wall).normal[0]) > 0.999
    with pytest.raises(InputError, match="normal"):
        fit_plane(points, normal=[0, 0, 0])


def test_points_on_a_convex_surface_are_not_deep_and_two_touching_balls_are_cut_apart():
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(400, 3))
    ball *= 0.1 / np.linalg.norm(ball, axis=1)[:, None]
    assert depth_in_hull(ball).max() < 1e-9
    assert concavity(np.zeros((5, 3))) == 0.0
    assert (depth_in_hull(ball * [1.0, 1.0, 0.0]) == 0.0).all()
    both = np.concatenate([ball, ball + [0.0, 0.2, 0.0]])
    assert concavity(both) > 0.02
    assert concavity(both) == pytest.approx(np.quantile(depth_in_hull(both), 0.9), rel=1e-12)
    side, score = best_cut(both, np.array([3.0, 0.0, 0.0]))
    assert score < 0.2 * concavity(both)
    assert min(np.mean(side[:400] == side[0]), np.mean(side[400:] != side[0])) > 0.9
