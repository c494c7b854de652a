"""Perception of obstacles with a camera: depth images and the obstacles found in them."""

from __future__ import annotations

from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.detection import Detection

__all__ = ["DepthFrame", "Detection", "Intrinsics"]
