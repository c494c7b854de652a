"""Approach: a collision-free motion of the joints to the start posture of a plan, before the skill's motion begins."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise, product

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.retiming import retimed, safe_rates

Array = NDArray[np.float64]

_VIAS, _SPREAD = 120, 0.6  # random intermediate postures; their standard deviation [rad]
_PAIRS = 40  # pairs of intermediate postures that are tried
_ENOUGH = 4  # motions of which the shortest is taken
_STEP, _SPEED = 0.05, 0.6  # [rad] between samples; fraction of the largest speed


@dataclass(frozen=True, eq=False)
class Approach:
    """A motion of the joints to the start posture of a plan; it keeps the same clearances as the plan.

    Attributes:
        joints: joint positions, shape (m, n_joints) [rad]; between two samples the joints move linearly.
        times: times of these samples, from 0, shape (m,) [s].
    """

    joints: Array
    times: Array


def find_approach(around: ArmAmongObstacles, start: Array, end: Array, allowance: float) -> Approach | None:
    """Return a short collision-free motion from one posture to another, or None if no such motion was found.

    The motion is a straight line in joint space, or up to three straight lines that meet in intermediate postures.

    Args:
        around: the arm, its obstacles and the required clearances.
        start: posture at the start, shape (n_joints,) [rad].
        end: posture at the end, shape (n_joints,) [rad].
        allowance: required clearance minus the clearance that the safety filter keeps [m].
    """
    corners = islice(_corners(_Legs(around), start, end), _ENOUGH)
    timed = [motion for motion in (_timed(around, one, allowance) for one in corners) if motion is not None]
    return min(timed, key=lambda motion: float(motion.times[-1]), default=None)


class _Legs:
    """Straight lines in joint space, and whether they are clear."""

    def __init__(self, around: ArmAmongObstacles) -> None:
        self._around = around

    def clear_postures(self, joints: Array) -> Array:
        """Return the clear ones of several postures, shape (k, n_joints) [rad]."""
        path = ArmPath.of(self._around.arm, joints)
        gaps = self._around.gaps(path, np.zeros(len(path)), 0.0, connected=False)
        return np.asarray(np.delete(joints, np.unique(gaps.sample), axis=0))

    def clear(self, start: Array, end: Array) -> bool:
        """Return whether the arm keeps its clearances on a straight line."""
        line = ArmPath.of(self._around.arm, _line(start, end))
        return self._around.clearance_of(line, np.zeros(len(line))).room >= 0.0


def _corners(legs: _Legs, start: Array, end: Array) -> Iterator[list[Array]]:
    """Yield clear polylines in joint space, with few corners first."""
    if legs.clear(start, end):
        yield [start, end]
        return
    arm = legs._around.arm
    random = np.random.default_rng(1)
    spread = 0.5 * (start + end) + _SPREAD * random.normal(size=(_VIAS, arm.n_joints))
    spread = spread[
        np.argsort(np.abs(spread - start).max(axis=1) + np.abs(spread - end).max(axis=1))
    ]  # short ones first
    vias = legs.clear_postures(np.clip(np.concatenate([arm.home[None], spread]), arm.lower, arm.upper))
    first, last = [], []
    for via in vias:
        begins, ends = legs.clear(start, via), legs.clear(via, end)
        if begins and ends:
            yield [start, via, end]
        if begins:
            first.append(via)
        if ends:
            last.append(via)
    pairs = sorted(product(first, last), key=lambda pair: float(np.abs(pair[0] - pair[1]).max()))
    for a, b in pairs[:_PAIRS]:
        if legs.clear(a, b):
            yield [start, a, b, end]


def _line(start: Array, end: Array) -> Array:
    n = 2 + int(np.abs(end - start).max() / _STEP)
    return np.linspace(start, end, n + 10)


def _timed(around: ArmAmongObstacles, corners: list[Array], allowance: float) -> Approach | None:
    """Return the motion along straight lines with its execution times; the arm rests at each corner."""
    arm = around.arm
    joints, times, now = [corners[0][None]], [np.zeros(1)], 0.0
    for a, b in pairwise(corners):
        path = ArmPath.of(arm, _line(a, b))
        whole = np.abs(b - a) / (_SPEED * arm.max_velocity)
        parameters = np.linspace(0.0, max(float(whole.max()), 0.1), len(path))
        fastest = safe_rates(around, path, parameters, np.zeros(len(path)), allowance)
        timing = retimed(arm, path.joints, parameters, fastest, path=path)
        if timing.blocked >= 0:
            return None
        joints.append(path.joints[1:])
        times.append(now + timing.times[1:])
        now = float(times[-1][-1])
    return Approach(np.concatenate(joints), np.concatenate(times))
