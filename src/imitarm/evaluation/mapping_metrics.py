"""MappingMetrics: what a method made of a recording, as plain values; pure functions of the run (METHODS B)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.evaluation.execution import execute_within_limits
from imitarm.evaluation.motion import (
    ArmMotion,
    jerk_rms,
    path_length,
    spectral_arc_length,
    violations,
)
from imitarm.evaluation.tracking import (
    Hold,
    TrueArm,
    best_lag,
    elbow_angle_errors,
    elbow_direction_errors,
    motion_end,
    reference_positions,
    reference_rotations,
    rms,
    rotation_errors,
    settling_time,
)
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.retargeter import Retargeting

Array = NDArray[np.float64]

_REST = 0.5  # [s] at the end, over which the last target is averaged


@dataclass(frozen=True)
class MappingMetrics:
    """What a method made of a recording. What is not known is nan.

    The reference of tool and elbow is the clutch's law with the *true* hand from the moment the method engaged; each
    engagement begins anew. Errors are taken over the frames in which the clutch is engaged, so read them beside
    ``engaged_fraction``; ``tool_rms_from_first`` forgives nothing.

    Attributes:
        duration: of the robot's motion [s].
        following_fraction: share of the frames with state "following".
        engaged_fraction: share of the frames in which the clutch is engaged: following, coasting, holding.
        engagements: how often the clutch was engaged.
        tool_rms: distance of the tool to the reference, as it is, lag included, root mean square [m].
        tool_rms_without_lag: the same with the best constant lag taken out [m].
        lag: that lag [s].
        tool_rms_from_first: distance to the reference of the first engagement over all frames after it, whatever
            the state, lag included [m].
        executed_rms: distance of the tool to the reference, lag included, when an arm that keeps its limits of
            position, velocity and acceleration executes the commands [m]: nothing is gained by breaking them.
        executed_rms_without_lag: the same with the best constant lag taken out [m].
        target_rms: distance of the tool to the method's own target [m].
        orientation_rms: angle between the tool's rotation and the reference [rad].
        elbow_direction_rms: angle between the robot's upper arm and where it should point, see
            :func:`~imitarm.evaluation.tracking.elbow_direction_errors` [rad].
        elbow_angle_rms: difference of the changes of the SEW angles of robot and person [rad].
        path_length: of the tool [m].
        settling_time: from the end of the true hand's motion until the tool stays for 0.5 s within 1 cm of the
            method's last target [s]; nan when it never does.
        mean_torque: mean of the absolute torque of each joint [N m].
        rms_torque: root mean square of each joint's torque [N m].
        mean_gravity_torque: mean of the absolute torque that holds the weight alone [N m].
        mean_motion_torque: mean of the absolute torque without the part that holds the weight [N m].
        effort: integral over time of the squared torques, summed over the joints [N^2 m^2 s].
        gravity_effort: the same of the torques that hold the weight [N^2 m^2 s].
        peak_torque_ratio: largest torque over the rated one.
        position_violations: frames in which a joint is beyond its range, by finite differences of the positions alone
            as all violations are.
        velocity_violations: frames into which a joint moved too fast.
        acceleration_violations: frames in which a joint changed its velocity too fast.
        position_excess: by how much the worst joint is beyond its range [rad].
        velocity_ratio: largest velocity over the one allowed.
        acceleration_ratio: largest acceleration over the one allowed.
        jerk_rms: of the tool's position [m/s^3].
        joint_jerk_rms: of all joints together [rad/s^3].
        spectral_arc_length: of the tool's speed; 0 is smoothest.
        least_singular: smallest singular value of the tool's Jacobian on the way, 1 rad counting as 0.3 m [m/rad].
        teaching_time: time of a teacher that the method's corrections took [s]; 0 for methods without a teacher.
        failures: faults that the method itself found and could not mend; 0 for methods that look for none.
    """

    duration: float
    following_fraction: float
    engaged_fraction: float
    engagements: int
    tool_rms: float
    tool_rms_without_lag: float
    lag: float
    tool_rms_from_first: float
    executed_rms: float
    executed_rms_without_lag: float
    target_rms: float
    orientation_rms: float
    elbow_direction_rms: float
    elbow_angle_rms: float
    path_length: float
    settling_time: float
    mean_torque: tuple[float, ...]
    rms_torque: tuple[float, ...]
    mean_gravity_torque: tuple[float, ...]
    mean_motion_torque: tuple[float, ...]
    effort: float
    gravity_effort: float
    peak_torque_ratio: float
    position_violations: int
    velocity_violations: int
    acceleration_violations: int
    position_excess: float
    velocity_ratio: float
    acceleration_ratio: float
    jerk_rms: float
    joint_jerk_rms: float
    spectral_arc_length: float
    least_singular: float
    teaching_time: float
    failures: int

    @property
    def limit_violations(self) -> int:
        """Frames that break a limit of position, velocity or acceleration, counted once for each kind of limit."""
        return self.position_violations + self.velocity_violations + self.acceleration_violations


def measure(run: Retargeting, correspondence: Correspondence, true: TrueArm | None = None) -> MappingMetrics:
    """Measure what a method made of a recording.

    Args:
        run: of the method.
        correspondence: that the method was given.
        true: where the person's arm was at the times of the run, or, for a method that slows the motion afterwards, at
            the moments that it reproduces; None when it is not known, as with a real camera: what needs it is nan.

    Raises:
        InputError: when the run is shorter than 4 control periods or a joint position is not finite.
    """
    motion = ArmMotion.of(run.arm, run.times, run.joints)
    hold = Hold.of(run.states)
    broken = violations(run.arm, run.joints, motion.dt)
    speed = np.linalg.norm(np.diff(motion.tool, axis=0), axis=1) / motion.dt
    tool_rms, without_lag, lag, from_first, turned, upper_arm, swing = _tracking(
        run, motion, hold, correspondence, true
    )
    executed_rms, executed_without_lag = _executed(run, motion, hold, correspondence, true)
    targets = run.targets[0]
    aimed = np.isfinite(targets).all(axis=1)
    moving = motion.torques - motion.gravity
    return MappingMetrics(
        duration=float(run.times[-1] - run.times[0]),
        following_fraction=float(np.mean(run.states == "following")),
        engaged_fraction=float(np.mean(hold.led)),
        engagements=hold.count,
        tool_rms=tool_rms,
        tool_rms_without_lag=without_lag,
        lag=lag,
        tool_rms_from_first=from_first,
        executed_rms=executed_rms,
        executed_rms_without_lag=executed_without_lag,
        target_rms=rms((motion.tool - targets)[aimed]),
        orientation_rms=turned,
        elbow_direction_rms=upper_arm,
        elbow_angle_rms=swing,
        path_length=path_length(motion.tool),
        settling_time=_settling(run, motion, hold, correspondence, true),
        mean_torque=_each(np.abs(motion.torques).mean(axis=0)),
        rms_torque=_each(np.sqrt(np.mean(motion.torques**2, axis=0))),
        mean_gravity_torque=_each(np.abs(motion.gravity).mean(axis=0)),
        mean_motion_torque=_each(np.abs(moving).mean(axis=0)),
        effort=float(np.sum(motion.torques**2) * motion.dt),
        gravity_effort=float(np.sum(motion.gravity**2) * motion.dt),
        peak_torque_ratio=float((np.abs(motion.torques) / run.arm.max_torque).max()),
        position_violations=broken.position,
        velocity_violations=broken.velocity,
        acceleration_violations=broken.acceleration,
        position_excess=broken.position_excess,
        velocity_ratio=broken.velocity_ratio,
        acceleration_ratio=broken.acceleration_ratio,
        jerk_rms=jerk_rms(motion.tool, motion.dt),
        joint_jerk_rms=jerk_rms(run.joints, motion.dt),
        spectral_arc_length=spectral_arc_length(speed, motion.dt),
        least_singular=float(motion.least_singular.min()),
        teaching_time=float(run.notes.get("teaching_time", 0.0)),
        failures=int(run.notes.get("failures", 0.0)),
    )


def _tracking(
    run: Retargeting, motion: ArmMotion, hold: Hold, correspondence: Correspondence, true: TrueArm | None
) -> tuple[float, ...]:
    """Return what is measured against the true arm, in the order of the fields."""
    if true is None or not hold.led.any():
        return (math.nan,) * 7
    scale, led = correspondence.scale, hold.led
    first = Hold.of(run.states, first_only=True)
    lag, without_lag = best_lag(true, motion.tool, hold, scale)
    rotations = reference_rotations(true, motion.quaternions, hold, correspondence.orientation)
    swing = elbow_angle_errors(true, motion.sew, hold)
    return (
        rms((motion.tool - reference_positions(true, motion.tool, hold, scale))[led]),
        without_lag,
        lag,
        rms((motion.tool - reference_positions(true, motion.tool, first, scale))[first.led]),
        rms(rotation_errors(motion.quaternions, rotations)[led]),
        rms(elbow_direction_errors(true, motion.sew, hold)[led]),
        rms(swing[led & np.isfinite(swing)]),
    )


def _executed(
    run: Retargeting, motion: ArmMotion, hold: Hold, correspondence: Correspondence, true: TrueArm | None
) -> tuple[float, float]:
    """Return how far an arm that keeps its limits is from the reference: as it is, and without lag."""
    if true is None or not hold.led.any():
        return math.nan, math.nan
    tool = run.arm.tool_path(execute_within_limits(run.arm, run.joints, motion.dt))[0]
    off = tool - reference_positions(true, tool, hold, correspondence.scale)
    return rms(off[hold.led]), best_lag(true, tool, hold, correspondence.scale)[1]


def _settling(
    run: Retargeting, motion: ArmMotion, hold: Hold, correspondence: Correspondence, true: TrueArm | None
) -> float:
    """Return the settling time; the last target is the mean of the method's own over its last half second."""
    if true is None or not hold.led.any():
        return math.nan
    late = run.times >= run.times[-1] - _REST
    targets = run.targets[0][late]
    targets = targets[np.isfinite(targets).all(axis=1)]
    if len(targets) == 0:
        if not hold.led[-1]:
            return math.nan
        targets = reference_positions(true, motion.tool, hold, correspondence.scale)[late]
    end = motion_end(run.times, true.wrist)
    return settling_time(run.times, motion.tool, targets.mean(axis=0), end)


def _each(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
