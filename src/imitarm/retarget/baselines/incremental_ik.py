"""IncrementalIK: baseline M3, resolved-rate control with error feedback and an undamped pseudo-inverse."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.retarget.baselines.baseline_retargeter import BaselineRetargeter
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.retargeter import Goal
from imitarm.scene import Scene
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_RCOND = 1e-6  # ignores only singular values that are numerically zero


class IncrementalIK(BaselineRetargeter):
    r"""Baseline M3: our interpretation of "incremental inverse kinematics" in the thesis.

    The thesis cites Ijspeert et al. 2002 for this method, but the abstract of this paper is about movement primitives.
    M3 is therefore our interpretation of the name, not a published method. Once per frame of the camera, M3 computes
    the joint displacement

    .. math:: \Delta q = J^+ \left(\Delta x_d + K\,e\right), \qquad e = \log(T_d\,T(q)^{-1}),

    where :math:`J^+` is the pseudo-inverse of the tool's Jacobian, and :math:`\Delta x_d` is the displacement of the
    target since the last frame. The error e is that of the tool's pose T(q) relative to the target pose :math:`T_d` of
    the last frame. The displacement :math:`\Delta q` is distributed evenly over the control steps of one frame. The
    pseudo-inverse is not damped, so :math:`\Delta q` grows without bound near singularities, for example at the edge of
    the workspace. Each joint is then limited to its velocity limit and its range, which changes the direction of the
    tool's motion. In ``notes``, ``"capped_steps"`` is the number of control steps in which a velocity limit was active.
    ``"caps"`` is the number of limited joints, summed over these steps.

    M3 does not include the movement primitives of the cited paper. In this library, movement primitives belong to the
    learned skill, which is independent of the retargeting method.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: ignored.
        velocity_scaling: True: all joints are scaled down together in every step, so that no joint exceeds its velocity
            limit. False: each joint is limited separately.
        gain: gain K, the fraction of the error that is corrected per frame.

    Raises:
        InputError: when the gain is 0, negative or above 1.
    """

    name: ClassVar[str] = "m3"
    title: ClassVar[str] = "M3"
    caption: ClassVar[str] = "Our interpretation of incremental inverse kinematics: no treatment of singularities."

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        velocity_scaling: bool = False,
        gain: float = 0.5,
    ) -> None:
        super().__init__(arm, correspondence, dt=dt, scene=scene, velocity_scaling=velocity_scaling)
        self._gain = finite_number(gain, "IncrementalIK: gain", above=0.0, at_most=1.0)

    def _rest_at(self, q: Array) -> None:
        self._last_target: Pose | None = None
        self._step, self._left = np.zeros(self.arm.n_joints), 0

    def _wanted(self, goal: Goal) -> Array:
        q = self.latest.q
        if goal.fresh:
            before = goal.clutch.home if self._last_target is None else self._last_target
            rest = self._left * self._capped(self._step)  # of the last frame, when this one came early
            self._left = self._steps_per_frame
            self._step = (rest + self._increment(q + rest, before, goal.target)) / self._left
            self._last_target = goal.target
        if self._left <= 0:
            return q
        self._left -= 1
        self._count(self._step)
        return q + (self._step if self.velocity_scaling else self._capped(self._step))

    def _increment(self, q: Array, before: Pose, target: Pose) -> Array:
        """Return the displacement of the joints for one frame from ``q``, shape (n_joints,) [rad]."""
        twist = before.error_to(target) + self._gain * self.arm.tool_pose(q).error_to(before)
        return np.asarray(np.linalg.pinv(self.arm.tool_jacobian(q), rcond=_RCOND) @ twist)

    def _capped(self, step: Array) -> Array:
        """Limit each joint to its maximum velocity, or scale the step as a whole."""
        most = self.dt * self.arm.max_velocity
        if self.velocity_scaling:
            return np.asarray(step / max(float((np.abs(step) / most).max()), 1.0))
        return np.clip(step, -most, most)

    def _count(self, step: Array) -> None:
        """Count the joints that a step would move faster than their velocity limits allow."""
        over = int(np.count_nonzero(np.abs(step) > self.dt * self.arm.max_velocity * (1.0 + 1e-9)))
        self.counts["caps"] += over
        self.counts["capped_steps"] += over > 0
