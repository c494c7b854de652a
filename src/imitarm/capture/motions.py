"""Motions of a synthetic person's hand, all determined by a seed: random reaches, and shapes drawn repeatedly."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline

from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.errors import UnknownNameError
from imitarm.validation import finite_number

Array = NDArray[np.float64]
Truth = Callable[[float], Skeleton]
"""A moving person: a function that returns the true position of every joint at a time [s]."""

REACHES = ("inside", "edge")
REST = 1.0  # [s] the hand is still at the beginning, so that a robot can engage
_INSIDE = np.array([[-0.15, 0.5], [-0.7, 0.1], [0.7, 1.0]])  # direction from the shoulder: out, up, forward
_AWAY = (0.55, 0.85)  # distance from the shoulder over the reach
_SPEED = (0.25, 0.55)  # [m/s] mean speed of a reach


def minimum_jerk(points: ArrayLike, times: ArrayLike) -> BSpline:
    """Return the quintic spline that passes through ``points`` (n, d) at ``times`` (n,) and is at rest at both ends.

    The quintic spline is the minimum-jerk path through the points (Flash and Hogan 1985).
    """
    at = np.asarray(points, dtype=float)
    zero = np.zeros(at.shape[1])
    return make_interp_spline(
        np.asarray(times, dtype=float), at, k=5, bc_type=([(1, zero), (2, zero)], [(1, zero), (2, zero)])
    )


def reaching(person: Person, seed: int, *, duration: float = 12.0, kind: str = "inside") -> Truth:
    """Return the motion of a person who reaches from point to point with the right hand.

    Args:
        person: the person who moves.
        seed: seed of the random points and speeds.
        duration: duration of the motion [s]; the hand is at rest during the first second.
        kind: ``"inside"``: every reach ends at 55 % to 85 % of the arm's length from the shoulder. ``"edge"``: at the
            end of every second reach, the arm is fully stretched for some time. A robot arm with the same proportions
            is then at or beyond the limit of its workspace.

    Raises:
        UnknownNameError: when there is no such kind.
        InputError: when the duration is shorter than 4 s.
    """
    if kind not in REACHES:
        raise UnknownNameError.among("kind of reach", kind, REACHES)
    finite_number(duration, "reaching: duration", "s", at_least=4.0)
    rng = np.random.default_rng([30312, person.seed, seed])
    place = _comfortable(rng, person)
    places, times = [place], [REST]
    out = False
    while times[-1] < duration:
        out = kind == "edge" and not out
        place = _stretched(rng, person) if out else _comfortable(rng, person)
        pace = max(float(np.linalg.norm(place - places[-1])) / rng.uniform(*_SPEED), 0.6)
        places.append(place)
        times.append(times[-1] + pace)
        if out:
            places.append(place + rng.normal(0.0, 0.003, 3))
            times.append(times[-1] + 0.6)
    path = minimum_jerk(places, times)

    def truth(time: float) -> Skeleton:
        away = path(np.clip(time, times[0], times[-1]))
        return person.skeleton(time, person.shoulder("right", 0.0) + away)

    return truth


def _comfortable(rng: np.random.Generator, person: Person) -> Array:
    out, up, forward = rng.uniform(_INSIDE[:, 0], _INSIDE[:, 1])
    direction = np.array([out, up, -forward])
    return np.asarray(rng.uniform(*_AWAY) * person.reach * direction / np.linalg.norm(direction))


def _stretched(rng: np.random.Generator, person: Person) -> Array:
    side, up = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.15)
    direction = np.array([side, up, -1.0])
    return np.asarray(1.1 * person.reach * direction / np.linalg.norm(direction))


_RAMP = 1.0  # [s] the hand takes to reach its speed, and to come to rest again


def _circle(angle: float) -> tuple[float, float, float]:
    return math.cos(angle) - 1.0, math.sin(angle), 0.0


def _eight(angle: float) -> tuple[float, float, float]:
    return math.sin(angle), 0.5 * math.sin(2.0 * angle), 0.0


def _wave(angle: float) -> tuple[float, float, float]:
    return math.sin(angle), -0.3 * (1.0 - math.cos(2.0 * angle)), 0.0


# shape; place: out, up, forward over the reach; smallest and largest size [m]; shortest and longest period [s]
_Shape = Callable[[float], tuple[float, float, float]]
DRAWINGS: dict[str, tuple[_Shape, tuple[float, float, float], tuple[float, float], tuple[float, float]]] = {
    "circle": (_circle, (0.15, -0.15, 0.65), (0.07, 0.13), (2.5, 4.5)),
    "eight": (_eight, (0.05, -0.15, 0.65), (0.10, 0.18), (3.0, 5.0)),
    "wave": (_wave, (0.40, 0.35, 0.35), (0.06, 0.12), (0.7, 1.2)),
}
"""Shapes that a hand can draw in a plane perpendicular to the line of sight, by name."""


def drawing(person: Person, seed: int, *, duration: float = 12.0, kind: str = "circle") -> Truth:
    r"""Return the motion of a person who draws a shape repeatedly with the right hand.

    Each shape is a curve whose parameter is an angle [rad]. At time t, the angle is :math:`\omega\,s(t)`, where
    :math:`\omega` is the angular frequency [rad/s]. The warped time s is constant during the first second and after the
    end of the motion. In the second after the start, ds/dt rises from 0 to 1. In the last second, ds/dt falls from 1 to
    0. Both transitions follow a minimum-jerk profile.

    Args:
        person: the person who moves.
        seed: seed of the shape's random position, size and period.
        duration: duration of the motion [s]; the hand is at rest during the first second.
        kind: shape, one of :data:`DRAWINGS`.

    Raises:
        UnknownNameError: when there is no such shape.
        InputError: when the duration is shorter than 4 s.
    """
    if kind not in DRAWINGS:
        raise UnknownNameError.among("drawing", kind, DRAWINGS)
    finite_number(duration, "drawing: duration", "s", at_least=4.0)
    shape, place, sizes, periods = DRAWINGS[kind]
    rng = np.random.default_rng([30315, person.seed, seed])
    out, up, forward = np.array(place) + rng.uniform(-0.05, 0.05, 3)
    middle = person.shoulder("right", 0.0) + person.reach * np.array([out, up, -forward])
    size, frequency = rng.uniform(*sizes), 2.0 * math.pi / rng.uniform(*periods)

    def truth(time: float) -> Skeleton:
        return person.skeleton(time, middle + size * np.array(shape(frequency * _warped_time(time, duration))))

    return truth


def _warped_time(time: float, duration: float) -> float:
    """Return the warped time s [s], which is constant at the beginning and at the end."""
    begun = min(max(time, REST), duration) - REST
    ended = begun - (duration - REST - _RAMP)
    passed = max(begun - _RAMP, 0.0) + _RAMP * _ramped(min(begun / _RAMP, 1.0))
    return passed - (_RAMP * _ramped(ended / _RAMP) if ended > 0.0 else 0.0)


def _ramped(u: float) -> float:
    """Return the integral from 0 to u of the minimum-jerk profile 10 u^3 - 15 u^4 + 6 u^5."""
    return u**4 * (2.5 - 3.0 * u + u * u)
