"""Clear postures at the goal: the tool is at a given pose, and the whole arm keeps its clearances."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import UnreachableError
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.arm_path import ArmPath, self_motions
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.policies.arm_certificate import ArmAmongObstacles, ArmClearance

Array = NDArray[np.float64]

_STARTS, _STARTS_TILTED = 24, 6  # random postures from which inverse kinematics begins: for the goal, for each tilt
_SWEEP, _SWEEP_STEPS = 0.15, 24  # [rad] of self-motion in one step of the search; number of steps
_REACHED = 1e-5  # [m, rad] error of the tool's pose that is accepted
_DIFFERENT, _MOST = 0.3, 8  # [rad] difference of a joint between two postures that are returned; number of postures
_REACH = 0.15  # [m] largest clearance that is reported
_TILTS = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class GoalPosture:
    """A posture with the tool at the goal.

    Attributes:
        joints: joint positions, shape (n_joints,) [rad].
        tilt: rotation vector from the learned rotation of the tool at the goal to its rotation in this posture, in the
            base frame, shape (3,) [rad].
    """

    joints: Array
    tilt: Array


@dataclass(frozen=True, eq=False)
class GoalSearch:
    """The result of a search for clear postures at the goal.

    Attributes:
        found: different clear postures, the one nearest to the start of the motion first.
        best: the largest clearance of all postures at the goal; None if the arm can't reach the goal.
    """

    found: tuple[GoalPosture, ...]
    best: ArmClearance | None


def clear_postures(around: ArmAmongObstacles, goal: Pose, time: float, start: Array, goal_tilt: float) -> GoalSearch:
    """Search for postures in which the tool is at the goal and the whole arm is clear.

    Inverse kinematics from random starts finds postures at the goal. Each posture is then varied by the self-motion of
    the arm, which does not move the tool. If no posture is clear and ``goal_tilt`` is positive, the same search is made
    with a tilted tool.

    Args:
        around: the arm, its obstacles and the required clearances.
        goal: learned pose of the tool at the goal, tool_to_base.
        time: time at which the arm is at the goal, for obstacles that move [s].
        start: posture at the start of the motion, shape (n_joints,) [rad].
        goal_tilt: largest rotation of the tool away from its learned rotation at the goal [rad].
    """
    tilts = [np.zeros(3)]
    if goal_tilt > 0.0:
        tilts += [angle * axis for angle in (0.5 * goal_tilt, goal_tilt) for axis in _TILTS]
    best: ArmClearance | None = None
    for tilt in tilts:
        pose = Pose(goal.position, quaternion_multiply(quaternion_exp(tilt), goal.quaternion))
        sweep = _Sweep(around, pose, time)
        found: list[Array] = []
        for q in sweep.run(_STARTS if not tilt.any() else _STARTS_TILTED):
            if all(np.abs(q - other).max() > _DIFFERENT for other in found):
                found.append(q)
        if sweep.best is not None and (best is None or sweep.best.room > best.room):
            best = sweep.best
        if found:
            found.sort(key=lambda q: float(np.abs(q - start).max()))
            return GoalSearch(tuple(GoalPosture(q, tilt) for q in found[:_MOST]), best)
    return GoalSearch((), best)


class _Sweep:
    """Postures with the tool at one pose: the best clearance so far, and those that are clear."""

    def __init__(self, around: ArmAmongObstacles, pose: Pose, time: float) -> None:
        self._around, self._arm, self._pose, self._time = around, around.arm, pose, time
        self.best: ArmClearance | None = None

    def run(self, n_starts: int) -> Iterator[Array]:
        """Yield clear postures, first those that inverse kinematics finds, then those on their self-motions."""
        starts = self._starts(n_starts)
        if not len(starts):
            return
        poses = np.tile(self._pose.position, (len(starts), 1)), np.tile(self._pose.quaternion, (len(starts), 1))
        paths = [ArmPath.of(self._arm, starts)] * 2
        null = self_motions(paths[0].tool_jacobians())
        headings = [sign * null[:, :, :1].sum(axis=2) for sign in (1.0, -1.0)]
        for step in range(_SWEEP_STEPS + 1):
            for path in paths[: 2 if step else 1]:
                yield from self._clear(path, poses)
            if not null.shape[2]:
                return
            for i, path in enumerate(paths):
                paths[i], _ = ArmPath.of(self._arm, path.joints + _SWEEP * headings[i]).moved_to(*poses)
                now = self_motions(paths[i].tool_jacobians())[:, :, 0]
                headings[i] = now * np.where(np.einsum("kj,kj->k", now, headings[i]) < 0.0, -1.0, 1.0)[:, None]

    def _starts(self, n: int) -> Array:
        """Return postures with the tool at the pose, shape (k, n_joints) [rad]."""
        random = np.random.default_rng(0)
        low, high = np.maximum(self._arm.lower, -np.pi), np.minimum(self._arm.upper, np.pi)
        found: list[Array] = []
        for _ in range(n):
            with contextlib.suppress(UnreachableError):
                found.append(find_posture(self._arm, self._pose, q0=random.uniform(low, high), restarts=0))
        return np.array(found).reshape(-1, self._arm.n_joints)

    def _clear(self, path: ArmPath, poses: Sequence[Array]) -> Array:
        """Return the clear ones of several postures, shape (k, n_joints) [rad]."""
        usable = np.abs(path.errors_to(*poses)).max(axis=1) < _REACHED
        usable &= ((path.joints >= self._arm.lower) & (path.joints <= self._arm.upper)).all(axis=1)
        gaps = self._around.gaps(path, np.full(len(path), self._time), 0.0, connected=False)
        room = np.zeros(len(path))
        np.minimum.at(room, gaps.sample, gaps.room)
        best = int(np.argmax(np.where(usable, room, -np.inf)))
        if usable[best] and (self.best is None or room[best] > self.best.room):
            one = ArmPath.of(self._arm, path.joints[best][None])
            self.best = self._around.clearance_at(one, np.array([self._time]), _REACH)
        return path.joints[usable & (room == 0.0)]
