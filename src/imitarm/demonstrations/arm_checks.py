"""Checks of one motion against an arm: joint names and units, joint limits, joint speed, reach."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import smooth_slope
from imitarm.demonstrations.raw import Finding, ValidRows
from imitarm.errors import InputError

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

_OVER = 0.01  # [rad] by which measured joints may exceed a limit
_SPEED_WINDOW = 0.06  # [s] encoders have little noise
_MARGIN = 5e-3  # [m] by which measured positions may exceed the reach
_DEGREES = 2.5 * np.pi  # [rad] no joint rotates farther, so these are degrees


def check_arm(motion: ValidRows, arm: ArmModel) -> Iterator[Finding]:
    """Check that joints belong to the arm, are in rad and within limits, and that positions are within reach."""
    if motion.joints is None:
        yield from _check_reach(motion, arm)
        return
    try:
        q = motion.raw.joints_of(arm)[motion.rows]
    except InputError as error:
        remedy = "give the arm that was recorded"
        yield motion.finding("error", "other-arm", str(error).removeprefix(f"{motion.raw.source}: "), remedy)
        return
    if np.abs(q).max() > _DEGREES:
        row, joint = np.unravel_index(np.argmax(np.abs(q)), q.shape)
        yield motion.finding(
            "error",
            "joint-units",
            f"{arm.joint_names[joint]} is at {q[row, joint]:.4g} rad: these are degrees",
            "convert the joints to rad, or put the unit in the names: right_j0 [deg]",
            int(row),
        )
        return
    over = np.maximum(arm.lower - q, q - arm.upper)
    if over.max() > _OVER:
        row, joint = np.unravel_index(np.argmax(over), over.shape)
        yield motion.finding(
            "error",
            "joint-limit",
            f"{arm.joint_names[joint]} is at {q[row, joint]:.3f} rad, {over[row, joint]:.3f} beyond its limit "
            f"[{arm.lower[joint]:.3f}, {arm.upper[joint]:.3f}]",
            f"repeat the motion within the limits of {arm.name}, or give the arm that was recorded",
            int(row),
        )
    speed = np.abs(smooth_slope(motion.times, q, _SPEED_WINDOW)[0]) / arm.max_velocity
    if speed.max() > 1.0:
        row, joint = np.unravel_index(np.argmax(speed), speed.shape)
        yield motion.finding(
            "warning",
            "joint-speed",
            f"{arm.joint_names[joint]} rotates at {speed[row, joint] * arm.max_velocity[joint]:.2f} rad/s, but "
            f"{arm.name} allows {arm.max_velocity[joint]:.2f}",
            "reproduce the motion with a longer duration",
            int(row),
        )


def _check_reach(motion: ValidRows, arm: ArmModel) -> Iterator[Finding]:
    centre, radius = reach(arm)
    distance = np.linalg.norm(motion.positions - centre, axis=1)
    row = int(np.argmax(distance))
    if distance[row] > radius + _MARGIN:
        yield motion.finding(
            "error",
            "reach",
            f"{int(np.sum(distance > radius + _MARGIN))} positions are out of reach: {distance[row]:.3f} m from the "
            f"shoulder of {arm.name}, which reaches {radius:.3f} m",
            "check units and frame (the arm's base), or choose a larger arm",
            row,
        )


def reach(arm: ArmModel, *, n_samples: int = 400, seed: int = 0) -> tuple[Array, float]:
    """Return the shoulder of an arm, and the largest distance between the shoulder and the tool's tip.

    The shoulder is the point on the first joint's axis that is nearest to the second joint's axis. The distance is
    found by gradient ascent within the joint limits from random postures, so it is a close lower bound of the true
    reach.

    Args:
        arm: arm with its tool.
        n_samples: number of random postures; gradient ascent starts from the four with the largest distance.
        seed: seed of the random postures.

    Returns:
        Shoulder position in the base frame, shape (3,) [m], and largest distance [m].
    """
    centre = _shoulder(arm)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    postures = np.random.default_rng(seed).uniform(low, high, (n_samples, arm.n_joints))
    distance = np.linalg.norm(arm.tool_path(postures)[0] - centre, axis=1)
    best = 0.0
    for q in postures[np.argsort(distance)[-4:]]:
        here, step = q, 0.5
        value = float(np.linalg.norm(arm.tool_pose(here).position - centre))
        while step > 1e-3:
            offset = arm.tool_pose(here).position - centre
            uphill = arm.tool_jacobian(here)[:3].T @ (offset / value)
            there = np.clip(here + step * uphill / max(float(np.linalg.norm(uphill)), 1e-9), low, high)
            further = float(np.linalg.norm(arm.tool_pose(there).position - centre))
            here, value, step = (there, further, step) if further > value + 1e-7 else (here, value, 0.5 * step)
        best = max(best, value)
    return centre, best


def _shoulder(arm: ArmModel) -> Array:
    """Return the point on the first joint's axis that is nearest to the second joint's axis, shape (3,) [m]."""
    q = np.array(arm.home)
    columns = arm.tool_jacobian(q)
    position = arm.tool_pose(q).position
    axes = columns[3:].T
    if arm.n_joints < 2 or not (axes[0].any() and axes[1].any()):
        return np.zeros(3)
    # a point of joint j's axis, from v_j = a_j x (p - o_j)
    anchors = [position - np.cross(columns[:3, j], axes[j]) for j in (0, 1)]
    normal = np.cross(axes[0], axes[1])
    between = anchors[1] - anchors[0]
    if np.linalg.norm(normal) < 1e-6:
        along = float(between @ axes[0])
    else:
        along = float(np.cross(between, axes[1]) @ normal / (normal @ normal))
    return np.asarray(anchors[0] + along * axes[0])
