"""Inverse kinematics with damping: damped least squares, and the filtered singular value decomposition.

:class:`~imitarm.kinematics.ik.IKSolver` explains these methods. Damped least squares and the filtered decomposition
accept one task for the tool, and no limits except bounds on each joint velocity (boxes).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from imitarm.kinematics.ik_problem import IKProblem

Array = NDArray[np.float64]

_NULL = 1e-12  # squared singular values below this belong to directions in which the arm can't move
_FILTER = 0.06  # [m/rad] "svd": directions with a smaller singular value are damped, by up to this much
_CLEAR = 1e-3  # squared singular values above this can be factored without losing half of the digits
_EYE = np.eye(6)


def damped_least_squares(problem: IKProblem) -> Array:
    """Solve thesis Eq 3.8 and 3.9 with the smallest isotropic damping that keeps the joint speeds within limits."""
    scaled, target, _ = problem.tasks[0]
    length = math.hypot(*target.tolist())
    gram = scaled.dot(scaled.T)
    if problem.posture is None and _is_above(gram, max(length * length, _CLEAR)):
        return _undamped(problem, gram)
    squares, basis, _ = lapack.dsyev(gram)
    return _damped(problem, squares, basis, length)


def damped_with_small_angle(problem: IKProblem) -> Array:
    """Solve thesis Eq 3.8 and 3.9 with the small-angle term that is printed after Eq 3.9."""
    scaled, target, _ = problem.tasks[0]
    squares, basis, _ = lapack.dsyev(scaled.dot(scaled.T))
    small = 0.5 * math.sqrt(max(float(squares[0]), 0.0))
    return _damped(problem, squares, basis, max(math.hypot(*target.tolist()) - small, 0.0))


def _damped(problem: IKProblem, squares: Array, basis: Array, threshold: float) -> Array:
    """Solve from squared singular values and left singular vectors; damp if a singular value is below the threshold."""
    scaled, target, _ = problem.tasks[0]
    least = math.sqrt(max(float(squares[0]), 0.0))
    if least >= threshold:
        damping = 0.0
    elif least >= 0.5 * threshold:
        damping = least * (threshold - least)
    else:
        damping = 0.25 * threshold * threshold
    along = target.dot(basis)
    along /= np.maximum(squares + damping, _NULL)
    result = basis.dot(along).dot(scaled)
    result *= problem.arm.max_velocity
    return _within_box(problem, result, problem.arm.max_velocity, squares, basis)


def _is_above(gram: Array, bound: float) -> bool:
    """Return whether all eigenvalues exceed ``bound``, by trying a Cholesky factorisation."""
    rest = gram - bound * _EYE
    return mujoco.mju_cholFactor(rest, _NULL) == 6


def _undamped(problem: IKProblem, gram: Array) -> Array:
    """Solve without damping; no joint exceeds its limit, because the norm of the scaled velocity is at most 1."""
    jacobian, target, _ = problem.tasks[0]
    along = np.empty(6)
    mujoco.mju_cholFactor(gram, 0.0)
    mujoco.mju_cholSolve(along, gram, target)
    result = along.dot(jacobian)
    result *= problem.arm.max_velocity
    if problem.box.upper is problem.arm.max_velocity:  # no limit is near, so the box holds no more than that
        return result
    np.maximum(result, problem.box.lower, out=result)
    return np.minimum(result, problem.box.upper, out=result)


def filtered_svd(problem: IKProblem) -> Array:
    """Damp only the directions with small singular values (Maciejewski and Klein 1988)."""
    jacobian, target, _ = problem.tasks[0]
    squares, basis, _ = lapack.dsyev(jacobian.dot(jacobian.T))
    squares = np.maximum(squares, 0.0)
    damping = np.maximum(_FILTER * _FILTER - squares, 0.0)
    along = target.dot(basis) / np.maximum(squares + damping, _NULL)
    result = basis.dot(along).dot(jacobian)
    return _within_box(problem, result, 1.0, squares, basis)


def _within_box(problem: IKProblem, result: Array, scale: Array | float, squares: Array, basis: Array) -> Array:
    """Add the null-space drift towards the posture, scale the whole velocity, and clip each joint to its limits."""
    if problem.posture is not None:
        jacobian = problem.tasks[0].jacobian
        drift = problem.posture / scale
        usable = squares > 1e-8
        used = (basis.T @ (jacobian @ drift))[usable] / squares[usable]
        result = result + scale * (drift - jacobian.T @ (basis[:, usable] @ used))
    excess = float((np.abs(result) / problem.arm.max_velocity).max())
    if excess > 1.0:
        result = result / excess
    return np.minimum(np.maximum(result, problem.box.lower), problem.box.upper)
