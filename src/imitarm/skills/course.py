"""One use of a movement primitive: from where, to where, how long, and the force that belongs to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.skills.phase_basis import DECAY, on_grid, phase_basis
from imitarm.skills.spring import Gains, by_step, propagator

Array = NDArray[np.float64]
Adjustment = Literal["progress", "hoffmann", "rotodilatation"]

ADJUSTMENTS = ("progress", "hoffmann", "rotodilatation")
_CLOSED = 0.1  # net motion below this share of the path length gives no direction to turn and stretch by
_SAME_STEP = 1e-12  # so little a step may miss a whole number of steps and still be taken for one
_LONGEST_PLAN = 100_000  # steps


class Plan(NamedTuple):
    """A whole course in steps of one length.

    Attributes:
        transition: of one step, shape (2, 2).
        pushes: what the target adds in each step, shape (n, 2, 3).
    """

    transition: Array
    pushes: Array


@dataclass(frozen=True, eq=False)
class Course:
    """Where the spring pulls to, as a function of the phase: ``y(s) = g + sum_i (w_i - (g - x_0)) b_i(s)``.

    The basis functions b_i sum to s, so that is ``g - (g - x_0) s + f(s)``.

    Attributes:
        start: x_0, position (3,) [m].
        goal: g, position (3,) [m].
        duration: [s].
        adjustment: how the learnt motion gives way to another start and goal.
        drive: w - (g - x_0), the weights made ready for these ends, shape (N, 3) [m].
    """

    start: Array
    goal: Array
    duration: float
    adjustment: Adjustment
    drive: Array
    _plans: dict[float, Plan | None] = field(default_factory=dict, repr=False)

    def target(self, s: Array) -> Array:
        """Return y at phases s (n,), shape (n, 3)."""
        return np.asarray(self.goal + phase_basis(len(self.drive)).at(s) @ self.drive)

    def target_on_grid(self, n_steps: int) -> Array:
        """Return y at the begin, middle and end of ``n_steps`` equal steps, shape (2 n + 1, 3)."""
        return np.asarray(self.goal + on_grid(len(self.drive), n_steps)[1] @ self.drive)

    def plan(self, gains: Gains, step: float) -> Plan | None:
        """Return the course in steps of this share of the duration, made when asked for the second time.

        The target does not depend on the state, so who steps through a course with a fixed step needs it computed only
        once. A goal that moves makes a new course at every step, which is asked for once and gets no plan.
        """
        if step not in self._plans:
            self._plans[step] = None
            return None
        plan = self._plans[step]
        if plan is None and 1.0 / step < _LONGEST_PLAN:
            n = round(1.0 / step)
            one = propagator(gains, step)
            m = one.n_parts
            if abs(n * step - 1.0) < _SAME_STEP:
                y = self.target_on_grid(n * m)
            else:
                n = int(np.ceil(1.0 / step))
                y = self.target(np.exp(-0.5 * DECAY * step / m * np.arange(2 * n * m + 1)))
            plan = Plan(one.transition, np.asarray(one.drive @ np.moveaxis(by_step(one, y), 0, 1)))
            self._plans[step] = plan
        return plan


def rotodilatation(learnt: Array, asked: Array, path_length: float) -> Array:
    """Return the (3, 3) turn (the shortest) and stretch that takes ``learnt`` to ``asked`` (Ginesi et al. 2019).

    A motion that comes back to near where it began gives no direction to turn and no length to stretch by: identity.
    """
    a, b = float(np.linalg.norm(learnt)), float(np.linalg.norm(asked))
    if a <= _CLOSED * path_length or a == 0.0:
        return np.eye(3)
    if b == 0.0:
        return np.zeros((3, 3))
    u, v = learnt / a, asked / b
    cosine = float(u @ v)
    if cosine < -1.0 + 1e-9:  # straight back: half a turn about any axis across
        axis = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        axis /= np.linalg.norm(axis)
        return np.asarray((b / a) * (2.0 * np.outer(axis, axis) - np.eye(3)))
    w = np.cross(u, v)
    cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray((b / a) * (np.eye(3) + cross + cross @ cross / (1.0 + cosine)))
