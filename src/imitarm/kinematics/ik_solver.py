"""IKSolver: inverse kinematics with its options checked once, for a control loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ArmMemory
from imitarm.kinematics.bounds import VelocityBox, WristBound
from imitarm.kinematics.ik_methods import METHODS, Task
from imitarm.kinematics.posture import ANGLE_LENGTH
from imitarm.kinematics.sew import one_angle
from imitarm.kinematics.spare_motion import spare_motion

Array = NDArray[np.float64]
Rows = tuple[ArrayLike, ArrayLike]
Bounds = tuple[Array, Array]

_MAX_SPEED = {"dls": 0.6, "qp": 2.0, "svd": 0.6}  # [m/s] clamp of the weighted twist
_BENT = 0.1  # squared sine of the angle at the elbow below which its swing fades
_QUICK = 0.5  # share of what the joints can change in a step by which the swing's speed may change
_REFERENCE = 0.04  # squared length below which the direction that the elbow's angle is measured from fades


@dataclass(frozen=True, eq=False)
class IKStep:
    """One step of inverse kinematics and how well it could be done.

    Attributes:
        velocity: of the joints, shape (n_joints,) [rad/s].
        error: what is missing of the wanted twist after the clamp, shape (6,) [m/s, rad/s].
        limited: joints that stand at a bound of velocity, acceleration or position, shape (n_joints,) bool.
        slack: by how much each extra row is violated, shape (m,); 0 where it holds.
    """

    velocity: Array
    error: Array
    limited: NDArray[np.bool_]
    slack: Array


class ElbowTask(NamedTuple):
    r"""Where the elbow should be while the tool does its task (METHODS A.9).

    The elbow swings by the spare motion, the unit vector n along :math:`(I - J^+ J) J_\psi^T`, which leaves the tool
    as it is. What is added to the cost of ``"qp"`` is

    .. math:: \tfrac{w}2\,(n^T v - s)^2, \qquad s = c\,\min(1, 10\sin^2\!\beta)\;
              \frac{k\,\mathrm{wrap}(\psi_h - \psi) - J_\psi J^+ e}{J_\psi n}

    with e the tool's twist and :math:`\beta` the angle at the robot's elbow: the swing fades, to none, as the arm gets
    straight, and likewise near the one direction in which the stereographic angle is lost. From one step to the next s
    changes by no more than half of what the joints can change. While no limit is near this takes
    nothing from the tool, whatever the weight; where the joints are at their limits the weight decides, and a spare
    motion that is not held would drift into postures from which the arm does not get on.

    Attributes:
        angle: wanted :func:`~imitarm.kinematics.sew.sew_angle` [rad].
        weight: w beside the tool's task, whose weight is 1 [m^2]; 0: the spare motion is free.
        confidence: c, 0 to 1: how surely the wanted angle is known; 0: no swing.
        gain: k [1/s].
        max_rate: the wanted rate of the angle is cut to this [rad/s].
        convention: of the angle.
    """

    angle: float
    weight: float = 0.1
    confidence: float = 1.0
    gain: float = 5.0
    max_rate: float = 1.0
    convention: str = "stereographic"


class IKSolver:
    r"""Inverse kinematics of one arm for a control loop: what does not change is checked once.

    ``IKSolver(arm, ...).solve(q, twist)`` is :func:`~imitarm.kinematics.ik.solve_ik`, which explains the methods.
    It holds nothing of a step before and can be used by several threads.

    Args:
        arm: the arm.
        method: ``"qp"``, ``"dls"`` or ``"svd"``.
        dt: length of the control step [s].
        frame: what moves, ``"tool"`` or ``"flange"``.
        posture_gain: how quickly ``q_ref`` is approached [1/s].
        max_speed: the twist is scaled down to this weighted norm [m/s]; None: 0.6 for ``"dls"`` and ``"svd"``, which
            need it, and 2.0 for ``"qp"``.
        small_angle: ``"thesis"`` subtracts half the least singular value from d in ``"dls"`` (METHODS A.8).
        singularity_bounds: keep the elbow 0.15 rad off its stretched position, always, and (``"qp"`` only) the
            wrist 0.1 rad off its singular ones, where the task can spare it (METHODS A.8).
        turn_length: what one radian counts as, beside a metre, where the joints can't do all of the twist [m]; less
            lets the tool's turn go sooner, more its way. Three numbers: for turns about the base's x, y and z.

    Raises:
        UnknownNameError: when method, frame or small_angle is not known.
        InputError: when a number can't be used, or the arm's elbow is not known and ``singularity_bounds`` asked for.
    """

    def __init__(
        self,
        arm: ArmModel,
        method: str = "qp",
        *,
        dt: float = 0.01,
        frame: str = "tool",
        posture_gain: float = 1.0,
        max_speed: float | None = None,
        small_angle: str | None = None,
        singularity_bounds: bool = False,
        turn_length: float | tuple[float, float, float] = ANGLE_LENGTH,
    ) -> None:
        if method not in METHODS:
            raise UnknownNameError.among("IK method", method, METHODS)
        if small_angle not in {None, "thesis"}:
            raise UnknownNameError.among("small_angle", small_angle, ("thesis", None))
        if not 0.0 < dt < math.inf:
            raise InputError(f"solve_ik: dt must be a positive time [s], got {dt}")
        if not math.isfinite(posture_gain) or not (max_speed is None or max_speed >= 0.0):
            raise InputError(
                f"solve_ik: posture_gain must be finite and max_speed not negative, got {posture_gain} and {max_speed}"
            )
        lengths = np.broadcast_to(np.asarray(turn_length, dtype=float), 3)
        if not (np.isfinite(lengths).all() and lengths.min() > 0.0):
            raise InputError(f"solve_ik: turn_length must be one or three positive lengths [m], got {turn_length}")
        self.arm, self.method = arm, method
        self._weights = np.concatenate([np.ones(3), lengths])
        self._thrift = min(1.0, float(lengths.min()) / ANGLE_LENGTH) ** 2  # else a light turn is left for less effort
        self._solve = METHODS[method]
        self._site = arm.site(frame)
        self._arm_sites = np.array([] if arm.landmarks is None else arm.marked().sites, dtype=np.intp)
        self._max_speed = _MAX_SPEED[method] if max_speed is None else max_speed
        self._most = self._max_speed * self._max_speed
        # rows weighted; for "dls" the columns too, whose joints are counted in shares of their velocity limit
        joints = arm.max_velocity if method == "dls" else np.ones(arm.n_joints)
        self._scale = np.outer(self._weights, joints)
        self._posture_gain, self._small_angle, self._max_velocity = posture_gain, small_angle, arm.max_velocity
        self._box = VelocityBox(arm, dt, singularity_bounds=singularity_bounds)
        self._wrist = WristBound(arm, dt) if singularity_bounds and method == "qp" else None

    def solve(
        self,
        q: ArrayLike,
        twist: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        q_ref: ArrayLike | None = None,
        rows: Rows | None = None,
        sew: ElbowTask | None = None,
    ) -> Array:
        """Return the joint velocity, shape (n_joints,) [rad/s]; arguments as for ``solve_ik``."""
        return self._solve(self.task(q, twist, velocity=velocity, q_ref=q_ref, rows=rows, sew=sew))

    def step(
        self,
        q: ArrayLike,
        twist: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        q_ref: ArrayLike | None = None,
        rows: Rows | None = None,
        sew: ElbowTask | None = None,
    ) -> IKStep:
        """Do what :meth:`solve` does, and report what could not be done; same arguments."""
        task = self.task(q, twist, velocity=velocity, q_ref=q_ref, rows=rows, sew=sew)
        result = self._solve(task)
        moved = self.arm.at(q).site_jacobian(self._site) @ result
        error = task.twist[:6] / self._weights - moved
        near = 1e-9 * task.max_velocity
        limited = (result >= task.upper - near) | (result <= task.lower + near)
        slack = np.zeros(0) if task.rows is None else np.maximum(0.0, task.rows[1] - task.rows[0] @ result)
        return IKStep(result, error, limited, slack)

    def task(
        self,
        q: ArrayLike,
        twist: ArrayLike,
        *,
        velocity: ArrayLike | None = None,
        q_ref: ArrayLike | None = None,
        rows: Rows | None = None,
        sew: ElbowTask | None = None,
    ) -> Task:
        """Check the input and weight the task; same arguments."""
        wanted = np.asarray(twist, dtype=float)
        if wanted.shape != (6,):
            raise InputError(f"solve_ik: twist must be 6 finite numbers (linear, angular), got {twist!r}")
        wanted = wanted * self._weights
        square = float(wanted.dot(wanted))
        if not math.isfinite(square):
            raise InputError(f"solve_ik: twist must be 6 finite numbers (linear, angular), got {twist!r}")
        if square > self._most:
            wanted *= self._max_speed / math.sqrt(square)
            square = self._most
        position = np.asarray(q, dtype=float)
        memory = self.arm.at(position)
        jacobian = memory.site_jacobian(self._site) * self._scale
        previous = None if velocity is None else self._joints(velocity, "velocity")
        lower, upper = self._box.at(position, previous)
        posture = None
        if q_ref is not None:
            posture = self._posture_gain * (self._joints(q_ref, "q_ref") - position)
            posture = np.minimum(np.maximum(posture, lower), upper)
        checked = None if rows is None else self._checked_rows(rows)
        if sew is not None:
            jacobian, wanted = self._with_elbow(memory, jacobian, wanted, sew, previous, (lower, upper))
        bound = None if self._wrist is None else self._wrist.at(position)
        if bound is not None and square == 0.0:  # an arm that is told to stand leaves no singularity by itself
            bound = bound[0], bound[1], min(bound[2], 0.0)
        return Task(
            jacobian,
            wanted,
            square,
            lower,
            upper,
            self._max_velocity,
            previous,
            posture,
            checked,
            self._small_angle,
            bound,
            self._thrift,
        )

    def _with_elbow(
        self, memory: ArmMemory, jacobian: Array, wanted: Array, sew: ElbowTask, previous: Array | None, bounds: Bounds
    ) -> tuple[Array, Array]:
        """Add the swing's row to the task; nothing where the arm has no joint to spare."""
        angle, weight, confidence, gain, max_rate, convention = sew
        if self.method != "qp":
            raise InputError(f"solve_ik: method {self.method!r} can't lead the elbow; use method='qp'")
        if not (math.isfinite(angle) and weight >= 0.0 and confidence >= 0.0 and gain >= 0.0 and max_rate >= 0.0):
            raise InputError(f"solve_ik: sew needs a finite angle and numbers that are not negative, got {sew!r}")
        shoulder, elbow, wrist = memory.sites.take(self._arm_sites, axis=0).tolist()
        now = one_angle(shoulder, elbow, wrist, convention)
        if now is None:
            return jacobian, wanted
        gradient = np.array(now.shoulder + now.elbow + now.wrist).dot(memory.marked_jacobians())
        swing = spare_motion(jacobian, gradient)
        if swing is None:
            return jacobian, wanted
        direction, turns, share_of_tool = swing
        share = min(confidence, 1.0) * min(1.0, now.bend / _BENT) * min(1.0, now.reference / _REFERENCE)
        rate = gain * math.remainder(angle - now.angle, math.tau)
        speed = share * (min(max(rate, -max_rate), max_rate) - float(share_of_tool.dot(wanted))) / turns
        if previous is not None:
            before = float(direction.dot(previous))
            along = zip((bounds[1] - bounds[0]).tolist(), direction.tolist(), strict=True)
            change = 0.5 * _QUICK * min([width / max(abs(share), 1e-9) for width, share in along])
            speed = min(max(speed, before - change), before + change)
        root = math.sqrt(weight)
        extended, target = np.empty((7, len(direction))), np.empty(7)
        extended[:6], extended[6] = jacobian, direction
        extended[6] *= root
        target[:6], target[6] = wanted, root * speed
        return extended, target

    def _joints(self, values: ArrayLike, what: str) -> Array:
        array = np.asarray(values, dtype=float)
        n = self.arm.n_joints
        if array.shape != (n,) or not math.isfinite(sum(array.tolist())):
            raise InputError(f"solve_ik: {what} must be {n} finite numbers, got {values!r}")
        return array

    def _checked_rows(self, rows: Rows) -> tuple[Array, Array]:
        if self.method != "qp":
            raise InputError(f"solve_ik: method {self.method!r} can't keep extra rows; use method='qp'")
        n = self.arm.n_joints
        matrix, lower = (np.asarray(part, dtype=float) for part in rows)
        if lower.ndim != 1 or matrix.shape != (len(lower), n):
            raise InputError(f"solve_ik: rows need shapes (m, {n}) and (m,), got {matrix.shape}, {lower.shape}")
        if not math.isfinite(float(np.vdot(matrix, matrix)) + sum(lower.tolist())):
            raise InputError("solve_ik: rows must be finite numbers")
        return matrix, lower
