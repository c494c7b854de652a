"""Dynamic time warping of many motions at once, within a band and against a barycentre.

A warp says for each step of the common motion which time of a demonstration shows it. For two motions ``a``, ``b``
of n samples the cheapest monotone path through the grid of costs ``c(i, j) = |a_i - b_j|^2`` obeys

    D(i, j) = c(i, j) + min(D(i-1, j-1) + c(i, j), D(i-1, j) + p, D(i, j-1) + p)

(Sakoe and Chiba 1978, symmetric form: the diagonal counts twice), here with a price ``p`` on every step that is not
diagonal, so that noise does not bend time, and only for |i - j| within the band. All cells of one anti-diagonal are
computed together, for all pairs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.idle import turns
from imitarm.kinematics.pose import mean_quaternion, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_BACK, _ASIDE = np.array([2, 1, 1, 0]), np.array([0, -1, 1, 0])  # steps: both, a only, b only, arrived
_LEVER = 0.1  # [m] distance that a turn of 1 rad counts for
_SMOOTHING = 0.04  # half width of the window that smooths a warp, as a share of the duration
_SLOWEST = 0.1  # pace of a demonstration's clock, at least, as a share of the common one


def dtw(a: Array, b: Array, *, band: int, price: float = 0.0) -> tuple[Array, Indices]:
    """Match motions ``a`` with motions ``b``, pair by pair.

    Args:
        a: shape (pairs, n, d).
        b: shape (pairs, n, d), same n.
        band: largest |i - j| that is allowed, in samples.
        price: of a step that is not diagonal, in units of the cost.

    Returns:
        cost: D(n-1, n-1) of each pair, shape (pairs,).
        path: index pairs (i, j) from the end to the start, which is repeated, shape (pairs, 2 n - 1, 2).
    """
    n = a.shape[1]
    # one row an anti-diagonal i + j, one column an offset i - j; what is outside the grid or the band costs inf
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
    """Walk back from the last pair of samples to the first, for all pairs of motions together."""
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
    """Return the warps that change nothing, shape (n_demonstrations, n)."""
    return np.tile(np.linspace(0.0, 1.0, n), (n_demonstrations, 1))


def features(trajectories: Sequence[Trajectory]) -> Array:
    """Return what motions are compared by, shape (n_demonstrations, n, 3) or (..., 6) with rotations [m].

    Each path is carried to the common start and goal, so that one which began elsewhere is not taken for one which
    began earlier. Rotations count as rotation vectors from their mean, times a lever of 0.1 m.
    """
    positions = np.stack([trajectory.positions for trajectory in trajectories])
    parts = [_to_common_ends(positions)]
    if trajectories[0].quaternions is not None:
        q = np.stack([one.quaternions for one in trajectories if one.quaternions is not None])
        mean = mean_quaternion(q)
        first = quaternion_log(quaternion_multiply(q[:, 0], quaternion_conjugate(mean)))
        parts.append(_LEVER * _to_common_ends(np.stack([f + turns(one) for f, one in zip(first, q, strict=True)])))
    return np.concatenate(parts, axis=2)


def _to_common_ends(values: Array) -> Array:
    share = np.linspace(0.0, 1.0, values.shape[1])[:, None]
    start, goal = values[:, :1], values[:, -1:]
    return np.asarray(values - (1.0 - share) * (start - start.mean(axis=0)) - share * (goal - goal.mean(axis=0)))


def medoid(values: Array) -> int:
    """Return the index of the motion that is nearest to all others, of (n_demonstrations, n, d)."""
    flat = values.reshape(len(values), -1)
    squares = np.sum(flat**2, axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2.0 * flat @ flat.T, 0.0))
    return int(np.argmin(distance.sum(axis=1)))


def barycentre_warps(values: Array, *, band: float = 0.2, stiffness: float = 1.0, n_iterations: int = 8) -> Array:
    """Return the warps that bring motions to their common barycentre.

    Starting from the medoid, each motion is matched with the barycentre by :func:`dtw`, its matched times are
    smoothed into a warp, and the barycentre becomes the mean of the warped motions (averaging as in Petitjean et al.
    2011, with one smooth warp a motion in place of sets of matched samples). The warps are centred: at every moment
    of the common motion their mean is that moment, so the common pace is the mean pace and not the medoid's.

    Args:
        values: what to compare by, shape (n_demonstrations, n, d), evenly spaced in time.
        band: largest share of the duration by which a moment may be moved before centring.
        stiffness: price of bending time, in mean squared deviations from the barycentre.
        n_iterations: at most so many rounds.

    Returns:
        shape (n_demonstrations, n), from 0 to 1, strictly increasing.
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
    """Return motions (m, n, d) read at warped times (m, n)."""
    even = np.linspace(0.0, 1.0, values.shape[1])
    return np.stack(
        [np.stack([np.interp(w, even, c) for c in v.T], axis=1) for v, w in zip(values, warps, strict=True)]
    )


def _smooth_warp(path: Indices, n: int) -> Array:
    """Turn matched pairs (motion, barycentre) into a strictly increasing warp over the barycentre's n steps."""
    length = int(np.argmax(path.sum(axis=1) == 0)) + 1
    own, common = path[:length, 0], path[:length, 1]
    mean = np.bincount(common, weights=own, minlength=n) / np.bincount(common, minlength=n)
    bend = mean / (n - 1) - np.linspace(0.0, 1.0, n)  # 0 at both ends, and stays so: it is mirrored through them
    half = max(1, round(_SMOOTHING * n))
    padded = np.concatenate([-bend[half:0:-1], bend, -bend[-2 : -half - 2 : -1]])
    kernel = np.hanning(2 * half + 3)[1:-1]
    warp = np.linspace(0.0, 1.0, n) + np.convolve(padded, kernel / kernel.sum(), mode="valid")
    steps = np.maximum(np.diff(warp), _SLOWEST / n)  # time never stands: every moment keeps a place
    warp = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(warp / warp[-1])


def _centred(warps: Array, even: Array) -> Array:
    """Change the common clock so that the mean of all warps is even time."""
    back = np.interp(even, warps.mean(axis=0), even)
    return np.stack([np.interp(back, even, warp) for warp in warps])
