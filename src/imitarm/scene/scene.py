"""Scene: the goal and the obstacles at one time."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.html_table import html_table
from imitarm.kinematics.pose import Pose
from imitarm.scene.distances import PackedObstacles, distances, distances_and_gradients, resized
from imitarm.scene.obstacle import Array, Obstacle
from imitarm.validation import finite_number, finite_points, whole_number

_LISTED = 4  # obstacles that a short repr names


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """A goal and obstacles at one time, all in the base frame.

    A goal inside an obstacle is allowed, because a sensor may report such a scene; :meth:`check` rejects it.

    Attributes:
        goal: tool_to_base at the end of the motion; None: the learned goal of the skill.
        obstacles: any iterable of obstacles; stored as a tuple.
        stamp: time at which the obstacles have their poses [s]. For a scene from a sensor, this is the time of the
            measurement. :meth:`at` predicts the poses at other times.
        fixtures: objects on which the arm stands or works, such as floor, pedestal and table. Fixtures are part of a
            simulated world and cause contacts. Planners that consider only the tool's path ignore fixtures, because the
            tool must reach the table.

    Raises:
        InputError: when ``goal`` is not a pose, an entry of ``obstacles`` is not an obstacle, or ``stamp`` is not a
            finite number.
    """

    goal: Pose | None = None
    obstacles: tuple[Obstacle, ...] = field(default_factory=tuple)
    stamp: float = 0.0
    fixtures: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        if self.goal is not None and not isinstance(self.goal, Pose):
            raise InputError(f"Scene: goal must be a Pose or None, got {self.goal!r}")
        for key in ("obstacles", "fixtures"):
            object.__setattr__(self, key, _checked_obstacles(getattr(self, key), key))
        object.__setattr__(self, "stamp", finite_number(self.stamp, "Scene: stamp", "s"))

    @classmethod
    def predicted(cls, seen: Scene, packed: PackedObstacles, stamp: float) -> Scene:
        """Return a copy of ``seen`` with other poses of the obstacles; the poses are those of ``packed``.

        Args:
            seen: the scene with the shapes, the goal and the fixtures.
            packed: the same obstacles with new poses and velocities.
            stamp: time for which the poses of ``packed`` are valid [s].
        """
        scene = object.__new__(cls)
        scene.__dict__.update(goal=seen.goal, stamp=stamp, fixtures=seen.fixtures, packed=packed, _seen=seen)
        return scene

    @cached_property
    def packed(self) -> PackedObstacles:
        """The obstacles as arrays, from which distances are computed."""
        return PackedObstacles.of(self.obstacles, self.stamp)

    def at(self, time: float) -> Scene:
        """Return the scene as predicted for another time.

        Each obstacle keeps its velocity and its angular velocity; the goal does not move. The result has ``stamp =
        time``; ``packed.stamps`` keeps the time at which each obstacle was seen. The prediction takes microseconds,
        because only the packed arrays are moved. The obstacle objects are built when ``obstacles`` is read.

        Args:
            time: time on the clock of ``stamp`` [s].

        Raises:
            InputError: when ``time`` is not a finite number.
        """
        time = finite_number(time, "Scene.at: time", "s")
        seen: Scene = self.__dict__.get("_seen", self)
        if seen is not self and seen.packed.velocities is not self.packed.velocities:
            seen = self  # its obstacles were moved by something else
        return Scene.predicted(seen, seen.packed.after(time - seen.stamp), time)

    def now(self, time: float) -> Scene:
        """Return the scene predicted by :meth:`at`.

        If no obstacle moves or ``time`` is the stamp, return this scene itself.

        Args:
            time: time on the clock of ``stamp`` [s].
        """
        return self if time == self.stamp or self.packed.still else self.at(time)

    def with_goal(self, goal: Pose | None) -> Scene:
        """Return the same scene with another goal.

        Args:
            goal: tool_to_base at the end of the motion; None: the learned goal.

        Raises:
            InputError: when ``goal`` is not a pose.
        """
        if goal is not None and not isinstance(goal, Pose):
            raise InputError(f"Scene: goal must be a Pose or None, got {goal!r}")
        scene = object.__new__(Scene)
        scene.__dict__.update(self.__dict__, goal=goal)
        if "_seen" in self.__dict__:
            scene.__dict__["_seen"] = self.__dict__["_seen"].with_goal(goal)
        return scene

    def poses(self, time: float) -> tuple[Array, Array]:
        """Return the poses of the obstacles' local frames at ``time`` [s]: positions (n, 3) [m], quaternions (n, 4)."""
        packed = self.packed.after(time - self.stamp)
        return packed.positions, packed.quaternions

    def __getattr__(self, name: str) -> Any:
        """Build ``obstacles`` when they are first read from a predicted scene; reject unknown attributes."""
        seen: Scene | None = self.__dict__.get("_seen")
        if name != "obstacles" or seen is None:
            raise AttributeError(f"Scene has no attribute {name!r}")
        packed = self.packed
        shapes = seen.obstacles
        if packed.sizes is not seen.packed.sizes:
            shapes = tuple(resized(obstacle, size) for obstacle, size in zip(shapes, packed.sizes, strict=True))
        rows = zip(
            shapes,
            packed.positions,
            packed.quaternions,
            packed.velocities,
            packed.angular_velocities,
            strict=True,
        )
        obstacles = tuple(obstacle.placed(*row) for obstacle, *row in rows)
        if packed.covariances is not seen.packed.covariances:
            obstacles = tuple(o.with_covariance(c) for o, c in zip(obstacles, packed.covariances, strict=True))
        object.__setattr__(self, "obstacles", obstacles)
        return obstacles

    def __repr__(self) -> str:
        parts = [self.name_of(i) for i in range(len(self.obstacles))]
        parts = parts if len(parts) <= _LISTED else [*parts[:_LISTED], f"{len(parts) - _LISTED} more"]
        goal = "" if self.goal is None else f", goal {np.round(self.goal.position, 3).tolist()}"
        return f"Scene({', '.join(parts) or 'no obstacles'}{goal}, stamp {self.stamp:g} s)"

    def _repr_html_(self) -> str:
        rows: dict[str, object] = {
            "goal": "as learned" if self.goal is None else f"{np.round(self.goal.position, 3).tolist()} m",
            "stamp": f"{self.stamp:g} s",
        }
        for i, obstacle in enumerate(self.obstacles):
            place = f"at {np.round(self.packed.positions[i], 3).tolist()} m"
            speed = float(np.linalg.norm(obstacle.velocity))
            rows[self.name_of(i)] = f"{place}, {speed:.2g} m/s" if speed else place
        rows["fixtures"] = ", ".join(fixture.name or fixture.kind for fixture in self.fixtures)
        return html_table("Scene", rows)

    def distances(self, points: ArrayLike) -> Array:
        """Return the signed distance of every point to every obstacle.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Distances, shape (n_obstacles, ...) [m], negative inside an obstacle.

        Raises:
            InputError: when the last axis of ``points`` does not have length 3 or a number is not finite.
        """
        if len(self.packed) == 1 and "_seen" not in self.__dict__:  # takes half of the time
            return self.obstacles[0].signed_distance(points)[None]
        return distances(self.packed, points)

    def distances_and_gradients(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return :meth:`distances` (n_obstacles, ...) [m] and their gradients, unit vectors (n_obstacles, ..., 3).

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Raises:
            InputError: when the last axis of ``points`` does not have length 3 or a number is not finite.
        """
        if len(self.packed) == 1 and "_seen" not in self.__dict__:
            distance, gradient = self.obstacles[0].distance_and_gradient(points)
            return distance[None], gradient[None]
        return distances_and_gradients(self.packed, points)

    def clearance(self, points: ArrayLike) -> Array:
        """Return the signed distance to the nearest obstacle; inf without obstacles.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Distances, shape (...) [m], negative inside an obstacle.

        Raises:
            InputError: when the last axis of ``points`` does not have length 3 or a number is not finite.
        """
        return np.asarray(self.distances(points).min(axis=0, initial=np.inf))

    def nearest(self, points: ArrayLike) -> NDArray[np.intp]:
        """Return the index of the obstacle nearest to each point; -1 without obstacles.

        Args:
            points: points in the base frame, shape (..., 3) [m].

        Returns:
            Indices into ``obstacles``, shape (...).

        Raises:
            InputError: when the last axis of ``points`` does not have length 3 or a number is not finite.
        """
        if not len(self.packed):
            return np.full(finite_points(points).shape[:-1], -1, dtype=np.intp)
        return np.asarray(self.distances(points).argmin(axis=0))

    def name_of(self, index: SupportsIndex) -> str:
        """Return the name of obstacle ``index`` in messages: ``box "tin"``, or ``box 1`` when it has no name.

        Unnamed obstacles are counted by shape, from 1, in the order of ``obstacles``.

        Raises:
            InputError: when the scene has no obstacle with this index.
        """
        i = whole_number(index, "name_of: index")
        obstacles = self.__dict__.get("_seen", self).obstacles  # shapes and names do not depend on the time
        if not 0 <= i < len(obstacles):
            raise InputError(f"obstacle {i} does not exist; the scene has {len(obstacles)} obstacles")
        obstacle = obstacles[i]
        if obstacle.name:
            return f'{obstacle.kind} "{obstacle.name}"'
        alike = sum(o.kind == obstacle.kind and not o.name for o in obstacles[: i + 1])
        return f"{obstacle.kind} {alike}"

    def check(self, tool_radius: float = 0.0) -> None:
        """Raise an error if the tool at the goal would touch an obstacle.

        Args:
            tool_radius: radius of a sphere around the tool's tip that must be clear of obstacles [m]; at least 0.

        Raises:
            InputError: when the goal is inside an obstacle or closer to it than ``tool_radius``. The message names the
                obstacle and the overlap. The error is also raised when ``tool_radius`` is negative or not finite.
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


def _checked_obstacles(given: object, what: str) -> tuple[Obstacle, ...]:
    try:
        obstacles: tuple[Any, ...] = tuple(given)  # type: ignore[arg-type]
    except TypeError as error:
        raise InputError(f"Scene: {what} must be a list of obstacles, got {given!r}") from error
    for i, obstacle in enumerate(obstacles):
        if not isinstance(obstacle, Obstacle):
            raise InputError(f"Scene: {what}[{i}] must be an obstacle such as Sphere or Box, got {obstacle!r}")
    return obstacles
