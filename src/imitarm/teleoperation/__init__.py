"""Teleoperation: a person moves a robot in real time, in this process or over UDP."""

from imitarm.teleoperation.loop import StepInfo, Summary, Teleoperation

__all__ = ["StepInfo", "Summary", "Teleoperation"]
