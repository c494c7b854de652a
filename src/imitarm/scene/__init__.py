"""Where to go and what is in the way: obstacles with exact signed distances, scenes and scene files."""

from __future__ import annotations

from imitarm.scene.edged import Box, Cylinder
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.rounded import Capsule, Ellipsoid, Sphere
from imitarm.scene.scene import Scene

OBSTACLES: dict[str, type[Obstacle]] = {shape.kind: shape for shape in (Sphere, Box, Capsule, Cylinder, Ellipsoid)}

__all__ = ["OBSTACLES", "Box", "Capsule", "Cylinder", "Ellipsoid", "Obstacle", "Scene", "Sphere"]
