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
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Pair:
    """One sphere of the tool and one obstacle that it must stay clear of.

    Attributes:
        obstacle: what is in the way.
        index: of the obstacle in its scene.
        radius: of the sphere [m].
        offset: from the tool's tip to the sphere's centre at each sample of a path, in the base frame, shape (n, 3)
            [m]; None for a sphere about the tip itself.
        bow: how far the centre strays from a straight line between two samples while the tool turns, (n - 1,) [m].
    """

    obstacle: Obstacle
    index: int
    radius: float
    offset: Array | None
    bow: Array | float

    def centres(self, positions: Array, samples: Index | slice = slice(None)) -> Array:
        """Return the sphere's centres (..., m, 3) for tip positions (..., m, 3) at some ``samples`` of the path."""
        return positions if self.offset is None else positions + self.offset[samples]

    def distance(self, positions: Array, samples: Index | slice = slice(None)) -> Array:
        """Return the distance (..., m) [m] from the sphere's surface to the obstacle."""
        return self.obstacle.signed_distance(self.centres(positions, samples)) - self.radius

    def distance_and_normal(self, centres: Array) -> tuple[Array, Array]:
        """Return the distance (...) [m] from the sphere's surface to the obstacle, and its gradient (..., 3)."""
        distance, normal = self.obstacle.distance_and_gradient(centres)
        return distance - self.radius, normal


@dataclass(frozen=True, eq=False)
class Detour:
    """A displaced path and what is proven of it.

    Attributes:
        displacement: of each component's mean, shape (n_components, 3) [m].
        positions: the path of the tool's tip, shape (n, 3) [m].
        bounds: proven lower bound of the clearance of each pair over the whole path, shape (n_pairs,) [m].
        nearest: smallest clearance of each pair at the samples, shape (n_pairs,) [m].
        feasible: whether every bound reaches the asked clearance and the path does not stray.
        expanded: how many choices of a side were made.
        strays: whether the path leads absurdly far away or jumps, as it does where a point that must not move is near.
    """

    displacement: Array
    positions: Array
    bounds: Array
    nearest: Array
    feasible: bool
    expanded: int
    strays: bool = False


def judged(
    pairs: Sequence[Pair],
    displacement: Array,
    positions: Array,
    distance: Array,
    normal: Array,
    clearance: float,
    expanded: int = 0,
) -> Detour:
    """Judge a path by its distances (n_pairs, n) and normals (n_pairs, n, 3) against the asked clearance [m]."""
    bounds = segment_bounds(pairs, distance, normal, positions).min(axis=1)
    return Detour(displacement, positions, bounds, distance.min(axis=1), bool(bounds.min() >= clearance), expanded)


def distances(pairs: Sequence[Pair], positions: Array) -> tuple[Array, Array]:
    """Return clearances (n_pairs, n) [m] and unit normals (n_pairs, n, 3) of a path (n, 3)."""
    answers = [pair.distance_and_normal(pair.centres(positions)) for pair in pairs]
    return np.stack([d for d, _ in answers]), np.stack([n for _, n in answers])


def segment_bounds(pairs: Sequence[Pair], distance: Array, normal: Array, positions: Array) -> Array:
    """Bound the clearance of convex obstacles from below on each segment of a path.

    For a convex signed distance ``f`` the tangents at both ends of a segment of length L, with slopes a (start) and b
    (end), under-estimate it, so on the segment ``f(s) >= max(f0 + a s, f1 - b (L - s))``; the minimum over s of the
    right side is at an end or where the two lines cross. The tip moves straight between two samples; a sphere beside
    it bows out by at most ``|offset| (1 - cos(turn / 2))``, which is taken off.

    Args:
        pairs: which spheres and obstacles.
        distance: clearance at the samples, shape (n_pairs, n) [m].
        normal: gradient at the samples, shape (n_pairs, n, 3).
        positions: of the tip at the samples, shape (n, 3) [m].

    Returns:
        Lower bounds, shape (n_pairs, n - 1) [m].
    """
    if all(pair.offset is None for pair in pairs):
        step, bow = (positions[1:] - positions[:-1])[None], np.zeros(1)
    else:
        step = np.stack([np.diff(pair.centres(positions), axis=0) for pair in pairs])
        bow = np.stack([np.broadcast_to(pair.bow, len(positions) - 1) for pair in pairs])
    f0, f1 = distance[:, :-1], distance[:, 1:]
    a = (normal[:, :-1, None, :] @ step[..., None])[..., 0, 0]  # the parameter s runs over [0, 1] on each segment
    b = (normal[:, 1:, None, :] @ step[..., None])[..., 0, 0]
    dip = (a < 0.0) & (b > 0.0)
    crossing = np.clip((f1 - f0 - b) / np.where(dip, a - b, -1.0), 0.0, 1.0)
    low = np.where(a >= 0.0, f0, f1)  # rising from the start, or falling until the end
    return np.asarray(np.where(dip, np.maximum(f0 + a * crossing, f1 + b * (crossing - 1.0)), low) - bow)
