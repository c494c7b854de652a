"""IdealFollower: a gripper that is where the hand says it is; to have people shown doing a task without any method."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import matrix_to_quaternion
from imitarm.kinematics.tasks import TwistTask
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.engagement import EngagementRule
from imitarm.retarget.human_arm import hand_rotation
from imitarm.retarget.retargeter import Goal, Retargeter

Array = NDArray[np.float64]

_SHARE = 0.3  # of what is missing that a step makes up for: no more than the joints can brake again
_HELD = {HandState.OPEN: False, HandState.CLOSED: True}


class IdealFollower(Retargeter):
    """Takes every skeleton for the truth, and brings the tool to the clutch's target by inverse kinematics at once.

    No filter, no correction, no loss, nothing of a method: before an :func:`ideal_camera` it is a tool in the
    person's own hand, with some hundredths of a second of lag. What people do with it is recorded to be given to all
    methods alike.
    """

    name: ClassVar[str] = "ideal"
    rule: ClassVar[EngagementRule] = EngagementRule(seen_for=0.0, follow_until=math.inf)

    def _begin(self) -> None:
        self._rotation = np.array([1.0, 0.0, 0.0, 0.0])
        self._closed: bool | None = None

    def _rest_at(self, q: Array) -> None:
        self._velocity = np.zeros(self.arm.n_joints)

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        """Return the arm exactly as the skeleton shows it."""
        if skeleton is None:
            return None
        arm = skeleton.arm(self.correspondence.side)
        if not arm.seen:
            return None
        points = self.correspondence.sensor_to_base.apply(arm.points)
        rotation = hand_rotation(points[2], points[4], points[5])
        self._rotation = self._rotation if rotation is None else matrix_to_quaternion(rotation)
        self._closed = _HELD.get(arm.hand_state, self._closed)
        still, sure = np.zeros((3, 3)), (1.0, 1.0, 1.0)
        shoulder, elbow, wrist = points[:3]
        return ArmEstimate(arm.time, shoulder, elbow, wrist, still, self._rotation, still[0], sure, self._closed)

    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        q, twist = self.latest.q, np.zeros(6)
        if goal is not None:
            twist = (_SHARE / self.dt) * self.arm.tool_pose(q).error_to(goal.target)
        self._velocity = solve_ik(self.arm, q, TwistTask(twist), dt=self.dt, velocity=self._velocity)
        return q + self.dt * self._velocity


def ideal_camera(seed: int = 0) -> SkeletonCamera:
    """Return a camera that sees the truth 100 times a second."""
    return SkeletonCamera.ideal(rate=100.0)
