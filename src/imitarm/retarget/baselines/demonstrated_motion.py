"""DemonstratedMotion: the person's arm during one engagement, and the robot's joints for it, evenly sampled."""

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
class DemonstratedMotion:
    """The motion of one engagement, sampled at the control period.

    Attributes:
        shown_times: when the person showed each sample [s], on the recording's clock, shape (n,); evenly spaced until
            the motion is slowed down.
        points: shoulder, elbow, wrist in the base frame, as corrected so far, shape (n, 3, 3) [m].
        hands: rotations of the hand, quaternions wxyz, shape (n, 4).
        shown: points as the person had them, shape (n, 3, 3) [m]; never corrected.
        closed: whether the hand was closed; None where unknown.
        joints: of the robot, shape (n, n_joints) [rad]; without columns until they are mapped.
    """

    shown_times: Array
    points: Array
    hands: Array
    shown: Array
    closed: tuple[bool | None, ...]
    joints: Array

    @classmethod
    def through(cls, estimates: Sequence[ArmEstimate], dt: float) -> DemonstratedMotion:
        """Interpolate the estimates of one engagement, at least two, at every ``dt`` [s], without overshoot."""
        times = np.array([e.time for e in estimates])
        shown_times = times[0] + dt * np.arange(int((times[-1] - times[0]) / dt + 1e-9) + 1)
        keys = np.array([(e.shoulder, e.elbow, e.wrist) for e in estimates])
        points = np.asarray(PchipInterpolator(times, keys)(np.clip(shown_times, times[0], times[-1])))
        hands = slerp(shown_times, times, np.array([e.hand for e in estimates]))
        last = np.searchsorted(times, shown_times + 1e-9, side="right") - 1
        closed = tuple(estimates[int(i)].closed for i in last)
        return cls(shown_times, points, hands, points, closed, np.empty((len(shown_times), 0)))

    def __len__(self) -> int:
        return len(self.shown_times)

    def estimate(self, i: int) -> ArmEstimate:
        """Return sample ``i`` as an estimate, as live methods receive it."""
        s, e, w = self.points[i]
        rest = np.zeros(3)
        return ArmEstimate(
            float(self.shown_times[i]), s, e, w, rest, self.hands[i], rest, (1.0, 1.0, 1.0), self.closed[i]
        )

    def estimates(self) -> Iterator[ArmEstimate]:
        """Yield all samples as estimates."""
        return map(self.estimate, range(len(self)))

    def at(self, where: Array) -> DemonstratedMotion:
        """Return the motion at fractional sample numbers, shape (m,): slower where they are closer together."""
        n = np.arange(len(self))
        near = tuple(self.closed[int(i)] for i in np.clip(where.astype(int), 0, len(self) - 1))

        def read(columns: Array) -> Array:
            flat = columns.reshape(len(self), -1)
            values = [np.interp(where, n, column) for column in flat.T]
            return np.stack(values, axis=1).reshape(len(where), *columns.shape[1:])

        hands = slerp(where, n.astype(float), self.hands)
        shown_times = np.interp(where, n, self.shown_times)
        return DemonstratedMotion(shown_times, read(self.points), hands, read(self.shown), near, read(self.joints))

    def with_joints(self, joints: Array) -> DemonstratedMotion:
        """Return the motion with other joints, shape (n, n_joints) [rad]."""
        return replace(self, joints=joints)


def engagements(
    frames: Iterable[Skeleton], correspondence: Correspondence, rule: EngagementRule
) -> Iterator[tuple[ArmEstimate, ...]]:
    """Yield for each engagement in a recording its estimates, at least two, by the rule that all methods share.

    Args:
        frames: in order of time.
        correspondence: between the person's arm and the robot's.
        rule: the times of the engagement.
    """
    estimator, engagement = ArmEstimator(correspondence), Engagement(correspondence, rule)
    collected: list[ArmEstimate] = []
    last = -np.inf
    for frame in frames:
        estimate = estimator.update(frame)
        if estimate is None:
            continue
        engagement.update(None, estimate.time - last)  # the time for which the arm was not seen
        if engagement.clutch is None:
            if len(collected) > 1:
                yield tuple(collected)
            collected = []
        last = estimate.time
        engagement.update(estimate, 0.0)
        if engagement.ready:
            engagement.engage(estimate.wrist, estimate.hand, Pose.identity())
        if engagement.clutch is not None:
            collected.append(estimate)
    if len(collected) > 1:
        yield tuple(collected)
