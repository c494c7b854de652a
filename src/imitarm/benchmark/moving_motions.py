"""Motions of obstacles in the moving benchmark.

Each motion passes through a given point at a given time. There, the obstacle meets a tool on the learned motion.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import quaternion_exp, rotate
from imitarm.scene import Obstacle
from imitarm.scene.motion import Motion, Track

Array = NDArray[np.float64]

AWAY = np.array([0.0, 0.0, -50.0])
"""Position of an obstacle before it appears, shape (3,) [m]; no sensor sees an obstacle there."""
BEFORE = 2.0
"""Time before the start of the tool's motion (time 0) at which the motion of every obstacle begins [s]."""
_MOVES, _RESTS = (0.4, 0.9), (0.3, 0.8)  # [s] of an obstacle that stops and goes on
_RAMP = 10  # samples over which its speed changes
_STEP = 0.01  # [s]
_AMPLITUDE, _PERIOD = (0.03, 0.10), (0.8, 2.0)  # [m], [s] of weaving
_RATE = 0.5, 1.5  # [rad/s] of turning


def straight(obstacle: Obstacle) -> Motion:
    """Return the motion of an obstacle that keeps its velocity and does not rotate."""
    start, velocity = obstacle.solid().position, obstacle.velocity
    return lambda time: start + time * velocity


def appearing(motion: Motion, time: float) -> Motion:
    """Return a motion that equals ``motion`` from ``time`` [s] on; before, the obstacle is at :data:`AWAY`."""
    return lambda now: AWAY if now < time else motion(now)


def stop_and_go(rng: np.random.Generator, obstacle: Obstacle, time: float, velocity: Array, until: float) -> Track:
    """Return a straight motion that stops several times.

    Args:
        rng: source of the random durations.
        obstacle: the obstacle, with the pose that it has at the meeting point.
        time: time at which the obstacle is at the meeting point [s].
        velocity: velocity of the obstacle while it moves, shape (3,) [m/s].
        until: time at which the motion ends [s].
    """
    times = np.arange(-BEFORE, until, _STEP)
    goes = np.zeros(len(times))
    at, moves = 0, bool(rng.random() < 0.5)
    while at < len(times):
        n = round(float(rng.uniform(*(_MOVES if moves else _RESTS))) / _STEP)
        goes[at : at + n] = moves
        at, moves = at + n, not moves
    goes = np.convolve(np.pad(goes, _RAMP, mode="edge"), np.ones(_RAMP) / _RAMP, "same")[_RAMP:-_RAMP]
    along = np.concatenate([[0.0], np.cumsum(0.5 * (goes[1:] + goes[:-1]) * _STEP)])
    along -= np.interp(time, times, along)
    return Track(times, obstacle.solid().position + along[:, None] * velocity)


def weaving(
    rng: np.random.Generator, obstacle: Obstacle, time: float, velocity: Array, side: Array, fastest: float
) -> Motion:
    """Return a motion that swings to both sides of a straight line.

    Args:
        rng: source of amplitude, period and phase.
        obstacle: the obstacle, with the pose that it has at the meeting point.
        time: time at which the obstacle is at the meeting point [s].
        velocity: mean velocity of the obstacle, shape (3,) [m/s].
        side: direction of the swing, unit vector (3,) perpendicular to the velocity.
        fastest: largest speed of the obstacle [m/s]; if necessary, the amplitude is reduced to keep this speed.
    """
    at, rate, phase = obstacle.solid().position, 2.0 * math.pi / rng.uniform(*_PERIOD), rng.uniform(0.0, 2.0 * math.pi)
    widest = math.sqrt(fastest**2 - float(velocity @ velocity)) / rate
    amplitude = min(float(rng.uniform(*_AMPLITUDE)), widest)

    def motion(now: float) -> Array:
        swing = amplitude * (math.sin(rate * (now - time) + phase) - math.sin(phase))
        return np.asarray(at + (now - time) * velocity + swing * side)

    return motion


def turning(
    rng: np.random.Generator, obstacle: Obstacle, time: float, velocity: Array, side: Array, fastest: float
) -> Motion:
    """Return a motion on a circle. At the meeting point, the velocity of the obstacle is ``velocity``.

    The arguments are the same as for :func:`weaving`, but ``side`` points from the obstacle to the centre of the
    circle.
    """
    speed = min(float(np.linalg.norm(velocity)), fastest)
    at, rate = obstacle.solid().position, float(rng.uniform(*_RATE))
    centre = at + speed / rate * side
    axis = np.cross(side, velocity) / -max(float(np.linalg.norm(velocity)), 1e-9)

    def motion(now: float) -> Array:
        return np.asarray(centre + rotate(quaternion_exp(rate * (now - time) * axis), at - centre))

    return motion
