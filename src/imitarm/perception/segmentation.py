"""Segmentation: decide which measured points form one object."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull as Qhull
from scipy.spatial import QhullError, cKDTree

from imitarm.errors import InputError
from imitarm.scene import HalfSpace
from imitarm.validation import finite_array, finite_number, finite_vector, whole_number

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_SEARCHED = 100  # points with which the best cut of a cluster is searched
_CUTS = (0.2, 0.35, 0.5, 0.65, 0.8)  # quantiles at which cuts are tried
_TRIALS = 200  # planes that fit_plane tries


def mixed_pixels(depth: Array, jump: float = 0.04) -> Mask:
    """Return whether each pixel measured a mixture of two surfaces, so that no surface is at the measured depth.

    At the edge of an object, part of the light of a pixel comes from the object and part from the background. The depth
    of such a pixel lies between the depths of its two neighbours in a row or column, and differs from each by more than
    ``jump``.

    Args:
        depth: depth image, shape (height, width) [m]; nan where nothing was measured.
        jump: smallest difference of a mixed pixel's depth from the depth of each of the two neighbours [m].
    """
    mixed = np.zeros(depth.shape, dtype=bool)
    for values, result in ((depth, mixed), (depth.T, mixed.T)):
        steps = np.diff(values, axis=1)
        up, down = steps > jump, steps < -jump
        result[:, 1:-1] |= (up[:, :-1] & up[:, 1:]) | (down[:, :-1] & down[:, 1:])
    return mixed


def fit_plane(
    points: ArrayLike,
    *,
    normal: ArrayLike | None = None,
    tolerance: float = 0.015,
    max_tilt: float = 0.26,
    least_fraction: float = 0.15,
    seed: int = 0,
) -> HalfSpace | None:
    """Find the largest plane among points by RANSAC, for example a table whose height is unknown.

    RANSAC tries planes through three random points, and selects the plane with the most points within ``tolerance``.
    This plane is then fitted to these points by least squares.

    Args:
        points: measured points, shape (n, 3) [m].
        normal: expected normal of the plane, shape (3,), for example straight up; None: any plane, with a normal whose
            z is positive.
        tolerance: largest distance of a point that belongs to the plane [m].
        max_tilt: largest angle between the plane's normal and ``normal`` [rad].
        least_fraction: smallest fraction of all points that must belong to the plane.
        seed: seed of the random number generator.

    Returns:
        The half-space below the plane; None if no plane contains enough of the points.

    Raises:
        InputError: when an argument can't be used.
    """
    points = finite_array(points, (None, 3), "fit_plane: points", "m")
    tolerance = finite_number(tolerance, "fit_plane: tolerance", "m", above=0.0)
    expected = None if normal is None else finite_vector(normal, 3, "fit_plane: normal")
    if expected is not None and not np.linalg.norm(expected) > 0.0:
        raise InputError("fit_plane: normal must not be zero")
    if len(points) < 3:
        return None
    rng = np.random.default_rng(whole_number(seed, "fit_plane: seed", at_least=0))
    a, b, c = np.moveaxis(points[rng.integers(0, len(points), (_TRIALS, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 1e-9
    normals, anchors = normals[good] / lengths[good, None], a[good]
    if expected is not None:
        aligned = np.abs(normals @ (expected / np.linalg.norm(expected))) >= np.cos(max_tilt)
        normals, anchors = normals[aligned], anchors[aligned]
    if not len(normals):
        return None
    sample = points[rng.permutation(len(points))[:2000]]
    counts = (np.abs(sample @ normals.T - (normals * anchors).sum(axis=1)) < tolerance).sum(axis=0)
    best = int(counts.argmax())
    if counts[best] < least_fraction * len(sample):
        return None
    inliers = points[np.abs((points - anchors[best]) @ normals[best]) < tolerance]
    center = inliers.mean(axis=0)
    fitted = np.linalg.svd(inliers - center, full_matrices=False)[2][2]
    up = np.array([0.0, 0.0, 1.0]) if expected is None else expected
    return HalfSpace(center, fitted if fitted @ up >= 0.0 else -fitted, name="plane")


def voxels(points: Array, size: float) -> tuple[Indices, int]:
    """Return the voxel of each point (n,), numbered from 0, and the number of voxels that contain points.

    Args:
        points: measured points, shape (n, 3) [m].
        size: edge length of a voxel [m].
    """
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    counts = cells.max(axis=0) + 1
    keys = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
    unique, index = np.unique(keys, return_inverse=True)
    return index.reshape(-1), len(unique)


def voxel_means(values: Array, index: Indices, n: int) -> Array:
    """Return the mean of the rows of ``values`` (k, m) in each of ``n`` voxels, shape (n, m)."""
    counts = np.bincount(index, minlength=n)
    return np.stack([np.bincount(index, column, n) for column in values.T], axis=1) / counts[:, None]


def connected(points: Array, gaps: Array) -> Indices:
    """Divide points into clusters; return the index of each point's cluster, counted from 0, shape (n,).

    Two points are neighbours if their distance is at most the larger of their two gaps. A cluster contains all points
    that can be reached from each other through neighbours.

    Args:
        points: measured points, shape (n, 3) [m].
        gaps: gap of each point, shape (n,) [m].
    """
    n = len(points)
    if n == 0:
        return np.zeros(0, dtype=np.intp)
    pairs = cKDTree(points).query_pairs(float(gaps.max()), output_type="ndarray")
    if gaps.min() < gaps.max():
        between = points[pairs[:, 0]] - points[pairs[:, 1]]
        allowed = np.maximum(gaps[pairs[:, 0]], gaps[pairs[:, 1]])
        pairs = pairs[(between * between).sum(axis=1) <= allowed * allowed]
    graph = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def depth_in_hull(points: Array) -> Array:
    """Return how deep each point is inside the convex hull of all points, shape (n,) [m].

    The visible points of a convex object are on the object's surface, so none of them is deep inside the hull. If there
    are points deep inside the hull, the object is therefore concave, or there are two objects that touch.
    """
    try:
        equations = Qhull(points).equations
    except QhullError:  # points in one plane
        return np.zeros(len(points))
    return -(points @ equations[:, :3].T + equations[:, 3]).max(axis=1)


def concavity(points: Array) -> float:
    """Return the 90th percentile of :func:`depth_in_hull` [m]; 0 for fewer than 8 points or points in a plane."""
    if len(points) < 8:
        return 0.0
    place = 0.9 * (len(points) - 1)
    low = int(place)
    parts = np.partition(depth_in_hull(points), (low, low + 1))  # half of the time of np.quantile
    return float(parts[low] + (place - low) * (parts[low + 1] - parts[low]))


def best_cut(points: Array, origin: Array) -> tuple[Mask, float]:
    """Find the plane that cuts a cluster into the two most convex parts.

    The function tries five directions of the plane's normal: the three principal axes of the points, the vertical, and
    the horizontal direction across the line of sight. It tries several positions of the plane along each normal.

    Args:
        points: points of the cluster, shape (n, 3) [m].
        origin: position of the camera, shape (3,) [m].

    Returns:
        Whether each point is on the first side of the plane, shape (n,); and the mean of the two sides' concavities
        (:func:`concavity`), weighted by their numbers of points [m].
    """
    sample = points[np.linspace(0, len(points) - 1, min(len(points), _SEARCHED)).astype(int)]
    center = sample.mean(axis=0)
    axes = np.linalg.svd(sample - center, full_matrices=False)[2]
    across = np.cross([0.0, 0.0, 1.0], center - origin)
    across = across / max(float(np.linalg.norm(across)), 1e-9)
    directions = np.vstack([axes, [0.0, 0.0, 1.0], across])
    best, best_score = (directions[0], 0.0), np.inf
    for direction in directions:
        heights = sample @ direction
        for height in np.quantile(heights, _CUTS):
            side = heights > height
            k = int(side.sum())
            if min(k, len(sample) - k) < 8:
                continue
            score = (k * concavity(sample[side]) + (len(sample) - k) * concavity(sample[~side])) / len(sample)
            if score < best_score:
                best, best_score = (direction, float(height)), score
    return points @ best[0] > best[1], best_score
