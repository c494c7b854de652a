r"""What a teacher may advise where an arm can't do what was shown: slower, nearer, another elbow, or a repair.

Each operator changes one segment of a :class:`~imitarm.retarget.baselines.shown_motion.ShownMotion`, by a weight that
is 1 where the change is needed and falls to 0 at the segment's ends, so that the motion stays in one piece.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from imitarm.retarget.baselines.infeasible import ELBOW, Infeasible
from imitarm.retarget.baselines.shown_motion import ShownMotion

Array = NDArray[np.float64]

SPEED_LEFT = 0.9  # share of the velocity limits that a slowed segment uses
PULLED_TO = 0.78 / 0.80  # share of the reach to which the wrist is pulled in
TURNS = tuple(np.deg2rad((10.0, -10.0, 20.0, -20.0, 30.0, -30.0)))  # [rad] of the elbow about shoulder to wrist
KEYS, DRAWS = 5, 500  # key frames of a segment; samples drawn for one of them
_ABOUT_KEY = 0.2  # [s] on both sides of a key frame, from which its spread is taken
_LEAST_SPREAD = 0.1  # [rad] of each joint at a key frame: one demonstration tells little of what may vary


def slowed(motion: ShownMotion, first: int, past: int, weight: Array, factor: float) -> tuple[ShownMotion, int]:
    r"""Slow a segment down: its time passes :math:`1 + w\,(s - 1)` times as slowly.

    Args:
        motion: with joints.
        first: sample at which the segment begins.
        past: the one after its last.
        weight: w, shape (past - first,).
        factor: s, at least 1.

    Returns:
        the motion, and the sample at which the segment now ends.
    """
    stretch = np.ones(len(motion))
    stretch[first:past] += weight * (factor - 1.0)
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]))])  # in periods, for each sample
    where = np.interp(np.arange(np.ceil(passed[-1]) + 1), passed, np.arange(len(motion)))
    last = past + round(passed[-1] - (len(motion) - 1))
    return motion.at(where), min(last, len(where))


def pull(points: Array, joints: Array) -> Array:
    r"""Return how far to pull the wrist in so that the robot is stretched to 78/80 at most, :math:`\kappa`, (n,).

    Where the robot's elbow is the person's, that is :math:`\kappa = 0.78/(\rho |W - S|)` as METHODS has it; where it is
    not (a relative mapping), the person's elbow has to bend by what the robot's lacks.

    Args:
        points: shoulder, elbow, wrist, shape (n, 3, 3) [m].
        joints: of the robot, shape (n, n_joints) [rad].
    """
    s, e, w = np.moveaxis(points, 1, 0)
    upper, fore, reach = _length(e - s), _length(w - e), _length(w - s)
    lacking = np.maximum(2.0 * np.arccos(PULLED_TO) - np.abs(joints[:, ELBOW]), 0.0)
    cosine = (reach**2 - upper**2 - fore**2) / (2.0 * upper * fore)
    bend = np.arccos(np.clip(cosine, -1.0, 1.0)) + lacking
    near = np.sqrt(upper**2 + fore**2 + 2.0 * upper * fore * np.cos(np.minimum(bend, np.pi)))
    return np.where(lacking > 0.0, np.minimum(near / np.maximum(reach, 1e-9), 1.0), 1.0)


def pulled_in(points: Array, kappa: Array) -> Array:
    r"""Pull the wrist towards the shoulder, :math:`W' = S + \kappa (W - S)`; the elbow bends in the plane it is in.

    Args:
        points: shoulder, elbow, wrist, shape (n, 3, 3) [m].
        kappa: shape (n,), at most 1.

    Returns:
        shape (n, 3, 3) [m]; the bones keep their lengths.
    """
    s, e, w = np.moveaxis(points, 1, 0)
    upper, fore = _length(e - s), _length(w - e)
    pulled = s + kappa[:, None] * (w - s)
    reach = np.clip(_length(pulled - s), np.maximum(np.abs(upper - fore), 1e-6), upper + fore)
    way = (pulled - s) / np.maximum(_length(pulled - s), 1e-9)[:, None]
    side = (e - s) - way * np.sum(way * (e - s), axis=1, keepdims=True)
    down = np.array([0.0, 0.0, -1.0]) - way * -way[:, 2:]  # where the elbow of a straight arm goes
    side = np.where(_length(side)[:, None] > 1e-3 * upper[:, None], side, down)
    side = side / np.maximum(_length(side), 1e-9)[:, None]
    along = (upper**2 - fore**2 + reach**2) / (2.0 * reach)
    across = np.sqrt(np.maximum(upper**2 - along**2, 0.0))
    elbow = s + along[:, None] * way + across[:, None] * side
    return np.stack([s, elbow, s + reach[:, None] * way], axis=1)


def elbow_turned(points: Array, angle: Array) -> Array:
    """Turn the elbow about the line from shoulder to wrist.

    Args:
        points: shoulder, elbow, wrist, shape (n, 3, 3) [m].
        angle: shape (n,) [rad].

    Returns:
        shape (n, 3, 3) [m]; the bones keep their lengths.
    """
    s, e, w = np.moveaxis(points, 1, 0)
    axis = (w - s) / np.maximum(_length(w - s), 1e-9)[:, None]
    c, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    out = e - s
    turned = c * out + sine * np.cross(axis, out) + (1.0 - c) * axis * np.sum(axis * out, axis=1, keepdims=True)
    return np.stack([s, s + turned, w], axis=1)


def with_points(motion: ShownMotion, first: int, past: int, points: Array) -> ShownMotion:
    """Return the motion with other points (past - first, 3, 3) [m] in a segment; the joints are to be mapped anew."""
    changed = motion.points.copy()
    changed[first:past] = points
    return replace(motion, points=changed)


def repaired(
    joints: Array, first: int, past: int, infeasible: Infeasible, rng: np.random.Generator
) -> tuple[Array, int]:
    r"""Repair a segment at key frames (after Mueller et al. 2018), and lay a cubic spline through them.

    For each of five key frames a normal distribution :math:`N(\mu_k, \Sigma_k)` is fitted to the joints about it, and
    up to 500 samples are drawn until one meets all that can be told from a posture; a key frame that meets
    it already is kept. When none does, :math:`\mu_k` is put back into the limits.

    Args:
        joints: of the whole motion, shape (n, n_joints) [rad].
        first: sample at which the segment begins.
        past: the one after its last.
        infeasible: what must not be.
        rng: for the samples.

    Returns:
        joints, shape (n, n_joints) [rad], the same outside the segment; how many key frames found no sample.
    """
    n, dt = len(joints), infeasible.dt
    last = past - 1
    inside = np.unique(np.linspace(first, last, KEYS + 2).round().astype(int)[1:-1])
    keys = [int(k) for k in inside if first < k < last]
    begin, end = (0 if first == 0 else None), (last if past == n else None)  # an end of the motion may move too
    keys = sorted({*keys, *(k for k in (begin, end) if k is not None)})
    values, missed = [], 0
    wide = max(round(_ABOUT_KEY / dt), 1)
    for key in keys:
        about = joints[max(key - wide, 0) : key + wide + 1]
        spread = np.cov(about, rowvar=False) if len(about) > 1 else np.zeros((joints.shape[1],) * 2)
        value, met = _sample(joints[key], spread + _LEAST_SPREAD**2 * np.eye(joints.shape[1]), infeasible, rng)
        values.append(value)
        missed += not met
    at = sorted({first, *keys, last})
    through = np.array([values[keys.index(k)] if k in keys else joints[k] for k in at])
    result = joints.copy()
    if len(at) > 1:
        rest = np.zeros(joints.shape[1])
        before = rest if first == 0 else joints[first] - joints[first - 1]  # [rad] a sample, outside the segment
        after = rest if past == n else joints[past] - joints[last]
        spline = CubicSpline(at, through, bc_type=((1, before), (1, after)))
        result[first:past] = spline(np.arange(first, past))
    else:
        result[first:past] = through
    return result, missed


def _sample(mean: Array, covariance: Array, infeasible: Infeasible, rng: np.random.Generator) -> tuple[Array, bool]:
    """Return a posture that nothing is wrong with, shape (n_joints,), and whether one was found."""
    if infeasible.allows(mean):
        return mean, True
    for q in rng.multivariate_normal(mean, covariance, DRAWS):
        if infeasible.allows(q):
            return np.asarray(q), True
    return np.clip(mean, infeasible.arm.lower, infeasible.arm.upper), False


def _length(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))
