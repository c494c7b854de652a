"""RivalRetargeter: what the methods that ours is compared with have in common, so that none wins by plumbing."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.arm_estimator import ArmEstimate, ArmEstimator
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.engagement import Engagement
from imitarm.retarget.retargeter import Command, Retargeter
from imitarm.scene import Scene

Array = NDArray[np.float64]

SHOWN, HOLD = 0.1, 0.3  # [s] without a sight of the arm: until then it is followed; until then the hold is kept
FRAME = 1.0 / 30.0  # [s] between two frames, where they do not tell
_LONGEST_FRAME = 0.1  # [s]
_PUSHED = 0.05  # [rad] an arm found farther than this from its command was moved by somebody
_ROUNDING = 1.0 + 1e-9


class RivalRetargeter(Retargeter):
    """A method to compare with, behind the same front end (METHODS B).

    All have the estimate of the arm with its true limbs and One-Euro filters, the rule by which a person takes hold,
    the clutch and the scale of :class:`~imitarm.retarget.correspondence.Correspondence`. What such a method has no word
    on is the same for all: without a sight of the arm for 0.1 s the robot is held, after 0.3 s the hold is lost and
    must be taken anew; no joint ever passes a limit of position. Limits of velocity can be broken where the
    method itself does not keep them; how often is counted in ``notes``.

    Args:
        arm: the robot's arm with its tool.
        correspondence: what of the person's arm stands for what of the robot's.
        dt: control period [s].
        scene: not heeded.
        velocity_scaling: scale every step as a whole so that no joint exceeds its velocity limit.

    Attributes:
        counts: since :meth:`start`, by name; see ``notes``.
    """

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        velocity_scaling: bool = False,
    ) -> None:
        self.velocity_scaling = velocity_scaling
        super().__init__(arm, correspondence, dt=dt, scene=scene)

    def _begin(self, q: Array) -> None:
        self._q = q.copy()
        self._silence = math.inf
        self._held = False  # whether the person had taken hold since the last stop
        self._estimate: ArmEstimate | None = None
        self._period = FRAME
        self._estimator = ArmEstimator(self.correspondence)
        self._engagement = Engagement(self.correspondence)
        self.counts: Counter[str] = Counter()
        self._restart(q)

    @abstractmethod
    def _restart(self, q: Array) -> None:
        """Forget the person; the arm is at rest at ``q``, shape (n_joints,) [rad]."""

    @abstractmethod
    def _engaged(self, estimate: ArmEstimate, clutch: Clutch) -> None:
        """The person has just taken hold."""

    @abstractmethod
    def _advance(self, estimate: ArmEstimate | None, clutch: Clutch) -> Array:
        """Return the joints wanted at the end of this control period, shape (n_joints,) [rad].

        Args:
            estimate: of a new frame; None: none came in.
            clutch: engaged.
        """

    def _hold(self) -> Array:
        """Return the joints of an arm that is not led, shape (n_joints,) [rad]."""
        return self._q

    def step(self, skeleton: Skeleton | None, q: ArrayLike) -> Array:
        """Return the joint positions to be at after ``dt``; see :class:`~imitarm.retarget.retargeter.Retargeter`."""
        fresh = self._look(skeleton)
        state = self._state(fresh, np.asarray(q, dtype=float))
        clutch, estimate = self._engagement.clutch, self._estimate
        target = closed = elbow = None
        if clutch is not None and estimate is not None:
            target, elbow, closed = clutch.target(estimate.wrist, estimate.hand), estimate.upper_arm, estimate.closed
        wanted = self._hold() if state != "following" or clutch is None else self._advance(fresh, clutch)
        before, self._q = self._q, self._limited(wanted)
        velocity = (self._q - before) / self.dt
        self.command = Command(self.command.time + self.dt, self._q, velocity, closed, state, target, elbow)
        return self._q

    @property
    def notes(self) -> dict[str, float]:
        """What there is to count so far, by name.

        ``"velocity_excess"``: joints and steps that were, or without scaling would have been, too fast;
        ``"position_clips"``: joints and steps that were cut at a limit of position.
        """
        return {name: float(self.counts[name]) for name in ("velocity_excess", "position_clips", *self.counts)}

    @property
    def _steps(self) -> int:
        """In how many control steps the next frame is to be expected, rounded up, so that no step stands still."""
        return max(math.ceil(self._period / self.dt - 1e-6), 1)

    def _look(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        """Take in a skeleton; return what is new, and count the time in which none showed the arm."""
        self._silence += self.dt
        estimate = None if skeleton is None else self._estimator.update(skeleton)
        if estimate is not None:
            if self._estimate is not None:
                self._period = min(max(estimate.time - self._estimate.time, self.dt), _LONGEST_FRAME)
            self._estimate, self._silence = estimate, 0.0
        return estimate

    def _state(self, fresh: ArmEstimate | None, q: Array) -> str:
        """Return what to do now; engage or let go."""
        if self._engagement.clutch is not None:
            if self._silence <= HOLD:
                return "following" if self._silence <= SHOWN else "holding"
            self._engagement.release()
            self._restart(self._q)
            self._held = True
        if self._held and self._silence > HOLD:
            return "stopped"
        self._held = False
        if np.isfinite(q).all() and np.abs(q - self._q).max() > _PUSHED:  # somebody has moved the arm: begin there
            self._q = np.clip(q, self.arm.lower, self.arm.upper)
            self._restart(self._q)
        clutch = self._engagement.update(fresh, self.arm.tool_pose(self._q))
        if clutch is None or fresh is None:
            return "waiting"
        self._engaged(fresh, clutch)
        return "following"

    def _limited(self, wanted: Array) -> Array:
        """Return the joints that are reached: positions kept always, velocities by scaling where it is asked for."""
        step = wanted - self._q
        shares = np.abs(step) / (self.dt * self.arm.max_velocity)
        self.counts["velocity_excess"] += int(np.count_nonzero(shares > _ROUNDING))
        if self.velocity_scaling:
            step = step / max(float(shares.max()), 1.0)
        reached = self._q + step
        kept = np.minimum(np.maximum(reached, self.arm.lower), self.arm.upper)
        self.counts["position_clips"] += int(np.count_nonzero(kept != reached))
        return kept
