"""The world of the moving benchmark with a whole arm: a simulated robot with a safety filter and a sensor."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.moving_measures import Contact, motion_measures, tracking
from imitarm.benchmark.moving_scenes import LONGEST, MovingCase, distances_in_time, moving_case
from imitarm.benchmark.moving_world import DT, Seen, ToolRun
from imitarm.benchmark.static_measures import AT_GOAL, LATEST, SLACK
from imitarm.command import Command
from imitarm.control_loop import Step, reproduce
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.demonstrations import align, read
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.perception import ObstacleTracker
from imitarm.policies.policy import Observation, Policy
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene, standard_fixtures
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS
from imitarm.tasks.watching import delayed, watched
from imitarm.trajectory import Rollout

Array = NDArray[np.float64]

ROBOTS = {"sawyer": "brush", "panda": "gripper"}
"""Name of each arm, and the name of the tool that it holds."""
OBSERVERS = ("sensor", "camera")
"""How the obstacles are observed: by the simulated sensor or by two depth cameras."""
_EYES = ((1.9, -0.5, 1.1), (-0.9, 1.4, 1.6))  # [m] the cameras: in front of the path, and behind the arm
_MIDDLES = ((0.6, -0.05, 0.0), (0.2, 0.0, 0.1))  # [m] the points at which they look
_WORKSPACE = ((-0.9, -1.2, -0.7), (1.5, 1.1, 1.3))  # [m] in which the cameras' detector searches for obstacles
_CAMERA_MARGIN = 0.01  # [m] added to the required clearance, because shapes from a camera are a little too small
_SPARE = 0.01  # [m] beyond the required clearance, at the start and at the goal
_ANGLES = (-0.8, -0.4, 0.0, 0.4, 0.8)  # [rad] of the first joint, from the start
_INTERVAL = 0.05  # [s] between the instants at which the base is checked
_STILL = 0.05  # [rad/s] joints slower than this stand


@lru_cache(maxsize=4)
def prepared(robot: str) -> tuple[Skill, ArmModel, Array]:
    """Return the skill 'sweep' of the package, the arm with its tool, and the start posture."""
    skill, arm = Skill().fit(align(read(DEMONSTRATIONS))), ArmModel.load(robot, tool=ROBOTS[robot])
    rotation = arm.tool_pose(arm.home).quaternion
    end = skill.start_
    start = find_posture(arm, Pose(end.position, end.quaternion if skill.gmr_.has_orientation_ else rotation))
    return skill, arm, start


def arm_case(robot: str, family: str, seed: int) -> MovingCase:
    """Return a scene around the path of the skill 'sweep'.

    No obstacle overlaps the arm at the start, or its tool at the goal. No obstacle comes near the base of the arm or
    its first link during the run, because these parts can't evade an obstacle. If the scene of a seed breaks these
    rules, the scene of a seed that is 10 000 larger replaces it.

    Raises:
        InputError: when none of 20 seeds gives a scene that keeps these rules.
    """
    skill, arm, start = prepared(robot)
    centers, radii = arm.collision_spheres(start)
    goal = skill.goal_ if skill.gmr_.has_orientation_ else Pose(skill.goal_.position, arm.tool_pose(start).quaternion)
    tool = goal.apply(arm.tool_spheres[:, :3])
    for number in range(seed, seed + 200_000, 10_000):
        case = moving_case(family, 3, number, skill=skill)
        early = _least_gap(case, np.linspace(-0.5, 0.3, 9), centers, radii)
        late = _least_gap(case, skill.duration_ * np.linspace(1.0, LONGEST, 15), tool, arm.tool_spheres[:, 3])
        if min(early, late) > case.clearance + _SPARE and _leaves_base_free(case, arm, start):
            return case
    raise InputError(
        f"{family}, seed {seed}: in every scene that was tried, an obstacle is too near to the {robot}; "
        "choose another seed"
    )


def _leaves_base_free(case: MovingCase, arm: ArmModel, start: Array) -> bool:
    """Return whether no obstacle comes near the base or the first link, from before the start to the end of the run.

    The first joint only rotates the first link about its own axis, so this link is checked at several angles.
    """
    times = np.arange(-0.5, LATEST * case.skill.duration_, _INTERVAL)
    first = arm.cover.links == 1
    turned = [arm.collision_spheres(start + angle * np.eye(len(start))[0])[0][first] for angle in _ANGLES]
    fixed = np.concatenate([arm.cover.base_centers, *turned])
    radii = np.concatenate([arm.cover.base_radii, *[arm.cover.radii[first]] * len(_ANGLES)])
    reach = case.truth.scene.packed.radii
    obstacles = np.array([case.truth.poses(float(time))[0] for time in times])
    middle = fixed.mean(axis=0)
    size = float((np.linalg.norm(fixed - middle, axis=1) + radii).max())
    near = (np.linalg.norm(obstacles - middle, axis=2) - reach < size + case.clearance).any(axis=1)
    return not near.any() or _least_gap(case, times[near], fixed, radii) > case.clearance


def _least_gap(case: MovingCase, times: Array, centers: Array, radii: Array) -> float:
    """Return the smallest gap of standing spheres to the obstacles [m]."""
    gaps = [
        distances_in_time(case.truth, times, np.broadcast_to(c, (len(times), 3))).min() - r
        for c, r in zip(centers, radii, strict=True)
    ]
    return float(min(gaps))


class _Timed(Policy):
    """A policy whose steps are timed."""

    def __init__(self, policy: Policy, run: ToolRun) -> None:
        self._policy, self._run = policy, run

    def reset(self, observation: Observation) -> None:
        """Time the reset."""
        began = clock.perf_counter()
        self._policy.reset(observation)
        self._run.reset_seconds = clock.perf_counter() - began

    def step(self, observation: Observation, dt: float) -> Command:
        """Time a step, and note what was observed."""
        began = clock.perf_counter()
        command = self._policy.step(observation, dt)
        self._run.step_seconds.append(clock.perf_counter() - began)
        self._run.statuses.append(command.status)
        self._run.last = command
        if len(self._run.step_seconds) % 3 == 1:
            self._run.seen.append(Seen.of(observation.scene.now(observation.time), observation.time))
        return command

    def finished(self, observation: Observation) -> bool:
        """Return whether the policy has finished."""
        return self._policy.finished(observation)


def required(case: MovingCase, observer: str) -> float:
    """Return the clearance that policy and safety filter must keep from the observed obstacles [m]."""
    return case.clearance + (_CAMERA_MARGIN if observer == "camera" else 0.0)


def run_arm(
    policy: Policy, case: MovingCase, robot: str, sensor: SensorModel, observer: str = OBSERVERS[0]
) -> tuple[str, str, dict[str, Any]]:
    """Run a policy with an arm in a scene; return the outcome, its explanation, and the measures.

    The measures are the same as for a tool without an arm, with one difference: clearance and contacts are those of the
    whole arm, measured by the simulator. The safety filter keeps the required clearance for all links.

    Args:
        policy: the policy.
        case: the scene.
        robot: name of the arm.
        sensor: the simulated sensor; with a camera, only its seed is used.
        observer: one of :data:`OBSERVERS`.
    """
    _, arm, start = prepared(robot)
    seen = delayed(case.truth) if observer == "camera" else case.truth
    body = SimulatedRobot(arm, scene=seen.scene, motion=seen.motions, q=start)
    run, steps = ToolRun(), list[Step]()
    safety = SafetyFilter(arm, dt=DT, clearance=required(case, observer))
    tracker = ObstacleTracker("imm")
    observe: Callable[[float], Scene]
    if observer == "camera":
        fixtures = standard_fixtures()
        observe = watched(body, _EYES, _MIDDLES, _WORKSPACE, surfaces=fixtures, tracker=tracker, seed=sensor.seed)
    else:
        observe = TrackedScene(case.truth, sensor, tracker)
    try:
        rollout = reproduce(
            _Timed(policy, run),
            body,
            observe,
            dt=DT,
            safety=safety,
            timeout=LATEST * case.skill.duration_,
            on_step=steps.append,
        )
    except InfeasibleError as refusal:
        return "refused", str(refusal), {"reset_seconds": run.reset_seconds}
    return _measured(case, run, rollout, steps, body)


def _measured(
    case: MovingCase, run: ToolRun, rollout: Rollout, steps: list[Step], body: SimulatedRobot
) -> tuple[str, str, dict[str, Any]]:
    path = rollout.trajectory
    n = round(path.duration / DT)
    times = DT * np.arange(n + 1.0)
    run.times, run.positions = times, path.at(np.minimum(times, path.times[-1]))[0]
    run.arrived = rollout.reason == "finished" or rollout.reason.startswith(("clearance", "touched"))
    gap = distances_in_time(case.truth, run.times, run.positions)
    values: dict[str, Any] = {
        **tracking(case, run.seen),
        **motion_measures(case, run, run.times, gap),
        "reset_seconds": run.reset_seconds,
        "step_median": float(np.median(run.step_seconds)) if run.step_seconds else np.nan,
        "step_p99": float(np.quantile(run.step_seconds, 0.99)) if run.step_seconds else np.nan,
        "clearance": float(rollout.min_clearance),
        "unsafe": float(rollout.details["unsafe"]),
    }
    pairs = sorted(" with ".join(pair) for pair in rollout.details.get("contacts", ()))
    values["contacts"] = [asdict(_contact(pairs, steps))] if pairs else []
    if pairs:
        return "contact", "; ".join(pairs), values
    if rollout.reason.startswith("not finished"):
        return "late", rollout.reason, values
    if not rollout.success and not rollout.reason.startswith("clearance"):
        return "failed", rollout.reason, values
    if values["goal_error"] > AT_GOAL:
        return "missed goal", f"the motion ends {1e3 * values['goal_error']:.1f} mm from the goal", values
    if values["clearance"] < case.clearance - SLACK:
        return "too near", f"{1e3 * values['clearance']:.1f} mm instead of {1e3 * case.clearance:.0f} mm", values
    return "success", "", values


def _contact(pairs: list[str], steps: list[Step]) -> Contact:
    """Return the first contact; if the joints are at rest, the closing speed is attributed to the obstacle."""
    gaps = np.array([step.clearance for step in steps])
    k = int(np.argmax(gaps <= 0.0)) if (gaps <= 0.0).any() else int(np.argmin(gaps))
    closing = float(gaps[max(k - 1, 0)] - gaps[k]) / DT if k else 0.0
    step = steps[k]
    stands = float(np.abs(step.state.velocity).max()) < _STILL
    cause = "the obstacle moves into the arm" if stands else "the arm moves at the contact"
    if not step.safety.safe:
        cause += "; no velocity keeps all clearances"
    speeds = (closing, 0.0) if stands else (closing, float("nan"))
    return Contact(pairs[0], step.time, *speeds, stands, step.command.status.value, cause)
