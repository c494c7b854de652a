"""Robots: simulated in this process, or controlled over UDP."""

from __future__ import annotations

from imitarm.robots.depth_camera import DepthCamera
from imitarm.robots.robot import Robot, limit_velocity
from imitarm.robots.server import RobotServer
from imitarm.robots.simulated import SimulatedRobot
from imitarm.robots.udp import UdpRobot
from imitarm.robots.world import arm_world

ROBOTS: dict[str, type[Robot]] = {"simulated": SimulatedRobot, "udp": UdpRobot}

__all__ = ["ROBOTS", "DepthCamera", "Robot", "RobotServer", "SimulatedRobot", "UdpRobot", "arm_world", "limit_velocity"]
