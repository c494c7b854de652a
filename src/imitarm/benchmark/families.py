"""Families of random scenes with obstacles on a learned path. The same seed gives the same scene on every machine.

Every scene is a :class:`Case`: obstacles, forbidden directions, and whether a solution exists. The construction of the
scene determines whether a solution exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_to_matrix
from imitarm.policies.adaptation import HORIZONTAL_ONLY
from imitarm.scene import Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, Obstacle, Scene, Sphere

Array = NDArray[np.float64]

TOOL_RADIUS = 0.03  # [m]
CLEARANCE = 0.02  # [m] required of every method
_FREE_ENDS = 0.08  # [m] no obstacle is nearer to start or goal than this
_APART = 0.16  # [m] between the centres of sparse obstacles
_OFF_PATH = 0.015  # [m] standard deviation of an obstacle's centre about the path
_TRIES = 2000  # of an obstacle, before its path counts as too short
_WALL = 2.0  # [m] length of a wall that can't be passed at its outer end


@dataclass(frozen=True, eq=False)
class Case:
    """One scene. A method must solve the scene if a solution exists, and refuse it otherwise.

    Attributes:
        scene: the obstacles.
        forbidden: directions in which the path must not be displaced, shape (m, 3).
        solvable: whether a path with the required clearance exists.
    """

    scene: Scene
    forbidden: tuple[tuple[float, float, float], ...]
    solvable: bool


SIMPLE = ("sphere", "box")  # the shapes with the simplest distances
KINDS = (*SIMPLE, "capsule", "cylinder", "ellipsoid", "convex hull")
ALL_KINDS = (*KINDS, "cone")


class _Draft(NamedTuple):
    """The parameters of a random obstacle. Drawing random parameters is much faster than building the obstacle.

    ``outer`` is the radius of a sphere around ``centre`` that contains the obstacle [m]. ``inner`` is the distance from
    ``centre`` to one point that belongs to the obstacle [m].
    """

    build: Callable[[], Obstacle]
    inner: float
    outer: float


def random_obstacle(
    rng: np.random.Generator, centre: Array, *, planar: bool, kinds: tuple[str, ...] = KINDS
) -> Obstacle:
    """Make an obstacle of a random shape, 2 to 10 cm in size. If ``planar`` is True, the obstacle stands upright."""
    return _draft(rng, centre, planar, kinds).build()


def _draft(rng: np.random.Generator, centre: Array, planar: bool, kinds: tuple[str, ...]) -> _Draft:
    radius = rng.uniform(0.02, 0.05)
    turn = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) if planar else rng.normal(size=3)
    half = rng.uniform(0.015, 0.045, size=3)
    kind = kinds[int(rng.integers(len(kinds)))]
    if kind == "sphere":
        return _Draft(lambda: Sphere(centre, radius), 0.0, radius)
    if kind == "convex hull":
        corners = rng.normal(size=(12, 3)) * 0.02
        away = np.linalg.norm(corners, axis=1)
        return _Draft(lambda: ConvexHull(centre + corners), float(away.min()), float(away.max()))

    def build() -> Obstacle:
        pose = Pose(centre, quaternion_exp(turn))
        if kind == "box":
            return Box(pose, 2.0 * half)
        if kind == "cylinder":
            return Cylinder(pose, radius, 4.0 * half[2])
        if kind == "cone":
            return Cone(pose, radius, 4.0 * half[2])
        if kind == "ellipsoid":
            return Ellipsoid(pose, half)
        along = pose.rotation[:, 0] * half[0]
        return Capsule(centre - along, centre + along, 0.6 * radius)

    return _Draft(build, 0.0, radius + 2.0 * float(np.linalg.norm(half)))


def sparse_clutter(seed: int, path: Array, *, n_obstacles: int, planar: bool, kinds: tuple[str, ...] = KINDS) -> Case:
    """Make a scene with obstacles of random shapes on the path, far apart from one another.

    The scene is solvable, because a path can go around each obstacle.

    Args:
        seed: number of the scene.
        path: nominal path on which the obstacles are placed, shape (n, 3) [m].
        n_obstacles: how many.
        planar: whether the path must stay in its plane.
        kinds: names of the shapes from which obstacles are chosen.
    """
    rng = np.random.default_rng([11, n_obstacles, planar, seed])
    chosen = obstacles_apart(rng, path, n_obstacles, planar=planar, kinds=kinds)
    return Case(Scene(None, chosen), HORIZONTAL_ONLY if planar else (), True)


def obstacles_apart(
    rng: np.random.Generator, path: Array, n_obstacles: int, *, planar: bool, kinds: tuple[str, ...] = KINDS
) -> tuple[Obstacle, ...]:
    """Place obstacles on a path. They stand far from one another, from the start and from the goal.

    Args:
        rng: source of the random numbers.
        path: nominal path, shape (n, 3) [m].
        n_obstacles: number of obstacles.
        planar: whether the obstacles stand upright, at the height of the path.
        kinds: names of the shapes from which obstacles are chosen.

    Raises:
        InputError: when the path is too short for so many obstacles.
    """
    ends, free = path[[0, -1]], TOOL_RADIUS + _FREE_ENDS
    chosen: list[Obstacle] = []
    centres: list[Array] = []
    for _ in range(_TRIES):
        if len(chosen) == n_obstacles:
            return tuple(chosen)
        off = _OFF_PATH * rng.normal(size=3) * ([1.0, 1.0, 0.0] if planar else [1.0, 1.0, 1.0])
        centre = path[rng.integers(len(path))] + off
        draft = _draft(rng, centre, planar, kinds)
        to_end = float(np.linalg.norm(ends - centre, axis=1).min())
        if to_end + draft.inner < free:
            continue
        apart = all(np.linalg.norm(centre - other) >= _APART for other in centres)
        if apart or to_end - draft.outer < free:
            obstacle = draft.build()
            if obstacle.signed_distance(ends).min() < free:
                continue
        if apart:
            chosen.append(obstacle)
            centres.append(centre)
        elif rng.random() < 0.02:  # painted into a corner: begin again
            chosen.clear()
            centres.clear()
    raise InputError(
        f"no place for {n_obstacles} obstacles on the path; choose fewer obstacles, or a skill with a longer path"
    )


def narrow_gap(seed: int, path: Array, *, solvable: bool) -> Case:
    """Make a wall with one gap across a planar path. The gap is 5 to 30 mm wider or narrower than the tool needs.

    Args:
        seed: number of the scene.
        path: nominal path, shape (n, 3) [m].
        solvable: whether the gap is wide enough for the tool with the required clearance.
    """
    rng = np.random.default_rng([14, solvable, seed])
    need = 2.0 * (TOOL_RADIUS + CLEARANCE)
    slack = rng.uniform(0.005, 0.03)
    walls = wall_with_gap(rng, path, need + slack if solvable else need - slack)
    return Case(Scene(None, walls), HORIZONTAL_ONLY, solvable)


def wall_with_gap(
    rng: np.random.Generator, path: Array, width: float, *, shift: float = 0.04, height: float = 0.3
) -> tuple[Box, Box]:
    """Make a wall across the middle of a path. The wall consists of two halves with a gap between them.

    The wall is so long that a path can pass only through the gap.

    Args:
        rng: source of the random numbers.
        path: nominal path, shape (n, 3) [m].
        width: width of the gap [m].
        shift: largest distance between the centre of the gap and the path [m].
        height: height of the wall [m].
    """
    middle = path[len(path) // 2]
    ahead = path[len(path) // 2 + 5] - path[len(path) // 2 - 5]
    heading = np.array([0.0, 0.0, np.arctan2(ahead[1], ahead[0])])
    across = quaternion_to_matrix(quaternion_exp(heading))[:, 1]
    centre = middle + rng.uniform(-shift, shift) * across
    size = np.array([rng.uniform(0.02, 0.05), _WALL, height])
    left, right = (
        Box(Pose(centre + side * 0.5 * (width + _WALL) * across, quaternion_exp(heading)), size, name=name)
        for side, name in ((1.0, "left wall"), (-1.0, "right wall"))
    )
    return left, right


def covered_end(seed: int, path: Array, *, planar: bool) -> Case:
    """Make a scene in which an obstacle covers the start or the goal. A method must refuse this scene.

    Args:
        seed: number of the scene.
        path: nominal path, shape (n, 3) [m].
        planar: whether the path must stay in its plane.
    """
    rng = np.random.default_rng([16, planar, seed])
    obstacle = covering_sphere(rng, path[0] if rng.random() < 0.5 else path[-1], planar=planar)
    return Case(Scene(None, (obstacle,)), HORIZONTAL_ONLY if planar else (), False)


def covering_sphere(rng: np.random.Generator, point: Array, *, planar: bool) -> Sphere:
    """Make a sphere near ``point``, shape (3,) [m].

    A tool at this point touches the sphere or has too little clearance.
    """
    radius = rng.uniform(0.02, 0.05)
    direction = rng.normal(size=3) * ([1.0, 1.0, 0.0] if planar else [1.0, 1.0, 1.0])
    direction /= np.linalg.norm(direction)
    gap = rng.uniform(-radius, 0.9 * CLEARANCE)  # from swallowing the point to leaving too little
    return Sphere(point + direction * max(0.0, gap + TOOL_RADIUS + radius), radius)
