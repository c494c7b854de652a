"""PersonCapsules: a person's arms as obstacles, so that the robot avoids the person whom the camera records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import SIDES, Arm, Skeleton
from imitarm.kinematics.pose import Pose
from imitarm.perception.detection import Detection
from imitarm.scene import Capsule
from imitarm.validation import choice, finite_number, instance

Array = NDArray[np.float64]

_LONGEST = 0.75  # [m] of an upper arm, or of a forearm with its hand: more was not measured
_SHOULDER, _ELBOW, _WRIST, _HAND, _TIP, _THUMB = range(6)


class PersonCapsules:
    r"""Converts skeletons to detections: each arm becomes two capsules, an upper arm and a forearm with its hand.

    The capsule of the upper arm surrounds the segment from shoulder to elbow. The capsule of the forearm begins at the
    elbow and ends at the farthest tracked point of the hand. If only the wrist is tracked, the capsule of the forearm
    ends ``hand_length`` beyond the wrist. Its radius is enlarged until the tracked points of wrist, hand and thumb are
    inside by at least ``hand_radius``.

    Let :math:`\sigma_a` and :math:`\sigma_b` be the standard deviations of the two ends of a capsule. Each is
    ``tracked_sigma`` or ``inferred_sigma``, because a skeleton camera states whether it tracked or only inferred a
    joint. Both ends have similar errors, because most errors come from the posture of the person. The middle of the
    capsule is therefore not more accurate than its ends, and the covariance of the middle is

    .. math:: R = \tfrac12 (\sigma_a^2 + \sigma_b^2)\, I

    There is no detection of a capsule if one of its ends is lost, or if its ends are farther apart than is possible for
    a person. A tracker then predicts the capsule. Each capsule has a label such as ``"person 0 right forearm"``, so
    that a tracker never confuses two capsules.

    Args:
        sensor_to_base: pose of the skeleton camera; the camera's frame is that of
            :class:`~imitarm.capture.skeleton.Skeleton` (x to the sensor's left, y up, z away from the sensor).
        sides: sides of the arms to convert, ``"left"`` and ``"right"``.
        upper_arm_radius: radius of the upper arm's capsule [m].
        forearm_radius: smallest radius of the forearm's capsule [m].
        hand_length: distance from wrist to finger tips [m].
        hand_radius: half of the thickness of a hand [m].
        tracked_sigma: standard deviation of the position of a tracked joint [m].
        inferred_sigma: standard deviation of the position of an inferred joint [m].

    Raises:
        UnknownNameError: when a side is neither left nor right.
        InputError: when an argument can't be used.
    """

    def __init__(
        self,
        sensor_to_base: Pose,
        *,
        sides: Sequence[str] = SIDES,
        upper_arm_radius: float = 0.06,
        forearm_radius: float = 0.05,
        hand_length: float = 0.19,
        hand_radius: float = 0.03,
        tracked_sigma: float = 0.015,
        inferred_sigma: float = 0.05,
    ) -> None:
        name = type(self).__name__
        self.sensor_to_base = instance(sensor_to_base, Pose, f"{name}: sensor_to_base")
        self.sides = tuple(choice(side, SIDES, "side") for side in sides)
        self.upper_arm_radius = finite_number(upper_arm_radius, f"{name}: upper_arm_radius", "m", above=0.0)
        self.forearm_radius = finite_number(forearm_radius, f"{name}: forearm_radius", "m", above=0.0)
        self.hand_length = finite_number(hand_length, f"{name}: hand_length", "m", at_least=0.0)
        self.hand_radius = finite_number(hand_radius, f"{name}: hand_radius", "m", at_least=0.0)
        self.tracked_sigma = finite_number(tracked_sigma, f"{name}: tracked_sigma", "m", above=0.0)
        self.inferred_sigma = finite_number(inferred_sigma, f"{name}: inferred_sigma", "m", at_least=self.tracked_sigma)

    def detections(self, skeleton: Skeleton) -> list[Detection]:
        """Return the capsules of the arms that the camera sees, in the base frame.

        Raises:
            InputError: when ``skeleton`` is not a Skeleton.
        """
        instance(skeleton, Skeleton, "PersonCapsules: skeleton")
        found = []
        for side in self.sides:
            arm = skeleton.arm(side)
            points = self.sensor_to_base.apply(np.nan_to_num(arm.points))
            parts = {"upper arm": self._upper_arm(arm, points), "forearm": self._forearm(arm, points)}
            for part, detection in parts.items():
                if detection is not None:
                    capsule, covariance = detection
                    found.append(Detection(capsule, covariance, f"person {skeleton.person} {side} {part}"))
        return found

    def _upper_arm(self, arm: Arm, points: Array) -> tuple[Capsule, Array] | None:
        if not self._plausible(arm, points, _SHOULDER, _ELBOW):
            return None
        capsule = Capsule(points[_SHOULDER], points[_ELBOW], self.upper_arm_radius)
        return capsule, self._covariance(arm, _SHOULDER, _ELBOW)

    def _forearm(self, arm: Arm, points: Array) -> tuple[Capsule, Array] | None:
        seen = [i for i in (_WRIST, _HAND, _TIP, _THUMB) if self._plausible(arm, points, _ELBOW, i)]
        ends = [i for i in (_TIP, _HAND, _WRIST) if i in seen]
        if not ends:
            return None
        start, last = points[_ELBOW], ends[0]
        along = points[last] - start
        length = float(np.linalg.norm(along))
        direction = along / max(length, 1e-6)
        missing = {_TIP: 0.0, _HAND: 0.5, _WRIST: 1.0}[last] * self.hand_length
        end = points[last] + missing * direction
        others = points[seen] - start
        nearest = np.clip(others @ direction, 0.0, length + missing)
        beside = np.linalg.norm(others - nearest[:, None] * direction, axis=1)
        radius = max(self.forearm_radius, float(beside.max()) + self.hand_radius)
        return Capsule(start, end, radius), self._covariance(arm, _ELBOW, last)

    def _plausible(self, arm: Arm, points: Array, first: int, second: int) -> bool:
        """Return whether the camera has positions of both joints, which are not too far apart for an arm."""
        if min(arm.confidence[first], arm.confidence[second]) <= 0.0:
            return False
        return float(np.linalg.norm(points[second] - points[first])) <= _LONGEST

    def _covariance(self, arm: Arm, first: int, second: int) -> Array:
        sigmas = [self.tracked_sigma if arm.confidence[i] >= 1.0 else self.inferred_sigma for i in (first, second)]
        return float(np.mean(np.square(sigmas))) * np.eye(3)


def upright_camera(position: ArrayLike, yaw: float = 0.0) -> Pose:
    """Return the pose ``sensor_to_base`` of an upright skeleton camera that looks along the x-axis of the base.

    Args:
        position: position of the camera in the base frame, shape (3,) [m].
        yaw: rotation of the camera about the vertical [rad]. With 0, the camera looks in the direction of x; with pi,
            in the opposite direction.

    Raises:
        InputError: when a number is not finite.
    """
    yaw = finite_number(yaw, "upright_camera: yaw", "rad")
    ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([left, [0.0, 0.0, 1.0], ahead])  # the sensor's x (left), y (up) and z (ahead)
    matrix[:3, 3] = position
    return Pose.from_matrix(matrix)
