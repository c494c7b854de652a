"""The live loop: a person leads a robot, in this process or over UDP."""

from imitarm.teleoperation.loop import Teleoperation

__all__ = ["Teleoperation"]
