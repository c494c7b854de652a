"""Limits of the joint velocity in one control step, as small objects that can be combined.

In each control step, a :class:`Limit` returns a :class:`Box` or :class:`Rows`. A box is a lower and an upper bound of
each joint velocity. The solver never violates these bounds. Rows are linear inequalities on the joint velocities. The
solver may violate them where they contradict a box, or where their penalty weight (price) is finite.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Box, IKProblem, Rows
from imitarm.validation import instance

Array = NDArray[np.float64]

ELBOW_MARGIN = 0.15  # [rad] distance that ElbowSingularityLimit keeps from the stretched elbow
WRIST_MARGIN = 0.1  # [rad] distance that WristSingularityLimit keeps from the singular wrist
_WRIST_PRICE = 0.1  # as much as the tool's rotation about that joint
_RETURN_RATE = 5.0  # [1/s] how fast a wrist inside its margin leaves it
_MAX_PERIODS = 8  # control periods for which the constants of the box are kept
_SIGN = np.array([[1.0], [-1.0]])


class Limit(ABC):
    """One limit of the joint velocity. To write your own limit, implement the method :meth:`restrict` in a subclass.

    Attributes:
        soft: whether the limit returns :class:`Rows` instead of a :class:`Box`; only the solver method ``"qp"`` accepts
            rows.
    """

    soft: ClassVar[bool] = False

    @abstractmethod
    def restrict(self, problem: IKProblem) -> Box | Rows | None:
        """Return the box or the rows for one control step; None when the limit is too far away to have an effect."""


class JointLimits(Limit):
    r"""Position, velocity and acceleration limits of the joints, combined into a box of joint velocities.

    The box contains a lower and an upper bound of each joint velocity, and is never empty.

    Let D be the distance to the upper position limit [rad], a the acceleration limit [rad/s^2] and :math:`dt` the
    length of a control step [s]. A joint can stop before the position limit only if its velocity is at most
    :math:`v_b(D)`:

    .. math:: v_b(D) = -a\,dt + \sqrt{a^2 dt^2 + 2 a D}

    The velocity :math:`v_b` is the solution of :math:`v^2/(2a) + v\,dt = D`. The upper bound is
    :math:`\min(v_{max},\; v_p + a\,dt,\; \max(v_b(D),\, v_p - a\,dt))` where :math:`v_p` is the previous velocity; the
    lower bound has the same form, with the lower position limit and opposite signs. If :math:`v_p` satisfied this bound
    in the previous step, braking with the acceleration a satisfies the bound in this step. The box is therefore never
    empty.

    The bound assumes that the joint moves by :math:`v\,dt` in one step. A robot with constant acceleration moves by
    :math:`(v_p + v)\,dt/2`; ``imitarm.robots.limit_velocity`` therefore evaluates this box at :math:`q + v_p\,dt/2`.

    Args:
        arm: arm whose limits are kept.
    """

    def __init__(self, arm: ArmModel) -> None:
        self.arm = instance(arm, ArmModel, "JointLimits: arm")
        self._boxes: dict[float, _VelocityBox] = {}

    def restrict(self, problem: IKProblem) -> Box:
        """Return the bounds in one control step; a joint outside its position limits can only move back."""
        known = self._boxes.get(problem.dt)
        if known is None:
            return self.box(problem.q, problem.dt, problem.velocity)
        return known.at(problem.q, problem.velocity)

    def box(self, q: Array, dt: float, velocity: Array | None = None) -> Box:
        """Return the bounds at one posture; the caller must not change the arrays.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            dt: length of the control step [s].
            velocity: joint velocity of the previous step, shape (n_joints,) [rad/s]; None: accelerations are not
                limited.
        """
        known = self._boxes.get(dt)
        if known is None:
            if len(self._boxes) >= _MAX_PERIODS:  # a measured dt differs in every step
                self._boxes.clear()
            known = self._boxes.setdefault(dt, _VelocityBox(self.arm, dt))
        return known.at(q, velocity)


class _VelocityBox:
    """The bounds of :class:`JointLimits` for one control period."""

    def __init__(self, arm: ArmModel, dt: float) -> None:
        self._most, self._least = arm.max_velocity, -arm.max_velocity
        self._least.setflags(write=False)
        self._free = Box(self._least, self._most)
        self._step = arm.max_acceleration * dt
        self._squared, self._double = self._step * self._step, 2.0 * arm.max_acceleration
        room = self._most * self._most / self._double + self._most * dt  # farther from a limit, v_b exceeds v_max
        # both directions at once: row 0 upwards, row 1 downwards with signs changed
        self._ends = np.stack((arm.upper, -arm.lower))
        self._range = list(zip((arm.lower + room).tolist(), (arm.upper - room).tolist(), strict=True))
        slower = self._most - self._step  # a joint that is no faster can't reach v_max in one step
        self._inner = list(zip((arm.lower + room).tolist(), (arm.upper - room).tolist(), slower.tolist(), strict=True))

    def at(self, q: Array, velocity: Array | None) -> Box:
        if velocity is None:
            for value, (low, high) in zip(q.tolist(), self._range, strict=True):
                if not low <= value <= high:
                    return self._near_a_limit(q, None)
            return self._free
        for value, speed, (low, high, slower) in zip(q.tolist(), velocity.tolist(), self._inner, strict=True):
            if not (low <= value <= high and -slower <= speed <= slower):
                return self._near_a_limit(q, velocity)
        return Box(velocity - self._step, velocity + self._step)

    def _near_a_limit(self, q: Array, velocity: Array | None) -> Box:
        bound = np.maximum(self._ends - _SIGN * q, 0.0)
        bound *= self._double
        bound += self._squared
        np.sqrt(bound, out=bound)
        bound -= self._step
        if velocity is not None:
            before = _SIGN * np.minimum(np.maximum(velocity, self._least), self._most)
            np.maximum(bound, before - self._step, out=bound)
            np.minimum(bound, before + self._step, out=bound)
        np.minimum(bound, self._most, out=bound)
        return Box(-bound[1], bound[0])


class ElbowSingularityLimit(Limit):
    """Keeps the elbow 0.15 rad away from its stretched position, on the side on which it currently is.

    An SRS (spherical-rotational-spherical) arm is singular where its upper arm and forearm are in line, because the
    elbow then can't change the distance between shoulder and wrist. The margin acts like an additional position limit
    of the elbow joint (see :class:`JointLimits`). An arm that starts inside the margin can only move out of it.

    Args:
        arm: the arm; its file must mark shoulder, elbow and wrist.

    Raises:
        InputError: when the arm's file does not define its elbow.
    """

    def __init__(self, arm: ArmModel) -> None:
        marked = instance(arm, ArmModel, "ElbowSingularityLimit: arm").required_landmarks()
        self._joint = joint = marked.elbow
        self._straight = marked.elbow_straight
        self._acceleration, self._most = float(arm.max_acceleration[joint]), float(arm.max_velocity[joint])
        low, high = float(arm.lower[joint]), float(arm.upper[joint])
        # on a side where the position limits leave no room for the margin, they alone are kept
        self._sides = tuple(low < self._straight + side * ELBOW_MARGIN < high for side in (1.0, -1.0))
        self._open = np.full(arm.n_joints, np.inf)
        self._open.setflags(write=False)
        self._braking_distance = self._most * self._most / (2.0 * self._acceleration)

    def restrict(self, problem: IKProblem) -> Box | None:
        """Return a bound of the elbow joint; None when the margin is farther away than the braking distance."""
        position = float(problem.q[self._joint])
        side = -1.0 if position < self._straight else 1.0
        if not self._sides[0 if side > 0.0 else 1]:
            return None
        distance = max(side * (position - self._straight) - ELBOW_MARGIN, 0.0)
        if distance > self._braking_distance + self._most * problem.dt:
            return None
        step = self._acceleration * problem.dt
        bound = math.sqrt(step * step + 2.0 * self._acceleration * distance) - step  # towards the stretched elbow
        if problem.velocity is not None:
            before = min(max(-side * float(problem.velocity[self._joint]), -self._most), self._most)
            bound = max(bound, before - step)
        if bound >= self._most:
            return None
        bounded = self._open.copy()
        bounded[self._joint] = bound
        return Box(-bounded, self._open) if side > 0.0 else Box(-self._open, bounded)


class WristSingularityLimit(Limit):
    r"""Softly keeps the wrist joint at least 0.1 rad away from its singular positions.

    The wrist is singular at every multiple of pi, because the joint axes before and after the wrist joint are parallel
    there. Let e be the joint's distance from the nearest multiple of pi [rad], and :math:`e'` the rate at which e grows
    [rad/s]. If e exceeds 0.1, the limit is :math:`e' \ge -v_b(e - 0.1)` (see :class:`JointLimits`). If e is at most
    0.1, the limit is :math:`e' \ge 5\,(0.1 - e)`. The penalty weight (price) of a violation is low, so that the wrist
    can pass through a singular position if necessary.

    Args:
        arm: the arm; its file must mark shoulder, elbow and wrist.

    Raises:
        InputError: when the arm's file does not define its wrist.
    """

    soft: ClassVar[bool] = True

    def __init__(self, arm: ArmModel) -> None:
        self._joint = arm.required_landmarks().wrist
        self._acceleration = float(arm.max_acceleration[self._joint])
        self._most = float(arm.max_velocity[self._joint])
        self._rows = []
        for side in (1.0, -1.0):
            row = np.zeros((1, arm.n_joints))
            row[0, self._joint] = side
            row.setflags(write=False)
            self._rows.append(row)

    def restrict(self, problem: IKProblem) -> Rows | None:
        """Return one inequality on the wrist joint's velocity; None when no velocity can violate the inequality."""
        position = float(problem.q[self._joint])
        away = position - math.pi * round(position / math.pi)
        distance = abs(away) - WRIST_MARGIN
        if distance <= 0.0:
            least = -_RETURN_RATE * distance if problem.moving else 0.0  # an arm told to stand still stays there
        else:
            step = self._acceleration * problem.dt
            least = step - math.sqrt(step * step + 2.0 * self._acceleration * distance)
            if least <= -self._most:
                return None
        return Rows(self._rows[0 if away >= 0.0 else 1], np.array([least]), _WRIST_PRICE)


def singularity_limits(arm: ArmModel) -> tuple[Limit, ...]:
    """Return the limits that keep an SRS arm away from its elbow and wrist singularities.

    Raises:
        InputError: when the arm's file does not define its elbow and wrist.
    """
    return ElbowSingularityLimit(arm), WristSingularityLimit(arm)
