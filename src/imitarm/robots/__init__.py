"""Bodies that move: simulated and real."""

from __future__ import annotations

from imitarm.robots.robot import Robot, limit_velocity
from imitarm.robots.simulated import SimulatedRobot
from imitarm.robots.world import arm_world

ROBOTS: dict[str, type[Robot]] = {"simulated": SimulatedRobot}

__all__ = ["ROBOTS", "Robot", "SimulatedRobot", "arm_world", "limit_velocity"]
