"""Data that the tasks, the limits and the methods of inverse kinematics pass to each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ArmMemory

Array = NDArray[np.float64]


class Box(NamedTuple):
    """Bounds of each joint velocity, ``lower <= v <= upper``, which the solver always keeps.

    Attributes:
        lower: lower bounds, shape (n_joints,) [rad/s].
        upper: upper bounds, shape (n_joints,) [rad/s].
    """

    lower: Array
    upper: Array


class Rows(NamedTuple):
    """Linear inequalities on the joint velocity, ``matrix @ v >= lower``.

    Let ``a`` be a row of the matrix, and ``s`` the amount by which the velocity violates its inequality. If the price
    is finite, the violation adds ``price * (s / |a|)^2 / 2`` to the cost, in which the tasks have weights of about 1.
    The quotient ``s / |a|`` is the smallest change of the joint velocity [rad/s] that would satisfy the row, so the
    cost does not depend on the unit of the row. If the price is infinite, the rows have priority over all tasks. Such
    rows are violated only if they contradict one another or the bounds in :class:`Box`.

    Attributes:
        matrix: coefficients of the inequalities, shape (m, n_joints).
        lower: lower bounds, shape (m,).
        price: penalty weight of a violation; inf for hard constraints.
    """

    matrix: Array
    lower: Array
    price: float = math.inf


def violable(matrix: Array, lower: Array, box: Box) -> NDArray[np.bool_]:
    """Return for each row ``matrix @ v >= lower`` whether any velocity v in a box violates it, shape (k,)."""
    middle, half = 0.5 * (box.lower + box.upper), 0.5 * (box.upper - box.lower)
    return np.asarray(lower > matrix.dot(middle) - np.abs(matrix).dot(half))


class TaskRows(NamedTuple):
    """The weighted equations of a task in one control step: ``jacobian @ v`` should equal ``target``.

    Attributes:
        jacobian: weighted Jacobian of the task, shape (m, n_joints).
        target: weighted target velocity of the task, shape (m,).
        effort: factor of the small cost of joint motion: 1 for a task with full weights, less for a task with small
            weights.
    """

    jacobian: Array
    target: Array
    effort: float = 1.0


@dataclass(slots=True, eq=False)
class IKProblem:
    """The problem of one control step: the arm's state, and the rows of the tasks and limits collected so far.

    Attributes:
        arm: the arm.
        memory: working memory of the arm, which holds its kinematics at ``q``.
        q: joint positions, shape (n_joints,) [rad].
        velocity: joint velocity of the previous step, shape (n_joints,) [rad/s]; None: unknown, so accelerations are
            not limited.
        dt: length of the control step [s].
        box: hard bounds of the joint velocity: the arm's velocity limits, narrowed by the limits of the solver.
        tasks: rows of the tasks; the tool's rows come first.
        rows: soft inequalities.
        max_speed: largest norm of a twist, for tasks without their own limit [m/s].
        scaled: whether each joint velocity is counted in units of its velocity limit, as in damped least squares.
        posture: desired joint velocity in the null space of the tool's task, shape (n_joints,) [rad/s]; only the damped
            methods use it. None: no null-space motion is desired.
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
        """Whether the tool's task has a nonzero target; True until a task has been added."""
        return not self.tasks or bool(self.tasks[0].target.any())
