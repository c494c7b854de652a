"""DemonstrationModification: rival M1, the person's joints as the robot's, corrected afterwards where the arm can't."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.joint_mapping import Approach, JointMapping
from imitarm.retarget.rival import RivalRetargeter
from imitarm.scene import Scene

Array = NDArray[np.float64]


class DemonstrationModification(RivalRetargeter):
    """Rival M1: our reading of "demonstration modification" in the thesis (METHODS B).

    Step by step it is the uncorrected mapping of the person's joints, cut at the limits of position: the method itself
    is an offline one.

    Args:
        arm: the robot's arm with its tool.
        correspondence: what of the person's arm stands for what of the robot's.
        dt: control period [s].
        scene: not heeded.
        velocity_scaling: scale every step as a whole so that no joint exceeds its velocity limit.
        relative: map the change of the person's joints since the hold was taken; else the joints themselves, which are
            approached at limited speed. See :class:`~imitarm.retarget.joint_mapping.JointMapping`.

    Raises:
        InputError: when the arm has not the axes of a person's arm.
    """

    name: ClassVar[str] = "m1"

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        velocity_scaling: bool = False,
        relative: bool = True,
    ) -> None:
        self._mapping = JointMapping(arm, relative=relative)
        super().__init__(arm, correspondence, dt=dt, scene=scene, velocity_scaling=velocity_scaling)

    def _restart(self, q: Array) -> None:
        self._mapping.start(q)
        self._approach = Approach(self.arm, self.dt)
        self._goal, self._left = q, 0

    def _engaged(self, estimate: ArmEstimate, clutch: Clutch) -> None:
        pass  # the mapping begins with the first frame that is mapped

    def _advance(self, estimate: ArmEstimate | None, clutch: Clutch) -> Array:
        if estimate is not None:
            self._goal = self._mapping.joints(estimate, clutch)
            self._left = max(round(self._period / self.dt), 1)
        if self._approach.active:
            return self._approach.towards(self._q, self._goal)
        if self._left <= 0:
            return self._q
        step = (self._goal - self._q) / self._left
        self._left -= 1
        return np.asarray(self._q + step)
