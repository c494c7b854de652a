"""PrimitivePath: the motion of a skill's primitive and the learned precision, as tables over the phase."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled.kernels import Record
from imitarm.kinematics.pose import Pose, quaternion_to_matrix
from imitarm.skills.dmp import DMP
from imitarm.skills.skill import Skill

Array = NDArray[np.float64]

N_SAMPLES = 600  # intervals of the tables
_FLOOR = 5e-3  # [m] standard deviation that is added to the learned one
_SOFTEST, _STIFFEST = 0.25, 4.0  # limits of the precision
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class PrimitivePath:
    r"""The motion xi(s) of a motion primitive; the phase s runs from 0 at the start to 1 at the goal.

    If the goal moves by delta, the motion moves by ``p(s) delta``, where p increases from 0 at the start to 1 at the
    goal. After a change of the goal, the primitive is therefore not integrated again.

    Attributes:
        duration: duration of the motion [s].
        goal: pose of the tool (tool_to_base) at the end of the motion.
        positions: xi at n + 1 equally spaced phases, shape (n + 1, 3) [m].
        progress: the factor p at each phase, shape (n + 1,).
        precision: the matrices Theta of :func:`learned_precision`, shape (n + 1, 3, 3).
        quaternions: learned rotations wxyz, shape (n + 1, 4); None when no rotation was learned.
    """

    dmp: DMP
    start: Pose | None
    duration: float
    goal: Pose
    positions: Array
    progress: Array
    precision: Array
    quaternions: Array | None

    @classmethod
    def of(cls, dmp: DMP, precision: Array, start: Pose | None = None, goal: Pose | None = None) -> Self:
        """Return the motion between two poses.

        Args:
            dmp: the motion primitive.
            precision: result of :func:`learned_precision`, shape (n + 1, 3, 3).
            start: pose of the tool at the start; None: the learned start.
            goal: pose of the tool at the end; None: the learned goal.
        """
        T = dmp.duration_
        motion = dmp.generate(start, goal, dt=T / N_SAMPLES)
        if goal is None:
            rotation = _UPRIGHT if dmp.orientation_ is None else dmp.orientation_.goal_
            goal = Pose(dmp.goal_, rotation)
        progress = dmp.progress(np.linspace(0.0, T, N_SAMPLES + 1))
        return cls(dmp, start, T, goal, motion.positions, progress, precision, motion.quaternions)

    def to(self, goal: Pose) -> PrimitivePath:
        """Return the motion from the same start to another goal."""
        positions = self.positions + self.progress[:, None] * (goal.position - self.goal.position)
        quaternions = self.quaternions
        if quaternions is not None and not np.array_equal(goal.quaternion, self.goal.quaternion):
            quaternions = self.dmp.generate(self.start, goal, dt=self.duration / N_SAMPLES).quaternions
        return replace(self, goal=goal, positions=positions, quaternions=quaternions)

    def positions_at(self, phases: Array) -> Array:
        """Return the positions xi at phases (...), shape (..., 3) [m]; phases are clipped to the range from 0 to 1."""
        x = np.minimum(np.maximum(phases, 0.0), 1.0) * N_SAMPLES
        i = np.minimum(x.astype(np.intp), N_SAMPLES - 1)
        before = self.positions[i]
        return np.asarray(before + (x - i)[..., None] * self._steps[i])

    def position(self, phase: float) -> Array:
        """Return the position xi at one phase from 0 to 1, shape (3,) [m]."""
        x = phase * N_SAMPLES
        i = min(int(x), N_SAMPLES - 1)
        return np.asarray(self.positions[i] + (x - i) * self._steps[i])

    @cached_property
    def _steps(self) -> Array:
        return np.diff(self.positions, axis=0)

    def nearest(self, phases: Array) -> NDArray[np.intp]:
        """Return the index of the sample nearest to each phase; the result has the shape of ``phases``."""
        return np.rint(np.minimum(np.maximum(phases, 0.0), 1.0) * N_SAMPLES).astype(np.intp)

    def tangent(self, phase: float) -> Array:
        """Return the direction of the motion (3,), or towards the goal where the motion rests; 0 at the goal."""
        i = min(int(phase * N_SAMPLES), N_SAMPLES - 1)
        along = self._steps[i]
        length = float(np.sqrt(along.dot(along)))
        if length * N_SAMPLES < _FLOOR:
            along = self.goal.position - self.positions[i]
            length = float(np.sqrt(along.dot(along)))
        return along / length if length > 1e-9 else np.zeros(3)

    def quaternion(self, phase: float) -> Array | None:
        """Return the learned rotation wxyz (4,), or None when no rotation was learned."""
        if self.quaternions is None:
            return None
        x = phase * N_SAMPLES
        i = min(int(x), N_SAMPLES - 1)
        before, after = self.quaternions[i], self.quaternions[i + 1]
        between = before + (x - i) * (after if before.dot(after) >= 0.0 else -after) - (x - i) * before
        return np.asarray(between / np.sqrt(between.dot(between)))

    def record(self, spheres: bool, hold: Array) -> Record:
        """Return the C structure ``Path``.

        Args:
            spheres: whether the tool has spheres with the centre away from the tip, so that its rotation matters.
            hold: rotation wxyz (4,) that the tool keeps if no rotation was learned.
        """
        rotations = np.zeros(0)
        if spheres:
            rotations = quaternion_to_matrix(hold) if self.rotations is None else np.ascontiguousarray(self.rotations)
        tables = np.ascontiguousarray(self.positions), np.ascontiguousarray(self.precision)
        goal = np.ascontiguousarray(self.goal.position, dtype=float)
        return Record(N_SAMPLES, rotations.size // 9, *tables, rotations, goal, self.duration, self.speed)

    @cached_property
    def speed(self) -> float:
        """Highest speed of the motion [m/s]."""
        return float(np.sqrt(np.sum(self._steps**2, axis=1).max())) * N_SAMPLES / self.duration

    @cached_property
    def rotations(self) -> Array | None:
        """Learned rotations as matrices, shape (n + 1, 3, 3); None when no rotation was learned."""
        return None if self.quaternions is None else quaternion_to_matrix(self.quaternions)


def learned_precision(skill: Skill) -> Array:
    r"""Return how precisely the tool must follow the motion at n + 1 equally spaced phases, shape (n + 1, 3, 3).

    The precision is the matrix theta of thesis Eq 5.1: the inverse of the learned covariance Sigma, but without a unit.

    .. math:: \Theta(s) = \bar\sigma^2 (\Sigma(s) + \epsilon^2 I)^{-1}, \qquad \epsilon = 5\ mm

    The factor :math:`\bar\sigma^2` is the mean variance over the motion, so a typical precision is 1. The eigenvalues
    are limited to the range from 1/4 to 4, so that no demonstration, however precise, counts more than a collision.
    """
    covariance = skill.tolerance(np.linspace(0.0, skill.duration_, N_SAMPLES + 1)) + _FLOOR**2 * np.eye(3)
    variances, axes = np.linalg.eigh(covariance)
    precision = np.clip(variances.mean() / variances, _SOFTEST, _STIFFEST)
    return np.asarray((axes * precision[:, None]) @ np.swapaxes(axes, 1, 2))
