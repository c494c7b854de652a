"""Corrections of a demonstrated motion, segment by segment: the step that a teacher performs in baseline M1."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from imitarm.retarget.baselines.demonstrated_motion import ShownMotion
from imitarm.retarget.baselines.feasibility import ELBOW, Infeasible, blend, segments
from imitarm.retarget.baselines.joint_mapping import JointMapping
from imitarm.retarget.correspondence import Clutch

Array = NDArray[np.float64]

SPEED_LEFT = 0.9  # share of the velocity limits that a slowed segment uses
PULLED_TO = 0.78 / 0.80  # share of the reach to which the wrist is pulled in
TURNS = tuple(np.deg2rad((10.0, -10.0, 20.0, -20.0, 30.0, -30.0)))  # [rad] of the elbow about shoulder to wrist
KEYS, DRAWS = 5, 500  # key frames of a segment; samples drawn for one of them
_ABOUT_KEY = 0.2  # [s] on both sides of a key frame, from which its spread is taken
_LEAST_SPREAD = 0.1  # [rad] of each joint at a key frame: one demonstration tells little of what may vary
Mask = NDArray[np.bool_]

COUNTED = (
    "segments",
    "slowed",
    "pulled_in",
    "elbow_turned",
    "repaired",
    "missed_keys",
    "infeasible_before",
    "infeasible_after",
    "failures",
    "shown_time",
    "advised_time",
)
"""What is counted and added up over the holds of a recording."""
_GLANCE = 10  # samples between two that are looked at first
_SLOWEST = 10.0  # nobody advises to be slower than so many times


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


class Advice:
    """Corrects the motion of one hold on the robot (METHODS B, M1, steps 2 to 4).

    Args:
        mapping: of the person's joints, begun where the robot is.
        clutch: of this hold.
        infeasible: what must not be.
        rng: for the samples of a repair.

    Attributes:
        rounds: that were needed.
        counts: by the names of :data:`COUNTED`; times in s.
    """

    def __init__(self, mapping: JointMapping, clutch: Clutch, infeasible: Infeasible, rng: np.random.Generator) -> None:
        self._mapping, self._clutch, self._infeasible, self._rng = mapping, clutch, infeasible, rng
        self.rounds = 0
        self.counts: dict[str, float] = dict.fromkeys(COUNTED, 0.0)

    def corrected(self, motion: ShownMotion, rounds: int) -> ShownMotion:
        """Return the motion with the robot's joints, corrected as far as that goes.

        Args:
            motion: without joints.
            rounds: how many at most.
        """
        dt = self._infeasible.dt
        motion = motion.with_joints(np.array([self._mapping.joints(e, self._clutch) for e in motion.estimates()]))
        found = self._infeasible.anywhere(motion.joints)
        self.counts["shown_time"] += dt * len(motion)
        self.counts["infeasible_before"] += int(np.count_nonzero(found))
        while found.any() and self.rounds < rounds:
            self.rounds += 1
            for first, past in reversed(segments(found, dt)):  # from the end: slowing moves what comes after
                self.counts["segments"] += 1
                self.counts["advised_time"] += dt * (past - first)
                motion = self._advised(motion, first, past, blend(found, first, past, dt))
            found = self._infeasible.anywhere(motion.joints)
        self.counts["infeasible_after"] += int(np.count_nonzero(found))
        self.counts["failures"] += len(segments(found, dt))
        return motion

    def _advised(self, motion: ShownMotion, first: int, past: int, weight: Array) -> ShownMotion:
        """Return the motion with one segment changed by the first operator that clears it, else repaired."""
        for name, changed, end in self._proposals(motion, first, past, weight):
            if self._infeasible.clear(changed.joints[max(first - 1, 0) : end + 1]):
                self.counts[name] += 1
                return changed
        joints, missed = repaired(motion.joints, first, past, self._infeasible, self._rng)
        self.counts["repaired"] += 1
        self.counts["missed_keys"] += missed
        return motion.with_joints(joints)

    def _proposals(
        self, motion: ShownMotion, first: int, past: int, weight: Array
    ) -> Iterator[tuple[str, ShownMotion, int]]:
        """Give what may be advised, one after the other: name, changed motion, where the segment then ends."""
        window = motion.joints[first:past]
        factor = float(self._infeasible.speeds(window).max(initial=0.0)) / SPEED_LEFT
        if SPEED_LEFT * factor > 1.0 and factor <= _SLOWEST:
            yield "slowed", *slowed(motion, first, past, weight, factor)
        kappa = pull(motion.points[first:past], window)
        if kappa.min() < 1.0:
            points = pulled_in(motion.points[first:past], 1.0 + weight * (kappa - 1.0))
            yield from self._mapped("pulled_in", with_points(motion, first, past, points), first, past)
        for turn in TURNS:
            points = elbow_turned(motion.points[first:past], weight * turn)
            yield from self._mapped("elbow_turned", with_points(motion, first, past, points), first, past)

    def _mapped(self, name: str, motion: ShownMotion, first: int, past: int) -> Iterator[tuple[str, ShownMotion, int]]:
        """Give a motion with the joints of a segment mapped anew; not if a look at every tenth sample shows a fault."""
        before = motion.joints[max(first - 1, 0)]
        self._mapping.resume(before)
        for i in range(first, past, _GLANCE):
            if not self._infeasible.allows(self._mapping.joints(motion.estimate(i), self._clutch)):
                return
        joints = motion.joints.copy()
        self._mapping.resume(before)
        for i in range(first, past):
            joints[i] = self._mapping.joints(motion.estimate(i), self._clutch)
        yield name, motion.with_joints(joints), past
