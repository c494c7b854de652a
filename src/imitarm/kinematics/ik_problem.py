"""What tasks, limits and methods of the inverse kinematics tell each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ArmMemory

Array = NDArray[np.float64]

ROTATION_LENGTH = 0.3
"""[m/rad] A rotation of 1 rad counts as much as a displacement of 0.3 m."""


class Box(NamedTuple):
    """Bounds of each joint velocity, ``lower <= v <= upper``; always kept.

    Attributes:
        lower: shape (n_joints,) [rad/s].
        upper: shape (n_joints,) [rad/s].
    """

    lower: Array
    upper: Array


class Rows(NamedTuple):
    """Linear inequalities on the joint velocity, ``matrix @ v >= lower``.

    With a finite price, a row a that is violated by s costs ``price * (s / |a|)^2 / 2`` beside the tasks, whose weight
    is about 1: what counts is the joint velocity [rad/s] that is missing along the row, whatever the row's own unit.
    Without one, rows come before all tasks: they give way only where they contradict the boxes or one another.

    Attributes:
        matrix: shape (m, n_joints).
        lower: shape (m,).
        price: of a violation.
    """

    matrix: Array
    lower: Array
    price: float = math.inf


class TaskRows(NamedTuple):
    """What a task asks for at one step: ``jacobian @ v`` should equal ``target``, both already weighted.

    Attributes:
        jacobian: shape (m, n_joints).
        target: shape (m,).
        effort: factor of the cost of joint motion beside this task: less for a task with small weights.
    """

    jacobian: Array
    target: Array
    effort: float = 1.0


@dataclass(slots=True, eq=False)
class IKProblem:
    """One control step: what is known of the arm, and what the tasks and limits ask for so far.

    Attributes:
        arm: the arm.
        memory: its kinematics at ``q``.
        q: joint positions, shape (n_joints,) [rad].
        velocity: joint velocity of the previous step, shape (n_joints,) [rad/s]; None: unknown, any is assumed.
        dt: length of the control step [s].
        box: hard bounds of the joint velocity: those of the velocity limits until the limits have been asked.
        tasks: what the tasks ask for, the tool's first.
        rows: soft inequalities.
        max_speed: longest target of a twist, where the task does not say [m/s].
        scaled: whether each joint velocity is counted in units of its velocity limit, as in damped least squares.
        posture: drift in the null space, shape (n_joints,) [rad/s], for the damped methods; None: none.
    """

    arm: ArmModel
    memory: ArmMemory
    q: Array
    velocity: Array | None
    dt: float
    box: Box
    tasks: list[TaskRows]
    rows: list[Rows]
    max_speed: float
    scaled: bool = False
    posture: Array | None = None

    @property
    def moving(self) -> bool:
        """Whether the tool's task asks for any motion; True while that is not known."""
        return not self.tasks or bool(self.tasks[0].target.any())
