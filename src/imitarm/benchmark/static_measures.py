"""Measure a planned path of the tool in a static scene, with code that the compared methods do not use.

The distances to the obstacles are computed at 4000 points of the path, which are closer together than the samples of
the plan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from imitarm.benchmark.refusal_question import Question, separation
from imitarm.benchmark.static_scenes import StaticCase
from imitarm.evaluation.motion import log_dimensionless_jerk, spectral_arc_length
from imitarm.kinematics.pose import rotate
from imitarm.policies.component_path import TOLERANCE_FLOOR
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

DENSE = 4000
"""Number of points of the path, evenly spaced in time, at which distances to the obstacles are computed."""
NEAR = 0.10
"""A sample of the learned path is unaffected if a tool at this sample is farther than this distance from every obstacle
[m]."""
AT_GOAL = 0.005
"""Largest permitted distance from start, goal and contact points, and largest displacement in a forbidden direction
[m]."""
LATEST = 2.0
"""Longest permitted duration of a successful motion, divided by the learned duration."""
MAX_SPEED, MAX_ACCELERATION = 1.7, 13.0
"""Limits of the tool's speed [m/s] and acceleration [m/s^2], which the manufacturer of the Panda states. A plan is
slowed down at the times at which it exceeds a limit (:meth:`~imitarm.policies.PathPlan.within`). If the plan still
exceeds a limit, the whole plan is slowed down by one factor. The path does not change."""
SLACK = 0.0005
"""Tolerance of the clearance [m]. A path keeps the required clearance if its clearance is at most this much smaller."""
_SAMPLES = 200  # of the learned path, and of a planned path for speed, acceleration and smoothness


@dataclass(frozen=True)
class PathMeasures:
    """Measures of one path.

    Attributes:
        clearance: smallest distance between tool and obstacles, at :data:`DENSE` points of the path [m].
        separation: lower bound of ``clearance``, computed from separating planes instead of a distance function [m].
        start_error: distance of the first position from the learned start [m].
        goal_error: distance of the last position from the goal [m].
        contact_error: largest distance between the path and a pinned point, which the path must meet [m]; 0 if no point
            is pinned.
        forbidden: largest displacement of the path in a forbidden direction [m]. The displacement of a sample is
            measured from two points of the learned path: the nearest point, and the point at the same fraction of the
            duration. The smaller value counts.
        max_speed: largest speed of the planned motion [m/s].
        max_acceleration: largest acceleration of the planned motion [m/s^2].
        slowdown: factor by which the whole plan is slowed down to keep its limits; at least 1.
        duration: duration of the motion [s]: ``slowdown`` times the duration of the plan.
        duration_ratio: ``duration`` divided by the learned duration.
        rmse: root mean square distance between planned and learned path at equal fractions of their durations [m]
            (thesis Eq 4.9, with the square root).
        rmse_unaffected: like ``rmse``, but only over the samples of the learned path at which the tool is farther than
            :data:`NEAR` from every obstacle [m]; nan if there is no such sample.
        path_rmse: root mean square distance from each sample of the learned path to the nearest point of the planned
            path [m]. It does not depend on the timing.
        deviation: largest displacement from the learned path, in standard deviations of the demonstrations (Mahalanobis
            distance).
        length_ratio: path length divided by the length of the learned path.
        sparc: spectral arc length of the speed; a value closer to 0 means a smoother motion.
        ldlj: logarithmic dimensionless jerk; a value closer to 0 means a smoother motion.
    """

    clearance: float
    separation: float
    start_error: float
    goal_error: float
    contact_error: float
    forbidden: float
    max_speed: float
    max_acceleration: float
    slowdown: float
    duration: float
    duration_ratio: float
    rmse: float
    rmse_unaffected: float
    path_rmse: float
    deviation: float
    length_ratio: float
    sparc: float
    ldlj: float


def measure(case: StaticCase, trajectory: Trajectory) -> PathMeasures:
    """Measure a planned path of the tool in its scene."""
    skill = case.skill
    times = np.linspace(0.0, skill.duration_, _SAMPLES)
    nominal = skill.nominal(times, None, case.scene.goal)
    dense = _dense(trajectory)
    there = trajectory.at(trajectory.times[0] + times / skill.duration_ * trajectory.duration)[0]
    offset = there - nominal.positions
    away = np.linalg.norm(offset, axis=1)
    free = unaffected(case, nominal)
    tree = cKDTree(dense.positions)
    pins = skill.nominal(np.unique([0.0, *case.pinned, skill.duration_]), None, case.scene.goal).positions[1:-1]
    even = evenly(trajectory)
    dt = even.duration / (len(even) - 1)
    speed = np.linalg.norm(np.diff(even.positions, axis=0), axis=1) / dt
    fastest, sudden = (
        float(speed.max()),
        float(np.linalg.norm(np.diff(even.positions, 2, axis=0), axis=1).max()) / dt**2,
    )
    slowdown = max(1.0, fastest / MAX_SPEED, math.sqrt(sudden / MAX_ACCELERATION))
    return PathMeasures(
        clearance=tool_clearance(case, dense),
        separation=_separation(case, trajectory),
        start_error=float(np.linalg.norm(trajectory.positions[0] - nominal.positions[0])),
        goal_error=float(np.linalg.norm(trajectory.positions[-1] - nominal.positions[-1])),
        contact_error=float(np.max(tree.query(pins)[0], initial=0.0)),
        forbidden=_forbidden(case, dense),
        max_speed=fastest,
        max_acceleration=sudden,
        slowdown=slowdown,
        duration=slowdown * trajectory.duration,
        duration_ratio=slowdown * trajectory.duration / skill.duration_,
        rmse=_rms(away),
        rmse_unaffected=_rms(away[free]),
        path_rmse=_rms(tree.query(nominal.positions)[0]),
        deviation=_deviation(offset, skill.gmr_.predict(times)[1]),
        length_ratio=trajectory.path_length / nominal.path_length,
        sparc=spectral_arc_length(speed, dt),
        ldlj=log_dimensionless_jerk(even.positions, dt),
    )


def _dense(trajectory: Trajectory) -> Trajectory:
    """Return the polyline at :data:`DENSE` evenly spaced times, and at its own samples."""
    times = np.union1d(np.linspace(trajectory.times[0], trajectory.times[-1], DENSE), trajectory.times)
    return Trajectory(times, *trajectory.at(times))


def evenly(trajectory: Trajectory) -> Trajectory:
    """Fit a cubic spline through the samples of a trajectory, and return the spline at 200 evenly spaced times.

    The paths of all methods then have the same number of samples, so that their finite differences can be compared.
    """
    times = np.linspace(trajectory.times[0], trajectory.times[-1], _SAMPLES)
    return Trajectory(times, CubicSpline(trajectory.times, trajectory.positions)(times))


def tool_clearance(case: StaticCase, trajectory: Trajectory) -> float:
    """Return the smallest distance from the spheres of the tool to an obstacle, at the samples of a path [m]."""
    return float((_sphere_distances(case, trajectory)).min(initial=np.inf))


def _sphere_distances(case: StaticCase, trajectory: Trajectory) -> Array:
    """Return the distance of each sphere of the tool from the nearest obstacle, shape (n_spheres, n) [m]."""
    found = []
    for sphere in case.tool_spheres:
        centers = trajectory.positions
        if trajectory.quaternions is not None:
            centers = centers + rotate(trajectory.quaternions, np.broadcast_to(sphere[:3], centers.shape))
        found.append(case.scene.clearance(centers) - sphere[3])
    return np.array(found)


def unaffected(case: StaticCase, nominal: Trajectory) -> NDArray[np.bool_]:
    """Return which samples of the learned path are unaffected, see :data:`NEAR`."""
    return np.asarray(_sphere_distances(case, nominal).min(axis=0) > NEAR)


def _separation(case: StaticCase, trajectory: Trajectory) -> float:
    if not case.scene.obstacles:
        return float("inf")
    if trajectory.quaternions is None and case.tool_spheres[:, :3].any():
        return float("nan")  # the rotation of the tool is not known
    question = Question(
        trajectory,
        np.empty((len(trajectory), 0)),
        case.scene.obstacles,
        case.tool_spheres,
        0.0,
        np.empty((0, 3)),
        (),
    )
    return separation(question, trajectory.times, trajectory.positions)


def _forbidden(case: StaticCase, path: Trajectory) -> float:
    if not case.forbidden:
        return 0.0
    phase = (path.times - path.times[0]) / path.duration
    learned = case.skill.nominal(np.linspace(0.0, case.skill.duration_, DENSE), None, case.scene.goal)
    same = learned.at(phase * case.skill.duration_)[0]
    nearest = learned.positions[cKDTree(learned.positions).query(path.positions)[1]]
    unit = np.array(case.forbidden) / np.linalg.norm(case.forbidden, axis=1, keepdims=True)
    by_phase, by_place = ((path.positions - points) @ unit.T for points in (same, nearest))
    return float(np.minimum(by_phase, by_place).max(initial=0.0))


def _deviation(offset: Array, covariances: Array) -> float:
    """Return the largest Mahalanobis distance of offsets (n, 3) [m] for covariances (n, 3, 3) [m^2].

    The standard deviation in every direction is at least :data:`TOLERANCE_FLOOR`.
    """
    values, vectors = np.linalg.eigh(covariances)
    along = np.einsum("nde,nd->ne", vectors, offset)
    return float(np.sqrt((along**2 / np.maximum(values, TOLERANCE_FLOOR**2)).sum(axis=1)).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def outcome(case: StaticCase, found: PathMeasures) -> tuple[str, str]:
    """Return the outcome of a planned path, one of :data:`OUTCOMES`, and an explanation."""
    if not found.clearance > 0.0:
        return "contact", f"the smallest distance between tool and obstacles is {1e3 * found.clearance:.1f} mm"
    for error, limit, where in (
        (found.start_error, AT_GOAL, "from the start"),
        (found.goal_error, AT_GOAL, "from the goal"),
        (found.contact_error, AT_GOAL, "from a contact point"),
        (found.forbidden, AT_GOAL, "away from the learned path in a forbidden direction"),
    ):
        if error > limit:
            return "missed goal", f"the path is {1e3 * error:.1f} mm {where}"
    if found.duration_ratio > LATEST:
        planned = found.duration_ratio / found.slowdown
        if planned <= LATEST:
            fast = f"the plan reaches {found.max_speed:.2f} m/s and {found.max_acceleration:.1f} m/s^2"
            return (
                "limit",
                f"{fast}; within the limits, the motion takes {found.duration_ratio:.2f} times the learned duration",
            )
        return "late", f"the planned motion takes {planned:.2f} times the learned duration"
    if found.clearance < case.clearance - SLACK:
        return "too near", f"the clearance is {1e3 * found.clearance:.1f} mm instead of {1e3 * case.clearance:.0f} mm"
    return "success", ""


OUTCOMES = ("success", "too near", "contact", "missed goal", "late", "limit", "refused", "failed")
"""Possible outcomes of a plan:

* "success": the path meets all conditions.
* "too near": the same, but the path comes nearer to an obstacle than required.
* "contact": the tool touches an obstacle.
* "missed goal": the path misses the goal, the start or a contact point, or is displaced in a forbidden direction.
* "late": the planned motion takes too long.
* "limit": the motion takes too long after it was slowed down to keep the limits of speed and acceleration.
* "refused": the method refused the scene.
* "failed": the method raised an error.
"""
SUCCESSES = OUTCOMES[:2]
"""Outcomes that count as a success."""
