"""Reaction: the motion of a baseline in a changing scene, one control period at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from imitarm.scene.distances import PackedObstacles
from imitarm.scene.scene import Scene
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_SAME = 1e-9  # [m] an obstacle that has moved by less stands where it stood


class Reaction(ABC):
    """The motion of a baseline in a scene whose obstacles move, appear or disappear.

    A baseline plans its path once if the obstacles stand still. In a changing scene, the baseline integrates the same
    equations step by step, with the last observed positions and velocities of the obstacles.

    Args:
        nominal: the learned path between the start and the goal of this motion.
        position: measured position of the tool, shape (3,) [m].
        velocity: velocity of the tool, shape (3,) [m/s].
        fraction: elapsed time divided by the duration.

    Attributes:
        fraction: elapsed time divided by the duration; it may exceed 1.
        position: desired position of the tool, shape (3,) [m].
    """

    def __init__(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> None:
        self.nominal, self.fraction = nominal, fraction
        self.position, self.velocity = position.copy(), velocity.copy()

    @property
    def goal(self) -> Array:
        """Position of the goal, shape (3,) [m]."""
        return self.nominal.positions[-1]

    def learned(self, fraction: float) -> Array:
        """Return the position on the learned path at a fraction of the duration, shape (3,) [m]."""
        phase = min(max(fraction, 0.0), 1.0)
        found: Array = self.nominal.at([self.nominal.times[0] + phase * self.nominal.duration])[0][0]
        return found

    def advance(self, scene: Scene, dt: float) -> Array:
        """Advance by ``dt`` seconds; return the velocity of the tool in this time, shape (3,) [m/s].

        Args:
            scene: the obstacles at the current time.
            dt: control period [s].
        """
        before = self.position
        self.step(scene, dt)
        self.velocity = (self.position - before) / dt
        return self.velocity

    @abstractmethod
    def step(self, scene: Scene, dt: float) -> None:
        """Change ``position`` and ``fraction`` to their values one control period later."""


def changed(before: PackedObstacles, now: PackedObstacles) -> bool:
    """Return whether an obstacle moves or has another position, or the number of obstacles has changed."""
    if not now.still or len(before) != len(now):
        return True
    return bool(np.abs(before.positions - now.positions).max(initial=0.0) > _SAME)
