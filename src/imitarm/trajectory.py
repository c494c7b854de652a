"""Motions: Trajectory (timed poses), Demonstration (a demonstrated motion), Rollout (a motion executed by a robot).

Objects of these classes cannot be changed, and their arrays are read-only copies.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import Table, read_table, write_table
from imitarm.html_table import html_table
from imitarm.kinematics.pose import Pose, checked_unit_quaternions, continuous_signs, slerp
from imitarm.validation import (
    file_path,
    finite_array,
    finite_numbers,
    flag,
    instance,
    real_array,
    sequence,
    text,
    whole_number,
)

Array = NDArray[np.float64]

FORMAT = "imitarm-demonstration"
VERSION = 1
_MOST_SAMPLES = 10_000_000
_UNITS = "m s rad"
_FRAME = "tool_to_base"
_POSE_COLUMNS = ("t", "x", "y", "z")
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_COLUMN_NAME = re.compile(r"[A-Za-z_][\w./:-]*")
_RESERVED = {*_POSE_COLUMNS, *_QUATERNION_COLUMNS, "nan", "inf", "infinity"}


def _frozen(values: ArrayLike, shape: tuple[int | None, ...], what: str, unit: str = "") -> Array:
    """Return a read-only copy of ``values``, which must be finite numbers of this shape."""
    array = finite_array(values, shape, what, unit).copy()
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Timed poses of the tool in the base frame.

    Attributes:
        times: strictly increasing times, shape (n,) [s].
        positions: positions of the tool, shape (n, 3) [m].
        quaternions: unit quaternions w, x, y, z with continuous signs, shape (n, 4); None when the rotation is not
            known.

    Raises:
        InputError: when shapes disagree, a number is not finite, the times do not increase, or there are fewer than
            2 samples.
    """

    times: Array
    positions: Array
    quaternions: Array | None = None

    def __post_init__(self) -> None:
        name = type(self).__name__
        times = _frozen(self.times, (None,), f"{name} times", "s")
        if len(times) < 2:
            raise InputError(f"{name}: needs at least 2 samples, got {len(times)}")
        late = np.flatnonzero(np.diff(times) <= 0.0)
        if len(late):
            raise InputError(
                f"{name} times: row {late[0] + 1} ({times[late[0] + 1]:g} s) is not later than the row before"
            )
        positions = _frozen(self.positions, (len(times), 3), f"{name} positions", "m")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        if self.quaternions is not None:
            quaternions = _frozen(self.quaternions, (len(times), 4), f"{name} quaternions")
            quaternions = continuous_signs(checked_unit_quaternions(quaternions, f"{name} quaternions"))
            quaternions.setflags(write=False)
            object.__setattr__(self, "quaternions", quaternions)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        return f"Trajectory({', '.join(self._facts())})"

    def _repr_html_(self) -> str:
        samples, duration, path, rotation = self._facts()
        rows = {"samples": samples.split()[0], "duration": duration, "path length": path.removeprefix("path ")}
        first, last = (_triple(x) for x in self.positions[[0, -1]])
        return html_table("Trajectory", {**rows, "first, last position": f"{first}, {last} m", "rotation": rotation})

    def _facts(self) -> tuple[str, str, str, str]:
        rotation = "with" if self.quaternions is not None else "without"
        return (
            f"{len(self)} samples",
            f"{self.duration:.4g} s",
            f"path {self.path_length:.4g} m",
            f"{rotation} rotation",
        )

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def path_length(self) -> float:
        """Sum of the distances between successive positions [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, times: ArrayLike) -> tuple[Array, Array | None]:
        """Interpolate positions linearly and rotations along the shortest arc.

        Outside the times, return the nearest sample.

        Args:
            times: query times [s], shape (m,), or one number.

        Returns:
            positions (m, 3) [m] and quaternions (m, 4) wxyz or None.

        Raises:
            InputError: when the times are not finite numbers.
        """
        t = finite_numbers(times, "Trajectory.at: times", "s")
        positions = np.stack([np.interp(t, self.times, column) for column in self.positions.T], axis=1)
        return positions, None if self.quaternions is None else slerp(t, self.times, self.quaternions)

    def pose(self, index: int) -> Pose:
        """Return sample ``index`` as a pose; without quaternions the rotation is the identity.

        Raises:
            InputError: when ``index`` is not a whole number from ``-n`` to ``n - 1``.
        """
        index = whole_number(index, "Trajectory.pose: index", at_least=-len(self), at_most=len(self) - 1)
        q = np.array([1.0, 0.0, 0.0, 0.0]) if self.quaternions is None else self.quaternions[index]
        return Pose(self.positions[index], q)

    def resample(self, n: int) -> Trajectory:
        """Return ``n`` samples that are equally spaced in time, including the first and the last sample.

        Raises:
            InputError: when ``n`` is not a whole number from 2 to 10 million.
        """
        n = whole_number(n, "Trajectory.resample: n", at_least=2, at_most=_MOST_SAMPLES)
        times = np.linspace(self.times[0], self.times[-1], n)
        return Trajectory(times, *self.at(times))

    def with_positions(self, positions: ArrayLike) -> Trajectory:
        """Return a motion with the same times and rotations, but with the positions ``positions``, shape (n, 3) [m].

        Raises:
            InputError: when ``positions`` has another shape, or a number is not finite.
        """
        moved = copy.copy(self)  # times and rotations have been checked
        name = f"{type(self).__name__} positions"
        object.__setattr__(moved, "positions", _frozen(positions, (len(self), 3), name, "m"))
        return moved

    def from_zero(self) -> Trajectory:
        """Return the same motion with shifted times, so that it begins at 0 s."""
        return Trajectory(self.times - self.times[0], self.positions, self.quaternions)


@dataclass(frozen=True, eq=False, repr=False)
class Demonstration:
    """A demonstrated motion and its origin.

    Attributes:
        trajectory: timed poses of the tool in the base frame.
        joints: joint angles (n, n_joints) [rad] of the arm that was guided; None when they were not recorded.
        task: name of the demonstrated task, for example ``"sweep"``.
        source: origin of the motion, for example a file name, a range of rows in a file, or the name of a recorder.
        joint_names: one name for each column of ``joints``. Without names, they are called ``joint_1``, ``joint_2`` and
            so on.

    Raises:
        InputError: when ``joints`` does not have one row for each sample, or ``joint_names`` does not have one name for
            each column.
    """

    trajectory: Trajectory
    joints: Array | None = None
    task: str = ""
    source: str = ""
    joint_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        instance(self.trajectory, Trajectory, "Demonstration: trajectory")
        for name in ("task", "source"):
            text(getattr(self, name), f"Demonstration: {name}")
        if self.joints is None:
            object.__setattr__(self, "joint_names", ())
            return
        what = f"Demonstration joints of {self.source or self.task}"
        joints = _frozen(self.joints, (len(self.trajectory), None), what, "rad")
        names = sequence(self.joint_names, str, f"{what}: joint_names") or tuple(
            f"joint_{i + 1}" for i in range(joints.shape[1])
        )
        if len(names) != joints.shape[1] or len(set(names)) != len(names):
            raise InputError(f"{what}: {joints.shape[1]} columns need as many different joint_names, got {names}")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "joint_names", names)

    def __len__(self) -> int:
        return len(self.trajectory)

    def __repr__(self) -> str:
        joints = "no joints" if self.joints is None else f"{len(self.joint_names)} joints"
        return f"Demonstration({self.task or 'unnamed'!r}, {', '.join(self.trajectory._facts())}, {joints})"

    def _repr_html_(self) -> str:
        samples, *facts = self.trajectory._facts()
        rows = {"task": self.task, "source": self.source, "samples": samples.split()[0], "motion": ", ".join(facts)}
        return html_table("Demonstration", {**rows, "joints": ", ".join(self.joint_names) or "not recorded"})

    def with_trajectory(self, trajectory: Trajectory, joints: Array | None) -> Demonstration:
        """Return a copy with the motion ``trajectory`` and ``joints``, and the same task, source and joint names."""
        return replace(self, trajectory=trajectory, joints=joints)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a CSV file that states its units and its frame. All digits are kept. An existing file is replaced.

        Columns: ``t`` [s], ``x y z`` [m], ``qw qx qy qz`` when the rotation is known, then the joints by name [rad].

        Args:
            path: path of the file.

        Raises:
            InputError: when a joint's name can't be a column name, or the file can't be written.
        """
        path = file_path(path, "Demonstration.save: path")
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
    def load(cls, path: str | os.PathLike[str]) -> Demonstration:
        """Read a file that :meth:`save` wrote; ``imitarm.demonstrations.read`` reads other formats.

        The ``source`` of the result is the path.

        Args:
            path: path of the file.

        Raises:
            InputError: when the file can't be opened.
            FileFormatError: when the file is damaged or incomplete, or has another format or a newer version.
        """
        path = file_path(path, "Demonstration.load: path")
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


def read_demonstration_table(path: str | os.PathLike[str]) -> Table:
    """Read the file of a demonstration as a table. The header is checked, but not the numbers.

    Args:
        path: path of the file.

    Raises:
        InputError: when the file can't be opened.
        FileFormatError: when the file is damaged or incomplete, or has another format or a newer version.
    """
    path = file_path(path, "read_demonstration_table: path")
    table = read_table(path)
    if table.remarks.get("format") != FORMAT:
        raise FileFormatError(
            f"{path}: its header has no line '# format: {FORMAT}'; read other formats with imitarm.demonstrations.read"
        )
    version = table.remarks.get("version", "")
    if not version.isdecimal() or int(version) > VERSION:
        raise FileFormatError(
            f"{path}: format version {version!r}; this imitarm reads versions up to {VERSION}; update imitarm"
        )
    for key, wanted in (("units", _UNITS), ("frame", _FRAME)):
        if table.remarks.get(key, wanted) != wanted:
            raise FileFormatError(
                f"{path}: {key} is {table.remarks[key]!r}, but must be {wanted!r}; convert the numbers"
            )
    samples = table.remarks.get("samples", str(len(table.values)))
    if samples != str(len(table.values)) or not table.ends_in_newline:
        raise FileFormatError(
            f"{path}: the header announces {samples} samples, but the file holds {len(table.values)}; "
            "the file is incomplete: copy it again"
        )
    names = table.names or ()
    pose = _POSE_COLUMNS + (_QUATERNION_COLUMNS if "qw" in names else ())
    if names[: len(pose)] != pose:
        raise FileFormatError(f"{path}: first columns must be {','.join(pose)}, got {','.join(names) or 'no names'}")
    return table


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """A measured motion of a robot.

    Attributes:
        trajectory: measured poses of the tool in the base frame, n samples.
        joints: measured joint angles (n, n_joints) [rad].
        velocities: measured joint velocities (n, n_joints) [rad/s].
        torques: torques of the joints' drives (n, n_joints) [N m].
        clearance: smallest distance between the arm (with its tool) and any obstacle (n,) [m]; negative when arm and
            obstacle overlap, inf without obstacles; nan in all samples if the robot can't measure it.
        success: whether the motion reached its end within the time limit.
        reason: explanation of why the motion ended.
        details: further measurements of the robot or the task, by name.

    Raises:
        InputError: when shapes disagree, or a number is NaN. Only ``clearance`` may consist of NaN, as a whole.
    """

    trajectory: Trajectory
    joints: Array
    velocities: Array
    torques: Array
    clearance: Array
    success: bool
    reason: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(instance(self.trajectory, Trajectory, "Rollout: trajectory"))
        joints = _frozen(self.joints, (n, None), "Rollout: joints", "rad")
        object.__setattr__(self, "joints", joints)
        for name, unit in (("velocities", "rad/s"), ("torques", "N m")):
            object.__setattr__(self, name, _frozen(getattr(self, name), joints.shape, f"Rollout: {name}", unit))
        clearance = real_array(self.clearance, (n,), "Rollout: clearance", "m").copy()
        unknown = np.isnan(clearance)
        if unknown.any() and not unknown.all():
            raise InputError(f"Rollout: clearance [m] is NaN in row {int(np.argmax(unknown))}, but not in all rows")
        clearance.setflags(write=False)
        object.__setattr__(self, "clearance", clearance)
        object.__setattr__(self, "success", flag(self.success, "Rollout: success"))
        text(self.reason, "Rollout: reason")
        instance(self.details, Mapping, "Rollout: details")  # type: ignore[type-abstract]

    def __repr__(self) -> str:
        samples, duration, *_ = self.trajectory._facts()
        success = "succeeded" if self.success else "failed"
        return f"Rollout({success}, {samples}, {duration}, smallest clearance {self._clearance_text})"

    def _repr_html_(self) -> str:
        samples, *facts = self.trajectory._facts()
        rows = {
            "success": "yes" if self.success else "no",
            "reason": self.reason,
            "samples": samples.split()[0],
            "motion": ", ".join(facts),
            "smallest clearance": self._clearance_text,
            "largest joint velocity": f"{np.abs(self.velocities).max(initial=0.0):.4g} rad/s",
            "largest torque": f"{np.abs(self.torques).max(initial=0.0):.4g} N m",
        }
        return html_table("Rollout", rows)

    @property
    def min_clearance(self) -> float:
        """Smallest clearance of the whole motion [m]; nan if it was not measured."""
        return float(np.min(self.clearance, initial=np.inf))

    @property
    def _clearance_text(self) -> str:
        return "not measured" if np.isnan(self.min_clearance) else f"{self.min_clearance:.4g} m"


def _triple(position: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in position)})"
