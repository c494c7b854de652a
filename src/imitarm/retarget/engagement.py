"""Engagement: when a person takes hold of the robot; the same rule for all methods."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Clutch, Correspondence

Array = NDArray[np.float64]

SEEN_FOR = 0.5  # [s] that an arm must have been seen
LOST_AFTER = 0.1  # [s] a longer gap between two estimates begins the count anew


class Engagement:
    """Engages the clutch once the arm has been seen for half a second without a gap.

    Attributes:
        clutch: what is engaged; None while nothing is.
    """

    def __init__(self, correspondence: Correspondence) -> None:
        self._correspondence = correspondence
        self.release()

    def release(self) -> None:
        """Let go; the arm must be seen for half a second again."""
        self.clutch: Clutch | None = None
        self._since = self._last = math.inf

    def slip(self, way: Array) -> None:
        """Move where the tool is led by ``way``, shape (3,) [m]: from now on the hand leads it from there."""
        if self.clutch is not None:
            home = self.clutch.home
            self.clutch = replace(self.clutch, home=Pose.trusted(home.position + way, home.quaternion))

    def update(self, estimate: ArmEstimate | None, tool_to_base: Pose | None) -> Clutch | None:
        """Take in what became of a frame, and return the clutch, engaged or None.

        Args:
            estimate: of the person's arm; None when the frame did not show it.
            tool_to_base: where the robot's tool is now; None while the robot can't be taken hold of, then only how long
                the arm has been seen is counted.
        """
        if estimate is None or self.clutch is not None:
            return self.clutch
        if not 0.0 <= estimate.time - self._last <= LOST_AFTER:
            self._since = estimate.time
        self._last = estimate.time
        if tool_to_base is not None and estimate.time - self._since >= SEEN_FOR:
            self.clutch = self._correspondence.engage(estimate.wrist, estimate.hand, tool_to_base)
        return self.clutch
