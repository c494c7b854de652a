"""The question whether a path exists in a scene, in the form that the oracle of refusals uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import rotate, slerp
from imitarm.scene.obstacle import Obstacle
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_DISPLACEMENT = 0.5  # [m] as the product states it
MAX_STEP_RATIO = 8.0  # likewise
_DENSE = 4000
_ROUNDING = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class Question:
    """The question whether a path exists in a scene, in the form that the oracle takes.

    Attributes:
        nominal: the nominal path, n samples.
        basis: influence of the skill's components on the samples, shape (n, n_components).
        obstacles: obstacles at time 0; each obstacle moves with constant velocity.
        spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required [m].
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
        """Return the tip (m, 3) at times (m,), and the sphere centres relative to the tip (n_spheres, m, 3)."""
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
    """Return a proven lower bound of the distance along a path, minus the required clearance [m].

    For any unit vector u, a point p is at least ``u . p - max_x u . x`` away from a convex obstacle. The maximum over
    all points x of the obstacle is its support function. The proof uses no other geometry code of the library; the
    library's distance gradient only proposes u.

    Args:
        question: obstacles, spheres and clearance.
        times: times of the path [s], shape (n,).
        positions: positions of the tip, a polyline, shape (n, 3) [m].
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
