"""Test policies with a simulated arm and random obstacles on the path: count arrivals, refusals and contacts.

A placement is a scene with one to three obstacles on the learned path of a skill. Every policy reproduces the skill
around these obstacles, with the same safety filter. The simulator measures clearance and contact with its own geometry.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.families import random_obstacle
from imitarm.benchmark.placement_results import (
    PlacementResult,
    Run,
    Setup,
    append_result,
    load_results,
    repaired,
)
from imitarm.benchmark.provenance import code_version
from imitarm.control_loop import reproduce
from imitarm.errors import InfeasibleError, InputError, UnreachableError
from imitarm.evaluation.path_style import path_style
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.policies import POLICIES
from imitarm.policies.adaptation import adapt
from imitarm.policies.component_path import TOLERANCE_FLOOR, ComponentPath
from imitarm.policies.whole_arm import links_apart
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Obstacle, Scene
from imitarm.skills import Skill
from imitarm.trajectory import Rollout, Trajectory

Array = NDArray[np.float64]

OUTCOMES = ("arrived", "refused", "waited", "too near", "touched", "stopped")
"""Possible outcomes of a placement:

* "arrived": the arm reached the goal and kept the clearance.
* "refused": the policy refused the placement before any motion.
* "waited": the motion was not finished in time.
* "too near": the arm reached the goal, but came nearer to an obstacle than permitted.
* "touched": the arm touched an obstacle or itself.
* "stopped": a protective stop or another failure ended the motion.
"""

CLEARANCE = 0.02  # [m] required
_DT = 0.01  # [s]
_PATIENCE = 4.0  # a reproduction may take this many times as long as the demonstrations
_SPREAD = 0.02  # [m] standard deviation of an obstacle's centre about the path
_FREE_ENDS = 0.01  # [m] beyond the clearance, that an obstacle leaves to the tool at start and goal
_TRIES = 200
_ALLOWANCE = 0.002  # [m] that ACFRA adds to the clearance when it plans for the tool alone


def placement(skill: Skill, arm: ArmModel, seed: int, start: Array) -> Scene:
    """Return a scene with one to three obstacles on the learned path. No obstacle touches the arm in its start posture.

    Args:
        skill: the skill with the learned path.
        arm: the arm. At the start and at the goal, no obstacle touches its tool.
        seed: seed of the scene, which also determines the number of obstacles: 1 + seed modulo 3.
        start: joint positions at the start, shape (n_joints,) [rad].

    Raises:
        InputError: when every place that was tried for an obstacle is too near to the start or to the goal.
    """
    rng = np.random.default_rng([31, seed])
    path = skill.generate()
    count = 1 + seed % 3
    chosen: list[Obstacle] = []
    for _ in range(_TRIES):
        sample = int(rng.integers(round(0.15 * len(path)), round(0.85 * len(path))))
        obstacle = random_obstacle(rng, path.positions[sample] + _SPREAD * rng.normal(size=3), planar=False)
        if min(_end_clearance(skill, arm, obstacle), _start_clearance(arm, start, obstacle)) >= CLEARANCE + _FREE_ENDS:
            chosen.append(obstacle)
        if len(chosen) == count:
            return Scene(None, tuple(chosen))
    raise InputError(
        f"placement {seed}: no place for {count} obstacles between start and goal of {skill!r}; choose another seed, "
        "or a skill with a longer path"
    )


def _start_clearance(arm: ArmModel, start: Array, obstacle: Obstacle) -> float:
    centers, radii = arm.collision_spheres(start)
    return float((obstacle.signed_distance(centers) - radii).min())


def _end_clearance(skill: Skill, arm: ArmModel, obstacle: Obstacle) -> float:
    rotation = arm.tool_pose(arm.home).quaternion
    nearest = np.inf
    for end in (skill.start_, skill.goal_):
        pose = Pose(end.position, end.quaternion if skill.gmr_.has_orientation_ else rotation)
        distance = obstacle.signed_distance(pose.apply(arm.tool_spheres[:, :3])) - arm.tool_spheres[:, 3]
        nearest = min(nearest, float(distance.min()))
    return nearest


def run_placement(policy: str, setup: Setup, seed: int, max_tilt: float | None = None) -> PlacementResult:
    """Run one policy in one placement, and return the result.

    Args:
        policy: name in :data:`~imitarm.policies.POLICIES`.
        setup: the skill to reproduce, and the arm.
        seed: seed of the placement.
        max_tilt: largest rotation of the tool away from the learned rotation [rad]; None: the policy's default.

    Raises:
        InputError: when the skill or the arm can't be loaded.
        UnknownNameError: when the policy or the arm is not known.
    """
    skill, arm, start = _prepared(setup)
    scene = placement(skill, arm, seed, start)
    robot = SimulatedRobot(arm, scene=scene, q=start)
    spheres = arm.tool_spheres if skill.gmr_.has_orientation_ else [[0.0, 0.0, 0.0, arm.tool_radius]]
    decides = POLICIES[policy].build(skill, tool_spheres=spheres, clearance=CLEARANCE, arm=arm, max_tilt=max_tilt)
    watch = _Stopwatch()
    safety = SafetyFilter(arm, dt=_DT, clearance=CLEARANCE)
    rollout: Rollout | None = None
    try:
        rollout = reproduce(
            decides, robot, scene.at, dt=_DT, safety=safety, timeout=_PATIENCE * skill.duration_, on_step=watch.stop
        )
        outcome, reason = (
            _outcome(rollout.success, rollout.reason, bool(rollout.details.get("contacts"))),
            rollout.reason,
        )
    except InfeasibleError as refusal:
        watch.stop()
        outcome, reason = "refused", str(refusal)
    measured: dict[str, float] = {}
    if outcome == "arrived" and rollout is not None:
        measured = asdict(path_style(rollout.trajectory, *_demonstrated(setup)))
        measured["tool_rmse"] = tool_alone(setup, scene)
    return PlacementResult(
        policy,
        setup,
        seed,
        outcome,
        clearance=np.nan if rollout is None else float(rollout.min_clearance),
        duration=np.nan if rollout is None else rollout.trajectory.duration / skill.duration_,
        planning=watch.time,
        reason=reason,
        max_tilt=max_tilt,
        computing=watch.computing,
        code=code_version(),
        **measured,
    )


def tool_alone(setup: Setup, scene: Scene) -> float:
    """Plan a path for the tool without the arm, between the same ends, and return the RMSE of this path.

    Args:
        setup: the skill and the arm. Only the tool of the arm must keep the clearance, not the links.
        scene: the obstacles.

    Returns:
        The RMS distance of the path from the mean of the demonstrations, see
        :class:`~imitarm.evaluation.path_style.PathStyle` [m]; nan if no path is found.
    """
    arm = _prepared(setup)[1]
    found = adapt(_tool_path(setup), scene, tool_spheres=arm.tool_spheres, clearance=CLEARANCE, allowance=_ALLOWANCE)
    return path_style(found.trajectory, *_demonstrated(setup)).rmse if found.feasible else np.nan


@lru_cache(maxsize=8)
def _tool_path(setup: Setup) -> ComponentPath:
    """Return the learned path from the pose of the tool in the start posture, with rotations."""
    skill, arm, start = _prepared(setup)
    begins = arm.tool_pose(start)
    path = ComponentPath.of_skill(skill, start=begins)
    return replace(path, nominal=_rotated(path.nominal, begins))


def _rotated(path: Trajectory, begins: Pose) -> Trajectory:
    """Return a path with rotations. If no rotations were learned, the tool keeps the rotation of ``begins``."""
    if path.quaternions is not None:
        return path
    return Trajectory(path.times, path.positions, np.tile(begins.quaternion, (len(path), 1)))


class _Stopwatch:
    """Time [s] and processor time [s] from its construction to the first call of ``stop``."""

    def __init__(self) -> None:
        self._began = time.perf_counter(), time.process_time()
        self.time = self.computing = np.nan

    def stop(self, _step: object = None) -> None:
        if np.isnan(self.time):
            self.time, self.computing = time.perf_counter() - self._began[0], time.process_time() - self._began[1]


@lru_cache(maxsize=8)
def _demonstrated(setup: Setup) -> tuple[Trajectory, Array]:
    """Return the mean of the demonstrations with rotations, n samples, and its covariances (n, 3, 3) [m^2]."""
    skill, arm, start = _prepared(setup)
    path = ComponentPath.of_skill(skill)
    return _rotated(path.nominal, arm.tool_pose(start)), path.tolerance + TOLERANCE_FLOOR**2 * np.eye(3)


def _outcome(success: bool, reason: str, contact: bool) -> str:
    if contact:
        return "touched"
    if success:
        return "arrived"
    for start, outcome in (("not finished", "waited"), ("clearance ", "too near")):
        if reason.startswith(start):
            return outcome
    return "stopped"


@lru_cache(maxsize=8)
def _prepared(setup: Setup) -> tuple[Skill, ArmModel, Array]:
    skill, arm = Skill.load(setup.skill), ArmModel.load(setup.robot, tool=setup.tool)
    rotation = arm.tool_pose(arm.home).quaternion
    end = skill.start_
    try:
        start = find_posture(arm, Pose(end.position, end.quaternion if skill.gmr_.has_orientation_ else rotation))
    except UnreachableError as error:
        raise InputError(f"{setup.skill}: {error}; choose another robot for this skill") from error
    links_apart(arm)  # is computed once for each arm, which no policy should be charged for
    return skill, arm, start


def run_placements(
    policies: Sequence[str],
    setups: Sequence[Setup],
    seeds: Iterable[int],
    *,
    max_tilt: float | None = None,
    jobs: int = 1,
    out: Path | None = None,
    reuse: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[PlacementResult]:
    """Run every policy in every placement, and return the results. They do not depend on the number of processes.

    Args:
        policies: names in :data:`~imitarm.policies.POLICIES`.
        setups: skills, each with the arm that reproduces it.
        seeds: seeds of the placements.
        max_tilt: largest rotation of the tool away from the learned rotation [rad]; None: the policy's default.
        jobs: number of processes.
        out: file to which each result is appended as one line of JSON as soon as it is known. If the file already
            contains a result of the same run by the same code, this run is not repeated. None: results are not saved.
        reuse: whether to use results in ``out`` that another version of the code produced.
        progress: function that is called after each run, with the number of finished runs and the number of all runs.

    Raises:
        InputError: when a skill or an arm can't be loaded, ``out`` can't be written, or ``jobs`` is above 1 and joblib
            is not installed.
        FileFormatError: when ``out`` contains something other than results.
    """
    work = list(
        dict.fromkeys(Run(policy, setup, s, max_tilt) for setup in setups for s in seeds for policy in policies)
    )
    known: dict[Run, PlacementResult] = {}
    if out is not None and out.exists():
        repaired(out)
        known = {t: found for t, found in load_results([out]).items() if reuse or found.code == code_version()}
    left = [run for run in work if run not in known]
    with contextlib.ExitStack() as stack:
        results: Iterable[PlacementResult]
        if jobs == 1:
            results = (run_placement(*run) for run in left)
        else:
            joblib = _joblib()
            pool = stack.enter_context(joblib.Parallel(n_jobs=jobs, return_as="generator"))
            results = pool(joblib.delayed(run_placement)(*run) for run in left)
        for done, result in enumerate(results, len(work) - len(left) + 1):
            known[result.run] = result
            if out is not None:
                append_result(out, result)
            if progress is not None:
                progress(done, len(work))
    return [known[run] for run in work]


def _joblib() -> Any:
    try:
        import joblib  # noqa: PLC0415 (an extra)
    except ModuleNotFoundError as error:
        raise InputError("several processes need joblib: pip install 'imitarm[benchmark]', or use --jobs 1") from error
    return joblib


def packaged_skill(folder: Path) -> Path:
    """Learn the skill 'sweep' from the packaged demonstrations, save it in ``folder``, and return the file's path."""
    from imitarm.demonstrations import align, read  # noqa: PLC0415 (only here)
    from imitarm.tasks.sweep import DEMONSTRATIONS  # noqa: PLC0415 (only here)

    place = folder / "sweep.json"
    Skill().fit(align(read(DEMONSTRATIONS))).save(place)
    return place
