"""Proof that a path keeps its distance: a lower bound on every straight segment, from convexity.

The signed distance to a convex obstacle is a convex function, so a tangent plane at any point under-estimates it
everywhere. Two samples and their tangents therefore bound the distance on the whole segment between them: what is
certified is the polyline itself, not a set of samples. Where that bound falls short, points of the segment are looked
at until either the bound reaches what is asked, or one of them is truly nearer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_LOOKS = 12  # points looked at on a segment whose bound falls short; the bracket then is far below a micrometre


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
class Dips:
    """Points between two samples, at which a path is nearer to an obstacle than asked although both samples are not.

    Attributes:
        pair: which sphere and obstacle, shape (m,).
        segment: index of the sample before the point, shape (m,).
        fraction: where between that sample and the next, in [0, 1], shape (m,).
    """

    pair: Index
    segment: Index
    fraction: Array

    @classmethod
    def none(cls) -> Dips:
        """Return no dips."""
        return cls(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp), np.empty(0))

    def and_also(self, others: Dips) -> Dips:
        """Return these dips and others."""
        pair, segment = np.append(self.pair, others.pair), np.append(self.segment, others.segment)
        return Dips(pair, segment, np.append(self.fraction, others.fraction))


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
        dips: where it is too near between two samples that are not.
    """

    displacement: Array
    positions: Array
    bounds: Array
    nearest: Array
    feasible: bool
    expanded: int
    strays: bool = False
    dips: Dips = field(default_factory=Dips.none)


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
    bounds = segment_bounds(pairs, distance, normal, positions)
    dips = Dips.none()
    if bounds.min() < clearance:
        bounds, dips = looked_at_again(pairs, bounds, distance, normal, positions, clearance)
    feasible, bounds = bool(bounds.min() >= clearance), bounds.min(axis=1)
    return Detour(displacement, positions, bounds, distance.min(axis=1), feasible, expanded, dips=dips)


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
    a = (normal[:, :-1, None, :] @ step[..., None])[..., 0, 0]  # the parameter s runs over [0, 1] on each segment
    b = (normal[:, 1:, None, :] @ step[..., None])[..., 0, 0]
    return _lowest(distance[:, :-1], a, distance[:, 1:], b, 1.0)[0] - bow


def looked_at_again(
    pairs: Sequence[Pair], bounds: Array, distance: Array, normal: Array, positions: Array, clearance: float
) -> tuple[Array, Dips]:
    """Look between samples where the bound falls short although both of them keep the clearance.

    Two tangents round a corner cross at twice the depth of the chord, or deeper. The true distance where they cross
    is either too small, then there is a dip; or its tangent takes the place of one of the two, on whose side the
    distance then only falls towards it. So the lowest point stays between two tangents, which close in on it.

    Args:
        pairs: which spheres and obstacles.
        bounds: of :func:`segment_bounds`, shape (n_pairs, n - 1) [m].
        distance: clearance at the samples, shape (n_pairs, n) [m].
        normal: gradient at the samples, shape (n_pairs, n, 3).
        positions: of the tip at the samples, shape (n, 3) [m].
        clearance: asked [m].

    Returns:
        Better lower bounds, shape (n_pairs, n - 1) [m], and the dips that remain.
    """
    bounds, dips = bounds.copy(), Dips.none()
    short = (bounds < clearance) & (distance[:, :-1] >= clearance) & (distance[:, 1:] >= clearance)
    for i in np.flatnonzero(short.any(axis=1)).tolist():
        j = np.flatnonzero(short[i])
        start = pairs[i].centres(positions[j], j)
        step = pairs[i].centres(positions[j + 1], j + 1) - start
        bow = np.broadcast_to(pairs[i].bow, len(positions) - 1)[j]
        left, right = np.zeros(len(j)), np.ones(len(j))
        f0, f1 = distance[i, j], distance[i, j + 1]
        a, b = np.einsum("sd,sd->s", normal[i, j], step), np.einsum("sd,sd->s", normal[i, j + 1], step)
        low, at = _lowest(f0, a, f1, b, 1.0)
        found = np.zeros(len(j), dtype=bool)
        for _ in range(_LOOKS):
            if np.all(found | (low - bow >= clearance)):
                break
            f, n = pairs[i].distance_and_normal(start + at[:, None] * step)
            slope = np.einsum("sd,sd->s", n, step)
            found |= f - bow < clearance
            falls, rises = ~found & (slope <= 0.0), ~found & (slope > 0.0)
            left, f0, a = np.where(falls, (at, f, slope), (left, f0, a))
            right, f1, b = np.where(rises, (at, f, slope), (right, f1, b))
            low, inside = _lowest(f0, a, f1, b, right - left)
            at = np.where(found, at, left + inside)
        bounds[i, j] = np.maximum(bounds[i, j], low - bow)
        dip = bounds[i, j] < clearance
        dips = dips.and_also(Dips(np.full(int(dip.sum()), i), j[dip], at[dip]))
    return bounds, dips


def _lowest(f0: Array, a: Array, f1: Array, b: Array, length: Array | float) -> tuple[Array, Array]:
    """Return the least value of ``max(f0 + a s, f1 - b (length - s))`` over s in [0, length], and where it is."""
    dip = (a < 0.0) & (b > 0.0)
    s = np.clip((f1 - f0 - b * length) / np.where(dip, a - b, -1.0), 0.0, length)
    low = np.where(a >= 0.0, f0, f1)  # rising from the start, or falling until the end
    crossing = np.maximum(f0 + a * s, f1 + b * (s - length))
    return np.where(dip, crossing, low), np.where(dip, s, np.where(a >= 0.0, 0.0, length))
