"""Corrections of a demonstrated motion, segment by segment, in place of the teacher's advice in baseline M1.

There are four corrections: slow down, move the wrist closer, rotate the elbow, repair by key frames. Each changes one
segment of a :class:`~imitarm.retarget.baselines.demonstrated_motion.DemonstratedMotion` by a weight that is 1 where the
change is needed and decays to 0 at the segment's ends, so that the motion stays continuous.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from imitarm.retarget.baselines.demonstrated_motion import DemonstratedMotion
from imitarm.retarget.baselines.feasibility import ELBOW, FeasibilityCheck, blend, segments
from imitarm.retarget.baselines.joint_mapping import JointMapping
from imitarm.retarget.correspondence import Clutch

Array = NDArray[np.float64]

SLOWED_TO = 0.9  # of the velocity limits: highest speed of a slowed segment
PULLED_TO = 0.78 / 0.80  # of the reach: largest distance of the wrist after the correction
# [rad] about the line from shoulder to wrist
ELBOW_ROTATIONS = tuple(np.deg2rad((10.0, -10.0, 20.0, -20.0, 30.0, -30.0)))
KEYS, DRAWS = 5, 500  # key frames per segment; samples drawn per key frame
_ABOUT_KEY = 0.2  # [s] on both sides of a key frame: samples that determine its covariance
_LEAST_SPREAD = 0.1  # [rad] smallest standard deviation of a joint: one demonstration shows little variation
Mask = NDArray[np.bool_]

COUNTED = (
    "segments",
    "slowed",
    "pulled_in",
    "elbow_rotated",
    "repaired",
    "missed_keys",
    "infeasible_before",
    "infeasible_after",
    "failures",
    "shown_time",
    "corrected_time",
)
"""Names of the counts that are summed over the engagements of a recording."""
_STRIDE = 10  # every tenth sample is checked first
_SLOWEST = 10.0  # largest factor of slowing down


def slowed(
    motion: DemonstratedMotion, first: int, past: int, weight: Array, factor: float
) -> tuple[DemonstratedMotion, int]:
    r"""Slow a segment down: its time passes :math:`1 + w\,(s - 1)` times as slowly.

    Args:
        motion: with joints.
        first: first sample of the segment.
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
    r"""Return the factor :math:`\kappa` of the distance shoulder to wrist for a stretch of 78/80 at most, shape (n,).

    Where the robot's elbow angle equals the person's, this is :math:`\kappa = 0.78/(\rho |W - S|)`; where it differs
    (relative mapping), the person's elbow must bend by the amount that is missing at the robot's elbow.

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
    r"""Move the wrist towards the shoulder, :math:`W' = S + \kappa (W - S)`; the elbow bends in its plane.

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
    axis = (pulled - s) / np.maximum(_length(pulled - s), 1e-9)[:, None]
    side = (e - s) - axis * np.sum(axis * (e - s), axis=1, keepdims=True)
    down = np.array([0.0, 0.0, -1.0]) - axis * -axis[:, 2:]  # direction in which the elbow of a straight arm moves
    side = np.where(_length(side)[:, None] > 1e-3 * upper[:, None], side, down)
    side = side / np.maximum(_length(side), 1e-9)[:, None]
    along = (upper**2 - fore**2 + reach**2) / (2.0 * reach)
    across = np.sqrt(np.maximum(upper**2 - along**2, 0.0))
    elbow = s + along[:, None] * axis + across[:, None] * side
    return np.stack([s, elbow, s + reach[:, None] * axis], axis=1)


def elbow_rotated(points: Array, angle: Array) -> Array:
    """Rotate the elbow about the line from shoulder to wrist.

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
    rotated = c * out + sine * np.cross(axis, out) + (1.0 - c) * axis * np.sum(axis * out, axis=1, keepdims=True)
    return np.stack([s, s + rotated, w], axis=1)


def with_points(motion: DemonstratedMotion, first: int, past: int, points: Array) -> DemonstratedMotion:
    """Return the motion with other points (past - first, 3, 3) [m] in a segment; its joints must be mapped again."""
    changed = motion.points.copy()
    changed[first:past] = points
    return replace(motion, points=changed)


def repaired(
    joints: Array, first: int, past: int, check: FeasibilityCheck, rng: np.random.Generator
) -> tuple[Array, int]:
    r"""Repair a segment at key frames (after Mueller et al. 2018) and interpolate them by a cubic spline.

    For each of five key frames a normal distribution :math:`N(\mu_k, \Sigma_k)` is fitted to the joints around it, and
    up to 500 samples are drawn until one is feasible; a key frame that is feasible already is kept. When no sample is
    feasible, :math:`\mu_k` is clipped to the joint ranges.

    Args:
        joints: of the whole motion, shape (n, n_joints) [rad].
        first: first sample of the segment.
        past: the one after its last.
        check: the feasibility check.
        rng: for the samples.

    Returns:
        joints, shape (n, n_joints) [rad], unchanged outside the segment; number of key frames without a feasible
        sample.
    """
    n, dt = len(joints), check.dt
    last = past - 1
    inside = np.unique(np.linspace(first, last, KEYS + 2).round().astype(int)[1:-1])
    keys = [int(k) for k in inside if first < k < last]
    begin, end = (0 if first == 0 else None), (last if past == n else None)  # the ends of the motion may change too
    keys = sorted({*keys, *(k for k in (begin, end) if k is not None)})
    values, missed = [], 0
    wide = max(round(_ABOUT_KEY / dt), 1)
    for key in keys:
        about = joints[max(key - wide, 0) : key + wide + 1]
        spread = np.cov(about, rowvar=False) if len(about) > 1 else np.zeros((joints.shape[1],) * 2)
        value, met = _sample(joints[key], spread + _LEAST_SPREAD**2 * np.eye(joints.shape[1]), check, rng)
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


def _sample(mean: Array, covariance: Array, check: FeasibilityCheck, rng: np.random.Generator) -> tuple[Array, bool]:
    """Return a feasible posture, shape (n_joints,), and whether one was found."""
    if check.allows(mean):
        return mean, True
    for q in rng.multivariate_normal(mean, covariance, DRAWS):
        if check.allows(q):
            return np.asarray(q), True
    return np.clip(mean, check.arm.lower, check.arm.upper), False


def _length(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


class SegmentCorrector:
    """Corrects the motion of one engagement in rounds (baseline M1).

    Args:
        mapping: of the person's joints, started where the robot is.
        clutch: of this engagement.
        check: the feasibility check.
        rng: for the samples of a repair.

    Attributes:
        rounds: number of rounds so far.
        counts: by the names of :data:`COUNTED`; times in s.
    """

    def __init__(
        self, mapping: JointMapping, clutch: Clutch, check: FeasibilityCheck, rng: np.random.Generator
    ) -> None:
        self._mapping, self._clutch, self._check, self._rng = mapping, clutch, check, rng
        self.rounds = 0
        self.counts: dict[str, float] = dict.fromkeys(COUNTED, 0.0)

    def corrected(self, motion: DemonstratedMotion, rounds: int) -> DemonstratedMotion:
        """Return the motion with the robot's joints, corrected as far as possible.

        Args:
            motion: without joints.
            rounds: at most.
        """
        dt = self._check.dt
        motion = motion.with_joints(np.array([self._mapping.joints(e, self._clutch) for e in motion.estimates()]))
        found = self._check.anywhere(motion.joints)
        self.counts["shown_time"] += dt * len(motion)
        self.counts["infeasible_before"] += int(np.count_nonzero(found))
        while found.any() and self.rounds < rounds:
            self.rounds += 1
            for first, past in reversed(segments(found, dt)):  # slowing down shifts what follows
                self.counts["segments"] += 1
                self.counts["corrected_time"] += dt * (past - first)
                motion = self._corrected(motion, first, past, blend(found, first, past, dt))
            found = self._check.anywhere(motion.joints)
        self.counts["infeasible_after"] += int(np.count_nonzero(found))
        self.counts["failures"] += len(segments(found, dt))
        return motion

    def _corrected(self, motion: DemonstratedMotion, first: int, past: int, weight: Array) -> DemonstratedMotion:
        """Return the motion with one segment changed by the first correction that makes it feasible, else repaired."""
        for name, changed, end in self._proposals(motion, first, past, weight):
            if self._check.clear(changed.joints[max(first - 1, 0) : end + 1]):
                self.counts[name] += 1
                return changed
        joints, missed = repaired(motion.joints, first, past, self._check, self._rng)
        self.counts["repaired"] += 1
        self.counts["missed_keys"] += missed
        return motion.with_joints(joints)

    def _proposals(
        self, motion: DemonstratedMotion, first: int, past: int, weight: Array
    ) -> Iterator[tuple[str, DemonstratedMotion, int]]:
        """Yield the possible corrections in order: name, changed motion, new end of the segment."""
        window = motion.joints[first:past]
        factor = float(self._check.speeds(window).max(initial=0.0)) / SLOWED_TO
        if SLOWED_TO * factor > 1.0 and factor <= _SLOWEST:
            yield "slowed", *slowed(motion, first, past, weight, factor)
        kappa = pull(motion.points[first:past], window)
        if kappa.min() < 1.0:
            points = pulled_in(motion.points[first:past], 1.0 + weight * (kappa - 1.0))
            yield from self._mapped("pulled_in", with_points(motion, first, past, points), first, past)
        for angle in ELBOW_ROTATIONS:
            points = elbow_rotated(motion.points[first:past], weight * angle)
            yield from self._mapped("elbow_rotated", with_points(motion, first, past, points), first, past)

    def _mapped(
        self, name: str, motion: DemonstratedMotion, first: int, past: int
    ) -> Iterator[tuple[str, DemonstratedMotion, int]]:
        """Yield a motion with the joints of a segment mapped again, unless every tenth sample already shows a fault."""
        before = motion.joints[max(first - 1, 0)]
        self._mapping.resume(before)
        for i in range(first, past, _STRIDE):
            if not self._check.allows(self._mapping.joints(motion.estimate(i), self._clutch)):
                return
        joints = motion.joints.copy()
        self._mapping.resume(before)
        for i in range(first, past):
            joints[i] = self._mapping.joints(motion.estimate(i), self._clutch)
        yield name, motion.with_joints(joints), past
