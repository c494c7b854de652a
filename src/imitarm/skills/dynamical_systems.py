"""The two dynamical systems of a movement primitive.

The canonical system is its clock: the phase, and the basis functions over it. The transformation system is a spring and
damper that follows a moving target; it is integrated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from imitarm.errors import InputError, UnknownNameError
from imitarm.validation import finite_number

Array = NDArray[np.float64]
Adjustment = Literal["progress", "hoffmann", "rotodilatation"]

ADJUSTMENTS = ("progress", "hoffmann", "rotodilatation")
DECAY = float(np.log(100.0))  # alpha: the phase is 0.01 when the duration is over
_TINY = 1e-300  # far past the end all basis functions underflow to 0
_CLOSED = 0.1  # net motion below this fraction of the path length gives no direction to rotate and stretch by
_SAME_STEP = 1e-12  # steps that fill the duration to this fraction count as a whole number of steps
_MOST_STEPS = 100_000  # of a motion whose steps are computed in advance
_PARTS, _PARTS_PER_BASIS = 200, 5  # of the duration, at least; with so many a motion ends within 1e-8 m of its goal


# ----- canonical system: the phase and the basis functions


@dataclass(frozen=True)
class PhaseBasis:
    r"""Basis functions over the phase s, which falls from 1 to 0.01 during the motion and on towards 0 afterwards.

    .. math::
        \tau \dot s = -\alpha s, \qquad b_i(s) = \frac{\psi_i(s) s}{\sum_j \psi_j(s)}, \qquad
        \psi_i(s) = \exp(-h_i (s - c_i)^2)

    (thesis Eqs 2.10 and 2.11.) The centres are equally spaced in time, and h_i is 2 over the squared distance to the
    next centre.

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
    """Return the basis of that size, the same object at every call."""
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
    """Stiffness and damping of ``tau^2 x'' = K (y - x) - D tau x'``. tau is the duration, so both have no unit.

    Attributes:
        stiffness: K.
        damping: D; ``D = 2 sqrt(K)`` is critical.
    """

    stiffness: float
    damping: float

    @property
    def damping_ratio(self) -> float:
        """``D / (2 sqrt(K))``: 1 is critical; above 1 the spring is slower than it could be."""
        return float(self.damping / (2.0 * np.sqrt(self.stiffness)))

    @classmethod
    def of(cls, gains: str | Gains, what: str) -> Self:
        """Return gains by name, or the given ones after a check.

        Args:
            gains: a name in ``GAINS``, or stiffness and damping.
            what: the class that uses them, for messages.

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

    The step is divided into m equal parts, and the target ``y`` is given at the beginning, middle and end of each. A
    part is exact when the target is a parabola within it, so the error falls with the fourth power of its length. A
    part is at most 1/200 of the duration, and at most a fifth of the distance between two basis functions.

    Attributes:
        transition: shape (2, 2).
        drive: shape (2, 2 m + 1).
        push: what an acceleration of 1 (in units of the duration) adds when it is held during the step, shape (2,).
        instants: where the target is needed, as fractions of the duration since the step began, shape (2 m + 1,).
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
        gains: of the spring.
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
    """Return the targets at the instants of each step, shape (2 m + 1, n, C), of ``target`` (2 n m + 1, C)."""
    stride = len(step.instants) - 1
    last = len(target) - stride
    return np.stack([target[i : last + i : stride] for i in range(stride + 1)])


def roll_out(step: Propagator, start: Array, target: Array) -> Array:
    """Return the states after all steps at once.

    The recursion ``z_k = E z_(k-1) + q_k`` is summed by doubling: after j passes each state holds the sum of its last
    2^j terms, so n steps take log2(n) passes over whole arrays instead of a loop.

    Args:
        step: one of n equal steps.
        start: [x; tau x'] at the beginning, shape (2, C).
        target: y at the instants of all steps in turn, shape (2 n m + 1, C).

    Returns:
        x and tau x', shape (2, n + 1, C).
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
    """All steps of one length through a motion, computed in advance.

    Attributes:
        transition: of one step, shape (2, 2).
        pushes: what the target adds, for each of the n steps an array of shape (2, 3).
    """

    transition: Array
    pushes: list[Array]


@dataclass(frozen=True, eq=False)
class MovingTarget:
    """The target that the spring follows, as a function of the phase: ``y(s) = g + sum_i (w_i - (g - x_0)) b_i(s)``.

    The basis functions b_i sum to s, so that is ``g - (g - x_0) s + f(s)``.

    Attributes:
        start: x_0, position (3,) [m].
        goal: g, position (3,) [m].
        duration: of the motion [s].
        adjustment: how the learned motion is changed for another start and goal.
        drive: w - (g - x_0), with the weights w adjusted to this start and goal, shape (N, 3) [m].
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
        """Return all steps of this fraction of the duration, from the second call with the same ``step`` on.

        The target does not depend on the state, so a caller that uses a fixed step needs it computed only once. A goal
        that moves makes a new target at every step. That one is asked once, and no plan is computed for it.
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


def rotodilatation(learned: Array, asked: Array, path_length: float) -> Array:
    """Return the smallest rotation, times a factor, that takes ``learned`` to ``asked``, shape (3, 3).

    After Ginesi, Sansonetto and Fiorini (2019), "DMP++". A motion that comes back to near its start gives no direction
    to rotate and no length to stretch by: the result is then the identity.

    Args:
        learned: from the learned start to the learned goal, shape (3,) [m].
        asked: from the start to the goal of the new motion, shape (3,) [m].
        path_length: of the learned motion [m].
    """
    a, b = float(np.linalg.norm(learned)), float(np.linalg.norm(asked))
    if a <= _CLOSED * path_length or a == 0.0:
        return np.eye(3)
    if b == 0.0:
        return np.zeros((3, 3))
    u, v = learned / a, asked / b
    cosine = float(u @ v)
    if cosine < -1.0 + 1e-9:  # straight back: 180 degrees about any perpendicular axis
        axis = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        axis /= np.linalg.norm(axis)
        return np.asarray((b / a) * (2.0 * np.outer(axis, axis) - np.eye(3)))
    w = np.cross(u, v)
    cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray((b / a) * (np.eye(3) + cross + cross @ cross / (1.0 + cosine)))
