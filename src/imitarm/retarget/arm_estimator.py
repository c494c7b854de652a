"""ArmEstimator: estimates the motion of a person's arm from noisy skeletons, in the same way for all methods."""

from __future__ import annotations

import math
from collections import deque
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import matrix_to_quaternion
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.human_arm import carried, hand_rotation
from imitarm.retarget.limbs import LimbLengths, correct_limbs, fit_limbs, measure_limbs
from imitarm.retarget.smoothing import GAP, Hampel, OneEuro, OneEuroRotation, TrackingOffsets

Array = NDArray[np.float64]

_LEARNING_FRAMES = 60  # frames from which lengths that were not given are measured
_GRIP_FRAMES = 3  # consecutive frames that must agree on a hand state
_FILTER = (3.0, 25.0, 10.0)  # [Hz, Hz per m/s, Hz] for the points; a slower speed estimate would make the robot lag
_DOUBTFUL = 0.02  # [m] offset of the elbow from its measured position at which its weight is halved
_JUMP = 0.12  # [m] that a hand may move within half the outlier filter's window without being an outlier


class ArmEstimate(NamedTuple):
    """Smoothed pose and motion of a person's arm with the true bone lengths, in the robot's base frame.

    Attributes:
        time: time of the frame, on the clock of the camera or recording [s].
        shoulder: position of the shoulder, shape (3,) [m].
        elbow: position of the elbow, shape (3,) [m].
        wrist: position of the wrist, shape (3,) [m].
        velocities: velocities of shoulder, elbow and wrist, shape (3, 3) [m/s].
        hand: rotation of the hand, quaternion wxyz, shape (4,): x along the hand, z out of the back of the hand.
        angular_velocity: angular velocity of the hand, shape (3,) [rad/s].
        confidence: confidences of the elbow position, the wrist position and the hand rotation, each 0 to 1.
        closed: whether the hand is closed; None if this is not known.
    """

    time: float
    shoulder: Array
    elbow: Array
    wrist: Array
    velocities: Array
    hand: Array
    angular_velocity: Array
    confidence: tuple[float, float, float]
    closed: bool | None

    @property
    def velocity(self) -> Array:
        """Velocity of the wrist, shape (3,) [m/s]."""
        return self.velocities[2]

    @property
    def upper_arm(self) -> Array:
        """Direction from the shoulder to the elbow, a unit vector, shape (3,)."""
        bone = self.elbow - self.shoulder
        return bone / max(math.sqrt(float(bone.dot(bone))), 1e-9)


class ArmEstimator:
    """Computes an :class:`ArmEstimate` from each skeleton: removes outliers, corrects bone lengths, and smooths.

    All retargeting methods use this estimator, so that a comparison of the methods does not depend on different
    filters.

    Args:
        correspondence: the side of the person's arm, its bone lengths if known, and the pose of the sensor.
        smoothing: whether to apply the One-Euro filter, and to remove jumps that occur when the camera loses or finds a
            joint (:class:`~imitarm.retarget.smoothing.TrackingOffsets`). If False, only outliers are removed and bone
            lengths corrected.
        limbs: how the bone lengths are corrected. ``"fit"``: by the smallest change of shoulder, elbow and wrist.
            ``"direction"``: as in the thesis, by a change of elbow and wrist with which the bones keep their
            directions.
    """

    def __init__(
        self,
        correspondence: Correspondence,
        *,
        smoothing: bool = True,
        limbs: Literal["fit", "direction"] = "fit",
    ) -> None:
        if limbs not in {"fit", "direction"}:
            raise UnknownNameError.among("limbs", limbs, ("fit", "direction"))
        self.correspondence, self._limbs = correspondence, limbs
        self._smoothing = smoothing
        self._rotation = correspondence.sensor_to_base.rotation
        self._origin = correspondence.sensor_to_base.position
        self._filter, self._rotation_filter = OneEuro(*_FILTER), OneEuroRotation()
        self._guard, self._offsets = Hampel(least=_JUMP), TrackingOffsets()
        self.reset()

    def reset(self) -> None:
        """Delete all information from previous frames."""
        self._time = self._used = -np.inf
        self._hand: Array | None = None
        self._fore: Array | None = None
        self._closed: bool | None = None
        self._grips: deque[HandState] = deque(maxlen=_GRIP_FRAMES)
        self._learning: list[Skeleton] = []
        self.lengths: LimbLengths | None = self.correspondence.lengths
        for one in (self._filter, self._rotation_filter, self._guard, self._offsets):
            one.reset()

    def update(self, skeleton: Skeleton) -> ArmEstimate | None:
        """Return the estimate from a skeleton; None if it shows no usable arm or is not newer than the last one."""
        if skeleton.time <= self._time:
            return None
        self._time = skeleton.time
        arm = skeleton.arm(self.correspondence.side)
        if not arm.seen:
            return None
        if self.lengths is None or self._learning:
            self._learn(skeleton)
        if self.lengths is None or not self._guard.accept(arm.time, arm.wrist - arm.shoulder):
            return None
        period, self._used = arm.time - self._used, arm.time
        if period > GAP:
            self._hand = None
            self._offsets.reset()
        points = arm.points.dot(self._rotation.T) + self._origin
        confidence = arm.confidence.tolist()
        bones = self._bones(points[:3], arm.confidence[:3], period, self.lengths)
        rotation, hand_known = self._hand_rotation(points, confidence, bones[2] - bones[1])
        hand = matrix_to_quaternion(rotation)
        if self._smoothing:
            bones = self._filter.filter(arm.time, bones, arm.confidence[:3, None])
            hand = self._rotation_filter.filter(arm.time, hand, 1.0 if hand_known else 0.5)
            velocities, angular_velocity = self._filter.velocity, self._rotation_filter.velocity
        else:
            velocities, angular_velocity = np.zeros((3, 3)), np.zeros(3)
        known = (confidence[1], min(confidence[2], confidence[0]), hand_known)
        closed = self._grip(arm.hand_state)
        return ArmEstimate(arm.time, bones[0], bones[1], bones[2], velocities, hand, angular_velocity, known, closed)

    def _bones(self, points: Array, confidence: Array, period: float, lengths: LimbLengths) -> Array:
        """Return shoulder, elbow and wrist with the true bone lengths between them, shape (3, 3) [m]."""
        if self._smoothing:
            velocity = self._filter.velocity if period <= GAP else np.zeros((3, 3))
            points = self._offsets.compensate(points, confidence.tolist(), velocity, period)
            confidence = self._weights(confidence)
        if self._limbs == "fit":
            return fit_limbs(points, confidence, lengths)
        return np.array([points[0], *correct_limbs(points[0], points[1], points[2], lengths)])

    def _weights(self, confidence: Array) -> Array:
        """Return the weights of shoulder, elbow and wrist; an inferred elbow with a large error gets a small weight.

        If an inferred elbow had a large weight, its error would move the wrist, because the forearm has a fixed length.
        The tool follows the wrist, so the elbow's error would also move the tool.
        """
        offset = self._offsets.offset(1)
        if offset == 0.0:
            return confidence
        weights = confidence.copy()
        weights[1] /= 1.0 + (offset / _DOUBTFUL) ** 2
        return weights

    def _learn(self, skeleton: Skeleton) -> None:
        """Measure the bone lengths of the arm in the first frames that show the arm."""
        self._learning.append(skeleton)
        try:
            self.lengths = measure_limbs(self._learning, self.correspondence.side)
        except InputError:  # too few frames so far, or not an arm
            self._learning = self._learning[-_LEARNING_FRAMES:]
            return
        if len(self._learning) >= _LEARNING_FRAMES:
            self._learning = []

    def _hand_rotation(self, points: Array, confidence: list[float], forearm: Array) -> tuple[Array, float]:
        """Return the hand's rotation in the base frame, and the confidence of this rotation.

        If the hand is not visible, it is assumed to rotate with the forearm.
        """
        length = math.sqrt(float(forearm.dot(forearm)))
        fore = forearm / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
        seen = min(confidence[2], confidence[4], confidence[5]) >= 1.0
        rotation = hand_rotation(points[2], points[4], points[5]) if seen else None
        known = 1.0 if rotation is not None else 0.0
        if rotation is None:
            rotation = carried(self._hand, self._fore, fore)
        self._hand, self._fore = rotation, fore
        return rotation, known

    def _grip(self, state: HandState) -> bool | None:
        """Return whether the hand is closed; this changes only when several successive frames agree."""
        self._grips.append(state)
        if len(self._grips) == _GRIP_FRAMES and len(set(self._grips)) == 1 and state in _GRIP:
            self._closed = _GRIP[state]
        return self._closed


_GRIP = {HandState.OPEN: False, HandState.CLOSED: True}
