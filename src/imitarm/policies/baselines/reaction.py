"""How a baseline moves when the scene changes: one control period at a time, with the last observed obstacles."""

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
    """The motion of a method in a scene whose obstacles move, appear or disappear.

    A baseline plans its path once if the obstacles stand still. If an obstacle moves, appears or disappears, the
    baseline instead integrates the same equations step by step, with the current positions and velocities of the
    obstacles.

    Args:
        nominal: the learned path between the start and the goal of this motion.
        position: measured position of the tool, shape (3,) [m].
        velocity: velocity of the tool, shape (3,) [m/s].
        fraction: fraction of the duration that has passed.

    Attributes:
        fraction: fraction of the duration that has passed; above 1 after the learned duration.
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
        """Return the position on the learned path, shape (3,) [m]."""
        phase = min(max(fraction, 0.0), 1.0)
        found: Array = self.nominal.at([self.nominal.times[0] + phase * self.nominal.duration])[0][0]
        return found

    def advance(self, scene: Scene, dt: float) -> Array:
        """Return the velocity of the tool for the next ``dt`` seconds, shape (3,) [m/s], and move ``position`` by it.

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
        """Move ``position`` and ``fraction`` by one control period."""


def changed(before: PackedObstacles, now: PackedObstacles) -> bool:
    """Return whether an obstacle moves, or differs in position from before, or the number of obstacles differs."""
    if not now.still or len(before) != len(now):
        return True
    return bool(np.abs(before.positions - now.positions).max(initial=0.0) > _SAME)
