"""Random scenes in front of a depth camera, for the benchmark of perception. A seed determines each scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, matrix_to_quaternion, quaternion_exp
from imitarm.perception import DepthFrame, DepthNoise, Intrinsics
from imitarm.robots import SimulatedRobot
from imitarm.robots.depth_camera import DepthCamera
from imitarm.scene import (
    Box,
    Capsule,
    Cone,
    ConvexHull,
    Cylinder,
    Ellipsoid,
    Obstacle,
    Scene,
    Sphere,
    standard_fixtures,
)
from imitarm.validation import choice, whole_number

Array = NDArray[np.float64]

SHAPES = ("sphere", "box", "cylinder", "capsule", "cone", "ellipsoid", "convex hull")
FAMILIES = ("one object", "held bottle", "in contact", "half hidden", "empty")
"""Families of scenes:

* "one object": an object of any shape stands on the table or floats.
* "held bottle": a hand with its forearm holds a bottle.
* "in contact": two objects touch each other.
* "half hidden": an object hides about half of another object from the camera.
* "empty": there is no object.
"""
DISTANCES = (1.0, 2.0, 3.0)
"""Distances of the camera from the middle of the table [m]."""
MOST = 10_000  # seeds of one family

_TABLE = Box(Pose(np.array([0.7, 0.0, -0.05]), np.array([1.0, 0.0, 0.0, 0.0])), np.array([0.9, 1.6, 0.1]), name="table")
_FIXTURES = (*standard_fixtures(), _TABLE)
_MIDDLE = np.array([0.7, 0.0, 0.12])
_FROM_ARM = 0.10  # [m] from every obstacle to the arm: nearer obstacles are removed with it
_FIELD_OF_VIEW = 1.047  # [rad] vertical, as of a Kinect v2
_TRIES = 500


@dataclass(frozen=True, eq=False)
class PerceptionScene:
    """A scene: obstacles on and above a table beside an arm, and the pose of a camera.

    Attributes:
        family: one of :data:`FAMILIES`.
        seed: seed of the scene.
        obstacles: the true obstacles. The name of the family describes the first obstacle.
        camera_to_base: pose of the camera in the frame of the arm's base.
        distance: distance of the camera from the middle of the table [m].
        fixtures: fixed surfaces: floor, pedestal and table.
    """

    family: str
    seed: int
    obstacles: tuple[Obstacle, ...]
    camera_to_base: Pose
    distance: float
    fixtures: tuple[Obstacle, ...] = _FIXTURES

    @property
    def shape(self) -> str:
        """Shape of the first obstacle as text; empty if the scene has no obstacle."""
        return self.obstacles[0].kind.replace("_", " ") if self.obstacles else ""


@lru_cache(maxsize=1)
def perception_arm() -> ArmModel:
    """Return the arm that stands at the table: Sawyer with a gripper."""
    return ArmModel.load("sawyer", tool="gripper")


def make_scene(family: str, seed: int) -> PerceptionScene:
    """Return one scene. The same seed gives the same scene on every machine.

    Successive seeds go through all combinations of shape and distance, so each combination is equally frequent.

    Raises:
        UnknownNameError: when there is no such family.
        InputError: when the seed is not a whole number from 0 to 9 999.
    """
    index = FAMILIES.index(choice(family, FAMILIES, "family"))
    seed = whole_number(seed, "seed", at_least=0, at_most=MOST - 1)
    shape, distance = SHAPES[seed % len(SHAPES)], DISTANCES[seed // len(SHAPES) % len(DISTANCES)]
    arm = perception_arm()
    centers, radii = arm.collision_spheres(arm.home)
    for attempt in range(_TRIES):
        rng = np.random.default_rng([index, seed, attempt])
        camera = _camera(distance, rng)
        obstacles = _BUILD[family](shape, camera.position, rng)
        gaps = [float((obstacle.signed_distance(centers) - radii).min()) for obstacle in obstacles]
        if all(gap > _FROM_ARM for gap in gaps):
            return PerceptionScene(family, seed, obstacles, camera, distance)
    raise InputError(f"no scene of the family {family!r} could be made from seed {seed}; choose another seed")


def images(scene: PerceptionScene, noise: DepthNoise, height: int) -> tuple[DepthFrame, DepthFrame]:
    """Return an image of a scene without noise, and the same image with noise. The robot is in its home posture.

    Args:
        scene: the scene.
        noise: noise that is added to the second image.
        height: number of rows of the image; the image has 4/3 as many columns.
    """
    robot = SimulatedRobot(perception_arm(), scene=Scene(None, scene.obstacles, fixtures=scene.fixtures))
    intrinsics = Intrinsics.from_field_of_view(height * 4 // 3, height, _FIELD_OF_VIEW)
    exact = DepthCamera(robot, intrinsics, scene.camera_to_base, nearest=0.5, farthest=5.0).frame()
    rng = np.random.default_rng([FAMILIES.index(scene.family), scene.seed, 1_000_000])
    return exact, noise.apply(exact, rng)


def _camera(distance: float, rng: np.random.Generator) -> Pose:
    """Return a camera on any side of the table except behind the arm, 15 to 60 degrees above it."""
    azimuth, elevation = rng.uniform(-1.9, 1.9), np.radians(rng.uniform(15.0, 60.0))
    flat = np.cos(elevation)
    z = -np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Pose(_MIDDLE - distance * z, matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def _place(rng: np.random.Generator) -> Array:
    """Return a place on the table, as height 0."""
    return np.array([rng.uniform(0.45, 1.0), rng.uniform(-0.5, 0.5), 0.0])


def _standing(rng: np.random.Generator) -> Array:
    """Return the rotation of an object that stands upright."""
    return quaternion_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])


def make_object(shape: str, rng: np.random.Generator) -> Obstacle:
    """Return one object. It stands on the table with a probability of 1/2; otherwise it floats above the table.

    Raises:
        UnknownNameError: when there is no such shape.
    """
    a, b, c = rng.uniform(0.03, 0.10, 3)
    stands = rng.random() < 0.5
    turn = _standing(rng) if stands else quaternion_exp(rng.normal(size=3))
    place = _place(rng)
    origin = Pose(np.zeros(3), turn)
    corners = rng.normal(size=(14, 3))
    corners *= (np.array([a, b, c]) * 1.3 / np.linalg.norm(corners, axis=1)[:, None]) + 0.01
    build: dict[str, Callable[[], Obstacle]] = {
        "sphere": lambda: Sphere(np.zeros(3), a),
        "box": lambda: Box(origin, 2.0 * np.array([a, b, c])),
        "cylinder": lambda: Cylinder(origin, 0.6 * a, 3.0 * b),
        "capsule": lambda: Capsule(-1.2 * b * origin.rotation[:, 2], 1.2 * b * origin.rotation[:, 2], 0.6 * a),
        "cone": lambda: Cone(origin, a, 2.5 * b),
        "ellipsoid": lambda: Ellipsoid(origin, np.array([a, b, c])),
        "convex hull": lambda: ConvexHull(corners),
    }
    if shape not in build:
        raise UnknownNameError.among("shape", shape, SHAPES)
    made = build[shape]()
    height = -float(made.bounds()[0, 2]) + (0.001 if stands else rng.uniform(0.05, 0.25))
    solid = made.solid()
    return made.placed(solid.position + place + [0.0, 0.0, height], solid.quaternion, np.zeros(3), np.zeros(3))


def _one(shape: str, _eye: Array, rng: np.random.Generator) -> tuple[Obstacle, ...]:
    return (make_object(shape, rng),)


def _held(_shape: str, _eye: Array, rng: np.random.Generator) -> tuple[Obstacle, ...]:
    """Return a bottle, and the forearm with the hand that holds it."""
    radius, length = rng.uniform(0.03, 0.045), rng.uniform(0.18, 0.28)
    center = _place(rng) + [0.0, 0.0, 0.5 * length + rng.uniform(0.02, 0.25)]
    bottle = Cylinder(Pose(center, quaternion_exp(0.3 * rng.normal(size=3))), radius, length)
    away = np.array([np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn), rng.uniform(-0.2, 0.4)])
    away /= np.linalg.norm(away)
    hand = center + radius * away
    return bottle, Capsule(hand, hand + rng.uniform(0.3, 0.4) * away, rng.uniform(0.035, 0.05))


def _touching(shape: str, _eye: Array, rng: np.random.Generator) -> tuple[Obstacle, ...]:
    """Return two objects that stand on the table and touch each other."""
    first = make_object(shape, rng)
    second = make_object(SHAPES[int(rng.integers(len(SHAPES)))], rng)
    direction = np.array([np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn), 0.0])
    start = first.solid().position
    near, far = 0.0, 0.6
    for _ in range(40):  # bisection: the smallest displacement at which they do not overlap
        middle = 0.5 * (near + far)
        if _overlap(first, _at(second, start + middle * direction)):
            near = middle
        else:
            far = middle
    return first, _at(second, start + far * direction)


def _at(obstacle: Obstacle, position: Array) -> Obstacle:
    low = float(obstacle.bounds()[0, 2] - obstacle.solid().position[2])
    position = np.array([position[0], position[1], max(position[2], 0.001 - low)])
    return obstacle.placed(position, obstacle.solid().quaternion, np.zeros(3), np.zeros(3))


def _overlap(first: Obstacle, second: Obstacle) -> bool:
    """Return whether two convex objects overlap: alternating projections find their nearest points."""
    point = second.solid().position
    for _ in range(60):
        distance, normal = first.distance_and_gradient(point)
        if distance <= 0.0 and second.signed_distance(point) <= 1e-6:
            return True
        point = point - max(float(distance), 0.0) * normal
        distance, normal = second.distance_and_gradient(point)
        point = point - max(float(distance), 0.0) * normal
    return bool(first.signed_distance(point) < 1e-4)


def _hidden(shape: str, eye: Array, rng: np.random.Generator) -> tuple[Obstacle, ...]:
    """Return an object, and a box between it and the camera that hides about half of it."""
    first = make_object(shape, rng)
    center = first.solid().position
    sight = center - eye
    distance = float(np.linalg.norm(sight))
    sight /= distance
    across = np.cross(sight, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    half = 0.5 * float(np.ptp(first.support(np.stack([across, -across])) @ across))
    side = rng.choice([-1.0, 1.0])
    before = rng.uniform(0.15, 0.3)
    turn = matrix_to_quaternion(np.column_stack([sight, across, np.cross(sight, across)]))
    width = max(2.0 * half, 0.06)
    place = center - before * sight + side * 0.5 * width * (1.0 - before / distance) * across
    return first, Box(Pose(place, turn), np.array([0.03, width, 0.3]))


def _none(_shape: str, _eye: Array, _rng: np.random.Generator) -> tuple[Obstacle, ...]:
    return ()


_BUILD: dict[str, Callable[[str, Array, np.random.Generator], tuple[Obstacle, ...]]] = dict(
    zip(FAMILIES, (_one, _held, _touching, _hidden, _none), strict=True)
)
