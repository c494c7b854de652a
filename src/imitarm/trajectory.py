"""One motion in three tenses: Trajectory (timed poses), Demonstration (was shown), Rollout (was done).

All three are frozen and their arrays read-only: state comes in as an argument, results come out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import Table, read_table, write_table
from imitarm.kinematics.pose import Pose, checked_unit_quaternions, continuous_signs, slerp

Array = NDArray[np.float64]

FORMAT = "imitarm-demonstration"
VERSION = 1
_UNITS = "m s rad"
_FRAME = "tool_to_base"
_POSE_COLUMNS = ("t", "x", "y", "z")
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_COLUMN_NAME = re.compile(r"[A-Za-z_][\w./:-]*")
_RESERVED = {*_POSE_COLUMNS, *_QUATERNION_COLUMNS, "nan", "inf", "infinity"}


def _frozen(values: ArrayLike, shape: tuple[int | None, ...], what: str) -> Array:
    """Return a read-only float copy of ``values``, or say which shape or which row is wrong."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: not a table of numbers ({error})") from error
    wanted = "(" + ", ".join("n" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
    if array.ndim != len(shape) or any(s is not None and s != a for s, a in zip(shape, array.shape, strict=True)):
        raise InputError(f"{what}: shape must be {wanted}, got {array.shape}")
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1) if len(array) else np.zeros(0, bool)
    if bad.any():
        raise InputError(f"{what}: row {int(np.flatnonzero(bad)[0])} is not finite; remove or repair it")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Timed poses of the tool in the base frame.

    Attributes:
        times: strictly increasing, shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: unit quaternions w, x, y, z with continuous signs, shape (n, 4); None when not known.

    Raises:
        InputError: when shapes disagree, a number is not finite, times do not increase, or there are fewer
            than 2 samples.
    """

    times: Array
    positions: Array
    quaternions: Array | None = None

    def __post_init__(self) -> None:
        name = type(self).__name__
        times = _frozen(self.times, (None,), f"{name} times")
        if len(times) < 2:
            raise InputError(f"{name}: needs at least 2 samples, got {len(times)}")
        late = np.flatnonzero(np.diff(times) <= 0.0)
        if len(late):
            raise InputError(
                f"{name} times: row {late[0] + 1} ({times[late[0] + 1]:g} s) is not later than the row before"
            )
        positions = _frozen(self.positions, (len(times), 3), f"{name} positions")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        if self.quaternions is not None:
            quaternions = _frozen(self.quaternions, (len(times), 4), f"{name} quaternions")
            quaternions = continuous_signs(checked_unit_quaternions(quaternions, f"{name} quaternions"))
            quaternions.setflags(write=False)
            object.__setattr__(self, "quaternions", quaternions)

    def __len__(self) -> int:
        return len(self.times)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def path_length(self) -> float:
        """Length of the polyline through all positions [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, times: ArrayLike) -> tuple[Array, Array | None]:
        """Interpolate: positions linearly, rotations along the shortest arc; the ends are held.

        Args:
            times: query times [s], shape (m,).

        Returns:
            positions (m, 3) [m] and quaternions (m, 4) wxyz or None.
        """
        t = np.atleast_1d(np.asarray(times, dtype=float))
        positions = np.stack([np.interp(t, self.times, column) for column in self.positions.T], axis=1)
        return positions, None if self.quaternions is None else slerp(t, self.times, self.quaternions)

    def pose(self, index: int) -> Pose:
        """Return sample ``index`` as a pose; without quaternions the rotation is the identity."""
        q = np.array([1.0, 0.0, 0.0, 0.0]) if self.quaternions is None else self.quaternions[index]
        return Pose(self.positions[index], q)

    def resample(self, n: int) -> Trajectory:
        """Return ``n`` samples equally spaced in time, first and last kept.

        Raises:
            InputError: when ``n`` is below 2.
        """
        if n < 2:
            raise InputError(f"resample: n must be at least 2, got {n}")
        times = np.linspace(self.times[0], self.times[-1], n)
        return Trajectory(times, *self.at(times))

    def from_zero(self) -> Trajectory:
        """Return the same motion with its first time at 0 s."""
        return Trajectory(self.times - self.times[0], self.positions, self.quaternions)


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A motion that was shown, with where it came from.

    Attributes:
        trajectory: timed poses of the tool in the base frame.
        joints: joint angles (n, n_joints) [rad] of the arm that was guided, None when not recorded.
        task: what was shown, for example ``"sweep"``.
        source: where it came from: a file, a row range, a recorder.
        joint_names: one name for each column of ``joints``; ``joint_1``, ``joint_2``, ... when not given.

    Raises:
        InputError: when ``joints`` has not one row for each sample, or ``joint_names`` not one name for each column.
    """

    trajectory: Trajectory
    joints: Array | None = None
    task: str = ""
    source: str = ""
    joint_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.joints is None:
            object.__setattr__(self, "joint_names", ())
            return
        what = f"Demonstration joints of {self.source or self.task}"
        columns = np.shape(self.joints)[1] if np.ndim(self.joints) == 2 else None
        joints = _frozen(self.joints, (len(self.trajectory), columns), what)
        names = tuple(self.joint_names) or tuple(f"joint_{i + 1}" for i in range(joints.shape[1]))
        if len(names) != joints.shape[1] or len(set(names)) != len(names):
            raise InputError(f"{what}: {joints.shape[1]} columns need as many different joint_names, got {names}")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "joint_names", names)

    def __len__(self) -> int:
        return len(self.trajectory)

    def with_trajectory(self, trajectory: Trajectory, joints: Array | None) -> Demonstration:
        """Return a copy that keeps task and source."""
        return replace(self, trajectory=trajectory, joints=joints)

    def save(self, path: str | Path) -> None:
        """Write a CSV file that says its units and frame and loses no digit; an older file is replaced.

        Columns: ``t`` [s], ``x y z`` [m], ``qw qx qy qz`` when the rotation is known, then the joints by name [rad].

        Raises:
            InputError: when a joint's name can't be a column name, or the file can't be written.
        """
        for name in self.joint_names:
            if not _COLUMN_NAME.fullmatch(name) or name.lower() in _RESERVED:
                raise InputError(f"{path}: {name!r} can't be the name of a joint's column; rename that joint")
        motion = self.trajectory
        names = [*_POSE_COLUMNS, *(_QUATERNION_COLUMNS if motion.quaternions is not None else ()), *self.joint_names]
        parts = [motion.times[:, None], motion.positions, motion.quaternions, self.joints]
        remarks = {
            "format": FORMAT,
            "version": VERSION,
            "units": _UNITS,
            "frame": _FRAME,
            "task": self.task,
            "source": self.source,
            "samples": len(self),
        }
        values = np.hstack([part for part in parts if part is not None])
        write_table(path, {key: str(value) for key, value in remarks.items()}, names, values)

    @classmethod
    def load(cls, path: str | Path) -> Demonstration:
        """Read what :meth:`save` wrote. Other formats: ``imitarm.demonstrations.read``.

        ``source`` becomes the path.

        Raises:
            InputError: when the file can't be opened.
            FileFormatError: when it is damaged, cut off, of another format or of a newer version.
        """
        table = read_demonstration_table(path)
        names = table.names or ()
        n_pose = 8 if "qw" in names else 4
        quaternions = table.values[:, 4:8] if n_pose == 8 else None
        joints = table.values[:, n_pose:] if len(names) > n_pose else None
        try:
            trajectory = Trajectory(table.values[:, 0], table.values[:, 1:4], quaternions)
            return cls(trajectory, joints, table.remarks.get("task", ""), str(path), names[n_pose:])
        except InputError as error:
            raise FileFormatError(f"{path} (row 0 is line {table.lines[0]}): {error}") from error


def read_demonstration_table(path: str | Path) -> Table:
    """Read the file of a demonstration as a table: the header is checked, the numbers are not.

    Raises:
        InputError: when the file can't be opened.
        FileFormatError: when it is damaged, cut off, of another format or of a newer version.
    """
    table = read_table(path)
    if table.remarks.get("format") != FORMAT:
        raise FileFormatError(
            f"{path}: no line '# format: {FORMAT}' at its head; read other formats with imitarm.demonstrations.read"
        )
    version = table.remarks.get("version", "")
    if not version.isdecimal() or int(version) > VERSION:
        raise FileFormatError(f"{path}: format version {version!r}, this imitarm reads up to {VERSION}; update imitarm")
    for key, wanted in (("units", _UNITS), ("frame", _FRAME)):
        if table.remarks.get(key, wanted) != wanted:
            raise FileFormatError(f"{path}: {key} are {table.remarks[key]!r}, must be {wanted!r}; convert the numbers")
    samples = table.remarks.get("samples", str(len(table.values)))
    if samples != str(len(table.values)) or not table.ends_in_newline:
        raise FileFormatError(
            f"{path}: announces {samples} samples, holds {len(table.values)}; the file was cut off, copy it again"
        )
    names = table.names or ()
    pose = _POSE_COLUMNS + (_QUATERNION_COLUMNS if "qw" in names else ())
    if names[: len(pose)] != pose:
        raise FileFormatError(f"{path}: columns must begin {','.join(pose)}, got {','.join(names) or 'no names'}")
    return table


@dataclass(frozen=True, eq=False)
class Rollout:
    """A motion that was done by a robot, as it was measured.

    Attributes:
        trajectory: measured poses of the tool in the base frame.
        joints: measured joint angles (n, n_joints) [rad].
        velocities: measured joint velocities (n, n_joints) [rad/s].
        torques: torques that the joints' drives gave (n, n_joints) [N m].
        clearance: smallest distance from the arm or its tool to an obstacle (n,) [m]; negative when they overlap;
            inf when there was no obstacle.
        success: whether the motion was finished in time.
        reason: why it ended, in words.
        details: anything more that the robot or the task measured, by name.
    """

    trajectory: Trajectory
    joints: Array
    velocities: Array
    torques: Array
    clearance: Array
    success: bool
    reason: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def min_clearance(self) -> float:
        """Smallest clearance of the whole motion [m]."""
        return float(np.min(self.clearance, initial=np.inf))
