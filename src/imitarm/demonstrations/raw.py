"""RawDemonstration: a demonstration as recorded. Checks of the numbers in its file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import held_rows, moving_rows
from imitarm.errors import FileFormatError, InputError
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import instance, real_array, text

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]
Severity = Literal["error", "warning", "note"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

_LENGTH_TOLERANCE = 0.05  # files with two decimals hold quaternions this far from length one
_ABSURD_DISTANCE = 1e5  # [m] no unit of length turns a robot's reach into this
_BOUND = 1e30  # larger numbers come from damaged files, and overflow when squared
_MAX_DROPPED = 0.1  # largest fraction of rows that `repair` may drop
_SAMPLES = 100  # of each motion, when motions are compared

_FEW = 20  # samples

_GENERIC_JOINT = re.compile(r"(?:j|joint|q|a|axis)_?\d+", re.IGNORECASE)
_NUMBER_AT_END = re.compile(r"(\d+)$")


@dataclass(frozen=True)
class Finding:
    """One fault that ``lint`` found in demonstrations, or one useful fact about them.

    Attributes:
        severity: ``"error"``: no good skill can be learned; ``"warning"``: a user should check the demonstration;
            ``"note"``: information that requires no action.
        code: short name that does not change between versions, such as ``"gap"``.
        message: description of the fault or fact, with measured values.
        source: name of the demonstration concerned; empty when the finding concerns all demonstrations.
        row: index of the first sample concerned, from 0; None when the finding concerns the whole motion.
        line: line number of the sample ``row`` in the text file, from 1; None when the file is not text.
        remedy: action that fixes the fault. Options of ``read`` are written as in Python, for example ``units="mm"``.
    """

    severity: Severity
    code: str
    message: str
    source: str = ""
    row: int | None = None
    line: int | None = None
    remedy: str = ""

    @property
    def place(self) -> str:
        """Place of the finding in the recording: ``line 12``, ``row 10`` or an empty text."""
        if self.line is not None:
            return f"line {self.line}"
        return "" if self.row is None else f"row {self.row}"

    def __str__(self) -> str:
        place = ", ".join(part for part in (self.source, self.place) if part)
        return f"{self.severity} {self.code}: {place + ': ' if place else ''}{self.message}; {self.remedy}"


@dataclass(frozen=True, eq=False)
class RawDemonstration:
    """One motion as recorded, in SI units, before the check for invalid rows.

    :class:`~imitarm.trajectory.Demonstration` rejects times that do not increase, numbers that are not finite and
    quaternions whose length is not one. ``lint`` checks the raw demonstration instead, so that it can list all faults.

    Attributes:
        source: name of the file. If the file contains several demonstrations, an index or a name follows.
        times: time stamps in any order, shape (n,) [s].
        positions: positions of the tool in the base frame, shape (n, 3) [m]; None when only joints were recorded.
        quaternions: quaternions wxyz, not necessarily of length one, shape (n, 4); None when not recorded.
        joints: joint positions, shape (n, n_joints) [rad]; None when not recorded.
        joint_names: one name for each column of ``joints``.
        task: name of the task.
        lines: line number of each sample in the text file, from 1, shape (n,); None when the file is not text.
        notes: remarks of the reader about its assumptions, and about data of the file that it left out.
        unread_rotation: names of columns that seem to contain a rotation in an unsupported form, such as Euler angles.
        length_unit: unit of the lengths in the file, from which ``positions`` were converted.
        time_unit: unit of the times in the file, from which ``times`` were converted.
        units_in_file: quantities whose units the file itself states: ``"length"``, ``"time"``, both or neither.

    Raises:
        InputError: when an array has the wrong shape or does not contain numbers, or joints and names do not agree.
    """

    source: str
    times: Array
    positions: Array | None = None
    quaternions: Array | None = None
    joints: Array | None = None
    joint_names: tuple[str, ...] = ()
    task: str = ""
    lines: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    unread_rotation: tuple[str, ...] = ()
    length_unit: str = "m"
    time_unit: str = "s"
    units_in_file: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        what = f"RawDemonstration {text(self.source, 'RawDemonstration: source')}"
        n = len(times := real_array(self.times, (None,), f"{what}: times", "s"))
        if n == 0:
            raise InputError(f"{what}: holds no samples; record it again")
        object.__setattr__(self, "times", times)
        for name, columns in (("positions", 3), ("quaternions", 4), ("joints", None)):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, real_array(getattr(self, name), (n, columns), f"{what}: {name}"))
        n_joints = 0 if self.joints is None else self.joints.shape[1]
        if len(self.joint_names) != n_joints:
            raise InputError(
                f"{what}: {n_joints} columns of joints need {n_joints} joint_names, got {len(self.joint_names)}"
            )

    @classmethod
    def of(cls, demonstration: Demonstration | RawDemonstration) -> RawDemonstration:
        """Convert a demonstration to a raw demonstration; a raw demonstration is returned unchanged."""
        if isinstance(demonstration, RawDemonstration):
            return demonstration
        motion = instance(demonstration, Demonstration, "a demonstration").trajectory
        return cls(
            demonstration.source,
            motion.times,
            motion.positions,
            motion.quaternions,
            demonstration.joints,
            demonstration.joint_names,
            demonstration.task,
        )

    def __len__(self) -> int:
        return len(self.times)

    def line(self, row: int) -> int | None:
        """Return the line number of the sample ``row`` in the text file; None when the file is not text."""
        return None if self.lines is None else int(self.lines[row])

    def finding(self, severity: Severity, code: str, message: str, remedy: str, row: int | None = None) -> Finding:
        """Return a finding about this demonstration, or about one of its rows."""
        return Finding(severity, code, message, self.source, row, None if row is None else self.line(row), remedy)

    def where(self, row: int) -> str:
        """Return the file and the place of the sample ``row``, for a message."""
        line = self.line(row)
        return f"{self.source}, row {row}" if line is None else f"{self.source}, line {line}"

    def joints_of(self, arm: ArmModel) -> Array:
        """Return the joint angles (n, arm.n_joints) [rad] in the order of the arm's joints.

        Columns are selected by the arm's joint names. If the columns have generic names (``joint_1``, ``j1``, ``q1``),
        they are sorted by the numbers in the names, which must be consecutive.

        Raises:
            InputError: when the demonstration has no joints, its joints are those of another arm, or the order of its
                joints is unknown.
        """
        if self.joints is None:
            raise InputError(f"{self.source}: holds no joint angles")
        names = self.joint_names
        if set(arm.joint_names) <= set(names):
            return self.joints[:, [names.index(name) for name in arm.joint_names]]
        generic = all(_GENERIC_JOINT.fullmatch(name) for name in names)
        if not generic or len(names) != arm.n_joints:
            raise InputError(
                f"{self.source}: joints {', '.join(names)} are not those of {arm.name} "
                f"({', '.join(arm.joint_names)}); give the arm that was recorded, or name the columns like "
                f"the joints of this arm"
            )
        numbers = [int(match[1]) for name in names if (match := _NUMBER_AT_END.search(name))]
        if sorted(numbers) != list(range(min(numbers), min(numbers) + len(names))):
            raise InputError(
                f"{self.source}: the numbers of joints {', '.join(names)} do not follow one another; use the joint "
                f"names of {arm.name}: {', '.join(arm.joint_names)}"
            )
        return self.joints[:, np.argsort(numbers)]

    def with_poses(self, arm: ArmModel | None) -> RawDemonstration:
        """Return a copy that has tool poses; if none were recorded, they are computed from the joint positions.

        Raises:
            InputError: when the arm is needed but not given, or the recorded joints belong to another arm.
        """
        check_arm_model(arm, "arm")
        if self.positions is not None:
            return self
        if arm is None:
            raise InputError(
                f"{self.source}: holds joint angles only; give the arm that was recorded, arm=ArmModel.load('sawyer')"
            )
        q = self.joints_of(arm)
        known = (np.abs(q) < _BOUND).all(axis=1)
        positions, quaternions = np.full((len(self), 3), np.nan), np.full((len(self), 4), np.nan)
        positions[known], quaternions[known] = arm.tool_path(q[known])
        return replace(self, positions=positions, quaternions=quaternions, joints=q, joint_names=arm.joint_names)

    def not_finite(self) -> NDArray[np.bool_]:
        """Return for each row whether the row holds nan, inf or a number of magnitude above 1e30, shape (n,)."""
        columns = [self.times[:, None], self.positions, self.quaternions, self.joints]
        table = np.hstack([part for part in columns if part is not None])
        return np.asarray(~(np.abs(table) < _BOUND).all(axis=1))

    def late(self) -> NDArray[np.bool_]:
        """Return for each row whether an earlier row has the same or a later time stamp, shape (n,)."""
        times = np.where(np.isfinite(self.times), self.times, -np.inf)
        before = np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]])
        return np.asarray(np.isfinite(self.times) & (self.times <= before))

    def held(self) -> NDArray[np.bool_]:
        """Return for each row whether it only repeats the previous row because the sensor had no new value, shape (n,).

        A recorder that runs faster than its sensor repeats each value (sample and hold). A tool at rest also repeats
        values, and rounding can make different values equal. Repetitions caused by rest or rounding do not count.
        Values count as held only if they are repeated many times during the motion, and if their changes are larger
        than rounding to the last digit would cause.
        """
        masks = [held_rows(part) for part in (self.positions, self.quaternions, self.joints) if part is not None]
        return max(masks, key=lambda mask: int(mask.sum()), default=np.zeros(len(self), dtype=bool))

    def thinned(self) -> RawDemonstration:
        """Return a copy without the rows that :meth:`held` finds; a note states how many rows were dropped."""
        held = self.held()
        if not held.any():
            return self
        keep = ~held
        return replace(
            self,
            times=self.times[keep],
            positions=None if self.positions is None else self.positions[keep],
            quaternions=None if self.quaternions is None else self.quaternions[keep],
            joints=None if self.joints is None else self.joints[keep],
            lines=None if self.lines is None else self.lines[keep],
            notes=(*self.notes, f"{held.sum()} of {len(self)} rows only repeated the previous row and were dropped"),
        )

    def demonstration(self, arm: ArmModel | None = None, *, repair: bool = False) -> Demonstration:
        """Check all rows, and convert the raw demonstration to a valid demonstration.

        Args:
            arm: arm that was recorded; needed when only joints were recorded.
            repair: whether to drop invalid rows: rows with a number that is not finite, and rows whose time stamp is
                not later than all earlier time stamps. ``source`` then states how many rows were dropped.

        Raises:
            FileFormatError: when a row is invalid; the message names file, line and remedy.
            InputError: when only joints were recorded and ``arm`` is not given.
        """
        raw = self.with_poses(arm)
        invalid, late = raw.not_finite(), raw.late()
        bad = invalid | late
        if bad.any() and not repair:
            row = int(np.flatnonzero(bad)[0])
            what = (
                "the row holds a number that is not finite"
                if invalid[row]
                else "the time is not later than in the previous row"
            )
            raise FileFormatError(
                f"{raw.where(row)}: {what}; fix the file, or read it with repair=True to drop such rows"
            )
        keep = np.flatnonzero(~bad)
        if len(keep) < max(2, (1.0 - _MAX_DROPPED) * len(raw)):
            raise FileFormatError(f"{raw.source}: {bad.sum()} of {len(raw)} rows are invalid; record it again")
        assert raw.positions is not None
        far = np.abs(raw.positions[keep]).max(axis=1) > _ABSURD_DISTANCE
        if far.any():
            row = int(keep[np.flatnonzero(far)[0]])
            position = f"position {raw.positions[row].tolist()} m"
            raise FileFormatError(
                f"{raw.where(row)}: no robot reaches the {position}; check which columns hold the position"
            )
        quaternions = None if raw.quaternions is None else _unit(raw, keep)
        source = raw.source + (f" ({bad.sum()} of {len(raw)} rows dropped)" if bad.any() else "")
        return Demonstration(
            Trajectory(raw.times[keep], raw.positions[keep], quaternions),
            None if raw.joints is None else raw.joints[keep],
            raw.task,
            source,
            raw.joint_names,
        )


def check_arm_model(arm: object, what: str) -> None:
    """Raise InputError if ``arm`` is neither an ArmModel nor None, without the slow import of ArmModel."""
    if arm is not None and not hasattr(arm, "tool_path"):
        raise InputError(f"{what} must be an ArmModel, got {arm!r:.60}; load it with ArmModel.load('sawyer')")


def _unit(raw: RawDemonstration, keep: NDArray[np.int64]) -> Array:
    """Return the quaternions of the rows ``keep``, scaled to length one."""
    assert raw.quaternions is not None
    quaternions = raw.quaternions[keep]
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)
    if len(bad):
        what = f"the quaternion has length {length[bad[0]]:.3g}, must be 1; check which columns hold the quaternion"
        raise FileFormatError(f"{raw.where(int(keep[bad[0]]))}: {what}")
    return np.asarray(quaternions / length[:, None])


@dataclass(frozen=True, eq=False)
class ValidRows:
    """The valid rows of a raw demonstration.

    A row is valid if its numbers are finite, its time stamp is later than the previous time stamp, and it does not
    merely repeat the previous sample.

    Attributes:
        raw: the demonstration.
        rows: indices of the valid rows of ``raw``, shape (n,).
        times: times since the first valid row, shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: unit quaternions, shape (n, 4), or None.
        joints: joint positions, shape (n, n_joints) [rad], or None.
    """

    raw: RawDemonstration
    rows: NDArray[np.int64]
    times: Array
    positions: Array
    quaternions: Array | None
    joints: Array | None

    @classmethod
    def of(cls, raw: RawDemonstration) -> ValidRows | None:
        """Select the valid rows; return None when fewer than 5 rows are valid or there are no positions."""
        if raw.positions is None:
            return None
        bad = raw.not_finite() | raw.late() | raw.held()
        quaternions = raw.quaternions
        if quaternions is not None:
            quaternions = np.where(bad[:, None], 0.0, quaternions)
            length = np.linalg.norm(quaternions, axis=1)
            bad |= length < 0.1
            quaternions = quaternions / np.maximum(length, 0.1)[:, None]
        rows = np.flatnonzero(~bad)
        if len(rows) < 5:
            return None
        return cls(
            raw,
            rows,
            raw.times[rows] - raw.times[rows[0]],
            raw.positions[rows],
            None if quaternions is None else quaternions[rows],
            None if raw.joints is None else raw.joints[rows],
        )

    @property
    def duration(self) -> float:
        """Time from the first to the last valid row [s]."""
        return float(self.times[-1])

    @property
    def name(self) -> str:
        """Name of the demonstration's file without its folder."""
        return PurePath(self.raw.source).name or "a demonstration"

    def moving_part(self) -> Trajectory | None:
        """Return the motion without rest at both ends, resampled to 100 samples; None when the tool does not move."""
        rows = moving_rows(self.times, self.positions, self.quaternions)
        if rows is None or rows[1] <= rows[0]:
            return None
        keep = slice(rows[0], rows[1] + 1)
        quaternions = None if self.quaternions is None else self.quaternions[keep]
        return Trajectory(self.times[keep], self.positions[keep], quaternions).from_zero().resample(_SAMPLES)

    def finding(self, severity: Severity, code: str, message: str, remedy: str, index: int | None = None) -> Finding:
        """Return a finding about the valid row ``index``, counted from 0.

        If ``index`` is None, the finding is about the whole motion.
        """
        return self.raw.finding(severity, code, message, remedy, None if index is None else int(self.rows[index]))


def check_rows(raw: RawDemonstration) -> Iterator[Finding]:
    """Find numbers that are not finite, and recordings with too few samples."""
    invalid = np.flatnonzero(raw.not_finite())
    if len(invalid):
        message = f"{len(invalid)} of {len(raw)} rows hold nan or inf"
        remedy = "fix the file, or read it with repair=True to drop those rows"
        yield raw.finding("error", "not-finite", message, remedy, int(invalid[0]))
    if len(raw) < _FEW:
        remedy = f"record at 50 Hz or faster, {_FEW} samples or more"
        yield raw.finding("warning", "few-samples", f"only {len(raw)} samples", remedy)


def check_quaternions(raw: RawDemonstration) -> Iterator[Finding]:
    """Find quaternions whose length is not one, and signs that flip."""
    if raw.quaternions is None:
        return
    q = np.where(raw.not_finite()[:, None], np.nan, raw.quaternions)
    length = np.nan_to_num(np.linalg.norm(q, axis=1), nan=1.0)
    off = np.abs(length - 1.0)
    worst = int(np.argmax(off))
    if off[worst] > _LENGTH_TOLERANCE:
        first = int(np.flatnonzero(off > _LENGTH_TOLERANCE)[0])
        n = int(np.sum(off > _LENGTH_TOLERANCE))
        message = f"{n} quaternions do not have length 1; the first has length {length[first]:.3g}"
        yield raw.finding("error", "no-rotation", message, "check which columns hold the quaternion", first)
    elif off[worst] > 0.1 * _LENGTH_TOLERANCE:
        message = (
            f"quaternions have length {length.min():.4f} to {length.max():.4f}; they are scaled to length 1 when read"
        )
        yield raw.finding("warning", "quaternion-length", message, "write the quaternions with more digits", worst)
    flips = np.flatnonzero(np.sum(q[1:] * q[:-1], axis=1) < 0.0) + 1
    if len(flips):
        message = f"the quaternion's sign flips {len(flips)} times (q and -q are the same rotation)"
        remedy = "nothing to do: the reader makes the signs of the quaternions continuous"
        yield raw.finding("note", "quaternion-flips", message, remedy, int(flips[0]))


def check_held(raw: RawDemonstration) -> Iterator[Finding]:
    """Find repeated values, which a recorder writes when it runs faster than its sensor."""
    held = raw.held()
    if held.any():
        rows = (len(raw) - 1) / max(1, int((~held).sum()) - 1)
        message = (
            f"{held.sum()} of {len(raw)} rows repeat the previous row: each value is held for about {rows:.2g} rows"
        )
        remedy = "read it with thin=True to drop the repeated rows"
        yield raw.finding("warning", "held-values", message, remedy, int(np.flatnonzero(held)[0]))


def check_notes(raw: RawDemonstration) -> Iterator[Finding]:
    """Report what the reader left out or assumed."""
    if raw.unread_rotation:
        message = (
            f"the rotation in columns {', '.join(raw.unread_rotation)} can't be read, so the motion has no orientation"
        )
        remedy = (
            "write the rotation as a quaternion in columns qw qx qy qz, or as a rotation matrix in columns r11 r12 "
            "... r33"
        )
        yield raw.finding("warning", "rotation-not-read", message, remedy)
    for note in raw.notes:
        yield raw.finding("note", "reader", note, "none needed, unless you need these data")


RAW_CHECKS = (check_rows, check_quaternions, check_held, check_notes)
