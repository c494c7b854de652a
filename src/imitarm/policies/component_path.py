"""ComponentPath: a learned path with its Gaussian components, so that an adaptation can move only some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills.gmr import GMR
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, whole_number

if TYPE_CHECKING:
    from imitarm.skills.skill import Skill

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PIN_WIDTH = 0.06  # fraction of the duration over which the influence of components fades towards a fixed time
NEGLIGIBLE_RESPONSIBILITY = 1e-6  # below this a component's influence is cut, so that "unmoved" is bit-identical
STILL = 1e-6  # [m] a mean that would move less than this stays exactly where it is
TOLERANCE_FLOOR = 0.005  # [m] nobody demonstrates more precisely than this: keeps planar covariances invertible
_PIECES = 24  # a divided path has a piece about every 24th of the duration, and narrower ones at its ends
_FINE_PIECES = 48  # likewise of a finely divided path
_NARROWEST_PIN = 0.015  # fraction of the duration over which the pieces fade towards a fixed time between the ends


def quintic_step(u: ArrayLike) -> Array:
    """Return the smooth step ``10 u^3 - 15 u^4 + 6 u^5`` of ``u`` clipped to [0, 1], elementwise."""
    v = np.clip(np.asarray(u, dtype=float), 0.0, 1.0)
    return np.asarray(v**3 * (10.0 - 15.0 * v + 6.0 * v**2))


@dataclass(frozen=True, eq=False)
class ComponentPath:
    r"""The nominal path, and how it changes when its components are displaced.

    Gaussian mixture regression (GMR) over time gives ``x0(t) = sum_k h_k(t) m_k(t)`` (thesis Eq 2.6). The
    responsibilities ``h_k(t)`` depend only on time. If the mean of each component ``k`` is displaced by ``Delta_k``,
    the change of the path is therefore linear in the ``Delta_k``::

        x(t) = x0(t) + w(t) sum_k h_k(t) Delta_k  =  x0(t) + basis(t) @ Delta

    The window ``w`` is 0 at the start, at the goal and at the pinned times, for example contacts. It rises to 1 on both
    sides of these times as a quintic step.

    Attributes:
        nominal: the path without obstacles, n samples.
        fixed_times: times of the start, of the pinned points and of the goal, at which the path is not displaced [s].
        responsibilities: responsibilities h_k at the samples, shape (n, n_components).
        basis: products of the window w and the responsibilities h_k at the samples, shape (n, n_components).
        means: centres of the components on the nominal path, shape (n_components, 3) [m].
        covariances: position covariances of the components, with the lower bound (5 mm)^2, (n_components, 3, 3) [m^2].
            A component is elongated along the path, because its covariance includes the motion along the path.
        yields: covariance from GMR at the time of each component's centre, with the same lower bound, (n_components, 3,
            3) [m^2]. The cost of a displacement is relative to this covariance.
        centres: index of the sample at the centre of each component, (n_components,).
        precisions: inverses of ``yields``, (n_components, 3, 3) [1/m^2].
        tolerance: covariance of the demonstrated positions from GMR, at the samples, shape (n, 3, 3) [m^2].
        rotation_tolerance: two standard deviations of the demonstrated rotation at the samples, about the axis with the
            largest variation, shape (n,) [rad]; 0 if no orientation was learned.
    """

    nominal: Trajectory
    fixed_times: tuple[float, ...]
    responsibilities: Array
    basis: Array
    means: Array
    covariances: Array
    yields: Array
    centres: Index
    precisions: Array
    tolerance: Array
    rotation_tolerance: Array

    @classmethod
    def of_skill(
        cls,
        skill: Skill,
        *,
        n_samples: int = 200,
        start: Pose | None = None,
        goal: Pose | None = None,
        pinned: Sequence[float] = (),
    ) -> ComponentPath:
        """Decompose the path of a skill.

        Args:
            skill: a fitted skill.
            n_samples: number of samples along the path.
            start: start of the motion; None: the learned start.
            goal: end of the motion; None: the learned goal. For another start or goal, the skill changes the nominal
                path (``Skill.nominal``), and the components move with this path.
            pinned: further times [s] at which the path is not displaced, for example at a contact. There is a sample at
                each of these times.

        Raises:
            InputError: when there are fewer than 10 or more than 100 000 samples, or a pinned time is outside the
                motion.
        """
        n_samples = whole_number(n_samples, "n_samples", at_least=10, at_most=100_000)
        duration = skill.duration_
        pins: list[float] = []
        if not isinstance(pinned, tuple) or pinned:
            pins = finite_array(pinned, (None,), "pinned", "s").tolist()
        for pin in pins:
            if not 0.0 <= pin <= duration:
                raise InputError(f"pinned: {pin:g} s is outside the motion (0 to {duration:g} s)")
        return _learned(skill.gmr_, n_samples, (0.0, *pins, duration)).between(skill, start, goal)

    def between(self, skill: Skill, start: Pose | None, goal: Pose | None) -> ComponentPath:
        """Return this path, moved to another start or goal.

        Args:
            skill: the skill whose path was decomposed.
            start: start of the motion; None: the learned start.
            goal: end of the motion; None: the learned goal.
        """
        if start is None and goal is None:
            return self
        moved = skill.nominal(self.nominal.times, start, goal)
        shift = moved.positions - self.nominal.positions
        return replace(self, nominal=moved, means=self.means + shift[self.centres])

    @property
    def n_components(self) -> int:
        """Number of components."""
        return len(self.means)

    @cached_property
    def factors(self) -> Array:
        """Lower Cholesky factors of ``yields``, (n_components, 3, 3) [m]."""
        return np.asarray(np.linalg.cholesky(self.yields), dtype=np.float64)

    @cached_property
    def lever(self) -> Array:
        """The largest influence of any component on each sample, shape (n,)."""
        return np.asarray(self.basis.max(axis=1))

    @cached_property
    def fixed(self) -> Index:
        """Indices of the samples that no displacement of the components can move."""
        return np.flatnonzero(self.lever == 0.0)

    @cached_property
    def at_pins(self) -> Array:
        """A factor for each sample that is 0 at every pinned time and 1 far from the pinned times, shape (n,)."""
        pins = self.fixed_times[1:-1]
        return _window(self.nominal.times, pins, PIN_WIDTH) if pins else np.ones(len(self.nominal))

    def displaced(self, displacement: Array) -> Array:
        """Return the positions (..., n, 3) when the means move by ``displacement`` (..., n_components, 3) [m]."""
        return self.nominal.positions + self.basis @ displacement

    def deviation(self, displacement: Array) -> float:
        """Return the largest displacement of a mean, in standard deviations of the demonstrations (Mahalanobis)."""
        squares = np.einsum("kd,kde,ke->k", displacement, self.precisions, displacement)
        return float(np.sqrt(squares.max(initial=0.0)))

    def jerk(self, values: Array) -> Array:
        """Return the third time derivative of the values (n, m) at the samples, from third divided differences.

        Returns:
            Shape (n - 3, m).
        """
        for spans in self._spans:
            values = (values[1:] - values[:-1]) / spans
        return 6.0 * values

    @cached_property
    def _spans(self) -> tuple[Array, ...]:
        t = self.nominal.times
        return tuple((t[k:] - t[:-k])[:, None] for k in (1, 2, 3))

    @cached_property
    def basis_jerk(self) -> Array:
        """Change of the jerk caused by a unit displacement of each component, shape (n - 3, n_components) [1/s^3]."""
        return self.jerk(self.basis)

    @cached_property
    def nominal_jerk(self) -> float:
        """The largest jerk along the nominal path [m/s^3]."""
        return _largest_norm(self.jerk(self.nominal.positions))

    def jerk_ratio(self, positions: Array) -> float:
        """Return the largest jerk along a path (n, 3), divided by the largest jerk along the nominal path."""
        jerk = _largest_norm(self.jerk(positions))
        return jerk / self.nominal_jerk if self.nominal_jerk > 0.0 else 1.0 if jerk == 0.0 else np.inf

    @cached_property
    def divided(self) -> ComponentPath:
        """The same path with more, narrower components (cubic B-splines)."""
        return self._divided(_PIECES)

    @cached_property
    def finely_divided(self) -> ComponentPath:
        """The same path with about 48 components (cubic B-splines), which allow sharp bends."""
        return self._divided(_FINE_PIECES)

    def _divided(self, n_pieces: int) -> ComponentPath:
        """Return the same path with more, narrower components.

        For some scenes, the influence of the Gaussians extends too far, for example near the start or the goal, or in
        narrow spaces. The returned path therefore has cubic B-splines in time instead of the responsibilities ``h_k``.
        Like the responsibilities, the B-splines sum to 1. The first and the last B-spline are left out, because they
        would move the start and the goal. The knots are closer together near the fixed times.
        """
        times, fixed = self.nominal.times, self.fixed_times
        knots = np.concatenate([[times[0]] * 3, _knots(times, fixed, n_pieces), [times[-1]] * 3])
        pieces = BSpline.design_matrix(times, knots, 3).toarray()[:, 1:-1]
        pieces[[0, -1]] = 0.0
        basis = pieces
        if len(fixed) > 2:
            width = max(_NARROWEST_PIN, 3.0 * float(np.diff(times).max()) / (times[-1] - times[0]))
            basis = _window(times, fixed[1:-1], width)[:, None] * pieces
        centres = np.asarray(np.argmax(pieces, axis=0), dtype=np.intp)
        yields = self.tolerance[centres] + TOLERANCE_FLOOR**2 * np.eye(3)
        return replace(
            self,
            responsibilities=pieces,
            basis=basis,
            means=self.nominal.positions[centres],
            covariances=yields,
            yields=yields,
            centres=centres,
            precisions=np.asarray(np.linalg.inv(yields), dtype=np.float64),
        )


def _largest_norm(vectors: Array) -> float:
    return float(np.sqrt(np.einsum("nd,nd->n", vectors, vectors).max()))


_PATHS: WeakKeyDictionary[GMR, tuple[Array, tuple[int, tuple[float, ...]], ComponentPath]] = WeakKeyDictionary()


def _learned(gmr: GMR, n_samples: int, fixed_times: tuple[float, ...]) -> ComponentPath:
    """Decompose the learned path.

    The last result for each regression is cached, because a decomposition does not depend on the scene.
    """
    key = (n_samples, fixed_times)
    if gmr in _PATHS and _PATHS[gmr][0] is gmr.means_ and _PATHS[gmr][1] == key:  # fitting again makes new means
        return _PATHS[gmr][2]
    times = _sample_times(n_samples, fixed_times)
    tolerance = gmr.predict(times)[1]
    responsibilities = gmr.responsibilities(times)
    centres = np.asarray(np.argmin(np.abs(times[:, None] - gmr.time_means_), axis=0), dtype=np.intp)
    yields = tolerance[centres] + TOLERANCE_FLOOR**2 * np.eye(3)
    influence = np.where(responsibilities < NEGLIGIBLE_RESPONSIBILITY, 0.0, responsibilities)
    path = ComponentPath(
        nominal=Trajectory(times, *gmr.nominal(times)),
        fixed_times=fixed_times,
        responsibilities=responsibilities,
        basis=_window(times, fixed_times, PIN_WIDTH)[:, None] * influence,
        means=gmr.position_means_,
        covariances=gmr.position_covariances_ + TOLERANCE_FLOOR**2 * np.eye(3),
        yields=yields,
        centres=centres,
        precisions=np.asarray(np.linalg.inv(yields), dtype=np.float64),
        tolerance=tolerance,
        rotation_tolerance=_rotation_tolerance(gmr, times),
    )
    _PATHS[gmr] = (gmr.means_, key, path)
    return path


def _rotation_tolerance(gmr: GMR, times: Array) -> Array:
    """Return two standard deviations of the rotation at each time, shape (n,) [rad]."""
    if not gmr.has_orientation_:
        return np.zeros(len(times))
    largest = np.linalg.eigvalsh(gmr.predict_orientation(times)[1])[:, -1]
    return np.asarray(2.0 * np.sqrt(np.maximum(largest, 0.0)))


def _sample_times(n_samples: int, fixed_times: tuple[float, ...]) -> Array:
    """Return nearly equally spaced times that include every fixed time, because fixed points must be samples."""
    even = np.linspace(0.0, fixed_times[-1], n_samples)
    apart = np.abs(even[:, None] - np.asarray(fixed_times)).min(axis=1) > 0.01 * even[1]
    return np.unique(np.concatenate([even[apart], fixed_times]))


def _window(times: Array, fixed_times: Sequence[float], width: float) -> Array:
    """Return the window w (n,): 0 at each fixed time, 1 where each fixed time is at least ``width`` durations away."""
    distance = np.min(np.abs(times[:, None] - np.asarray(fixed_times)[None, :]), axis=1)
    return quintic_step(distance / (width * (times[-1] - times[0])))


def _knots(times: Array, fixed_times: Sequence[float], n_pieces: int) -> Array:
    """Return the sample indices of the knots: about ``n_pieces`` evenly spaced ones, and more near each fixed time."""
    last = len(times) - 1
    widest = max(last / n_pieces, 1.0)
    fixed = np.unique(np.searchsorted(times, fixed_times)).tolist()
    knots = set(fixed)
    for start, end in pairwise(fixed):
        reach, step = 0, 1.0
        while step < widest and 2 * (reach + step) < end - start:
            reach += round(step)
            knots |= {start + reach, end - reach}
            step *= 1.6
        inner = np.linspace(start + reach, end - reach, max(int(np.ceil((end - start - 2 * reach) / widest)), 1) + 1)
        knots |= set(np.round(inner).astype(int).tolist())
    return np.asarray(times[sorted(knots)])
