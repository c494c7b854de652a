r"""Kinematics and dynamics of a chain of joints in many postures at once, as arrays.

Joint j rotates all links after it, towards the tool, about its axis. In the reference posture, this axis has the
direction of the unit vector :math:`a_j` and passes through the point :math:`o_j`. Let c be a point of a link that the
first k joints move. In another posture, the point is at

.. math:: T_k\, c, \qquad T_k = E_1(\theta_1) \cdots E_k(\theta_k), \qquad
          E_j(\theta)\, x = o_j + \exp(\theta\,[a_j]_\times)(x - o_j)

where :math:`\theta_j` is the joint position minus its value in the reference posture (product of exponentials). For a
prismatic joint, :math:`E_j(\theta)\,x = x + \theta a_j`. The torques follow from the recursive Newton-Euler algorithm,
with all spatial vectors about the origin of the base frame.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.spheres import SphereCover

Array = NDArray[np.float64]


class Placed(NamedTuple):
    """A chain in n postures.

    Attributes:
        axes: unit vectors along the axes of the joints in the base frame, shape (n, n_joints, 3).
        anchors: a point on the axis of each joint in the base frame, shape (n, n_joints, 3) [m].
        rotations: rotation matrix of the base and of the link that each joint moves, relative to the reference posture,
            shape (n, n_joints + 1, 3, 3).
        shifts: displacement of the base and of each link, added after the rotation, shape (n, n_joints + 1, 3) [m].
    """

    axes: Array
    anchors: Array
    rotations: Array
    shifts: Array


class JointChain:
    """The joints of an arm, the spheres that cover its links, and the masses of its links, in a reference posture.

    Args:
        model: the arm; its other joints, if it has any, stay in their reference posture.
        data: kinematics of the model in the reference posture.
        cover: spheres that cover the arm.
        reference: reference posture of the arm's joints, shape (n_joints,) [rad].
        tool: index of the site at the tip of the tool.

    Attributes:
        slides: True for prismatic joints, shape (n_joints,).
        middles: for each link, a point in the middle of its spheres in the reference posture, shape (n_joints, 3) [m].
        extents: for each link, the largest distance from this point to the centre of a sphere, shape (n_joints,) [m].
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, cover: SphereCover, reference: Array, tool: int
    ) -> None:
        self._reference, self.slides = reference.copy(), cover.slides
        self._axes, self._anchors = data.xaxis[cover.joints].copy(), data.xanchor[cover.joints].copy()
        x, y, z = self._axes.T
        zero = np.zeros_like(x)
        turn = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
        turn[self.slides] = 0.0
        self._turn, self._turn_twice = turn, turn @ turn
        self._tip, self._tip_rotation = data.site_xpos[tool].copy(), data.site_xmat[tool].reshape(3, 3).copy()
        centers = cover.centers(data)
        links = range(1, len(reference) + 1)
        parts = [(k, np.flatnonzero(cover.links == k)) for k in links]
        self._spheres = [(k, _slice(of), np.ascontiguousarray(centers[of].T)) for k, of in parts if len(of)]
        self._n_spheres = len(centers)
        self.middles, self.extents = self._anchors.copy(), np.zeros(len(links))
        for k, of in parts:
            if len(of):
                self.middles[k - 1] = 0.5 * (centers[of].min(axis=0) + centers[of].max(axis=0))
                self.extents[k - 1] = np.linalg.norm(centers[of] - self.middles[k - 1], axis=1).max()
        self._bodies(model, data, cover)

    def _bodies(self, model: mujoco.MjModel, data: mujoco.MjData, cover: SphereCover) -> None:
        """Add up the mass, first moment and inertia of each link's bodies, about the origin of the base."""
        n = len(self._reference)
        self._mass, self._moment, self._inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
        carriers = cover.carriers.tolist()
        for body in range(1, model.nbody):
            link, above = -1, body
            while above > 0 and link < 0:
                if above in carriers:
                    link = len(carriers) - 1 - carriers[::-1].index(above)  # two joints of one body: the second
                above = int(model.body_parentid[above])
            if link < 0:
                continue
            mass, at, axes = model.body_mass[body], data.xipos[body], data.ximat[body].reshape(3, 3)
            own = axes @ np.diag(model.body_inertia[body]) @ axes.T
            self._mass[link] += mass
            self._moment[link] += mass * at
            self._inertia[link] += own + mass * (at @ at * np.eye(3) - np.outer(at, at))
        self._gravity = np.array(model.opt.gravity)

    def placed(self, joints: Array) -> Placed:
        """Compute the positions and rotations of the joints and links in many postures.

        Args:
            joints: joint positions, shape (n, n_joints) [rad].
        """
        angles = joints - self._reference
        n, n_joints = angles.shape
        sine, cosine = np.sin(angles)[:, :, None, None], 1.0 - np.cos(angles)[:, :, None, None]
        turns = np.eye(3) + sine * self._turn + cosine * self._turn_twice
        steps = self._anchors - (turns @ self._anchors[:, :, None])[..., 0]
        if self.slides.any():
            steps[:, self.slides] = angles[:, self.slides, None] * self._axes[self.slides]
        rotations, shifts = np.empty((n, n_joints + 1, 3, 3)), np.empty((n, n_joints + 1, 3))
        rotations[:, 0], shifts[:, 0] = np.eye(3), 0.0
        for j in range(n_joints):
            now = rotations[:, j]
            np.matmul(now, turns[:, j], out=rotations[:, j + 1])
            shifts[:, j + 1] = np.matmul(now, steps[:, j, :, None])[..., 0] + shifts[:, j]
        axes = (rotations[:, :-1] @ self._axes[:, :, None])[..., 0]
        anchors = (rotations[:, :-1] @ self._anchors[:, :, None])[..., 0] + shifts[:, :-1]
        return Placed(axes, anchors, rotations, shifts)

    def tips(self, placed: Placed) -> tuple[Array, Array]:
        """Return the positions (n, 3) [m] of the tool's tip and its rotation matrices tool_to_base (n, 3, 3)."""
        last = placed.rotations[:, -1]
        return last @ self._tip + placed.shifts[:, -1], last @ self._tip_rotation

    def spheres(self, placed: Placed) -> Array:
        """Return the centres of the spheres that cover the moving links and the tool, shape (n, m, 3) [m]."""
        n = len(placed.shifts)
        out = np.empty((n, self._n_spheres, 3))
        for link, of, centers in self._spheres:
            turned = np.dot(np.ascontiguousarray(placed.rotations[:, link]).reshape(-1, 3), centers)
            turned = turned.reshape(n, 3, -1) + placed.shifts[:, link, :, None]
            out[:, of] = turned.transpose(0, 2, 1)
        return out

    def reaches(self, placed: Placed) -> Array:
        """Return bounds of the distance from the axis of each joint to the spheres of each link that it moves.

        Returns:
            Bounds, shape (n, n_joints, n_joints) [m]; the second axis is the link, the third the joint. The joints 0 to
            k move the link k. The value is 1 for a prismatic joint, which moves every point by the same amount, and 0
            for a joint that does not move the link.
        """
        middles = (placed.rotations[:, 1:] @ self.middles[:, :, None])[..., 0] + placed.shifts[:, 1:]
        away = middles[:, :, None] - placed.anchors[:, None]
        reaches = np.sqrt(np.einsum("nkji,nkji->nkj", away, away)) + self.extents[:, None]
        reaches[:, :, self.slides] = 1.0
        return np.tril(reaches)

    def torques(self, placed: Placed, velocity: Array, acceleration: Array) -> Array:
        """Return the joint torques of motions, including gravity, shape (..., n, n_joints) [N m].

        Args:
            placed: the chain in n postures.
            velocity: joint velocities, shape (..., n, n_joints) [rad/s].
            acceleration: joint accelerations, shape (..., n, n_joints) [rad/s^2].
        """
        axes, n_joints = placed.axes, placed.axes.shape[1]
        linear = cross(placed.anchors, axes)
        angular = axes
        if self.slides.any():
            linear, angular = linear.copy(), angular.copy()
            linear[:, self.slides], angular[:, self.slides] = axes[:, self.slides], 0.0
        shape = (*velocity.shape[:-1], 3)
        spin, speed = np.zeros(shape), np.zeros(shape)  # of each link in turn, at the origin of the base
        turning, pull = np.zeros(shape), np.broadcast_to(-self._gravity, shape)
        moments, forces = np.empty((n_joints, *shape)), np.empty((n_joints, *shape))
        for j in range(n_joints):
            v, a = velocity[..., j, None], acceleration[..., j, None]
            w, u = angular[:, j] * v, linear[:, j] * v
            turning = turning + angular[:, j] * a + cross(spin, w)
            pull = pull + linear[:, j] * a + cross(spin, u) + cross(speed, w)
            spin, speed = spin + w, speed + u
            rotation, shift, mass = placed.rotations[:, j + 1], placed.shifts[:, j + 1], self._mass[j]
            moved = rotation @ self._moment[j]
            moment = moved + mass * shift
            inertia = rotation @ self._inertia[j] @ np.swapaxes(rotation, 1, 2)
            inertia = inertia + _shifted(moved, shift) + mass * _square(shift)
            force = mass * pull + cross(turning, moment)
            torque = np.einsum("nij,...nj->...ni", inertia, turning) + cross(moment, pull)
            momentum = mass * speed + cross(spin, moment)
            spinning = np.einsum("nij,...nj->...ni", inertia, spin) + cross(moment, speed)
            forces[j] = force + cross(spin, momentum)
            moments[j] = torque + cross(spin, spinning) + cross(speed, momentum)
        out = np.empty(velocity.shape)
        force, torque = np.zeros(shape), np.zeros(shape)
        for j in range(n_joints - 1, -1, -1):
            force, torque = force + forces[j], torque + moments[j]
            out[..., j] = np.einsum("ni,...ni->...n", angular[:, j], torque)
            out[..., j] += np.einsum("ni,...ni->...n", linear[:, j], force)
        return out


def cross(a: Array, b: Array) -> Array:
    """Return cross products over the last axis; faster than np.cross for small arrays."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    x, y, z = (a[..., i] for i in range(3))
    u, v, w = (b[..., i] for i in range(3))
    out[..., 0], out[..., 1], out[..., 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return out


def _square(points: Array) -> Array:
    """Return ``|p|^2 - p p^T`` of each point (n, 3): the inertia of a unit mass, shape (n, 3, 3)."""
    squares = np.einsum("ni,ni->n", points, points)[:, None, None] * np.eye(3)
    return np.asarray(squares - points[:, :, None] * points[:, None, :])


def _shifted(moments: Array, shifts: Array) -> Array:
    """Return how first moments (n, 3) change an inertia that is shifted by ``shifts`` (n, 3), shape (n, 3, 3)."""
    both = 2.0 * np.einsum("ni,ni->n", moments, shifts)[:, None, None] * np.eye(3)
    outer = moments[:, :, None] * shifts[:, None, :]
    return np.asarray(both - outer - np.swapaxes(outer, 1, 2))


def _slice(index: NDArray[np.intp]) -> slice | NDArray[np.intp]:
    """Return consecutive indices as a slice; return other indices unchanged."""
    if index[-1] - index[0] + 1 == len(index):
        return slice(int(index[0]), int(index[-1]) + 1)
    return index
