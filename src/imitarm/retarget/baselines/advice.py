"""Advice: goes over a shown motion in rounds and changes what the arm can't do; stands in for the teacher of M1."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from imitarm.retarget.baselines.advice_operators import (
    SPEED_LEFT,
    TURNS,
    elbow_turned,
    pull,
    pulled_in,
    repaired,
    slowed,
    with_points,
)
from imitarm.retarget.baselines.infeasible import Infeasible, blend, segments
from imitarm.retarget.baselines.joint_mapping import JointMapping
from imitarm.retarget.baselines.shown_motion import ShownMotion
from imitarm.retarget.correspondence import Clutch

Array = NDArray[np.float64]
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
