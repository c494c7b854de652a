"""The policy ACFRA: it follows the adapted path, waits for what lags, and refuses what it can't do."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import covered_end, sparse_clutter
from imitarm.command import Status
from imitarm.errors import InfeasibleError, InputError, UnknownNameError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.policies import ACFRA, POLICIES, Observation, Policy
from imitarm.scene import Scene, Sphere

DT = 0.01
STILL = ArmState(np.zeros(7), np.zeros(7), np.zeros(7), 0.0)


@pytest.fixture(scope="module")
def skill_and_path():
    return learn(planar=False)


def fly(policy, scene, start, *, top_speed=np.inf, held=(), steps=2000):
    """Let a point without inertia follow the policy; it stands still while it is held, and is never too fast."""
    position, quaternion, track = np.array(start, dtype=float), np.array([1.0, 0, 0, 0]), []
    policy.reset(Observation(0.0, STILL, Pose(position, quaternion), scene))
    for k in range(steps):
        observation = Observation(k * DT, STILL, Pose(position, quaternion / np.linalg.norm(quaternion)), scene)
        if policy.finished(observation):
            break
        twist = policy.step(observation, DT).twist
        velocity = twist[:3] * min(1.0, top_speed / max(np.linalg.norm(twist[:3]), 1e-12))
        if k not in held:
            position = position + DT * velocity
            quaternion = quaternion_multiply(quaternion_exp(DT * twist[3:]), quaternion)
        track.append(position)
    return np.array(track), observation


def test_registered_and_a_policy():
    assert POLICIES["acfra"] is ACFRA and issubclass(ACFRA, Policy)


def test_reaches_the_goal_and_keeps_clear(skill_and_path):
    skill, path = skill_and_path
    for seed in range(8):
        scene = sparse_clutter(seed, path, n_obstacles=2, planar=False).scene
        policy = ACFRA(skill, tool_radius=0.03)
        track, last = fly(policy, scene, skill.start_.position)
        assert policy.finished(last)
        assert np.linalg.norm(track[-1] - skill.goal_.position) < 0.004
        assert scene.clearance(track).min() - 0.03 > 0.018
        assert len(track) * DT < 1.3 * skill.duration_


def test_the_phase_waits_for_a_robot_that_is_held(skill_and_path):
    skill, path = skill_and_path
    scene = sparse_clutter(1, path, n_obstacles=1, planar=False).scene
    free, _ = fly(ACFRA(skill, tool_radius=0.03), scene, skill.start_.position)
    policy = ACFRA(skill, tool_radius=0.03)
    held, last = fly(policy, scene, skill.start_.position, held=range(150, 450))
    assert policy.finished(last)
    assert scene.clearance(held).min() - 0.03 > 0.0099  # the corner is cut by no more than half the clearance
    assert len(held) > len(free) + 200


def test_a_slow_robot_follows_the_same_path(skill_and_path):
    skill, path = skill_and_path
    scene = sparse_clutter(2, path, n_obstacles=1, planar=False).scene
    policy = ACFRA(skill, tool_radius=0.03)
    slow, last = fly(policy, scene, skill.start_.position, top_speed=0.08)
    assert policy.finished(last)
    assert scene.clearance(slow).min() - 0.03 > 0.0099


def test_begins_where_the_tool_is(skill_and_path):
    skill, _ = skill_and_path
    away = np.add(skill.start_.position, [0.0, 0.06, 0.05])
    policy = ACFRA(skill, tool_radius=0.0)
    track, last = fly(policy, Scene(), away)
    assert policy.finished(last)
    assert np.linalg.norm(np.diff(track, axis=0), axis=1).max() < 0.006  # no jump to the learnt start
    np.testing.assert_allclose(policy.adaptation.nominal.positions[0], away, atol=1e-9)


def test_refuses_with_the_reason(skill_and_path):
    skill, path = skill_and_path
    case = covered_end(3, path, planar=False)
    with pytest.raises(InfeasibleError, match="sphere"):
        ACFRA(skill, tool_radius=0.03).reset(Observation(0.0, STILL, skill.start_, case.scene))


def test_a_moving_obstacle_is_passed_on_schedule_and_a_late_arm_brakes_and_says_so(skill_and_path):
    """The certificate among moving obstacles holds at the planned times only."""
    skill, path = skill_and_path
    middle = path[len(path) // 2]
    velocity = np.array([0.0, 0.0, 0.08])
    ball = Sphere(middle - 0.5 * skill.duration_ * velocity, 0.04, velocity=velocity)
    scene = Scene(None, [ball])
    policy = ACFRA(skill, tool_radius=0.03)
    track, last = fly(policy, scene, skill.start_.position)
    assert policy.adaptation.only_on_schedule and policy.finished(last)
    times = DT * (1.0 + np.arange(len(track)))
    apart = [scene.at(t).clearance(p) - 0.03 for t, p in zip(times, track, strict=True)]
    assert min(apart) > 0.0195
    assert len(track) * DT == pytest.approx(skill.duration_, abs=0.1)
    held, last = fly(ACFRA(skill, tool_radius=0.03), scene, skill.start_.position, held=range(100, 200), steps=400)
    late = ACFRA(skill, tool_radius=0.03)
    fly(late, scene, skill.start_.position, held=range(100, 200), steps=400)
    command = late.step(last, DT)
    assert command.status is Status.BRAKING and "only at the planned times" in command.reason
    assert not command.twist.any() and not late.finished(last)
    np.testing.assert_array_equal(held[-1], held[-100])  # and stays


def test_the_command_says_how_it_goes(skill_and_path):
    skill, path = skill_and_path
    scene = sparse_clutter(1, path, n_obstacles=1, planar=False).scene
    policy, seen, position = ACFRA(skill, tool_radius=0.03), [], skill.start_.position
    policy.reset(Observation(0.0, STILL, Pose(position, [1, 0, 0, 0]), scene))
    for k in range(600):
        seen.append(policy.step(Observation(k * DT, STILL, Pose(position, [1, 0, 0, 0]), scene), DT))
        position = position + (DT * seen[-1].twist[:3] if k < 200 else 0.0)
    assert seen[0].status is Status.NOMINAL and not seen[0].reason
    assert any(command.status is Status.AVOIDING and "displaced by" in command.reason for command in seen)
    assert seen[-1].status is Status.WAITING and "behind its path" in seen[-1].reason
    progress = [command.progress for command in seen]
    assert progress == sorted(progress) and 0.0 <= progress[0] < progress[-1] < 1.0


def test_step_before_reset_and_unknown_methods_are_errors(skill_and_path):
    skill, _ = skill_and_path
    policy = ACFRA(skill, tool_radius=0.0)
    observation = Observation(0.0, STILL, skill.start_, Scene())
    assert not policy.finished(observation)
    with pytest.raises(InputError, match="reset"):
        policy.step(observation, DT)
    with pytest.raises(UnknownNameError, match="certified"):
        ACFRA(skill, method="magic")
