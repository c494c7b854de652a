"""The question whether a path exists in a scene, in the form that the oracle of refusals uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import rotate, slerp
from imitarm.scene.obstacle import Obstacle
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_DISPLACEMENT = 0.5  # [m] as the product states it
MAX_STEP_RATIO = 8.0  # likewise
TIME_LEVELS = 10  # a leg is divided into at most 2^10 intervals
_DENSE = 4000
_ROUNDING = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class Question:
    """The question of whether a path exists in a scene, in the form that the oracle takes.

    Attributes:
        nominal: the nominal path, with n samples.
        basis: influence of the skill's components on the samples, shape (n, n_components).
        obstacles: the obstacles at time 0 s; each obstacle moves with constant velocity.
        spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required clearance [m].
        forbidden: directions in which the path must not be displaced, shape (k, 3).
        fixed_times: times at which the path must not be displaced [s].
    """

    nominal: Trajectory
    basis: Array
    obstacles: tuple[Obstacle, ...]
    spheres: Array
    clearance: float
    forbidden: Array
    fixed_times: tuple[float, ...]

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions of the tip (m, 3) at ``times``, and sphere centres relative to it (n_spheres, m, 3) [m]."""
        tip, quaternions = self.nominal.at(times)
        if quaternions is None:
            return tip, np.zeros((len(self.spheres), len(times), 3))
        rotations = slerp(times, self.nominal.times, np.asarray(self.nominal.quaternions))
        return tip, np.stack([rotate(rotations, np.broadcast_to(s[:3], (len(times), 3))) for s in self.spheres])

    def axes(self) -> Array:
        """Return an orthonormal basis (d, 3) of the permitted displacements."""
        if not len(self.forbidden):
            return np.eye(3)
        unit = self.forbidden / np.linalg.norm(self.forbidden, axis=1, keepdims=True)
        both = unit[(unit @ unit.T).min(axis=1) < -1.0 + 1e-9]
        if not len(both):
            return np.eye(3)
        _, size, rows = np.linalg.svd(both)
        return np.asarray(rows[int(np.sum(size > 1e-6)) :])


def separation(question: Question, times: Array, positions: Array) -> float:
    """Return a proven lower bound of the clearance along a path, minus the required clearance [m].

    For any unit vector u, a point p is at least ``u . p - max_x u . x`` away from a convex obstacle. The maximum over
    all points x of the obstacle is its support function. The proof uses no other geometry of the library, except that
    the library's distance gradient proposes the vector u. Every u gives a valid bound.

    Args:
        question: obstacles, spheres and clearance.
        times: times of the path [s], shape (n,).
        positions: positions of the tip at these times, the corners of a polyline, shape (n, 3) [m].
    """
    dense = np.unique(np.concatenate([np.linspace(times[0], times[-1], _DENSE), times]))
    tip = np.stack([np.interp(dense, times, column) for column in positions.T], axis=1)
    _, relative = question.at(dense)
    lowest = np.inf
    for obstacle in question.obstacles:
        for sphere, offset in zip(question.spheres, relative, strict=True):
            points = tip + offset - dense[:, None] * obstacle.velocity
            u = obstacle.gradient(points)
            u = u / np.linalg.norm(u, axis=1, keepdims=True)
            gap = np.einsum("nd,nd->n", u, points - obstacle.support(u)) - sphere[3]
            lowest = min(lowest, float(gap.min()))
    return lowest - question.clearance


def covers_fixed_point(question: Question) -> bool:
    """Return whether an obstacle is too close to the tool at a fixed time, where the path may not be displaced."""
    times = np.asarray(question.fixed_times)
    tip, relative = question.at(times)
    for obstacle in question.obstacles:
        points = tip + relative - times[:, None] * obstacle.velocity
        needed = question.clearance + question.spheres[:, 3, None]
        if np.any(obstacle.signed_distance(points) < needed - _ROUNDING):
            return True
    return False


class Leg:
    """The part of the motion between two neighbouring fixed times; at a fixed time, the tip must not be displaced.

    The coordinates of a position are its components along ``frame``: first the d permitted directions, then the others.
    The tip is displaced only along the d permitted directions. Everything else that moves is known: the tip along the
    other directions, the spheres relative to the tip, and the obstacles. A table contains a box for each interval of
    time and each pair of an obstacle and a sphere. The box bounds the known motion of the sphere relative to the
    obstacle. Level l of the table divides the leg into 2^l intervals.

    Args:
        question: scene and path.
        axes: orthonormal basis of the permitted displacements, shape (d, 3).
        start: first time of the leg [s].
        end: last time of the leg [s].

    Attributes:
        dimension: number d of permitted directions.
        frame: unit vectors as rows, first the permitted directions, shape (3, 3).
        pairs: for each pair of an obstacle and a sphere, the obstacle and the distance that the sphere's centre must
            keep from it [m].
        ends: coordinates of the tip at the start and at the end of the leg, shape (2, d) [m].
        one_sided: components of the forbidden directions along the permitted axes, shape (m, d).
    """

    def __init__(self, question: Question, axes: Array, start: float, end: float) -> None:
        d = self.dimension = len(axes)
        self._question, self.start, self.end = question, start, end
        self.frame = np.concatenate([axes, np.linalg.svd(axes)[2][d:]])
        edges = np.linspace(start, end, 2**TIME_LEVELS + 1)
        samples = question.nominal.times
        times = np.unique(np.concatenate([edges, samples[(samples > start) & (samples < end)]]))
        first = np.searchsorted(times, edges)
        tip, relative = question.at(times)
        along = tip @ self.frame.T
        self.ends = along[[0, -1], :d]
        self.pairs = [(o, question.clearance + float(s[3])) for o in question.obstacles for s in question.spheres]
        known = np.where(np.arange(3) < d, 0.0, along)
        low, high = np.empty((2, len(edges) - 1, len(self.pairs), 3))
        bows = np.tile(_bows(question), len(question.obstacles))
        for k, (obstacle, _) in enumerate(self.pairs):
            moved = relative[k % len(question.spheres)] - times[:, None] * obstacle.velocity
            motion = known + moved @ self.frame.T
            low[:, k] = _over(np.minimum, motion, first) - bows[k]
            high[:, k] = _over(np.maximum, motion, first) + bows[k]
        self._motion = _levels(np.minimum, low), _levels(np.maximum, high)
        tips = along[:, :d]
        self._tip = (
            _levels(np.minimum, _over(np.minimum, tips, first)),
            _levels(np.maximum, _over(np.maximum, tips, first)),
        )
        slopes = question.forbidden / np.linalg.norm(question.forbidden, axis=1, keepdims=True) @ axes.T
        self.one_sided = slopes[np.linalg.norm(slopes, axis=1) > 1e-9]

    def positions(self, coordinates: Array, times: Array) -> Array:
        """Return positions (m, 3) [m] of the tip from coordinates (m, d) [m]; ``times`` (m,) are parts of the leg."""
        tip = self._question.at(self.start + times * (self.end - self.start))[0]
        axes = self.frame[: self.dimension]
        return np.asarray(tip + (coordinates - tip @ axes.T) @ axes)

    def nominal(self) -> tuple[Array, Array]:
        """Return the times (n,) of the samples, as fractions of the leg, and the undisplaced coordinates (n, d) [m]."""
        samples = self._question.nominal.times
        samples = np.concatenate([[self.start], samples[(samples > self.start) & (samples < self.end)], [self.end]])
        tip = self._question.at(samples)[0]
        return (samples - self.start) / (self.end - self.start), tip @ self.frame[: self.dimension].T

    def tip_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the box of the undisplaced tip in n intervals of time: lowest and highest coordinates (n, d) [m]."""
        return _looked_up(self._tip[0], level, at), _looked_up(self._tip[1], level, at)

    def motion_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the boxes of the known motion in n intervals: lowest and highest corners (n, n_pairs, 3) [m]."""
        return _looked_up(self._motion[0], level, at), _looked_up(self._motion[1], level, at)


def _bows(question: Question) -> Array:
    """Return how far each sphere's centre moves away from straight lines between samples, at most, (n_spheres,) [m]."""
    arms, quaternions = np.linalg.norm(question.spheres[:, :3], axis=1), question.nominal.quaternions
    if quaternions is None:
        return np.zeros(len(arms))
    cosine = np.abs(np.sum(quaternions[1:] * quaternions[:-1], axis=1)).min(initial=1.0)
    return np.asarray(arms * (1.0 - min(float(cosine), 1.0) + 1e-12))


def _over(reduce: np.ufunc, values: Array, first: Index) -> Array:
    """Reduce ``values`` (m, ...) over the intervals from ``first[i]`` to ``first[i + 1]``, both included."""
    return np.asarray(reduce(reduce.reduceat(values, first[:-1], axis=0), values[first[1:]]))


def _levels(reduce: np.ufunc, finest: Array) -> list[Array]:
    """Return a table with 1, 2, 4, ... rows, in which each row reduces two rows of the next level."""
    levels = [finest]
    while len(levels[-1]) > 1:
        levels.append(reduce(levels[-1][::2], levels[-1][1::2]))
    return levels[::-1]


def _looked_up(levels: list[Array], level: Index, at: Index) -> Array:
    found = np.empty((len(level), *levels[0].shape[1:]))
    for number in np.unique(level).tolist():
        own = np.flatnonzero(level == number)
        found[own] = levels[number][at[own]]
    return found
