"""What a file says about one motion before anybody has judged it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.trajectory import Demonstration, Trajectory

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

_LENGTH_TOLERANCE = 0.05  # files with two decimals hold quaternions this far from length one
_ABSURD_DISTANCE = 1e5  # [m] no unit of length makes a reach of this
_BOUND = 1e30  # larger numbers come from damaged files, and overflow when squared
_MAX_DROPPED = 0.1  # share of rows that `repair` may drop before the file counts as broken


@dataclass(frozen=True, eq=False)
class RawDemonstration:
    """One motion as it was recorded: in SI units, but with every fault it has.

    :class:`~imitarm.trajectory.Demonstration` refuses times that do not increase, numbers that are not finite and
    quaternions that are none; ``lint`` looks at this instead, to name them all.

    Attributes:
        source: file, and the part of it.
        times: shape (n,) [s], in any order.
        positions: of the tool in the base frame, shape (n, 3) [m]; None when only joints were recorded.
        quaternions: wxyz of any length, shape (n, 4); None when not recorded.
        joints: shape (n, n_joints) [rad]; None when not recorded.
        joint_names: one name for each column of ``joints``.
        task: what was shown.
        lines: line of the text file of each row, from 1, shape (n,); None when the file is not text.
        notes: what the reader assumed or left out.
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

    @classmethod
    def of(cls, demonstration: Demonstration) -> RawDemonstration:
        """Look at a demonstration as if it had just been read."""
        motion = demonstration.trajectory
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
        """Return the line of ``row`` in the text file, None when the file is not text."""
        return None if self.lines is None else int(self.lines[row])

    def where(self, row: int) -> str:
        """Name the place of ``row`` for a message."""
        line = self.line(row)
        return f"{self.source}, row {row}" if line is None else f"{self.source}, line {line}"

    def joints_of(self, arm: ArmModel) -> Array:
        """Return the joint angles (n, arm.n_joints) [rad] in the arm's order.

        Columns are chosen by the arm's joint names; when none of those is known, they are taken in order.

        Raises:
            InputError: when there are no joints, or not those of this arm.
        """
        if self.joints is None:
            raise InputError(f"{self.source}: holds no joint angles")
        if set(arm.joint_names) <= set(self.joint_names):
            return self.joints[:, [self.joint_names.index(name) for name in arm.joint_names]]
        if set(arm.joint_names) & set(self.joint_names) or self.joints.shape[1] != arm.n_joints:
            raise InputError(
                f"{self.source}: joints {', '.join(self.joint_names)} are not those of {arm.name} "
                f"({', '.join(arm.joint_names)}); name the arm that was recorded"
            )
        return self.joints

    def with_poses(self, arm: ArmModel | None) -> RawDemonstration:
        """Return this with the tool's poses, computed from the joints when they were not recorded.

        Raises:
            InputError: when they are needed and the arm is not named, or is another one.
        """
        if self.positions is not None:
            return self
        if arm is None:
            raise InputError(
                f"{self.source}: holds joint angles only; name the arm that was recorded, arm=ArmModel.load('sawyer')"
            )
        q = self.joints_of(arm)
        known = (np.abs(q) < _BOUND).all(axis=1)
        positions, quaternions = np.full((len(self), 3), np.nan), np.full((len(self), 4), np.nan)
        positions[known], quaternions[known] = arm.tool_path(q[known])
        return replace(self, positions=positions, quaternions=quaternions, joints=q, joint_names=arm.joint_names)

    def not_finite(self) -> NDArray[np.bool_]:
        """Tell which rows hold nan, inf or a number beyond all bounds (1e30), shape (n,)."""
        columns = [self.times[:, None], self.positions, self.quaternions, self.joints]
        table = np.hstack([part for part in columns if part is not None])
        return np.asarray(~(np.abs(table) < _BOUND).all(axis=1))

    def late(self) -> NDArray[np.bool_]:
        """Tell which rows are not later than all rows before them, shape (n,)."""
        times = np.where(np.isfinite(self.times), self.times, -np.inf)
        before = np.concatenate([[-np.inf], np.maximum.accumulate(times)[:-1]])
        return np.asarray(np.isfinite(self.times) & (self.times <= before))

    def demonstration(self, arm: ArmModel | None = None, *, repair: bool = False) -> Demonstration:
        """Check everything and return it as a demonstration.

        Args:
            arm: the arm that was recorded; needed when only joints were.
            repair: drop rows that are not finite or not later than the row before, and say so in ``source``.

        Raises:
            FileFormatError: when a row can't be used; the message names file, line and remedy.
            InputError: when only joints were recorded and ``arm`` is not named.
        """
        raw = self.with_poses(arm)
        broken, late = raw.not_finite(), raw.late()
        bad = broken | late
        if bad.any() and not repair:
            row = int(np.flatnonzero(bad)[0])
            what = "holds a number that is not finite" if broken[row] else "is not later than the row before"
            raise FileFormatError(f"{raw.where(row)} {what}; mend the file or read it with repair=True")
        keep = np.flatnonzero(~bad)
        if len(keep) < max(2, (1.0 - _MAX_DROPPED) * len(raw)):
            raise FileFormatError(f"{raw.source}: {bad.sum()} of {len(raw)} rows can't be used; record it again")
        assert raw.positions is not None
        far = np.abs(raw.positions[keep]).max(axis=1) > _ABSURD_DISTANCE
        if far.any():
            row = int(keep[np.flatnonzero(far)[0]])
            raise FileFormatError(
                f"{raw.where(row)}: position {raw.positions[row].tolist()} m is no place an arm can be; wrong columns?"
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


def _unit(raw: RawDemonstration, keep: NDArray[np.int64]) -> Array:
    """Return the quaternions of rows ``keep`` scaled to length one, or say which is none."""
    assert raw.quaternions is not None
    quaternions = raw.quaternions[keep]
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)
    if len(bad):
        raise FileFormatError(
            f"{raw.where(int(keep[bad[0]]))}: quaternion of length {length[bad[0]]:.3g}, must be 1; wrong columns?"
        )
    return np.asarray(quaternions / length[:, None])
