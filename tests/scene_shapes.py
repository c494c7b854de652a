"""Seeded obstacles of every shape, and coal's version of them."""

from __future__ import annotations

import coal
import numpy as np
from scipy.spatial import Delaunay

from imitarm.kinematics.pose import Pose
from imitarm.scene import OBSTACLES, Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, Sphere

KINDS = [kind for kind in OBSTACLES if kind != "half_space"]  # all shapes that have an end


def random_pose(rng):
    q = rng.normal(size=4)
    return Pose(rng.uniform(-0.5, 0.5, 3), q / np.linalg.norm(q))


def random_obstacle(kind, rng, **more):
    sizes = 10.0 ** rng.uniform(-2.0, -0.4, 3)  # 10 to 400 mm, thin ones too
    center = rng.uniform(-0.5, 0.5, 3)
    build = {
        "sphere": lambda: Sphere(center, sizes[0], **more),
        "box": lambda: Box(random_pose(rng), sizes, **more),
        "capsule": lambda: Capsule(center, center + rng.normal(size=3) * sizes[1], sizes[0], **more),
        "cylinder": lambda: Cylinder(random_pose(rng), sizes[0], sizes[1], **more),
        "cone": lambda: Cone(random_pose(rng), sizes[0], sizes[1], **more),
        "ellipsoid": lambda: Ellipsoid(random_pose(rng), sizes, **more),
        "convex_hull": lambda: ConvexHull(center + rng.normal(size=(rng.integers(4, 25), 3)) * 0.5 * sizes, **more),
    }
    return build[kind]()


def points_around(obstacle, rng, n, spread=0.6):
    """Points in and around the obstacle, about a third of them inside of its bounds."""
    low, high = obstacle.bounds()
    center, half = 0.5 * (low + high), 0.5 * (high - low)
    near = center + rng.uniform(-1.0, 1.0, (n // 3, 3)) * half
    around = center + rng.uniform(-1.0, 1.0, (n // 3, 3)) * (half + 0.05)
    return np.vstack([near, around, center + rng.normal(size=(n - 2 * (n // 3), 3)) * spread])


def moved_by(obstacle, pose):
    """The same obstacle after a rigid motion."""
    if isinstance(obstacle, Sphere):
        return Sphere(pose.apply(obstacle.center), obstacle.radius)
    if isinstance(obstacle, Capsule):
        return Capsule(pose.apply(obstacle.start), pose.apply(obstacle.end), obstacle.radius)
    if isinstance(obstacle, ConvexHull):
        return ConvexHull(pose.apply(obstacle.points))
    sizes = {
        "box": ["size"],
        "cylinder": ["radius", "length"],
        "cone": ["radius", "height"],
        "ellipsoid": ["semi_axes"],
    }
    return type(obstacle)(pose @ obstacle.pose, *(getattr(obstacle, name) for name in sizes[obstacle.kind]))


def coal_shape(obstacle):
    """Return the geometry and placement of the same obstacle in coal, built from the public fields only."""
    if isinstance(obstacle, Sphere):
        return coal.Sphere(obstacle.radius), coal.Transform3s(np.eye(3), obstacle.center)
    if isinstance(obstacle, ConvexHull):
        points = coal.StdVec_Vec3s()
        for point in obstacle.points:
            points.append(point)
        return coal.Convex.convexHull(points, False, None), coal.Transform3s.Identity()
    if isinstance(obstacle, Capsule):
        axis = obstacle.end - obstacle.start
        length = np.linalg.norm(axis)
        z = axis / length
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z], axis=1)
        return coal.Capsule(obstacle.radius, length), coal.Transform3s(rotation, 0.5 * (obstacle.start + obstacle.end))
    shape = {
        "box": lambda: coal.Box(*obstacle.size),
        "cylinder": lambda: coal.Cylinder(obstacle.radius, obstacle.length),
        "cone": lambda: coal.Cone(obstacle.radius, obstacle.height),
        "ellipsoid": lambda: coal.Ellipsoid(*obstacle.semi_axes),
    }[obstacle.kind]()
    return shape, coal.Transform3s(obstacle.pose.rotation, obstacle.pose.position)


def coal_distances(obstacle, points, radius=1e-3):
    """Signed distance by coal: that of a small sphere at each point, plus its radius."""
    shape, placement = coal_shape(obstacle)
    ball = coal.Sphere(radius)
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-9
    request.epa_tolerance = 1e-9
    request.gjk_max_iterations = 1000
    request.epa_max_iterations = 1000
    distances = []
    for point in points:
        result = coal.DistanceResult()
        distances.append(
            coal.distance(shape, placement, ball, coal.Transform3s(np.eye(3), point), request, result) + radius
        )
    return np.array(distances)


def contains(obstacle, points):
    """Whether each point is in the solid, straight from the definition of the shape; no distance is involved."""
    if isinstance(obstacle, Sphere):
        return np.sum((points - obstacle.center) ** 2, axis=-1) <= obstacle.radius**2
    if isinstance(obstacle, Capsule):
        axis = obstacle.end - obstacle.start
        share = np.clip((points - obstacle.start) @ axis / (axis @ axis), 0.0, 1.0)
        return np.sum((points - obstacle.start - share[..., None] * axis) ** 2, axis=-1) <= obstacle.radius**2
    if isinstance(obstacle, ConvexHull):
        return Delaunay(obstacle.points).find_simplex(points) >= 0
    x, y, z = np.moveaxis((points - obstacle.pose.position) @ obstacle.pose.rotation, -1, 0)
    rho = np.sqrt(x**2 + y**2)
    return {
        "box": lambda: np.all(2 * np.abs(np.stack([x, y, z], axis=-1)) <= obstacle.size, axis=-1),
        "cylinder": lambda: (rho <= obstacle.radius) & (2 * np.abs(z) <= obstacle.length),
        "cone": lambda: (np.abs(z) <= obstacle.height / 2) & (rho <= obstacle.radius * (0.5 - z / obstacle.height)),
        "ellipsoid": lambda: np.sum((np.stack([x, y, z], axis=-1) / obstacle.semi_axes) ** 2, axis=-1) <= 1.0,
    }[obstacle.kind]()
