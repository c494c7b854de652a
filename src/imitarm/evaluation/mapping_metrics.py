"""MappingMetrics: the measures of a retargeting run, as plain values."""

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
    EngagementPeriods,
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

_REST = 0.5  # [s] at the end: the last target is averaged over it


@dataclass(frozen=True)
class MappingMetrics:
    """The measures of a retargeting run. Unknown values are nan.

    An *engagement* is a period in which the robot is in one of the states "following", "coasting" and "holding";
    docs/retargeting.md describes these states. Errors of tool and elbow are relative to a reference motion. The clutch
    law computes the reference from the person's *true* hand: it moves the tool by the scaled displacement of the hand
    since the start of the engagement. Each engagement has a new reference. Errors are averaged over the engaged frames
    only, so compare them together with ``engaged_fraction``. Only ``tool_rms_from_first`` includes all frames after the
    first engagement.

    Attributes:
        duration: duration of the robot's motion [s].
        following_fraction: fraction of the frames with state "following".
        engaged_fraction: fraction of the frames that are engaged: with state "following", "coasting" or "holding".
        engagements: how often the robot began to follow the person.
        tool_rms: root mean square distance between the tool and the reference, including the lag [m].
        tool_rms_without_lag: ``tool_rms`` after removing the constant lag that gives the smallest value [m].
        lag: the constant lag that is removed in ``tool_rms_without_lag`` [s].
        tool_rms_from_first: root mean square distance between the tool and the reference of the first engagement,
            including the lag [m]; the mean is taken over all later frames, in any state.
        executed_rms: ``tool_rms`` of an arm that executes the commands within its limits of position, velocity and
            acceleration [m]. A method therefore gains nothing from commands beyond the limits.
        executed_rms_without_lag: ``executed_rms`` after removing the constant lag that gives the smallest value [m].
        target_rms: root mean square distance between the tool and the target that the method computed [m].
        orientation_rms: root mean square angle between the rotations of the tool and of the reference [rad].
        elbow_direction_rms: root mean square angle between the actual and the correct direction of the robot's upper
            arm, see :func:`~imitarm.evaluation.tracking.elbow_direction_errors` [rad].
        elbow_angle_rms: root mean square of an angle difference: the change of the robot's SEW angle (swivel angle of
            the elbow) since the start of the engagement, minus the change of the person's SEW angle [rad].
        path_length: path length of the tool [m].
        settling_time: time from the end of the true hand's motion until the tool comes within 1 cm of the method's last
            target and stays there for 0.5 s [s]; nan if the tool never stays there.
        mean_torque: mean absolute torque of each joint [N m].
        rms_torque: root mean square torque of each joint [N m].
        mean_gravity_torque: mean absolute torque that holds each joint against gravity [N m].
        mean_motion_torque: mean absolute torque of each joint, after the part that holds the joint against gravity is
            subtracted [N m].
        effort: integral over time of the squared torques, summed over the joints [N^2 m^2 s].
        gravity_effort: like ``effort``, but only for the torques that hold the arm against gravity [N^2 m^2 s].
        peak_torque_ratio: largest torque of a joint, divided by the joint's rated torque.
        position_violations: number of frames in which a joint is outside its range.
        velocity_violations: number of frames in which a joint exceeds its velocity limit; the velocity is the finite
            difference of the positions.
        acceleration_violations: number of frames in which a joint exceeds its acceleration limit; the acceleration is
            the second finite difference of the positions.
        position_excess: largest distance of a joint from its range [rad].
        velocity_ratio: largest velocity of a joint, divided by the joint's limit.
        acceleration_ratio: largest acceleration of a joint, divided by the joint's limit.
        jerk_rms: RMS jerk of the tool's position [m/s^3].
        joint_jerk_rms: RMS jerk of all joints together [rad/s^3].
        spectral_arc_length: spectral arc length of the tool's speed, a measure of smoothness; the closer to 0, the
            smoother.
        least_singular: smallest singular value of the tool's Jacobian during the motion, with 1 rad counted as 0.3
            m [m/rad].
        teaching_time: assumed working time of a teacher, for a method in which a teacher corrects the motion [s]; 0 for
            other methods.
        failures: number of faults that the method detected in its motion but could not fix; 0 for methods that detect
            none.
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
        """Sum of ``position_violations``, ``velocity_violations`` and ``acceleration_violations``."""
        return self.position_violations + self.velocity_violations + self.acceleration_violations


def measure(run: Retargeting, correspondence: Correspondence, true: TrueArm | None = None) -> MappingMetrics:
    """Measure a retargeting run.

    Args:
        run: run of a retargeting method.
        correspondence: arm, scale, orientation and sensor pose by which the method related the person to the robot.
        true: the person's true arm, one sample for each time of the run. If the method slows the motion down, the
            robot reproduces what the person did at an earlier time, and the sample shows the arm at this earlier time.
            None: the true arm is unknown, for example with a real camera, and the measures that need it are nan.

    Raises:
        InputError: when the run is shorter than 4 control periods or a joint position is not finite.
    """
    motion = ArmMotion.of(run.arm, run.times, run.joints)
    periods = EngagementPeriods.of(run.states)
    broken = violations(run.arm, run.joints, motion.dt)
    speed = np.linalg.norm(np.diff(motion.tool, axis=0), axis=1) / motion.dt
    tool_rms, without_lag, lag, from_first, rotation, upper_arm, swing = _tracking(
        run, motion, periods, correspondence, true
    )
    executed_rms, executed_without_lag = _executed(run, motion, periods, correspondence, true)
    targets = run.targets[0]
    aimed = np.isfinite(targets).all(axis=1)
    moving = motion.torques - motion.gravity
    return MappingMetrics(
        duration=float(run.times[-1] - run.times[0]),
        following_fraction=float(np.mean(run.states == "following")),
        engaged_fraction=float(np.mean(periods.engaged)),
        engagements=periods.count,
        tool_rms=tool_rms,
        tool_rms_without_lag=without_lag,
        lag=lag,
        tool_rms_from_first=from_first,
        executed_rms=executed_rms,
        executed_rms_without_lag=executed_without_lag,
        target_rms=rms((motion.tool - targets)[aimed]),
        orientation_rms=rotation,
        elbow_direction_rms=upper_arm,
        elbow_angle_rms=swing,
        path_length=path_length(motion.tool),
        settling_time=_settling(run, motion, periods, correspondence, true),
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
    run: Retargeting,
    motion: ArmMotion,
    periods: EngagementPeriods,
    correspondence: Correspondence,
    true: TrueArm | None,
) -> tuple[float, ...]:
    """Return the seven measures that need the true arm, in the order of :class:`MappingMetrics`."""
    if true is None or not periods.engaged.any():
        return (math.nan,) * 7
    scale, engaged = correspondence.scale, periods.engaged
    first = EngagementPeriods.of(run.states, first_only=True)
    lag, without_lag = best_lag(true, motion.tool, periods, scale)
    rotations = reference_rotations(true, motion.quaternions, periods, correspondence.orientation)
    swing = elbow_angle_errors(true, motion.sew, periods)
    return (
        rms((motion.tool - reference_positions(true, motion.tool, periods, scale))[engaged]),
        without_lag,
        lag,
        rms((motion.tool - reference_positions(true, motion.tool, first, scale))[first.engaged]),
        rms(rotation_errors(motion.quaternions, rotations)[engaged]),
        rms(elbow_direction_errors(true, motion.sew, periods)[engaged]),
        rms(swing[engaged & np.isfinite(swing)]),
    )


def _executed(
    run: Retargeting,
    motion: ArmMotion,
    periods: EngagementPeriods,
    correspondence: Correspondence,
    true: TrueArm | None,
) -> tuple[float, float]:
    """Return the tool error, with the lag and without it, of an arm that executes the commands within its limits."""
    if true is None or not periods.engaged.any():
        return math.nan, math.nan
    tool = run.arm.tool_path(execute_within_limits(run.arm, run.joints, motion.dt))[0]
    off = tool - reference_positions(true, tool, periods, correspondence.scale)
    return rms(off[periods.engaged]), best_lag(true, tool, periods, correspondence.scale)[1]


def _settling(
    run: Retargeting,
    motion: ArmMotion,
    periods: EngagementPeriods,
    correspondence: Correspondence,
    true: TrueArm | None,
) -> float:
    """Return the settling time [s]; the final target is the mean of the method's targets in the last half second."""
    if true is None or not periods.engaged.any():
        return math.nan
    late = run.times >= run.times[-1] - _REST
    targets = run.targets[0][late]
    targets = targets[np.isfinite(targets).all(axis=1)]
    if len(targets) == 0:
        if not periods.engaged[-1]:
            return math.nan
        targets = reference_positions(true, motion.tool, periods, correspondence.scale)[late]
    end = motion_end(run.times, true.wrist)
    return settling_time(run.times, motion.tool, targets.mean(axis=0), end)


def _each(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
