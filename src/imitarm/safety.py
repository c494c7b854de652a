"""SafetyFilter: the last check of every joint velocity before it is sent to an arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.command import Command
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import Rows
from imitarm.kinematics.limits import Limit
from imitarm.kinematics.tasks import ElbowTask, JointVelocityTask, PostureTask, Task, TwistTask
from imitarm.scene.clearance import ClearanceLimit, SelfClearance
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, finite_vector, instance

Array = NDArray[np.float64]

_KEPT = 1e-6  # [m/s] a row that is missed by less is kept: what rounding leaves


@dataclass(frozen=True, eq=False)
class SafetyStep:
    """The result of the filter for one command.

    Attributes:
        velocity: joint velocity to send, shape (n_joints,) [rad/s].
        changed: norm of the difference between ``velocity`` and the velocity that the command would yield with only
            the joint limits [rad/s]; 0 when no clearance inequality was active.
        slack: largest violation of a clearance inequality [m/s]; 0 when all inequalities are kept.
        safe: whether ``velocity`` keeps every limit and every clearance inequality; if False, no joint velocity keeps
            them all.
    """

    velocity: Array
    changed: float
    slack: float
    safe: bool


class SafetyFilter:
    r"""Converts commands to joint velocities that keep the arm's limits and its clearances.

    Each step finds the joint velocity that is closest to the command and meets two conditions, by one quadratic program
    (:class:`~imitarm.kinematics.ik.IKSolver`):

    * The velocity always stays inside the position, velocity and acceleration limits of the joints.
    * No part of the arm approaches an obstacle faster than :class:`~imitarm.scene.clearance.ClearanceLimit` allows, and
      no link approaches another link faster than :class:`~imitarm.scene.clearance.SelfClearance` allows.

    If these clearance inequalities contradict the joint limits, no safe motion exists. The velocity then violates the
    inequalities as little as possible, which moves the arm away from objects that are too close, and ``safe`` is False.

    The same filter serves every policy and teleoperation.

    Args:
        arm: the arm with its tool.
        dt: control period [s].
        clearance: required distance of every part of the arm to every obstacle [m]; None: obstacles are ignored.
        allowance: margin added to the clearance, because no robot moves exactly as commanded [m].
        self_clearance: required distance between links that are not neighbours [m]; None: not checked.
        limits: limits of the inverse kinematics; None: position, velocity and acceleration of each joint.
        method: method of the inverse kinematics; only ``"qp"`` keeps clearances, so with another method both clearances
            must be None.

    Raises:
        InputError: when a number can't be used, or the method can't keep a required clearance.
    """

    def __init__(
        self,
        arm: ArmModel,
        *,
        dt: float = 0.01,
        clearance: float | None = 0.0,
        allowance: float = 0.001,
        self_clearance: float | None = 0.01,
        limits: Sequence[Limit] | None = None,
        method: str = "qp",
    ) -> None:
        self.solver = IKSolver(arm, limits, dt=dt, method=method)
        self.arm, self.dt = arm, self.solver.dt
        self.clearance = (
            None if clearance is None else finite_number(clearance, "SafetyFilter: clearance", "m", at_least=0.0)
        )
        allowance = finite_number(allowance, "SafetyFilter: allowance", "m", at_least=0.0)
        self._obstacles = None if self.clearance is None else ClearanceLimit(arm, self.clearance + allowance)
        self._own = None if self_clearance is None else SelfClearance(arm, self_clearance)

    def step(self, command: Command, q: ArrayLike, velocity: ArrayLike | None, scene: Scene) -> SafetyStep:
        """Return the joint velocity for one control period.

        Args:
            command: command of the policy.
            q: joint positions, shape (n_joints,) [rad].
            velocity: joint velocity that was sent last, shape (n_joints,) [rad/s]; None: unknown, so accelerations are
                not limited.
            scene: obstacles predicted for the current time, with their velocities.

        Raises:
            InputError: when a shape is wrong or a number is not finite.
        """
        instance(command, Command, "SafetyFilter.step: command")
        instance(scene, Scene, "SafetyFilter.step: scene")
        position = finite_vector(q, self.arm.n_joints, "SafetyFilter.step: q", "rad")
        rows = self._rows(position, scene)
        if command.joint_velocity is not None and self._admits(position, command.joint_velocity, velocity, rows):
            return SafetyStep(command.joint_velocity, 0.0, 0.0, True)
        tasks = _tasks(command)
        allowed = self.solver.solve(position, tasks, velocity=velocity, rows=rows)
        missing = max((float((part.lower - part.matrix @ allowed).max()) for part in rows), default=-math.inf)
        changed = 0.0
        if missing > -_KEPT:  # a row is active, or violated
            alone = self.solver.solve(position, tasks, velocity=velocity)
            changed = float(np.linalg.norm(allowed - alone))
        return SafetyStep(allowed, changed, max(missing, 0.0), missing <= _KEPT)

    def _admits(self, q: Array, wanted: Array, velocity: ArrayLike | None, rows: list[Rows]) -> bool:
        """Return whether a joint velocity already keeps all limits and inequalities."""
        box = self.solver.problem(q, JointVelocityTask(wanted), velocity).box
        inside = bool((wanted >= box.lower).all() and (wanted <= box.upper).all())
        return inside and all(bool((part.matrix @ wanted >= part.lower).all()) for part in rows)

    def _rows(self, q: Array, scene: Scene) -> list[Rows]:
        obstacles = None if self._obstacles is None else self._obstacles.rows(q, scene)
        own = None if self._own is None else self._own.rows(q)
        return [part for part in (obstacles, own) if part is not None]


def _tasks(command: Command) -> list[Task]:
    """Return the tasks of the inverse kinematics for a command."""
    if command.joint_velocity is not None:
        return [JointVelocityTask(command.joint_velocity)]
    tasks: list[Task] = [TwistTask(command.twist)]
    if command.elbow is not None:
        tasks.append(ElbowTask(command.elbow))
    if command.posture is not None:
        tasks.append(PostureTask(command.posture))
    return tasks
