"""IdealFollower: a gripper that is where the hand says it is; to have people shown doing a task without any method."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import matrix_to_quaternion
from imitarm.retarget.correspondence import Clutch
from imitarm.retarget.human_arm import hand_rotation
from imitarm.retarget.retargeter import Command, Retargeter

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

    def _begin(self, q: Array) -> None:
        self._q, self._velocity = q.copy(), np.zeros(self.arm.n_joints)
        self._clutch: Clutch | None = None
        self._wrist, self._hand = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        self._closed: bool | None = None

    def step(self, skeleton: Skeleton | None, q: ArrayLike) -> Array:
        """Return the joint positions to be at after ``dt``; it takes hold at the first skeleton."""
        if skeleton is not None:
            self._take(skeleton)
        target, twist = None, np.zeros(6)
        if self._clutch is not None:
            target = self._clutch.target(self._wrist, self._hand)
            twist = (_SHARE / self.dt) * self.arm.tool_pose(self._q).error_to(target)
        self._velocity = solve_ik(self.arm, self._q, twist, dt=self.dt, velocity=self._velocity)
        self._q = self._q + self.dt * self._velocity
        state = "waiting" if target is None else "following"
        self.command = Command(self.command.time + self.dt, self._q, self._velocity, self._closed, state, target)
        return self._q

    def _take(self, skeleton: Skeleton) -> None:
        arm, sensor_to_base = skeleton.arm(self.correspondence.side), self.correspondence.sensor_to_base
        if not arm.seen:
            return
        points = sensor_to_base.apply(arm.points)
        rotation = hand_rotation(points[2], points[4], points[5])
        self._wrist = points[2]
        self._hand = self._hand if rotation is None else matrix_to_quaternion(rotation)
        self._closed = _HELD.get(arm.hand_state, self._closed)
        if self._clutch is None:
            self._clutch = self.correspondence.engage(self._wrist, self._hand, self.arm.tool_pose(self._q))


def ideal_camera(seed: int = 0) -> SkeletonCamera:
    """Return a camera that sees the truth 100 times a second."""
    return SkeletonCamera.ideal(rate=100.0)
