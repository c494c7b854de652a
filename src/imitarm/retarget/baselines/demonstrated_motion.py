"""ShownMotion: what a person showed while holding the robot once, and the robot's joints for it, evenly sampled."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from imitarm.capture.skeleton import Skeleton
from imitarm.kinematics.pose import Pose, slerp
from imitarm.retarget.arm_estimator import ArmEstimate, ArmEstimator
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import Engagement, EngagementRule

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShownMotion:
    """One hold of a person on the robot, sampled at the control period.

    Attributes:
        clock: when the person did it [s], on the recording's clock, shape (n,); evenly spaced until it is slowed.
        points: shoulder, elbow, wrist in the base frame, shape (n, 3, 3) [m]; operators change them.
        hands: rotations of the hand, wxyz, shape (n, 4).
        shown: points as the person had them, shape (n, 3, 3) [m]; no operator changes them.
        closed: whether the hand was closed; None where not known.
        joints: of the robot, shape (n, n_joints) [rad]; without columns until they are mapped.
    """

    clock: Array
    points: Array
    hands: Array
    shown: Array
    closed: tuple[bool | None, ...]
    joints: Array

    @classmethod
    def through(cls, estimates: Sequence[ArmEstimate], dt: float) -> ShownMotion:
        """Interpolate the estimates of one hold, at least two, at every ``dt`` [s]; without overshoot."""
        times = np.array([e.time for e in estimates])
        clock = times[0] + dt * np.arange(int((times[-1] - times[0]) / dt + 1e-9) + 1)
        keys = np.array([(e.shoulder, e.elbow, e.wrist) for e in estimates])
        points = np.asarray(PchipInterpolator(times, keys)(np.clip(clock, times[0], times[-1])))
        hands = slerp(clock, times, np.array([e.hand for e in estimates]))
        last = np.searchsorted(times, clock + 1e-9, side="right") - 1
        closed = tuple(estimates[int(i)].closed for i in last)
        return cls(clock, points, hands, points, closed, np.empty((len(clock), 0)))

    def __len__(self) -> int:
        return len(self.clock)

    def estimate(self, i: int) -> ArmEstimate:
        """Return sample ``i`` as an estimate, as live methods are given it."""
        s, e, w = self.points[i]
        rest = np.zeros(3)
        return ArmEstimate(float(self.clock[i]), s, e, w, rest, self.hands[i], rest, (1.0, 1.0, 1.0), self.closed[i])

    def estimates(self) -> Iterator[ArmEstimate]:
        """Give all samples as estimates."""
        return map(self.estimate, range(len(self)))

    def at(self, where: Array) -> ShownMotion:
        """Return the motion read at fractional sample numbers, shape (m,): slower where they lie closer together."""
        n = np.arange(len(self))
        near = tuple(self.closed[int(i)] for i in np.clip(where.astype(int), 0, len(self) - 1))

        def read(columns: Array) -> Array:
            flat = columns.reshape(len(self), -1)
            values = [np.interp(where, n, column) for column in flat.T]
            return np.stack(values, axis=1).reshape(len(where), *columns.shape[1:])

        hands = slerp(where, n.astype(float), self.hands)
        clock = np.interp(where, n, self.clock)
        return ShownMotion(clock, read(self.points), hands, read(self.shown), near, read(self.joints))

    def with_joints(self, joints: Array) -> ShownMotion:
        """Return the motion with other joints, shape (n, n_joints) [rad]."""
        return replace(self, joints=joints)


def holds(
    frames: Iterable[Skeleton], correspondence: Correspondence, rule: EngagementRule
) -> Iterator[tuple[ArmEstimate, ...]]:
    """Yield for each engagement in a recording its estimates, at least two, by the rule that all methods share.

    Args:
        frames: in order of time.
        correspondence: between the person's arm and the robot's.
        rule: the times of the engagement.
    """
    estimator, engagement = ArmEstimator(correspondence), Engagement(correspondence, rule)
    held: list[ArmEstimate] = []
    last = -np.inf
    for frame in frames:
        estimate = estimator.update(frame)
        if estimate is None:
            continue
        engagement.update(None, estimate.time - last)  # the time for which the arm was not seen
        if engagement.clutch is None:
            if len(held) > 1:
                yield tuple(held)
            held = []
        last = estimate.time
        engagement.update(estimate, 0.0)
        if engagement.ready:
            engagement.engage(estimate.wrist, estimate.hand, Pose.identity())
        if engagement.clutch is not None:
            held.append(estimate)
    if len(held) > 1:
        yield tuple(held)
