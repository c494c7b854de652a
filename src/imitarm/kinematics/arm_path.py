"""ArmPath: the kinematics of an arm along a joint path, as arrays; track: a joint path for given poses of the tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH
from imitarm.kinematics.joint_chain import Placed, cross
from imitarm.kinematics.pose import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]

REACHED = 1e-6  # [m, rad] error of a pose that counts as reached
_TRACKED = 1e-4  # [m, rad] error of a tracked pose
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
        placed: positions and rotations of the joints and links, from ``JointChain.placed``.
    """

    arm: ArmModel
    joints: Array
    positions: Array
    quaternions: Array
    placed: Placed

    @classmethod
    def of(cls, arm: ArmModel, joints: Array) -> ArmPath:
        """Compute the kinematics of every posture.

        Args:
            arm: the arm with its tool.
            joints: joint positions, shape (n, n_joints) [rad].
        """
        placed = arm.chain.placed(joints)
        tips, rotations = arm.chain.tips(placed)
        return cls(arm, joints, tips, matrix_to_quaternion(rotations), placed)

    @cached_property
    def centers(self) -> Array:
        """Centres of the spheres that cover the moving links and the tool (``ArmModel.cover``), (n, m, 3) [m]."""
        return self.arm.chain.spheres(self.placed)

    @property
    def axes(self) -> Array:
        """Unit vectors along the axes of the joints in the base frame, shape (n, n_joints, 3)."""
        return self.placed.axes

    @property
    def anchors(self) -> Array:
        """A point on the axis of each joint in the base frame, shape (n, n_joints, 3) [m]."""
        return self.placed.anchors

    def __len__(self) -> int:
        return len(self.joints)

    def tool_jacobians(self) -> Array:
        """Return the Jacobian of the tool's tip in each posture, linear rows first, shape (n, 6, n_joints)."""
        jacobians = np.empty((len(self), 6, self.joints.shape[1]))
        jacobians[:, :3] = np.swapaxes(cross(self.axes, self.positions[:, None] - self.anchors), 1, 2)
        jacobians[:, 3:] = np.swapaxes(self.axes, 1, 2)
        slides = self.arm.cover.slides
        if slides.any():
            jacobians[:, :3, slides] = np.swapaxes(self.axes[:, slides], 1, 2)
            jacobians[:, 3:, slides] = 0.0
        return jacobians

    def speeds(self, velocity: Array) -> Array:
        """Return upper bounds of the speeds of each link's spheres, relative to the frame of each earlier link.

        Args:
            velocity: joint velocities, shape (n, n_joints) [rad/s].

        Returns:
            Bounds, shape (n, n_joints, n_joints) [m/s]. The second axis is the index of the link, which is the index of
            the last joint that moves the link. The third axis is the number of joints between the base and the frame.
        """
        parts = self._reaches * np.abs(velocity)[:, None]
        return np.asarray(np.cumsum(parts[..., ::-1], axis=2)[..., ::-1])

    @cached_property
    def travel(self) -> Array:
        """Upper bounds of the path length of each link's spheres from one posture to the next.

        Between two postures, each joint moves at constant speed. Between the two postures, a sphere may be farther from
        a joint's axis than in either posture. The additional distance is at most half of the path that the joints
        between axis and sphere cause.

        The shape is (n - 1, n_joints, n_joints) [m]; :meth:`speeds` describes the second and the third axis.
        """
        steps = np.abs(np.diff(self.joints, axis=0))
        travel = np.maximum(self._reaches[:-1], self._reaches[1:])
        way = np.zeros(travel.shape[:2])
        for j in range(travel.shape[2] - 1, -1, -1):
            moves = slice(j, None)  # the links behind the joint
            way[:, moves] += steps[:, j, None] * (travel[:, moves, j] + 0.5 * way[:, moves])
            travel[:, :, j] = way
        return travel

    @cached_property
    def _reaches(self) -> Array:
        return self.arm.chain.reaches(self.placed)

    def sphere_speeds(self, sample: Index, sphere: Index, directions: Array) -> Array:
        """Return the speed of each sphere along its direction, per unit of each joint's speed, (k, n_joints) [m/rad].

        Args:
            sample: index of the posture, shape (k,).
            sphere: index of the sphere, shape (k,).
            directions: unit vectors in the base frame, shape (k, 3).
        """
        axes = self.axes[sample]
        arms = self.centers[sample, sphere][:, None] - self.anchors[sample]
        speeds = np.einsum("kji,ki->kj", cross(axes, arms), directions)
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
        across = cross(self.axes[sample], arms)
        radii = np.sqrt(np.einsum("kji,kji->kj", across, across))
        slides = self.arm.cover.slides
        if slides.any():
            radii[:, slides] = 1.0
        return radii * self.arm.cover.moves[sphere]

    def errors_to(self, positions: Array, quaternions: Array) -> Array:
        """Return the displacement and the rotation vector from the tool to each pose, shape (n, 6) [m, rad].

        Args:
            positions: positions of the tool's tip, shape (n, 3) [m].
            quaternions: rotations tool_to_base, wxyz, shape (n, 4).
        """
        rotation = quaternion_log(quaternion_multiply(quaternions, quaternion_conjugate(self.quaternions)))
        return np.concatenate([positions - self.positions, rotation], axis=1)

    def moved_to(self, positions: Array, quaternions: Array) -> tuple[ArmPath, float]:
        """Change each posture as little as possible so that the tool reaches a given pose (Newton's method).

        Args:
            positions: positions of the tool's tip, shape (n, 3) [m].
            quaternions: rotations tool_to_base, wxyz, shape (n, 4).

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
    """Return damped right inverses (n, n_joints, 6) of Jacobians (n, 6, n_joints), with weighted rotations."""
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
        positions: positions of the tool's tip, shape (n, 3) [m].
        quaternions: rotations tool_to_base, wxyz, shape (n, 4).
        drift: posture that the arm gradually approaches by self-motion (joint motion that does not move the tool),
            shape (n_joints,) [rad]; None: no self-motion.

    Returns:
        Joint positions, shape (n, n_joints) [rad]. They bring the tool to within 0.1 mm and 0.1 mrad of each pose;
        :meth:`ArmPath.moved_to` removes the remaining error. If a pose is out of reach, the result is the posture that
        was found nearest to the pose.
    """
    site = arm.site("tool")
    joints, q = np.empty((len(positions), arm.n_joints)), np.array(start, dtype=float)
    weights, damping = _WEIGHTS[:, None], _DAMPING**2 * np.eye(6)
    error, rotation, back = np.empty(6), np.empty(4), np.empty(4)
    for i, (position, quaternion) in enumerate(zip(positions, quaternions, strict=True)):
        for attempt in range(_NEWTON_STEPS + 2):
            memory = arm.at(q)
            np.subtract(position, memory.data.site_xpos[site], out=error[:3])
            mujoco.mju_mat2Quat(back, memory.data.site_xmat[site])
            mujoco.mju_negQuat(back, back)
            mujoco.mju_mulQuat(rotation, quaternion, back)
            mujoco.mju_quat2Vel(error[3:], rotation, 1.0)
            pulled = drift is not None and attempt == 0 and i > 0
            if not pulled and np.abs(error).max() < _TRACKED:
                break
            weighted = weights * memory.site_jacobian(site)
            inverse = np.linalg.solve(weighted @ weighted.T + damping, weighted).T
            step = inverse @ (_WEIGHTS * error)
            if drift is not None and pulled:
                away = (drift - q) / (len(positions) - i)
                step = step + away - inverse @ (weighted @ away)
            q = q + step
        joints[i] = q
    return joints
