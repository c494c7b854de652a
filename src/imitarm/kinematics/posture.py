"""Find a posture of an arm in which its tool has a given pose."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import ROTATION_LENGTH
from imitarm.kinematics.pose import Pose
from imitarm.validation import finite_vector, instance, whole_number

Array = NDArray[np.float64]

_TOLERANCE = 1e-7  # [m], weighted
_STEPS = 120
_LONGEST_STEP = 0.4  # [rad] of one joint in one step
_DRIFT = 0.05  # fraction of the distance to the reference posture that one step covers
_MOST_RESTARTS = 100_000


def find_posture(
    arm: ArmModel,
    pose: Pose,
    *,
    q0: ArrayLike | None = None,
    frame: str = "tool",
    restarts: int = 40,
    seed: int = 0,
) -> Array:
    r"""Find joint positions within the limits that bring the tool to ``pose``.

    The method is Levenberg-Marquardt: steps :math:`J^T(JJ^T+\mu)^{-1}e` of the joints that are not at a limit, with
    damping :math:`\mu` proportional to the squared error :math:`|e|^2` (Sugihara, IEEE T-RO 27(5), 2011), and a drift
    towards the starting posture in the null space. The search starts from ``q0``, then from ``home``, then from random
    postures.

    Args:
        arm: the arm.
        pose: desired pose in the base frame.
        q0: posture from which to start and near which to stay, shape (n_joints,) [rad]; None: ``home``.
        frame: frame to bring to this pose, ``"tool"`` or ``"flange"``.
        restarts: number of random start postures.
        seed: seed of the random postures.

    Returns:
        shape (n_joints,) [rad]; position within 1e-6 m and rotation within 1e-6 rad.

    Raises:
        UnreachableError: naming the pose and the error of the best posture.
        UnknownNameError: if the frame is not known.
        InputError: if another argument can't be used.
    """
    instance(arm, ArmModel, "arm").site(frame)
    instance(pose, Pose, "pose")
    whole_number(restarts, "restarts", at_least=0, at_most=_MOST_RESTARTS)
    whole_number(seed, "seed", at_least=0)
    best, least = arm.home, math.inf
    for start in _starts(arm, q0, restarts, seed):
        q, error = _descend(arm, start, pose, frame)
        if error < least:
            best, least = q, error
        if error <= _TOLERANCE:
            return q
    missing = _error(arm, best, pose, frame)
    raise UnreachableError(
        f"{arm.name} can't bring its {frame} to position {np.round(pose.position, 4).tolist()} m, quaternion "
        f"{np.round(pose.quaternion, 4).tolist()}: the best posture within its limits is "
        f"{1e3 * float(np.linalg.norm(missing[:3])):.1f} mm and {math.degrees(float(np.linalg.norm(missing[3:]))):.1f} "
        "degrees off; move the pose nearer to the arm or rotate it"
    )


def _starts(arm: ArmModel, q0: ArrayLike | None, restarts: int, seed: int) -> Iterator[Array]:
    if q0 is not None:
        yield np.clip(finite_vector(q0, arm.n_joints, f"{arm.name}: q0", "rad"), arm.lower, arm.upper)
    yield np.array(arm.home)
    low, high = np.maximum(arm.lower, -math.pi), np.minimum(arm.upper, math.pi)
    random = np.random.default_rng(seed)
    for _ in range(restarts):
        yield random.uniform(low, high)


def _error(arm: ArmModel, q: Array, pose: Pose, frame: str) -> Array:
    now = arm.tool_pose(q) if frame == "tool" else arm.forward_kinematics(q)
    return now.error_to(pose)


def _descend(arm: ArmModel, start: Array, pose: Pose, frame: str) -> tuple[Array, float]:
    """Return the final posture and its weighted error [m]."""
    weights = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
    q, best, least, since = start, start, math.inf, 0
    for _ in range(_STEPS):
        error = weights * _error(arm, q, pose, frame)
        size = float(np.linalg.norm(error))
        since = 0 if size < 0.99 * least else since + 1
        if size < least:
            best, least = q, size
        if least <= _TOLERANCE or since > 12:
            break
        jacobian = weights[:, None] * (arm.tool_jacobian(q) if frame == "tool" else arm.jacobian(q))
        q = np.clip(q + _step(arm, q, jacobian, error, start), arm.lower, arm.upper)
    return best, least


def _step(arm: ArmModel, q: Array, jacobian: Array, error: Array, reference: Array) -> Array:
    """Return one step; a joint at a limit does not move beyond it."""
    free = np.ones(len(q), dtype=bool)
    step = np.zeros(len(q))
    damping = 1e-3 * float(error @ error) + 1e-12
    for _ in range(len(q)):
        part = jacobian * free
        inverse = part.T @ np.linalg.inv(part @ part.T + damping * np.eye(6))
        drift = _DRIFT * free * (reference - q)
        step = inverse @ error + drift - inverse @ (part @ drift)
        pressed = free & (((q >= arm.upper) & (step > 0.0)) | ((q <= arm.lower) & (step < 0.0)))
        if not pressed.any():
            break
        free &= ~pressed
    longest = float(np.max(np.abs(step)))
    return step * min(1.0, _LONGEST_STEP / longest) if longest > 0.0 else step
