"""BaselineRetargeter: base class of the baselines M1 to M3, which differ only in the mapping from person to robot."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import EngagementState
from imitarm.retarget.retargeter import Goal, Retargeter
from imitarm.scene import Scene
from imitarm.validation import flag

Array = NDArray[np.float64]

FRAME_PERIOD = 1.0 / 30.0  # [s] assumed until two frames have been seen
_LONGEST_PERIOD = 0.1  # [s]
_ROUNDING = 1.0 + 1e-9


class BaselineRetargeter(Retargeter):
    """Base class of the baselines, with the same processing of the input as all other methods.

    :class:`~imitarm.retarget.retargeter.Retargeter` estimates the person's arm, and decides when the robot follows the
    person. This class also decides two points that the publications of the baselines leave open. While the camera does
    not see the person, the robot holds its position. Joint positions are clipped to the ranges of the joints. A
    baseline may exceed velocity limits; ``notes`` counts how often.

    A subclass implements ``_wanted``.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: ignored.
        velocity_scaling: whether to scale down all joints together in every step, so that no joint exceeds its velocity
            limit.

    Attributes:
        counts: counts since :meth:`start`, by their names; see :attr:`notes`.
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
        super().__init__(arm, correspondence, dt=dt, scene=scene)
        self.velocity_scaling = flag(velocity_scaling, f"{type(self).__name__}: velocity_scaling")
        self.counts: Counter[str] = Counter()
        self._period, self._led = FRAME_PERIOD, False

    @abstractmethod
    def _wanted(self, goal: Goal) -> Array:
        """Return the desired joint positions at the end of this period, shape (n_joints,) [rad], before any limit."""

    def _holding(self) -> Array:
        """Return the desired joint positions while the person is lost, which are the last commanded positions."""
        return self.latest.q

    @property
    def notes(self) -> dict[str, float]:
        """Counts since :meth:`start`, by name.

        A *joint step* is the motion of one joint in one control period. ``"velocity_excess"`` is the number of joint
        steps that were faster than the velocity limit, before any scaling. ``"position_clips"`` is the number of joint
        steps that were clipped at a position limit.
        """
        return {name: float(self.counts[name]) for name in ("velocity_excess", "position_clips", *self.counts)}

    def _begin(self) -> None:
        self.counts = Counter()
        self._period, self._led = FRAME_PERIOD, False

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        before, estimate = self._estimate, super()._see(skeleton)
        if estimate is not None and before is not None:
            self._period = min(max(estimate.time - before.time, self.dt), _LONGEST_PERIOD)
        return estimate

    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        if goal is None and self._led:  # the person is lost: forget them
            self._rest_at(self.latest.q)
        self._led = goal is not None
        if goal is None or goal.state is not EngagementState.FOLLOWING:
            return self._limited(self._holding())
        return self._limited(self._wanted(goal))

    @property
    def _steps_per_frame(self) -> int:
        """Number of control steps until the next frame is expected; rounded up, so that the robot does not pause."""
        return max(math.ceil(self._period / self.dt - 1e-6), 1)

    def _limited(self, wanted: Array) -> Array:
        """Return the desired joint positions after velocity scaling (if requested), clipped to the joint ranges."""
        before = self.latest.q
        step = wanted - before
        fractions = np.abs(step) / (self.dt * self.arm.max_velocity)
        self.counts["velocity_excess"] += int(np.count_nonzero(fractions > _ROUNDING))
        if self.velocity_scaling:
            step = step / max(float(fractions.max()), 1.0)
        reached = before + step
        kept = np.minimum(np.maximum(reached, self.arm.lower), self.arm.upper)
        self.counts["position_clips"] += int(np.count_nonzero(kept != reached))
        return kept
