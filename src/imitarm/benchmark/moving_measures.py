"""Measure a motion of the tool among moving obstacles, with the true positions of the obstacles."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.moving_scenes import MovingCase, distances_in_time
from imitarm.benchmark.moving_world import DT, Seen, ToolRun
from imitarm.benchmark.static_measures import AT_GOAL, LATEST, MAX_ACCELERATION, MAX_SPEED, NEAR, SLACK, evenly
from imitarm.command import Status
from imitarm.evaluation.motion import log_dimensionless_jerk, path_length, spectral_arc_length
from imitarm.scene import Scene
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

PER_PERIOD = 2
"""Number of instants per control period at which the true distance to the obstacles is computed."""
OUTCOMES = ("success", "too near", "contact", "missed goal", "late", "refused", "failed")
"""Possible outcomes of a run:

* "success": the tool touched nothing and reached the goal.
* "too near": the same, but the tool came nearer to an obstacle than required.
* "contact": the tool touched an obstacle.
* "missed goal": the policy ended the motion away from the goal.
* "late": the tool had not arrived after twice the learned duration.
* "refused": the policy refused the task before any motion.
* "failed": the method raised an error.
"""
SUCCESSES = OUTCOMES[:2]
"""Outcomes that count as a success. The simulation itself limits the speed and the acceleration of the tool."""
_STALLED = 0.02  # [m/s] a tool slower than this stands
_TRACKED = 0.15  # [m] a track farther than this from an obstacle belongs to something else
_LOOKS = 0.10  # [s] before a contact, at which its cause is determined
_WRONG = 0.03  # [m] an error of a track that explains a contact
_FULL = 0.5  # of the largest deceleration: braking


@dataclass(frozen=True)
class Contact:
    """One contact of the tool with an obstacle.

    Attributes:
        obstacle: name of the obstacle.
        time: time at which the contact begins [s].
        obstacle_speed: speed at which the obstacle's surface approaches the tool [m/s].
        tool_speed: speed at which the tool approaches the obstacle [m/s]; negative if the tool moves away from the
            obstacle.
        braking: whether the tool stands, or brakes with at least half of its largest deceleration.
        status: status of the policy's command at the contact.
        cause: explanation, see :func:`contacts`.
    """

    obstacle: str
    time: float
    obstacle_speed: float
    tool_speed: float
    braking: bool
    status: str
    cause: str


def measured(case: MovingCase, run: ToolRun) -> tuple[str, str, dict[str, Any]]:
    """Measure a run.

    Returns:
        The outcome, one of :data:`OUTCOMES`; an explanation; and the measures by name:

        * ``clearance``: smallest true distance of the tool from an obstacle [m];
        * ``goal_error``: distance from the goal at the end [m];
        * ``duration``, ``duration_ratio``: duration of the motion [s], and this duration divided by the learned
          duration;
        * ``rmse``: root mean square distance between the motion and the learned motion at equal times [m]. After its
          end, the learned motion stays at the goal.
        * ``rmse_unaffected``: like ``rmse``, but only at times at which a tool on the learned path would be farther
          than 10 cm from every obstacle [m];
        * ``path_rmse``: root mean square distance from the nearest point of the learned path [m], so delays do not
          count;
        * ``stall``: longest time for which the tool stands between start and goal [s];
        * ``length_ratio``: path length divided by the length of the learned path;
        * ``sparc``, ``ldlj``: smoothness, as spectral arc length and as logarithmic dimensionless jerk;
        * ``max_speed``, ``max_acceleration``: largest speed and acceleration of the tool [m/s], [m/s^2];
        * ``step_median``, ``step_p99``: computing time of a step, median and 99th percentile [s]; ``reset_seconds``:
          computing time of the reset [s];
        * ``position_error``, ``velocity_error``: root mean square errors of the tracked obstacles [m], [m/s];
        * ``nees``: mean squared error of the tracked positions, normalised by their covariance; 3 if the covariance is
          right;
        * ``switches``: number of times that a tracked obstacle gets a new track number;
        * ``unseen``: fraction of the time in which an obstacle has no track, over all obstacles;
        * ``contacts``: list of :class:`Contact` as dictionaries.
    """
    values: dict[str, Any] = {"step_median": math.nan, "step_p99": math.nan, "reset_seconds": run.reset_seconds}
    if run.step_seconds:
        values["step_median"] = float(np.median(run.step_seconds))
        values["step_p99"] = float(np.quantile(run.step_seconds, 0.99))
    values.update(tracking(case, run.seen))
    if run.refusal:
        return "refused", run.refusal, values
    times, points = _dense(run)
    gap = distances_in_time(case.truth, times, points) - case.tool_spheres[0, 3]
    values.update(motion_measures(case, run, times, gap))
    touched = contacts(case, run, times, points, gap)
    values["contacts"] = [asdict(contact) for contact in touched]
    values["clearance"] = float(gap.min())
    return *_outcome(case, run, values, touched), values


def _outcome(case: MovingCase, run: ToolRun, values: dict[str, Any], touched: list[Contact]) -> tuple[str, str]:
    if touched:
        first = touched[0]
        return "contact", f"{first.obstacle} at {first.time:.2f} s: {first.cause}"
    error = float(values["goal_error"])
    if not run.arrived:
        why = f": {run.last.reason}" if run.last.reason else ""
        return "late", f"{1e3 * error:.0f} mm from the goal after {LATEST:g} times the learned duration{why}"
    if error > AT_GOAL:
        return "missed goal", f"the policy ends the motion {1e3 * error:.1f} mm from the goal"
    if values["clearance"] < case.clearance - SLACK:
        return "too near", f"{1e3 * values['clearance']:.1f} mm instead of {1e3 * case.clearance:.0f} mm"
    return "success", ""


def _dense(run: ToolRun) -> tuple[Array, Array]:
    """Return times and positions, with :data:`PER_PERIOD` samples in each control period."""
    n = PER_PERIOD * (len(run.times) - 1) + 1
    times = np.linspace(run.times[0], run.times[-1], n)
    return times, np.stack([np.interp(times, run.times, column) for column in run.positions.T], axis=1)


def motion_measures(case: MovingCase, run: ToolRun, times: Array, gap: Array) -> dict[str, float]:
    """Return the measures of the motion, see :func:`measured`.

    ``gap`` is the gap between the tool and each obstacle at ``times``, shape (n_obstacles, n) [m].
    """
    skill = case.skill
    goal, T = skill.goal_.position, skill.duration_
    nominal = skill.nominal(np.linspace(0.0, T, 400))
    learned = nominal.at(np.minimum(run.times, T))[0]
    away = np.linalg.norm(run.positions - learned, axis=1)
    free = distances_in_time(case.truth, run.times, learned).min(axis=0) - case.tool_spheres[0, 3] > NEAR
    nearest = np.linalg.norm(run.positions[:, None] - nominal.positions[None, ::2], axis=2).min(axis=1)
    velocity = np.diff(run.positions, axis=0) / DT
    speed = np.linalg.norm(velocity, axis=1)
    found = {
        "goal_error": float(np.linalg.norm(run.positions[-1] - goal)),
        "duration": float(run.times[-1]),
        "duration_ratio": float(run.times[-1]) / T,
        "rmse": _rms(away),
        "rmse_unaffected": _rms(away[free]),
        "path_rmse": _rms(nearest),
        "stall": _longest_stall(run, speed, goal),
        "length_ratio": path_length(run.positions) / nominal.path_length,
        "max_speed": float(speed.max(initial=0.0)),
        "max_acceleration": float(np.linalg.norm(np.diff(velocity, axis=0), axis=1).max(initial=0.0)) / DT,
        "sparc": math.nan,
        "ldlj": math.nan,
    }
    if len(run.times) > 10 and speed.max() > _STALLED:
        even = evenly(Trajectory(run.times, run.positions))
        step = even.duration / (len(even) - 1)
        found["ldlj"] = log_dimensionless_jerk(even.positions, step)
        found["sparc"] = spectral_arc_length(np.linalg.norm(np.diff(even.positions, axis=0), axis=1) / step, step)
    return found


def _longest_stall(run: ToolRun, speed: Array, goal: Array) -> float:
    """Return the longest time for which the tool stands between its start and its arrival at the goal [s]."""
    stands = speed < _STALLED
    started = np.flatnonzero(~stands)
    if not len(started):
        return float(run.times[-1])
    away = np.linalg.norm(run.positions[:-1] - goal, axis=1) > 2.0 * AT_GOAL
    counts = np.where(stands & away & (np.arange(len(stands)) > started[0]), 1, 0)
    edges = np.diff(np.concatenate([[0], counts, [0]]))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return DT * float(np.max(lengths, initial=0))


def contacts(case: MovingCase, run: ToolRun, times: Array, points: Array, gap: Array) -> list[Contact]:
    """Return the first contact with each obstacle, and its cause.

    The cause is the first entry of this list that is true:

    * "not tracked": the obstacle had no track 0.1 s before the contact;
    * "wrong track": 0.1 s before the contact, the track was more than 3 cm away from the obstacle;
    * "the obstacle moves into the tool": the tool stands or moves away from the obstacle;
    * "braked too late": the tool brakes;
    * "the tool moves into the obstacle": all other cases.
    """
    found = []
    scene = case.truth.scene
    for i in range(len(gap)):
        inside = np.flatnonzero(gap[i] <= 0.0)
        if not len(inside):
            continue
        k = int(inside[0])
        time, step = float(times[k]), max(k // PER_PERIOD - 1, 0)
        velocity = np.diff(run.positions, axis=0) / DT
        now, before = velocity[min(step, len(velocity) - 1)], velocity[max(step - 1, 0)]
        normal = case.truth.at(time).obstacles[i].distance_and_gradient(points[k])[1]
        closing = -float(gap[i, k] - gap[i, max(k - 1, 0)]) / float(times[1] - times[0]) if k else 0.0
        towards = -float(normal @ now)
        speed = float(np.linalg.norm(now))
        slows = (float(np.linalg.norm(before)) - speed) / DT >= _FULL * MAX_ACCELERATION
        braking = speed < _STALLED or slows
        cause = _cause(case, run.seen, i, time, towards, braking=braking)
        status = run.statuses[min(step, len(run.statuses) - 1)] if run.statuses else Status.NOMINAL
        name = scene.name_of(i)
        found.append(Contact(name, time, closing - towards, towards, braking, status.value, cause))
    return sorted(found, key=lambda contact: contact.time)


def _cause(case: MovingCase, seen: list[Seen], i: int, time: float, towards: float, *, braking: bool) -> str:
    looked = [observed for observed in seen if observed.time <= time - _LOOKS]
    if not looked:
        return "not tracked"
    last = looked[-1]
    true = case.truth.poses(last.time)[0][i]
    error = np.linalg.norm(last.positions - true, axis=1)
    if not len(error) or error.min() > _TRACKED:
        return "not tracked"
    if error.min() > _WRONG:
        return "wrong track"
    if towards <= _STALLED:
        return "the obstacle moves into the tool"
    return "braked too late" if braking else "the tool moves into the obstacle"


def tracking(case: MovingCase, seen: list[Seen]) -> dict[str, float]:
    """Return the errors of the tracked obstacles, see :func:`measured`.

    The nearest track within 15 cm of an obstacle counts as the track of this obstacle. Obstacles more than 5 m away are
    left out.
    """
    squares, speeds, nees, missing, switches, total = [], [], [], 0, 0, 0
    last: dict[int, int] = {}
    for observed in seen:
        truth = case.truth.at(observed.time).packed
        for i in np.flatnonzero(np.linalg.norm(truth.positions, axis=1) < _WITHIN):
            total += 1
            errors = observed.positions - truth.positions[i]
            away = np.linalg.norm(errors, axis=1)
            if not len(away) or away.min() > _TRACKED:
                missing += 1
                continue
            j = int(np.argmin(away))
            squares.append(away[j] ** 2)
            speeds.append(float(np.sum((observed.velocities[j] - truth.velocities[i]) ** 2)))
            covariance = observed.covariances[j]
            if np.trace(covariance) > 0.0:
                nees.append(float(errors[j] @ np.linalg.solve(covariance, errors[j])))
            number = int(observed.track_ids[j])
            switches += last.get(int(i), number) != number
            last[int(i)] = number
    return {
        "position_error": math.sqrt(np.mean(squares)) if squares else math.nan,
        "velocity_error": math.sqrt(np.mean(speeds)) if speeds else math.nan,
        "nees": float(np.mean(nees)) if nees else math.nan,
        "switches": float(switches),
        "unseen": missing / total if total else 0.0,
    }


_WITHIN = 5.0  # [m] reach of the sensor


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def limits_kept(values: dict[str, Any]) -> bool:
    """Return whether the tool kept its limits of speed and acceleration."""
    fast, sudden = values.get("max_speed", 0.0), values.get("max_acceleration", 0.0)
    return bool(fast <= MAX_SPEED * (1.0 + 1e-9) and sudden <= MAX_ACCELERATION * (1.0 + 1e-6))


def truth_of(case: MovingCase) -> Scene:
    """Return the true scene at time 0."""
    return case.truth.at(0.0)
