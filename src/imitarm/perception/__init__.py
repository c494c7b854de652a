"""Perception of obstacles with a camera: depth images, the obstacles found in them, and their motion."""

from __future__ import annotations

from imitarm.perception.association import assign
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.detection import Detection
from imitarm.perception.margins import CoverageMargin
from imitarm.perception.tracker import ObstacleTracker
from imitarm.perception.tracks import TrackedObstacle

__all__ = ["CoverageMargin", "DepthFrame", "Detection", "Intrinsics", "ObstacleTracker", "TrackedObstacle", "assign"]
