"""Scene: where to go and what is in the way, at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene.obstacle import Array, Obstacle


@dataclass(frozen=True, eq=False)
class Scene:
    """A goal and obstacles at one instant, all in the base frame.

    A goal inside an obstacle is allowed here, because a scene is what a sensor saw; :meth:`check` tells it.

    Attributes:
        goal: tool_to_base to end at; None for the goal that was learnt.
        obstacles: any iterable of obstacles; kept as a tuple.

    Raises:
        InputError: when ``goal`` is no pose or an obstacle is no obstacle.
    """

    goal: Pose | None = None
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        if self.goal is not None and not isinstance(self.goal, Pose):
            raise InputError(f"Scene: goal must be a Pose or None, got {self.goal!r}")
        try:
            obstacles = tuple(self.obstacles)
        except TypeError as error:
            raise InputError(f"Scene: obstacles must be a list of obstacles, got {self.obstacles!r}") from error
        for i, obstacle in enumerate(obstacles):
            if not isinstance(obstacle, Obstacle):
                raise InputError(f"Scene: obstacles[{i}] must be an obstacle such as Sphere or Box, got {obstacle!r}")
        object.__setattr__(self, "obstacles", obstacles)

    def distances(self, points: ArrayLike) -> Array:
        """Return the signed distance of every point to every obstacle.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (n_obstacles, ...) [m], negative inside.

        Raises:
            InputError: when the last axis of ``points`` has not length 3.
        """
        p = _points(points)
        distances = np.empty((len(self.obstacles), *p.shape[:-1]))
        for i, obstacle in enumerate(self.obstacles):
            distances[i] = obstacle.signed_distance(p)
        return distances

    def clearance(self, points: ArrayLike) -> Array:
        """Return the signed distance to the nearest obstacle, inf when there is none.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (...) [m], negative inside an obstacle.

        Raises:
            InputError: when the last axis of ``points`` has not length 3.
        """
        return np.asarray(self.distances(points).min(axis=0, initial=np.inf))

    def nearest(self, points: ArrayLike) -> NDArray[np.intp]:
        """Return the index of the nearest obstacle of every point, -1 when there is none.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Indices into ``obstacles``, shape (...).

        Raises:
            InputError: when the last axis of ``points`` has not length 3.
        """
        if not self.obstacles:
            return np.full(_points(points).shape[:-1], -1, dtype=np.intp)
        return np.asarray(self.distances(points).argmin(axis=0))

    def after(self, dt: float) -> Scene:
        """Return the scene ``dt`` seconds later: obstacles moved at their velocities, the goal where it was."""
        return Scene(self.goal, tuple(obstacle.after(dt) for obstacle in self.obstacles))

    def name_of(self, index: SupportsIndex) -> str:
        """Return how messages call obstacle ``index``: ``box "tin"``, or ``box 1`` when it has no name.

        Unnamed obstacles are counted by shape, from 1, in the order of ``obstacles``.

        Raises:
            InputError: when there is no such obstacle.
        """
        i = index.__index__()
        if not 0 <= i < len(self.obstacles):
            raise InputError(f"obstacle {i} does not exist; the scene has {len(self.obstacles)}")
        obstacle = self.obstacles[i]
        if obstacle.name:
            return f'{obstacle.kind} "{obstacle.name}"'
        alike = sum(o.kind == obstacle.kind and not o.name for o in self.obstacles[: i + 1])
        return f"{obstacle.kind} {alike}"

    def check(self, tool_radius: float = 0.0) -> None:
        """Refuse a goal that can't be reached without a touch.

        Args:
            tool_radius: of the sphere around the tool's tip that must stay free [m].

        Raises:
            InputError: when the goal is nearer than ``tool_radius`` to an obstacle or inside it; the message names
                the obstacle and by how much.
        """
        if self.goal is None or not self.obstacles:
            return
        distances = self.distances(self.goal.position)
        worst = int(distances.argmin())
        if distances[worst] < tool_radius:
            depth = 1e3 * (tool_radius - distances[worst])
            raise InputError(
                f"Scene: the goal {np.round(self.goal.position, 4).tolist()} overlaps {self.name_of(worst)} by "
                f"{depth:.1f} mm (tool radius {1e3 * tool_radius:g} mm); move the goal or the obstacle"
            )


def _points(points: ArrayLike) -> Array:
    p = np.asarray(points, dtype=float)
    if p.shape[-1:] != (3,):
        raise InputError(f"points must have shape (..., 3), got {p.shape}")
    return p
