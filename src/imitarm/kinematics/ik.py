r"""From a wanted motion of the tool to the motion of the joints, one control step at a time.

All methods weight the task rows so that 1 rad counts as 0.3 m, and clamp the wanted twist: damped least squares fed
with an unclamped error freezes short of its target, because its damping grows with the error (METHODS A.7).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.bounds import clearance_rows, velocity_box
from imitarm.kinematics.ik_methods import METHODS
from imitarm.kinematics.ik_solver import ElbowTask, IKSolver, IKStep, Rows
from imitarm.kinematics.posture import find_posture

__all__ = [
    "METHODS",
    "ElbowTask",
    "IKSolver",
    "IKStep",
    "clearance_rows",
    "find_posture",
    "solve_ik",
    "solve_ik_step",
    "velocity_box",
]

Array = NDArray[np.float64]


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
    sew: ElbowTask | None = None,
    singularity_bounds: bool = False,
    small_angle: str | None = None,
) -> Array:
    r"""Return the joint velocity that moves the tool with ``twist``, as far as the arm's limits let it.

    With :math:`J` and :math:`e` the weighted Jacobian and twist, the methods are

    * ``"qp"`` (default, METHODS A.9): minimise
      :math:`\tfrac12|J v-e|^2+\tfrac{\mu}2|v|^2+\tfrac{w_a}2|v-v_p|^2+\tfrac{w_q}2|v-k(q_{ref}-q)|^2`
      inside :func:`velocity_box`, with ``rows`` under them, and with the cost of ``sew`` (see :class:`ElbowTask`).
    * ``"dls"`` (thesis Eq 3.8 and 3.9, Baerlocher's damping, METHODS A.7): in joints scaled by their velocity limits,
      :math:`v = J^T (J J^T+\lambda^2)^{-1} e`, with :math:`\lambda=0` for :math:`s_{min}\ge d`,
      :math:`\lambda^2=s_{min}(d-s_{min})` for :math:`d/2\le s_{min}<d` and :math:`\lambda=d/2` below, :math:`d=|e|`.
      This keeps the norm of the scaled velocity at most 1.
    * ``"svd"`` (numerical filtering, METHODS A.9): :math:`v=\sum_i s_i/(s_i^2+\lambda_i^2)\, v_i u_i^T e` with
      :math:`\lambda_i^2=0.06^2(1-(s_i/0.06)^2)` where :math:`s_i<0.06`.

    The last two are scaled down as a whole when a joint would be too fast, then cut to the same box.
    :class:`IKSolver` does the same in a loop and checks its options only once.

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
        sew: where the elbow should be, for ``"qp"`` only.
        singularity_bounds: keep the elbow 0.15 rad off its stretched position (on the side where it is), always, and
            in ``"qp"`` the wrist 0.1 rad off its singular ones, where the task can spare it (METHODS A.8).
        small_angle: ``"thesis"`` subtracts half the least singular value from d in ``"dls"``, as the thesis prints
            it (METHODS A.8: that weakens the damping; for comparison only).

    Returns:
        Joint velocity, shape (n_joints,) [rad/s].

    Raises:
        UnknownNameError: when method, frame or small_angle is not known.
        InputError: when a shape is wrong, a number is not finite, rows or sew are given to a method without them, or
            the arm does not say where its shoulder, elbow and wrist are and they are needed.
    """
    solver = _solver(arm, method, dt, frame, posture_gain, max_speed, small_angle, singularity_bounds)
    return solver.solve(q, twist, velocity=velocity, q_ref=q_ref, rows=rows, sew=sew)


def solve_ik_step(arm: ArmModel, q: ArrayLike, twist: ArrayLike, **options: Any) -> IKStep:
    """Do what :func:`solve_ik` does, and report what could not be done; same arguments."""
    unknown = set(options) - set(_DEFAULTS)
    if unknown:
        raise UnknownNameError.among("option of solve_ik:", sorted(unknown)[0], _DEFAULTS)
    given = {**_DEFAULTS, **options}
    fixed = ("method", "dt", "frame", "posture_gain", "max_speed", "small_angle", "singularity_bounds")
    solver = _solver(arm, *(given.pop(name) for name in fixed))
    return solver.step(q, twist, **given)


_DEFAULTS: dict[str, Any] = {
    "method": "qp",
    "dt": 0.01,
    "frame": "tool",
    "velocity": None,
    "q_ref": None,
    "posture_gain": 1.0,
    "rows": None,
    "max_speed": None,
    "sew": None,
    "singularity_bounds": False,
    "small_angle": None,
}


@lru_cache(maxsize=32)
def _solver(
    arm: ArmModel,
    method: str,
    dt: float,
    frame: str,
    posture_gain: float,
    max_speed: float | None,
    small_angle: str | None,
    singularity_bounds: bool,
) -> IKSolver:
    return IKSolver(
        arm,
        method,
        dt=dt,
        frame=frame,
        posture_gain=posture_gain,
        max_speed=max_speed,
        small_angle=small_angle,
        singularity_bounds=singularity_bounds,
    )
