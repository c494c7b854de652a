"""RRT-Connect: its joint paths are clear by other geometry, end at the goal, keep all limits, or are refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import mujoco
import numpy as np
import pytest

from imitarm import ArmModel, InfeasibleError, InputError, Scene, SimulatedRobot, Skill, Sphere, find_posture
from imitarm.benchmark.placements import placement
from imitarm.control_loop import reproduce
from imitarm.demonstrations import align, read
from imitarm.evaluation.path_style import tilts
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies import POLICIES
from imitarm.policies.baselines.joint_planner import RRTConnect, TiltLimitedRRTConnect
from imitarm.safety import SafetyFilter
from imitarm.tasks.sweep import DEMONSTRATIONS

TILT = np.deg2rad(30.0)
TOOLS = {"sawyer": "brush", "panda": "gripper"}


@lru_cache
def prepared(name):
    skill, arm = Skill(10).fit(align(read(DEMONSTRATIONS))), ArmModel.load(name, tool=TOOLS[name])
    return skill, arm, find_posture(arm, skill.start_)


def at_rest(q) -> ArmState:
    return ArmState(np.asarray(q), np.zeros(7), np.zeros(7), 0.0)


def measured_clearance(arm, scene, joints) -> float:
    """The smallest distance of the simulator's exact shapes, at four postures of each segment."""
    robot = SimulatedRobot(arm, scene=scene, q=joints[0])
    addresses = [robot.model.joint(joint).qposadr[0] for joint in arm.joint_names]
    lowest = np.inf
    for a, b in pairwise(joints):
        for fraction in np.linspace(0.0, 1.0, 4, endpoint=False):
            robot.data.qpos[addresses] = a + fraction * (b - a)
            mujoco.mj_kinematics(robot.model, robot.data)
            lowest = min(lowest, robot.clearance())
    return lowest


@pytest.mark.parametrize("name", TOOLS)
@pytest.mark.parametrize("seed", [1, 2, 5])
@pytest.mark.parametrize("max_tilt", [None, TILT])
def test_a_path_is_clear_by_the_geometry_of_the_simulator_and_ends_at_the_goal(name, seed, max_tilt):
    skill, arm, start = prepared(name)
    scene = placement(skill, arm, seed, start)
    motion = RRTConnect(skill, arm=arm, max_tilt=max_tilt).plan_motion(scene, state=at_rest(start))
    joints, path = motion.joints, motion.trajectory
    assert measured_clearance(arm, scene, joints) >= 0.02
    np.testing.assert_array_equal(joints[0], start)
    goal = arm.tool_pose(joints[-1])
    np.testing.assert_allclose(goal.position, skill.goal_.position, atol=1e-5)
    turned = quaternion_log(quaternion_multiply(goal.quaternion, quaternion_conjugate(skill.goal_.quaternion)))
    assert np.linalg.norm(turned) < 1e-4
    assert (joints >= arm.lower).all()
    assert (joints <= arm.upper).all()
    assert (np.abs(np.diff(joints, axis=0)) <= 1.001 * np.diff(path.times)[:, None] * arm.max_velocity).all()
    for i in (0, len(path) // 2, -1):  # the trajectory is that of the joints
        np.testing.assert_allclose(path.positions[i], arm.tool_pose(joints[i]).position, atol=1e-9)
    if max_tilt is not None:
        tilt, _ = tilts(skill.nominal(np.linspace(0.0, skill.duration_, 200)), path.positions, path.quaternions)
        assert tilt.max() <= max_tilt + 0.01


def test_the_same_seed_gives_the_same_path_and_another_seed_another():
    skill, arm, start = prepared("panda")
    scene = placement(skill, arm, 2, start)
    one, same, other = (
        RRTConnect(skill, arm=arm, seed=seed).plan_motion(scene, state=at_rest(start)).joints for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert one.shape != other.shape or not np.array_equal(one, other)


def test_the_safety_filter_follows_the_path_and_the_arm_arrives():
    skill, arm, start = prepared("panda")
    scene = placement(skill, arm, 2, start)
    robot = SimulatedRobot(arm, scene=scene, q=start)
    safety = SafetyFilter(arm, clearance=0.02)
    done = reproduce(RRTConnect(skill, arm=arm), robot, scene.at, safety=safety, timeout=2.0 * skill.duration_)
    assert done.success, done.reason
    assert done.min_clearance >= 0.02
    assert not robot.contacts
    np.testing.assert_allclose(done.trajectory.positions[-1], skill.goal_.position, atol=3e-3)


def test_what_can_not_be_reached_is_refused_with_the_reason():
    skill, arm, start = prepared("panda")
    policy = RRTConnect(skill, arm=arm, seconds=0.3)
    at_goal = Sphere(skill.goal_.position, 0.05)
    at_start = Sphere(skill.start_.position, 0.05)
    moving = Sphere([2.0, 2.0, 2.0], 0.05, velocity=[0.1, 0.0, 0.0])
    for obstacle, reason in ((at_goal, "tool is at the goal"), (at_start, "start posture"), (moving, "stand still")):
        with pytest.raises(InfeasibleError, match=reason):
            policy.plan_motion(Scene(None, (obstacle,)), state=at_rest(start))
    scene = placement(skill, arm, 2, start)
    with pytest.raises(InfeasibleError, match=r"no clear joint path was found in 0\.3 s"):
        RRTConnect(skill, arm=arm, seconds=0.3, max_tilt=1e-4).plan_motion(scene, state=at_rest(start))


def test_the_tilt_limited_planner_takes_its_limit_from_the_demonstrations():
    skill, arm, start = prepared("panda")
    policy = TiltLimitedRRTConnect(skill, arm=arm)
    limit = policy._limits(policy._path)
    np.testing.assert_array_equal(limit, policy._path.rotation_tolerance)
    assert RRTConnect(skill, arm=arm)._limits(policy._path) is None
    policy._path = replace(policy._path, rotation_tolerance=np.zeros_like(limit))
    with pytest.raises(InfeasibleError, match="max_tilt"):
        policy.plan_motion(Scene(), state=at_rest(start))


def test_wrong_arguments_are_rejected_and_a_missing_library_is_named(monkeypatch):
    skill, arm, _ = prepared("panda")
    for options, said in (
        ({}, "needs the argument arm"),
        ({"arm": arm, "forbidden": [[0.0, 0.0, 1.0]]}, "forbidden directions"),
        ({"arm": arm, "seconds": 0.0}, "seconds"),
        ({"arm": arm, "seed": 0}, "seed"),
        ({"arm": arm, "max_tilt": -1.0}, "max_tilt"),
    ):
        with pytest.raises(InputError, match=said):
            RRTConnect(skill, **options)
    assert POLICIES["rrt-connect"] is RRTConnect
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(InputError, match=r"pip install 'imitarm\[planner\]'"):
        RRTConnect(skill, arm=arm)
