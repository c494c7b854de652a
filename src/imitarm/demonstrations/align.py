"""Make demonstrations of one motion equally long and bring what belongs together to the same time.

People never show a motion twice at the same pace. Averaged at equal times, a bend that came early here and late
there is smeared: the mean of unaligned demonstrations cuts corners and flattens peaks. Alignment changes *when* a
demonstration is where, never *where* it goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.idle import moving_rows
from imitarm.demonstrations.warp import barycentre_warps, features, identity_warps
from imitarm.errors import InputError, UnknownNameError
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]
Method = Literal["dtw", "resample"]

METHODS = ("dtw", "resample")


@dataclass(frozen=True, eq=False)
class Alignment:
    """Aligned demonstrations and what was changed to get them.

    Attributes:
        demonstrations: all with the same times, from 0 to ``duration``.
        duration: the median of the trimmed demonstrations' durations [s].
        kept_rows: first and last row of each demonstration that were kept, shape (n_demonstrations, 2).
        durations: of each trimmed demonstration, before [s], shape (n_demonstrations,).
        warps: for each sample of the common motion, how far through its own trimmed duration each demonstration was,
            0 to 1, strictly increasing, shape (n_demonstrations, n).
        method: how it was done.
    """

    demonstrations: tuple[Demonstration, ...]
    duration: float
    kept_rows: NDArray[np.int64]
    durations: Array
    warps: Array
    method: str

    @property
    def largest_shift(self) -> Array:
        """Most that a moment of each demonstration was moved in time [s], shape (n_demonstrations,)."""
        even = np.linspace(0.0, 1.0, self.warps.shape[1])
        return np.asarray(np.abs(self.warps - even).max(axis=1) * self.duration)

    def notes(self) -> list[str]:
        """Say in words what was changed, one line a demonstration."""
        return [
            f"{one.source}: {duration:.2f} s to {self.duration:.2f} s, moments moved by up to {shift:.2f} s"
            for one, duration, shift in zip(self.demonstrations, self.durations, self.largest_shift, strict=True)
        ]


def align(demonstrations: Sequence[Demonstration], *, n: int = 200, method: Method = "dtw") -> list[Demonstration]:
    """Trim, re-time and resample demonstrations of one motion so that they can be learnt from together.

    Idle heads and tails are cut off, time starts at 0, and the common duration is the median. ``"dtw"`` then warps
    each demonstration's time to a barycentre of them all (:func:`~imitarm.demonstrations.warp.barycentre_warps`);
    ``"resample"`` only stretches it evenly. Positions, rotations and joints all follow the same warp.

    Args:
        demonstrations: of one motion, at least one.
        n: samples of each result.
        method: ``"dtw"`` or ``"resample"``.

    Returns:
        Demonstrations with the same ``n`` times; ``source`` names the rows that were kept.

    Raises:
        InputError: when there are none, ``n`` is below 10, one does not move, or only some have rotations.
        UnknownNameError: when the method is unknown.
    """
    return list(compute_alignment(demonstrations, n=n, method=method).demonstrations)


def compute_alignment(demonstrations: Sequence[Demonstration], *, n: int = 200, method: Method = "dtw") -> Alignment:
    """Do what :func:`align` does and return also what was changed; arguments and errors are the same."""
    if method not in METHODS:
        raise UnknownNameError.among("method of alignment", method, METHODS)
    if n < 10:
        raise InputError(f"align: n must be at least 10 samples, got {n}")
    if not demonstrations:
        raise InputError("align: no demonstrations; read some first")
    if len({one.trajectory.quaternions is None for one in demonstrations}) > 1:
        without = next(one for one in demonstrations if one.trajectory.quaternions is None)
        raise InputError(f"align: some demonstrations have rotations, {without.source or 'one'} has none; leave it out")
    kept = [_kept_rows(one) for one in demonstrations]
    trimmed = [_trimmed(one, rows) for one, rows in zip(demonstrations, kept, strict=True)]
    durations = np.array([one.trajectory.duration for one in trimmed])
    duration = float(np.median(durations))
    if method == "dtw" and len(trimmed) > 1:
        warps = barycentre_warps(features([one.trajectory.resample(n) for one in trimmed]))
    else:
        warps = identity_warps(len(trimmed), n)
    times = np.linspace(0.0, duration, n)
    aligned = tuple(_retimed(one, warp, times) for one, warp in zip(trimmed, warps, strict=True))
    return Alignment(aligned, duration, np.array(kept), durations, warps, method)


def _kept_rows(demonstration: Demonstration) -> tuple[int, int]:
    motion = demonstration.trajectory
    rows = moving_rows(motion.times, motion.positions, motion.quaternions)
    if rows is None or rows[1] == rows[0]:
        raise InputError(f"align: {demonstration.source or 'a demonstration'} does not move; leave it out")
    return rows


def _trimmed(demonstration: Demonstration, rows: tuple[int, int]) -> Demonstration:
    keep = slice(rows[0], rows[1] + 1)
    motion = demonstration.trajectory
    quaternions = None if motion.quaternions is None else motion.quaternions[keep]
    joints = None if demonstration.joints is None else demonstration.joints[keep]
    trajectory = Trajectory(motion.times[keep], motion.positions[keep], quaternions).from_zero()
    source = demonstration.source
    if rows != (0, len(motion) - 1):
        source = f"{source} rows {rows[0]} to {rows[1]}".strip()
    return replace(demonstration, trajectory=trajectory, joints=joints, source=source)


def _retimed(demonstration: Demonstration, warp: Array, times: Array) -> Demonstration:
    """Return the demonstration at ``times``; ``warp`` says how far through its own duration it is at each."""
    motion = demonstration.trajectory
    own = warp * motion.duration
    joints = demonstration.joints
    if joints is not None:
        joints = np.stack([np.interp(own, motion.times, column) for column in joints.T], axis=1)
    return demonstration.with_trajectory(Trajectory(times, *motion.at(own)), joints)
