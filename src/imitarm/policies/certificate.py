"""Proof that a path keeps its distance: a lower bound on every straight segment, from convexity.

The signed distance to a convex obstacle is a convex function, so a tangent plane at any point under-estimates it
everywhere. Two samples and their tangents therefore bound the distance on the whole segment between them: what is
certified is the polyline itself, not a set of samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Detour:
    """A displaced path and what is proven of it.

    Attributes:
        displacement: of each component's mean, shape (n_components, 3) [m].
        positions: the path, shape (n, 3) [m].
        bounds: proven lower bound of the distance to each obstacle over the whole path, shape (n_obstacles,) [m];
            measured from the path itself, nothing subtracted.
        nearest: smallest distance to each obstacle at the samples, shape (n_obstacles,) [m].
        feasible: whether every bound reaches the margin.
        expanded: how many choices of a side were made.
    """

    displacement: Array
    positions: Array
    bounds: Array
    nearest: Array
    feasible: bool
    expanded: int


def measured_detour(
    displacement: Array, positions: Array, distance: Array, normal: Array, margin: float, expanded: int = 0
) -> Detour:
    """Judge a path by its distances (n_obstacles, n) and normals (n_obstacles, n, 3) against ``margin`` [m]."""
    bounds = segment_bounds(distance, normal, positions).min(axis=1)
    return Detour(displacement, positions, bounds, distance.min(axis=1), bool(bounds.min() >= margin), expanded)


def distances(obstacles: Sequence[Obstacle], points: Array) -> tuple[Array, Array]:
    """Return signed distances (n_obstacles, ...) [m] and unit normals (n_obstacles, ..., 3) of ``points`` (..., 3)."""
    pairs = [obstacle.distance_and_gradient(points) for obstacle in obstacles]
    return np.stack([d for d, _ in pairs]), np.stack([n for _, n in pairs])


def segment_bounds(distance: Array, normal: Array, positions: Array) -> Array:
    """Bound the distance to convex obstacles from below on each straight segment of a path.

    For a convex signed distance ``f`` the tangents at both ends of a segment of length L, with slopes a (start) and b
    (end), under-estimate it, so on the segment ``f(s) >= max(f0 + a s, f1 - b (L - s))``; the minimum over s of the
    right side is at an end or where the two lines cross.

    Args:
        distance: signed distance at the samples, shape (n_obstacles, n) [m].
        normal: gradient at the samples, shape (n_obstacles, n, 3).
        positions: the samples, shape (n, 3) [m].

    Returns:
        Lower bounds, shape (n_obstacles, n - 1) [m].
    """
    step = (positions[1:] - positions[:-1])[:, :, None]  # parameter s runs over [0, 1] on each segment
    f0, f1 = distance[:, :-1], distance[:, 1:]
    a = (normal[:, :-1, None, :] @ step)[..., 0, 0]
    b = (normal[:, 1:, None, :] @ step)[..., 0, 0]
    dip = (a < 0.0) & (b > 0.0)
    crossing = np.clip((f1 - f0 - b) / np.where(dip, a - b, -1.0), 0.0, 1.0)
    low = np.where(a >= 0.0, f0, f1)  # rising from the start, or falling until the end
    return np.where(dip, np.maximum(f0 + a * crossing, f1 + b * (crossing - 1.0)), low)
