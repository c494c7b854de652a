"""replan: plan the rest of a motion of the whole arm again, from the measured posture of the arm."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.perception.margins import CoverageMargin
from imitarm.policies.adaptation import allowed_directions, depends_on_time, of_whole_arm, tilt_limits
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.arm_planner import Effort
from imitarm.policies.arm_task import ArmTask
from imitarm.policies.component_path import STILL
from imitarm.policies.prediction_margin import margins_in
from imitarm.policies.remainder import Remainder
from imitarm.policies.whole_arm import solve
from imitarm.scene.scene import Scene
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array, finite_number, instance, whole_number

_BEYOND = 1.03  # times the measured tilt: a planner does not use the whole limit


def replan(
    previous: Adaptation,
    scene: Scene,
    *,
    arm: ArmModel,
    state: ArmState,
    phase: float,
    clearance: float = 0.02,
    forbidden: ArrayLike = (),
    max_tilt: float | None = None,
    goal_tilt: float = 0.0,
    allowance: float = 0.0,
    margin: CoverageMargin | None = None,
    margin_horizon: float | None = None,
    hold: float = 0.0,
    max_attempts: int | None = None,
    max_rounds: int | None = None,
    displacement: ArrayLike | None = None,
) -> Adaptation:
    """Plan the rest of a motion of the whole arm again, for example because an obstacle has moved.

    The new plan continues the motion from the measured posture, in the planned direction and with the measured speed.
    If possible, it passes each obstacle on the same side as ``previous``. Where ``previous`` still keeps the clearance,
    its displacement does not change. The guaranteed clearance covers the rest of the motion, from the measured posture
    to the goal.

    The times of the result start at 0, now. At time 0, the obstacles are at their poses in the scene; then they move
    with their velocities. To plan again later, pass the result as ``previous``.

    Args:
        previous: a feasible adaptation of the whole arm (``adapt(..., arm=...)``), or a result of this function.
        scene: obstacles at the current time; its goal must be None or the goal of ``previous``.
        arm: the arm with its tool.
        state: measured state of the arm.
        phase: time in ``previous.trajectory`` that the motion has reached [s]. If ``previous`` has an approach, the
            time 0 is the end of the approach.
        clearance: required distance from the whole arm to every obstacle [m].
        forbidden: directions in which no component may move, shape (m, 3); see :func:`adapt`.
        max_tilt: largest rotation of the tool away from the learned rotation [rad]; see :func:`adapt`.
        goal_tilt: largest rotation of the tool away from the learned rotation at the goal [rad]; see :func:`adapt`.
        allowance: additional clearance for tracking errors [m]. If ``previous`` or the new path does not have this
            additional clearance, the function plans without it.
        margin: bound of the error of the predicted obstacle positions; see :func:`adapt`.
        margin_horizon: time after the last detection of an obstacle at which the margin stops growing [s]; see
            :func:`adapt`.
        hold: time for which the whole arm must keep its clearances at the goal after the arrival [s].
        max_attempts: largest number of attempts in the search for a joint path, to limit the computing time; None: no
            limit. The search may also try to execute the path later, after an obstacle has passed; such attempts are
            not counted.
        max_rounds: largest number of rounds of the whole search, to limit the computing time; None: no limit. In each
            round, the planner improves a joint path once. An attempt can have many rounds.
        displacement: first guess of the components' displacements, shape (n_components, 3) [m], for example the result
            of a search that ended after ``max_rounds``; None: the displacements of ``previous``.

    Returns:
        The adaptation of the rest of the motion. If its attribute ``feasible`` is False, do not execute it: brake the
        arm.

    Raises:
        InputError: when ``previous`` has no plan of the whole arm, the motion is over, or an argument is not valid.
    """
    began = time.perf_counter()
    plan = instance(previous, Adaptation, "previous").arm_plan
    if plan is None or not previous.feasible:
        raise InputError("replan: previous must be a feasible adaptation with arm; call adapt(..., arm=...) first")
    instance(scene, Scene, "scene")
    q = instance(state, ArmState, "state").q
    if len(q) != instance(arm, ArmModel, "arm").n_joints:
        raise InputError(f"replan: state has {len(q)} joints, but {arm.name} has {arm.n_joints}")
    goal = previous.nominal.positions[-1]
    if scene.goal is not None and np.abs(scene.goal.position - goal).max() > STILL:
        raise InputError("replan: the scene has another goal than previous; call adapt for the new goal")
    clearance = finite_number(clearance, "clearance", "m", at_least=0.0)
    extra = finite_number(allowance, "allowance", "m", at_least=0.0)
    at_goal = finite_number(goal_tilt, "goal_tilt", "rad", at_least=0.0)
    rest_at_goal = finite_number(hold, "hold", "s", at_least=0.0)
    allowed = allowed_directions(forbidden)
    done, times = previous.trajectory.times, plan.components.nominal.times
    now = finite_number(phase, "phase", "s", at_least=0.0)
    if now >= done[-1]:
        raise InputError(f"replan: the motion is over at {done[-1]:.2f} s; phase is {now:.2f} s")
    rest = Remainder.of(plan, float(np.interp(now, done, times)), state)
    limit = tilt_limits(rest.components, max_tilt, at_goal)
    limit = np.maximum(limit, _BEYOND * np.linalg.norm(rest.tilts.fixed, axis=1))  # where the arm is, it may be
    begin = rest.displacement
    if displacement is not None:
        begin = finite_array(displacement, begin.shape, "displacement", "m")
    around = margins_in(scene, margin, margin_horizon)
    positions, quaternions = previous.nominal.at(rest.components.nominal.times + rest.begins)
    nominal = Trajectory(rest.components.nominal.times, positions, quaternions)
    unplanned = replace(
        previous,
        nominal=nominal,
        trajectory=nominal,
        tolerance=rest.components.tolerance,
        only_on_schedule=depends_on_time(scene, around),
        joints=None,
        approach=None,
        arm_plan=None,
    )
    effort = Effort(np.inf if max_rounds is None else whole_number(max_rounds, "max_rounds", at_least=1))
    extras = (extra, 0.0) if previous.certified_clearance >= clearance + extra else (0.0,)
    for more in dict.fromkeys(extras):
        task = ArmTask(arm, q, scene, clearance + more, allowed, limit, at_goal, more, rest, around)
        task = replace(task, hold=rest_at_goal, max_attempts=max_attempts, effort=effort)
        solution = solve(task, rest.components, begin)
        found = of_whole_arm(unplanned, solution, scene, clearance + more, began, around)
        if found.feasible or effort.left <= 0.0:
            break
    return found
