"""Planning again and again among moving obstacles: certified, on time, and honest when nothing is certified."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from imitarm import (
    ArmModel,
    InfeasibleError,
    InputError,
    Pose,
    SafetyFilter,
    Scene,
    Skill,
    Sphere,
    adapt,
    find_posture,
    replan,
    reproduce,
)
from imitarm.command import Status
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.kinematics.arm import ArmState
from imitarm.perception import CoverageMargin, ObstacleTracker
from imitarm.policies import POLICIES, CertifiedRCAMO, Observation, certified_stop
from imitarm.policies.plan_in_execution import PlanInExecution
from imitarm.policies.prediction_margin import margins_in
from imitarm.policies.retiming import schedules
from imitarm.robots import SimulatedRobot
from imitarm.scene import Box, Cylinder, MovingScene
from imitarm.trajectory import Demonstration, Trajectory

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
TILT = {"max_tilt": np.deg2rad(30.0)}
MARGIN = CoverageMargin(0.005, 0.02)
UPRIGHT = [1.0, 0.0, 0.0, 0.0]
AWAY = np.array([0.02, 0.4, -0.05])


@lru_cache
def carrying(name) -> tuple[Skill, ArmModel, np.ndarray]:
    """A skill that carries the tool to the side in 3 s, and the posture in which it starts."""
    arm, rng = ARMS[name], np.random.default_rng(0)
    home, u = arm.tool_pose(arm.home), np.linspace(0.0, 1.0, 100)
    rise = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    shown = []
    for _ in range(4):
        positions = home.position + np.outer(rise, AWAY + 0.01 * rng.normal(size=3))
        rotations = np.tile(home.quaternion, (len(u), 1))
        shown.append(Demonstration(Trajectory(3.0 * u, positions, rotations), task="carry"))
    skill = Skill(8).fit(shown)
    return skill, arm, find_posture(arm, Pose(skill.start_.position, skill.start_.quaternion))


def at(arm, q, velocity=None, time=0.0) -> ArmState:
    still = np.zeros(arm.n_joints)
    return ArmState(np.asarray(q), still if velocity is None else velocity, still, time)


def crossing(skill, direction, speed, *, share=0.5, at_side=0.0, **more) -> Sphere:
    """A ball that meets the tool after a fraction of the motion."""
    place = skill.generate().at([share * skill.duration_])[0][0] + [at_side, 0.0, 0.0]
    velocity = speed * np.asarray(direction) / np.linalg.norm(direction)
    return Sphere(place - share * skill.duration_ * velocity, 0.035, velocity=velocity, name="ball", **more)


def clearance(arm, scene, times, joints, n=250) -> float:
    """The smallest distance from the arm's spheres to the moving obstacles, at n times."""
    lowest = np.inf
    for time in np.linspace(times[0], times[-1], n):
        centers, radii = arm.collision_spheres(np.array([np.interp(time, times, column) for column in joints.T]))
        lowest = min(lowest, *((o.after(time).signed_distance(centers) - radii).min() for o in scene.obstacles))
    return float(lowest)


# ----- schedules: to let an obstacle pass


def test_a_plan_waits_until_an_obstacle_has_left_the_goal():
    skill, arm, start = carrying("sawyer")
    ball = crossing(skill, [0.0, 1.0, 0.6], 0.12, share=1.0)
    scene = Scene(None, [ball])
    plan = adapt(skill, scene, arm=arm, state=at(arm, start), max_attempts=1, **TILT)
    assert not plan.feasible  # the goal is covered when the tool would arrive: the tool alone is refused already
    free = adapt(skill, Scene(), arm=arm, state=at(arm, start), **TILT)
    again = replan(free, scene, arm=arm, state=at(arm, start), phase=0.0, max_attempts=1, **TILT)
    assert again.feasible, again.reason
    assert again.trajectory.duration > free.trajectory.duration + 0.3
    assert clearance(arm, scene, again.trajectory.times, again.joints) >= 0.02 - 1e-6
    np.testing.assert_allclose(again.trajectory.positions[-1], skill.goal_.position, atol=1e-4)
    velocity = np.diff(again.joints, axis=0) / np.diff(again.trajectory.times)[:, None]
    assert (np.abs(velocity) <= arm.max_velocity).all()


def test_the_goal_must_stay_clear_after_the_arrival():
    skill, arm, start = carrying("sawyer")
    free = adapt(skill, Scene(), arm=arm, state=at(arm, start), **TILT)
    late = skill.duration_ + 0.6  # the ball comes to the goal then
    velocity = np.array([0.5, 0.0, 0.1])
    scene = Scene(None, [Sphere(skill.goal_.position - late * velocity, 0.03, velocity=velocity)])
    options = {"arm": arm, "state": at(arm, start), "phase": 0.0, "max_attempts": 1, **TILT}
    soon = replan(free, scene, **options)
    assert soon.feasible
    assert soon.trajectory.duration < late
    held = replan(free, scene, hold=1.0, **options)
    if held.feasible:
        times = np.append(held.trajectory.times, held.trajectory.times[-1] + 1.0)
        joints = np.concatenate([held.joints, held.joints[-1:]])
        assert clearance(arm, scene, times, joints) >= 0.02 - 1e-6
    times = np.append(soon.trajectory.times, soon.trajectory.times[-1] + 1.0)
    assert clearance(arm, scene, times, np.concatenate([soon.joints, soon.joints[-1:]])) < 0.02


def test_schedules_are_sorted_by_delay_and_only_a_resting_arm_waits_at_once():
    times = np.linspace(0.0, 4.0, 200)
    found = schedules(times, times, at_rest=True)
    delays = [schedule.delay for schedule in found]
    assert delays == sorted(delays)
    assert all((np.diff(schedule.clock) > 0.0).all() for schedule in found)
    assert all(schedule.clock[-1] == pytest.approx(4.0 + schedule.delay) for schedule in found)
    assert any(schedule.fastest[0] < 0.1 for schedule in found)
    assert all(schedule.fastest[0] > 0.3 for schedule in schedules(times, times, at_rest=False))
    assert len(schedules(times[:4], times[:4], at_rest=False)) >= 3


# ----- stops


@pytest.mark.parametrize("name", ARMS)
def test_a_certified_stop_brakes_within_the_limits_and_keeps_its_clearance(name):
    _, arm, start = carrying(name)
    rng, certified = np.random.default_rng(4), 0
    for _ in range(25):
        velocity = 0.5 * rng.uniform(-1.0, 1.0, 7) * arm.max_velocity
        tool = arm.tool_pose(start).position
        ball = Sphere(tool + rng.normal(size=3) * 0.25, 0.04, velocity=0.2 * rng.normal(size=3))
        scene = Scene(None, [ball])
        stop = certified_stop(arm, at(arm, start, velocity), scene, horizon=1.0, margin=MARGIN)
        assert stop.times[-1] == pytest.approx(1.0)
        steps = np.diff(stop.joints, axis=0) / np.diff(stop.times)[:, None]
        np.testing.assert_allclose(steps[-1], 0.0, atol=1e-12)
        change = np.abs(np.diff(steps[:-1], axis=0)) / np.diff(stop.times)[1:-1, None]
        assert (change <= arm.max_acceleration + 1e-9).all()
        lowest = clearance(arm, scene, stop.times, stop.joints, 120)
        if stop.certified:
            certified += 1
            assert stop.reason == ""
            assert lowest >= stop.clearance - 1e-9 >= 0.02 - 1e-9
        else:
            assert lowest < 0.02 + 0.03 + 1e-6 or "another link" in stop.reason
    assert 3 <= certified <= 24


def test_a_stop_in_the_way_of_an_obstacle_is_not_certified_and_names_it():
    _, arm, start = carrying("panda")
    tool = arm.tool_pose(start).position
    ball = Sphere(tool + [0.4, 0.0, 0.0], 0.04, velocity=[-0.5, 0.0, 0.0], name="ball")
    stop = certified_stop(arm, at(arm, start), Scene(None, [ball]), horizon=1.0)
    assert not stop.certified
    assert "ball" in stop.reason
    assert certified_stop(arm, at(arm, start), Scene(None, [ball]), horizon=0.2).certified
    centers, radii = arm.collision_spheres(start)
    lowest = float((centers[:, 2] - radii)[arm.cover.links == arm.n_joints].min())
    table = Box(Pose([tool[0], tool[1], lowest - 0.055], UPRIGHT), [0.3, 0.3, 0.1], name="table")
    assert certified_stop(arm, at(arm, start), Scene(fixtures=[table])).certified
    down = -np.linalg.pinv(arm.jacobian(start)[:3]) @ [0.0, 0.0, 1.0]
    sinking = certified_stop(arm, at(arm, start, down), Scene(fixtures=[table]))
    assert not sinking.certified
    assert "table" in sinking.reason
    with pytest.raises(InputError, match="joints"):
        certified_stop(arm, ArmState(np.zeros(6), np.zeros(6), np.zeros(6), 0.0), Scene())


# ----- the assumptions of a plan


@lru_cache
def begun(margin=MARGIN):
    skill, arm, start = carrying("sawyer")
    box = Box(Pose([0.3, 0.9, 0.2], UPRIGHT), [0.1, 0.2, 0.1], velocity=[0.0, -0.1, 0.0], track_id=4, name="carton")
    scene = Scene(None, [box], stamp=2.0)
    found = adapt(skill, scene, arm=arm, state=at(arm, start), margin=margin, margin_horizon=1.0, **TILT)
    assert found.feasible
    plan = PlanInExecution.of(arm, found, 2.0, 0.0, scene, margins_in(scene, margin, 1.0), 0.02)
    return plan, scene, box


def test_what_was_foreseen_is_accepted_and_what_was_not_is_named():
    plan, scene, box = begun()
    spare = plan.adaptation.certified_clearance - 0.02
    for time in (2.0, 2.4, 3.5):
        assert plan.unforeseen(scene.at(time)) == ""
        allowed = 0.005 + 0.02 * min(time - 2.0, 1.0) + spare
        for factor, fits in ((0.99, True), (1.01, False)):
            moved = replace(box.after(time - 2.0), pose=box.after(time - 2.0).pose)
            shift = factor * allowed * np.array([0.0, 0.6, 0.8])
            moved = replace(moved, pose=Pose(moved.pose.position + shift, moved.pose.quaternion))
            reason = plan.unforeseen(Scene(None, [moved], stamp=time))
            assert (reason == "") == fits
            if not fits:
                assert "carton" in reason
                assert "allowed" in reason


def test_a_new_obstacle_a_rotated_one_and_a_larger_one_are_unforeseen_and_a_missing_one_is_not():
    plan, _, box = begun()
    new = Sphere([0.2, 0.0, 1.0], 0.1, track_id=7, name="hand")
    assert "hand" in plan.unforeseen(Scene(None, [box, new], stamp=2.0))
    tilted = replace(box, pose=Pose(box.pose.position, [np.cos(0.8), np.sin(0.8), 0.0, 0.0]))
    big = replace(box, size=[0.6, 0.7, 0.6])
    if plan.adaptation.certified_clearance - 0.02 < 0.1:
        assert "carton" in plan.unforeseen(Scene(None, [tilted], stamp=2.0))
    assert "carton" in plan.unforeseen(Scene(None, [big], stamp=2.0))
    assert plan.unforeseen(Scene(None, [], stamp=2.0)) == ""


def test_a_plan_is_certified_again_for_obstacles_elsewhere_if_its_rest_is_clear_of_them():
    plan, _, box = begun()
    _, arm, _ = carrying("sawyer")
    for shift, fits in (([0.0, 0.25, 0.0], True), (plan.trajectory.positions[-1] - box.pose.position, False)):
        moved = replace(box.after(0.5), pose=Pose(box.after(0.5).pose.position + shift, UPRIGHT))
        scene = Scene(None, [moved], stamp=2.5)
        assert plan.unforeseen(scene)
        again = plan.certified_again(arm, scene, margins_in(scene, MARGIN, 1.0), 0.5)
        assert (again is not None) == fits
        if again is not None:
            assert again.unforeseen(scene) == ""
            times = np.linspace(2.5, plan.end + 0.5, 200)
            for time in times:
                centers, radii = arm.collision_spheres(again.joints_at(time))
                away = float((moved.after(time - 2.5).signed_distance(centers) - radii).min())
                assert away >= again.certified + 0.005 + 0.02 * min(time - 2.5, 1.0) - 1e-6


@pytest.mark.parametrize("track", [None, 7])
def test_among_tracked_obstacles_the_near_future_is_enough(track):
    plan, _, box = begun()
    _, arm, _ = carrying("sawyer")
    goal, way = plan.trajectory.positions[-1], np.array([0.0, 0.9, 0.0])
    place, velocity = Pose(goal + way, UPRIGHT), -way / (plan.end - 2.5)
    comes = replace(box, pose=place, velocity=velocity, angular_velocity=np.zeros(3), track_id=track)
    again = plan.certified_again(arm, Scene(None, [comes], stamp=2.5), (None,), 0.5, 1.0)
    assert (again is None) == (track is None)
    if again is not None:
        assert again.until == pytest.approx(3.5) and again.certified >= plan.clearance
        late = Scene(None, [comes.after(plan.end - 2.8)], stamp=plan.end - 0.3)
        assert plan.certified_again(arm, late, (None,), 0.5, 1.0) is None


def test_the_time_in_the_learned_motion_and_the_phase_are_inverse():
    plan, _, _ = begun()
    for time in np.linspace(2.0, plan.end, 15):
        assert plan.phase_of(plan.learned_at(time)) == pytest.approx(plan.phase_at(time), abs=1e-6)
    assert not plan.velocity_at(plan.end + 1.0).any()
    np.testing.assert_allclose(plan.joints_at(0.0), plan.joints[0])
    step = 1e-4
    change = (plan.joints_at(3.0 + step) - plan.joints_at(3.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(plan.velocity_at(3.0), change, atol=0.02)
    _, arm, _ = carrying("sawyer")
    tool = arm.tool_pose(plan.joints_at(2.5))
    assert plan.off_schedule(arm, 2.5, at(arm, plan.joints_at(2.5)), tool, 0.01) == ""
    assert "mm from its planned position" in plan.off_schedule(arm, 3.5, at(arm, plan.joints_at(2.5)), tool, 0.01)


# ----- the policy, on an arm that moves exactly as commanded


def executed(policy, arm, start, observe, *, timeout=8.0, dt=0.02, disturb=None):
    """Let the arm follow the policy exactly; return times, joints and commands."""
    q, velocity, time = start.copy(), np.zeros(arm.n_joints), 0.0
    rows, commands = [q], []

    def observation():
        return Observation(time, at(arm, q, velocity, time), arm.tool_pose(q), observe(time))

    policy.reset(observation())
    while time < timeout and not policy.finished(observation()):
        command = policy.step(observation(), dt)
        velocity = command.joint_velocity
        if velocity is None:
            velocity = np.linalg.pinv(arm.jacobian(q), rcond=1e-2) @ command.twist
        velocity = np.clip(velocity, -arm.max_velocity, arm.max_velocity)
        if disturb is not None:
            velocity = velocity + disturb(time)
        q, time = q + dt * velocity, time + dt
        rows.append(q)
        commands.append(command)
    return dt * np.arange(len(rows)), np.array(rows), commands, policy.finished(observation())


def policy_of(name, **options):
    skill, arm, _ = carrying(name)
    return CertifiedRCAMO(skill, arm=arm, **{"rate": 10.0, "margin": MARGIN, **TILT, **options})


@pytest.mark.parametrize("planning_time", [0.0, 0.06])
@pytest.mark.parametrize("name", ARMS)
def test_a_crossing_ball_is_passed_with_the_clearance_and_the_arm_arrives(name, planning_time):
    skill, arm, start = carrying(name)
    scene = Scene(None, [crossing(skill, [1.0, 0.0, 0.3], 0.3)])
    policy = policy_of(name, planning_time=planning_time)
    times, joints, commands, arrived = executed(policy, arm, start, scene.at)
    assert arrived
    assert times[-1] <= 2.0 * skill.duration_
    assert clearance(arm, scene, times, joints) >= 0.02
    assert policy.certified > 15
    assert {Status.NOMINAL, Status.AVOIDING} >= {command.status for command in commands} - {Status.WAITING}
    assert commands[-1].progress == pytest.approx(1.0, abs=0.02)


def test_without_obstacles_the_learned_motion_is_followed_to_the_goal():
    skill, arm, start = carrying("panda")
    times, joints, commands, arrived = executed(policy_of("panda"), arm, start, lambda time: Scene(stamp=time))
    assert arrived
    assert times[-1] <= 1.1 * skill.duration_
    assert all(command.status is Status.NOMINAL for command in commands)
    learned, _ = skill.generate().at(np.minimum(times, skill.duration_))
    tool, _ = arm.tool_path(joints)
    assert np.linalg.norm(tool - learned, axis=1).max() < 0.02


def test_a_ball_that_turns_towards_the_arm_voids_the_plan_and_a_new_one_is_made():
    skill, arm, start = carrying("sawyer")
    place = skill.generate().at([0.6 * skill.duration_])[0][0]

    def truth(time):
        turned = max(time - 0.8, 0.0)
        centre = place + [0.45, 0.0, 0.1] + np.array([0.0, 0.1, 0.0]) * min(time, 0.8) + np.array([-0.3, 0, 0]) * turned
        velocity = [0.0, 0.1, 0.0] if time < 0.8 else [-0.3, 0.0, 0.0]
        return Scene(None, [Sphere(centre, 0.035, velocity=velocity, track_id=1)], stamp=time)

    policy = policy_of("sawyer")
    times, joints, _, arrived = executed(policy, arm, start, truth)
    assert arrived
    centers = np.array([truth(time).obstacles[0].center for time in times])
    lowest = min(
        float((np.linalg.norm(arm.collision_spheres(q)[0] - c, axis=1) - arm.collision_spheres(q)[1]).min()) - 0.035
        for q, c in zip(joints, centers, strict=True)
    )
    assert lowest >= 0.015


def test_an_obstacle_that_appears_is_planned_around():
    skill, arm, start = carrying("sawyer")
    place = skill.generate().at([0.45 * skill.duration_])[0][0]
    post = Sphere(place + [0.08, 0.0, 0.0], 0.03, track_id=2, name="post")
    policy = policy_of("sawyer")
    times, joints, commands, arrived = executed(
        policy, arm, start, lambda time: Scene(None, [post] if time > 0.3 else [], stamp=time)
    )
    assert arrived
    assert clearance(arm, Scene(None, [post]), times, joints) >= 0.015
    assert Status.AVOIDING in {command.status for command in commands}


def test_an_arm_that_is_held_off_its_path_is_off_schedule_and_plans_again():
    skill, arm, start = carrying("panda")
    scene = Scene(None, [crossing(skill, [1.0, 0.0, 0.0], 0.2, at_side=0.3)])
    push = 0.5 * np.ones(7)
    policy = policy_of("panda")
    times, joints, _, arrived = executed(
        policy, arm, start, scene.at, disturb=lambda time: push if 0.9 < time < 1.0 else np.zeros(7)
    )
    assert arrived
    assert clearance(arm, scene, times, joints) >= 0.015


def test_an_obstacle_that_stays_on_the_goal_is_waited_for_and_named():
    skill, arm, start = carrying("sawyer")
    velocity = np.array([-0.3, 0.0, 0.1])

    def truth(time):
        left = max(1.5 - time, 0.0)
        now = velocity if left else np.zeros(3)
        return Scene(None, [Sphere(skill.goal_.position - left * velocity, 0.04, velocity=now, name="cup")], stamp=time)

    policy = policy_of("sawyer", rate=5.0, patience=10.0)
    _, joints, commands, arrived = executed(policy, arm, start, truth, timeout=4.5)
    assert not arrived
    last = commands[-1]
    assert last.status is Status.WAITING
    assert "no certified plan" in last.reason and "cup" in last.reason
    assert np.abs(joints[-1] - joints[-5]).max() < 1e-3
    final = truth(10.0)
    assert min(clearance(arm, final, [0.0, 1.0], np.stack([q, q]), 1) for q in joints[-3:]) > 0.0


def test_a_moving_obstacle_at_the_start_is_waited_for_and_a_standing_one_is_refused():
    skill, arm, start = carrying("panda")
    goal = skill.goal_.position
    leaving = Sphere(goal, 0.04, velocity=[0.02, 0.05, 0.05], name="cart")
    policy = policy_of("panda", rate=5.0, margin=None)
    times, joints, _, arrived = executed(policy, arm, start, Scene(None, [leaving]).at, timeout=9.0)
    assert arrived
    assert clearance(arm, Scene(None, [leaving]), times, joints) >= 0.02 - 1e-3
    standing = Scene(None, [replace(leaving, velocity=np.zeros(3))])
    with pytest.raises(InfeasibleError, match="cart"):
        executed(policy_of("panda"), arm, start, standing.at)


def test_a_goal_that_moves_and_wrong_options_are_rejected():
    skill, arm, start = carrying("sawyer")
    policy = policy_of("sawyer")
    scene = Scene(skill.goal_)
    first = Observation(0.0, at(arm, start), arm.tool_pose(start), scene)
    with pytest.raises(InputError, match="call reset"):
        policy.step(first, 0.01)
    policy.reset(first)
    moved = Scene(Pose(skill.goal_.position + [0.01, 0.0, 0.0], skill.goal_.quaternion))
    with pytest.raises(InputError, match="goal has moved"):
        policy.step(Observation(0.01, at(arm, start), arm.tool_pose(start), moved), 0.01)
    with pytest.raises(InputError, match="arm="):
        CertifiedRCAMO(skill)
    for wrong in ({"rate": 0.0}, {"planning_time": -1.0}, {"hold": 0.0}, {"margin": 0.01}, {"gain": -1.0}):
        with pytest.raises(InputError):
            policy_of("sawyer", **wrong)
    assert POLICIES["rcamo-certified"] is CertifiedRCAMO


# ----- in the simulator, whose geometry and contacts are independent of the planner


SHAPES = {
    "sphere": lambda place, velocity: Sphere(place, 0.035, velocity=velocity),
    "box": lambda place, velocity: Box(Pose(place, [0.9, 0.1, 0.3, 0.3]), [0.05, 0.06, 0.07], velocity=velocity),
    "cylinder": lambda place, velocity: Cylinder(Pose(place, UPRIGHT), 0.03, 0.08, velocity=velocity),
}


@pytest.mark.parametrize(
    ("name", "shape", "direction", "speed", "sensed"),
    [
        ("sawyer", "box", [1.0, 0.0, 0.2], 0.4, True),  # crossing
        ("panda", "cylinder", [0.1, -1.0, 0.2], 0.2, False),  # oncoming
        ("panda", "sphere", [0.1, 1.0, -0.1], 0.5, True),  # chasing
    ],
)
def test_no_contact_in_the_simulator_with_the_truth_and_with_a_noisy_late_sensor(name, shape, direction, speed, sensed):
    skill, arm, start = carrying(name)
    velocity = speed * np.array(direction) / np.linalg.norm(direction)
    place = skill.generate().at([0.5 * skill.duration_])[0][0]
    scene = Scene(None, [SHAPES[shape](place - 0.5 * skill.duration_ * velocity, velocity)])
    robot = SimulatedRobot(arm, scene=scene, q=start)
    observe = lambda time: robot.scene  # noqa: E731
    if sensed:
        sensor = SensorModel(noise=0.005, rate=30.0, latency=0.033, seed=1)
        observe = TrackedScene(MovingScene(scene), sensor, ObstacleTracker())
    policy = policy_of(name, planning_time=0.05)
    safety = SafetyFilter(arm, dt=0.01, clearance=0.005)
    rollout = reproduce(policy, robot, observe, dt=0.01, timeout=2.0 * skill.duration_ + 1.0, safety=safety)
    assert not rollout.details["contacts"]
    assert rollout.clearance.min() > 0.005
    assert np.linalg.norm(rollout.trajectory.positions[-1] - skill.goal_.position) < 0.01, rollout.reason
