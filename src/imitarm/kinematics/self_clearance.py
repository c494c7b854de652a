"""Keeping the arm off itself: distances between its links, and rows for the inverse kinematics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Rows
from imitarm.kinematics.reach_of_links import meeting_links

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

_LOOK, _LOOK_AT_LATEST = 0.03, 0.05  # [s] after which a loop looks for what is near when it has time, or has not
_INFLUENCE = 0.15  # [m] beyond the clearance, links farther apart get no row


class SelfClearance:
    r"""Keeps links that are not neighbours, and the tool, off each other.

    The arm is covered by spheres (``ArmModel.collision_spheres``). For the spheres i and j of two links, with centres
    c and radii r, the distance and its gradient are

    .. math:: d = |c_i - c_j| - r_i - r_j, \qquad \nabla d = n^T (J_i - J_j), \quad n = (c_i - c_j)/|c_i - c_j|

    and a row :math:`\nabla d\, v \ge -\xi (d - d_{safe})` lets it shrink no faster than exponentially (METHODS A.9).
    Every two links that are near have one row, for their nearest spheres; of those the ``n_rows`` nearest are taken.

    Not watched are links that are joined by a joint, links that their joints' limits keep apart
    (:func:`~imitarm.kinematics.reach_of_links.meeting_links`), and spheres that are nearer than the clearance in the
    arm's home posture. The base is watched; what it stands on is no part of the arm: put it into the scene.

    Args:
        arm: the arm with its tool.
        clearance: least distance [m].
        n_rows: how many pairs of links at most have a row.
        gain: xi [1/s].

    Raises:
        InputError: when a number can't be used.
    """

    def __init__(self, arm: ArmModel, clearance: float = 0.02, *, n_rows: int = 6, gain: float = 5.0) -> None:
        if not (0.0 <= clearance < math.inf and n_rows >= 1 and 0.0 < gain < math.inf):
            raise InputError(
                "SelfClearance: needs clearance >= 0 [m], n_rows >= 1 and gain > 0 [1/s], "
                f"got {clearance}, {n_rows} and {gain}"
            )
        self.arm, self.clearance = arm, clearance
        self._n_rows, self._gain = n_rows, gain
        cover = arm.cover
        centers, radii = self._centers(arm.home), np.concatenate([cover.radii, cover.base_radii])
        links = np.concatenate([cover.links, np.zeros(len(cover.base_radii), dtype=int)])
        meet = meeting_links(arm)
        sums = radii[:, None] + radii
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) - sums
        # the sphere that is farther out comes first, so every pair occurs once
        outer, inner = np.nonzero(meet[links[:, None], links] & (apart >= clearance))
        pair_of_links = links[outer] * (arm.n_joints + 1) + links[inner]
        order = np.argsort(pair_of_links, kind="stable")
        self._outer, self._inner = outer[order], inner[order]
        self._flat = self._outer * len(radii) + self._inner  # in the matrix of all distances
        self._sums = sums[self._outer, self._inner]
        self._coarse_sums = self._sums.astype(np.float32)
        self._starts = np.flatnonzero(np.diff(pair_of_links[order], prepend=-1))
        ends = [*self._starts.tolist(), len(order)][1:]
        self._groups = [slice(a, b) for a, b in zip(self._starts.tolist(), ends, strict=True)]
        self._near = np.float32(clearance + _INFLUENCE)

    def _centers(self, q: ArrayLike) -> Array:
        """Return where all spheres are, those of the base last, shape (m, 3) [m]."""
        return np.concatenate([self.arm.collision_spheres(q)[0], self.arm.cover.base_centers])

    @property
    def n_pairs(self) -> int:
        """How many pairs of spheres are watched."""
        return len(self._sums)

    def distance(self, q: ArrayLike) -> float:
        """Return the least distance between any two watched spheres [m]; negative where they overlap.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            inf when the arm has no two links that could touch.
        """
        if not self.n_pairs:
            return math.inf
        centers = self._centers(q)
        return float((np.linalg.norm(centers[self._outer] - centers[self._inner], axis=1) - self._sums).min())

    def nearest(self, q: ArrayLike) -> tuple[Indices, Array]:
        """Return the nearest spheres of every two links that are near, the nearest first.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            indices of the two spheres (k, 2), and their distances (k,) [m]; at most ``n_rows``.
        """
        outer, inner, _, _, distances = self._found(q)
        return np.stack((outer, inner), axis=1), distances

    def rows(self, q: ArrayLike) -> Rows | None:
        """Return inequalities on the joint velocity for ``solve_ik(..., rows=...)``.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            at most ``n_rows`` rows; None when nothing is near.
        """
        outer, inner, centers, normals, distances = self._found(q)
        if not len(outer):
            return None
        rows = self.arm.cover.parting(self.arm.at(q).data, outer, inner, centers, normals)
        return Rows(rows, -self._gain * (distances - self.clearance))

    def watch(self, dt: float = 0.01) -> SelfWatch:
        """Return the same for a control loop with period ``dt`` [s], at a fifth of the price."""
        return SelfWatch(self, self._gain, dt)

    def _found(self, q: ArrayLike) -> tuple[Indices, Indices, Array, Array, Array]:
        """Return the nearest pairs: outer and inner spheres, centres of the outer, normals and distances."""
        centers = self._centers(q)
        best: list[int] = []
        if self._groups:
            coarse = self._coarse_distances(centers)
            least = np.minimum.reduceat(coarse, self._starts)
            for group in least.argsort()[: self._n_rows].tolist():
                if least[group] < self._near:
                    part = self._groups[group]
                    best.append(part.start + int(coarse[part].argmin()))
        outer, inner = self._outer[best], self._inner[best]
        outer_centers = centers[outer]
        between = outer_centers - centers[inner]
        lengths = np.sqrt((between * between).sum(axis=1))
        return outer, inner, outer_centers, between / lengths[:, None], lengths - self._sums[best]

    def _coarse_distances(self, centers: Array) -> NDArray[np.float32]:
        """Return the distances of all watched pairs, in single precision: good to some um, which tells who is near."""
        points = centers.astype(np.float32)
        squares = (points * points).sum(axis=1)
        products = points @ (-2.0 * points).T
        products += squares
        products += squares[:, None]
        distances = products.ravel().take(self._flat)
        np.maximum(distances, 0.0, out=distances)
        np.sqrt(distances, out=distances)
        distances -= self._coarse_sums
        return distances


class SelfWatch:
    r"""Rows of a :class:`SelfClearance` for a control loop: the nearest links are looked for every 30 to 50 ms.

    In between the distances follow from the joints' motion, :math:`d(q) \approx d_0 + \nabla d\,(q - q_0)`. What that
    leaves out in 50 ms is less than 8 mm with every joint at 1 rad/s, and grows with the square of the speed.

    Args:
        own: what is watched.
        gain: xi [1/s].
        dt: control period [s].
    """

    def __init__(self, own: SelfClearance, gain: float, dt: float) -> None:
        self._own, self._gain = own, gain
        self._every, self._latest = max(round(_LOOK / dt), 1), max(round(_LOOK_AT_LATEST / dt), 1)
        self.reset()

    def reset(self) -> None:
        """Look anew in the next step."""
        self._age = self._latest
        self._rows: Rows | None = None
        self._at: Array = np.zeros(0)

    def rows(self, q: Array, *, time_to_look: bool = True) -> Rows | None:
        """Return inequalities on the joint velocity as ``SelfClearance.rows`` does; None when nothing is near.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            time_to_look: whether this step has time for a new look.
        """
        self._age += 1
        if self._age > self._latest or (time_to_look and self._age > self._every):  # from 1 on, the look's own step
            self._rows, self._at, self._age = self._own.rows(q), q.copy(), 1
        if self._rows is None:
            return None
        matrix, lower, price = self._rows
        return Rows(matrix, lower - self._gain * matrix.dot(q - self._at), price)
