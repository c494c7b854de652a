"""Positions and rotations: quaternions (w, x, y, z) as arrays, and the class :class:`Pose`.

All functions accept arrays with any number of leading dimensions, and process all their elements at once. The functions
do not check their arguments, but :class:`Pose` checks them. A single rotation is computed with plain floats, because a
control step computes many rotations and floats are faster than a numpy array of four numbers.

Rotation vectors (axis times angle) are in rad. Twists have shape (6,): linear velocity [m/s] first, then angular
velocity [rad/s], both in the base frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.validation import finite_array, finite_vector, instance, real_array

Array = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-3  # how far from length one a quaternion may be and still be taken as one
_SMALL_ANGLE = 1e-7  # [rad] below this the series of sin(a)/a is exact to double precision


def quaternion_multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Return the Hamilton product ``p q``: rotate by ``q`` first, then by ``p``.

    Args:
        p: quaternions wxyz, shape (..., 4).
        q: quaternions wxyz, shape (..., 4).

    Returns:
        Quaternions wxyz, shape (..., 4).
    """
    first, second = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    single = first.ndim == second.ndim == 1
    pw, px, py, pz = first.tolist() if single else np.moveaxis(first, -1, 0)
    qw, qx, qy, qz = second.tolist() if single else np.moveaxis(second, -1, 0)
    product = [
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    ]
    return np.array(product) if single else np.stack(product, axis=-1)


def quaternion_conjugate(q: ArrayLike) -> Array:
    """Return the inverse rotation of unit quaternions wxyz, shape (..., 4)."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


def quaternion_exp(rotation_vector: ArrayLike) -> Array:
    """Return unit quaternions wxyz (..., 4) of rotation vectors (..., 3) [rad]."""
    v = np.asarray(rotation_vector, dtype=float)
    if v.ndim == 1:
        x, y, z = v.tolist()
        a = 0.5 * math.sqrt(x * x + y * y + z * z)
        factor = 0.5 * math.sin(a) / a if a > _SMALL_ANGLE else 0.5
        return np.array([math.cos(a), factor * x, factor * y, factor * z])
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * v], axis=-1)


def quaternion_log(q: ArrayLike) -> Array:
    """Return rotation vectors (..., 3) [rad], length at most pi, of unit quaternions wxyz (..., 4)."""
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        w, x, y, z = q.tolist()
        s = math.sqrt(x * x + y * y + z * z)
        factor = 2.0 * math.atan2(s, abs(w)) / s if s > _SMALL_ANGLE else 2.0
        factor = factor if w >= 0.0 else -factor
        return np.array([factor * x, factor * y, factor * z])
    q = np.where(q[..., :1] < 0.0, -q, q)  # q and -q are the same rotation: take the shorter arc
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    scale = np.where(sine > _SMALL_ANGLE, angle / np.maximum(sine, _SMALL_ANGLE), 2.0)
    return np.asarray(scale * q[..., 1:])


def quaternion_to_matrix(q: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4)."""
    q = np.asarray(q, dtype=float)
    w, x, y, z = q.tolist() if q.ndim == 1 else q.reshape(-1, 4).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows) if q.ndim == 1 else np.array(rows).transpose(2, 0, 1).reshape(*q.shape[:-1], 3, 3)


def matrix_to_quaternion(matrix: ArrayLike) -> Array:
    """Return unit quaternions wxyz (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    The function uses the largest column of the 4x4 matrix ``4 q q^T`` and is therefore well conditioned at every angle.
    The usual trace formula loses all digits near 180 degrees.
    """
    m = np.asarray(matrix, dtype=float)
    if m.ndim == 2:
        return _largest_column(m)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    columns = np.stack(
        [
            np.stack([1 + m00 + m11 + m22, wx, wy, wz], axis=-1),
            np.stack([wx, 1 + m00 - m11 - m22, xy, xz], axis=-1),
            np.stack([wy, xy, 1 - m00 + m11 - m22, yz], axis=-1),
            np.stack([wz, xz, yz, 1 - m00 - m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(columns, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(columns, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0.0, -q, q)


def _largest_column(m: Array) -> Array:
    """Convert one matrix (3, 3) as :func:`matrix_to_quaternion` does."""
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    diagonal = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    best = diagonal.index(max(diagonal))
    q = (
        (diagonal[0], h - f, c - g, d - b),
        (h - f, diagonal[1], b + d, c + g),
        (c - g, b + d, diagonal[2], f + h),
        (d - b, c + g, f + h, diagonal[3]),
    )[best]
    length = math.copysign(math.sqrt(sum(x * x for x in q)), q[0])
    return np.array(q) / length


def rotate(q: ArrayLike, vectors: ArrayLike) -> Array:
    """Rotate ``vectors`` (..., 3) by unit quaternions wxyz ``q`` (..., 4)."""
    q, v = np.asarray(q, dtype=float), np.asarray(vectors, dtype=float)
    if q.ndim == v.ndim == 1:
        w, x, y, z = q.tolist()
        a, b, c = v.tolist()
        d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
        return np.array([a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d])
    t = 2.0 * np.cross(q[..., 1:], v)
    return np.asarray(v + q[..., :1] * t + np.cross(q[..., 1:], t))


def continuous_signs(quaternions: ArrayLike) -> Array:
    """Flip the signs of quaternions so that each quaternion is nearer to the previous one than its negative is.

    Args:
        quaternions: unit quaternions wxyz in time order, shape (n, 4).

    Returns:
        The same rotations with continuous signs, shape (n, 4).
    """
    q = np.asarray(quaternions, dtype=float)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(flips)])[: len(q), None])


def slerp(times: ArrayLike, key_times: ArrayLike, key_quaternions: ArrayLike) -> Array:
    """Interpolate between successive key rotations along the shortest arc.

    Args:
        times: query times [s], shape (n,). Before the first key time, the result is the first key rotation. After the
            last key time, the result is the last key rotation.
        key_times: strictly increasing times [s], shape (k,).
        key_quaternions: unit quaternions wxyz, shape (k, 4).

    Returns:
        Unit quaternions wxyz, shape (n, 4).
    """
    keys = np.asarray(key_times, dtype=float)
    q = continuous_signs(key_quaternions)
    if len(keys) == 1:
        return np.repeat(q, len(np.atleast_1d(np.asarray(times))), axis=0)
    t = np.clip(np.asarray(times, dtype=float), keys[0], keys[-1])
    i = np.clip(np.searchsorted(keys, t, side="right") - 1, 0, len(keys) - 2)
    u = ((t - keys[i]) / (keys[i + 1] - keys[i]))[:, None]
    step = quaternion_log(quaternion_multiply(quaternion_conjugate(q[i]), q[i + 1]))
    return continuous_signs(quaternion_multiply(q[i], quaternion_exp(u * step)))


def mean_quaternion(quaternions: ArrayLike) -> Array:
    """Return the rotation (4,) wxyz that is nearest to all ``quaternions`` (n, 4), whose signs do not matter.

    This rotation is the eigenvector of the largest eigenvalue of ``sum q q^T`` (Markley et al. 2007).
    """
    q = np.asarray(quaternions, dtype=float).reshape(-1, 4)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean if mean[0] >= 0.0 else -mean)


def checked_unit_quaternions(quaternions: ArrayLike, what: str) -> Array:
    """Return ``quaternions`` (..., 4) scaled to length one; raise an error if a length is not within 1e-3 of one.

    Args:
        quaternions: quaternions wxyz, shape (..., 4).
        what: the name of the argument in messages.

    Raises:
        InputError: if the shape is wrong, or a length differs from one by more than 1e-3.
    """
    q = real_array(quaternions, (..., None), what)
    if q.shape[-1] != 4:
        raise InputError(f"{what}: quaternions need 4 columns (w, x, y, z), got shape {q.shape}")
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    bad = ~(np.abs(length[..., 0] - 1.0) <= _UNIT_TOLERANCE)
    if np.any(bad):
        first = np.flatnonzero(np.atleast_1d(bad))[0]
        raise InputError(
            f"{what}: quaternion {first} has length {np.ravel(length)[first]:.4g}, not 1; normalise it first"
        )
    return np.asarray(q / length)


@dataclass(frozen=True, eq=False)
class Pose:
    """A position and a rotation: the pose of one frame relative to another.

    The name of a pose names both frames: ``tool_to_base`` maps tool coordinates to base coordinates,
    ``p_base = R p_tool + position``.

    Attributes:
        position: shape (3,) [m].
        quaternion: unit quaternion w, x, y, z, shape (4,).

    Raises:
        InputError: if a shape is wrong, a number is not finite or the length of the quaternion is not one.
    """

    position: Array
    quaternion: Array

    def __post_init__(self) -> None:
        position = np.array(finite_vector(self.position, 3, "Pose: position", "m"))
        quaternion = finite_vector(self.quaternion, 4, "Pose: quaternion", "w x y z")
        w, x, y, z = quaternion.tolist()
        length = math.sqrt(w * w + x * x + y * y + z * z)
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise InputError(
                f"Pose: quaternion {quaternion.tolist()} has length {length:.4g}, not 1; normalise it first"
            )
        quaternion = quaternion / length
        position.setflags(write=False)
        quaternion.setflags(write=False)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "quaternion", quaternion)

    @classmethod
    def trusted(cls, position: Array, quaternion: Array) -> Pose:
        """Build a pose without checks, to save time in control steps; the caller must not use the arrays afterwards.

        Args:
            position: shape (3,) [m]; the call makes this array read-only.
            quaternion: unit quaternion wxyz, shape (4,); the call makes this array read-only.
        """
        pose = object.__new__(cls)
        position.setflags(write=False)
        quaternion.setflags(write=False)
        object.__setattr__(pose, "position", position)
        object.__setattr__(pose, "quaternion", quaternion)
        return pose

    @classmethod
    def identity(cls) -> Pose:
        """Return the identity: no displacement and no rotation."""
        return cls(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Build from a homogeneous transform, shape (4, 4).

        Raises:
            InputError: if the matrix is not a rotation and a displacement, for example because it mirrors, scales or
                shears.
        """
        m = finite_array(matrix, (4, 4), "matrix")
        rotation = m[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _UNIT_TOLERANCE or np.linalg.det(rotation) < 0.0:
            raise InputError("matrix: its upper left 3 x 3 is not a rotation (orthonormal, determinant 1)")
        if np.abs(m[3] - [0.0, 0.0, 0.0, 1.0]).max() > _UNIT_TOLERANCE:
            raise InputError(f"matrix: its last row must be 0 0 0 1, got {m[3].tolist()}")
        return cls(m[:3, 3], matrix_to_quaternion(rotation))

    @property
    def rotation(self) -> Array:
        """Rotation matrix, shape (3, 3)."""
        return quaternion_to_matrix(self.quaternion)

    @property
    def matrix(self) -> Array:
        """Homogeneous transform, shape (4, 4)."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.position
        return m

    def inverse(self) -> Pose:
        """Return the inverse pose: ``tool_to_base.inverse()`` is ``base_to_tool``."""
        back = quaternion_conjugate(self.quaternion)
        return Pose.trusted(-rotate(back, self.position), back)

    def __matmul__(self, other: Pose) -> Pose:
        """Chain two poses: ``b_to_a @ c_to_b`` is ``c_to_a``."""
        instance(other, Pose, "the right operand of @")
        q = quaternion_multiply(self.quaternion, other.quaternion)
        return Pose(self.position + rotate(self.quaternion, other.position), q)

    def apply(self, points: ArrayLike) -> Array:
        """Transform ``points``, shape (..., 3) [m], with this pose: ``R p + position``."""
        given = finite_array(points, (..., 3), "points", "m")
        return np.asarray(given @ self.rotation.T + self.position)

    def error_to(self, target: Pose) -> Array:
        r"""Return the translation and rotation from this pose to ``target``, in their common frame, shape (6,).

        The linear part is :math:`p_{target} - p` [m], the angular part :math:`\log(R_{target} R^T)` [rad] (Lynch and
        Park, Modern Robotics, 2017, section 3.2.3).
        """
        instance(target, Pose, "target")
        (a, b, c, d), (w, x, y, z) = target.quaternion.tolist(), self.quaternion.tolist()
        real = a * w + b * x + c * y + d * z
        u, v, r = b * w - a * x + d * y - c * z, c * w - a * y + b * z - d * x, d * w - a * z + c * x - b * y
        sine = math.sqrt(u * u + v * v + r * r)
        factor = 2.0 * math.atan2(sine, abs(real)) / sine if sine > _SMALL_ANGLE else 2.0
        factor = factor if real >= 0.0 else -factor
        (px, py, pz), (qx, qy, qz) = target.position.tolist(), self.position.tolist()
        return np.array([px - qx, py - qy, pz - qz, factor * u, factor * v, factor * r])
