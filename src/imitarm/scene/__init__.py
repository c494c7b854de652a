"""Scenes: a goal and obstacles with exact signed distances, and scene files."""

from __future__ import annotations

from imitarm.scene.motion import MovingScene, Track
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.scene import Scene
from imitarm.scene.scene_file import load_scene, save_scene
from imitarm.scene.shapes import (
    Box,
    Capsule,
    Cone,
    ConvexHull,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Sphere,
)

OBSTACLES: dict[str, type[Obstacle]] = {
    shape.kind: shape for shape in (Sphere, Box, Capsule, Cylinder, Cone, Ellipsoid, ConvexHull, HalfSpace)
}

__all__ = [
    "OBSTACLES",
    "Box",
    "Capsule",
    "Cone",
    "ConvexHull",
    "Cylinder",
    "Ellipsoid",
    "HalfSpace",
    "MovingScene",
    "Obstacle",
    "Scene",
    "Sphere",
    "Track",
    "load_scene",
    "save_scene",
]
