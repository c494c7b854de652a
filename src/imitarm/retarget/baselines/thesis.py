"""ThesisRetargeter: the method of Chapter 3 of the thesis, with its misprints corrected or reproduced."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import (
    Pose,
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    quaternion_to_matrix,
)
from imitarm.kinematics.tasks import TwistTask
from imitarm.retarget.arm_estimator import ArmEstimate, ArmEstimator
from imitarm.retarget.baselines.hand_curve import DelayedCurve, HandCurve, HandSample
from imitarm.retarget.correspondence import Clutch, Correspondence
from imitarm.retarget.engagement import EngagementRule
from imitarm.retarget.human_arm import carried, human_arm_angles, human_arm_frames, human_arm_jacobian, human_arm_pose
from imitarm.retarget.limbs import LimbLengths, correct_limbs
from imitarm.retarget.retargeter import Goal, Retargeter, Retargeting, in_order
from imitarm.retarget.smoothing import GAP
from imitarm.scene import Scene
from imitarm.validation import choice, finite_number, whole_number

Array = NDArray[np.float64]

_NULL = 0.01  # of the largest singular value: smaller ones are directions in which the arm can't move
_LARGEST = 0.5  # [rad] largest increment
_ARRIVED = 1e-5  # [m, rad] error at which no further increment is needed
Curve = Literal["live", "global"]

PRINTED = {
    "limbs": "Eq 3.1 to 3.4 place the elbow behind the shoulder and attach the forearm to the measured elbow",
    "dh": "Eq 3.5 has sin instead of cos in the second row, so forward kinematics gives no rotation",
    "error": "The error has the wrong sign (actual minus desired), so the angles diverge from the target",
    "rpy": "Differences of roll, pitch and yaw are used with a geometric Jacobian, which needs a rotation vector",
    "step": "Only one increment of the joint angles is computed per frame",
    "order": "P_R = P_HA R_HR moves the tool along the axes of the sensor instead of the axes of the base",
    "damping": "Eq 3.9 uses the whole remaining error, so the arm is slower when the target is farther away",
    "small_angle": "The small-angle term after Eq 3.9 gives less damping than the velocity limit needs",
}
"""The misprints that :class:`ThesisRetargeter` can reproduce, by their names in ``as_printed``."""

_UNLIMITED = 1e6  # [m/s] a limit that no twist reaches
_UNSEEN = 0.2  # weight of a hand rotation that was not seen but moved with the forearm


class HumanArmTracker:
    r"""Computes the joint angles of a person's arm in each frame (thesis 3.1.1 and 3.1.2).

    In each frame, the tracker starts from the angles :math:`\tau` of the previous frame, and updates them several
    times:

    .. math:: \tau \leftarrow \tau + J^+ \varepsilon, \qquad
        \varepsilon = \begin{pmatrix} p_d - p(\tau) \\ \log(R_d R(\tau)^T) \end{pmatrix}

    where :math:`p_d, R_d` are the measured wrist position and hand rotation, with corrected bone lengths.
    :math:`p(\tau), R(\tau)` are those of an arm with the angles :math:`\tau`, and J is the Jacobian of this arm. The
    pseudo-inverse :math:`J^+` ignores directions in which a straight arm can't move. In the first frame, and in the
    first frame after a gap, the tracker starts from angles that are computed in closed form.

    Attributes:
        angles: joint angles tau of the person's arm, shape (7,) [rad]; None before the first frame.

    Args:
        iterations: largest number of updates per frame.
        faults: misprints from :data:`PRINTED` to reproduce; only ``"limbs"``, ``"dh"``, ``"error"``, ``"rpy"`` and
            ``"step"`` affect this class.
    """

    def __init__(self, iterations: int = 3, faults: Collection[str] = ()) -> None:
        self._iterations = 1 if "step" in faults else iterations
        self._faults = frozenset(faults)
        self.reset()

    def reset(self) -> None:
        """Delete the angles of previous frames."""
        self.angles: Array | None = None
        self._time = -math.inf

    def follow(self, estimate: ArmEstimate, lengths: LimbLengths) -> tuple[Array, Array]:
        """Update the angles; return wrist (3,) [m] and hand quaternion (4,) for these angles, in the base frame.

        Args:
            estimate: estimate of the arm, with true bone lengths.
            lengths: bone lengths of the arm.
        """
        elbow, wrist = estimate.elbow, estimate.wrist
        if "limbs" in self._faults:
            elbow, wrist = correct_limbs(estimate.shoulder, elbow, wrist, lengths, as_printed=True)
        hand = quaternion_to_matrix(estimate.hand)
        if self.angles is None or estimate.time - self._time > GAP:
            self.angles = human_arm_angles(
                _unit(elbow - estimate.shoulder), _unit(wrist - elbow), hand, previous=self.angles
            )
        self._time = estimate.time
        at, rotation = self._pose(lengths)
        for _ in range(self._iterations):
            error = np.concatenate([wrist - estimate.shoulder - at, self._rotation_error(rotation, hand)])
            if float(error @ error) < _ARRIVED**2:
                break
            self._advance(-error if "error" in self._faults else error, lengths)
            at, rotation = self._pose(lengths)
        return estimate.shoulder + at, matrix_to_quaternion(rotation)

    def _advance(self, error: Array, lengths: LimbLengths) -> None:
        """Make one increment."""
        assert self.angles is not None
        increment = np.linalg.pinv(human_arm_jacobian(self.angles, lengths), rcond=_NULL) @ error
        increment *= min(1.0, _LARGEST / max(float(np.abs(increment).max()), 1e-12))
        self.angles = (self.angles + increment + math.pi) % (2.0 * math.pi) - math.pi

    def _pose(self, lengths: LimbLengths) -> tuple[Array, Array]:
        """Return wrist and hand rotation relative to the shoulder, by forward kinematics of the tracked angles."""
        assert self.angles is not None
        if "dh" in self._faults:
            frames = human_arm_frames(self.angles, lengths, as_printed=True)
            return frames[5, :3, 3], _nearest_rotation(frames[7, :3, :3])
        _, wrist, hand = human_arm_pose(self.angles, lengths)  # the same chain, three times as fast
        return wrist, hand

    def _rotation_error(self, rotation: Array, wanted: Array) -> Array:
        """Return the rotational part of the error, shape (3,) [rad]."""
        if "rpy" in self._faults:
            return roll_pitch_yaw(wanted) - roll_pitch_yaw(rotation)
        return quaternion_log(
            quaternion_multiply(matrix_to_quaternion(wanted), quaternion_conjugate(matrix_to_quaternion(rotation)))
        )


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return roll, pitch and yaw of a rotation Rz(yaw) Ry(pitch) Rx(roll), shape (3,) [rad].

    The thesis uses differences of roll, pitch and yaw as the orientation error. These differences are not a rotation
    vector, jump at 180 degrees, and are singular at a pitch of 90 degrees.
    """
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    return np.array(
        [
            math.atan2(rotation[2, 1], rotation[2, 2]),
            pitch,
            math.atan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def _unit(vector: Array) -> Array:
    length = math.sqrt(float(vector @ vector))
    return vector / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])


def _nearest_rotation(matrix: Array) -> Array:
    """Return the rotation closest to ``matrix``.

    ``matrix`` is a product of matrices as printed in the thesis, and therefore is not a rotation itself.
    """
    left, values, right = np.linalg.svd(matrix)
    if values[1] < 1e-9:  # almost no direction is left
        return carried(None, None, left[:, 0])
    left[:, 2] *= np.linalg.det(left @ right)
    return np.asarray(left @ right)


class ThesisRetargeter(Retargeter):
    r"""The method of Chapter 3 of the thesis, corrected as in docs/thesis_map.md.

    For each skeleton

    1. the bones get their true lengths (Eq 3.1 to 3.4);
    2. the person's joint angles are tracked (:class:`HumanArmTracker`); forward kinematics with Denavit-Hartenberg
       parameters (Eq 3.5) then gives the pose of the hand in the robot's base frame;
    3. a NURBS curve is fitted to the hand's motion of the last 0.6 s and evaluated 70 ms in the past (Eq 3.6 and 3.7,
       :class:`~imitarm.retarget.baselines.hand_curve.DelayedCurve`).

    In each control step, the tool moves towards the curve by damped least squares with Baerlocher's damping (Eq 3.8 and
    3.9). The length of the step is limited, because the damping grows with this length and would stop the arm. Joint
    positions and velocities stay within their limits. As in the thesis, accelerations, the position of the elbow,
    obstacles and tracking losses are not handled. If the camera loses the person, the target stays at its last pose.
    When the camera finds the person again, the target jumps.

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period [s].
        scene: ignored.
        small_angle: None: damping as in Eq 3.9; ``"thesis"``: damping with the additional term for small angles that
            follows Eq 3.9 in the thesis.
        as_printed: names of the misprints in :data:`PRINTED` that are reproduced; True: all; False: none. Even then,
            the arm stays within its limits.
        smoothing: ``"live"``: a curve is fitted to the last 0.6 s. ``"global"``: :meth:`run` fits one curve to the
            whole recording and evaluates it without lag; :meth:`step` works as with ``"live"``. None: no curve.
        lag: time between the evaluated point of the live curve and the current time [s].
        iterations: largest number of updates of the person's joint angles per frame.
        gain: gain K [1/s] of the tool's twist :math:`K \log(T_d T^{-1})`, where T is the tool's pose and :math:`T_d`
            its target; the default is the usual frame rate of the camera.
        max_speed: largest norm of the twist [m/s]; a rotation of 1 rad counts as 0.3 m.

    Raises:
        InputError: when a number is out of range.
        UnknownNameError: when a name in ``as_printed``, ``smoothing`` or ``small_angle`` is unknown.
    """

    name: ClassVar[str] = "thesis"
    caption: ClassVar[str] = "The thesis's Chapter 3, corrected: damped least squares towards a smooth curve."
    rule: ClassVar[EngagementRule] = EngagementRule(hold_until=math.inf)

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        small_angle: str | None = None,
        as_printed: bool | Collection[str] = False,
        smoothing: Curve | None = "live",
        lag: float = 0.07,
        iterations: int = 3,
        gain: float = 30.0,
        max_speed: float = 1.0,
    ) -> None:
        faults = _faults(as_printed)
        super().__init__(arm, correspondence, dt=dt, scene=scene)
        if smoothing is not None:
            choice(smoothing, get_args(Curve), "smoothing")
        if small_angle is not None:
            choice(small_angle, ("thesis",), "small_angle")
        finite_number(gain, "ThesisRetargeter: gain", "1/s", above=0.0, at_most=1.0 / dt)
        finite_number(max_speed, "ThesisRetargeter: max_speed", "m/s", above=0.0)
        whole_number(iterations, "ThesisRetargeter: iterations", at_least=1, at_most=10)
        finite_number(lag, "ThesisRetargeter: lag", "s", at_least=0.0, at_most=0.3)
        self.faults = faults
        self._small_angle = "thesis" if "small_angle" in faults else small_angle
        self._smoothing, self._lag, self._iterations = smoothing, lag, iterations
        self._gain, self._max_speed = gain, _UNLIMITED if "damping" in faults else max_speed
        self._whole: HandCurve | None = None

    def _begin(self) -> None:
        self._tracker = HumanArmTracker(self._iterations, self.faults)
        self._curve = DelayedCurve(lag=self._lag, smooth=self._smoothing is not None, whole=self._whole)

    def _new_estimator(self) -> ArmEstimator:
        return ArmEstimator(self.correspondence, smoothing=False, limbs="direction")

    def run(self, skeletons: Iterable[Skeleton], q: ArrayLike | None = None) -> Retargeting:
        """Retarget a whole recording; with ``smoothing="global"``, one curve is fitted to the whole recording.

        Args:
            skeletons: skeletons in order of time.
            q: start posture, shape (n_joints,) [rad]; None: ``arm.home``.

        Raises:
            InputError: when there are fewer than two skeletons, when times do not increase, or when ``smoothing`` is
                ``"global"`` and fewer than four skeletons show the arm.
        """
        frames = in_order(skeletons)
        if self._smoothing == "global":
            self.start(self.arm.home if q is None else q)
            estimates = [self._estimator.update(frame) for frame in frames]
            self._whole = HandCurve.through([self._sample(e) for e in estimates if e is not None])
        try:
            return super().run(frames, q)
        finally:
            self._whole = None

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        self._curve.step(self.dt)
        estimate = super()._see(skeleton)
        if estimate is not None:
            self._curve.add(self._sample(estimate))
        return estimate

    def _sample(self, estimate: ArmEstimate) -> HandSample:
        """Return the pose of the hand, computed from the tracked joint angles."""
        lengths = self._estimator.lengths
        assert lengths is not None  # else there would be no estimate
        wrist, hand = self._tracker.follow(estimate, lengths)
        _, known, rotated = estimate.confidence
        return HandSample(estimate.time, wrist, hand, (known, max(rotated, _UNSEEN)))

    def _hand(self) -> tuple[Array, Array]:
        """Return wrist and hand on the smoothed curve; the clutch engages at this pose, so the tool does not jump."""
        hand = self._curve.now()
        assert hand is not None
        return hand

    def _target(self, clutch: Clutch, wrist: Array, hand: Array) -> Pose:
        if "order" in self.faults:
            sensor_to_base = self.correspondence.sensor_to_base
            back = quaternion_conjugate(sensor_to_base.quaternion)
            rotation = quaternion_multiply(hand, quaternion_conjugate(clutch.hand))
            rotation = quaternion_multiply(quaternion_multiply(back, rotation), sensor_to_base.quaternion)
            wrist = clutch.wrist + sensor_to_base.rotation.T @ (wrist - clutch.wrist)
            hand = quaternion_multiply(rotation, clutch.hand)
        return clutch.target(wrist, hand)

    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        """Move towards the target by damped least squares."""
        q = self.latest.q
        if goal is None:
            return q
        error = self.arm.tool_pose(q).error_to(goal.target)
        method = "dls" if self._small_angle is None else "dls_small_angle"
        task = TwistTask(self._gain * error, max_speed=self._max_speed)
        velocity = solve_ik(self.arm, q, task, dt=self.dt, method=method)
        return np.clip(q + self.dt * velocity, self.arm.lower, self.arm.upper)


def _faults(as_printed: bool | Collection[str]) -> frozenset[str]:
    if isinstance(as_printed, bool):
        return frozenset(PRINTED if as_printed else ())
    if not isinstance(as_printed, str | Collection):
        raise InputError(f"ThesisRetargeter: as_printed must be True, False or names of misprints, got {as_printed!r}")
    names = [as_printed] if isinstance(as_printed, str) else list(as_printed)
    return frozenset(choice(name, PRINTED, "as_printed") for name in names)
