"""Scenes: a goal and obstacles with exact signed distances, and scene files."""

from __future__ import annotations

from imitarm.scene.convex_hull import ConvexHull
from imitarm.scene.displacements import displaced_distances
from imitarm.scene.edged import Box, Cone, Cylinder, HalfSpace, standard_fixtures
from imitarm.scene.motion import MovingScene, Track
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.rounded import Capsule, Ellipsoid, Sphere
from imitarm.scene.scene import Scene
from imitarm.scene.scene_file import load_moving_scene, load_scene, save_scene

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
    "displaced_distances",
    "load_moving_scene",
    "load_scene",
    "save_scene",
    "standard_fixtures",
]
