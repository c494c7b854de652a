"""Planning again on the way: from where the arm is, on the same side, certified, without a jump."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import ArmModel, InputError, Pose, Scene, Skill, Sphere, adapt, find_posture, replan
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.policies.remainder import Remainder
from imitarm.trajectory import Demonstration, Trajectory

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
OPTIONS = {"max_tilt": np.deg2rad(30.0), "allowance": 0.005}
each_arm = pytest.mark.parametrize("name", ARMS)


@lru_cache
def carrying(name) -> tuple[Skill, ArmModel, np.ndarray]:
    """A skill that carries the tool to the side and turns it, and the posture in which it starts."""
    arm, rng = ARMS[name], np.random.default_rng(0)
    home, u = arm.tool_pose(arm.home), np.linspace(0.0, 1.0, 100)
    rise = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    shown = []
    for _ in range(4):
        positions = home.position + np.outer(rise, np.array([0.02, 0.4, -0.05]) + 0.01 * rng.normal(size=3))
        turn = quaternion_exp(np.outer(rise, [0.0, 0.0, 0.5]))
        rotations = quaternion_multiply(turn, np.tile(home.quaternion, (len(u), 1)))
        shown.append(Demonstration(Trajectory(6.0 * u, positions, rotations), task="carry"))
    skill = Skill(8).fit(shown)
    return skill, arm, find_posture(arm, Pose(skill.start_.position, skill.start_.quaternion))


def at(arm, q, velocity=None) -> ArmState:
    still = np.zeros(arm.n_joints)
    return ArmState(np.asarray(q), still if velocity is None else velocity, still, 0.0)


@lru_cache
def planned(name):
    skill, arm, start = carrying(name)
    path = skill.generate().positions
    scene = Scene(None, [Sphere(path[len(path) // 2] + [0.0, 0.0, -0.02], 0.04, name="ball")])
    plan = adapt(skill, scene, arm=arm, state=at(arm, start), **OPTIONS)
    assert plan.feasible, plan.reason
    assert plan.moved.any()
    return scene, plan


def on_the_way(arm, plan, phase) -> ArmState:
    """The state of an arm that follows a plan exactly."""

    def joints(time):
        return np.array([np.interp(time, plan.trajectory.times, column) for column in plan.joints.T])

    return at(arm, joints(phase), (joints(phase + 1e-3) - joints(phase - 1e-3)) / 2e-3)


def clearance_of(arm, scene, plan) -> float:
    """The smallest distance from the arm's spheres to an obstacle, densely along the joint path."""
    steps = np.linspace(0.0, len(plan.joints) - 1.0, 600)
    dense = np.stack([np.interp(steps, np.arange(len(plan.joints)), column) for column in plan.joints.T], axis=1)
    times = np.interp(steps, np.arange(len(plan.joints)), plan.trajectory.times)
    lowest = np.inf
    for q, time in zip(dense, times, strict=True):
        centers, radii = arm.collision_spheres(q)
        lowest = min(lowest, *((o.after(time).signed_distance(centers) - radii).min() for o in scene.obstacles))
    return float(lowest)


def towards(arm, ball, plan) -> np.ndarray:
    """The direction from an obstacle to the part of the arm that comes nearest to it."""
    places = [arm.collision_spheres(q) for q in plan.joints]
    gaps = np.array([np.linalg.norm(centers - ball.center, axis=1) - radii for centers, radii in places])
    sample, sphere = np.unravel_index(np.argmin(gaps), gaps.shape)
    away = places[sample][0][sphere] - ball.center
    return away / np.linalg.norm(away)


@each_arm
@settings(max_examples=8)
@given(share=st.floats(0.02, 0.97))
def test_where_nothing_has_changed_the_same_path_is_planned_and_certified(name, share):
    _, arm, _ = carrying(name)
    scene, plan = planned(name)
    phase = share * plan.trajectory.duration
    state = on_the_way(arm, plan, phase)
    again = replan(plan, scene, arm=arm, state=state, phase=phase, **OPTIONS)
    assert again.feasible, again.reason
    assert again.approach is None
    assert again.certified_clearance >= 0.02
    np.testing.assert_allclose(again.joints[0], state.q, atol=1e-9)
    assert again.trajectory.times[0] == 0.0
    assert again.trajectory.duration == pytest.approx(plan.trajectory.duration - phase, abs=0.2)
    rest = Remainder.of(plan.arm_plan, np.interp(phase, plan.trajectory.times, plan.nominal.times), state)
    before = Trajectory(plan.nominal.times, plan.trajectory.positions)
    expected, _ = before.at(again.nominal.times + rest.begins)
    np.testing.assert_allclose(again.trajectory.positions, expected, atol=2e-3)
    velocity = (again.joints[1] - again.joints[0]) / again.trajectory.times[1]
    assert (np.abs(velocity) <= arm.max_velocity).all()
    np.testing.assert_allclose(velocity, state.velocity, atol=0.15)


@each_arm
@pytest.mark.parametrize("share", [0.1, 0.2, 0.35])
def test_around_an_obstacle_that_was_moved_a_new_path_is_certified(name, share):
    _, arm, _ = carrying(name)
    scene, plan = planned(name)
    phase = share * plan.trajectory.duration
    state = on_the_way(arm, plan, phase)
    ball = scene.obstacles[0]
    moved = Scene(None, [replace(ball, center=ball.center + 0.012 * towards(arm, ball, plan))])
    assert clearance_of(arm, moved, plan) < 0.02  # so that the old plan does not do
    again = replan(plan, moved, arm=arm, state=state, phase=phase, **OPTIONS)
    assert again.feasible, again.reason
    assert again.certified_clearance >= 0.02
    assert clearance_of(arm, moved, again) >= again.certified_clearance - 1e-6
    np.testing.assert_allclose(again.joints[0], state.q, atol=1e-9)
    velocity = (again.joints[1] - again.joints[0]) / again.trajectory.times[1]
    assert (np.abs(velocity) <= arm.max_velocity).all()
    np.testing.assert_allclose(velocity, state.velocity, atol=0.15)


def test_an_obstacle_that_begins_to_move_is_certified_on_schedule():
    _, arm, _ = carrying("sawyer")
    scene, plan = planned("sawyer")
    phase = 0.2 * plan.trajectory.duration
    crossing = Scene(None, [replace(scene.obstacles[0], velocity=np.array([0.01, 0.0, 0.0]))])
    again = replan(plan, crossing, arm=arm, state=on_the_way(arm, plan, phase), phase=phase, **OPTIONS)
    assert again.feasible, again.reason
    assert again.only_on_schedule
    assert "only from 0 to" in again.validity
    assert clearance_of(arm, crossing, again) >= 0.02 - 1e-6


def test_an_arm_beside_its_path_returns_to_it():
    skill, arm, _ = carrying("panda")
    scene, plan = planned("panda")
    phase = 0.5 * plan.trajectory.duration
    state = on_the_way(arm, plan, phase)
    aside = at(arm, state.q + 0.01 * np.random.default_rng(3).normal(size=7), state.velocity)
    again = replan(plan, scene, arm=arm, state=aside, phase=phase, **OPTIONS)
    assert again.feasible, again.reason
    np.testing.assert_allclose(again.joints[0], aside.q, atol=1e-9)
    np.testing.assert_allclose(again.trajectory.positions[-1], skill.goal_.position, atol=1e-4)


def test_one_can_plan_again_and_again_until_the_goal():
    skill, arm, _ = carrying("sawyer")
    scene, plan = planned("sawyer")
    goal = plan.trajectory.positions[-1]
    for _ in range(12):
        phase = 0.3 * plan.trajectory.duration
        plan = replan(plan, scene, arm=arm, state=on_the_way(arm, plan, phase), phase=phase, **OPTIONS)
        assert plan.feasible, plan.reason
        np.testing.assert_allclose(plan.trajectory.positions[-1], goal, atol=1e-4)
    assert plan.trajectory.duration < 0.3 * skill.duration_


def test_a_goal_that_is_now_blocked_is_refused_and_nothing_of_it_can_be_executed():
    _, arm, _ = carrying("sawyer")
    scene, plan = planned("sawyer")
    phase = 0.4 * plan.trajectory.duration
    post = Sphere(plan.trajectory.positions[-1], 0.05, name="post")
    blocked = Scene(None, [*scene.obstacles, post])
    again = replan(plan, blocked, arm=arm, state=on_the_way(arm, plan, phase), phase=phase, **OPTIONS)
    assert not again.feasible
    assert "post" in again.reason
    assert again.joints is None
    assert again.approach is None


def test_what_cannot_be_planned_again_is_refused_with_the_reason():
    skill, arm, start = carrying("sawyer")
    scene, plan = planned("sawyer")
    tool = adapt(skill, scene, tool_radius=0.05)
    options = {"arm": arm, "state": at(arm, start)}
    with pytest.raises(InputError, match=r"call adapt\(\.\.\., arm"):
        replan(tool, scene, phase=0.0, **options)
    with pytest.raises(InputError, match="the motion is over"):
        replan(plan, scene, phase=100.0, **options)
    with pytest.raises(InputError, match="another goal"):
        replan(plan, replace(scene, goal=Pose([0.5, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0])), phase=0.0, **options)
    with pytest.raises(InputError, match="joints"):
        replan(plan, scene, arm=arm, state=ArmState(np.zeros(6), np.zeros(6), np.zeros(6), 0.0), phase=0.0)


@each_arm
def test_at_pinned_times_the_tool_is_where_it_was_shown_and_not_tilted(name):
    skill, arm, start = carrying(name)
    scene, free = planned(name)
    pinned = (0.3 * skill.duration_, 0.75 * skill.duration_)
    plan = adapt(skill, scene, arm=arm, state=at(arm, start), pinned=pinned, **OPTIONS)
    assert plan.feasible, plan.reason
    assert plan.moved.any()
    nominal = plan.nominal
    for pin in pinned:
        i = int(np.argmin(np.abs(nominal.times - pin)))
        assert nominal.times[i] == pytest.approx(pin)
        pose = arm.tool_pose(plan.joints[i])
        np.testing.assert_allclose(pose.position, nominal.positions[i], atol=1e-5)
        assert np.linalg.norm(pose.error_to(Pose(nominal.positions[i], nominal.quaternions[i]))) < 1e-4
        away, _ = Trajectory(free.nominal.times, free.trajectory.positions).at([pin])
        assert np.linalg.norm(away[0] - nominal.positions[i]) > 1e-3  # without the pin, it is displaced there
    phase = 0.2 * plan.trajectory.duration
    again = replan(plan, scene, arm=arm, state=on_the_way(arm, plan, phase), phase=phase, **OPTIONS)
    assert again.feasible, again.reason
    left = Remainder.of(plan.arm_plan, np.interp(phase, plan.trajectory.times, nominal.times), at(arm, again.joints[0]))
    for pin in pinned:  # still pinned
        i = int(np.argmin(np.abs(again.nominal.times + left.begins - pin)))
        np.testing.assert_allclose(again.trajectory.positions[i], again.nominal.positions[i], atol=1e-5)


def test_an_obstacle_at_a_pinned_point_is_refused_with_the_time():
    skill, arm, start = carrying("sawyer")
    nominal = skill.generate()
    pin = 0.5 * skill.duration_
    place, _ = nominal.at([pin])
    scene = Scene(None, [Sphere(place[0], 0.03, name="cup")])
    plan = adapt(skill, scene, arm=arm, state=at(arm, start), pinned=[pin], **OPTIONS)
    assert not plan.feasible
    assert "cup" in plan.reason
    assert "pinned" in plan.reason


def test_a_link_at_an_obstacle_at_a_pinned_time_moves_away_by_self_motion_or_the_scene_is_refused():
    skill, arm, start = carrying("sawyer")
    free = adapt(skill, Scene(), arm=arm, state=at(arm, start))
    middle = free.joints[len(free.joints) // 2]
    centers, radii = arm.collision_spheres(middle)
    elbow = int(np.flatnonzero(arm.cover.links == 4)[0])
    post = Sphere(centers[elbow] + [0.0, 0.0, radii[elbow] + 0.04], 0.03, name="lamp")
    pin = float(free.nominal.times[len(free.joints) // 2])
    plan = adapt(skill, Scene(None, [post]), arm=arm, state=at(arm, start), pinned=[pin], **OPTIONS)
    if not plan.feasible:
        assert "lamp" in plan.reason
        return
    i = int(np.argmin(np.abs(plan.nominal.times - pin)))
    np.testing.assert_allclose(plan.trajectory.positions[i], plan.nominal.positions[i], atol=1e-5)
    assert clearance_of(arm, Scene(None, [post]), plan) >= 0.02 - 1e-6


@each_arm
def test_a_limited_search_ends_early_and_goes_on_in_the_next_one(name):
    _, arm, _ = carrying(name)
    scene, plan = planned(name)
    state, ball = on_the_way(arm, plan, 1.0), scene.obstacles[0]
    nearer = Scene(None, [replace(ball, center=ball.center + 0.035 * towards(arm, ball, plan))])
    options = {**OPTIONS, "arm": arm, "state": state, "phase": 1.0, "max_attempts": 1}
    assert replan(plan, nearer, **options).feasible
    found = replan(plan, nearer, max_rounds=1, **options)
    assert not found.feasible
    for _ in range(12):
        guess = found.displacement
        found = replan(plan, nearer, max_rounds=3, displacement=guess, **options)
        if found.feasible:
            break
    assert found.feasible, found.reason
    assert clearance_of(arm, nearer, found) >= 0.02 - 1e-6
    for wrong in (np.zeros(3), np.full_like(plan.displacement, np.nan)):
        with pytest.raises(InputError, match="displacement"):
            replan(plan, nearer, displacement=wrong, **options)
    with pytest.raises(InputError, match="max_rounds"):
        replan(plan, nearer, max_rounds=0, **options)
