"""Cover the collision shapes of an arm with spheres, so that the whole arm can keep a clearance to obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COLLISION_GROUP = 3
"""Group of the geoms used for contact; geoms used only for drawing are in groups 0 to 2."""
_SPACING = 0.9  # distance of neighbouring spheres on a bar, in radii: they then exceed the bar by a tenth
_MOST_PIECES = 50  # of one bar
_SMALLEST_CELL = 0.025  # [m] smallest cell of a plate, however thin it is
_LONGEST_ROW = 4  # cells along the longest edge of a plate


class SphereCover:
    """Spheres that cover all moving collision shapes (group 3) of a model, and how joints move them.

    Attributes:
        bodies: name of the body that carries each sphere.
        radii: radii of the spheres, shape (m,) [m].
        links: number of joints between the base and each sphere, shape (m,).
        follows_last_joint: True for each sphere that moves rigidly with the flange, shape (m,).
        base_centers: centers of the spheres that cover the base, which never moves, shape (b, 3) [m].
        base_radii: radii of the base's spheres, shape (b,) [m].
        joints: index of each of the arm's joints in the model, shape (n_joints,).
        carriers: index of the body that each joint moves, shape (n_joints,).
        slides: True for prismatic joints, shape (n_joints,).
        moves: 1.0 where a joint moves a sphere, else 0.0, shape (m, n_joints).
        dofs: index of each joint's velocity in the model, shape (n_joints,).
        owners: index of the body that carries each sphere, shape (m,).
        local: centers of the spheres in the frames of these bodies, shape (m, 3) [m].
        root: index of the arm's root body. MuJoCo gives the twists of the joints about the centre of mass of this body
            and all bodies that it carries.
    """

    def __init__(self, model: mujoco.MjModel, working: mujoco.MjModel, names: Sequence[str]) -> None:
        """Cover the shapes of a model with spheres.

        Args:
            model: model with all shapes.
            working: model with the same bodies; the other methods take ``MjData`` of this model.
            names: names of the joints to which the columns of the Jacobians belong.
        """
        joints = np.array([model.joint(name).id for name in names])
        owners: list[int] = []
        centers, radii = [np.zeros((0, 3))], [np.zeros(0)]
        base_centers, base_radii = [np.zeros((0, 3))], [np.zeros(0)]
        at_rest = mujoco.MjData(model)
        mujoco.mj_kinematics(model, at_rest)
        for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP):
            body = int(model.geom_bodyid[geom])
            points, radius = covering_spheres(model, int(geom))
            if model.body_weldid[body] == 0:  # the base never moves
                base_centers.append(points @ at_rest.xmat[body].reshape(3, 3).T + at_rest.xpos[body])
                base_radii.append(np.full(len(points), radius))
            else:
                centers.append(points)
                radii.append(np.full(len(points), radius))
                owners += [body] * len(points)
        self.base_centers, self.base_radii = np.concatenate(base_centers), np.concatenate(base_radii)
        self.bodies = tuple(model.body(body).name for body in owners)
        self.radii = np.concatenate(radii)
        self.radii.setflags(write=False)
        self.joints, self.owners = np.array([working.joint(name).id for name in names]), np.array(owners, dtype=int)
        self.local = np.concatenate(centers)
        self._centers = self.local[:, :, None]
        self.slides = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE
        self._any_slides = bool(self.slides.any())
        moves = [[_carries(model, int(model.jnt_bodyid[joint]), body) for joint in joints] for body in owners]
        self._moves = np.array(moves, dtype=float).reshape(len(owners), 1, len(joints))
        self._moves_of_all = np.concatenate([self._moves[:, 0], np.zeros((len(self.base_radii), len(joints)))])
        # one product gives every local center in every body's rotation; the right ones are picked out of it
        self._columns = np.ascontiguousarray(self._centers[:, :, 0].T)
        rows = 3 * self.owners[:, None] + np.arange(3)
        self._picked = rows * len(owners) + np.arange(len(owners))[:, None]
        self.moves = self._moves[:, 0]
        self.moves.setflags(write=False)
        self.carriers = working.jnt_bodyid[self.joints].astype(int)
        self.root = int(model.body_rootid[model.jnt_bodyid[joints[0]]])
        self.dofs = working.jnt_dofadr[self.joints]
        self._moved = self._moves[:, 0].copy()
        self.links = self._moves[:, 0].sum(axis=1).astype(int)
        self.follows_last_joint = self._moves[:, 0, -1] > 0.0

    def centers(self, data: mujoco.MjData) -> Array:
        """Return the centers of the spheres in the base frame, shape (m, 3) [m].

        Args:
            data: the kinematics of a posture.
        """
        turned = (data.xmat.reshape(-1, 3) @ self._columns).take(self._picked)
        turned += data.xpos.take(self.owners, axis=0)
        return np.asarray(turned)

    def placed(self, rotations: Array, origins: Array) -> Array:
        """Return the centers of the spheres for many postures, in the base frame, shape (n, m, 3) [m].

        Args:
            rotations: rotation matrices of all bodies of the model, shape (n, n_bodies, 3, 3).
            origins: origins of all bodies in the base frame, shape (n, n_bodies, 3) [m].
        """
        turned = rotations[:, self.owners] @ self._centers
        return np.asarray(turned[..., 0] + origins[:, self.owners])

    def speeds(self, data: mujoco.MjData, spheres: NDArray[np.int_], centers: Array, normals: Array) -> Array:
        """Return the speed of spheres along given directions per unit of joint speed, shape (k, n_joints) [m/rad].

        MuJoCo stores the twist of each joint: the angular velocity ``w`` of the moved bodies, and their velocity ``v``
        at the arm's centre of mass ``o``. This twist moves a point ``c`` along ``n`` at the rate
        ``n.(v + w x (c - o)) = n.v + w.((c - o) x n)``.

        Args:
            data: the kinematics of a posture.
            spheres: indices of the spheres, shape (k,).
            centers: centers of these spheres, shape (3, k) [m].
            normals: the directions, unit vectors, shape (3, k).
        """
        a, b, c = centers - data.subtree_com[self.root][:, None]
        x, y, z = normals
        wrenches = np.empty((6, len(spheres)))
        for row, left, right in zip(wrenches, (b, c, a), (z, x, y), strict=False):
            np.multiply(left, right, out=row)
        for row, left, right in zip(wrenches, (c, a, b), (y, z, x), strict=False):
            np.subtract(row, left * right, out=row)
        wrenches[3:] = normals
        speeds = np.dot(wrenches.T, data.cdof.take(self.dofs, axis=0).T)
        speeds *= self._moved.take(spheres, axis=0)
        return speeds

    def parting(
        self, data: mujoco.MjData, outer: NDArray[np.int_], inner: NDArray[np.int_], centers: Array, normals: Array
    ) -> Array:
        """Return the gradients of the distances of pairs of spheres, shape (k, n_joints) [m/rad].

        A joint that moves both spheres does not change their distance. Let n be the unit vector from the inner to the
        outer sphere, and c the center of the outer sphere. Let a be the axis of a joint that moves only the outer
        sphere, and o a point on the axis. Per radian, this joint changes the distance by
        ``n.(a x (c - o)) = a.(c x n) - n.(a x o)``.

        Args:
            data: the kinematics of a posture.
            outer: indices of the spheres farther from the base, shape (k,); all joints that move the inner spheres
                also move the outer spheres.
            inner: indices of the spheres nearer to the base, shape (k,). The spheres of the base itself are numbered
                after all moving spheres.
            centers: centers of the outer spheres, shape (k, 3) [m].
            normals: unit vectors from inner to outer, shape (k, 3).
        """
        axes, anchors = data.xaxis[self.joints], data.xanchor[self.joints]
        rates = _cross(centers, normals) @ axes.T
        rates -= normals @ _cross(axes, anchors).T
        if self._any_slides:
            rates[:, self.slides] = normals @ axes[self.slides].T
        rates *= self._moves_of_all[outer] - self._moves_of_all[inner]
        return np.asarray(rates)

    def jacobians(self, data: mujoco.MjData) -> Array:
        """Return the Jacobians of the centers, shape (m, 3, n_joints) [m/rad]."""
        axes, anchors = data.xaxis[self.joints].T, data.xanchor[self.joints].T
        x, y, z = axes
        # Column j is a_j x (c - o_j). All the cross products with c at once: c times the stacked matrices [a_j]x^T.
        zero = np.zeros_like(x)
        crosses = np.stack((zero, z, -y, -z, zero, x, y, -x, zero)).reshape(3, -1)
        u, v, w = anchors
        offsets = np.stack((y * w - z * v, z * u - x * w, x * v - y * u))
        columns = (self.centers(data) @ crosses).reshape(-1, *axes.shape) - offsets
        if self._any_slides:
            columns[:, :, self.slides] = axes[:, self.slides]
        return np.asarray(columns * self._moves)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of rows; np.cross takes many times longer for few rows."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _carries(model: mujoco.MjModel, carrier: int, body: int) -> bool:
    """Return whether ``carrier`` is ``body`` or an ancestor of it."""
    while body > carrier:  # parents have smaller indices
        body = int(model.body_parentid[body])
    return body == carrier


def covering_spheres(model: mujoco.MjModel, geom: int) -> tuple[Array, float]:
    """Cover one geom with equal spheres: every point of the geom is inside at least one sphere.

    A row of spheres covers a capsule, a cylinder or an ellipsoid. A grid of spheres covers any other shape, for example
    a box or the bounding box of a mesh.

    Args:
        model: the compiled model.
        geom: index of the geom.

    Returns:
        centers in the frame of the geom's body (m, 3) [m], and their radius [m].
    """
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    offset = np.zeros(3)
    if kind == types.mjGEOM_SPHERE:
        centers, radius = np.zeros((1, 3)), float(size[0])
    elif kind == types.mjGEOM_CAPSULE:
        centers, radius = _row(2, float(size[1]), float(size[0]))
    elif kind == types.mjGEOM_CYLINDER:
        centers, radius = _cylinder(float(size[1]), float(size[0]))
    elif kind == types.mjGEOM_ELLIPSOID:
        longest = int(np.argmax(size))
        second = float(np.sort(size)[1])  # an ellipsoid lies inside the capsule of this radius along its longest axis
        centers, radius = _row(longest, float(size[longest]) - second, second)
    else:
        offset = model.geom_aabb[geom, :3]
        centers, radius = _grid(model.geom_aabb[geom, 3:])
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return np.asarray((centers + offset) @ rotation.reshape(3, 3).T + model.geom_pos[geom]), radius


def _pieces(half_length: float, radius: float) -> int:
    """Return the number of spheres that cover a round bar; the number is limited, so a wire gets larger spheres."""
    return max(1, math.ceil(min(2.0 * half_length / (_SPACING * radius), _MOST_PIECES)))


def _row(axis: int, half_length: float, radius: float) -> tuple[Array, float]:
    """Cover the capsule about a straight axis."""
    n = _pieces(half_length, radius) + 1 if half_length > 0.0 else 1
    centers = np.zeros((n, 3))
    centers[:, axis] = np.linspace(-half_length, half_length, n) if n > 1 else 0.0
    gap = 2.0 * half_length / (n - 1) if n > 1 else 0.0
    return centers, math.hypot(radius, 0.5 * gap)


def _cylinder(half_length: float, radius: float) -> tuple[Array, float]:
    """Cover a cylinder about z: cut it into slices, each of which is inside the sphere through its two rims."""
    n = _pieces(half_length, radius)
    centers = np.zeros((n, 3))
    centers[:, 2] = half_length * (2.0 * np.arange(n) + 1.0 - n) / n
    return centers, math.hypot(radius, half_length / n)


def _grid(half_size: Array) -> tuple[Array, float]:
    """Cover a box by a limited number of cells, with edges about as long as the shortest edge of the box."""
    cell = max(2.0 * float(np.min(half_size)), _SMALLEST_CELL, 2.0 * float(np.max(half_size)) / _LONGEST_ROW)
    counts = np.maximum(1, np.ceil(2.0 * half_size / cell - 1e-9)).astype(int)
    axes = [h * (2.0 * np.arange(n) + 1.0 - n) / n for h, n in zip(half_size, counts, strict=True)]
    return np.array(list(product(*axes))), float(np.linalg.norm(half_size / counts))
