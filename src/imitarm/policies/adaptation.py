"""Adapt a whole learned path to a scene by moving only the components near an obstacle (thesis Chapter 4)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.perception.margins import CoverageMargin
from imitarm.policies.adapted_path import Adaptation, jerk_reason, refusal
from imitarm.policies.arm_task import ArmSolution, ArmTask
from imitarm.policies.certificate import ToolAmongObstacles
from imitarm.policies.certified import CERTIFIED
from imitarm.policies.component_path import STILL, ComponentPath
from imitarm.policies.least_detour import (
    MAX_JERK_RATIO,
    AllowedDirections,
    AvoidanceProblem,
    Detour,
    LeastDetour,
    PathAdapter,
)
from imitarm.policies.prediction_margin import PredictionMargin, margins_in
from imitarm.policies.whole_arm import solve
from imitarm.registry import Registry
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number, instance, text

Array = NDArray[np.float64]

HORIZONTAL_ONLY = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))  # stay in the plane of the table: 2-D avoidance
NOT_DOWN = ((0.0, 0.0, -1.0),)  # never into the table

_TILTED_END = 0.3  # fraction of the duration at the end, in which the tool turns to a tilted goal
_SAME_START = 1e-3  # [m] between a decomposed path and the tool

ADAPTERS: Registry[PathAdapter] = Registry(
    "adaptation method",
    "imitarm.adapters",
    {
        "certified": "imitarm.policies.certified:CERTIFIED",
        "mapf": "imitarm.policies.baselines.potential_components:MAPF",
        "literal": "imitarm.policies.baselines.potential_components:LITERAL",
    },
)


def adapter_named(method: str) -> PathAdapter:
    """Return the method of ``ADAPTERS`` with this name. The default method is returned without a search of plugins.

    Raises:
        UnknownNameError: when no method has that name.
        InputError: when the name is not text.
    """
    return CERTIFIED if text(method, "method") == "certified" else ADAPTERS[method]


def adapt(
    skill: Skill | ComponentPath,
    scene: Scene,
    method: str = "certified",
    *,
    tool_radius: float | None = None,
    tool_spheres: ArrayLike | None = None,
    arm: ArmModel | None = None,
    clearance: float = 0.02,
    forbidden: ArrayLike = (),
    pinned: Sequence[float] = (),
    start: Pose | None = None,
    n_samples: int | None = None,
    state: ArmState | None = None,
    max_tilt: float | None = None,
    goal_tilt: float = 0.0,
    allowance: float = 0.0,
    margin: CoverageMargin | None = None,
    margin_horizon: float | None = None,
    hold: float = 0.0,
    max_attempts: int | None = None,
) -> Adaptation:
    """Adapt the whole path of a skill to the obstacles of a scene.

    The method ``certified`` moves the affected components by the smallest displacement that keeps the clearance on the
    whole path. If no displacement keeps the clearance, the result is not feasible and gives the reason. The methods
    ``mapf`` and ``literal`` are the thesis's potential fields (see ``potential_components``); they do not guarantee a
    clearance. All methods keep the path's start, its goal, and its positions at the ``pinned`` times. Specify the tool
    by exactly one of ``tool_radius``, ``tool_spheres`` and ``arm``.

    The motion begins at time 0. At that time, the obstacles are at the poses given by the scene; from then on, they
    move with their velocities.

    Args:
        skill: a fitted skill, or its decomposed path (``ComponentPath.of_skill``), which can be adapted to many scenes.
            A decomposed path already has a start, pinned times and samples, so leave out ``start``, ``pinned`` and
            ``n_samples``. If the scene has a goal, the decomposed path must end at this goal.
        scene: goal and obstacles; if the goal is None, the learned goal is used.
        method: a name in ``ADAPTERS``: ``"certified"``, ``"mapf"``, ``"literal"`` or a registered method.
        tool_radius: radius of one sphere about the tip that represents the tool [m]; 0 for a point.
        tool_spheres: spheres that contain the tool: rows x y z r in the tool's frame, shape (m, 4) [m]. On the path,
            the spheres have the learned orientation of the tool.
        arm: the arm with its tool. The function then plans a joint path. On this path, every moving part of the arm
            keeps the clearance, and the links stay at least 12 mm apart. The motion is slower than learned where the
            limits of velocity, acceleration or torque require it.
        clearance: required distance from the tool, or from the whole arm, to every obstacle [m].
        forbidden: directions in which no component may move, shape (m, 3), for example ``HORIZONTAL_ONLY`` or
            ``NOT_DOWN``.
        pinned: times [s] at which the path must keep its learned position, for example contacts. With ``arm``, the tool
            also keeps its learned rotation at these times.
        start: pose of the tool at the start of the motion; None: the learned start.
        n_samples: number of samples along the path; None: 200.
        state: measured state of ``arm``; the motion starts in its posture. None: the motion starts in a posture near
            ``arm.home`` with the tool at the start of the path.
        max_tilt: largest rotation of the tool of ``arm`` away from the learned rotation between start and goal [rad].
            None: two standard deviations of the demonstrated rotation, or 0 if no orientation was learned. At the
            start, the tool always has the learned rotation.
        goal_tilt: largest rotation of the tool of ``arm`` away from the learned rotation at the goal [rad]. The tool is
            rotated at the goal only if the arm can't keep the clearance there with the learned rotation.
        allowance: additional clearance for the tracking errors of the robot [m]. If no path has this additional
            clearance, the function plans without it.
        margin: a ``CoverageMargin``, which bounds the error of the predicted obstacle positions. It applies to
            obstacles that move or that a tracker estimates. The path keeps the distance ``clearance + margin.at(t)``
            from the prediction, where t [s] is the time since the obstacle was last detected. None: predictions count
            as exact.
        margin_horizon: time after the last detection of an obstacle at which the margin stops growing [s]; None: never.
        hold: the whole arm must keep its clearances at the goal for this long after the arrival [s].
        max_attempts: largest number of attempts in the search for a joint path, to limit the computing time; None: no
            limit. The search may also try to execute the path later, after an obstacle has passed; such attempts are
            not counted.

    Returns:
        The adaptation. Check its attribute ``feasible`` before you execute it.

    Raises:
        UnknownNameError: when no method has that name.
        InputError: when not exactly one of the three tool arguments is given, or an argument is not valid.
    """
    began = time.perf_counter()
    adapter = adapter_named(method)
    instance(scene, Scene, "scene")
    clearance = finite_number(clearance, "clearance", "m", at_least=0.0)
    if arm is not None:
        instance(arm, ArmModel, "arm")
    if state is not None:
        begins = _start_of(arm, state, start)
        if isinstance(skill, ComponentPath):
            _check_start(skill, begins)
        else:
            start = begins
    extra = finite_number(allowance, "allowance", "m", at_least=0.0)
    path = _decomposed(skill, scene.goal, start, pinned, n_samples)
    posture: Array | None = None
    if arm is not None:
        posture = _first_posture(arm, path.nominal, state)
        if path.nominal.quaternions is None:  # the tool keeps the rotation that it has at the start
            held = np.tile(arm.tool_pose(posture).quaternion, (len(path.nominal), 1))
            path = replace(path, nominal=Trajectory(path.nominal.times, path.nominal.positions, held))
    at_goal = finite_number(goal_tilt, "goal_tilt", "rad", at_least=0.0)
    limit = tilt_limits(path, max_tilt, at_goal)
    rest_at_goal = finite_number(hold, "hold", "s", at_least=0.0)
    allowed = allowed_directions(forbidden)
    exact = (None,) * len(scene.obstacles)
    margins = exact if margin is None else margins_in(scene, margin, margin_horizon)
    spheres = _spheres(path, tool_radius, tool_spheres, arm)
    tool = ToolAmongObstacles.along(path.nominal, spheres, scene.obstacles, margins)
    nominal = tool.clearance_of(path.nominal.positions)
    for more in dict.fromkeys((extra, 0.0)):
        problem = AvoidanceProblem(path, nominal, clearance + more, allowed)
        adaptation, detour = _of_tool(problem, scene, method, adapter, began)
        if arm is not None and posture is not None and adapter.refuses and not _covered(problem, at_goal):
            task = ArmTask(arm, posture, scene, problem.clearance, allowed, limit, at_goal, more)
            task = replace(task, margins=margins, hold=rest_at_goal, max_attempts=max_attempts)
            adaptation = of_whole_arm(
                adaptation, solve(task, detour.path, detour.displacement), scene, problem.clearance, began, margins
            )
        if adaptation.feasible:
            break
    return adaptation


def _covered(problem: AvoidanceProblem, goal_tilt: float) -> bool:
    """Return whether the tool is too close at the start, at a pinned time, or at a goal at which it may not tilt.

    No plan of the whole arm can change this.
    """
    path = problem.path
    fixed = np.searchsorted(path.nominal.times, path.fixed_times)
    still = fixed[:-1] if goal_tilt > 0.0 else fixed
    return bool(problem.nominal.distance[:, still].min(initial=np.inf) < problem.clearance)


def tilt_limits(path: ComponentPath, max_tilt: float | None, goal_tilt: float) -> Array:
    """Return the largest rotation of the tool away from the learned rotation at each sample, shape (n,) [rad]."""
    limit = path.rotation_tolerance
    if max_tilt is not None:
        limit = np.full(len(path.nominal), finite_number(max_tilt, "max_tilt", "rad", at_least=0.0))
    if goal_tilt == 0.0:
        return limit
    times = path.nominal.times
    ends = times - times[0] > (1.0 - _TILTED_END) * (times[-1] - times[0])
    limit = np.where(ends, np.maximum(limit, goal_tilt), limit)
    limit[-1] = goal_tilt
    return limit


def _of_tool(
    problem: AvoidanceProblem, scene: Scene, method: str, adapter: PathAdapter, began: float
) -> tuple[Adaptation, Detour]:
    """Adapt the path of the tool alone."""
    path, tool, clearance, allowed = problem.path, problem.nominal.tool, problem.clearance, problem.allowed
    detour = _detour(problem, adapter)
    jerk_ratio = 1.0
    if detour.displacement.any():
        jerk_ratio = path.jerk_ratio(detour.clearance.positions)
        if jerk_ratio > MAX_JERK_RATIO and detour.feasible and adapter.refuses:
            least = LeastDetour(detour.path, tool, clearance, allowed, exact=True)
            detour, jerk_ratio = least.smoothed(detour)
    used = detour.path
    adaptation = Adaptation(
        nominal=path.nominal,
        trajectory=path.nominal.with_positions(detour.clearance.positions),
        displacement=detour.displacement,
        moved=np.einsum("kd,kd->k", detour.displacement, detour.displacement) > STILL**2,
        means=used.means,
        covariances=used.covariances,
        responsibilities=used.responsibilities,
        divided=used is not path,
        tolerance=path.tolerance,
        min_clearance=detour.clearance.lowest,
        certified_clearance=detour.lowest,
        only_on_schedule=depends_on_time(scene, tool.margins),
        validity=validity(scene, path.nominal.duration, tool.margins),
        deviation=used.deviation(detour.displacement),
        jerk_ratio=jerk_ratio,
        jerk_reason="" if jerk_ratio <= MAX_JERK_RATIO else jerk_reason(scene, detour, jerk_ratio, clearance),
        feasible=detour.feasible,
        reason="" if detour.feasible else refusal(scene, problem, detour, method, adapter),
        method=method,
        compute_time=time.perf_counter() - began,
    )
    return adaptation, detour


def _start_of(arm: ArmModel | None, state: ArmState, start: Pose | None) -> Pose:
    """Return the pose of the tool in the measured posture."""
    instance(state, ArmState, "state")
    if arm is None or start is not None:
        raise InputError(
            "adapt: state can't be used without arm, or together with start; give both arm and state, or start alone"
        )
    return arm.tool_pose(state.q)


def _check_start(path: ComponentPath, begins: Pose) -> None:
    away = float(np.linalg.norm(path.nominal.positions[0] - begins.position))
    if away > _SAME_START:
        raise InputError(
            f"adapt: the decomposed path starts {1e3 * away:.1f} mm from the arm's tool; decompose it again, "
            "with the tool's pose as its start"
        )


def _first_posture(arm: ArmModel, nominal: Trajectory, state: ArmState | None) -> Array:
    """Return the posture in which the motion starts, shape (n_joints,) [rad].

    Raises:
        UnreachableError: when the arm can't bring its tool to the start.
    """
    if state is not None:
        return state.q
    rotation = arm.tool_pose(arm.home).quaternion if nominal.quaternions is None else nominal.quaternions[0]
    return find_posture(arm, Pose(nominal.positions[0], rotation))


def of_whole_arm(
    tool: Adaptation,
    solution: ArmSolution,
    scene: Scene,
    clearance: float,
    began: float,
    margins: Sequence[PredictionMargin | None],
) -> Adaptation:
    """Return the result of ``adapt`` for the whole arm, from the result of the search for a joint path.

    Args:
        tool: the adaptation of the tool's path; the values that do not depend on the arm are copied from it.
        solution: result of the search for a joint path.
        scene: the obstacles.
        clearance: required clearance [m].
        began: value of ``time.perf_counter`` when the computation began [s].
        margins: the margin of each obstacle; None for an obstacle without a margin.
    """
    plan, timing, spent = solution.plan, solution.timing, time.perf_counter() - began
    if plan is None or not plan.complete:
        last = tool.displacement
        if plan is not None and plan.displacement.shape == last.shape:  # otherwise, its components were divided
            last = plan.displacement
        moved = np.einsum("kd,kd->k", last, last) > STILL**2
        return replace(tool, displacement=last, moved=moved, feasible=False, reason=solution.reason, compute_time=spent)
    used = plan.components
    times = tool.nominal.times if timing is None else timing.times
    jerk = used.jerk_ratio(plan.path.positions)
    guaranteed = clearance + plan.clearance.room if scene.obstacles else np.inf
    return replace(
        tool,
        trajectory=Trajectory(times, plan.path.positions, plan.path.quaternions),
        displacement=plan.displacement,
        moved=np.einsum("kd,kd->k", plan.displacement, plan.displacement) > STILL**2,
        means=used.means,
        covariances=used.covariances,
        responsibilities=used.responsibilities,
        divided=used.n_components != tool.responsibilities.shape[1] or tool.divided,
        min_clearance=guaranteed,
        certified_clearance=guaranteed,
        validity=validity(scene, float(times[-1]), margins, arm=True),
        deviation=used.deviation(plan.displacement),
        jerk_ratio=jerk,
        jerk_reason=""
        if jerk <= MAX_JERK_RATIO
        else f"the jerk of the planned path is {jerk:.0f} times that of the nominal path; execute it more slowly",
        feasible=not solution.reason,
        reason=solution.reason,
        compute_time=spent,
        joints=plan.path.joints,
        tilt=plan.largest_tilt,
        approach=solution.approach,
        arm_plan=plan,
    )


def _decomposed(
    skill: Skill | ComponentPath, goal: Pose | None, start: Pose | None, pinned: Sequence[float], n_samples: int | None
) -> ComponentPath:
    """Return the path to adapt, from the start to the goal."""
    if isinstance(skill, ComponentPath):
        if start is not None or n_samples is not None or np.size(pinned):
            raise InputError("adapt: a decomposed path has its own start, pinned times and samples; leave them out")
        if goal is not None and np.abs(goal.position - skill.nominal.positions[-1]).max() > STILL:
            raise InputError("adapt: the decomposed path does not end at the scene's goal; decompose it with that goal")
        return skill
    instance(skill, Skill, "skill")
    if start is not None:
        instance(start, Pose, "start")
    n_samples = 200 if n_samples is None else n_samples
    return ComponentPath.of_skill(skill, n_samples=n_samples, start=start, goal=goal, pinned=pinned)


def _spheres(path: ComponentPath, radius: float | None, spheres: ArrayLike | None, arm: ArmModel | None) -> Array:
    """Return the tool as rows x y z r, shape (n, 4) [m]."""
    ways = {"tool_radius": radius, "tool_spheres": spheres, "arm": arm}
    given = [name for name, value in ways.items() if value is not None]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        raise InputError(f"adapt: give exactly one of tool_radius (0 for a point), tool_spheres or arm, got {got}")
    if arm is not None:
        rows = np.asarray(instance(arm, ArmModel, "arm").tool_spheres, dtype=float)
        if not len(rows):
            raise InputError(
                f"adapt: the arm {arm.name} has no collision shapes at its last link or tool, so no clearance can be "
                "certified for it: add them to its file, or give tool_radius or tool_spheres instead of arm"
            )
    elif radius is not None:
        rows = np.array([[0.0, 0.0, 0.0, finite_number(radius, "tool_radius", "m", at_least=0.0)]])
    else:
        rows = finite_array(spheres, (None, 4), "tool_spheres (rows x y z r)", "m")
        if not len(rows) or rows[:, 3].min() < 0.0:
            raise InputError("tool_spheres: give at least one row x y z r with r >= 0 m")
    if path.nominal.quaternions is None and rows[:, :3].any():
        raise InputError(
            "tool spheres away from the tip need the tool's orientation, which was not learned: "
            "record quaternions, or give tool_radius"
        )
    return rows


def allowed_directions(forbidden: ArrayLike) -> AllowedDirections:
    """Return the directions in which components may move, for forbidden directions of the shape (m, 3).

    Raises:
        InputError: when a direction is zero or not finite.
    """
    if isinstance(forbidden, tuple) and not forbidden:
        return AllowedDirections.without(np.empty((0, 3)))
    rows = finite_array(forbidden, (None,) if np.size(forbidden) == 0 else (None, 3), "forbidden (rows x y z)")
    rows = rows.reshape(-1, 3)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if np.any(length == 0.0) or not np.isfinite(length).all():
        raise InputError("forbidden: a direction is zero or too long; give rows of 3 numbers such as (0, 0, 1)")
    return AllowedDirections.without(np.asarray(rows / length))


def _detour(problem: AvoidanceProblem, adapter: PathAdapter) -> Detour:
    """Return the detour that the method finds.

    If the path is already clear, no method searches for a detour. If an obstacle covers a fixed point, no detour can be
    clear, so methods that may refuse (``refuses`` is True) do not search either.
    """
    path, clearance, lowest = problem.path, problem.clearance, problem.nominal.lowest
    still = np.zeros((path.n_components, 3))
    covered = bool(problem.nominal.distance[:, path.fixed].min(initial=np.inf) < clearance)
    if covered or lowest >= clearance:  # otherwise a sample already shows that the path has to move
        least = LeastDetour(path, problem.nominal.tool, clearance, problem.allowed)
        unmoved = least.evaluate(still, problem.nominal)
        if unmoved.feasible or (covered and adapter.refuses):
            return unmoved
    return adapter.detour(problem)


def depends_on_time(scene: Scene, margins: Sequence[PredictionMargin | None]) -> bool:
    """Return whether a guarantee of clearance depends on time, because an obstacle moves or a margin grows."""
    growing = any(margin is not None and margin.growth > 0.0 for margin in margins)
    return growing or any(obstacle.velocity.any() for obstacle in scene.obstacles)


def validity(scene: Scene, duration: float, margins: Sequence[PredictionMargin | None], *, arm: bool = False) -> str:
    """Return a text that says what the guarantee of clearance assumes, and what it does not cover."""
    moving = [scene.name_of(i) for i, obstacle in enumerate(scene.obstacles) if obstacle.velocity.any()]
    covers = "it covers the tool on the planned path, but neither the links of the arm nor tracking errors"
    if arm:
        covers = "it covers every moving part of the arm on the planned joint path, but no tracking errors"
    rotating = [scene.name_of(i) for i, obstacle in enumerate(scene.obstacles) if obstacle.angular_velocity.any()]
    if rotating:
        covers += f"; {' and '.join(rotating)} may rotate in any way about the obstacle's centre"
    if not moving and not depends_on_time(scene, margins):
        return f"the guarantee holds while the obstacles stand still; {covers}"
    return (
        f"the guarantee holds only from 0 to {duration:.2f} s (arrival), and only while the motion is on time and "
        f"{_assumed(scene, moving, margins)}; {covers}"
    )


def _assumed(scene: Scene, moving: Sequence[str], margins: Sequence[PredictionMargin | None]) -> str:
    """Return what a guarantee assumes of the obstacles."""
    kept = f"{' and '.join(moving)} {'keeps' if len(moving) == 1 else 'keep'} the given velocity"
    with_margin = [scene.name_of(i) for i, margin in enumerate(margins) if margin is not None]
    if not with_margin:
        return kept
    margin = next(margin for margin in margins if margin is not None)
    apart = f"the prediction of {' and '.join(with_margin)} is wrong by at most {1e3 * margin.offset:.0f} mm"
    if margin.growth > 0.0:
        apart += f" plus {1e3 * margin.growth:.0f} mm per second"
        apart += f" until {margin.until:.2f} s" if np.isfinite(margin.until) else ""
    others = [name for name in moving if name not in with_margin]
    return apart if not others else f"{apart}, and {' and '.join(others)} keep the given velocity"
