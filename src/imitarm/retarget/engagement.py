"""Engagement: the state machine that decides when a person leads the robot; all methods use the same one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.pose import Pose
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Clutch, Correspondence

Array = NDArray[np.float64]

SEEN_FOR = 0.5  # [s] the arm must be seen without a gap before the robot follows it
LONGEST_GAP = 0.1  # [s] between two estimates; a longer gap restarts that count


class EngagementState(StrEnum):
    """State of the engagement. A member equals its value, so ``state == "following"`` works.

    * ``WAITING``: the arm is at rest until a person has been seen for half a second.
    * ``FOLLOWING``: the person is seen and leads the tool.
    * ``COASTING``: the person has just been lost; the motion is extrapolated.
    * ``HOLDING``: the person has been lost for longer; the last target is held.
    * ``STOPPED``: the person has been lost for too long. The robot brakes, and stays stopped until it is at rest and
      the person is seen again.
    """

    WAITING = "waiting"
    FOLLOWING = "following"
    COASTING = "coasting"
    HOLDING = "holding"
    STOPPED = "stopped"

    @property
    def engaged(self) -> bool:
        """Whether the person leads the tool, including short losses of tracking."""
        return self in _ENGAGED


_ENGAGED = frozenset({EngagementState.FOLLOWING, EngagementState.COASTING, EngagementState.HOLDING})


def engaged_samples(states: ArrayLike) -> NDArray[np.bool_]:
    """Return whether the person leads the tool in each sample of a run, shape (n,).

    Args:
        states: states of the run, values of :class:`EngagementState`, shape (n,).
    """
    return np.isin(np.asarray(states, dtype=str), [state.value for state in _ENGAGED])


@dataclass(frozen=True)
class EngagementRule:
    """Times of the state machine, all in seconds.

    Attributes:
        seen_for: time for which the arm must be visible before the robot follows it.
        follow_until: longest time since the arm was last seen at which the state is still FOLLOWING (cameras drop
            frames).
        coast_until: the same for COASTING.
        hold_until: the same for HOLDING; inf: the robot never stops.
    """

    seen_for: float = SEEN_FOR
    follow_until: float = 0.1
    coast_until: float = 0.1
    hold_until: float = 0.3


class Engagement:
    """Decides, one control period at a time, whether a person leads the robot.

    ::

        WAITING --(seen for 0.5 s)--> FOLLOWING --(lost)--> COASTING --> HOLDING --> STOPPED --> WAITING
                                          ^                    |            |
                                          +------(seen again)--+------------+

    Args:
        correspondence: correspondence between the person's arm and the robot's.
        rule: the times of the transitions.

    Attributes:
        state: the current state.
        clutch: the poses of hand and tool when the person began to lead; None while nobody leads.
        ready: whether the person may begin to lead in this control period; the caller then calls :meth:`engage`.
        time_since_seen: time since the arm was last seen [s]; inf before it was ever seen.
    """

    def __init__(self, correspondence: Correspondence, rule: EngagementRule | None = None) -> None:
        self._correspondence = correspondence
        self._rule = EngagementRule() if rule is None else rule
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self.state = EngagementState.WAITING
        self.clutch: Clutch | None = None
        self.ready = False
        self.time_since_seen = math.inf
        self._first_seen = self._last_seen = math.inf

    def update(self, estimate: ArmEstimate | None, period: float, *, at_rest: bool = True) -> EngagementState:
        """Advance by one control period and return the new state.

        Args:
            estimate: estimate of the person's arm from a new frame; None: there was no frame, or it does not show the
                arm.
            period: time since the last call [s].
            at_rest: whether the robot is at rest: only then can a person begin to lead it. The time for which the
                person has been seen is counted in any case.
        """
        self.time_since_seen = self.time_since_seen + period if estimate is None else 0.0
        self.ready = False
        if self.clutch is not None:
            self.state = self._after(self.time_since_seen)
            if self.state is EngagementState.STOPPED:
                self.clutch, self._first_seen = None, math.inf
                self._last_seen = math.inf
            return self.state
        if estimate is None:
            return self.state
        if not 0.0 <= estimate.time - self._last_seen <= LONGEST_GAP:
            self._first_seen = estimate.time
        self._last_seen = estimate.time
        if at_rest:
            self.state = EngagementState.WAITING
            self.ready = estimate.time - self._first_seen >= self._rule.seen_for
        return self.state

    def engage(self, wrist: ArrayLike, hand: Array, tool_to_base: Pose) -> Clutch:
        """Let the person lead from now on; call this method when :attr:`ready` is true.

        Args:
            wrist: position of the person's wrist in the base frame, shape (3,) [m].
            hand: rotation of the hand in the base frame, quaternion wxyz, shape (4,).
            tool_to_base: pose of the robot's tool in the base frame.
        """
        self.ready, self.state = False, EngagementState.FOLLOWING
        self.clutch = self._correspondence.engage(wrist, hand, tool_to_base)
        return self.clutch

    def shift(self, displacement: Array) -> None:
        """Shift the target of the tool by ``displacement``, shape (3,) [m], from now on."""
        if self.clutch is not None:
            home = self.clutch.home
            home = Pose.trusted(home.position + displacement, home.quaternion)
            self.clutch = replace(self.clutch, home=home)

    def _after(self, lost: float) -> EngagementState:
        """Return the state of an engaged robot ``lost`` seconds after the arm was last seen."""
        rule = self._rule
        if lost <= rule.follow_until:
            return EngagementState.FOLLOWING
        if lost <= rule.coast_until:
            return EngagementState.COASTING
        return EngagementState.HOLDING if lost <= rule.hold_until else EngagementState.STOPPED
