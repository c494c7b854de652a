r"""Tasks of the inverse kinematics: desired motions, as small objects that can be combined.

Let :math:`v` be the joint velocity. A task sets the target velocity :math:`t` of a quantity that moves with :math:`J
v`, for example of the tool's pose. The solver minimises the sum of :math:`\tfrac12 |J v - t|^2` over all tasks, within
all limits (of the joints and of clearances).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH
from imitarm.kinematics.ik_problem import IKProblem, TaskRows
from imitarm.kinematics.sew import one_angle
from imitarm.validation import finite_number, finite_vector, text

Array = NDArray[np.float64]

_FLOAT64 = np.dtype(np.float64)
_BENT = 0.1  # squared sine of the angle at the elbow below which the elbow task fades
_REFERENCE = 0.04  # squared length below which the direction that the SEW angle is measured from fades
_QUICK = 0.5  # fraction of what the joints can change in a step by which the elbow's speed may change
_DAMPING = 1e-7  # squared singular values below this belong to directions in which the arm can't move
_LEAST = 1e-4  # squared: a quantity that changes less with the self-motion can't be led by it


class Task(Protocol):
    """One wanted motion. To write your own task, write a class with a method :meth:`rows`."""

    def rows(self, problem: IKProblem) -> TaskRows | None:
        """Return the weighted equations :math:`J v = t` of the task for one step; None: the task has no effect.

        Raises:
            InputError: when a number of the task can't be used.
        """


class TwistTask(NamedTuple):
    r"""Move the tool, or the flange, at a desired velocity (a twist).

    A rotation of 1 rad is weighted like a displacement of ``rotation_length``. A twist whose weighted norm exceeds
    ``max_speed`` is scaled down. Without this scaling, damped least squares would stop short of its target, because its
    damping grows with the error (thesis Eq 3.9).

    Attributes:
        twist: desired velocity in the base frame, linear rows first, shape (6,) [m/s, rad/s].
        frame: the frame that moves, ``"tool"`` or ``"flange"``.
        rotation_length: displacement that counts as much as a rotation of 1 rad [m]. It matters only when the joints
            can't achieve the whole twist: with a smaller value, the error of the rotation becomes larger. Three values
            apply to rotations about the base's x, y and z axes.
        max_speed: largest weighted norm of the twist [m/s]; None: the default of the solver.
    """

    twist: ArrayLike
    frame: str = "tool"
    rotation_length: float | tuple[float, float, float] = ROTATION_LENGTH
    max_speed: float | None = None

    def rows(self, problem: IKProblem) -> TaskRows:
        """Return the weighted Jacobian (6, n_joints) and the weighted twist (6,), scaled down to ``max_speed``."""
        twist, frame, rotation_length, most = self
        try:
            weights, scale, effort, site = _scales(rotation_length, frame, problem.arm, problem.scaled)
        except TypeError:  # not hashable
            lengths = tuple(finite_vector(rotation_length, 3, "TwistTask: rotation_length", "m").tolist())
            weights, scale, effort, site = _scales(lengths, text(frame, "frame"), problem.arm, problem.scaled)
        if most is None:
            most = problem.max_speed
        elif not (type(most) is float and 0.0 <= most < math.inf):
            most = finite_number(most, "TwistTask: max_speed", "m/s", at_least=0.0)
        if type(twist) is not np.ndarray or twist.dtype is not _FLOAT64 or twist.shape != (6,):
            twist = finite_vector(twist, 6, "TwistTask: twist", "m/s, rad/s")
        target = twist * weights
        speed = math.hypot(*target.tolist())
        if not speed <= most:  # too fast, or not finite
            target *= most / speed
            finite_vector(twist, 6, "TwistTask: twist", "m/s, rad/s")
        return TaskRows(problem.memory.site_jacobian(site) * scale, target, effort)


class JointVelocityTask(NamedTuple):
    """Move the joints at given velocities, for example along a planned joint path.

    Attributes:
        velocity: desired joint velocity, shape (n_joints,) [rad/s].
        weight: weight of this task [m^2]; the weight of a twist is 1.
    """

    velocity: ArrayLike
    weight: float = 1.0

    def rows(self, problem: IKProblem) -> TaskRows:
        """Return an identity matrix (n_joints, n_joints) and the velocity, both times the square root of the weight."""
        velocity = finite_vector(self.velocity, len(problem.q), "JointVelocityTask: velocity", "rad/s")
        root = _root(self.weight, "JointVelocityTask")
        return TaskRows(_scaled_eye(len(velocity), root), root * velocity)


class PostureTask(NamedTuple):
    """Drift towards a posture :math:`q_{ref}` as far as the other tasks allow: :math:`v = k (q_{ref} - q)`.

    Attributes:
        q: joint positions :math:`q_{ref}` of the posture, shape (n_joints,) [rad].
        gain: gain k of the speed [1/s].
        weight: weight of this task [m^2]; the weight of a twist is 1.
    """

    q: ArrayLike
    gain: float = 1.0
    weight: float = 1e-4

    def drift(self, problem: IKProblem) -> Array:
        """Return the desired joint velocity, clipped to the limits in ``problem.box``, shape (n_joints,) [rad/s]."""
        gain = finite_number(self.gain, "PostureTask: gain", "1/s")
        drift = gain * (finite_vector(self.q, len(problem.q), "PostureTask: q", "rad") - problem.q)
        return np.minimum(np.maximum(drift, problem.box.lower), problem.box.upper)

    def rows(self, problem: IKProblem) -> TaskRows:
        """Return an identity matrix (n_joints, n_joints) and the drift, both times the square root of the weight."""
        root = _root(self.weight, "PostureTask")
        return TaskRows(_scaled_eye(len(problem.q), root), root * self.drift(problem))


class ElbowTask(NamedTuple):
    r"""Rotate the elbow to a shoulder-elbow-wrist (SEW) angle without moving the tool.

    The elbow moves by the arm's self-motion, a joint motion that does not move the tool. The unit vector n of the
    self-motion points along :math:`(I - J^+ J) J_\psi^T`, where J is the Jacobian of the tool's task (the first task)
    and :math:`J_\psi` is the gradient of the SEW angle. The elbow task adds the cost :math:`\tfrac{w}2\,(n^T v - s)^2`,
    where :math:`v` is the joint velocity and s is the desired speed of the self-motion:

    .. math:: s = c\,\min(1, 10\sin^2\!\beta)\;\frac{k\,\mathrm{wrap}(\psi_h - \psi) - J_\psi J^+ e}{J_\psi n}

    Here, :math:`\psi` is the arm's :func:`~imitarm.kinematics.sew.sew_angle`, :math:`\beta` is the angle at its elbow,
    and e is the target velocity of the tool's task. The elbow's speed goes to zero as the arm becomes straight. It also
    goes to zero near the wrist positions at which the stereographic angle is undefined (a half-line from the shoulder).
    From one step to the next, the speed s changes by at most half of the change that the acceleration limits of the
    joints allow. While no limit restricts the joint velocity, the elbow task does not move the tool, whatever its
    weight. If a limit of a joint or of a clearance restricts it, the weights decide between the tool's task and the
    elbow task.

    Attributes:
        angle: desired SEW angle :math:`\psi_h` [rad].
        weight: weight w [m^2]; the tool's task has the weight 1.
        confidence: certainty c of the desired angle, 0 to 1; 0: the elbow is not moved.
        gain: gain k of the speed [1/s].
        max_rate: limit of the desired rate of the angle [rad/s].
        convention: convention of the SEW angle, see :func:`~imitarm.kinematics.sew.sew_angle`.
    """

    angle: float
    weight: float = 0.1
    confidence: float = 1.0
    gain: float = 5.0
    max_rate: float = 1.0
    convention: str = "stereographic"

    def rows(self, problem: IKProblem) -> TaskRows | None:
        """Return one equation, for the speed of the self-motion; None if the angle or the self-motion is undefined."""
        angle, weight, confidence, gain, max_rate, convention = self
        try:
            usable = math.isfinite(angle + weight + confidence + gain + max_rate)
            usable = usable and weight >= 0.0 and confidence >= 0.0 and gain >= 0.0 and max_rate >= 0.0
        except (TypeError, ValueError, OverflowError):
            usable = False
        if not usable:
            raise InputError(f"ElbowTask: needs a finite angle and other numbers that are not negative, got {self!r}")
        if not problem.tasks:
            raise InputError("ElbowTask: must follow a task for the tool, such as TwistTask, in the list of tasks")
        tool, velocity, memory = problem.tasks[0], problem.velocity, problem.memory
        problem.arm.required_landmarks()
        shoulder, elbow, wrist = memory.landmarks()
        now = one_angle(shoulder, elbow, wrist, convention)
        if now is None:
            return None
        gradient = np.array(now.shoulder + now.elbow + now.wrist).dot(memory.landmark_jacobians())
        motion = self_motion(tool.jacobian, gradient)
        if motion is None:
            return None
        direction, change, by_tool = motion
        factor = min(confidence, 1.0) * min(1.0, now.bend / _BENT) * min(1.0, now.reference / _REFERENCE)
        rate = gain * math.remainder(angle - now.angle, math.tau)
        speed = factor * (min(max(rate, -max_rate), max_rate) - float(by_tool.dot(tool.target))) / change
        if velocity is not None:
            before = float(direction.dot(velocity))
            widths = (problem.box.upper - problem.box.lower).tolist()
            if abs(speed - before) > 0.5 * _QUICK * min(widths):  # less is always possible along a unit vector
                parts = zip(widths, map(abs, direction.tolist()), strict=True)
                most = 0.5 * _QUICK * min([width / (part if part > 1e-9 else 1e-9) for width, part in parts])
                speed = min(max(speed, before - most), before + most)
        root = math.sqrt(weight)
        direction *= root
        return TaskRows(direction[None], np.array([root * speed]))


def self_motion(jacobian: Array, gradient: Array) -> tuple[Array, float, Array] | None:
    r"""Return the joint motion that does not move the tool and changes a given quantity most.

    Let J be the tool's Jacobian and g the gradient of the quantity. The returned motion is along :math:`(I - J^+
    J)\,g`. The joint motion :math:`J^+ e`, which moves the tool by e, changes the quantity by :math:`g^T J^+ e`.

    Args:
        jacobian: Jacobian of the tool, shape (m, n_joints).
        gradient: gradient of the quantity with respect to the joint positions, shape (n_joints,).

    Returns:
        The motion as a unit vector (n_joints,); the rate at which this motion changes the quantity; and :math:`g^T
        J^+`, shape (m,). None when no self-motion changes the quantity.
    """
    gram = jacobian.dot(jacobian.T)
    gram += _scaled_eye(len(gram), _DAMPING)
    by_tool = np.empty(len(gram))
    mujoco.mju_cholFactor(gram, 0.0)
    mujoco.mju_cholSolve(by_tool, gram, jacobian.dot(gradient))
    direction = gradient - by_tool.dot(jacobian)
    square = float(direction.dot(direction))
    if square < _LEAST:
        return None
    length = math.sqrt(square)
    direction /= length
    return direction, length, by_tool


def _root(weight: float, task: str) -> float:
    return math.sqrt(finite_number(weight, f"{task}: weight", at_least=0.0))


@lru_cache(maxsize=64)
def _scales(
    rotation_length: float | tuple[float, float, float], frame: str, arm: ArmModel, scaled: bool
) -> tuple[Array, Array, float, int]:
    """Return the weights of a twist (6,), the factors for its Jacobian (6, n_joints), the effort and the site.

    The effort is :attr:`TaskRows.effort`, the factor of the cost of joint motion.
    """
    try:
        lengths = np.broadcast_to(np.asarray(rotation_length, dtype=float), 3)
        usable = bool(np.isfinite(lengths).all() and lengths.min() > 0.0)
    except (TypeError, ValueError, OverflowError):
        usable = False
    if not usable:
        raise InputError(f"TwistTask: rotation_length must be one or three positive lengths [m], got {rotation_length}")
    weights = np.concatenate([np.ones(3), lengths])
    scale = np.outer(weights, arm.max_velocity if scaled else np.ones(arm.n_joints))
    for array in (weights, scale):
        array.setflags(write=False)
    effort = min(1.0, float(lengths.min()) / ROTATION_LENGTH) ** 2
    return weights, scale, effort, arm.site(frame)


@lru_cache(maxsize=64)
def _scaled_eye(n: int, factor: float) -> Array:
    eye = factor * np.eye(n)
    eye.setflags(write=False)
    return eye
