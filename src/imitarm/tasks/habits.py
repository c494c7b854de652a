"""Synthetic teachers: persons with different habits, each of whom demonstrates the same motion several times.

A learned skill contains the habits of its teachers. With one teacher, all habits of this teacher become part of the
skill. With several teachers, different habits partly cancel each other in the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

REPEATS = 8  # demonstrations by each teacher, as in the experiment of the thesis (section 4.2)
_SAMPLES = 200  # of a demonstration
_UNEVEN = 0.15  # standard deviation of the bend from one repeat to the next, as a fraction of the bend
_WAVES = 4  # of the wobble


@dataclass(frozen=True, eq=False)
class Motion:
    r"""A motion to demonstrate: a curve as a function of the progress p, from 0 at the start to 1 at the goal.

    A demonstration of the motion is the curve

    .. math:: x(p) = c(p) + (k - 1 + 0.15\, a)\, b(p) + \sum_{i=1}^2 (o_i + \beta_i)\, s_i(p) + \text{wobble}

    Here, c is the ideal curve, and b a bend of the curve. A teacher with a factor k above 1 exaggerates this bend. The
    constants :math:`o_i` belong to the teacher, and :math:`s_i` is the spread between repeats. The random numbers a and
    :math:`\beta_i` are different in each repeat. The wobble is a smooth random motion of the hand.

    Attributes:
        name: name of the task.
        curve: ideal positions c at n evenly spaced values of the progress, shape (n, 3) [m].
        bend: displacement b that a teacher with k = 2 adds to the curve, at the same values, shape (n, 3) [m].
        spread: two displacements :math:`s_i`, each one standard deviation of the demonstrations, at the same values,
            shape (2, n, 3) [m]. The spread is 0 where the motion must be precise.
        free: axes along which the hand may wobble (1) or not (0), shape (3,).
        duration: duration for a teacher without habits [s].
    """

    name: str
    curve: Callable[[Array], Array]
    bend: Callable[[Array], Array]
    spread: Callable[[Array], Array]
    free: tuple[float, float, float]
    duration: float = 4.0


@dataclass(frozen=True, eq=False)
class Habits:
    r"""Habits of one teacher, the same in all demonstrations by this teacher.

    The progress is :math:`p = m(w(u))` of the fraction u of the duration, with the minimum-jerk profile
    :math:`m(w) = 10 w^3 - 15 w^4 + 6 w^5` and the warp :math:`w(u) = u + e\, u (1 - u) + h \sin(2 \pi u) / (2 \pi)`.

    Attributes:
        pace: duration of the teacher's demonstrations, divided by the motion's duration.
        eagerness: e, positive when the teacher is fast at first and slow towards the goal.
        hesitation: h, positive when the teacher is slow in the middle.
        curvature: factor k of the bends; above 1, the teacher exaggerates them.
        offset: constants :math:`o_i`, which displace the path in units of the motion's spread, shape (2,).
        noise: standard deviation of the wobble [m].
    """

    pace: float = 1.0
    eagerness: float = 0.0
    hesitation: float = 0.0
    curvature: float = 1.0
    offset: tuple[float, float] = (0.0, 0.0)
    noise: float = 0.0005

    @classmethod
    def from_seed(cls, seed: int) -> Habits:
        """Return the habits of the teacher with number ``seed``."""
        rng = np.random.default_rng([41, seed])
        eagerness, hesitation = rng.uniform(-0.35, 0.35, size=2)
        return cls(
            pace=float(rng.uniform(0.8, 1.3)),
            eagerness=float(eagerness),
            hesitation=float(hesitation),
            curvature=float(rng.uniform(0.8, 1.2)),
            offset=(float(rng.normal()), float(rng.normal())),
            noise=float(rng.uniform(0.0002, 0.001)),
        )

    def progress(self, u: Array) -> Array:
        """Return the progress at the fractions ``u`` (n,) of the duration; the progress increases from 0 to 1."""
        w = u + self.eagerness * u * (1.0 - u) + self.hesitation * np.sin(2.0 * np.pi * u) / (2.0 * np.pi)
        return np.asarray(10 * w**3 - 15 * w**4 + 6 * w**5)


NO_HABITS = Habits()


def s_shaped_reach(*, planar: bool) -> Motion:
    """Return an S-shaped reach of 0.6 m. The repeats agree at both ends and differ in the middle.

    Args:
        planar: whether to keep the height constant, as in a task on a table.
    """

    def curve(p: Array) -> Array:
        z = np.full_like(p, 0.10) if planar else 0.30 + 0.05 * np.sin(np.pi * p)
        return np.stack([0.6 * p, 0.10 * np.sin(2.0 * np.pi * p), z], axis=1)

    def spread(p: Array) -> Array:
        loose = np.sin(np.pi * p)
        return np.stack([along(1, 0.02 * loose), along(2, (0.0 if planar else 0.015) * loose)])

    return Motion(
        "s-shaped reach",
        curve,
        bend=lambda p: along(1, 0.10 * np.sin(2.0 * np.pi * p)),
        spread=spread,
        free=(1.0, 1.0, 0.0 if planar else 1.0),
    )


def along(axis: int, values: Array) -> Array:
    """Return displacements (n, 3) by ``values`` (n,) along x, y or z (``axis`` 0, 1 or 2)."""
    return np.eye(3)[axis] * values[:, None]


def demonstrate(
    motion: Motion, habits: Habits, n_demonstrations: int, rng: np.random.Generator, source: str
) -> list[Demonstration]:
    """Let one teacher demonstrate a motion.

    Args:
        motion: motion to demonstrate.
        habits: habits of the teacher.
        n_demonstrations: number of demonstrations.
        rng: random generator for the differences between the demonstrations.
        source: name of the teacher, which becomes the source of the demonstrations together with their number.
    """
    u = np.linspace(0.0, 1.0, _SAMPLES)
    p = habits.progress(u)
    curve, bend, spread = motion.curve(p), motion.bend(p), motion.spread(p)
    waves = np.stack([np.sin((k + 2) * np.pi * u) for k in range(_WAVES)], axis=1)
    demonstrations = []
    for i in range(n_demonstrations):
        a, *beta = rng.normal(size=3)
        aside = np.tensordot(np.array(habits.offset) + beta, spread, axes=1)
        wobble = habits.noise * rng.normal(size=(_WAVES, 3)) * np.array(motion.free)
        positions = curve + (habits.curvature - 1.0 + _UNEVEN * a) * bend + aside + waves @ wobble
        trajectory = Trajectory(motion.duration * habits.pace * u, positions)
        demonstrations.append(Demonstration(trajectory, task=motion.name, source=f"{source}, number {i}"))
    return demonstrations


def demonstrations_by(motion: Motion, teachers: int, *, repeats: int = REPEATS) -> list[Demonstration]:
    """Return the demonstrations of several teachers.

    Align them before learning, because their durations and speeds differ.

    Args:
        motion: motion to demonstrate.
        teachers: number of teachers. If the number is increased, the first teachers keep their habits.
        repeats: number of demonstrations by each teacher.

    Raises:
        InputError: when a number is below 1.
    """
    if teachers < 1 or repeats < 1:
        raise InputError(f"teachers and repeats must be at least 1, got {teachers} and {repeats}")
    shown: list[Demonstration] = []
    for teacher in range(teachers):
        rng = np.random.default_rng([42, teacher])
        shown += demonstrate(motion, Habits.from_seed(teacher), repeats, rng, f"teacher {teacher}")
    return shown


def s_shaped_demonstrations(*, planar: bool, n_demonstrations: int = REPEATS, seed: int = 0) -> list[Demonstration]:
    """Return demonstrations of :func:`s_shaped_reach` by a teacher without habits.

    Args:
        planar: whether to keep the height constant.
        n_demonstrations: number of demonstrations.
        seed: seed of the differences between the demonstrations.
    """
    rng = np.random.default_rng([1, seed])
    return demonstrate(s_shaped_reach(planar=planar), NO_HABITS, n_demonstrations, rng, f"seed {seed}")
