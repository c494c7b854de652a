"""Where to go and what is in the way: obstacles with exact signed distances, scenes and scene files."""

from __future__ import annotations

from imitarm.scene.edged import Box, Cone, Cylinder
from imitarm.scene.hull import ConvexHull
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.rounded import Capsule, Ellipsoid, Sphere
from imitarm.scene.scene import Scene
from imitarm.scene.scene_file import load_scene, save_scene

OBSTACLES: dict[str, type[Obstacle]] = {
    shape.kind: shape for shape in (Sphere, Box, Capsule, Cylinder, Cone, Ellipsoid, ConvexHull)
}

__all__ = [
    "OBSTACLES",
    "Box",
    "Capsule",
    "Cone",
    "ConvexHull",
    "Cylinder",
    "Ellipsoid",
    "Obstacle",
    "Scene",
    "Sphere",
    "load_scene",
    "save_scene",
]
