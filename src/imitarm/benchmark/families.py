"""Seeded families of scenes around one seeded skill (METHODS F): the same number gives the same scene everywhere.

Every scene is a :class:`Case`: what is in the way, in which directions nothing may move, and whether it can be solved
at all, known from how the scene was made and not from a method under test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_to_matrix
from imitarm.policies.adaptation import HORIZONTAL_ONLY
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Obstacle, Scene, Sphere
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

TOOL_RADIUS = 0.03  # [m]
CLEARANCE = 0.02  # [m] asked of every method
_DURATION = 4.0  # [s]
_FREE_ENDS = 0.08  # [m] no obstacle is nearer to start or goal than this
_APART = 0.16  # [m] between the centres of sparse obstacles
_OFF_PATH = 0.015  # [m] standard deviation of an obstacle's centre about the path
_WALL = 2.0  # [m] length of a wall that can't be passed at its outer end


@dataclass(frozen=True, eq=False)
class Case:
    """One scene to be solved or refused.

    Attributes:
        scene: what is in the way.
        forbidden: directions in which nothing may move, shape (m, 3).
        solvable: whether a path with the asked clearance exists.
    """

    scene: Scene
    forbidden: tuple[tuple[float, float, float], ...]
    solvable: bool


def s_shaped_demonstrations(*, planar: bool, n_demonstrations: int = 8, seed: int = 0) -> list[Demonstration]:
    """Make demonstrations of an S-shaped reach of 0.6 m, precise at both ends and loose between them.

    Args:
        planar: keep the height constant, as in a task on a table.
        n_demonstrations: how many.
        seed: of the habits that tell one demonstration from another.
    """
    rng = np.random.default_rng([1, seed])
    times = np.linspace(0.0, _DURATION, 200)
    u = times / _DURATION
    pace = 10 * u**3 - 15 * u**4 + 6 * u**5  # minimum jerk
    demonstrations = []
    for i in range(n_demonstrations):
        a, b, c = rng.normal(size=3)
        loose = np.sin(np.pi * pace)
        x = 0.6 * pace
        y = (0.10 + 0.015 * a) * np.sin(2 * np.pi * pace) + 0.02 * b * loose
        z = np.full_like(x, 0.10) if planar else 0.30 + 0.05 * loose + 0.015 * c * loose
        wobble = 0.0005 * rng.normal(size=(4, 3)) * ([1, 1, 0] if planar else [1, 1, 1])
        ripple = np.stack([np.sin((k + 2) * np.pi * u) for k in range(4)], axis=1) @ wobble
        trajectory = Trajectory(times, np.stack([x, y, z], axis=1) + ripple)
        demonstrations.append(Demonstration(trajectory, task="s-shaped reach", source=f"seed {seed}, number {i}"))
    return demonstrations


SIMPLE = ("sphere", "box")  # the shapes of the earlier figures in METHODS D.2
KINDS = (*SIMPLE, "capsule", "cylinder", "ellipsoid", "convex hull")


def random_obstacle(
    rng: np.random.Generator, centre: Array, *, planar: bool, kinds: tuple[str, ...] = KINDS
) -> Obstacle:
    """Make an obstacle of a random kind, 2 to 10 cm across; in a planar scene it stands upright on the table."""
    radius = rng.uniform(0.02, 0.05)
    turn = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) if planar else rng.normal(size=3)
    pose = Pose(centre, quaternion_exp(turn))
    half = rng.uniform(0.015, 0.045, size=3)
    along = pose.rotation[:, 0] * half[0]
    make: dict[str, Callable[[], Obstacle]] = {
        "sphere": lambda: Sphere(centre, radius),
        "box": lambda: Box(pose, 2.0 * half),
        "capsule": lambda: Capsule(centre - along, centre + along, 0.6 * radius),
        "cylinder": lambda: Cylinder(pose, radius, 4.0 * half[2]),
        "ellipsoid": lambda: Ellipsoid(pose, half),
        "convex hull": lambda: ConvexHull(centre + rng.normal(size=(12, 3)) * 0.02),
    }
    return make[kinds[int(rng.integers(len(kinds)))]]()


def sparse_clutter(seed: int, path: Array, *, n_obstacles: int, planar: bool, kinds: tuple[str, ...] = KINDS) -> Case:
    """Family S1/S3: obstacles of all kinds placed on the path, well apart; solvable, since one can go round each.

    Args:
        seed: number of the scene.
        path: nominal path that they are put on, shape (n, 3) [m].
        n_obstacles: how many.
        planar: whether the path must stay in its plane.
        kinds: which shapes to choose from.
    """
    rng = np.random.default_rng([11, n_obstacles, planar, seed])
    ends = path[[0, -1]]
    chosen: list[Obstacle] = []
    centres: list[Array] = []
    while len(chosen) < n_obstacles:
        off = _OFF_PATH * rng.normal(size=3) * ([1.0, 1.0, 0.0] if planar else [1.0, 1.0, 1.0])
        centre = path[rng.integers(len(path))] + off
        obstacle = random_obstacle(rng, centre, planar=planar, kinds=kinds)
        if obstacle.signed_distance(ends).min() < TOOL_RADIUS + _FREE_ENDS:
            continue
        if all(np.linalg.norm(centre - other) >= _APART for other in centres):
            chosen.append(obstacle)
            centres.append(centre)
        elif rng.random() < 0.02:  # painted into a corner: begin again
            chosen.clear()
            centres.clear()
    return Case(Scene(None, tuple(chosen)), HORIZONTAL_ONLY if planar else (), True)


def narrow_gap(seed: int, path: Array, *, solvable: bool) -> Case:
    """Family S4: a wall square across a planar path with one gap, wide enough by 5 to 30 mm or too narrow by as much.

    Args:
        seed: number of the scene.
        path: nominal path, shape (n, 3) [m].
        solvable: whether the gap lets the tool through with the asked clearance.
    """
    rng = np.random.default_rng([14, solvable, seed])
    need = 2.0 * (TOOL_RADIUS + CLEARANCE)
    slack = rng.uniform(0.005, 0.03)
    width = need + slack if solvable else need - slack
    middle = path[len(path) // 2]
    ahead = path[len(path) // 2 + 5] - path[len(path) // 2 - 5]
    heading = np.array([0.0, 0.0, np.arctan2(ahead[1], ahead[0])])
    across = quaternion_to_matrix(quaternion_exp(heading))[:, 1]
    centre = middle + rng.uniform(-0.04, 0.04) * across
    thick = rng.uniform(0.02, 0.05)
    walls = [
        Box(
            Pose(centre + side * 0.5 * (width + _WALL) * across, quaternion_exp(heading)),
            np.array([thick, _WALL, 0.3]),
            name=name,
        )
        for side, name in ((1.0, "left wall"), (-1.0, "right wall"))
    ]
    return Case(Scene(None, tuple(walls)), HORIZONTAL_ONLY, solvable)


def covered_end(seed: int, path: Array, *, planar: bool) -> Case:
    """Family S6: an obstacle over the start or the goal, which must be refused.

    Args:
        seed: number of the scene.
        path: nominal path, shape (n, 3) [m].
        planar: whether the path must stay in its plane.
    """
    rng = np.random.default_rng([16, planar, seed])
    end = path[0] if rng.random() < 0.5 else path[-1]
    radius = rng.uniform(0.02, 0.05)
    direction = rng.normal(size=3) * ([1.0, 1.0, 0.0] if planar else [1.0, 1.0, 1.0])
    direction /= np.linalg.norm(direction)
    gap = rng.uniform(-radius, 0.9 * CLEARANCE)  # from swallowing the end to leaving too little
    obstacle = Sphere(end + direction * max(0.0, gap + TOOL_RADIUS + radius), radius)
    return Case(Scene(None, (obstacle,)), HORIZONTAL_ONLY if planar else (), False)
