r"""Kinematics of the person's arm: seven joint angles, forward and inverse (thesis Eq 3.5; docs/retargeting.md).

The kinematic chain consists of shoulder, upper arm, elbow, forearm and wrist. When all angles are zero, the arm is
straight along the x axis of the base. With the lengths :math:`L_U` of the upper arm and :math:`L_F` of the forearm, the
chain of rotations and lengths is

.. math:: R = R_z(q_0) R_y(q_1) R_x(q_2)\;|\,L_U\,|\;R_y(q_3) R_x(q_4)\;|\,L_F\,|\;R_y(q_5) R_x(q_6)

Sawyer's joints have the same axes in the same order when all its joint positions are zero. Therefore, a person and a
Sawyer in the same posture have nearly the same joint angles. The differences come from the offsets between Sawyer's
links.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.retarget.limbs import LimbLengths

Array = NDArray[np.float64]

AXES = ("z", "y", "x", "y", "x", "y", "x")
"""Rotation axis of each joint when all joint angles are zero."""

HUMAN_ARM_DH = (
    np.array([0.0, 0.5 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]),
    np.array([-0.5 * np.pi, 0.5 * np.pi, -0.5 * np.pi, 0.5 * np.pi, -0.5 * np.pi, 0.5 * np.pi, 0.0]),
)
"""Denavit-Hartenberg table of the arm: the offsets of theta and the angles alpha, shape (7,) each [rad].

The parameter a is 0 in all rows.
The parameter d is the length of the upper arm in row 3, the length of the forearm in row 5, and otherwise 0.
"""

_TO_HAND = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # from the table's last frame
_SINGULAR = 0.05  # sine below which an angle keeps its value, because it would only follow noise
_APART = 0.2  # smallest sine of the angle between hand and thumb
_HAND_LENGTH = 0.03  # [m] a hand tip closer to the wrist has no direction
_UNIT = {"x": 0, "y": 1, "z": 2}


def dh_transform(theta: ArrayLike, d: ArrayLike, a: ArrayLike, alpha: ArrayLike, *, as_printed: bool = False) -> Array:
    r"""Return Denavit-Hartenberg transforms from frame i to frame i-1 (thesis Eq 3.5, corrected).

    .. math::
        \begin{pmatrix} c & -c_\alpha s & s_\alpha s & a c \\ s & c_\alpha c & -s_\alpha c & a s \\
        0 & s_\alpha & c_\alpha & d \\ 0 & 0 & 0 & 1 \end{pmatrix}

    Args:
        theta: angle about the previous z axis [rad]. Each of the four parameters is a number or an array.
        d: distance along the previous z axis [m].
        a: distance along the new x axis [m].
        alpha: angle about the new x axis [rad].
        as_printed: whether to use the matrix as printed in the thesis, whose second row has sin instead of cos. With
            this misprint, the upper left 3 x 3 block is not a rotation matrix.

    Returns:
        Transforms, shape (..., 4, 4).
    """
    theta, d, a, alpha = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (theta, d, a, alpha)))
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    row = s if as_printed else c
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [
        [c, -ca * s, sa * s, a * c],
        [s, ca * row, -sa * row, a * s],
        [zero, sa, ca, d],
        [zero, zero, zero, one],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def human_arm_frames(angles: ArrayLike, lengths: LimbLengths, *, as_printed: bool = False) -> Array:
    """Return the frames of the Denavit-Hartenberg chain relative to the shoulder (thesis Eq 3.5).

    The thesis prints no Denavit-Hartenberg table for the arm; the function uses the table :data:`HUMAN_ARM_DH` of this
    library. Frame 3 is at the elbow, and frame 5 at the wrist. Frame 7 is the frame of the hand, with x along the hand
    and z out of the back of the hand.

    Args:
        angles: joint angles, shape (7,) [rad].
        lengths: bone lengths of the person's arm.
        as_printed: whether to use the misprinted matrices of the thesis (see :func:`dh_transform`).

    Returns:
        The transforms of frames 0 to 7, shape (8, 4, 4); frame 0 is the shoulder's frame.
    """
    offset, alpha = HUMAN_ARM_DH
    along = np.array([0.0, 0.0, lengths.upper_arm, 0.0, lengths.forearm, 0.0, 0.0])
    steps = dh_transform(np.asarray(angles, dtype=float) + offset, along, 0.0, alpha, as_printed=as_printed)
    frames = np.empty((8, 4, 4))
    frames[0] = np.eye(4)
    for i, step in enumerate(steps):
        frames[i + 1] = frames[i] @ step
    frames[7, :3, :3] = frames[7, :3, :3] @ _TO_HAND
    return frames


def human_arm_pose(angles: ArrayLike, lengths: LimbLengths) -> tuple[Array, Array, Array]:
    """Return elbow (3,), wrist (3,) [m] and the hand's rotation matrix (3, 3), all in the shoulder's frame."""
    elbow, wrist, hand, _ = _chain(np.asarray(angles, dtype=float), lengths)
    return elbow, wrist, hand


def human_arm_jacobian(angles: ArrayLike, lengths: LimbLengths) -> Array:
    """Return the Jacobian in the shoulder's frame, shape (6, 7).

    Rows 0 to 2 give the wrist's velocity, rows 3 to 5 the hand's angular velocity.
    """
    elbow, wrist, _, axes = _chain(np.asarray(angles, dtype=float), lengths)
    origins = np.array([np.zeros(3)] * 3 + [elbow] * 2 + [wrist] * 2)
    return np.concatenate([np.cross(axes, wrist - origins).T, axes.T])


def _chain(angles: Array, lengths: LimbLengths) -> tuple[Array, Array, Array, Array]:
    """Return elbow, wrist, hand rotation and the joint axes, shape (7, 3), all in the shoulder's frame."""
    rotation, axes = np.eye(3), np.empty((7, 3))
    at, elbow = np.zeros(3), np.zeros(3)
    for i, (name, angle) in enumerate(zip(AXES, angles, strict=True)):
        axes[i] = rotation[:, _UNIT[name]]
        rotation = rotation @ _rotation_about(name, float(angle))
        if i == 2:
            elbow = at = lengths.upper_arm * rotation[:, 0]
        elif i == 4:
            at = elbow + lengths.forearm * rotation[:, 0]
    return elbow, at, rotation, axes


def _rotation_about(axis: str, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    if axis == "x":
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    if axis == "y":
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def human_arm_angles(upper: ArrayLike, forearm: ArrayLike, hand: ArrayLike, previous: ArrayLike | None = None) -> Array:
    """Return the seven joint angles of a person's arm in closed form, shape (7,) [rad].

    An angle that is undefined keeps its previous value. The first angle is undefined when the upper arm is along z. The
    third angle is undefined when the arm is straight. The fifth angle is undefined when the hand is in line with the
    forearm. Two sets of wrist angles give the same rotation of the hand. The function returns the set that is closer to
    the previous angles.

    Args:
        upper: unit vector from shoulder to elbow, shape (3,).
        forearm: unit vector from elbow to wrist, shape (3,).
        hand: rotation matrix of the hand, in the same frame as ``upper`` and ``forearm``, shape (3, 3).
        previous: joint angles in the previous camera frame, shape (7,) [rad]; None: zeros.

    Returns:
        The joint angles, shape (7,) [rad].
    """
    u, f = (np.asarray(v, dtype=float) for v in (upper, forearm))
    held = np.zeros(7) if previous is None else np.asarray(previous, dtype=float)
    q = np.empty(7)
    across = math.hypot(u[0], u[1])
    q[0] = math.atan2(u[1], u[0]) if across >= _SINGULAR else held[0]
    q[1] = math.atan2(-u[2], u[0] * math.cos(q[0]) + u[1] * math.sin(q[0]))
    upper_rotation = _rotation_about("z", q[0]) @ _rotation_about("y", q[1])
    fx, fy, fz = upper_rotation.T @ f
    bent = math.hypot(fy, fz)
    q[2] = math.atan2(fy, -fz) if bent >= _SINGULAR else held[2]
    q[3] = math.atan2(fy * math.sin(q[2]) - fz * math.cos(q[2]), fx)
    forearm_rotation = upper_rotation @ _rotation_about("x", q[2]) @ _rotation_about("y", q[3])
    wrist = forearm_rotation.T @ np.asarray(hand, dtype=float)
    q[4:] = _wrist_angles(wrist, held[4:])
    return q


def _wrist_angles(rotation: Array, held: Array) -> Array:
    """Return the angles (a, b, c) with Rx(a) Ry(b) Rx(c) = rotation that are closest to ``held``."""
    sine = math.hypot(rotation[1, 0], rotation[2, 0])
    if sine < _SINGULAR:  # only the sum of the two angles about the forearm is defined
        rest = _rotation_about("x", -held[0]) @ rotation
        bend = math.atan2(-rest[2, 0], rest[0, 0])
        return np.array([held[0], bend, math.atan2(-rest[1, 2], rest[1, 1])])
    branches = [
        np.array(
            [
                math.atan2(s * rotation[1, 0], -s * rotation[2, 0]),
                math.atan2(s * sine, rotation[0, 0]),
                math.atan2(s * rotation[0, 1], s * rotation[0, 2]),
            ]
        )
        for s in (1.0, -1.0)
    ]
    return min(branches, key=lambda angles: float(np.abs(_wrapped(angles - held)).sum()))


def _wrapped(angles: Array) -> Array:
    return np.asarray((angles + math.pi) % (2.0 * math.pi) - math.pi)


def hand_rotation(wrist: Array, tip: Array, thumb: Array) -> Array | None:
    r"""Return the hand's rotation from wrist, tip and thumb; None when these points do not determine it.

    The positions of shoulder, elbow and wrist do not show how the forearm is rotated about its axis or how the wrist is
    bent. Let W be the wrist, and let a bar denote a vector scaled to length 1. With :math:`x = \overline{tip - W}` and
    :math:`n = \overline{x \times (thumb - W)}`, the rotation matrix is :math:`[x,\; n \times x,\; n]`.

    Args:
        wrist: wrist position, shape (3,) [m].
        tip: position of the hand's tip, shape (3,) [m].
        thumb: position of the thumb's tip, shape (3,) [m].

    Returns:
        Rotation matrix, shape (3, 3); None if the angle between hand and thumb is less than 12 degrees, or if tip or
        thumb is too close to the wrist.
    """
    # plain floats: for nine numbers three times as fast as NumPy
    x0, x1, x2 = (tip - wrist).tolist()
    y0, y1, y2 = (thumb - wrist).tolist()
    long, wide = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2), math.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    if not (long > _HAND_LENGTH and wide > 0.5 * _HAND_LENGTH):  # nan too
        return None
    x0, x1, x2, y0, y1, y2 = x0 / long, x1 / long, x2 / long, y0 / wide, y1 / wide, y2 / wide
    n0, n1, n2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    sine = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if sine < _APART:
        return None
    n0, n1, n2 = n0 / sine, n1 / sine, n2 / sine
    return np.array([[x0, n1 * x2 - n2 * x1, n0], [x1, n2 * x0 - n0 * x2, n1], [x2, n0 * x1 - n1 * x0, n2]])


def carried(rotation: Array | None, before: Array | None, after: Array) -> Array:
    """Estimate the rotation of a hidden hand, assuming that the hand has turned with the forearm.

    Args:
        rotation: previous rotation of the hand, shape (3, 3); None: unknown. The function then assumes that the hand's
            x axis is along the forearm and its y axis is horizontal.
        before: unit vector along the forearm when the hand had this rotation, shape (3,).
        after: unit vector along the forearm now, shape (3,).

    Returns:
        The new rotation matrix of the hand, shape (3, 3): the smallest rotation from ``before`` to ``after``, applied
        to ``rotation``.
    """
    if rotation is None or before is None:
        side = _cross(np.array([0.0, 0.0, 1.0]), after)
        length = math.sqrt(float(side.dot(side)))
        y = side / length if length > _SINGULAR else np.array([0.0, 1.0, 0.0])
        y = y - after * float(y.dot(after))
        y /= math.sqrt(float(y.dot(y)))
        return np.stack([after, y, _cross(after, y)], axis=1)
    axis, cosine = _cross(before, after), float(before.dot(after))
    if cosine < -0.999:  # reversed: the smallest rotation is undefined; keep the old one
        return rotation
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotated: Array = rotation + (k + (k @ k) / (1.0 + cosine)) @ rotation
    return rotated


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors (3,), faster than np.cross."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
