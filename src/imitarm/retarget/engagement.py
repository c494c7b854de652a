"""Engagement: the state machine that decides when the robot follows a person; all methods use it."""

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
    """State of the engagement; each member equals its value, so ``state == "following"`` works.

    * ``WAITING``: the robot waits at rest until the camera has seen the person's arm for half a second.
    * ``FOLLOWING``: the camera sees the person's arm, and the tool follows the hand.
    * ``COASTING``: the camera has lost the arm for a short time; the motion of the hand is extrapolated.
    * ``HOLDING``: the camera has lost the arm for a longer time; the target of the tool stays at its last pose.
    * ``STOPPED``: the camera has lost the arm for too long, and the robot brakes. When the robot is at rest and the
      camera sees the arm again, the state becomes ``WAITING``.
    """

    WAITING = "waiting"
    FOLLOWING = "following"
    COASTING = "coasting"
    HOLDING = "holding"
    STOPPED = "stopped"

    @property
    def engaged(self) -> bool:
        """Whether the robot follows the person: true for ``FOLLOWING``, ``COASTING`` and ``HOLDING``."""
        return self in _ENGAGED


_ENGAGED = frozenset({EngagementState.FOLLOWING, EngagementState.COASTING, EngagementState.HOLDING})


def engaged_samples(states: ArrayLike) -> NDArray[np.bool_]:
    """Return whether the robot follows the person in each sample of a run, shape (n,).

    Args:
        states: states of the run, values of :class:`EngagementState`, shape (n,).
    """
    return np.isin(np.asarray(states, dtype=str), [state.value for state in _ENGAGED])


@dataclass(frozen=True)
class EngagementRule:
    """Times after which the state of the engagement changes, all in seconds.

    Attributes:
        seen_for: time for which the person's arm must be visible before the robot follows it.
        follow_until: FOLLOWING ends when the arm has not been seen for this time; shorter gaps between frames have no
            effect.
        coast_until: COASTING ends when the arm has not been seen for this time.
        hold_until: HOLDING ends when the arm has not been seen for this time; inf: HOLDING does not end.
    """

    seen_for: float = SEEN_FOR
    follow_until: float = 0.1
    coast_until: float = 0.1
    hold_until: float = 0.3


class Engagement:
    """Decides, in each control period, whether the robot follows the person.

    The state changes as follows:

    * From ``WAITING`` to ``FOLLOWING``: the camera has seen the arm for the time ``seen_for``, and :meth:`engage` is
      called.
    * From ``FOLLOWING`` to ``COASTING``, then ``HOLDING``, then ``STOPPED``: the camera does not see the arm.
    * From ``COASTING`` or ``HOLDING`` back to ``FOLLOWING``: the camera sees the arm again.
    * From ``STOPPED`` to ``WAITING``: the robot is at rest, and the camera sees the arm again.


    Args:
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        rule: times at which the state changes.

    Attributes:
        state: the current state.
        clutch: the poses of hand and tool when the robot began to follow the person; None while the robot follows no
            person.
        ready: whether the robot may begin to follow the person in this control period. If True, the caller calls
            :meth:`engage`.
        time_since_seen: time since the person's arm was last seen [s]; inf if it was never seen.
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
            estimate: estimate of the person's arm from a new frame; None: there is no new frame, or it does not show
                the arm.
            period: time since the last call [s].
            at_rest: whether the robot is at rest. If it is not, it can't begin to follow a person, but the time for
                which the arm has been visible counts.
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
        """Let the robot follow the person from now on; call this method when :attr:`ready` is true.

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
        """Return the state of a robot that follows a person, ``lost`` seconds after the person's arm was last seen."""
        rule = self._rule
        if lost <= rule.follow_until:
            return EngagementState.FOLLOWING
        if lost <= rule.coast_until:
            return EngagementState.COASTING
        return EngagementState.HOLDING if lost <= rule.hold_until else EngagementState.STOPPED
