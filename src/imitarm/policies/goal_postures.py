"""Goal postures: search for postures with the tool at the goal in which the whole arm keeps its clearances."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.arm_path import ArmPath, self_motions
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.policies.arm_certificate import ArmAmongObstacles, ArmClearance

Array = NDArray[np.float64]

_STARTS, _TILTED_STARTS = 24, 6  # random postures from which inverse kinematics begins: for the goal, for each tilt
_SWEEP, _SWEEP_STEPS = 0.15, 24  # [rad] of self-motion in one step of the search; number of steps
_SAME = 0.03  # [rad] postures that differ by less are one
_REACHED = 1e-5  # [m, rad] error of the tool's pose that is accepted
_DIFFERENT, _MOST = 0.3, 8  # [rad] difference of a joint between two postures that are returned; number of postures
_REACH = 0.15  # [m] largest clearance that is reported
_TILTS = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True, eq=False)
class GoalPosture:
    """A posture of the arm with the tool at the goal.

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
        found: clear postures in the order of their distance from the start posture of the motion.
        best: the largest clearance among all postures at the goal; None if the arm can't reach the goal.
    """

    found: tuple[GoalPosture, ...]
    best: ArmClearance | None


def clear_postures(around: ArmAmongObstacles, goal: Pose, time: float, start: Array, goal_tilt: float) -> GoalSearch:
    """Search for postures in which the tool is at the goal and the whole arm is clear.

    Inverse kinematics from random starts finds postures at the goal. The self-motion of the arm, which does not move
    the tool, leads from each of these postures to further postures. If no posture is clear and ``goal_tilt`` is
    positive, the search is repeated with the tool rotated by up to ``goal_tilt``.

    Args:
        around: the arm, its obstacles and the required clearances.
        goal: learned pose of the tool at the goal, tool_to_base.
        time: time at which the arm is at the goal [s]; it determines the positions of moving obstacles.
        start: posture at the start of the motion, shape (n_joints,) [rad].
        goal_tilt: largest rotation of the tool away from its learned rotation at the goal [rad].
    """
    tilts = [np.zeros(3)]
    if goal_tilt > 0.0:
        tilts += [angle * axis for angle in (0.5 * goal_tilt, goal_tilt) for axis in _TILTS]
    best: ArmClearance | None = None
    for tilt in tilts:
        pose = Pose(goal.position, quaternion_multiply(quaternion_exp(tilt), goal.quaternion))
        path = _postures(around.arm, *_key(pose), _TILTED_STARTS if tilt.any() else _STARTS)
        if path is None:
            continue
        times = np.full(len(path), time)
        gaps = around.gaps(path, times, 0.0, connected=False)
        room = np.zeros(len(path))
        np.minimum.at(room, gaps.sample, gaps.room)
        top = int(np.argmax(room))
        if best is None or room[top] > best.room:
            best = around.clearance_at(ArmPath.of(around.arm, path.joints[top][None]), times[:1], _REACH)
        found: list[Array] = []
        for q in path.joints[room >= 0.0]:
            if all(np.abs(q - other).max() > _DIFFERENT for other in found):
                found.append(q)
        if found:
            found.sort(key=lambda q: float(np.abs(q - start).max()))
            return GoalSearch(tuple(GoalPosture(q, tilt) for q in found[:_MOST]), best)
    return GoalSearch((), best)


def _key(pose: Pose) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return tuple(pose.position.tolist()), tuple(pose.quaternion.tolist())


@lru_cache(maxsize=64)
def _postures(
    arm: ArmModel, position: tuple[float, ...], quaternion: tuple[float, ...], n_starts: int
) -> ArmPath | None:
    """Return postures with the tool at a pose; None if there are none.

    First come those that inverse kinematics finds from ``n_starts`` random starts, then those on their self-motions.
    They do not depend on obstacles, so they are kept for further scenes.
    """
    starts = _solutions(arm, Pose(np.array(position), np.array(quaternion)), n_starts)
    if not len(starts):
        return None
    poses = np.tile(position, (len(starts), 1)), np.tile(quaternion, (len(starts), 1))
    paths = [ArmPath.of(arm, starts)] * 2
    null = self_motions(paths[0].tool_jacobians())
    headings = [sign * null[:, :, :1].sum(axis=2) for sign in (1.0, -1.0)]
    found = [_usable(paths[0], poses)]
    for _ in range(_SWEEP_STEPS if null.shape[2] else 0):
        for i, path in enumerate(paths):
            paths[i], _ = ArmPath.of(arm, path.joints + _SWEEP * headings[i]).moved_to(*poses)
            now = self_motions(paths[i].tool_jacobians())[:, :, 0]
            headings[i] = now * np.where(np.einsum("kj,kj->k", now, headings[i]) < 0.0, -1.0, 1.0)[:, None]
            found.append(_usable(paths[i], poses))
    kept: list[Array] = []
    for q in np.concatenate(found):
        if not kept or np.abs(np.array(kept) - q).max(axis=1).min() > _SAME:
            kept.append(q)
    return ArmPath.of(arm, np.array(kept)) if kept else None


def _solutions(arm: ArmModel, pose: Pose, n: int) -> Array:
    """Return postures with the tool at a pose, found by inverse kinematics, shape (k, n_joints) [rad]."""
    random = np.random.default_rng(0)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    found: list[Array] = []
    for _ in range(n):
        with contextlib.suppress(UnreachableError):
            found.append(find_posture(arm, pose, q0=random.uniform(low, high), restarts=0))
    return np.array(found).reshape(-1, arm.n_joints)


def _usable(path: ArmPath, poses: Sequence[Array]) -> Array:
    """Return those of several postures in which the tool is at its pose and no limit is exceeded, (k, n_joints)."""
    usable = np.abs(path.errors_to(*poses)).max(axis=1) < _REACHED
    usable &= ((path.joints >= path.arm.lower) & (path.joints <= path.arm.upper)).all(axis=1)
    return path.joints[usable]
