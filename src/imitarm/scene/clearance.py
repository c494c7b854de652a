"""Inequalities for the inverse kinematics that keep the links of an arm clear of each other."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik_problem import Box, Rows
from imitarm.kinematics.spheres import COLLISION_GROUP
from imitarm.scene.arm_rows import Demand, Nearness, OwnRows, SpherePairs
from imitarm.validation import finite_number, instance, whole_number

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

_SEARCH, _SEARCH_AT_LATEST = 0.03, 0.05  # [s] after which near links are searched for when there is time, or is not
_INFLUENCE = 0.15  # [m] beyond the clearance: two links farther apart have no row
_NEAR = 0.06  # [m] beyond the clearance: every two spheres nearer than this have a row
_MOST = 64  # rows of such spheres at most, the nearest
_RETREAT_RATE = 25.0  # [1/s] how fast missing clearance is regained
_FEW = 3  # links with more joints between them are assumed to meet: there are too many postures to try
_POSTURES = 512  # tried for each pair of links


_known: dict[bytes, NDArray[np.bool_]] = {}  # by the content of the model: an arm that is loaded again is the same
_MOST_KNOWN = 64


class SelfClearance:
    r"""Keeps the links of an arm and its tool apart from each other; neighbouring links are not checked.

    The arm is covered by spheres (``ArmModel.collision_spheres``). Let c denote the centre, r the radius and J the
    Jacobian of a sphere. The spheres i and j of two links have the distance :math:`d` with the gradient :math:`\nabla
    d`:

    .. math:: d = |c_i - c_j| - r_i - r_j, \qquad \nabla d = n^T (J_i - J_j), \quad n = (c_i - c_j)/|c_i - c_j|

    Let v be the joint velocity. Each row is the inequality :math:`\nabla d\, v \ge -\xi (d - d_{safe})` for one pair of
    spheres. It lets the distance shrink at most exponentially towards the required clearance :math:`d_{safe}`. If the
    distance is below the clearance, it must grow, and 25/s replaces :math:`\xi`. The 64 nearest pairs of spheres have a
    row if their distance is less than the clearance plus 6 cm. In addition, each of the ``n_rows`` nearest pairs of
    links has a row for its nearest spheres. This row exists only if the distance of the spheres is less than the
    clearance plus 15 cm.

    Three kinds of pairs are not checked. The first are links that share a joint. The second are links that can't touch
    within their joint limits (:func:`meeting_links`). The third are spheres that are closer to each other than the
    clearance in the arm's home posture. The base counts as a link. The object on which the base stands is not part of
    the arm; add this object to the scene.

    Args:
        arm: the arm with its tool.
        clearance: required distance between links [m].
        n_rows: largest number of pairs of links that have a row.
        gain: :math:`\xi`, the largest rate at which the distance may shrink, divided by the distance minus the
            clearance [1/s].

    Raises:
        InputError: when a number can't be used.
    """

    def __init__(self, arm: ArmModel, clearance: float = 0.02, *, n_rows: int = 6, gain: float = 5.0) -> None:
        clearance = finite_number(clearance, "SelfClearance: clearance", "m", at_least=0.0)
        n_rows = whole_number(n_rows, "SelfClearance: n_rows", at_least=1)
        gain = finite_number(gain, "SelfClearance: gain", "1/s", above=0.0)
        instance(arm, ArmModel, "SelfClearance: arm")
        self.arm, self.clearance = arm, clearance
        self._gain = gain
        cover = arm.cover
        centers = np.concatenate([arm.sphere_centers(arm.home), cover.base_centers])
        radii = np.concatenate([cover.radii, cover.base_radii])
        links = self.links = np.concatenate([cover.links, np.zeros(len(cover.base_radii), dtype=int)])
        meet = meeting_links(arm)
        sums = radii[:, None] + radii
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) - sums
        # the sphere that is farther out comes first, so every pair occurs once
        outer, inner = np.nonzero(meet[links[:, None], links] & (apart >= clearance))
        pair_of_links = links[outer] * (arm.n_joints + 1) + links[inner]
        order = np.argsort(pair_of_links, kind="stable")
        starts = np.flatnonzero(np.diff(pair_of_links[order], prepend=-1))
        self.pairs = SpherePairs(cover, outer[order], inner[order], (radii[outer] + radii[inner])[order], starts)
        self._nearness = Nearness(n_rows, clearance + _INFLUENCE, clearance + _NEAR, _MOST)
        self._demand = Demand(clearance, gain, _RETREAT_RATE)

    @property
    def n_pairs(self) -> int:
        """Number of pairs of spheres that are checked."""
        return len(self.pairs.sums)

    def distance(self, q: ArrayLike) -> float:
        """Return the smallest distance of all checked pairs of spheres [m]; negative if two spheres overlap.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            The distance [m]; inf if no pair of spheres is checked.
        """
        if not self.n_pairs:
            return math.inf
        return float(self.pairs.distances(self.arm.sphere_centers(q)).min())

    def nearest(self, q: ArrayLike) -> tuple[Indices, Array]:
        """Return the pairs of spheres that are near enough to have a row in :meth:`rows`, nearest pair first.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            indices of the two spheres (k, 2), and their distances (k,) [m].
        """
        found = self._found(q)
        if found is None:
            return np.zeros((0, 2), dtype=int), np.zeros(0)
        pairs = np.stack((self.pairs.outer.take(found.pair), self.pairs.inner.take(found.pair)), axis=1)
        return pairs, found.distance

    def names_of(self, q: ArrayLike, row: int) -> tuple[str, str, float]:
        """Return the names of the two links to which a row belongs, and their distance minus the clearance [m].

        Args:
            q: joint positions, shape (n_joints,) [rad].
            row: index of the row in the result of :meth:`rows`.
        """
        pairs, distances = self.nearest(q)
        bodies = self.arm.cover.bodies
        first, second = (bodies[i] if i < len(bodies) else "base" for i in pairs[row].tolist())
        return first, second, float(distances[row]) - self.clearance

    def rows(self, q: ArrayLike, box: Box | None = None) -> Rows | None:
        """Return inequalities on the joint velocity, which can be passed to ``solve_ik(..., rows=...)``.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            box: bounds of the joint velocity; None: rows are returned even if no velocity could violate them.

        Returns:
            The inequalities; None if no pair is near, or if no velocity in the box violates an inequality.
        """
        found = self._found(q, box)
        return None if found is None else Rows(found.gradient, self.lower(found.distance - self.clearance))

    def near(self, q: ArrayLike) -> tuple[Array, Array] | None:
        """Return gradients of the distances of near pairs (k, n_joints) [m/rad], and distance minus clearance (k,) [m].

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            None when nothing is near.
        """
        found = self._found(q)
        return None if found is None else (found.gradient, found.distance - self.clearance)

    def lower(self, room: Array) -> Array:
        """Return the lowest allowed rates of distances (k,) [m/s]; ``room`` (k,) [m] is distance minus clearance."""
        if min(room.tolist(), default=0.0) >= 0.0:  # nearly always
            return -self._gain * room
        return np.where(room < 0.0, -_RETREAT_RATE, -self._gain) * room

    def periodic(self, dt: float = 0.01) -> PeriodicSelfClearance:
        """Return a version of this check that is five times as fast, for a control loop with period ``dt`` [s]."""
        return PeriodicSelfClearance(self, dt)

    def _found(self, q: ArrayLike, box: Box | None = None) -> OwnRows | None:
        """Return the nearest pairs."""
        return self.pairs.rows(self.arm, q, self._nearness, self._demand, box)


class PeriodicSelfClearance:
    r"""Rows of a :class:`SelfClearance` for a fast control loop: near pairs are searched for only every 30 to 50 ms.

    Between two searches, the distances are approximated by :math:`d(q) \approx d_0 + \nabla d\,(q - q_0)`, where
    :math:`d_0` and :math:`q_0` are distances and joint positions at the last search. After 50 ms with every joint at 1
    rad/s, the error is below 8 mm. The error grows with the square of the speed.

    Args:
        own: the self-clearance check whose rows are approximated.
        dt: control period [s].
    """

    def __init__(self, own: SelfClearance, dt: float) -> None:
        self._own = own
        self._every, self._latest = max(round(_SEARCH / dt), 1), max(round(_SEARCH_AT_LATEST / dt), 1)
        self.reset()

    def reset(self) -> None:
        """Make the next call of :meth:`rows` search for near pairs again."""
        self._age = self._latest
        self._found: tuple[Array, Array] | None = None
        self._at: Array = np.zeros(0)

    def rows(self, q: Array, *, may_search: bool = True) -> Rows | None:
        """Return inequalities on the joint velocity like ``SelfClearance.rows``; None when no pair is near.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            may_search: whether this step has time for a search. A search that is overdue takes place in any case.
        """
        self._age += 1
        if self._age > self._latest or (may_search and self._age > self._every):
            self._found, self._at, self._age = self._own.near(q), q.copy(), 1
        if self._found is None:
            return None
        matrix, room = self._found
        return Rows(matrix, self._own.lower(room + matrix.dot(q - self._at)))


@lru_cache(maxsize=16)
def meeting_links(arm: ArmModel) -> NDArray[np.bool_]:
    """Return, for every pair of links, whether the two links can touch within the limits of the joints between them.

    Link 0 is the base, and link k is moved by the first k joints. For neighbouring links, the answer is always False.
    For links with two or three joints between them, the distance of their exact shapes is measured in 512 postures. The
    postures fill the ranges of these joints evenly (a Sobol sequence). If the links touch in none of these postures,
    the answer is False. For links with four or more joints between them, the answer is always True.

    Args:
        arm: the arm with its tool.

    Returns:
        A read-only array of shape (n_joints + 1, n_joints + 1). The answer for links i and j, where i is farther from
        the base, is the entry [i, j]. All other entries are False.
    """
    model = arm.spec().compile()
    content = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, content)
    key = hashlib.sha256(content.tobytes() + arm.home.tobytes() + repr(arm.joint_names).encode()).digest()
    if key not in _known:
        while len(_known) >= _MOST_KNOWN:
            _known.pop(next(iter(_known)))
        _known[key] = _measured(arm, model)
    return _known[key]


def _measured(arm: ArmModel, model: mujoco.MjModel) -> NDArray[np.bool_]:
    n = arm.n_joints
    meet = np.tril(np.ones((n + 1, n + 1), dtype=bool), -2)
    data, shapes = mujoco.MjData(model), _shapes(arm, model)
    for outer in range(2, n + 1):
        for inner in range(max(outer - _FEW, 0), outer - 1):
            meet[outer, inner] = _touch(arm, model, data, (shapes[outer], shapes[inner]), slice(inner, outer))
    meet.setflags(write=False)
    return meet


def _shapes(arm: ArmModel, model: mujoco.MjModel) -> list[list[int]]:
    """Return the collision shapes of each link, beginning with the base."""
    joints = [model.joint(name).id for name in arm.joint_names]
    carriers = [int(model.jnt_bodyid[joint]) for joint in joints]
    shapes: list[list[int]] = [[] for _ in range(arm.n_joints + 1)]
    for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP).tolist():
        body, link = int(model.geom_bodyid[geom]), 0
        while body > 0 and link == 0:
            link = carriers.index(body) + 1 if body in carriers else 0
            body = int(model.body_parentid[body])
        shapes[link].append(geom)
    return shapes


def _touch(
    arm: ArmModel, model: mujoco.MjModel, data: mujoco.MjData, links: tuple[list[int], list[int]], between: slice
) -> bool:
    """Return whether two links touch in any of the postures that are tried."""
    low, high = (
        np.maximum(arm.lower[between], -np.pi),
        np.minimum(arm.upper[between], np.pi),
    )  # continuous joints have no limits
    from scipy.stats import qmc  # noqa: PLC0415  takes half a second to import

    addresses = [int(model.jnt_qposadr[model.joint(name).id]) for name in arm.joint_names[between]]
    data.qpos[:] = arm.posture(model)
    for fraction in qmc.Sobol(len(low), scramble=False).random(_POSTURES):
        data.qpos[addresses] = low + fraction * (high - low)
        mujoco.mj_kinematics(model, data)
        for one in links[0]:
            for other in links[1]:
                if mujoco.mj_geomDistance(model, data, one, other, 0.01, None) <= 0.0:
                    return True
    return False
