"""The two dynamical systems of a movement primitive.

The canonical system is the primitive's clock; it gives the phase and the basis functions of the phase. The
transformation system is a spring and damper that follows a moving target.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm

from imitarm.errors import InputError, UnknownNameError
from imitarm.validation import finite_number

Array = NDArray[np.float64]
Adjustment = Literal["progress", "hoffmann", "rotodilatation"]

ADJUSTMENTS = ("progress", "hoffmann", "rotodilatation")
DECAY = float(np.log(100.0))  # alpha: the phase is 0.01 when the duration is over
_TINY = 1e-300  # far past the end all basis functions underflow to 0
_SAME_STEP = 1e-12  # steps that fill the duration to this fraction count as a whole number of steps
_MOST_STEPS = 100_000  # of a motion whose steps are computed in advance
_PARTS, _PARTS_PER_BASIS = 200, 5  # of the duration, at least; with so many a motion ends within 1e-8 m of its goal
_FINE, _FINE_PER_BASIS = 512, 12  # steps of the grid on which responses are computed, at least
_START = 0.05  # of the duration: the part of a noisy motion that shows its velocity at the start
_NOISE = 1e-4  # [m] the repeatability of industrial arms


# ----- canonical system: the phase and the basis functions


@dataclass(frozen=True)
class PhaseBasis:
    r"""Basis functions of the phase s; the phase decays from 1 to 0.01 during the motion, and afterwards to 0.

    .. math::
        \tau \dot s = -\alpha s, \qquad b_i(s) = \frac{\psi_i(s) s}{\sum_j \psi_j(s)}, \qquad
        \psi_i(s) = \exp(-h_i (s - c_i)^2)

    (thesis Eqs 2.10 and 2.11.) The centres are equally spaced in time, and h_i is 2 divided by the squared distance to
    the next centre.

    Attributes:
        n_basis: number N of functions.
    """

    n_basis: int

    @cached_property
    def centers(self) -> Array:
        """c_i, shape (N,)."""
        return np.exp(-DECAY * np.linspace(0.0, 1.0, self.n_basis))

    @cached_property
    def widths(self) -> Array:
        """h_i, shape (N,)."""
        gaps = -np.diff(self.centers)
        return np.asarray(2.0 / np.concatenate([gaps, gaps[-1:]]) ** 2)

    def at(self, s: Array) -> Array:
        """Return b_i(s) for phases s (n,), shape (n, N)."""
        distance = s[:, None] - self.centers
        psi = np.exp(distance * distance * -self.widths)
        psi *= (s / (psi.sum(axis=1) + _TINY))[:, None]
        return psi


@lru_cache(maxsize=8)
def phase_basis(n_basis: int) -> PhaseBasis:
    """Return the basis of ``n_basis`` functions; every call returns the same object."""
    return PhaseBasis(n_basis)


@lru_cache(maxsize=16)
def basis_on_grid(n_basis: int, n_steps: int) -> tuple[Array, Array]:
    """Return phases (2 n + 1,) and basis (2 n + 1, N) at the beginning, middle and end of ``n_steps`` equal steps."""
    s = np.exp(-DECAY * np.linspace(0.0, 1.0, 2 * n_steps + 1))
    basis = phase_basis(n_basis).at(s)
    s.setflags(write=False)
    basis.setflags(write=False)
    return s, basis


# ----- transformation system: a spring and damper, integrated exactly


class Gains(NamedTuple):
    """Stiffness K and damping D of the spring ``tau^2 x'' = K (y - x) - D tau x'`` with the target y.

    Attributes:
        stiffness: K.
        damping: D; ``D = 2 sqrt(K)`` is critical.
    """

    stiffness: float
    damping: float

    @property
    def damping_ratio(self) -> float:
        """Damping ratio ``D / (2 sqrt(K))``: 1 is critical damping; a larger ratio makes the spring slower."""
        return float(self.damping / (2.0 * np.sqrt(self.stiffness)))

    @classmethod
    def of(cls, gains: str | Gains, what: str) -> Self:
        """Return the gains with the given name, or check and return the given gains.

        Args:
            gains: a name in ``GAINS``, or stiffness and damping.
            what: name of the class that uses the gains; error messages begin with it.

        Raises:
            UnknownNameError: when there are no gains of that name.
            InputError: when stiffness or damping is not a number above 0.
        """
        if isinstance(gains, str):
            if gains not in GAINS:
                raise UnknownNameError.among("gains", gains, GAINS)
            gains = GAINS[gains]
        if not isinstance(gains, tuple | list) or len(gains) != 2:
            raise InputError(f"{what}: gains must be one of {', '.join(GAINS)}, or Gains(stiffness, damping)")
        return cls(*(finite_number(g, f"{what}: stiffness and damping", above=0.0) for g in gains))


# The thesis calls K = 139.26, D = 28 critically damped; its damping ratio is 1.186.
GAINS = {"critical": Gains(139.26, 2.0 * float(np.sqrt(139.26))), "thesis": Gains(139.26, 28.0)}


class Propagator(NamedTuple):
    """One step of the spring: ``z_next = transition @ z + drive @ [y_0; ...; y_2m]``, with z = [x; tau x'].

    The step is divided into m equal parts, and the target ``y`` is given at the beginning, middle and end of each part.
    The integration over a part is exact if the target is a parabola within the part. For other targets, the error
    decreases with the fourth power of the part's length. A part is at most 1/200 of the duration, and at most a fifth
    of the distance between two basis functions.

    Attributes:
        transition: transition matrix, shape (2, 2).
        drive: drive matrix, shape (2, 2 m + 1).
        push: change of z during one step if 1 is added to ``tau^2 x''``, shape (2,).
        instants: times at which the target is needed, shape (2 m + 1,). They are counted from the start of the step, in
            fractions of the motion's duration.
    """

    transition: Array
    drive: Array
    push: Array
    instants: Array

    @property
    def n_parts(self) -> int:
        """Number m of parts."""
        return len(self.instants) // 2


@lru_cache(maxsize=256)
def propagator(gains: Gains, step: float, n_basis: int = 0) -> Propagator:
    """Return one step of the spring.

    Args:
        gains: gains of the spring.
        step: fraction of the duration, above 0.
        n_basis: number of basis functions of the target.
    """
    K, D = gains
    m = max(1, int(np.ceil(step * max(_PARTS, _PARTS_PER_BASIS * n_basis) - 1e-9)))
    part = step / m
    # the state is extended by the target and its two derivatives, which makes the whole a linear system at rest
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = A[3, 4] = 1.0
    A[1, :3] = -K, -D, K
    whole = expm(A * part)
    parabola = np.array([[1.0, 0.0, 0.0], [-3.0 / part, 4.0 / part, -1.0 / part], np.array([4.0, -8.0, 4.0]) / part**2])
    transition, drive_of_part = whole[:2, :2], whole[:2, 2:] @ parabola
    drive = np.zeros((2, 2 * m + 1))
    for i in range(m):
        drive = transition @ drive
        drive[:, 2 * i : 2 * i + 3] += drive_of_part
    instants = np.linspace(0.0, step, 2 * m + 1)
    return Propagator(np.linalg.matrix_power(transition, m), drive, drive.sum(axis=1) / K, instants)


def targets_by_step(step: Propagator, target: Array) -> Array:
    """Return ``target`` (2 n m + 1, C) as one column for each of the n steps, shape (2 m + 1, n, C)."""
    stride = len(step.instants) - 1
    last = len(target) - stride
    return np.stack([target[i : last + i : stride] for i in range(stride + 1)])


def roll_out(step: Propagator, start: Array, target: Array) -> Array:
    """Return the states after each of n steps, all computed at once.

    The recursion ``z_k = E z_(k-1) + q_k`` makes each state a sum with one term for each earlier step. Each pass over
    the arrays doubles the number of terms in every state. Therefore n steps need log2(n) passes.

    Args:
        step: propagator of one of the n equal steps.
        start: [x; tau x'] at the beginning, for C coordinates, shape (2, C).
        target: y at the ``instants`` of all n steps, in the order of time, shape (2 n m + 1, C).

    Returns:
        The states x and tau x' at the beginning and after each step, shape (2, n + 1, C).
    """
    E = step.transition
    C = target.shape[1]
    q = step.drive @ targets_by_step(step, target).reshape(len(step.instants), -1)
    z = np.concatenate([start, q], axis=1)  # time runs along the columns, C of them a step
    reach = C
    while reach < z.shape[1]:
        z[:, reach:] += E @ z[:, :-reach]
        E, reach = E @ E, 2 * reach
    return z.reshape(2, -1, C)


# ----- the target of the spring


class PlannedSteps(NamedTuple):
    """All steps of a motion that have the same length, computed in advance.

    Attributes:
        transition: transition matrix of one step, shape (2, 2).
        pushes: contribution of the target to each of the n steps, arrays of shape (2, 3).
    """

    transition: Array
    pushes: list[Array]


@dataclass(frozen=True, eq=False)
class MovingTarget:
    """The target that the spring follows, as a function of the phase: ``y(s) = g + sum_i (w_i - (g - x_0)) b_i(s)``.

    The basis functions b_i sum to s, so y(s) equals ``g - (g - x_0) s + f(s)``.

    Attributes:
        start: x_0, position (3,) [m].
        goal: g, position (3,) [m].
        duration: duration of the motion [s].
        adjustment: name of the method that changes the learned motion for another start and goal, see ``DMP``.
        drive: w - (g - x_0), where the weights w are adjusted to this start and goal, shape (N, 3) [m].
    """

    start: Array
    goal: Array
    duration: float
    adjustment: Adjustment
    drive: Array
    _plans: dict[float, PlannedSteps | None] = field(default_factory=dict, repr=False)

    def at(self, s: Array) -> Array:
        """Return y at phases s (n,), shape (n, 3)."""
        return np.asarray(self.goal + phase_basis(len(self.drive)).at(s) @ self.drive)

    def on_grid(self, n_steps: int) -> Array:
        """Return y at the beginning, middle and end of ``n_steps`` equal steps, shape (2 n + 1, 3)."""
        return np.asarray(self.goal + basis_on_grid(len(self.drive), n_steps)[1] @ self.drive)

    def plan(self, gains: Gains, step: float) -> PlannedSteps | None:
        """Return all steps of a motion in advance, or None; ``step`` is their length as a fraction of the duration.

        The target does not depend on the state, so one plan serves the whole motion. If the goal moves, however, every
        step has a new target, and a plan would be used only once. Therefore, the first call with a step length returns
        None, and only the second call computes the plan.
        """
        if step not in self._plans:
            self._plans[step] = None
            return None
        plan = self._plans[step]
        if plan is None and 1.0 / step < _MOST_STEPS:
            n = round(1.0 / step)
            one = propagator(gains, step, len(self.drive))
            m = one.n_parts
            if abs(n * step - 1.0) < _SAME_STEP:
                y = self.on_grid(n * m)
            else:
                n = int(np.ceil(1.0 / step))
                y = self.at(np.exp(-0.5 * DECAY * step / m * np.arange(2 * n * m + 1)))
            plan = PlannedSteps(one.transition, list(one.drive @ np.moveaxis(targets_by_step(one, y), 0, 1)))
            self._plans[step] = plan
        return plan


# ----- the weights that reproduce a path


class FittedWeights(NamedTuple):
    """A primitive's parameters, fitted to one path.

    Attributes:
        start: x_0, shape (3,) [m].
        goal: g, shape (3,) [m].
        weights: w, shape (N, 3) [m].
        progress_weights: w_p, shape (N,).
        start_rate: T x'(0), shape (3,) [m].
        path_length: path length of the fitted motion [m].
    """

    start: Array
    goal: Array
    weights: Array
    progress_weights: Array
    start_rate: Array
    path_length: float


@dataclass(frozen=True, eq=False)
class _Responses:
    """Responses of the spring on the fine grid to a unit start, a unit rate, a unit goal, and each basis function."""

    values: Array  # (n_steps + 1, 3 + N)
    rates: Array
    spline: CubicHermiteSpline


@lru_cache(maxsize=8)
def _responses(gains: Gains, n_basis: int) -> _Responses:
    fine = max(_FINE, _FINE_PER_BASIS * n_basis)
    basis = basis_on_grid(n_basis, fine)[1]
    nothing = np.zeros(len(basis))
    inputs = np.column_stack([nothing, nothing, np.ones_like(nothing), basis])
    start = np.zeros((2, inputs.shape[1]))
    start[0, 0] = start[1, 1] = 1.0
    z = roll_out(propagator(gains, 1.0 / fine, n_basis), start, inputs)
    return _Responses(z[0], z[1], CubicHermiteSpline(np.linspace(0.0, 1.0, fine + 1), z[0], z[1]))


def fit_weights(
    fraction: Array, x: Array, gains: Gains, n_basis: int, regularisation: float, *, exact_ends: bool = False
) -> FittedWeights:
    r"""Return the weights with which the primitive reproduces a path.

    The motion is linear in ``d_i = w_i - (g - x_0)``. Let ``R_start``, ``R_rate`` and ``R_goal`` be the responses of
    the spring to a start position, a start velocity and a goal of 1. Let ``R_i`` be its response to the basis function
    i. Then ``x(t) = R_start x_0 + R_rate v_0 + R_goal g + sum_i d_i R_i``. The usual regression fits forces (such as
    ``tau v' + D v``) and needs measured accelerations. This function instead fits the positions x(t) to the path.
    Therefore noise is not differentiated, and the samples need not be evenly spaced in time. The regression minimises
    the position error of the reproduced motion in metres.

    The motion passes exactly through its start and its goal, which are the first and the last sample. Noise may move
    one of these samples more than 0.1 mm away from the path that fits all samples. A motion through such a sample would
    have a high jerk. If ``exact_ends`` is False, the motion therefore starts or ends on the fitted path instead.

    The last ``d_i`` is set to 0, so that the target equals the goal at the end of the duration. The regression hardly
    determines the last ``d_i``. With another value, the tool could move decimetres away from the goal after the end of
    the motion.

    Args:
        fraction: fraction of the duration, from 0 to 1, shape (n,).
        x: positions, shape (n, 3) [m].
        gains: gains of the spring.
        n_basis: number N of basis functions.
        regularisation: weight of the penalty in the ridge regression, relative to the mean square response of a basis
            function.
        exact_ends: whether start and goal are always exactly the first and the last sample.
    """
    responses = _responses(gains, n_basis)
    R = responses.spline(fraction)
    rate = start_rate(fraction, x, 0.0 if exact_ends else _START)
    ends = np.stack([x[0], rate, x[-1]])
    if not exact_ends:
        beside = _beside(R, x - R[:, :3] @ ends, n_basis, regularisation)
        if start_rate(1.0 - fraction[::-1], x[::-1]).any():  # it ends in motion: the last sample is as good as any
            beside[2] = 0.0
        ends += np.where(np.linalg.norm(beside, axis=1, keepdims=True) > _NOISE, beside, 0.0)
    base = R[:, :3] @ ends
    force = phase_basis(n_basis).centers  # of a drive of 1: late ones carry the factor s = 0.01
    drives = _without_last(R[:, 3:], x - base, force, regularisation, ends[2] - base[-1])
    progress, path_length = _progress(responses.rates @ np.concatenate([ends, drives]))
    base_progress = responses.values[:, 2]
    progress_drives = _without_last(
        responses.values[:, 3:], (progress - base_progress)[:, None], force, regularisation, 1.0 - base_progress[-1:]
    )
    weights = drives + (ends[2] - ends[0])
    return FittedWeights(ends[0], ends[2], weights, progress_drives[:, 0] + 1.0, rate, path_length)


def progress_at(fraction: Array, progress_weights: Array, gains: Gains) -> Array:
    """Return the travelled fraction of the path, 0 to 1, at n times.

    The argument ``fraction``, shape (n,), contains each time divided by the duration.
    """
    R = _responses(gains, len(progress_weights)).spline(np.clip(fraction, 0.0, 1.0))
    return np.asarray(R[:, 2] + R[:, 3:] @ (progress_weights - 1.0))


def _without_last(R: Array, y: Array, force: Array, regularisation: float, end: Array) -> Array:
    """Return the solution d of :func:`_ridge` in which the last element is set to 0."""
    drives = _ridge(R[:, :-1], y, force[:-1], regularisation, end)
    return np.concatenate([drives, np.zeros((1, y.shape[1]))])


def _beside(R: Array, y: Array, n_basis: int, regularisation: float) -> Array:
    """Return the offsets of the best path from the first and the last sample, as rows (start, 0, goal) [m]."""
    columns = np.concatenate([R[:, :1], R[:, 3:-1]], axis=1)
    solution = _ridge(columns, y, np.append(1.0, phase_basis(n_basis).centers[:-1]), regularisation)
    start, goal = columns[[0, -1]] @ solution - y[[0, -1]]
    return np.stack([start, np.zeros(3), goal])


def _ridge(R: Array, y: Array, force: Array, regularisation: float, end: Array | None = None) -> Array:
    """Solve ``R d = y`` for d by ridge regression with a penalty on ``force d``; ``R[-1] d`` must equal ``end``."""
    n = R.shape[1]
    S = R / force
    kkt = np.zeros((n + 1, n + 1))
    kkt[:n, :n] = S.T @ S / len(S)
    kkt[np.arange(n), np.arange(n)] += regularisation * np.trace(kkt) / n
    right = np.concatenate([S.T @ y / len(S), np.zeros((1, y.shape[1])) if end is None else end[None]])
    if end is None:
        kkt[n, n] = 1.0
    else:
        kkt[n, :n] = kkt[:n, n] = S[-1]
    return np.asarray(np.linalg.solve(kkt, right)[:n] / force[:, None])


def _progress(rate: Array) -> tuple[Array, float]:
    """Return the fraction of the path that has been travelled, on the fine grid, and the path length [m].

    For a path of length 0 the fraction is a minimum-jerk profile.
    """
    speed = np.linalg.norm(rate, axis=1)
    done = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / (len(rate) - 1)
    length = float(done[-1])
    if length > 1e-9:
        return done / length, length
    u = np.linspace(0.0, 1.0, len(rate))
    return u**3 * (10.0 + u * (6.0 * u - 15.0)), length


def start_rate(fraction: Array, x: Array, part: float = _START) -> Array:
    """Return the velocity at the first sample, in m per duration, shape (3,).

    The velocity is the slope of a parabola through the first samples. A velocity below three standard errors, or below
    a tenth of the mean speed, is replaced by 0.

    Args:
        fraction: fraction of the duration, from 0 to 1, shape (n,).
        x: positions, shape (n, 3) [m].
        part: fraction of the duration that the parabola covers; at least 6 samples are used.
    """
    n = max(6, int(np.searchsorted(fraction, part, side="right")))
    if len(fraction) < n:
        return np.zeros(3)
    table = fraction[:n, None] ** np.arange(3)
    solution, *_ = np.linalg.lstsq(table, x[:n], rcond=None)
    variance = np.sum((x[:n] - table @ solution) ** 2, axis=0) / (n - 3)
    error = np.sqrt(variance.sum() * np.linalg.inv(table.T @ table)[1, 1])
    mean_speed = np.linalg.norm(np.diff(x, axis=0), axis=1).sum()
    slope = np.linalg.norm(solution[1])
    return solution[1] if slope > max(3.0 * error, 0.1 * mean_speed) else np.zeros(3)
