"""Tracking errors of a robot's tool and elbow, in comparison with a person's true or measured arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.motions import Truth
from imitarm.capture.skeleton import Skeleton
from imitarm.errors import TaskFailedError
from imitarm.kinematics.pose import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
)
from imitarm.kinematics.sew import sew_derivatives
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import engaged_samples
from imitarm.retarget.human_arm import hand_rotation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LAGS = np.round(np.arange(-0.10, 0.801, 0.01), 2)  # [s] candidates for the best constant lag
_BENT = 0.04  # squared sine of an elbow angle below which the SEW angle is poorly defined
_MOVES = 1e-3  # [m] a hand that moves less has no lag
_STILL = 1e-3  # [m] a target that moves less has no lag
_FOLLOWS = 0.5  # of the target's own motion (RMS); a tool with a larger error does not follow


@dataclass(frozen=True, eq=False)
class TrueArm:
    """Positions of a person's arm, in the axes of the robot's base.

    Attributes:
        times: times of the robot's samples in the run that is compared with the person, shape (n,) [s]; non-decreasing.
            The following arrays contain one value for each of these times.
        shoulder: position of the shoulder, shape (n, 3) [m].
        elbow: position of the elbow, shape (n, 3) [m].
        wrist: position of the wrist, shape (n, 3) [m].
        hand: rotation of the hand, quaternions wxyz, shape (n, 4).
    """

    times: Array
    shoulder: Array
    elbow: Array
    wrist: Array
    hand: Array

    @classmethod
    def of(cls, truth: Truth, times: ArrayLike, correspondence: Correspondence, *, start: float = 0.0) -> TrueArm:
        """Sample the true positions of the arm of a simulated or motion-captured person.

        Args:
            truth: function of time that returns the person's skeleton; it is called with increasing times.
            times: times of a run, shape (n,) [s].
            correspondence: object that states the side of the arm and the pose of the sensor.
            start: time at which the first skeleton was measured, on the clock of ``truth`` [s]; it is added to
                ``times`` before ``truth`` is called.
        """
        t = np.asarray(times, dtype=float)
        return cls.from_points(
            t, np.array([truth(start + time).arm(correspondence.side).points for time in t]), correspondence
        )

    @classmethod
    def from_points(cls, times: ArrayLike, points: ArrayLike, correspondence: Correspondence) -> TrueArm:
        """Convert the recorded points of an arm to the axes of the robot's base.

        Args:
            times: time stamps, shape (n,) [s].
            points: shoulder, elbow, wrist, hand, hand tip, thumb, in the sensor's frame, shape (n, 6, 3) [m].
            correspondence: object that states the pose of the sensor.
        """
        t, points = np.asarray(times, dtype=float), correspondence.sensor_to_base.apply(points)
        hands, hand = np.empty((len(t), 3, 3)), np.eye(3)
        for i, arm in enumerate(points):
            found = hand_rotation(arm[2], arm[4], arm[5])
            hand = hand if found is None else found
            hands[i] = hand
        return cls(t, points[:, 0], points[:, 1], points[:, 2], matrix_to_quaternion(hands))

    def wrist_at(self, times: Array) -> Array:
        """Return the wrist positions (m, 3) [m] at ``times`` (m,) [s].

        Before and after the recording, the wrist is at rest.
        """
        return np.column_stack([np.interp(times, self.times, column) for column in self.wrist.T])


def seen_arm(skeletons: Sequence[Skeleton], times: ArrayLike, correspondence: Correspondence) -> TrueArm:
    """Return a person's arm as the camera measured it, including noise, interpolated linearly between frames.

    If a run is compared with this arm, the camera's noise adds to the error of every method. A method with smooth
    output then appears slightly worse than it is.

    Args:
        skeletons: skeletons in order of time.
        times: times since the first skeleton, shape (n,) [s].
        correspondence: object that states the side of the arm and the pose of the sensor.

    Raises:
        TaskFailedError: when shoulder, elbow and wrist are never seen together.
    """
    arms = [arm for arm in (skeleton.arm(correspondence.side) for skeleton in skeletons) if arm.seen]
    if not arms:
        raise TaskFailedError(f"the {correspondence.side} arm is never seen; choose the other arm (--side)")
    t = np.asarray(times, dtype=float)
    at = np.array([arm.time for arm in arms]) - skeletons[0].time
    points = correspondence.sensor_to_base.apply(np.array([arm.points for arm in arms]).reshape(-1, 3))
    points = points.reshape(len(arms), -1, 3)
    between = np.stack(
        [np.column_stack([np.interp(t, at, points[:, joint, i]) for i in range(3)]) for joint in range(3)], axis=1
    )
    hands, hand = np.empty((len(arms), 3, 3)), np.eye(3)
    for i, (wrist, tip, thumb) in enumerate(points[:, [2, 4, 5]]):
        found = hand_rotation(wrist, tip, thumb)
        hand = hand if found is None else found
        hands[i] = hand
    newest = np.maximum(np.searchsorted(at, t + 1e-9, side="right") - 1, 0)
    return TrueArm(t, between[:, 0], between[:, 1], between[:, 2], matrix_to_quaternion(hands)[newest])


@dataclass(frozen=True, eq=False)
class EngagementPeriods:
    """The frames in which the robot was engaged (following, coasting or holding), and the starts of the engagements.

    Attributes:
        engaged: for each frame, whether the robot was engaged, shape (n,).
        start: for each engaged frame, the index of the last frame before the engagement began, shape (n,); undefined
            in all other frames.
        count: number of engagements.
    """

    engaged: Mask
    start: NDArray[np.intp]
    count: int

    @classmethod
    def of(cls, states: ArrayLike, *, first_only: bool = False) -> EngagementPeriods:
        """Find the engagements in a run from its states.

        Args:
            states: values of :class:`~imitarm.retarget.engagement.EngagementState` in each frame, shape (n,).
            first_only: whether to treat all frames from the start of the first engagement on as one engagement.
        """
        engaged = engaged_samples(states)
        begins = np.flatnonzero(engaged & ~np.concatenate([[False], engaged[:-1]]))
        frames = np.arange(len(engaged))
        if len(begins) == 0:
            return cls(engaged, np.zeros(len(engaged), dtype=np.intp), 0)
        if first_only:
            before = np.full(len(engaged), max(int(begins[0]) - 1, 0), dtype=np.intp)
            return cls(frames >= begins[0], before, 1)
        which = np.maximum(np.searchsorted(begins, frames, side="right") - 1, 0)
        return cls(engaged, np.maximum(begins[which] - 1, 0), len(begins))


def reference_positions(
    true: TrueArm, tool: Array, periods: EngagementPeriods, scale: float, lag: float = 0.0
) -> Array:
    r"""Return the correct position of the tool, which the clutch law computes from the true hand (docs/retargeting.md).

    .. math:: p(t) = p_{home} + \rho\,(W(t - lag) - W(t_e))

    Here, :math:`W` is the position of the true wrist, :math:`\rho` is the scale, :math:`t_e` is the time at which the
    engagement began, and :math:`p_{home}` is the position of the tool at the time :math:`t_e`.

    Args:
        true: the person's true arm, in the axes of the base.
        tool: positions of the tool, shape (n, 3) [m].
        periods: the engaged frames.
        scale: rho, displacement of the tool divided by the displacement of the wrist.
        lag: time by which the tool lags behind the wrist [s].

    Returns:
        Correct positions of the tool, shape (n, 3) [m]; undefined in frames that are not engaged.
    """
    return tool[periods.start] + scale * (true.wrist_at(true.times - lag) - true.wrist[periods.start])


def reference_rotations(true: TrueArm, quaternions: Array, periods: EngagementPeriods, orientation: str) -> Array:
    """Return the correct rotations of the tool (n, 4), wxyz; the clutch law computes them from the true hand.

    Args:
        true: the person's arm, in the axes of the base.
        quaternions: quaternions of the tool, wxyz, shape (n, 4).
        periods: the engaged frames.
        orientation: ``"hand"``, ``"upright"`` or ``"fixed"``, see
            :class:`~imitarm.retarget.correspondence.Correspondence`.
    """
    home = quaternions[periods.start]
    if orientation == "fixed":
        return home
    rotation = quaternion_multiply(true.hand, quaternion_conjugate(true.hand[periods.start]))
    if orientation == "upright":
        rotation = rotation * np.array([1.0, 0.0, 0.0, 1.0])
        length = np.linalg.norm(rotation, axis=1, keepdims=True)
        rotation = np.where(length < 1e-9, [1.0, 0.0, 0.0, 0.0], rotation / np.maximum(length, 1e-9))
    return quaternion_multiply(rotation, home)


def rms(errors: ArrayLike) -> float:
    """Return the root mean square of numbers (n,), or of the norms of vectors (n, d); nan if there are none."""
    values = np.asarray(errors, dtype=float)
    if len(values) == 0:
        return float("nan")
    squares = values * values if values.ndim == 1 else np.sum(values * values, axis=1)
    return float(np.sqrt(np.mean(squares)))


def best_lag(true: TrueArm, tool: Array, periods: EngagementPeriods, scale: float) -> tuple[float, float]:
    """Return the constant lag that explains the tool's motion best [s], and the RMS error after removing this lag [m].

    Lags from -0.1 to 0.8 s are tried. A parabola is fitted to the smallest error and the errors of the two neighbouring
    lags. The best lag is the minimum of this parabola. The lag and the error are nan if no frame is engaged. The lag is
    also nan if the hand did not move.
    """
    engaged = periods.engaged
    if not engaged.any():
        return float("nan"), float("nan")
    errors = np.array([rms((tool - reference_positions(true, tool, periods, scale, lag))[engaged]) for lag in LAGS])
    if not np.ptp(true.wrist[engaged], axis=0).max() > _MOVES:
        return float("nan"), float(errors[np.argmin(np.abs(LAGS))])
    i = int(np.argmin(errors))
    if i in {0, len(LAGS) - 1}:
        return float(LAGS[i]), float(errors[i])
    before, here, after = errors[i - 1 : i + 2] ** 2
    curved = before - 2.0 * here + after
    shift = 0.5 * (before - after) / curved if curved > 0.0 else 0.0
    lag = float(LAGS[i] + shift * (LAGS[1] - LAGS[0]))
    return lag, rms((tool - reference_positions(true, tool, periods, scale, lag))[engaged])


def target_lag(times: ArrayLike, tool: ArrayLike, targets: ArrayLike) -> float:
    """Return the constant lag, from 0 to 0.8 s, that explains best how a tool follows its target [s].

    Args:
        times: evenly spaced times, shape (n,) [s].
        tool: positions, shape (n, 3) [m].
        targets: target positions, shape (n, 3) [m]; nan where there is no target.

    Returns:
        The lag; nan when there is no target, the target does not move, or the tool does not follow the target. The tool
        counts as following if, at some lag, its RMS error is at most half of the target's own spread. The spread is the
        RMS distance of the target from its mean position.
    """
    t, p, aim = (np.asarray(values, dtype=float) for values in (times, tool, targets))
    known = np.isfinite(aim).all(axis=1)
    if not known.any() or not np.ptp(aim[known], axis=0).max() > _STILL:
        return float("nan")
    motion = rms(aim[known] - aim[known].mean(axis=0))
    dt, errors = float(t[1] - t[0]), {}
    for lag in np.abs(LAGS[LAGS >= 0.0]):  # abs: there is a -0.0 among them
        steps = round(float(lag) / dt)
        both = known[: len(p) - steps]  # the target then, the tool now
        if both.any():
            errors[float(lag)] = rms((p[steps:] - aim[: len(p) - steps])[both])
    best = min(errors, key=errors.__getitem__)
    return best if errors[best] < _FOLLOWS * motion else float("nan")


def rotation_errors(first: Array, second: Array) -> Array:
    """Return the angles between two series of quaternions wxyz (n, 4), shape (n,) [rad]."""
    both = quaternion_multiply(quaternion_conjugate(first), second)
    return 2.0 * np.arctan2(np.linalg.norm(both[:, 1:], axis=1), np.abs(both[:, 0]))


def elbow_direction_errors(true: TrueArm, sew: Array, periods: EngagementPeriods) -> Array:
    """Return the angle between the actual and the correct direction of the robot's upper arm, shape (n,) [rad].

    Let R be the smallest rotation that takes the direction of the person's upper arm at the start of the engagement to
    its current direction. The correct direction is R applied to the direction of the robot's upper arm at the start of
    the engagement.

    Args:
        true: the person's arm, in the axes of the base.
        sew: robot's shoulder, elbow and wrist, shape (n, 3, 3) [m].
        periods: the engaged frames.
    """
    person, robot = _unit(true.elbow - true.shoulder), _unit(sew[:, 1] - sew[:, 0])
    wanted = _rotated(person[periods.start], person, robot[periods.start])
    return np.arctan2(np.linalg.norm(np.cross(wanted, robot), axis=1), np.sum(wanted * robot, axis=1))


def elbow_angle_errors(true: TrueArm, sew: Array, periods: EngagementPeriods) -> Array:
    """Return the errors of the robot's SEW angle, the swivel angle of the elbow.

    An error is the absolute difference between two changes since the engagement began: the change of the robot's angle,
    and the change of the person's angle.

    Args:
        true: the person's arm, in the axes of the base.
        sew: robot's shoulder, elbow and wrist, shape (n, 3, 3) [m].
        periods: the engaged frames.

    Returns:
        Errors, shape (n,) [rad], 0 to pi; nan where the person's or the robot's arm is too straight for a well-defined
        swivel angle.
    """
    person = sew_derivatives(true.shoulder, true.elbow, true.wrist)
    robot = sew_derivatives(sew[:, 0], sew[:, 1], sew[:, 2])
    off = (robot.angle - robot.angle[periods.start]) - (person.angle - person.angle[periods.start])
    bent = (person.bend > _BENT) & (robot.bend > _BENT)
    return np.where(bent, np.abs(np.angle(np.exp(1j * np.nan_to_num(off)))), np.nan)


def motion_end(times: ArrayLike, positions: ArrayLike, radius: float = 0.01, rest: float = 0.5) -> float:
    """Return the time from which on a point stays within ``radius`` of its final position [s].

    The final position is the mean of the positions in the last ``rest`` seconds.

    Args:
        times: time stamps, shape (n,) [s].
        positions: positions of the point, shape (n, 3) [m].
        radius: largest distance from the final position [m].
        rest: duration of the final part over which the mean is taken [s].
    """
    t, p = np.asarray(times, dtype=float), np.asarray(positions, dtype=float)
    away = np.linalg.norm(p - p[t >= t[-1] - rest].mean(axis=0), axis=1)
    outside = np.flatnonzero(away > radius)
    return float(t[0] if len(outside) == 0 else t[min(outside[-1] + 1, len(t) - 1)])


def settling_time(
    times: ArrayLike, positions: ArrayLike, goal: ArrayLike, end: float, radius: float = 0.01, stay: float = 0.5
) -> float:
    """Return the time from ``end`` until a point is within ``radius`` of the goal and stays there for ``stay`` seconds.

    Args:
        times: evenly spaced times, shape (n,) [s].
        positions: shape (n, 3) [m].
        goal: goal position, shape (3,) [m].
        end: time at which the motion towards the goal ended [s].
        radius: largest distance to the goal [m].
        stay: time for which the point must stay within ``radius`` [s].

    Returns:
        The time [s], at least 0; nan if the point does not stay within ``radius`` for ``stay`` seconds in the recording
        after ``end``.
    """
    t = np.asarray(times, dtype=float)
    inside = np.linalg.norm(np.asarray(positions, dtype=float) - np.asarray(goal, dtype=float), axis=1) <= radius
    steps = max(round(stay / float(t[1] - t[0])), 1)
    count = np.concatenate([[0], np.cumsum(inside)])
    stays = count[steps:] - count[:-steps] == steps
    found = np.flatnonzero(stays & (t[: len(stays)] >= end - 1e-9))
    return float("nan") if len(found) == 0 else max(float(t[found[0]]) - end, 0.0)


def _unit(vectors: Array) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _rotated(before: Array, after: Array, vectors: Array) -> Array:
    """Return vectors (n, 3), rotated by the smallest rotations that take the unit vectors ``before`` to ``after``."""
    both = before + after
    factor = np.sum(both * vectors, axis=1) / np.maximum(1.0 + np.sum(before * after, axis=1), 1e-12)
    return vectors - factor[:, None] * both + 2.0 * np.sum(before * vectors, axis=1, keepdims=True) * after
