"""Scene: the goal and the obstacles at one time."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene.distances import PackedObstacles, checked_points, distances, distances_and_gradients
from imitarm.scene.obstacle import Array, Obstacle, pack
from imitarm.validation import finite_number


@dataclass(frozen=True, eq=False)
class Scene:
    """A goal and obstacles at one time, all in the base frame.

    A goal inside an obstacle is allowed, because a scene is what a sensor saw; :meth:`check` refuses it.

    Attributes:
        goal: tool_to_base at the end of the motion; None for the goal that the skill has learned.
        obstacles: any iterable of obstacles; kept as a tuple.
        stamp: the time for which the poses of the obstacles hold [s]. For a scene from a sensor this is when it was
            seen; :meth:`at` predicts from there.

    Raises:
        InputError: when ``goal`` is not a pose, an obstacle is not an obstacle, or ``stamp`` is not a finite number.
    """

    goal: Pose | None = None
    obstacles: tuple[Obstacle, ...] = field(default_factory=tuple)
    stamp: float = 0.0

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
        object.__setattr__(self, "stamp", finite_number(self.stamp, "Scene: stamp", "s"))

    @cached_property
    def packed(self) -> PackedObstacles:
        """The obstacles as arrays, which is what distances are computed from."""
        return pack(self.obstacles, self.stamp)

    def at(self, time: float) -> Scene:
        """Return the scene as predicted for another time: the one place where obstacles are moved ahead.

        Each obstacle keeps its velocity and its angular velocity; the goal stays. The result has ``stamp = time``;
        ``packed.stamps`` keep when each obstacle was seen. It takes microseconds: only the packed arrays are moved, and
        the obstacle objects are built when they are asked for.

        Args:
            time: on the clock of ``stamp`` [s].

        Raises:
            InputError: when ``time`` is not a finite number.
        """
        time = finite_number(time, "Scene.at: time", "s")
        seen: Scene = self.__dict__.get("_seen", self)
        moved = object.__new__(Scene)
        moved.__dict__.update(goal=seen.goal, stamp=time, packed=seen.packed.after(time - seen.stamp), _seen=seen)
        return moved

    def __getattr__(self, name: str) -> Any:
        """Build the obstacles of a predicted scene, the only attribute that may be missing."""
        seen: Scene | None = self.__dict__.get("_seen")
        if name != "obstacles" or seen is None:
            raise AttributeError(f"Scene has no attribute {name!r}")
        obstacles = tuple(obstacle.after(self.stamp - seen.stamp) for obstacle in seen.obstacles)
        object.__setattr__(self, "obstacles", obstacles)
        return obstacles

    def distances(self, points: ArrayLike) -> Array:
        """Return the signed distance of every point to every obstacle.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (n_obstacles, ...) [m], negative inside.

        Raises:
            InputError: when the last axis of ``points`` has not length 3 or a number is not finite.
        """
        return distances(self.packed, points)

    def distances_and_gradients(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return :meth:`distances` (n_obstacles, ...) [m] and their gradients, unit vectors (n_obstacles, ..., 3).

        Args:
            points: in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis of ``points`` has not length 3 or a number is not finite.
        """
        return distances_and_gradients(self.packed, points)

    def clearance(self, points: ArrayLike) -> Array:
        """Return the signed distance to the nearest obstacle, inf when there is none.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Shape (...) [m], negative inside an obstacle.

        Raises:
            InputError: when the last axis of ``points`` has not length 3 or a number is not finite.
        """
        return np.asarray(self.distances(points).min(axis=0, initial=np.inf))

    def nearest(self, points: ArrayLike) -> NDArray[np.intp]:
        """Return the index of the nearest obstacle of every point, -1 when there is none.

        Args:
            points: in the base frame, shape (..., 3) [m].

        Returns:
            Indices into ``obstacles``, shape (...).

        Raises:
            InputError: when the last axis of ``points`` has not length 3 or a number is not finite.
        """
        if not len(self.packed):
            return np.full(checked_points(points).shape[:-1], -1, dtype=np.intp)
        return np.asarray(self.distances(points).argmin(axis=0))

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
        """Refuse a goal that can't be reached without contact.

        Args:
            tool_radius: of the sphere around the tool's tip that must stay free [m]; at least 0.

        Raises:
            InputError: when the goal is nearer than ``tool_radius`` to an obstacle or inside it; the message names
                the obstacle and by how much. Also when ``tool_radius`` is not a length.
        """
        tool_radius = finite_number(tool_radius, "Scene.check: tool_radius", "m", at_least=0.0)
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
