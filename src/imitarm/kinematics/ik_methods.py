"""Three ways to choose the joints' velocity for one task; :func:`~imitarm.kinematics.ik.solve_ik` explains them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import daqp
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

_NULL = 1e-12  # squared singular values below this belong to directions that the arm can't move in
_FILTER = 0.06  # [m/rad] SVD filter: directions with a smaller singular value are damped, up to this much
_EFFORT, _POSTURE, _CHANGE = 1e-5, 1e-4, 1e-6  # weights of the QP beside a task of weight 1
_WRIST = 0.1  # weight of a violated wrist bound: as much as the tool's turn about that joint
_SLACK = 1e-6  # reciprocal weight of a violated extra row
_SOFT = 8  # daqp's mark of a constraint that may be violated at a price
_CLEAR = 1e-3  # squared singular values above this can be factored without losing half of the digits
_EYE = np.eye(6)
_NOTHING = np.zeros(0)


class Task(NamedTuple):
    """What the methods see: the weighted task, and the box of admissible joint velocities."""

    jacobian: Array  # weighted, (6, n); with the elbow's row (7, n); for "dls" in joints scaled by max_velocity
    twist: Array  # weighted and clamped, (6,) or (7,)
    square: float  # squared norm of the first six
    lower: Array
    upper: Array
    max_velocity: Array
    previous: Array | None
    posture: Array | None  # wanted joint velocity (n,) where the task leaves freedom
    rows: tuple[Array, Array] | None
    small_angle: str | None
    wrist: tuple[int, float, float] | None = None  # joint, side and least velocity to that side of the soft bound
    thrift: float = 1.0  # factor of the weights of all that is not the task


def quadratic_program(task: Task) -> Array:
    """Minimise the weighted error of the task inside the box and under the rows."""
    jacobian, n = task.jacobian, len(task.lower)
    hessian = jacobian.T.dot(jacobian)
    linear = task.twist.dot(jacobian)
    effort = _EFFORT
    if task.previous is not None:
        effort += _CHANGE
        linear += (task.thrift * _CHANGE) * task.previous
    if task.posture is not None:
        effort += _POSTURE
        linear += (task.thrift * _POSTURE) * task.posture
    hessian += _scaled_eye(n, task.thrift * effort)
    velocity = _least_cost(task, hessian, linear)
    if task.wrist is not None:
        joint, side, least = task.wrist
        if side * velocity[joint] < least:  # the price is convex, so where it is paid at all it stands in full
            hessian[joint, joint] += _WRIST
            linear[joint] += _WRIST * side * least
            velocity = _least_cost(task, hessian, linear)
    return velocity


def _least_cost(task: Task, hessian: Array, linear: Array) -> Array:
    """Minimise v^T H v / 2 - f^T v inside the box and under the rows, exactly."""
    free = _unconstrained(task, hessian, linear)
    if free is not None:
        return free
    n = len(linear)
    matrix, least = (_no_rows(n), _NOTHING) if task.rows is None else task.rows
    lower, upper = np.empty(n + len(least)), np.empty(n + len(least))  # it takes none that is read-only
    lower[:n], lower[n:], upper[:n], upper[n:] = task.lower, least, task.upper, 1e30
    sense = _senses(n, len(least)).copy()
    velocity, _, status, _ = daqp.solve(hessian, -linear, matrix, upper, lower, sense, rho_soft=_SLACK)
    if status <= 0:
        # the box is never empty and rows are soft: only lost digits can bring us here, and standing is safe
        velocity = np.zeros(n)
    velocity = np.maximum(velocity, task.lower)
    return np.minimum(velocity, task.upper, out=velocity)


def _unconstrained(task: Task, hessian: Array, linear: Array) -> Array | None:
    """Return the minimum without limits when it keeps them all: most steps need no more, in half of the time."""
    factor, velocity = hessian.copy(), np.empty(len(linear))
    if mujoco.mju_cholFactor(factor, _NULL) < len(linear):
        return None
    mujoco.mju_cholSolve(velocity, factor, linear)
    for low, value, high in zip(task.lower.tolist(), velocity.tolist(), task.upper.tolist(), strict=True):
        if not low <= value <= high:
            return None
    if task.rows is not None and (task.rows[0].dot(velocity) < task.rows[1]).any():
        return None
    return velocity


@cache
def _scaled_eye(n: int, factor: float) -> Array:
    return factor * np.eye(n)


@cache
def _no_rows(n: int) -> Array:
    return np.empty((0, n))


@cache
def _senses(n: int, n_rows: int) -> NDArray[np.intc]:
    return np.array([0] * n + [_SOFT] * n_rows, dtype=np.intc)


def damped_least_squares(task: Task) -> Array:
    """Thesis Eq 3.8 and 3.9: one damping for all directions, as little as keeps the joints' speed in bounds."""
    scaled, square = task.jacobian, task.square
    gram = scaled.dot(scaled.T)
    if task.posture is None and task.small_angle is None and _is_above(gram, max(square, _CLEAR)):
        return _undamped(task, gram)
    squares, basis, _ = lapack.dsyev(gram)
    least = math.sqrt(max(float(squares[0]), 0.0))
    d = math.sqrt(square)
    threshold = d if task.small_angle is None else max(d - 0.5 * least, 0.0)
    if least >= threshold:
        damping = 0.0
    elif least >= 0.5 * threshold:
        damping = least * (threshold - least)
    else:
        damping = 0.25 * threshold * threshold
    along = task.twist.dot(basis)
    along /= np.maximum(squares + damping, _NULL)
    result = basis.dot(along).dot(scaled)
    result *= task.max_velocity
    return _within_box(task, result, task.max_velocity, squares, basis)


def _is_above(gram: Array, bound: float) -> bool:
    """Return whether all eigenvalues are above ``bound``: then, and only then, a Cholesky factor of the rest exists."""
    rest = gram - bound * _EYE
    return mujoco.mju_cholFactor(rest, _NULL) == 6


def _undamped(task: Task, gram: Array) -> Array:
    """Solve without damping; no joint can then be too fast, since the norm is at most 1 in scaled joints."""
    along = np.empty(6)
    mujoco.mju_cholFactor(gram, 0.0)
    mujoco.mju_cholSolve(along, gram, task.twist)
    result = along.dot(task.jacobian)
    result *= task.max_velocity
    if task.upper is task.max_velocity:  # no limit is near, so the box holds no more than that
        return result
    np.maximum(result, task.lower, out=result)
    return np.minimum(result, task.upper, out=result)


def filtered_svd(task: Task) -> Array:
    """Damp only the directions in which the arm hardly moves (Maciejewski and Klein 1988)."""
    squares, basis, _ = lapack.dsyev(task.jacobian.dot(task.jacobian.T))
    squares = np.maximum(squares, 0.0)
    damping = np.maximum(_FILTER * _FILTER - squares, 0.0)
    along = task.twist.dot(basis) / np.maximum(squares + damping, _NULL)
    result = basis.dot(along).dot(task.jacobian)
    return _within_box(task, result, 1.0, squares, basis)


def _within_box(task: Task, result: Array, scale: Array | float, squares: Array, basis: Array) -> Array:
    """Add the drift to the posture in the null space, then keep the limits: direction first, then each joint."""
    if task.posture is not None:
        drift = task.posture / scale
        usable = squares > 1e-8
        used = (basis.T @ (task.jacobian @ drift))[usable] / squares[usable]
        result = result + scale * (drift - task.jacobian.T @ (basis[:, usable] @ used))
    excess = float((np.abs(result) / task.max_velocity).max())
    if excess > 1.0:
        result = result / excess
    return np.minimum(np.maximum(result, task.lower), task.upper)


METHODS: Mapping[str, Callable[[Task], Array]] = {
    "dls": damped_least_squares,
    "qp": quadratic_program,
    "svd": filtered_svd,
}
"""All methods of :func:`~imitarm.kinematics.ik.solve_ik`."""
