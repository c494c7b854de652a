"""The spring and damper under every movement primitive, integrated exactly."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from imitarm.errors import UnknownNameError

Array = NDArray[np.float64]

_PARTS = 200  # a step is integrated in parts of at most 1 / _PARTS of the duration: the goal is met to 1e-8 m


class Gains(NamedTuple):
    """Stiffness and damping of ``tau^2 x'' = K (y - x) - D tau x'``, in units of the duration: they have no unit.

    Attributes:
        stiffness: K.
        damping: D; ``D = 2 sqrt(K)`` is critical.
    """

    stiffness: float
    damping: float

    @property
    def damping_ratio(self) -> float:
        """``D / (2 sqrt(K))``: 1 is critical, above is sluggish."""
        return float(self.damping / (2.0 * np.sqrt(self.stiffness)))


# The thesis calls its K = 139.26, D = 28 critically damped; its damping ratio is 1.186 (METHODS D.1).
GAINS = {"critical": Gains(139.26, 2.0 * float(np.sqrt(139.26))), "thesis": Gains(139.26, 28.0)}


def gains_named(name: str) -> Gains:
    """Return gains by name.

    Raises:
        UnknownNameError: when there are none of that name.
    """
    if name not in GAINS:
        raise UnknownNameError.among("gains", name, GAINS)
    return GAINS[name]


class Propagator(NamedTuple):
    """One step of the spring: ``z_next = transition @ z + drive @ [y_0; ...; y_2m]``, with z = [x; tau x'].

    The step is divided into m equal parts, each at most 1/200 of the duration, and the target ``y`` is given at the
    beginning, middle and end of every part. A part is exact when the target is a parabola within it, so the error
    falls with the fourth power of its length.

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
def propagator(gains: Gains, step: float) -> Propagator:
    """Return the step of the spring; ``step`` is a fraction of the duration, above 0."""
    K, D = gains
    m = max(1, int(np.ceil(step * _PARTS - 1e-9)))
    part = step / m
    # the state is extended by the target and its two derivatives, which makes the whole a linear system at rest
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = A[3, 4] = 1.0
    A[1, :3] = -K, -D, K
    whole = expm(A * part)
    parabola = np.array([[1.0, 0.0, 0.0], [-3.0 / part, 4.0 / part, -1.0 / part], np.array([4.0, -8.0, 4.0]) / part**2])
    transition, of_part = whole[:2, :2], whole[:2, 2:] @ parabola
    drive = np.zeros((2, 2 * m + 1))
    for i in range(m):
        drive = transition @ drive
        drive[:, 2 * i : 2 * i + 3] += of_part
    return Propagator(
        np.linalg.matrix_power(transition, m), drive, drive.sum(axis=1) / K, np.linspace(0.0, step, 2 * m + 1)
    )


def by_step(step: Propagator, target: Array) -> Array:
    """Return the targets at the instants of each step, shape (2 m + 1, n, C), of ``target`` (2 n m + 1, C)."""
    stride = len(step.instants) - 1
    last = len(target) - stride
    return np.stack([target[i : last + i : stride] for i in range(stride + 1)])


def roll_out(step: Propagator, start: Array, target: Array) -> Array:
    """Return the states at all steps at once.

    The recursion ``z_k = E z_(k-1) + q_k`` is summed by doubling: after j passes each state holds the sum of its last
    2^j terms, so n steps take log2(n) passes over whole arrays instead of a loop.

    Args:
        step: of equal length throughout.
        start: [x; tau x'] at the beginning, shape (2, C).
        target: y at the instants of all steps in turn, shape (2 n m + 1, C).

    Returns:
        x and tau x', shape (2, n + 1, C).
    """
    E = step.transition
    C = target.shape[1]
    # time runs along the columns, C of them a step
    z = np.concatenate([start, step.drive @ by_step(step, target).reshape(len(step.instants), -1)], axis=1)
    reach = C
    while reach < z.shape[1]:
        z[:, reach:] += E @ z[:, :-reach]
        E, reach = E @ E, 2 * reach
    return z.reshape(2, -1, C)
