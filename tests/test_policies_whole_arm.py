"""The whole arm: planned, certified, executed as planned, or refused with the link, the obstacle and the time."""

from __future__ import annotations

import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest

from imitarm import (
    ACFRA,
    ArmModel,
    InfeasibleError,
    InputError,
    Pose,
    Scene,
    SimulatedRobot,
    Skill,
    Sphere,
    find_posture,
)
from imitarm.benchmark.placements import placement
from imitarm.control_loop import reproduce
from imitarm.demonstrations import align, read
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies import adapt, whole_arm
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.policy import Observation
from imitarm.safety import SafetyFilter
from imitarm.scene import HalfSpace
from imitarm.tasks import DEMONSTRATIONS
from imitarm.trajectory import Demonstration, Trajectory

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
ZEROS = np.zeros(7)
TILT = np.deg2rad(30.0)


@lru_cache
def pouring(folder: Path) -> Skill:
    return Skill(8).fit(align(read(folder / "panda_kinesthetic" / "pouring.npy", units="cm", duration=10.0)))


@lru_cache
def shelf(folder: Path) -> Skill:
    recording = folder / "panda_kinesthetic" / "bottle2shelf.npy"
    return Skill(10).fit(align(read(recording, units="cm", duration=10.0)))


@lru_cache
def prepared(folder: Path, name: str, learned=pouring):
    skill, arm = learned(folder), ARMS[name]
    rotation = skill.start_.quaternion if skill.gmr_.has_orientation_ else arm.tool_pose(arm.home).quaternion
    return skill, arm, find_posture(arm, Pose(skill.start_.position, rotation))


def at_rest(q) -> ArmState:
    return ArmState(np.asarray(q), ZEROS, ZEROS, 0.0)


def planned(folder, name, seed, **options):
    skill, arm, start = prepared(folder, name)
    scene = placement(skill, arm, seed, start)
    return scene, adapt(skill, scene, arm=arm, state=at_rest(start), **({"max_tilt": TILT} | options))


def measured_clearance(arm, scene, joints) -> float:
    """The smallest distance of the simulator's exact shapes at four postures of each segment."""
    robot = SimulatedRobot(arm, scene=scene, q=joints[0])
    addresses = [robot.model.joint(joint).qposadr[0] for joint in arm.joint_names]
    lowest = np.inf
    for a, b in pairwise(joints):
        for fraction in np.linspace(0.0, 1.0, 4, endpoint=False):
            robot.data.qpos[addresses] = a + fraction * (b - a)
            mujoco.mj_kinematics(robot.model, robot.data)
            lowest = min(lowest, robot.clearance())
    return lowest


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("seed", range(6))
def test_a_plan_keeps_the_clearance_by_the_geometry_of_the_simulator(real_data, name, seed):
    skill, arm, start = prepared(real_data, name)
    scene, plan = planned(real_data, name, seed)
    if not plan.feasible:
        pytest.fail(f"refused: {plan.reason}")
    assert plan.certified_clearance >= 0.02
    assert measured_clearance(arm, scene, plan.joints) >= plan.certified_clearance - 1e-6
    np.testing.assert_allclose(plan.joints[0], start, atol=1e-5)
    assert (plan.joints >= arm.lower).all()
    assert (plan.joints <= arm.upper).all()
    assert plan.tilt <= TILT + 1e-3
    assert plan.trajectory.duration <= 1.5 * skill.duration_
    for i in (0, 57, 120, -1):  # the trajectory is that of the joints
        pose = arm.tool_pose(plan.joints[i])
        np.testing.assert_allclose(plan.trajectory.positions[i], pose.position, atol=1e-6)
    goal = arm.tool_pose(plan.joints[-1])
    np.testing.assert_allclose(goal.position, skill.goal_.position, atol=1e-4)


@pytest.mark.parametrize(("name", "seed"), [("sawyer", 1), ("panda", 3), ("panda", 7)])
def test_what_is_planned_is_executed_and_arrives(real_data, name, seed):
    skill, arm, start = prepared(real_data, name)
    scene = placement(skill, arm, seed, start)
    robot = SimulatedRobot(arm, scene=scene, q=start)
    policy = ACFRA(skill, arm=arm, max_tilt=TILT)
    off = []

    def on_step(step):
        plan = policy.adaptation
        times = plan.trajectory.times
        target = np.array([np.interp(policy.phase, times, column) for column in plan.joints.T])
        off.append(np.abs(step.state.q - target).max())

    safety = SafetyFilter(arm, clearance=0.02)
    done = reproduce(policy, robot, scene.at, safety=safety, timeout=1.6 * skill.duration_, on_step=on_step)
    assert done.success, done.reason
    assert done.min_clearance >= 0.02
    assert not robot.contacts
    assert np.median(off) < 0.01


def test_a_goal_that_only_another_start_posture_reaches_is_approached_first(real_data):
    skill, arm, start = prepared(real_data, "sawyer", shelf)
    approached = 0
    for seed in (203, 204, 208):
        scene = placement(skill, arm, seed, start)
        plan = adapt(skill, scene, arm=arm, state=at_rest(start), max_tilt=TILT)
        if plan.approach is None:
            continue
        approached += 1
        np.testing.assert_allclose(plan.approach.joints[0], start, atol=1e-9)
        np.testing.assert_allclose(plan.approach.joints[-1], plan.joints[0], atol=1e-9)
        assert (np.diff(plan.approach.times) > 0.0).all()
        assert measured_clearance(arm, scene, plan.approach.joints) >= 0.02
        assert plan.approach.times[-1] + plan.trajectory.duration <= 1.5 * skill.duration_
        if approached == 1:
            robot = SimulatedRobot(arm, scene=scene, q=start)
            safety, timeout = SafetyFilter(arm, clearance=0.02), plan.approach.times[-1] + 1.6 * skill.duration_
            done = reproduce(ACFRA(skill, arm=arm, max_tilt=TILT), robot, scene.at, safety=safety, timeout=timeout)
            assert done.success, done.reason
            assert done.min_clearance >= 0.02
    assert approached > 0


def test_tilt_zero_keeps_the_learned_rotation(real_data):
    _, plan = planned(real_data, "sawyer", 0, max_tilt=0.0)
    assert plan.feasible
    shown = plan.nominal.quaternions
    apart = quaternion_log(quaternion_multiply(plan.trajectory.quaternions, quaternion_conjugate(shown)))
    assert np.linalg.norm(apart, axis=1).max() < 1e-4


def test_without_obstacles_the_learned_path_is_followed(real_data):
    skill, arm, start = prepared(real_data, "panda")
    plan = adapt(skill, Scene(), arm=arm, state=at_rest(start))
    assert plan.feasible
    assert not plan.moved.any()
    np.testing.assert_allclose(plan.trajectory.positions, plan.nominal.positions, atol=2e-6)


def test_a_blocked_goal_is_refused_before_anything_moves_with_the_link(real_data):
    skill, arm, start = prepared(real_data, "sawyer")
    goal = Pose(skill.generate().positions[-1], skill.generate().quaternions[-1])
    tool = goal.apply(arm.tool_spheres[:, :3])
    back = goal.apply([0.0, 0.0, -1.0]) - goal.position  # from the tip towards the wrist
    away = 0.1
    while (np.linalg.norm(tool - goal.position - away * back, axis=1) - arm.tool_spheres[:, 3]).min() < 0.13:
        away += 0.01
    scene = Scene(None, [Sphere(goal.position + away * back, 0.1, name="jug")])  # clear of the tool, not of the wrist
    plan = adapt(skill, scene, arm=arm, state=at_rest(start), max_tilt=TILT)
    assert not plan.feasible
    assert re.search(r'no posture .* goal .*right_l\d is -?\d+ mm from sphere "jug" \(20 mm required\)', plan.reason)
    robot = SimulatedRobot(arm, scene=scene, q=start)
    with pytest.raises(InfeasibleError, match="jug"):
        ACFRA(skill, arm=arm, max_tilt=TILT).reset(Observation(0.0, robot.state(), arm.tool_pose(start), scene))


def test_a_goal_that_only_a_tilted_tool_reaches_needs_the_option_for_it(real_data):
    skill, arm, start = prepared(real_data, "panda", shelf)
    goal_tilt, tilted = np.deg2rad(30.0), 0
    for seed in (201, 204, 206, 219):
        scene = placement(skill, arm, seed, start)
        plan = adapt(skill, scene, arm=arm, state=at_rest(start), max_tilt=TILT)
        if plan.feasible:
            continue
        assert "goal_tilt" in plan.reason
        plan = adapt(skill, scene, arm=arm, state=at_rest(start), max_tilt=TILT, goal_tilt=goal_tilt)
        if not plan.feasible:
            continue
        tilted += 1
        end = arm.tool_pose(plan.joints[-1])
        np.testing.assert_allclose(end.position, skill.goal_.position, atol=1e-4)
        turned = np.linalg.norm(end.error_to(Pose(end.position, plan.nominal.quaternions[-1]))[3:])
        assert 0.0 < turned <= goal_tilt + 1e-3
        assert measured_clearance(arm, scene, plan.joints) >= 0.02
    assert tilted > 0


def test_an_arm_that_starts_too_near_is_refused(real_data):
    skill, arm, start = prepared(real_data, "panda")
    elbow = arm.collision_spheres(start)[0][arm.cover.links == 4].mean(axis=0)
    plan = adapt(skill, Scene(None, [Sphere(elbow, 0.05, name="post")]), arm=arm, state=at_rest(start))
    assert not plan.feasible
    assert plan.reason.startswith("at the start")
    assert "post" in plan.reason


def test_a_table_is_kept_off_by_the_links_and_not_by_the_tool_that_works_on_it(real_data):
    skill, arm, start = prepared(real_data, "sawyer")
    lowest = skill.generate().positions[:, 2].min()
    tool = float(arm.tool_spheres[:, 3].max())
    table = HalfSpace([0.0, 0.0, lowest - tool - 0.03], name="table")
    plan = adapt(skill, Scene(None, (), 0.0, (table,)), arm=arm, state=at_rest(start), max_tilt=TILT)
    assert plan.feasible, plan.reason


def test_a_moving_obstacle_is_certified_on_schedule_for_the_whole_arm(real_data):
    skill, arm, start = prepared(real_data, "sawyer")
    middle = skill.generate().positions[100]
    time = 0.5 * skill.duration_
    velocity = np.array([0.03, 0.0, 0.0])
    ball = Sphere(middle - time * velocity + [0.0, 0.0, 0.05], 0.03, velocity=velocity, name="ball")
    plan = adapt(skill, Scene(None, [ball]), arm=arm, state=at_rest(start), max_tilt=TILT)
    assert plan.feasible, plan.reason
    assert plan.only_on_schedule
    for q, t in zip(plan.joints, plan.trajectory.times, strict=True):
        centers, radii = arm.collision_spheres(q)
        assert (ball.after(t).signed_distance(centers) - radii).min() >= 0.02 - 1e-9


def test_arguments_that_do_not_go_together_are_refused(real_data):
    skill, arm, start = prepared(real_data, "sawyer")
    with pytest.raises(InputError, match="state can't be used without arm"):
        adapt(skill, Scene(), tool_radius=0.01, state=at_rest(start))
    with pytest.raises(InputError, match="max_tilt"):
        adapt(skill, Scene(), arm=arm, state=at_rest(start), max_tilt=-1.0)
    with pytest.raises(InputError, match="with the tool's pose as its start"):
        adapt(ComponentPath.of_skill(skill), Scene(), arm=arm, state=at_rest(start + 0.1))


SIX = """<mujoco><compiler angle="radian"/><worldbody>
<body name="l1" pos="0 0 .2"><joint name="a" axis="0 0 1" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 0 0 .1" size=".06" mass="3" group="3"/><body name="l2" pos="0 0 .1">
<joint name="b" axis="0 1 0" range="-2 2"/><geom type="capsule" fromto="0 0 0 0 0 .4" size=".05" mass="3" group="3"/>
<body name="l3" pos="0 0 .4"><joint name="c" axis="0 1 0" range="-2.5 2.5"/>
<geom type="capsule" fromto="0 0 .06 0 0 .35" size=".045" mass="2" group="3"/><body name="l4" pos="0 0 .35">
<joint name="d" axis="0 0 1" range="-3 3"/><geom type="capsule" fromto="0 0 0 0 0 .06" size=".04" mass="1" group="3"/>
<body name="l5" pos="0 0 .06"><joint name="e" axis="0 1 0" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 0 0 .06" size=".04" mass="1" group="3"/><body name="l6" pos="0 0 .1">
<joint name="f" axis="0 0 1" range="-3 3"/><geom type="capsule" fromto="0 0 0 0 0 .08" size=".035" mass=".5" group="3"/>
<site name="flange" pos="0 0 .1"/></body></body></body></body></body></body></worldbody>
<keyframe><key name="home" qpos="0 .3 1.2 0 1.2 0"/></keyframe></mujoco>"""


def test_an_arm_with_six_joints_has_no_self_motion_and_is_planned_all_the_same(tmp_path):
    file = tmp_path / "six.xml"
    file.write_text(SIX)
    arm = ArmModel.load(file)
    home = arm.tool_pose(arm.home).position
    steps = np.linspace(0.0, 1.0, 100)
    rise = steps**3 * (10.0 - 15.0 * steps + 6.0 * steps**2)
    shown = [
        Demonstration(
            Trajectory(4.0 * steps, home + np.outer(rise, [-0.1, 0.3, -0.05]) + [0.002 * i, 0.0, 0.0]), task="go"
        )
        for i in range(4)
    ]
    skill = Skill(6).fit(shown)
    learned = skill.generate().positions
    middle = learned[len(learned) // 2]
    scene = Scene(None, [Sphere(middle + [0.0, 0.0, -0.02], 0.03, name="ball")])
    plan = adapt(skill, scene, arm=arm)
    assert plan.feasible, plan.reason
    for q in plan.joints:
        centers, radii = arm.collision_spheres(q)
        assert (scene.obstacles[0].signed_distance(centers) - radii).min() >= 0.02 - 1e-9


def test_an_arm_without_collision_shapes_is_refused(tmp_path):
    file = tmp_path / "bare.xml"
    file.write_text(SIX.replace(' group="3"', ' group="1" contype="0" conaffinity="0"'))
    arm = ArmModel.load(file)
    assert len(arm.cover.radii) == 0
    end = arm.tool_pose(arm.home).position
    steps = np.linspace(0.0, 1.0, 50)
    path = Trajectory(steps, end + np.outer(steps**2 * (3.0 - 2.0 * steps), [0.02, 0.1, 0.03]))
    skill = Skill(3).fit([Demonstration(path, task="go")] * 3)
    with pytest.raises(InputError, match="no collision shapes"):
        adapt(skill, Scene(), arm=arm)


@pytest.mark.parametrize(("name", "seed"), [("sawyer", 2104), ("sawyer", 2232), ("panda", 2057)])
def test_narrow_scenes_that_were_refused_are_solved(real_data, name, seed):
    skill, arm, start = prepared(real_data, name, shelf)
    scene = placement(skill, arm, seed, start)
    plan = adapt(skill, scene, arm=arm, state=at_rest(start), max_tilt=TILT)
    assert plan.feasible, plan.reason
    assert plan.certified_clearance >= 0.02
    assert measured_clearance(arm, scene, plan.joints) >= 0.02
    approach = 0.0 if plan.approach is None else plan.approach.times[-1]
    assert approach + plan.trajectory.duration <= 1.5 * skill.duration_


def test_where_the_tool_itself_is_too_slow_only_other_paths_of_the_tool_are_tried(real_data, monkeypatch):
    """Other postures can't help, so none are looked for: the time is for paths farther from the obstacle."""
    quick = Skill(8).fit(align(read(real_data / "panda_kinesthetic" / "pouring.npy", units="cm", duration=4.0)))
    arm, durations = ARMS["sawyer"], []
    start = find_posture(arm, quick.start_)
    is_late = whole_arm._Search._tool_is_late

    def noted(search, path, clock):
        durations.append(clock[-1])
        return is_late(search, path, clock)

    monkeypatch.setattr(whole_arm._Search, "_tool_is_late", noted)
    monkeypatch.setattr(whole_arm, "clear_postures", lambda *_: pytest.fail("no other posture is needed"))
    plan = adapt(quick, placement(quick, arm, 8, start), arm=arm, state=at_rest(start), max_tilt=TILT)
    assert plan.feasible
    assert durations
    assert plan.trajectory.duration < durations[0] - 0.1


def test_a_refusal_after_components_were_divided_has_arrays_of_one_length():
    """A ball drives into the shoulder; the last attempt had more components than the skill."""
    arm = ArmModel.load("sawyer", tool="brush")
    skill = Skill(10).fit(align(read(DEMONSTRATIONS)))
    ball = Sphere([0.9, 0.0, 0.35], 0.1, velocity=[-0.15, 0.0, 0.0])
    refused = adapt(skill, Scene(None, [ball]), arm=arm, clearance=0.02)
    assert not refused.feasible
    n = len(refused.means)
    assert refused.displacement.shape == (n, 3) and refused.moved.shape == (n,) and len(refused.covariances) == n
    assert refused.responsibilities.shape[1] == n
