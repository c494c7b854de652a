"""Perception of obstacles with a camera: depth images, detected obstacles, and the motion of the obstacles."""

from __future__ import annotations

from imitarm.perception.association import assign
from imitarm.perception.consistency import Consistency
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.depth_noise import DepthNoise
from imitarm.perception.detection import Detection
from imitarm.perception.frame_file import FrameRecording
from imitarm.perception.margins import CoverageMargin
from imitarm.perception.obstacle_detector import ObstacleDetector
from imitarm.perception.person_capsules import PersonCapsules
from imitarm.perception.point_cloud import PointCloud
from imitarm.perception.segmentation import fit_plane
from imitarm.perception.self_filter import SelfFilter
from imitarm.perception.shape_choice import SHAPES
from imitarm.perception.steady_velocity import SteadyVelocities
from imitarm.perception.target import Target
from imitarm.perception.tracker import ObstacleTracker
from imitarm.perception.tracks import TrackedObstacle

__all__ = [
    "SHAPES",
    "Consistency",
    "CoverageMargin",
    "DepthFrame",
    "DepthNoise",
    "Detection",
    "FrameRecording",
    "Intrinsics",
    "ObstacleDetector",
    "ObstacleTracker",
    "PersonCapsules",
    "PointCloud",
    "SelfFilter",
    "SteadyVelocities",
    "Target",
    "TrackedObstacle",
    "assign",
    "fit_plane",
]
