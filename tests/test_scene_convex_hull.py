"""ConvexHull against the shapes it can imitate and against coal."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, ConvexHull
from scene_shapes import coal_distances, random_pose

CORNERS = np.array(list(itertools.product([-0.5, 0.5], repeat=3)))


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_hull_of_eight_corners_is_the_box(seed):
    rng = np.random.default_rng(seed)
    pose, size = random_pose(rng), rng.uniform(0.01, 0.5, 3)
    box, hull = Box(pose, size), ConvexHull(pose.apply(CORNERS * size))
    points = pose.position + rng.normal(size=(300, 3)) * 0.3
    distance, gradient = box.distance_and_gradient(points)
    hull_distance, hull_gradient = hull.distance_and_gradient(points)
    np.testing.assert_allclose(hull_distance, distance, atol=1e-12)
    assert np.sum(np.abs(hull_gradient - gradient).max(axis=1) < 1e-9) >= 299


def test_faces_edges_and_corners_are_merged():
    # a cube with extra points on its faces, on its edges and inside is still 6 faces and 12 edges
    rng = np.random.default_rng(0)
    on_faces = np.vstack(
        [np.insert(rng.uniform(-0.5, 0.5, (5, 2)), i, s, axis=1) for i in range(3) for s in (-0.5, 0.5)]
    )
    on_edges = [[0.5, 0.5, 0.1], [-0.5, 0.2, 0.5]]
    hull = ConvexHull(np.vstack([CORNERS, on_faces, on_edges, rng.uniform(-0.4, 0.4, (20, 3))]))
    assert len(hull._polytope.normals) == 6
    points = rng.normal(size=(400, 3))
    expected = Box(Pose.identity(), [1, 1, 1]).signed_distance(points)
    np.testing.assert_allclose(hull.signed_distance(points), expected, atol=1e-12)
    cube = ConvexHull(CORNERS)
    assert cube._polytope.lengths.shape == (12,)
    assert cube.vertices.shape == (8, 3)


def test_triangles_close_the_surface_and_face_outwards():
    rng = np.random.default_rng(1)
    hull = ConvexHull(rng.normal(size=(40, 3)) + 3.0)
    a, b, c = np.moveaxis(hull.vertices[hull.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    assert np.all(np.sum(normals * (a - hull.vertices.mean(axis=0)), axis=1) > 0)
    directed = {(int(t[i]), int(t[(i + 1) % 3])) for t in hull.triangles for i in range(3)}
    assert len(directed) == 3 * len(hull.triangles)
    assert all((q, p) in directed for p, q in directed)  # each edge once each way
    for vertex in hull.vertices:
        assert np.abs(np.asarray(hull.points) - vertex).max(axis=1).min() < 1e-12


def test_many_points_at_once_equal_few():
    rng = np.random.default_rng(2)
    hull = ConvexHull(rng.normal(size=(30, 3)) * 0.1)
    points = rng.normal(size=(1500, 3)) * 0.2  # more than one block
    distance, gradient = hull.distance_and_gradient(points)
    for part in (slice(0, 7), slice(500, 530), slice(1490, None)):
        d, g = hull.distance_and_gradient(points[part])
        np.testing.assert_allclose(d, distance[part], atol=1e-14)
        np.testing.assert_allclose(g, gradient[part], atol=1e-9)


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-7, 1e-9])
def test_distances_near_edges_and_corners_keep_their_digits(gap):
    rng = np.random.default_rng(3)
    hull = ConvexHull(rng.normal(size=(60, 3)) * 0.2)
    normals = hull._polytope.normals
    for triangle in hull.triangles[:40]:
        edge = hull.vertices[triangle[:2]]
        heights = normals @ edge.T - np.sum(normals * hull.support(normals), axis=1)[:, None]
        owners = normals[np.abs(heights).max(axis=1) < 1e-12]
        assert len(owners) == 2
        outward = owners[0] + owners[1]  # between both faces: the edge is nearest
        outward /= np.linalg.norm(outward)
        points = edge.mean(axis=0) + gap * outward
        assert float(hull.signed_distance(points)) == pytest.approx(gap, abs=1e-11)


def test_inside_it_agrees_with_coal():
    rng = np.random.default_rng(4)
    for _ in range(10):
        hull = ConvexHull(rng.normal(size=(12, 3)) * 0.2)
        points = rng.dirichlet(np.ones(len(hull.points)), 20) @ hull.points
        np.testing.assert_allclose(hull.signed_distance(points), coal_distances(hull, points), atol=1e-9)


def test_qhull_is_imported_only_when_a_hull_is_built():
    code = "import sys, imitarm.scene; sys.exit('scipy.spatial' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
