"""SafetyFilter: the last check of every joint velocity before it is sent to an arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.command import Command
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import Box, Rows
from imitarm.kinematics.least_violation import least_violation
from imitarm.kinematics.limits import JointLimits, Limit
from imitarm.kinematics.tasks import ElbowTask, JointVelocityTask, PostureTask, Task, TwistTask
from imitarm.perception.margins import CoverageMargin
from imitarm.scene.arm_rows import NearRows
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, finite_vector, instance

Array = NDArray[np.float64]

_KEPT = 1e-6  # [m/s] a row that is missed by less is kept: what rounding leaves
_ROUNDING = 1e-9  # [m/s, rad/s]


class Cause(NamedTuple):
    """The two parts that the command would have brought too near to each other, so that the filter changed the command.

    Attributes:
        link: name of the part of the arm, as in the robot's file.
        other: name of the obstacle, or of another link.
        room: distance between the two parts minus the required clearance [m].
    """

    link: str
    other: str
    room: float

    def __str__(self) -> str:
        return f"{self.link} and {self.other}"


@dataclass(frozen=True, eq=False)
class SafetyStep:
    """The result of the filter for one command.

    Attributes:
        velocity: joint velocity to send, shape (n_joints,) [rad/s].
        changed: norm of the difference between ``velocity`` and the velocity that would keep only the joint limits
            [rad/s]. 0 if no clearance inequality was active.
        slack: largest violation of a clearance inequality [m/s]; 0 when all inequalities are kept.
        safe: whether ``velocity`` keeps every joint limit and every clearance inequality. If False, no joint velocity
            keeps them all.
        cause: the pair that required the largest change of the command; None if the filter changed nothing.
    """

    velocity: Array
    changed: float
    slack: float
    safe: bool
    cause: Cause | None = None

    @property
    def intervened(self) -> bool:
        """Whether the filter changed the command to keep a clearance."""
        return self.cause is not None


class SafetyFilter:
    r"""Converts commands to joint velocities that keep the arm's limits and its clearances.

    In each step, one quadratic program (:class:`~imitarm.kinematics.ik.IKSolver`) finds the joint velocity nearest to
    the command. The velocity meets two conditions:

    * The velocity stays inside the position, velocity and acceleration limits of the joints.
    * No part of the arm approaches an obstacle faster than :class:`~imitarm.scene.clearance_limit.ClearanceLimit`
      allows. No link approaches another link faster than :class:`~imitarm.scene.clearance.SelfClearance` allows. An arm
      at rest yields to an obstacle that moves towards it.

    The second condition is a set of inequalities :math:`A \dot q \ge b` for the joint velocity. If they contradict the
    joint limits, no safe motion exists, and ``safe`` is False. In this case, the filter ignores the command. No
    distance may shrink faster than during full braking:

    .. math:: A\, \dot q \;\ge\; \min(b,\; A\, \dot q_b), \qquad \dot q_b = \dot q_p \max(0, 1 - dt / t_b)

    Here, :math:`\dot q_p` is the previous velocity and dt the control period. :math:`t_b = \max_j |\dot q_{p,j}| / a_j`
    is the time in which all joints together can brake to rest, where :math:`a_j` is the acceleration limit of joint j.
    Among the velocities that keep this relaxed limit, the filter takes the one with the least sum of squared violations
    of :math:`A \dot q \ge b`. If a collision can't be avoided, the arm therefore moves away as fast as it can, or at
    least brakes as hard as it can.

    All policies send their commands through this filter, and so does teleoperation.

    Args:
        arm: the arm with its tool.
        dt: control period [s].
        clearance: required distance of every part of the arm to every obstacle [m]; None: obstacles are ignored.
        allowance: margin added to the clearance, because no robot moves exactly as commanded [m].
        self_clearance: required distance between links that are not neighbours [m]; None: not checked.
        limits: limits that the inverse kinematics keeps; None: the limits of position, velocity and acceleration of
            each joint.
        method: method of the inverse kinematics. Only ``"qp"`` keeps clearances; with another method, ``clearance`` and
            ``self_clearance`` must be None.
        latency: time between a command and the motion of the arm [s].
        margin: upper bound of the error of an obstacle's predicted position, as a function of the prediction time. The
            filter adds this bound to the clearance. The prediction time is the time since the obstacle was seen plus
            ``latency``. None: predictions count as exact.
        deviations: additional margin for obstacles with a covariance, as a number of standard deviations of the
            position.

    Raises:
        InputError: when a number is out of range, or a clearance is required but ``method`` can't keep it.
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
        latency: float = 0.0,
        margin: CoverageMargin | None = None,
        deviations: float = 0.0,
    ) -> None:
        self.solver = IKSolver(arm, limits, dt=dt, method=method)
        self.arm, self.dt = arm, self.solver.dt
        self.clearance = (
            None if clearance is None else finite_number(clearance, "SafetyFilter: clearance", "m", at_least=0.0)
        )
        allowance = finite_number(allowance, "SafetyFilter: allowance", "m", at_least=0.0)
        self.latency = finite_number(latency, "SafetyFilter: latency", "s", at_least=0.0)
        self.margin = None if margin is None else instance(margin, CoverageMargin, "SafetyFilter: margin")
        deviations = finite_number(deviations, "SafetyFilter: deviations", at_least=0.0)
        self._obstacles: ClearanceLimit | None = None
        if self.clearance is not None:
            delay = self.dt + self.latency
            self._obstacles = ClearanceLimit(arm, self.clearance + allowance, delay=delay, deviations=deviations)
        self._own = None if self_clearance is None else SelfClearance(arm, self_clearance)
        self._accelerates = any(isinstance(limit, JointLimits) for limit in self.solver.limits)
        self._change = arm.max_acceleration * self.dt + _ROUNDING

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
        n = self.arm.n_joints
        position = finite_vector(q, n, "SafetyFilter.step: q", "rad")
        previous = None if velocity is None else finite_vector(velocity, n, "SafetyFilter.step: velocity", "rad/s")
        near, own = self._near(position, previous, scene)
        rows = [*([] if near is None else [near.rows]), *([] if own is None else [own])]
        wanted = command.joint_velocity
        if wanted is not None and self._admits(position, wanted, previous, rows):
            return SafetyStep(wanted, 0.0, 0.0, True)
        tasks = _tasks(command)
        allowed = self.solver.solve(position, tasks, velocity=previous, rows=rows)
        missing = _missing(rows, allowed)
        if missing <= -_KEPT:  # no row is active
            return SafetyStep(allowed, 0.0, 0.0, True)
        alone = self.solver.solve(position, tasks, velocity=previous)
        if missing > _KEPT:
            allowed = self._retreat(position, previous, rows)
            missing = _missing(rows, allowed)
        changed = float(np.linalg.norm(allowed - alone))
        return SafetyStep(
            allowed, changed, max(missing, 0.0), missing <= _KEPT, self._cause(position, scene, near, own, alone)
        )

    def _near(self, q: Array, velocity: Array | None, scene: Scene) -> tuple[NearRows | None, Rows | None]:
        """Return the rows of obstacles, and those of the arm's own links, that the next velocity could violate."""
        box = None if velocity is None else self._box(velocity)
        near = own = None
        if self._obstacles is not None:
            margins = None
            if self.margin is not None:
                ages = np.maximum(scene.stamp - scene.packed.stamps, 0.0)
                margins = np.asarray(self.margin.at(ages + self.latency), dtype=float)
            near = self._obstacles.near(q, scene, velocity, margins, box)
        if self._own is not None:
            own = self._own.rows(q, box)
        return near, own

    def _box(self, velocity: Array) -> Box | None:
        """Return bounds that contain every joint velocity that the acceleration limits allow after ``velocity``."""
        if not self._accelerates:
            return None
        before = np.minimum(np.maximum(velocity, -self.arm.max_velocity), self.arm.max_velocity)
        return Box(before - self._change, before + self._change)

    def _admits(self, q: Array, wanted: Array, velocity: Array | None, rows: list[Rows]) -> bool:
        """Return whether a joint velocity already keeps all limits and inequalities."""
        box = self.solver.problem(q, JointVelocityTask(wanted), velocity).box
        inside = bool((wanted >= box.lower).all() and (wanted <= box.upper).all())
        return inside and all(bool((part.matrix @ wanted >= part.lower).all()) for part in rows)

    def _retreat(self, q: Array, velocity: Array | None, rows: list[Rows]) -> Array:
        """Return the velocity with the least violation of the rows that approaches nothing faster than full braking."""
        n = self.arm.n_joints
        box = self.solver.problem(q, JointVelocityTask(np.zeros(n)), velocity).box
        braked = np.zeros(n)
        if velocity is not None:
            time = float((np.abs(velocity) / self.arm.max_acceleration).max())
            braked = velocity * max(0.0, 1.0 - self.dt / max(time, self.dt))
        braked = np.clip(braked, box.lower, box.upper)
        matrix = np.concatenate([part.matrix for part in rows])
        least = np.concatenate([part.lower for part in rows])
        floor = np.minimum(least, matrix @ braked) - _ROUNDING
        return least_violation(box, matrix, least, floor)

    def _cause(self, q: Array, scene: Scene, near: NearRows | None, own: Rows | None, wanted: Array) -> Cause | None:
        """Return the pair whose row ``wanted`` violates most; None if it violates none."""
        worst, cause = _KEPT, None
        if near is not None:
            short = near.rows.lower - near.rows.matrix @ wanted
            i = int(short.argmax())
            if short[i] > worst:
                link, other = self.arm.cover.bodies[near.sphere[i]], scene.name_of(int(near.obstacle[i]))
                worst, cause = float(short[i]), Cause(link, other, float(near.room[i]))
        if own is not None and self._own is not None:
            short = own.lower - own.matrix @ wanted
            i = int(short.argmax())
            if short[i] > worst:
                cause = Cause(*self._own.names_of(q, i))
        return cause


def _missing(rows: list[Rows], velocity: Array) -> float:
    """Return the largest violation of any row [m/s]; negative if all rows are kept with room to spare."""
    return max((float((part.lower - part.matrix @ velocity).max()) for part in rows), default=-math.inf)


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
