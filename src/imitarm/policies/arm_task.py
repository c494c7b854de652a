"""ArmTask and ArmSolution: the input and the result of the search for a joint path of the whole arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.policies.approach import Approach
from imitarm.policies.arm_planner import ArmPlan, Effort
from imitarm.policies.least_detour import AllowedDirections
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.policies.remainder import Remainder
from imitarm.policies.retiming import Timing
from imitarm.scene.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ArmSolution:
    """The result of the search for a joint path of the whole arm.

    Attributes:
        plan: the plan, or the best attempt if no plan keeps the clearance; None if the arm can't follow the path at
            all.
        timing: times at which the arm reaches the samples of the plan; None if no plan is feasible.
        reason: text that says why no plan was found; empty if a plan was found.
        approach: motion from the task's start posture to the plan's first posture; None if these two postures are
            equal.
    """

    plan: ArmPlan | None
    timing: Timing | None
    reason: str
    approach: Approach | None = None

    @property
    def duration(self) -> float:
        """Duration of approach and plan together [s]; inf if no plan is feasible."""
        own = np.inf if self.timing is None else float(self.timing.times[-1])
        return own if self.approach is None else own + float(self.approach.times[-1])


@dataclass(frozen=True, eq=False)
class ArmTask:
    """The input of the search: the arm, its surroundings, and the limits that the plan must keep.

    Attributes:
        arm: the arm with its tool.
        start: posture at the start, shape (n_joints,) [rad].
        scene: obstacles at time 0, and fixtures.
        clearance: required distance from every moving part of the arm to every obstacle [m].
        allowed: directions in which the components of the path may be displaced.
        max_tilt: largest rotation of the tool away from the learned rotation at each of n samples, shape (n,) [rad].
        allowance: difference between ``clearance`` and the smaller clearance that the safety filter keeps [m].
        rest: the part of the learned motion that is still ahead, if the motion has begun; None: the arm stands still at
            the start.
        margins: the margin of each obstacle, or None for an obstacle without a margin; None: there are no margins.
        hold: the arm must keep its clearances at the goal for this long after the arrival [s].
        max_attempts: largest number of attempts of the search; None: no limit. An attempt that only delays the motion
            along an already found path is not counted.
        effort: number of planner rounds that the search may use.
    """

    arm: ArmModel
    start: Array
    scene: Scene
    clearance: float
    allowed: AllowedDirections
    max_tilt: Array
    goal_tilt: float
    allowance: float
    rest: Remainder | None = None
    margins: Sequence[PredictionMargin | None] | None = None
    hold: float = 0.0
    max_attempts: int | None = None
    effort: Effort = field(default_factory=lambda: Effort(np.inf))
