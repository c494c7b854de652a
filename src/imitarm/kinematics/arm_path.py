"""ArmPath: the kinematics of an arm along a joint path, as arrays; track: a joint path for given poses of the tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH
from imitarm.kinematics.pose import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]

REACHED = 1e-6  # [m, rad] error of a pose that counts as reached
_DAMPING = 1e-3  # [m/rad] of the inverses, near singular postures
_NEWTON_STEPS = 6
_LOST = 1.0  # [m, rad] an error beyond which Newton's method is given up
_WEIGHTS = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])


@dataclass(frozen=True, eq=False)
class ArmPath:
    """Kinematics of an arm in n postures.

    Attributes:
        arm: the arm with its tool.
        joints: joint positions, shape (n, n_joints) [rad].
        positions: positions of the tool's tip in the base frame, shape (n, 3) [m].
        quaternions: rotations tool_to_base, wxyz, shape (n, 4).
        centers: centres of the spheres that cover the moving links and the tool (``ArmModel.cover``), in the base
            frame, shape (n, m, 3) [m].
        axes: unit vectors along the axes of the joints in the base frame, shape (n, n_joints, 3).
        anchors: a point on the axis of each joint in the base frame, shape (n, n_joints, 3) [m].
        rotations: rotation matrices link_to_base, shape (n, n_joints + 1, 3, 3): first of the base, then, for each
            joint, of the link that the joint moves.
    """

    arm: ArmModel
    joints: Array
    positions: Array
    quaternions: Array
    centers: Array
    axes: Array
    anchors: Array
    rotations: Array

    @classmethod
    def of(cls, arm: ArmModel, joints: Array) -> ArmPath:
        """Compute the kinematics of every posture.

        Args:
            arm: the arm with its tool.
            joints: joint positions, shape (n, n_joints) [rad].
        """
        cover, site, n = arm.cover, arm.site("tool"), len(joints)
        data = arm.at(joints[0]).data
        rotations, origins = np.empty((n, *data.xmat.shape)), np.empty((n, *data.xpos.shape))
        axes, anchors = np.empty((n, *data.xaxis.shape)), np.empty((n, *data.xanchor.shape))
        tips, tip_rotations = np.empty((n, 3)), np.empty((n, 9))
        for i, q in enumerate(joints):
            data = arm.at(q).data
            rotations[i], origins[i] = data.xmat, data.xpos
            axes[i], anchors[i] = data.xaxis, data.xanchor
            tips[i], tip_rotations[i] = data.site_xpos[site], data.site_xmat[site]
        rotations = rotations.reshape(n, -1, 3, 3)
        base = np.broadcast_to(np.eye(3), (n, 1, 3, 3))
        return cls(
            arm,
            joints,
            tips,
            matrix_to_quaternion(tip_rotations.reshape(n, 3, 3)),
            cover.placed(rotations, origins),
            axes[:, cover.joints],
            anchors[:, cover.joints],
            np.concatenate([base, rotations[:, cover.carriers]], axis=1),
        )

    def __len__(self) -> int:
        return len(self.joints)

    def tool_jacobians(self) -> Array:
        """Return the Jacobian of the tool's tip in each posture, linear rows first, shape (n, 6, n_joints)."""
        jacobians = np.empty((len(self), 6, self.joints.shape[1]))
        jacobians[:, :3] = np.swapaxes(_cross(self.axes, self.positions[:, None] - self.anchors), 1, 2)
        jacobians[:, 3:] = np.swapaxes(self.axes, 1, 2)
        slides = self.arm.cover.slides
        if slides.any():
            jacobians[:, :3, slides] = np.swapaxes(self.axes[:, slides], 1, 2)
            jacobians[:, 3:, slides] = 0.0
        return jacobians

    def sphere_speeds(self, sample: Index, sphere: Index, directions: Array) -> Array:
        """Return each sphere's speed along its direction per unit speed of each joint, shape (k, n_joints) [m/rad].

        Args:
            sample: index of the posture, shape (k,).
            sphere: index of the sphere, shape (k,).
            directions: unit vectors in the base frame, shape (k, 3).
        """
        axes = self.axes[sample]
        arms = self.centers[sample, sphere][:, None] - self.anchors[sample]
        speeds = np.einsum("kji,ki->kj", _cross(axes, arms), directions)
        slides = self.arm.cover.slides
        if slides.any():
            speeds[:, slides] = np.einsum("kji,ki->kj", axes[:, slides], directions)
        return speeds * self.arm.cover.moves[sphere]

    def sphere_radii(self, sample: Index, sphere: Index) -> Array:
        """Return the distance of spheres' centres from the axis of each joint, shape (k, n_joints) [m].

        The value is 1 for a prismatic joint, which moves every point by the same amount, and 0 for a joint that does
        not move the sphere.

        Args:
            sample: index of the posture, shape (k,).
            sphere: index of the sphere, shape (k,).
        """
        arms = self.centers[sample, sphere][:, None] - self.anchors[sample]
        across = _cross(self.axes[sample], arms)
        radii = np.sqrt(np.einsum("kji,kji->kj", across, across))
        slides = self.arm.cover.slides
        if slides.any():
            radii[:, slides] = 1.0
        return radii * self.arm.cover.moves[sphere]

    def errors_to(self, positions: Array, quaternions: Array) -> Array:
        """Return the displacement and the rotation vector from the tool to each given pose, shape (n, 6) [m, rad].

        Args:
            positions: shape (n, 3) [m].
            quaternions: tool_to_base, shape (n, 4).
        """
        rotation = quaternion_log(quaternion_multiply(quaternions, quaternion_conjugate(self.quaternions)))
        return np.concatenate([positions - self.positions, rotation], axis=1)

    def moved_to(self, positions: Array, quaternions: Array) -> tuple[ArmPath, float]:
        """Move the joints of all postures so that the tool reaches given poses, with the least joint motion (Newton).

        Args:
            positions: shape (n, 3) [m].
            quaternions: tool_to_base, shape (n, 4).

        Returns:
            The moved path, and the largest remaining error over all coordinates of all poses [m, rad].
        """
        path = self
        for step in range(_NEWTON_STEPS + 1):
            errors = path.errors_to(positions, quaternions)
            worst = float(np.abs(errors).max())
            if not REACHED <= worst <= _LOST or step == _NEWTON_STEPS:
                break
            inverse = right_inverses(path.tool_jacobians())
            path = ArmPath.of(self.arm, path.joints + np.einsum("nji,ni->nj", inverse, errors))
        return path, worst


def right_inverses(jacobians: Array) -> Array:
    """Return damped right inverses (n, n_joints, 6) of Jacobians (n, 6, n_joints)."""
    weighted = _WEIGHTS[:, None] * jacobians
    transposed = np.swapaxes(weighted, 1, 2)
    squares = weighted @ transposed + _DAMPING**2 * np.eye(6)
    return np.asarray(np.swapaxes(np.linalg.solve(squares, weighted), 1, 2) * _WEIGHTS)


def self_motions(jacobians: Array) -> Array:
    """Return orthonormal joint motions that do not move the tool, shape (n, n_joints, n_joints - 6).

    The signs and the order of these motions change as little as possible from one posture to the next.

    Args:
        jacobians: Jacobians of the tool in consecutive postures, shape (n, 6, n_joints).
    """
    n_joints = jacobians.shape[2]
    if n_joints <= 6:
        return np.zeros((len(jacobians), n_joints, 0))
    if n_joints == 7:
        null = _null_vectors(jacobians)[:, :, None]
        signs = np.sign(np.einsum("nj,nj->n", null[1:, :, 0], null[:-1, :, 0]))
        null[1:] *= np.cumprod(np.where(signs == 0.0, 1.0, signs))[:, None, None]
        return null
    null = np.swapaxes(np.linalg.svd(jacobians)[2][:, 6:], 1, 2).copy()
    for i in range(1, len(null)):
        u, _, vt = np.linalg.svd(null[i].T @ null[i - 1])
        null[i] = null[i] @ (u @ vt)
    return null


def _null_vectors(jacobians: Array) -> Array:
    """Return the unit vectors (n, 7) that the Jacobians (n, 6, 7) map to zero: the last right singular vectors."""
    return np.asarray(np.linalg.svd(jacobians)[2][:, 6])


def track(arm: ArmModel, start: Array, positions: Array, quaternions: Array, drift: Array | None = None) -> Array:
    """Return joint positions for successive poses of the tool, each with the least motion from the previous posture.

    Args:
        arm: the arm with its tool.
        start: posture before the first pose, shape (n_joints,) [rad].
        positions: shape (n, 3) [m].
        quaternions: tool_to_base, shape (n, 4).
        drift: posture that the arm gradually approaches until the last pose, by joint motions that do not move the
            tool (self-motion), shape (n_joints,) [rad]; None: there is no self-motion.

    Returns:
        Shape (n, n_joints) [rad]. If a pose is out of reach, its posture is the nearest one that was found.
    """
    site = arm.site("tool")
    joints, q = np.empty((len(positions), arm.n_joints)), np.array(start, dtype=float)
    for i, (position, quaternion) in enumerate(zip(positions, quaternions, strict=True)):
        for attempt in range(_NEWTON_STEPS + 2):
            memory = arm.at(q)
            now = memory.site_pose(site)
            rotation = quaternion_log(quaternion_multiply(quaternion, quaternion_conjugate(now.quaternion)))
            error = np.concatenate([position - now.position, rotation])
            pulled = drift is not None and attempt == 0 and i > 0
            if np.abs(error).max() < REACHED and not pulled:
                break
            weighted = _WEIGHTS[:, None] * memory.site_jacobian(site)
            inverse = np.linalg.solve(weighted @ weighted.T + _DAMPING**2 * np.eye(6), weighted).T
            step = inverse @ (_WEIGHTS * error)
            if drift is not None and pulled:
                away = (drift - q) / (len(positions) - i)
                step = step + away - inverse @ (weighted @ away)
            q = q + step
        joints[i] = q
    return joints


def _cross(a: Array, b: Array) -> Array:
    """Return cross products over the last axis; faster than np.cross for small arrays."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    x, y, z = (a[..., i] for i in range(3))
    u, v, w = (b[..., i] for i in range(3))
    out[..., 0], out[..., 1], out[..., 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return out
