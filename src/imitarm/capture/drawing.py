"""Rhythmic motions of a made-up person's hand: a circle, an eight, a wave; seeded."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.motions import REST, Truth
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError, UnknownNameError

Array = NDArray[np.float64]

_RAMP = 1.0  # [s] in which the hand comes up to speed, and back to rest


def _circle(angle: float) -> tuple[float, float, float]:
    return math.cos(angle) - 1.0, math.sin(angle), 0.0


def _eight(angle: float) -> tuple[float, float, float]:
    return math.sin(angle), 0.5 * math.sin(2.0 * angle), 0.0


def _wave(angle: float) -> tuple[float, float, float]:
    return math.sin(angle), -0.3 * (1.0 - math.cos(2.0 * angle)), 0.0


# shape; where: out, up, forward over the reach; size [m] and period [s], from and to
_Shape = Callable[[float], tuple[float, float, float]]
DRAWINGS: dict[str, tuple[_Shape, tuple[float, float, float], tuple[float, float], tuple[float, float]]] = {
    "circle": (_circle, (0.15, -0.15, 0.65), (0.07, 0.13), (2.5, 4.5)),
    "eight": (_eight, (0.05, -0.15, 0.65), (0.10, 0.18), (3.0, 5.0)),
    "wave": (_wave, (0.40, 0.35, 0.35), (0.06, 0.12), (0.7, 1.2)),
}
"""Shapes that a hand draws in a plane across the line of sight, by name."""


def drawing(person: Person, seed: int, *, duration: float = 12.0, kind: str = "circle") -> Truth:
    r"""Return a person who draws a shape over and over with the right hand.

    The angle in the shape passes as :math:`\omega\,s(t)`, where s is at rest for the first second and at the end, goes
    with time between, and changes over as a motion of least jerk does.

    Args:
        person: who.
        seed: of place, size and period.
        duration: [s]; the first second is still.
        kind: one of :data:`DRAWINGS`.

    Raises:
        UnknownNameError: when there is no such shape.
        InputError: when the duration is shorter than 4 s.
    """
    if kind not in DRAWINGS:
        raise UnknownNameError.among("drawing", kind, DRAWINGS)
    if not 4.0 <= duration < math.inf:
        raise InputError(f"drawing: duration must be at least 4 s, got {duration!r}")
    shape, place, sizes, periods = DRAWINGS[kind]
    rng = np.random.default_rng([30315, person.seed, seed])
    out, up, forward = np.array(place) + rng.uniform(-0.05, 0.05, 3)
    middle = person.shoulder("right", 0.0) + person.reach * np.array([out, up, -forward])
    size, frequency = rng.uniform(*sizes), 2.0 * math.pi / rng.uniform(*periods)

    def truth(time: float) -> Skeleton:
        return person.skeleton(time, middle + size * np.array(shape(frequency * _course(time, duration))))

    return truth


def _course(time: float, duration: float) -> float:
    """Return how much time has passed for a hand that begins and ends at rest [s]."""
    begun = min(max(time, REST), duration) - REST
    ended = begun - (duration - REST - _RAMP)
    passed = max(begun - _RAMP, 0.0) + _RAMP * _ramped(min(begun / _RAMP, 1.0))
    return passed - (_RAMP * _ramped(ended / _RAMP) if ended > 0.0 else 0.0)


def _ramped(u: float) -> float:
    """Return the integral of the minimum-jerk course 10 u^3 - 15 u^4 + 6 u^5."""
    return u**4 * (2.5 - 3.0 * u + u * u)
