"""Perception of obstacles with a camera: depth images, the obstacles found in them, and their motion."""

from __future__ import annotations

from imitarm.perception.association import assign
from imitarm.perception.consistency import Consistency
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.detection import Detection
from imitarm.perception.margins import CoverageMargin
from imitarm.perception.tracker import ObstacleTracker
from imitarm.perception.tracks import TrackedObstacle

__all__ = [
    "Consistency",
    "CoverageMargin",
    "DepthFrame",
    "Detection",
    "Intrinsics",
    "ObstacleTracker",
    "TrackedObstacle",
    "assign",
]
