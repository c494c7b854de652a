r"""From a wanted motion of the tool to the motion of the joints, one control step at a time.

All methods weight the task rows so that 1 rad counts as 0.3 m, and clamp the wanted twist: damped least squares fed
with an unclamped error freezes short of its target, because its damping grows with the error (METHODS A.7).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.bounds import clearance_rows, velocity_box
from imitarm.kinematics.posture import ANGLE_LENGTH, find_posture

__all__ = ["METHODS", "IKStep", "clearance_rows", "find_posture", "solve_ik", "solve_ik_step", "velocity_box"]

Array = NDArray[np.float64]
Rows = tuple[ArrayLike, ArrayLike]

_WEIGHTS = np.array([1.0, 1.0, 1.0, ANGLE_LENGTH, ANGLE_LENGTH, ANGLE_LENGTH])
_MAX_SPEED = {"dls": 0.6, "qp": 2.0, "svd": 0.6}  # [m/s] clamp of the weighted twist
_NULL = 1e-12  # squared singular values below this belong to directions that the arm can't move in
_FILTER = 0.06  # [m/rad] SVD filter: directions with a smaller singular value are damped, up to this much
_EFFORT, _POSTURE, _CHANGE = 1e-5, 1e-4, 1e-6  # weights of the QP beside a task of weight 1
_SLACK = 1e-6  # reciprocal weight of a violated extra row
_SOFT = 8  # daqp's mark of a constraint that may be violated at a price


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


class _Task(NamedTuple):
    """What the methods see: the weighted task, and the box of admissible joint velocities."""

    jacobian: Array  # weighted, (6, n)
    twist: Array  # weighted and clamped, (6,)
    lower: Array
    upper: Array
    max_velocity: Array
    previous: Array | None
    posture: Array | None  # wanted joint velocity (n,) where the task leaves freedom
    rows: tuple[Array, Array] | None
    small_angle: str | None


def solve_ik(
    arm: ArmModel,
    q: ArrayLike,
    twist: ArrayLike,
    *,
    method: str = "qp",
    dt: float = 0.01,
    frame: str = "tool",
    velocity: ArrayLike | None = None,
    q_ref: ArrayLike | None = None,
    posture_gain: float = 1.0,
    rows: Rows | None = None,
    max_speed: float | None = None,
    small_angle: str | None = None,
) -> Array:
    r"""Return the joint velocity that moves the tool with ``twist``, as far as the arm's limits let it.

    With :math:`J` and :math:`e` the weighted Jacobian and twist, the methods are

    * ``"qp"`` (default, METHODS A.9): minimise
      :math:`\tfrac12|J v-e|^2+\tfrac{\mu}2|v|^2+\tfrac{w_a}2|v-v_p|^2+\tfrac{w_q}2|v-k(q_{ref}-q)|^2`
      inside :func:`velocity_box`, and with ``rows`` under them.
    * ``"dls"`` (thesis Eq 3.8 and 3.9, Baerlocher's damping, METHODS A.7): in joints scaled by their velocity limits,
      :math:`v = J^T (J J^T+\lambda^2)^{-1} e`, with :math:`\lambda=0` for :math:`s_{min}\ge d`,
      :math:`\lambda^2=s_{min}(d-s_{min})` for :math:`d/2\le s_{min}<d` and :math:`\lambda=d/2` below, :math:`d=|e|`.
      This keeps the norm of the scaled velocity at most 1.
    * ``"svd"`` (numerical filtering, METHODS A.9): :math:`v=\sum_i s_i/(s_i^2+\lambda_i^2)\, v_i u_i^T e` with
      :math:`\lambda_i^2=0.06^2(1-(s_i/0.06)^2)` where :math:`s_i<0.06`.

    The last two are scaled down as a whole when a joint would be too fast, then cut to the same box.

    Args:
        arm: the arm.
        q: joint positions, shape (n_joints,) [rad].
        twist: wanted velocity in the base frame, linear rows first, shape (6,) [m/s, rad/s].
        method: ``"qp"``, ``"dls"`` or ``"svd"``.
        dt: length of the control step [s].
        frame: what moves, ``"tool"`` or ``"flange"``.
        velocity: joint velocity of the step before, shape (n_joints,) [rad/s]; with it the limits of acceleration
            are kept.
        q_ref: posture to drift to where the task leaves freedom, shape (n_joints,) [rad].
        posture_gain: how quickly, [1/s].
        rows: ``(A, lower)`` with shapes (m, n_joints) and (m,): more inequalities ``A v >= lower`` on the joint
            velocity, for ``"qp"`` only. They give way at a high price when they contradict the limits of the joints.
        max_speed: the twist is scaled down to this weighted norm [m/s]; None: 0.6 for ``"dls"`` and ``"svd"``, which
            need it, and 2.0 for ``"qp"``.
        small_angle: ``"thesis"`` subtracts half the least singular value from d in ``"dls"``, as the thesis prints
            it (METHODS A.8: that weakens the damping; for comparison only).

    Returns:
        Joint velocity, shape (n_joints,) [rad/s].

    Raises:
        UnknownNameError: when method, frame or small_angle is not known.
        InputError: when a shape is wrong, a number is not finite, or rows are given to a method without rows.
    """
    task = _task(arm, q, twist, method, dt, frame, velocity, q_ref, posture_gain, rows, max_speed, small_angle)
    return METHODS[method](task)


def solve_ik_step(arm: ArmModel, q: ArrayLike, twist: ArrayLike, **options: object) -> IKStep:
    """Do what :func:`solve_ik` does, and report what could not be done; same arguments."""
    settings = {**_DEFAULTS, **options}
    unknown = set(settings) - set(_DEFAULTS)
    if unknown:
        raise UnknownNameError.among("option of solve_ik:", sorted(unknown)[0], _DEFAULTS)
    task = _task(arm, q, twist, **settings)  # type: ignore[arg-type]
    result = METHODS[str(settings["method"])](task)
    error = task.twist - task.jacobian @ result
    error /= _WEIGHTS
    near = 1e-9 * task.max_velocity
    limited = (result >= task.upper - near) | (result <= task.lower + near)
    slack = np.zeros(0) if task.rows is None else np.maximum(0.0, task.rows[1] - task.rows[0] @ result)
    return IKStep(result, error, limited, slack)


_DEFAULTS: dict[str, object] = {
    "method": "qp",
    "dt": 0.01,
    "frame": "tool",
    "velocity": None,
    "q_ref": None,
    "posture_gain": 1.0,
    "rows": None,
    "max_speed": None,
    "small_angle": None,
}


def _task(
    arm: ArmModel,
    q: ArrayLike,
    twist: ArrayLike,
    method: str,
    dt: float,
    frame: str,
    velocity: ArrayLike | None,
    q_ref: ArrayLike | None,
    posture_gain: float,
    rows: Rows | None,
    max_speed: float | None,
    small_angle: str | None,
) -> _Task:
    """Check the input and weight the task."""
    if method not in METHODS:
        raise UnknownNameError.among("IK method", method, METHODS)
    if frame not in {"tool", "flange"}:
        raise UnknownNameError.among("frame", frame, ("tool", "flange"))
    if small_angle not in {None, "thesis"}:
        raise UnknownNameError.among("small_angle", small_angle, ("thesis", None))
    if not dt > 0.0:
        raise InputError(f"solve_ik: dt must be a positive time [s], got {dt}")
    wanted = np.array(twist, dtype=float)
    if wanted.shape != (6,) or not math.isfinite(float(wanted.dot(wanted))):
        raise InputError(f"solve_ik: twist must be 6 finite numbers (linear, angular), got {twist!r}")
    position = np.asarray(q, dtype=float)
    jacobian = arm.tool_jacobian(position) if frame == "tool" else arm.jacobian(position)
    jacobian *= _WEIGHTS[:, None]
    wanted *= _WEIGHTS
    speed, most = math.sqrt(float(wanted.dot(wanted))), _MAX_SPEED[method] if max_speed is None else max_speed
    if speed > most:
        wanted *= most / speed
    previous = None if velocity is None else _joints(arm, velocity, "velocity")
    lower, upper = velocity_box(arm, position, dt, previous)
    posture = None
    if q_ref is not None:
        posture = np.minimum(np.maximum(posture_gain * (_joints(arm, q_ref, "q_ref") - position), lower), upper)
    if rows is not None:
        rows = _checked_rows(arm, rows, method)
    return _Task(jacobian, wanted, lower, upper, arm.max_velocity, previous, posture, rows, small_angle)


def _joints(arm: ArmModel, values: ArrayLike, what: str) -> Array:
    array = np.asarray(values, dtype=float)
    if array.shape != (arm.n_joints,) or not math.isfinite(float(array.dot(array))):
        raise InputError(f"solve_ik: {what} must be {arm.n_joints} finite numbers, got {values!r}")
    return array


def _checked_rows(arm: ArmModel, rows: Rows, method: str) -> tuple[Array, Array]:
    if method != "qp":
        raise InputError(f"solve_ik: method {method!r} can't keep extra rows; use method='qp'")
    matrix, lower = (np.asarray(part, dtype=float) for part in rows)
    if lower.ndim != 1 or matrix.shape != (len(lower), arm.n_joints):
        raise InputError(f"solve_ik: rows need shapes (m, {arm.n_joints}) and (m,), got {matrix.shape}, {lower.shape}")
    if not (np.isfinite(matrix).all() and np.isfinite(lower).all()):
        raise InputError("solve_ik: rows must be finite numbers")
    return matrix, lower


def _quadratic_program(task: _Task) -> Array:
    """Minimise the weighted error of the task inside the box and under the rows."""
    jacobian, n = task.jacobian, len(task.lower)
    hessian = jacobian.T @ jacobian
    linear = -(task.twist @ jacobian)
    effort = _EFFORT
    if task.previous is not None:
        effort += _CHANGE
        linear -= _CHANGE * task.previous
    if task.posture is not None:
        effort += _POSTURE
        linear -= _POSTURE * task.posture
    hessian.ravel()[:: n + 1] += effort
    matrix, upper, lower, sense = np.empty((0, n)), task.upper, task.lower, np.zeros(n, dtype=np.intc)
    if task.rows is not None:
        matrix, least = task.rows
        upper = np.concatenate((task.upper, np.full(len(least), 1e30)))
        lower = np.concatenate((task.lower, least))
        sense = np.zeros(n + len(least), dtype=np.intc)
        sense[n:] = _SOFT
    velocity, _, status, _ = daqp.solve(hessian, linear, matrix, upper, lower, sense, rho_soft=_SLACK)
    if (
        status <= 0
    ):  # the box is never empty and rows are soft: only lost digits can bring us here, and standing is safe
        velocity = np.zeros(n)
    return np.minimum(np.maximum(velocity, task.lower), task.upper)


def _damped_least_squares(task: _Task) -> Array:
    """Thesis Eq 3.8 and 3.9: one damping for all directions, as little as keeps the joints' speed in bounds."""
    scaled = task.jacobian * task.max_velocity
    squares, basis, _ = lapack.dsyev(scaled @ scaled.T)
    least = math.sqrt(max(float(squares[0]), 0.0))
    d = math.sqrt(float(task.twist.dot(task.twist)))
    threshold = d if task.small_angle is None else max(d - 0.5 * least, 0.0)
    if least >= threshold:
        damping = 0.0
    elif least >= 0.5 * threshold:
        damping = least * (threshold - least)
    else:
        damping = 0.25 * threshold * threshold
    along = (basis.T @ task.twist) / np.maximum(squares + damping, _NULL)
    result = (scaled.T @ (basis @ along)) * task.max_velocity
    return _within_box(task, result, scaled, squares, basis)


def _filtered_svd(task: _Task) -> Array:
    """Damp only the directions in which the arm hardly moves (Maciejewski and Klein 1988)."""
    squares, basis, _ = lapack.dsyev(task.jacobian @ task.jacobian.T)
    squares = np.maximum(squares, 0.0)
    damping = np.maximum(_FILTER * _FILTER - squares, 0.0)
    along = (basis.T @ task.twist) / np.maximum(squares + damping, _NULL)
    result = task.jacobian.T @ (basis @ along)
    return _within_box(task, result, task.jacobian, squares, basis)


def _within_box(task: _Task, result: Array, jacobian: Array, squares: Array, basis: Array) -> Array:
    """Add the drift to the posture in the null space, then keep the limits: direction first, then each joint."""
    if task.posture is not None:
        scale = task.max_velocity if jacobian is not task.jacobian else np.ones_like(task.posture)
        drift = task.posture / scale
        usable = squares > 1e-8
        used = (basis.T @ (jacobian @ drift))[usable] / squares[usable]
        result = result + scale * (drift - jacobian.T @ (basis[:, usable] @ used))
    excess = float((np.abs(result) / task.max_velocity).max())
    if excess > 1.0:
        result = result / excess
    return np.minimum(np.maximum(result, task.lower), task.upper)


METHODS: Mapping[str, Callable[[_Task], Array]] = {
    "dls": _damped_least_squares,
    "qp": _quadratic_program,
    "svd": _filtered_svd,
}
"""All methods of :func:`solve_ik`."""
