"""Checks of demonstrations against each other: kind, duration, plane, and the one that is unlike the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.finding import Finding, Usable
from imitarm.demonstrations.idle import moving_rows
from imitarm.demonstrations.warp import barycentre_warps, features
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_DURATION_RATIO = 2.0
_FLAT = 1e-3  # [m] standard deviation below which a direction counts as not moved in
_OUTLIER_RATIO = 3.0  # times as far from the medoid as is usual
_OUTLIER_SPREADS = 6.0  # and so many robust standard deviations further
_OUTLIER_DISTANCE = 0.02  # [m] and at least so far
_OUTLIER_ANGLE = 0.2  # [rad] likewise
_SAMPLES = 100


def check_number(motions: Sequence[Usable]) -> Iterator[Finding]:
    """Find that there is one only."""
    if len(motions) == 1:
        yield motions[0].finding(
            "warning",
            "single",
            "only one demonstration: how exact each part must be can't be learnt from it",
            "show the motion three times or more",
        )


def check_kinds(motions: Sequence[Usable]) -> Iterator[Finding]:
    """Find rotations, joints or a third dimension in some demonstrations only."""
    for code, what, has, severity in (
        ("mixed-rotations", "rotations", [m.quaternions is not None for m in motions], "error"),
        ("mixed-joints", "joints", [m.joints is not None for m in motions], "note"),
    ):
        if any(has) and not all(has):
            without = motions[has.index(False)]
            yield without.finding(
                "error" if severity == "error" else "note",
                code,
                f"{sum(has)} of {len(has)} demonstrations have {what}, this one has none",
                "leave it out, or record all alike" if severity == "error" else "nothing: joints are not learnt from",
            )
    flat = [bool(np.ptp(m.positions[:, 2]) == 0.0) for m in motions]
    deep = [float(np.ptp(m.positions[:, 2])) > _FLAT for m in motions]
    if any(flat) and any(deep):
        yield motions[flat.index(True)].finding(
            "warning",
            "mixed-dimensions",
            f"{sum(flat)} of {len(flat)} demonstrations are planar (z stands), the others are not",
            "do not mix recordings with and without z",
        )


def check_durations(motions: Sequence[Usable]) -> Iterator[Finding]:
    """Find that some take much longer than others."""
    durations = np.array([motion.duration for motion in motions])
    if durations.max() > _DURATION_RATIO * durations.min():
        slow = int(np.argmax(durations))
        yield motions[slow].finding(
            "warning",
            "durations",
            f"takes {durations[slow]:.2f} s, another one {durations.min():.2f} s",
            "align makes them equal; check that all show the whole motion",
        )


def check_plane(motions: Sequence[Usable]) -> Iterator[Finding]:
    """Find directions that no demonstration moves in."""
    positions = np.concatenate([motion.positions for motion in motions])
    deviations, directions = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[1:]
    deviations = deviations / np.sqrt(len(positions))
    flat = deviations < _FLAT
    if flat.any() and deviations[0] > _FLAT:
        normal = directions[-1] * np.sign(directions[-1][np.argmax(np.abs(directions[-1]))])
        shape = "in a plane, normal" if flat.sum() == 1 else "on a straight line, across"
        vector = " ".join(f"{x:.2f}" for x in normal + 0.0)
        yield Finding(
            "note",
            "planar",
            f"all motions lie {shape} ({vector}), within {1e3 * deviations[flat].max():.2g} mm",
            remedy="nothing: that direction is kept constant when learning",
        )


def check_outliers(motions: Sequence[Usable]) -> Iterator[Finding]:
    """Find the demonstration whose path, once aligned, is unlike all others.

    Distances are from the medoid, the demonstration that is nearest to all others; at least four are needed to say
    what is usual.
    """
    trajectories = [one for motion in motions if (one := _moving_part(motion)) is not None]
    if len(trajectories) < len(motions) or len(motions) < 4:
        return
    if any(one.quaternions is None for one in trajectories):
        trajectories = [Trajectory(one.times, one.positions) for one in trajectories]
    warps = barycentre_warps(features(trajectories), n_iterations=4)
    warped = [one.at(warp * one.duration) for one, warp in zip(trajectories, warps, strict=True)]
    positions = np.stack([p for p, _ in warped])
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=3).mean(axis=2)
    center = int(np.argmin(np.sum(distance, axis=1)))
    for i in _unlike(distance[center], center, _OUTLIER_DISTANCE):
        usual = float(np.median(np.delete(distance[center], center)))
        yield motions[i].finding(
            "warning",
            "outlier",
            f"is {1e3 * distance[center, i]:.0f} mm from the most typical one ({motions[center].raw.source}), "
            f"usual are {1e3 * usual:.0f} mm",
            "look at it; leave it out if it shows something else",
        )
    rotations = [q for _, q in warped if q is not None]
    if len(rotations) < len(motions):
        return
    back = quaternion_conjugate(rotations[center])
    angle = np.array([np.linalg.norm(quaternion_log(quaternion_multiply(q, back)), axis=1).mean() for q in rotations])
    for i in _unlike(angle, center, _OUTLIER_ANGLE):
        yield motions[i].finding(
            "warning",
            "rotation-outlier",
            f"is turned by {np.degrees(angle[i]):.0f} degrees from the most typical one "
            f"({motions[center].raw.source}), usual are {np.degrees(np.median(np.delete(angle, center))):.0f}",
            "look at it; check the quaternion's order (wxyz or xyzw)",
        )


def _unlike(distance: Array, center: int, floor: float) -> list[int]:
    """Return the demonstrations that are unusually far from the medoid ``center``, of distances (n,)."""
    others = np.delete(distance, center)
    usual = float(np.median(others))
    spread = 1.4826 * float(np.median(np.abs(others - usual)))
    limit = max(floor, _OUTLIER_RATIO * usual, usual + _OUTLIER_SPREADS * spread)
    return [int(i) for i in np.flatnonzero(distance > limit)]


def _moving_part(motion: Usable) -> Trajectory | None:
    rows = moving_rows(motion.times, motion.positions, motion.quaternions)
    if rows is None or rows[1] <= rows[0]:
        return None
    keep = slice(rows[0], rows[1] + 1)
    quaternions = None if motion.quaternions is None else motion.quaternions[keep]
    return Trajectory(motion.times[keep], motion.positions[keep], quaternions).from_zero().resample(_SAMPLES)


SET_CHECKS = (check_number, check_kinds, check_durations, check_plane, check_outliers)
