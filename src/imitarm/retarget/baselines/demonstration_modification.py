"""DemonstrationModification: baseline M1, the person's joint angles, corrected where the arm can't follow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.baselines.baseline_retargeter import BaselineRetargeter
from imitarm.retarget.baselines.demonstrated_motion import DemonstratedMotion, engagements
from imitarm.retarget.baselines.feasibility import Constraint, FeasibilityCheck
from imitarm.retarget.baselines.joint_mapping import Approach, JointMapping
from imitarm.retarget.baselines.segment_correction import COUNTED, SegmentCorrector
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.engagement import EngagementState
from imitarm.retarget.retargeter import Goal, Retargeting, RetargetStep, in_order
from imitarm.scene import Scene
from imitarm.validation import finite_number, whole_number

Array = NDArray[np.float64]

ROUNDS = 5
ADVICE_TIME = 5.0  # [s] that a teacher needs for one segment, in addition to watching it


class DemonstrationModification(BaselineRetargeter):
    """Baseline M1: our reading of "demonstration modification" in the thesis.

    It combines Argall's advice operators, which derive corrected data from an execution and a teacher's advice on a
    segment of it, and Mueller et al. 2018, who annotate constraints and replace key frames that violate them. The paper
    cited by the thesis is about policies of a mobile robot; the possible corrections for an arm, and the program that
    replaces the teacher, are ours.

    The method is offline. :meth:`run` processes the whole recording:

    1. the person's joint angles, in closed form, become the robot's
       (:class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`);
    2. :class:`~imitarm.retarget.baselines.feasibility.FeasibilityCheck` finds the infeasible segments;
    3. each of them, extended by 0.2 s on both sides, is changed by the first correction that makes it feasible: slower,
       wrist closer, elbow rotated; otherwise its key frames are repaired
       (:mod:`imitarm.retarget.baselines.segment_correction`);
    4. steps 2 and 3 are repeated up to five times; what is infeasible after that is counted, and clipped to the joint
       ranges.

    :meth:`step` is only the mapping of step 1, clipped to the joint ranges, for live use.

    ``notes`` of a run has ``"rounds"``; ``"segments"`` corrected in all rounds, of which ``"slowed"``, ``"pulled_in"``,
    ``"elbow_rotated"`` and ``"repaired"``; ``"missed_keys"``, key frames without a feasible sample;
    ``"infeasible_before"`` and ``"infeasible_after"``, samples; ``"failures"``, segments that remain;
    ``"execution_time"`` and, without slowing and approach, ``"shown_time"`` of the motion [s]; ``"teaching_time"`` [s],
    the length of each segment plus 5 s, per round.

    Args:
        arm: the robot's arm with its tool.
        correspondence: between the person's arm and the robot's.
        dt: control period [s].
        scene: ignored.
        velocity_scaling: scale every step as a whole so that no joint exceeds its velocity limit.
        relative: map the change of the person's joint angles since the person began to lead; otherwise the angles
            themselves, approached at limited speed. See
            :class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`.
        constraints: additional conditions, by name, for example ``{"table": above(0.02)}``.
        advice_time: time that a teacher needs for each segment in addition to watching it [s].
        seed: of the samples that repair key frames.

    Attributes:
        check: finds what the arm can't do.

    Raises:
        InputError: when the arm does not have the joint axes of a person's arm, or a number is out of range.
    """

    name: ClassVar[str] = "m1"
    title: ClassVar[str] = "M1"
    caption: ClassVar[str] = (
        "Our reading of demonstration modification: the person's joint angles, corrected where the arm can't follow."
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
        advice_time: float = ADVICE_TIME,
        seed: int = 0,
    ) -> None:
        super().__init__(arm, correspondence, dt=dt, scene=scene, velocity_scaling=velocity_scaling)
        self._mapping = JointMapping(arm, relative=relative)
        self.check = FeasibilityCheck(arm, dt, constraints)
        self._advice_time = finite_number(advice_time, "DemonstrationModification: advice_time", "s", at_least=0.0)
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
        """Retarget a whole recording and correct it; ``notes`` says what was done.

        Where the motion is slowed, the result is longer than the recording; ``shown_times`` says when the person showed
        each sample. The targets are those of that time: slowed with the motion, but otherwise not corrected.

        Args:
            skeletons: in order of time.
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
        """Return the counts of a run, over all engagements."""
        counts = {name: sum(corrector.counts[name] for corrector in correctors) for name in COUNTED}
        watched = counts.pop("corrected_time")
        return {
            "rounds": float(max((corrector.rounds for corrector in correctors), default=0)),
            **counts,
            "execution_time": self.dt * performed,
            "teaching_time": watched + self._advice_time * counts["segments"],
        }

    def _append_shown_times(self, steps: list[RetargetStep], shown: Array) -> None:
        """Complete the shown times: the last steps show ``shown``, those before them are waiting."""
        rest = len(steps) - len(self._shown_times) - len(shown)
        begin = float(self._shown_times[-1]) if len(self._shown_times) else -self.dt
        waited = begin + self.dt * np.arange(1, rest + 1)
        ahead = float(shown[0]) if len(shown) else np.inf
        self._shown_times = np.concatenate([self._shown_times, np.minimum(waited, ahead), shown])

    def _rest(self, steps: list[RetargetStep], duration: float, state: EngagementState) -> None:
        """Stand still for a while, at the end or between two engagements."""
        q = self.latest.q
        for _ in range(round(duration / self.dt)):
            self._append(steps, RetargetStep(0.0, q, q, None, state), q)

    def _perform(self, steps: list[RetargetStep], motion: DemonstratedMotion, clutch: Clutch) -> None:
        """Move to where the motion begins, at limited speed, then through it."""
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
        """Append a step towards joints (n_joints,) [rad], as far as the limits allow."""
        before, q = self.latest, self._limited(wanted)
        velocity = (q - before.q) / self.dt
        self.latest = replace(step, time=before.time + self.dt, q=q, velocity=velocity)
        steps.append(self.latest)
