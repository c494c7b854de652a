"""Align demonstrations: cut off rest at both ends, and warp time so that matching points have the same time.

People never repeat a motion at exactly the same speed. A bend may therefore occur early in one demonstration and late
in another. The mean of the demonstrations at equal times would smear a bend, because averaging cuts corners and
flattens peaks. Alignment changes the time at which a demonstration reaches each point of its path, but never the path.

Dynamic time warping (DTW) within a band finds the matching points. For two motions ``a``, ``b`` of n samples, the
cheapest monotone path through the grid of costs ``c(i, j) = |a_i - b_j|^2`` follows from a recursion:

    D(i, j) = c(i, j) + min(D(i-1, j-1) + c(i, j), D(i-1, j) + p, D(i, j-1) + p)

This is the symmetric form of Sakoe and Chiba (1978), in which a diagonal step counts twice. D(i, j) is the cost of the
cheapest path from (0, 0) to (i, j). The price ``p`` of a step that is not diagonal keeps noise from distorting time.
The band is the largest allowed |i - j|. The code computes all cells of one anti-diagonal together, for all pairs of
motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    continuous_signs,
    mean_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
)
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import choice, sequence, whole_number

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Method = Literal["dtw", "resample"]

METHODS = ("dtw", "resample")

_BACK, _ASIDE = np.array([2, 1, 1, 0]), np.array([0, -1, 1, 0])  # steps: both, a only, b only, arrived
_MOST_SAMPLES = 10_000  # warping takes memory in proportion to the square of them
_LEVER = 0.1  # [m] distance that counts as much as a rotation of 1 rad
_SMOOTHING = 0.04  # half width of the window that smooths a warp, as a fraction of the duration
_SLOWEST = 0.1  # lowest pace of a demonstration's clock, as a fraction of the common pace

_HELD = 0.2  # fraction of rows that repeat the row before, above which values count as held
_FEWEST_HELD = 5  # number of separate repeats, likewise: one long pause is not a held value
_QUANTA = 4.0  # steps of a held value are larger than this many least digits; rounded values step by one or two
_WINDOW = 0.2  # [s] over which positions are averaged
_LONGEST_WINDOW = 0.1  # of the duration, likewise when samples are noisy
_STILL = 1e-4  # [m] within this distance the tool still stands, whatever its speed
_STILL_ROTATION = 1e-3  # [rad]
_MARGIN = 0.1  # [s] kept before and after the motion, so that none of a slow motion is lost
_LEFT = 5.0  # times as far away the tool has left the place where it stood
_NOISE_FACTOR = 4.0  # standard deviations of noise that count as standing


@dataclass(frozen=True, eq=False)
class Alignment:
    """Aligned demonstrations, and how alignment changed them.

    Attributes:
        demonstrations: demonstrations with common times from 0 to ``duration``.
        duration: common duration of the aligned demonstrations, the median of the trimmed demonstrations' durations
            [s].
        kept_rows: indices of the first and the last row of each demonstration that remain after trimming, shape
            (n_demonstrations, 2).
        durations: duration of each trimmed demonstration before alignment [s], shape (n_demonstrations,).
        warps: for each sample of an aligned demonstration, the time of the same point in the trimmed demonstration,
            shape (n_demonstrations, n). Each time is a fraction of the trimmed demonstration's duration, from 0 to 1.
            The times strictly increase.
        method: ``"dtw"`` or ``"resample"``.
    """

    demonstrations: tuple[Demonstration, ...]
    duration: float
    kept_rows: NDArray[np.int64]
    durations: Array
    warps: Array
    method: str

    @property
    def largest_shift(self) -> Array:
        """Largest time shift of any sample of each demonstration [s], shape (n_demonstrations,)."""
        even = np.linspace(0.0, 1.0, self.warps.shape[1])
        return np.asarray(np.abs(self.warps - even).max(axis=1) * self.duration)

    def notes(self) -> list[str]:
        """Return a description of how alignment changed each demonstration, one line for each."""
        return [
            f"{one.source}: duration {duration:.2f} s, now {self.duration:.2f} s; largest time shift {shift:.2f} s"
            for one, duration, shift in zip(self.demonstrations, self.durations, self.largest_shift, strict=True)
        ]


def align(demonstrations: Sequence[Demonstration], *, n: int = 200, method: Method = "dtw") -> list[Demonstration]:
    """Trim, time-warp and resample demonstrations of one motion so that a skill can be learned from them.

    Rest at both ends is cut off, and time starts at 0. The common duration is the median duration. The method ``"dtw"``
    then warps the time of each demonstration to match an average motion (:func:`barycentre_warps`). The method
    ``"resample"`` only stretches time evenly. Positions, rotations and joint positions of one demonstration all follow
    the same warp.

    Args:
        demonstrations: one or more demonstrations of one motion.
        n: number of samples of each result.
        method: ``"dtw"`` or ``"resample"``.

    Returns:
        Demonstrations with the same ``n`` times. The ``source`` of each demonstration states which rows of the
        recording were kept.

    Raises:
        InputError: when the list is empty, ``n`` is below 10, a demonstration does not move, or only some have
            rotations.
        UnknownNameError: when the method is unknown.
    """
    return list(compute_alignment(demonstrations, n=n, method=method).demonstrations)


def compute_alignment(demonstrations: Sequence[Demonstration], *, n: int = 200, method: Method = "dtw") -> Alignment:
    """Align demonstrations, and return them together with a record of how alignment changed them.

    The arguments and errors are those of :func:`align`.
    """
    choice(method, METHODS, "method of alignment")
    n = whole_number(n, "align: n", at_least=10, at_most=_MOST_SAMPLES)
    if not sequence(demonstrations, Demonstration, "align: demonstrations"):
        raise InputError("align: no demonstrations; read some first")
    if len({one.trajectory.quaternions is None for one in demonstrations}) > 1:
        without = next(one for one in demonstrations if one.trajectory.quaternions is None)
        raise InputError(
            f"align: some demonstrations have rotations, but {without.source or 'one'} has none; leave out this "
            "demonstration"
        )
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
        raise InputError(
            f"align: {demonstration.source or 'a demonstration'} does not move; leave out this demonstration"
        )
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
    """Return the demonstration at ``times``; ``warp`` is the elapsed fraction of its own duration at each time."""
    motion = demonstration.trajectory
    own = warp * motion.duration
    joints = demonstration.joints
    if joints is not None:
        joints = np.stack([np.interp(own, motion.times, column) for column in joints.T], axis=1)
    return demonstration.with_trajectory(Trajectory(times, *motion.at(own)), joints)


def noise_level(values: Array) -> float:
    """Estimate the standard deviation of white noise on samples (n, d), from their third differences.

    For white noise of standard deviation s, the variance of a third difference is 20 s^2. Third differences still
    contain a little motion; the estimate uses the median, so that this motion has little influence. With fewer than 20
    samples, noise and motion can't be separated, and the result is 0.
    """
    if len(values) < 20:
        return 0.0
    third = np.diff(values, n=3, axis=0)
    return float(np.max(1.4826 * np.median(np.abs(third), axis=0)) / np.sqrt(20.0))


def turns(quaternions: Array) -> Array:
    """Return the sum of the rotation vectors of all steps up to each sample, shape (n, 3) [rad]."""
    q = continuous_signs(quaternions)
    steps = quaternion_log(quaternion_multiply(q[1:], quaternion_conjugate(q[:-1])))
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def moving_rows(times: Array, positions: Array, quaternions: Array | None = None) -> tuple[int, int] | None:
    """Return the first and the last row between which the tool moves; None if it never moves.

    The function first searches for the first row that is more than 0.5 mm away from the start. From there, it goes back
    to the last row within 0.1 mm of the start. That row is the first row of the motion. The last row is found in the
    same way, from the end backwards. A margin of 0.1 s is kept on both sides. Speed is not used, so a slow motion is
    never mistaken for rest. If the samples are noisy, both limits (0.5 mm and 0.1 mm) are raised to at least 4 standard
    deviations of the noise that remains after averaging. Rotation without displacement counts as motion.

    Args:
        times: strictly increasing, shape (n,) [s].
        positions: shape (n, 3) [m].
        quaternions: wxyz, shape (n, 4), or None.
    """
    spans = [_moving(times, positions, _STILL)]
    if quaternions is not None:
        spans.append(_moving(times, turns(quaternions), _STILL_ROTATION))
    found = [span for span in spans if span is not None]
    return (min(first for first, _ in found), max(last for _, last in found)) if found else None


def _moving(times: Array, values: Array, still: float) -> tuple[int, int] | None:
    """Return the first and the last row of the part in which ``values`` (n, d) change by more than ``still``."""
    noise, step = noise_level(values), float(np.median(np.diff(times)))
    left = _LEFT * still
    quiet = (_NOISE_FACTOR * noise / left) ** 2 * step  # an average over so long has noise below the larger distance
    window = float(np.clip(quiet, _WINDOW, max(_WINDOW, _LONGEST_WINDOW * (times[-1] - times[0]))))
    _, mean, n = smooth_slope(times, values, window)

    def leaves(mean: Array, n: Array) -> tuple[int, int] | None:
        distance = np.linalg.norm(mean - mean[0], axis=1)
        blur = _NOISE_FACTOR * noise * np.sqrt(1.0 / n + 1.0 / n[0])
        away = np.flatnonzero(distance > np.maximum(left, blur))
        if not len(away):
            return None
        near = np.flatnonzero(distance[: away[0]] <= np.maximum(still, blur[: away[0]]))
        return int(near[-1]), int(away[0])

    start, end = leaves(mean, n), leaves(mean[::-1], n[::-1])
    if start is None or end is None or start[1] > len(times) - 1 - end[1]:
        return None
    first = np.searchsorted(times, times[start[0]] - _MARGIN)
    last = np.searchsorted(times, times[len(times) - 1 - end[0]] + _MARGIN, side="right") - 1
    return int(first), int(last)


def held_rows(values: Array) -> NDArray[np.bool_]:
    """Return whether each row of ``values`` (n, d) repeats the previous row, shape (n,).

    Rows repeat if the recorder samples faster than the sensor measures. If a motion contains too few repeated rows, or
    the values change in coarse steps, no row counts as repeated.
    """
    none = np.zeros(len(values), dtype=bool)
    steps = np.abs(np.diff(values, axis=0))
    same = np.asarray(~(steps > 0.0).any(axis=1))
    changes = np.flatnonzero(~same)
    if len(changes) <= _FEWEST_HELD:
        return none
    repeats = np.diff(changes) > 1  # between two changes the value was held
    moving = same[changes[0] : changes[-1] + 1]
    if repeats.sum() < max(_FEWEST_HELD, 0.1 * len(repeats)) or moving.mean() < _HELD:
        return none
    largest = steps[changes].max(axis=1)
    if np.median(largest) <= _QUANTA * float(np.min(steps[steps > 0.0])):
        return none
    return np.concatenate([[False], same])


def smooth_speed(times: Array, values: Array, window: float = _WINDOW) -> tuple[Array, Array]:
    """Return speed (n,) [unit/s] and mean (n, d) of ``values`` (n, d) in a time window [s] around each sample."""
    slope, mean, _ = smooth_slope(times, values, window)
    return np.linalg.norm(slope, axis=1), mean


def smooth_slope(times: Array, values: Array, window: float = _WINDOW) -> tuple[Array, Array, Array]:
    """Fit a straight line over time to the samples in a window around each sample.

    Args:
        times: strictly increasing, shape (n,) [s].
        values: shape (n, d).
        window: length of the window [s]; it always includes the neighbouring samples on both sides.

    Returns:
        least-squares slopes (n, d) [unit/s], means (n, d), and the number of samples in each window (n,).
    """
    t = times - times[0]
    here = np.arange(len(t))
    first = np.minimum(np.searchsorted(t, t - 0.5 * window - 1e-9), np.maximum(here - 1, 0))
    last = np.maximum(np.searchsorted(t, t + 0.5 * window + 1e-9), np.minimum(here + 2, len(t)))
    n = (last - first).astype(float)
    offset = values[0]
    centred = values - offset

    def windowed(column: Array) -> Array:
        total = np.concatenate([np.zeros((1, *column.shape[1:])), np.cumsum(column, axis=0)])
        return np.asarray(total[last] - total[first])

    sum_t, sum_x = windowed(t), windowed(centred)
    spread = np.maximum(windowed(t * t) - sum_t**2 / n, 1e-12)
    slope = (windowed(t[:, None] * centred) - sum_t[:, None] * sum_x / n[:, None]) / spread[:, None]
    return np.asarray(slope), np.asarray(sum_x / n[:, None] + offset), n


def dtw(a: Array, b: Array, *, band: int, price: float = 0.0) -> tuple[Array, Indices]:
    """Match the samples of motions ``a`` with those of motions ``b``, pair by pair.

    Args:
        a: first motions, shape (pairs, n, d).
        b: second motions, shape (pairs, n, d), same n.
        band: largest allowed |i - j|, in samples.
        price: cost of a step that is not diagonal, in the unit of squared distances between samples.

    Returns:
        cost: cost D(n-1, n-1) of the cheapest path of each pair, shape (pairs,).
        path: index pairs (i, j) of matched samples, shape (pairs, 2 n - 1, 2). Each path runs backwards, from (n-1,
            n-1) to (0, 0); the remaining rows are (0, 0).
    """
    n = a.shape[1]
    # one row for each anti-diagonal i + j, one column for each offset i - j; cells outside grid or band cost inf
    diagonal, offset = np.arange(2 * n - 1)[:, None], np.arange(-band - 1, band + 2)
    i, j = (diagonal + offset) // 2, (diagonal - offset) // 2
    inside = ((diagonal + offset) % 2 == 0) & (i >= 0) & (i < n) & (j >= 0) & (j < n) & (np.abs(offset) <= band)
    squares = np.sum(a**2, axis=2)[:, :, None] + np.sum(b**2, axis=2)[:, None] - 2.0 * a @ np.swapaxes(b, 1, 2)
    cost = np.where(inside, np.maximum(squares, 0.0)[:, i.clip(0, n - 1), j.clip(0, n - 1)], np.inf)
    cost = np.ascontiguousarray(np.moveaxis(cost, 1, 0))  # (2 n - 1, pairs, offsets)
    total = np.full_like(cost, np.inf)
    total[0] = cost[0]
    for k in range(1, 2 * n - 1):
        straight = np.minimum(total[k - 1, :, :-2], total[k - 1, :, 2:]) + price
        if k > 1:
            straight = np.minimum(straight, total[k - 2, :, 1:-1] + cost[k, :, 1:-1])
        total[k, :, 1:-1] = cost[k, :, 1:-1] + straight
    return total[-1, :, band + 1], _trace(total, cost, price)


def _trace(total: Array, cost: Array, price: float) -> Indices:
    """Trace the cheapest path from the last pair of samples back to the first, for all pairs of motions together."""
    length, pairs, width = total.shape
    every = np.arange(pairs)
    diagonal, column = np.full(pairs, length - 1), np.full(pairs, width // 2)
    path = np.zeros((pairs, length, 2), dtype=np.int64)
    for step in range(length):
        offset = column - width // 2
        path[:, step, 0], path[:, step, 1] = (diagonal + offset) // 2, (diagonal - offset) // 2
        one, two = np.maximum(diagonal - 1, 0), np.maximum(diagonal - 2, 0)
        options = np.stack(
            [
                np.where(diagonal > 1, total[two, every, column] + cost[diagonal, every, column], np.inf),
                total[one, every, column - 1] + price,
                total[one, every, column + 1] + price,
            ]
        )
        choice = np.where(diagonal > 0, np.argmin(options, axis=0), 3)
        diagonal = diagonal - _BACK[choice]
        column = column + _ASIDE[choice]
    return path


def identity_warps(n_demonstrations: int, n: int) -> Array:
    """Return the warps of unchanged motions: evenly spaced times from 0 to 1, shape (n_demonstrations, n)."""
    return np.tile(np.linspace(0.0, 1.0, n), (n_demonstrations, 1))


def features(trajectories: Sequence[Trajectory]) -> Array:
    """Return the features by which motions are compared [m].

    Each path is first moved to the common start and goal. Otherwise, alignment would mistake a different start position
    for an earlier or later start. Rotations become rotation vectors relative to the mean rotation, multiplied by a
    lever arm of 0.1 m. The features have the shape (n_demonstrations, n, 3), or (n_demonstrations, n, 6) with
    rotations.
    """
    parts = [to_common_ends(np.stack([trajectory.positions for trajectory in trajectories]))]
    if trajectories[0].quaternions is not None:
        parts.append(_LEVER * to_common_ends(rotation_paths(trajectories)))
    return np.concatenate(parts, axis=2)


def rotation_paths(trajectories: Sequence[Trajectory]) -> Array:
    """Return rotation vectors relative to the mean rotation, continuous beyond 180 degrees, shape (m, n, 3) [rad]."""
    q = np.stack([one.quaternions for one in trajectories if one.quaternions is not None])
    first = quaternion_log(quaternion_multiply(q[:, 0], quaternion_conjugate(mean_quaternion(q))))
    return np.stack([f + turns(one) for f, one in zip(first, q, strict=True)])


def to_common_ends(values: Array) -> Array:
    """Return the m motions (m, n, d), moved so that they all begin at the mean start and end at the mean goal."""
    fraction = np.linspace(0.0, 1.0, values.shape[1])[:, None]
    start, goal = values[:, :1], values[:, -1:]
    return np.asarray(values - (1.0 - fraction) * (start - start.mean(axis=0)) - fraction * (goal - goal.mean(axis=0)))


def medoid(values: Array) -> int:
    """Return the index of the motion that is nearest to all others, among ``values`` (n_demonstrations, n, d)."""
    flat = values.reshape(len(values), -1)
    squares = np.sum(flat**2, axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2.0 * flat @ flat.T, 0.0))
    return int(np.argmin(distance.sum(axis=1)))


def barycentre_warps(values: Array, *, band: float = 0.2, stiffness: float = 1.0, n_iterations: int = 8) -> Array:
    """Return the time warps that align motions with their common average motion (barycentre).

    The first barycentre is the medoid: the motion nearest to all others. Each round matches every motion with the
    barycentre by :func:`dtw` and smooths the matched times into a warp. The mean of the warped motions is the
    barycentre of the next round. The method of Petitjean et al. (2011) uses sets of matched samples; here, each motion
    has a smooth warp instead. The warps are finally centred, so that the mean of all warps leaves time unchanged. The
    common speed profile is therefore the mean of all speed profiles, not the profile of the medoid.

    Args:
        values: features, shape (n_demonstrations, n, d), evenly spaced in time.
        band: largest time shift before centring, as a fraction of the duration.
        stiffness: price of a step that is not diagonal, as a multiple of the median squared distance to the barycentre.
        n_iterations: largest number of rounds; the rounds end earlier when the warps no longer change.

    Returns:
        Time warps, shape (n_demonstrations, n); each row strictly increases from 0 to 1.
    """
    m, n, _ = values.shape
    even = np.linspace(0.0, 1.0, n)
    warps = identity_warps(m, n)
    barycentre = values[medoid(values)]
    warped = values
    for _ in range(n_iterations):
        price = stiffness * float(np.median(np.sum((warped - barycentre) ** 2, axis=2)))
        _, path = dtw(values, np.repeat(barycentre[None], m, axis=0), band=max(2, round(band * n)), price=price)
        before, warps = warps, _centred(np.stack([_smooth_warp(one, n) for one in path]), even)
        warped = _at(values, warps)
        barycentre = warped.mean(axis=0)
        if np.abs(warps - before).max() < 0.5 / n:
            break
    return warps


def _at(values: Array, warps: Array) -> Array:
    """Return motions (m, n, d), interpolated at the warped times (m, n)."""
    even = np.linspace(0.0, 1.0, values.shape[1])
    return np.stack(
        [np.stack([np.interp(w, even, c) for c in v.T], axis=1) for v, w in zip(values, warps, strict=True)]
    )


def _smooth_warp(path: Indices, n: int) -> Array:
    """Return a smooth, strictly increasing warp (n,) from matched index pairs (motion, barycentre)."""
    length = int(np.argmax(path.sum(axis=1) == 0)) + 1
    own, common = path[:length, 0], path[:length, 1]
    mean = np.bincount(common, weights=own, minlength=n) / np.bincount(common, minlength=n)
    bend = mean / (n - 1) - np.linspace(0.0, 1.0, n)  # 0 at both ends, and stays so: it is mirrored through them
    half = max(1, round(_SMOOTHING * n))
    padded = np.concatenate([-bend[half:0:-1], bend, -bend[-2 : -half - 2 : -1]])
    kernel = np.hanning(2 * half + 3)[1:-1]
    warp = np.linspace(0.0, 1.0, n) + np.convolve(padded, kernel / kernel.sum(), mode="valid")
    steps = np.maximum(np.diff(warp), _SLOWEST / n)  # time never stands still
    warp = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(warp / warp[-1])


def _centred(warps: Array, even: Array) -> Array:
    """Return the warps as functions of a new common time, which makes the mean of all warps the identity."""
    back = np.interp(even, warps.mean(axis=0), even)
    return np.stack([np.interp(back, even, warp) for warp in warps])
