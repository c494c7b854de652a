"""The spring and damper under every movement primitive, integrated exactly."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from imitarm.errors import UnknownNameError

Array = NDArray[np.float64]


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
    """One step of the spring: ``z_next = transition @ z + drive @ [y_begin; y_middle; y_end]``, z = [x; tau x'].

    Exact when the target ``y`` is a parabola within the step, so the error of a step falls with its fourth power.

    Attributes:
        transition: shape (2, 2).
        drive: shape (2, 3).
        push: what an acceleration of 1 in units of the duration adds when held during the step, shape (2,).
    """

    transition: Array
    drive: Array
    push: Array


@lru_cache(maxsize=256)
def propagator(gains: Gains, step: float) -> Propagator:
    """Return the exact step of the spring; ``step`` is a share of the duration."""
    K, D = gains
    # the state is extended by the target and its two derivatives, which makes the whole a linear system at rest
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = A[3, 4] = 1.0
    A[1, :3] = -K, -D, K
    whole = expm(A * step)
    parabola = np.array([[1.0, 0.0, 0.0], [-3.0 / step, 4.0 / step, -1.0 / step], np.array([4.0, -8.0, 4.0]) / step**2])
    drive = whole[:2, 2:] @ parabola
    return Propagator(whole[:2, :2], drive, drive.sum(axis=1) / K)


def roll_out(step: Propagator, start: Array, target: Array) -> Array:
    """Return the states at all steps at once.

    The recursion ``z_k = E z_(k-1) + q_k`` is summed by doubling: after j passes each state holds the sum of its last
    2^j terms, so n steps take log2(n) passes over whole arrays instead of a loop.

    Args:
        step: of equal length throughout.
        start: [x; tau x'] at the beginning, shape (2, C).
        target: y at the beginning, middle and end of the steps in turn, shape (2 n + 1, C).

    Returns:
        x and tau x', shape (2, n + 1, C).
    """
    E = step.transition
    C = target.shape[1]
    parts = np.stack([target[:-1:2], target[1::2], target[2::2]]).reshape(3, -1)
    z = np.concatenate([start, step.drive @ parts], axis=1)  # time runs along the columns, C of them a step
    reach = C
    while reach < z.shape[1]:
        z[:, reach:] += E @ z[:, :-reach]
        E, reach = E @ E, 2 * reach
    return z.reshape(2, -1, C)
