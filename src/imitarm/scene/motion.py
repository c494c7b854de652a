"""Obstacles that follow an arbitrary function of time or a recorded track, for simulated worlds and replays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    Pose,
    checked_unit_quaternions,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    slerp,
)
from imitarm.scene.scene import Scene
from imitarm.validation import finite_array, finite_number

Array = NDArray[np.float64]
Motion = Callable[[float], "Pose | ArrayLike"]
"""A function of time [s] that returns the pose of an obstacle, or its position (3,) [m] when it does not rotate.
The pose is that of the obstacle's local frame (:class:`~imitarm.scene.distances.PackedObstacles`).
The origin of the local frame is the centre of a shape, or the mean of a hull's points."""

_STEP = 1e-4  # [s] half of the interval over which velocities are differences


@dataclass(frozen=True, eq=False)
class Track:
    """A recorded motion, interpolated between its samples.

    Before the first and after the last sample, the obstacle rests.

    Attributes:
        times: strictly increasing times of the samples, shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: quaternions wxyz, shape (n, 4); None for an obstacle that does not rotate.

    Raises:
        InputError: when a shape is wrong, a number is not finite or the times do not increase.
    """

    times: Array
    positions: Array
    quaternions: Array | None = None

    def __post_init__(self) -> None:
        times = np.array(finite_array(self.times, (None,), "Track: times", "s"))
        if not len(times) or (np.diff(times) <= 0.0).any():
            raise InputError("Track: times must contain at least one number and strictly increase [s]")
        positions = np.array(finite_array(self.positions, (len(times), 3), "Track: positions", "m"))
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        if self.quaternions is not None:
            quaternions = finite_array(self.quaternions, (len(times), 4), "Track: quaternions")
            object.__setattr__(self, "quaternions", checked_unit_quaternions(quaternions, "Track"))

    def __call__(self, time: float) -> Pose | Array:
        """Return the pose at ``time`` [s], or the position (3,) [m] if the track has no rotations."""
        position = np.array([np.interp(time, self.times, column) for column in self.positions.T])
        if self.quaternions is None:
            return position
        return Pose(position, slerp([time], self.times, self.quaternions)[0])


@dataclass(frozen=True, eq=False)
class MovingScene:
    """A scene in which some obstacles follow functions of time; all other obstacles keep their velocity.

    Attributes:
        scene: all obstacles, with their poses at the time ``scene.stamp``.
        motions: functions of time that give the poses or positions of some obstacles, by the obstacle's index or name.

    Raises:
        InputError: when an obstacle with a motion is not in the scene, or a motion does not return a pose or a
            position.
    """

    scene: Scene
    motions: Mapping[str | int, Motion] = field(default_factory=dict)
    _moved: tuple[tuple[int, Motion], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = [obstacle.name for obstacle in self.scene.obstacles]
        moved = []
        for key, motion in self.motions.items():
            if isinstance(key, str) and names.count(key) > 1:
                raise InputError(f"MovingScene: {names.count(key)} obstacles are named {key!r}; give the index instead")
            index = names.index(key) if key in names else key
            if not isinstance(index, int) or not 0 <= index < len(names):
                known = ", ".join(repr(name) for name in names if name) or "none has a name"
                raise InputError(f"MovingScene: no obstacle {key!r}; the scene has {len(names)} (names: {known})")
            if not callable(motion):
                raise InputError(
                    f"MovingScene: the motion of obstacle {key!r} must be a function of time, got {motion!r}"
                )
            moved.append((index, motion))
        object.__setattr__(self, "_moved", tuple(moved))
        if moved:  # each motion must return a place
            self.at(self.scene.stamp)

    def from_stamp(self) -> MovingScene:
        """Return the same scene and motions on a clock that starts with 0 at the scene's stamp."""
        begins = self.scene.stamp
        if begins == 0.0:
            return self
        motions = {key: lambda time, motion=motion: motion(begins + time) for key, motion in self.motions.items()}
        return MovingScene(replace(self.scene, stamp=0.0), motions)

    def poses(self, time: float) -> tuple[Array, Array]:
        """Return the poses of all obstacles' local frames.

        Args:
            time: time on the clock of ``scene.stamp`` [s].

        Returns:
            Positions (n, 3) [m] and quaternions wxyz (n, 4) in the base frame.
        """
        packed = self.scene.packed.after(time - self.scene.stamp)
        if not self._moved:
            return packed.positions, packed.quaternions
        positions, quaternions = packed.positions.copy(), packed.quaternions.copy()
        for index, motion in self._moved:
            place = _checked_place(motion(time), index, time)
            if isinstance(place, Pose):
                positions[index], quaternions[index] = place.position, place.quaternion
            else:
                positions[index] = place
        return positions, quaternions

    def at(self, time: float) -> Scene:
        """Return the scene at ``time`` [s], with the velocities of the obstacles at that time.

        If an obstacle follows a function, its velocity is computed from its displacement in an interval of 0.2 ms.
        """
        time = finite_number(time, "MovingScene.at: time", "s")
        if not self._moved:
            return self.scene.at(time)
        positions, quaternions = self.poses(time)
        (before, from_), (after, to) = self.poses(time - _STEP), self.poses(time + _STEP)
        packed = self.scene.packed
        velocities, rates = packed.velocities.copy(), packed.angular_velocities.copy()
        for index, _ in self._moved:
            velocities[index] = (after[index] - before[index]) / (2.0 * _STEP)
            turn = quaternion_multiply(to[index], quaternion_conjugate(from_[index]))
            rates[index] = quaternion_log(turn) / (2.0 * _STEP)
        moved = packed.placed(positions, quaternions, velocities, rates, time)
        return Scene.predicted(self.scene, moved, time)


def _checked_place(place: Any, index: int, time: float) -> Pose | Array:
    if isinstance(place, Pose):
        return place
    return finite_array(place, (3,), f"the position of obstacle {index} at {time:g} s", "m")
