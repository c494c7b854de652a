"""The samples of all demonstrations, in the form that a mixture is fitted to."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.skills.rotation_reference import RotationReference
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

_SAME_DURATION = 0.01  # demonstrations whose durations differ by a larger share were not aligned
_CLOCK_DIGITS = 6  # microseconds: epoch stamps have no finer ones, so that they give the same skill as others


class SingleDemonstrationWarning(UserWarning):
    """Only one demonstration: its covariance tells how well it was fitted, not how much a person varies."""


class UnalignedWarning(UserWarning):
    """Demonstrations of different durations were given; unaligned demonstrations flatten the mean."""


def samples_of(
    demonstrations: Sequence[Demonstration | Trajectory],
) -> tuple[list[Array], RotationReference | None, float]:
    """Return the samples of each demonstration in one form.

    Times are counted from each first sample and scaled to the median duration. Rotations, when all demonstrations have
    them, become rotation vectors near a common reference.

    Returns:
        Tables of rows [t, x, y, z] or [t, x, y, z, r1, r2, r3], the reference of the rotations or None, and the
        duration [s].

    Raises:
        InputError: when there is no demonstration, only some have quaternions, or they turn different ways.
    """
    if isinstance(demonstrations, Demonstration | Trajectory):
        raise InputError("GMR.fit: give a list of demonstrations, not one alone")
    if len(demonstrations) < 1:
        raise InputError("GMR.fit: no demonstrations; give at least 1, better 3 or more")
    trajectories = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
    for i, trajectory in enumerate(trajectories):
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"GMR.fit: demonstration {i} is a {type(trajectory).__name__}, not a Demonstration")
    without = [i for i, trajectory in enumerate(trajectories) if trajectory.quaternions is None]
    if 0 < len(without) < len(trajectories):
        raise InputError(
            f"GMR.fit: demonstrations {without} have no quaternions while the others have; "
            "record orientation in all of them or drop it from all"
        )
    durations = np.array([trajectory.duration for trajectory in trajectories])
    duration = float(np.median(durations))
    if np.ptp(durations) > _SAME_DURATION * duration:
        warnings.warn(
            f"demonstrations last from {durations.min():.3g} to {durations.max():.3g} s; their times are scaled to "
            f"{duration:.3g} s. Align them first: unaligned demonstrations flatten the mean",
            UnalignedWarning,
            stacklevel=4,
        )
    times = [_since_start(k.times) * (duration / k.duration) for k in trajectories]
    tables = [np.column_stack([t, k.positions]) for t, k in zip(times, trajectories, strict=True)]
    if without:
        return tables, None, duration
    rotations = [(t, k.quaternions) for t, k in zip(times, trajectories, strict=True) if k.quaternions is not None]
    reference = RotationReference.among(rotations)
    vectors = [reference.to_vectors(t, q) for t, q in rotations]
    return [np.column_stack(pair) for pair in zip(tables, vectors, strict=True)], reference, duration


def _since_start(times: Array) -> Array:
    t = times - times[0]
    rounded = np.round(t, _CLOCK_DIGITS)
    return rounded if np.all(np.diff(rounded) > 0.0) else t
