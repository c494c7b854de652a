"""The input of the oracle of refusals: a scene and a path, for which the oracle decides whether a detour exists."""

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
    """The question whether a path exists in a scene. Contains everything that the oracle must know.

    Attributes:
        nominal: the learned path without displacement, with n samples.
        basis: influence of each component of the skill on each sample, shape (n, n_components).
        obstacles: the obstacles at time 0 s. Each obstacle moves at its constant velocity.
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
        """Return the positions of the tip at ``times``, shape (m, 3) [m], and the relative positions of the spheres.

        These are the vectors from the tip to the centre of each sphere of the tool, shape (n_spheres, m, 3) [m].
        """
        tip, quaternions = self.nominal.at(times)
        if quaternions is None:
            return tip, np.zeros((len(self.spheres), len(times), 3))
        rotations = slerp(times, self.nominal.times, np.asarray(self.nominal.quaternions))
        return tip, np.stack([rotate(rotations, np.broadcast_to(s[:3], (len(times), 3))) for s in self.spheres])

    def axes(self) -> Array:
        """Return d orthonormal vectors that span the permitted displacements, shape (d, 3)."""
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
    all points x of the obstacle is the obstacle's support function. The proof uses only this function. The gradient of
    the library's distance function proposes u, but the bound is valid for every u.

    Args:
        question: obstacles, spheres and clearance.
        times: times of the path [s], shape (n,).
        positions: positions of the tip at these times, connected by straight segments, shape (n, 3) [m].
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
    """Return whether an obstacle is too close to the tool at a fixed time.

    The path must not be displaced at this time.
    """
    times = np.asarray(question.fixed_times)
    tip, relative = question.at(times)
    for obstacle in question.obstacles:
        points = tip + relative - times[:, None] * obstacle.velocity
        needed = question.clearance + question.spheres[:, 3, None]
        if np.any(obstacle.signed_distance(points) < needed - _ROUNDING):
            return True
    return False


class Leg:
    """The part of the motion between two successive fixed times. At a fixed time, the tip must not be displaced.

    The coordinates of a position are its components along the vectors of ``frame``. The first d vectors are the
    permitted directions, along which the search may displace the tip. The rest of the motion is known: the tip along
    the other vectors, the tool's spheres relative to the tip, and the obstacles. A table bounds this known motion. For
    each interval of time, and each pair of an obstacle and a sphere, the table contains a box. The box contains the
    known part of the sphere's motion relative to the obstacle. Level l of the table divides the leg into 2^l intervals.

    Args:
        question: scene and path.
        axes: orthonormal vectors that span the permitted displacements, shape (d, 3).
        start: fixed time at which the leg begins [s].
        end: fixed time at which the leg ends [s].

    Attributes:
        dimension: number d of permitted directions.
        frame: three orthonormal vectors as rows, shape (3, 3). The first d rows are the permitted directions.
        pairs: for each pair of an obstacle and a sphere of the tool: the obstacle, and the distance that the sphere's
            centre must keep from this obstacle [m].
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
        """Return the positions of the tip, shape (m, 3) [m], from its coordinates, shape (m, d) [m].

        The times, shape (m,), are fractions of the leg.
        """
        tip = self._question.at(self.start + times * (self.end - self.start))[0]
        axes = self.frame[: self.dimension]
        return np.asarray(tip + (coordinates - tip @ axes.T) @ axes)

    def nominal(self) -> tuple[Array, Array]:
        """Return the times and the undisplaced coordinates of the samples.

        The times, shape (n,), are fractions of the leg. The coordinates have the shape (n, d) [m].
        """
        samples = self._question.nominal.times
        samples = np.concatenate([[self.start], samples[(samples > self.start) & (samples < self.end)], [self.end]])
        tip = self._question.at(samples)[0]
        return (samples - self.start) / (self.end - self.start), tip @ self.frame[: self.dimension].T

    def tip_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the smallest and the largest coordinates of the undisplaced tip in n intervals of time.

        Each array has the shape (n, d) [m].
        """
        return _looked_up(self._tip[0], level, at), _looked_up(self._tip[1], level, at)

    def motion_box(self, level: Index, at: Index) -> tuple[Array, Array]:
        """Return the smallest and the largest corners of the boxes of the known motion in n intervals.

        Each array has the shape (n, n_pairs, 3) [m].
        """
        return _looked_up(self._motion[0], level, at), _looked_up(self._motion[1], level, at)


def _bows(question: Question) -> Array:
    """Return how far each sphere's centre moves away from straight lines between samples, (n_spheres,) [m]."""
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
