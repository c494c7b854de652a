"""DemonstrationModification: baseline M1, which maps joint angles and corrects segments that the robot can't execute.

There are four corrections: slow the motion down, move the wrist closer to the shoulder, rotate the elbow, or repair key
frames. Each correction changes one segment of a
:class:`~imitarm.retarget.baselines.demonstrated_motion.DemonstratedMotion`. Its weight is 1 at the infeasible samples
and falls to 0 at the ends of the segment, so that the motion stays continuous.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from imitarm.capture.skeleton import Skeleton
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.baselines.baseline_retargeter import BaselineRetargeter
from imitarm.retarget.baselines.demonstrated_motion import (
    ELBOW,
    Constraint,
    DemonstratedMotion,
    FeasibilityCheck,
    blend,
    engagements,
    segments,
)
from imitarm.retarget.baselines.joint_mapping import Approach, JointMapping
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.engagement import EngagementState
from imitarm.retarget.retargeter import Goal, Retargeting, RetargetStep, in_order
from imitarm.scene import Scene
from imitarm.validation import finite_number, whole_number

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 5
ANNOTATION_TIME = 5.0  # [s] that a teacher needs for one segment, in addition to watching it

SLOWED_TO = 0.9  # of the velocity limits: highest speed of a slowed segment
PULLED_TO = 0.78 / 0.80  # of the reach: largest distance of the wrist after the correction
# [rad] about the line from shoulder to wrist
ELBOW_ROTATIONS = tuple(np.deg2rad((10.0, -10.0, 20.0, -20.0, 30.0, -30.0)))
KEYS, DRAWS = 5, 500  # key frames per segment; samples drawn per key frame
_ABOUT_KEY = 0.2  # [s] on both sides of a key frame: samples that determine its covariance
_LEAST_SPREAD = 0.1  # [rad] smallest standard deviation of a joint: one demonstration shows little variation

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
"""Names of the counts, which are summed over all engagements of a recording."""

_STRIDE = 10  # every tenth sample is checked first
_SLOWEST = 10.0  # largest factor of slowing down


class DemonstrationModification(BaselineRetargeter):
    """Baseline M1: our interpretation of "demonstration modification" in the thesis.

    The method combines two published ideas. In the work of Argall, a teacher selects an "advice operator", which
    corrects one segment of an executed motion. In the work of Mueller et al. 2018, a teacher annotates constraints, and
    key frames that violate a constraint are replaced. Argall's operators are for a mobile robot, so we designed
    corrections for an arm. Here, a program selects the correction instead of a teacher.

    The method is offline. :meth:`run` processes the whole recording in four steps:

    1. the person's joint angles are computed and mapped to the robot's joints
       (:class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`);
    2. :class:`~imitarm.retarget.baselines.demonstrated_motion.FeasibilityCheck` finds the samples that the robot can't
       execute (infeasible samples) and groups them into segments;
    3. each segment is slowed down, its wrist is moved closer, or its elbow is rotated: the first correction that makes
       the segment feasible is used; if none does, the key frames of the segment are repaired
       (:class:`SegmentCorrector`);
    4. steps 2 and 3 are repeated up to five times; samples that remain infeasible are counted and clipped to the
       joint ranges.

    For live use, :meth:`step` performs only the mapping of step 1, and clips the result to the joint ranges.

    After a run, ``notes`` contains:

    * ``"rounds"``: number of rounds of corrections;
    * ``"segments"``: number of corrected segments in all rounds; ``"slowed"``, ``"pulled_in"``, ``"elbow_rotated"`` and
      ``"repaired"``: number of segments changed by each correction;
    * ``"missed_keys"``: number of key frames for which no feasible posture was found;
    * ``"infeasible_before"`` and ``"infeasible_after"``: number of infeasible samples before and after the corrections;
    * ``"failures"``: number of segments that remain infeasible;
    * ``"execution_time"``: duration of the robot's motion [s]; ``"shown_time"``: duration of the person's motion [s];
    * ``"teaching_time"``: assumed working time of a teacher [s]: the sum, over all corrected segments, of the duration
      of the segment and ``annotation_time``.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: ignored.
        velocity_scaling: whether to scale down all joints together in every step, so that no joint exceeds its velocity
            limit.
        relative: True: changes of the person's joint angles since the robot began to follow are added to the robot's
            joint positions. False: the angles themselves are mapped, and the robot first moves to the result at limited
            speed. See :class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`.
        constraints: additional conditions for the tool by their names, for example ``{"table": above(0.02)}``; None: no
            additional conditions.
        annotation_time: assumed time that a teacher needs to annotate a segment after watching it [s].
        seed: seed of the random postures that are tried in the repair of key frames.

    Attributes:
        check: feasibility check that finds the infeasible samples.

    Raises:
        InputError: when the arm does not have the joint axes of a person's arm, or a number is out of range.
    """

    name: ClassVar[str] = "m1"
    title: ClassVar[str] = "M1"
    caption: ClassVar[str] = (
        "Our interpretation of demonstration modification: human joint angles, corrected where the arm can't follow."
    )

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        velocity_scaling: bool = False,
        relative: bool = True,
        constraints: Mapping[str, Constraint] | None = None,
        annotation_time: float = ANNOTATION_TIME,
        seed: int = 0,
    ) -> None:
        super().__init__(arm, correspondence, dt=dt, scene=scene, velocity_scaling=velocity_scaling)
        self._mapping = JointMapping(arm, relative=relative)
        self.check = FeasibilityCheck(arm, dt, constraints)
        what = "DemonstrationModification: annotation_time"
        self._annotation_time = finite_number(annotation_time, what, "s", at_least=0.0)
        self._seed = whole_number(seed, "DemonstrationModification: seed", at_least=0)
        self._shown_times = np.empty(0)

    def _rest_at(self, q: Array) -> None:
        self._mapping.start(q)
        self._approach = Approach(self.arm, self.dt)
        self._joint_goal, self._left = q, 0

    def _wanted(self, goal: Goal) -> Array:
        q = self.latest.q
        if goal.fresh:
            self._joint_goal = self._mapping.joints(goal.estimate, goal.clutch)
            self._left = self._steps_per_frame
        if self._approach.active:
            return self._approach.towards(q, self._joint_goal)
        if self._left <= 0:
            return q
        step = (self._joint_goal - q) / self._left
        self._left -= 1
        return np.asarray(q + step)

    def run(self, skeletons: Iterable[Skeleton], q: ArrayLike | None = None) -> Retargeting:
        """Retarget a whole recording and correct the motion; ``notes`` counts the changes.

        If the motion is slowed down, the result is longer than the recording. Its ``shown_times`` contain the time at
        which the person showed each sample. The targets of the tool are then slowed down, too. The other corrections do
        not change the targets.

        Args:
            skeletons: skeletons in order of time.
            q: start posture, shape (n_joints,) [rad]; None: ``arm.home``.

        Raises:
            InputError: when there are fewer than two skeletons, or times do not increase.
        """
        frames = in_order(skeletons)
        self.start(self.arm.home if q is None else q)
        rng = np.random.default_rng(self._seed)
        steps, now = [self.latest], frames[0].time
        self._shown_times = np.empty(0)
        correctors: list[SegmentCorrector] = []
        performed = 0
        state = EngagementState.WAITING
        for estimates in engagements(frames, self.correspondence, self.rule):
            first, last = estimates[0], estimates[-1]
            self._rest(steps, first.time - now, state)
            q = self.latest.q
            clutch = self.correspondence.engage(first.wrist, first.hand, self.arm.tool_pose(q))
            self._mapping.start(q)
            correctors.append(SegmentCorrector(self._mapping, clutch, self.check, rng))
            motion = correctors[-1].corrected(DemonstratedMotion.through(estimates, self.dt), ROUNDS)
            performed -= len(steps)
            self._perform(steps, motion, clutch)
            performed += len(steps)
            self._append_shown_times(steps, motion.shown_times - frames[0].time)
            now, state = last.time, EngagementState.STOPPED
        self._rest(steps, frames[-1].time - now, state)
        self._append_shown_times(steps, np.empty(0))
        return Retargeting.of(self, steps, {**self.notes, **self._notes_of(correctors, performed)}, self._shown_times)

    def _notes_of(self, correctors: Sequence[SegmentCorrector], performed: int) -> dict[str, float]:
        """Return the counts of a run, summed over all engagements."""
        counts = {name: sum(corrector.counts[name] for corrector in correctors) for name in COUNTED}
        watched = counts.pop("corrected_time")
        return {
            "rounds": float(max((corrector.rounds for corrector in correctors), default=0)),
            **counts,
            "execution_time": self.dt * performed,
            "teaching_time": watched + self._annotation_time * counts["segments"],
        }

    def _append_shown_times(self, steps: list[RetargetStep], shown: Array) -> None:
        """Extend ``shown_times`` by the times at which the person showed the newest steps.

        ``shown`` contains the times of a motion. The robot waits before the motion; the times of the waiting steps are
        ``dt`` apart, but a time that would be later than the first time in ``shown`` is replaced by that first time.
        """
        rest = len(steps) - len(self._shown_times) - len(shown)
        begin = float(self._shown_times[-1]) if len(self._shown_times) else -self.dt
        waited = begin + self.dt * np.arange(1, rest + 1)
        ahead = float(shown[0]) if len(shown) else np.inf
        self._shown_times = np.concatenate([self._shown_times, np.minimum(waited, ahead), shown])

    def _rest(self, steps: list[RetargetStep], duration: float, state: EngagementState) -> None:
        """Append steps in which the robot is at rest for ``duration`` [s]."""
        q = self.latest.q
        for _ in range(round(duration / self.dt)):
            self._append(steps, RetargetStep(0.0, q, q, None, state), q)

    def _perform(self, steps: list[RetargetStep], motion: DemonstratedMotion, clutch: Clutch) -> None:
        """Append the steps that move the robot to the motion's start at limited speed, and then along the motion."""
        approach = Approach(self.arm, self.dt)
        start = np.clip(motion.joints[0], self.arm.lower, self.arm.upper)
        at = self.latest.q
        path: list[tuple[int, Array]] = []
        while (at != start).any():
            at = approach.towards(at, start)
            path.append((0, at))
        for i, q in (*path, *enumerate(motion.joints)):
            shoulder, elbow, wrist = motion.shown[i]
            upper = (elbow - shoulder) / max(float(np.linalg.norm(elbow - shoulder)), 1e-9)
            target = clutch.target(wrist, motion.hands[i])
            done = RetargetStep(0.0, q, q, motion.closed[i], EngagementState.FOLLOWING, target, upper)
            self._append(steps, done, q)

    def _append(self, steps: list[RetargetStep], step: RetargetStep, wanted: Array) -> None:
        """Append a step towards the joint positions ``wanted`` (n_joints,) [rad], as far as the limits allow."""
        before, q = self.latest, self._limited(wanted)
        velocity = (q - before.q) / self.dt
        self.latest = replace(step, time=before.time + self.dt, q=q, velocity=velocity)
        steps.append(self.latest)


def slowed(
    motion: DemonstratedMotion, first: int, past: int, weight: Array, factor: float
) -> tuple[DemonstratedMotion, int]:
    r"""Slow down a segment of a motion: the time for each sample becomes :math:`1 + w\,(s - 1)` times as long.

    Args:
        motion: motion with joint positions of the robot.
        first: first sample of the segment.
        past: index of the sample after the segment.
        weight: weight w of each sample, shape (past - first,).
        factor: factor s of the time, at least 1.

    Returns:
        The slower motion, and the new index of the sample after the segment.
    """
    stretch = np.ones(len(motion))
    stretch[first:past] += weight * (factor - 1.0)
    passed = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]))])  # in periods, for each sample
    where = np.interp(np.arange(np.ceil(passed[-1]) + 1), passed, np.arange(len(motion)))
    last = past + round(passed[-1] - (len(motion) - 1))
    return motion.at(where), min(last, len(where))


def pull(points: Array, joints: Array) -> Array:
    r"""Return the factor :math:`\kappa` by which the person's wrist must move closer to the shoulder, shape (n,).

    The function computes by how much the robot's elbow must bend further, until
    :func:`~imitarm.retarget.baselines.demonstrated_motion.stretch` is at most 78/80. With the factor :math:`\kappa`,
    the person's elbow bends by the same angle. In a relative mapping, the elbow angles of robot and person can differ.
    If they are equal, :math:`\kappa = \frac{78}{80} L / |W - S|`, where W is the wrist, S the shoulder and L the length
    of the straight arm.

    Args:
        points: shoulder, elbow, wrist, shape (n, 3, 3) [m].
        joints: joint positions of the robot, shape (n, n_joints) [rad].
    """
    s, e, w = np.moveaxis(points, 1, 0)
    upper, fore, reach = _length(e - s), _length(w - e), _length(w - s)
    lacking = np.maximum(2.0 * np.arccos(PULLED_TO) - np.abs(joints[:, ELBOW]), 0.0)
    cosine = (reach**2 - upper**2 - fore**2) / (2.0 * upper * fore)
    bend = np.arccos(np.clip(cosine, -1.0, 1.0)) + lacking
    near = np.sqrt(upper**2 + fore**2 + 2.0 * upper * fore * np.cos(np.minimum(bend, np.pi)))
    return np.where(lacking > 0.0, np.minimum(near / np.maximum(reach, 1e-9), 1.0), 1.0)


def pulled_in(points: Array, kappa: Array) -> Array:
    r"""Move the wrist to :math:`W' = S + \kappa (W - S)`, where S is the shoulder and W the wrist.

    Args:
        points: shoulder, elbow, wrist, shape (n, 3, 3) [m].
        kappa: factor :math:`\kappa` of each sample, at most 1, shape (n,).

    Returns:
        The changed points, shape (n, 3, 3) [m]; the bones keep their lengths.
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
        angle: angle of rotation of each sample, shape (n,) [rad].

    Returns:
        The changed points, shape (n, 3, 3) [m]; the bones keep their lengths.
    """
    s, e, w = np.moveaxis(points, 1, 0)
    axis = (w - s) / np.maximum(_length(w - s), 1e-9)[:, None]
    c, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    out = e - s
    rotated = c * out + sine * np.cross(axis, out) + (1.0 - c) * axis * np.sum(axis * out, axis=1, keepdims=True)
    return np.stack([s, s + rotated, w], axis=1)


def with_points(motion: DemonstratedMotion, first: int, past: int, points: Array) -> DemonstratedMotion:
    """Return the motion with new points (past - first, 3, 3) [m] in a segment, and with its old joint positions."""
    changed = motion.points.copy()
    changed[first:past] = points
    return replace(motion, points=changed)


def repaired(
    joints: Array, first: int, past: int, check: FeasibilityCheck, rng: np.random.Generator
) -> tuple[Array, int]:
    r"""Repair the key frames of a segment (after Mueller et al. 2018), and interpolate between them by a cubic spline.

    A segment has five key frames. Feasible key frames are kept. For an infeasible key frame with the joint positions
    :math:`\mu_k`, random postures are drawn from the normal distribution :math:`N(\mu_k, \Sigma_k)`, until one is
    feasible. The covariance :math:`\Sigma_k` is that of the joint positions up to 0.2 s before and after the key frame,
    plus :math:`(0.1\,\mathrm{rad})^2 I`. If 500 postures are infeasible, the key frame becomes :math:`\mu_k`, clipped
    to the joint ranges.

    Args:
        joints: joint positions of the whole motion, shape (n, n_joints) [rad].
        first: first sample of the segment.
        past: index of the sample after the segment.
        check: check whether a posture is feasible.
        rng: random number generator for the postures.

    Returns:
        Joint positions, shape (n, n_joints) [rad], unchanged outside the segment; and the number of key frames for
        which no feasible posture was found.
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
    """Corrects the motion of one engagement in several rounds (baseline M1).

    Args:
        mapping: mapping from the person's joint angles to the robot's joints, started at the robot's current posture.
        clutch: the poses of hand and tool when the robot began to follow the person.
        check: feasibility check that finds the infeasible samples.
        rng: random number generator for the repair of key frames.

    Attributes:
        rounds: number of rounds of corrections so far.
        counts: counts and times [s], by the names in :data:`COUNTED`.
    """

    def __init__(
        self, mapping: JointMapping, clutch: Clutch, check: FeasibilityCheck, rng: np.random.Generator
    ) -> None:
        self._mapping, self._clutch, self._check, self._rng = mapping, clutch, check, rng
        self.rounds = 0
        self.counts: dict[str, float] = dict.fromkeys(COUNTED, 0.0)

    def corrected(self, motion: DemonstratedMotion, rounds: int) -> DemonstratedMotion:
        """Map the motion to the robot's joints, correct it as far as possible, and return it.

        Args:
            motion: motion of the person, without joint positions of the robot.
            rounds: largest number of rounds of corrections.
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
        """Return the motion after the first correction that makes a segment feasible, or else after a repair."""
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
        """Yield the possible corrections in order; each has a name, the changed motion, and the segment's new end."""
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
        """Map the joints of a segment again; yield the motion only if every tenth sample of the segment is feasible."""
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
