"""A learnt path taken apart into its Gaussian components, so that only some of them need to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, rotate
from imitarm.policies.certificate import Pair
from imitarm.scene.obstacle import Obstacle
from imitarm.skills.gmr import GMR
from imitarm.trajectory import Trajectory

if TYPE_CHECKING:
    from imitarm.skills.skill import Skill

Array = NDArray[np.float64]

PIN_WIDTH = 0.06  # share of the duration over which a pinned instant lets go of the path (METHODS D.2.3)
NEGLIGIBLE_RESPONSIBILITY = 1e-6  # below this a component's influence is cut, so that "unmoved" is bit-identical
STILL = 1e-6  # [m] a mean that would move less than this stays exactly where it is
TOLERANCE_FLOOR = 0.005  # [m] nobody demonstrates more precisely than this: keeps planar covariances invertible


def quintic_step(u: ArrayLike) -> Array:
    """Return the smooth step ``10 u^3 - 15 u^4 + 6 u^5`` of ``u`` clipped to [0, 1], elementwise."""
    v = np.clip(np.asarray(u, dtype=float), 0.0, 1.0)
    return np.asarray(v**3 * (10.0 - 15.0 * v + 6.0 * v**2))


@dataclass(frozen=True, eq=False)
class ComponentPath:
    r"""The nominal path, and what moving its components does to it.

    Time-driven GMR gives ``x0(t) = sum_k h_k(t) m_k(t)``, and the responsibilities ``h_k(t)`` depend on time alone.
    Moving the mean of component ``k`` by ``Delta_k`` therefore changes the path by an affine, smooth amount
    (METHODS D.2.3)::

        x(t) = x0(t) + w(t) sum_k h_k(t) Delta_k  =  x0(t) + basis(t) @ Delta

    where the window ``w`` is a quintic step that is 0 at every pinned instant (start, goal, contact points) and 1
    elsewhere. Components with ``Delta_k = 0`` change nothing at all.

    Attributes:
        nominal: the path without obstacles, n samples.
        responsibilities: h, shape (n, n_components).
        basis: w h, shape (n, n_components).
        means: centres of the components on the nominal path, shape (n_components, 3) [m].
        covariances: position covariances of the components, floored at (5 mm)^2, (n_components, 3, 3) [m^2]. They
            hold the motion itself too: a component is long along the path.
        yields: how much the teacher varied at the instant of each component's centre, floored as well: GMR's
            covariance there, (n_components, 3, 3) [m^2]. It is what a displacement is measured against.
        centres: sample at which each component has its centre, (n_components,).
        factors: lower Cholesky factors of the yields, (n_components, 3, 3) [m].
        precisions: inverses of the yields, (n_components, 3, 3) [1/m^2].
        tolerance: GMR covariance along the path, shape (n, 3, 3) [m^2].
        spheres: that hold the tool: centres in the tool's frame and radii, rows x y z r, shape (n_spheres, 4) [m].
    """

    nominal: Trajectory
    responsibilities: Array
    basis: Array
    means: Array
    covariances: Array
    yields: Array
    centres: NDArray[np.intp]
    factors: Array
    precisions: Array
    tolerance: Array
    spheres: Array

    @classmethod
    def of_skill(
        cls,
        skill: Skill,
        *,
        spheres: ArrayLike = ((0.0, 0.0, 0.0, 0.0),),
        n_samples: int = 200,
        start: Pose | None = None,
        goal: Pose | None = None,
        pinned: Sequence[float] = (),
    ) -> ComponentPath:
        """Take the path of a skill apart.

        Args:
            skill: a fitted skill.
            spheres: that hold the tool, rows x y z r in the tool's frame, shape (n_spheres, 4) [m].
            n_samples: samples along the path.
            start: where the motion begins; None: where it was learnt.
            goal: where the motion ends; None: where it was learnt. A moved start or goal bends the nominal path by
                the skill's DMP, and the components ride on it.
            pinned: further instants [s] at which the path must not move, for example a contact point; each becomes a
                sample.

        Raises:
            InputError: when there are fewer than 10 samples, a pinned instant is outside the motion, or a sphere lies
                beside the tip of a tool whose orientation was not learnt.
        """
        if n_samples < 10:
            raise InputError(f"n_samples must be at least 10, got {n_samples}")
        outside = [p for p in pinned if not 0.0 <= p <= skill.duration_]
        if outside:
            raise InputError(f"pinned instant {outside[0]:g} s is outside the motion (0 to {skill.duration_:g} s)")
        rows = _checked_spheres(spheres, skill.gmr_.has_orientation_)
        window = (0.0, *map(float, pinned), skill.duration_)
        if start is None and goal is None:
            return replace(_learnt(skill.gmr_, n_samples, window), spheres=rows)
        learnt = _learnt(skill.gmr_, n_samples, window)
        times = learnt.nominal.times
        moved = skill.nominal(times, start, goal)
        shift = moved.positions - learnt.nominal.positions
        centre_times = np.clip(skill.gmr_.time_means_, times[0], times[-1])
        carried = np.stack([np.interp(centre_times, times, column) for column in shift.T], axis=1)
        return replace(learnt, nominal=moved, means=learnt.means + carried, spheres=rows)

    @property
    def n_components(self) -> int:
        """Number of components."""
        return len(self.means)

    def pairs(self, obstacles: Sequence[Obstacle]) -> list[Pair]:
        """Return every sphere of the tool with every obstacle; the tool turns as on the nominal path."""
        q = self.nominal.quaternions
        sides: list[tuple[float, Array | None, Array | float]] = []
        for x, y, z, radius in self.spheres:
            centre = np.array([x, y, z])
            if q is None or not centre.any():
                sides.append((radius, None, 0.0))
                continue
            half_turn = np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0.0, 1.0))
            sides.append((radius, rotate(q, centre), np.linalg.norm(centre) * (1.0 - np.cos(half_turn))))
        return [Pair(obstacle, i, *side) for i, obstacle in enumerate(obstacles) for side in sides]

    def displaced(self, displacement: Array) -> Array:
        """Return the positions (..., n, 3) when the means move by ``displacement`` (..., n_components, 3) [m]."""
        return self.nominal.positions + self.basis @ displacement

    def deviation(self, displacement: Array) -> float:
        """Return the largest Mahalanobis length of a mean's displacement: how many demonstrated sigmas it moved."""
        squares = np.einsum("kd,kde,ke->k", displacement, self.precisions, displacement)
        return float(np.sqrt(squares.max(initial=0.0)))


_PATHS: WeakKeyDictionary[GMR, tuple[Array, tuple[int, tuple[float, ...]], ComponentPath]] = WeakKeyDictionary()


def _learnt(gmr: GMR, n_samples: int, pins: tuple[float, ...]) -> ComponentPath:
    """Take the learnt path apart; the last answer for each regression is kept, since no scene changes it."""
    key = (n_samples, pins)
    if gmr in _PATHS and _PATHS[gmr][0] is gmr.means_ and _PATHS[gmr][1] == key:  # fitting again makes new means
        return _PATHS[gmr][2]
    times = _instants(n_samples, pins)
    tolerance = gmr.predict(times)[1]
    responsibilities = gmr.responsibilities(times)
    centres = _nearest(times, gmr.time_means_)
    yields = tolerance[centres] + TOLERANCE_FLOOR**2 * np.eye(3)
    influence = np.where(responsibilities < NEGLIGIBLE_RESPONSIBILITY, 0.0, responsibilities)
    path = ComponentPath(
        nominal=Trajectory(times, *gmr.nominal(times)),
        responsibilities=responsibilities,
        basis=_window(times, pins)[:, None] * influence,
        means=gmr.position_means_,
        covariances=gmr.position_covariances_ + TOLERANCE_FLOOR**2 * np.eye(3),
        yields=yields,
        centres=centres,
        factors=np.asarray(np.linalg.cholesky(yields), dtype=np.float64),
        precisions=np.asarray(np.linalg.inv(yields), dtype=np.float64),
        tolerance=tolerance,
        spheres=np.zeros((1, 4)),
    )
    _PATHS[gmr] = (gmr.means_, key, path)
    return path


def _checked_spheres(spheres: ArrayLike, turns_known: bool) -> Array:
    rows = np.asarray(spheres, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 4 or not len(rows):
        raise InputError(f"tool spheres must be rows x y z r [m], got shape {rows.shape}")
    if not np.isfinite(rows).all() or np.any(rows[:, 3] < 0.0):
        raise InputError(f"tool spheres must be finite with r >= 0 m, got radii from {rows[:, 3].min():g} m")
    if not turns_known and np.any(rows[:, :3] != 0.0):
        raise InputError(
            "tool spheres beside the tip need the tool's orientation, which was not learnt: "
            "record quaternions, or give one tool_radius"
        )
    return rows


def _instants(n_samples: int, pins: tuple[float, ...]) -> Array:
    """Return equally spaced times, and every pinned instant among them: what is pinned must be a sample."""
    even = np.linspace(0.0, pins[-1], n_samples)
    beside = np.abs(even[:, None] - np.asarray(pins)).min(axis=1) > 0.01 * even[1]
    return np.unique(np.concatenate([even[beside], pins]))


def _nearest(times: Array, moments: Array) -> NDArray[np.intp]:
    """Return the index of the sample nearest to each moment."""
    return np.argmin(np.abs(times[:, None] - moments), axis=0)


def _window(times: Array, pins: Sequence[float]) -> Array:
    """Return w (n,): 0 at each pinned instant, 1 beyond ``PIN_WIDTH`` of the duration from all of them."""
    distance = np.min(np.abs(times[:, None] - np.asarray(pins)[None, :]), axis=1)
    return quintic_step(distance / (PIN_WIDTH * (times[-1] - times[0])))
