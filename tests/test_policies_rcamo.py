"""RCAMO: the tool alone, moved exactly as commanded; distances are measured here, not by the policy."""

import numpy as np
import pytest

from imitarm.command import Status
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import POLICIES, RCAMO, Observation
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from skill_samples import shown

REST = np.zeros(7)
TOOL = 0.03  # [m]


@pytest.fixture(scope="module")
def skill():
    return Skill(5).fit(shown(turn=None))


def observation(time, position, scene, quaternion=(1.0, 0.0, 0.0, 0.0)):
    pose = Pose(np.array(position), np.array(quaternion))
    return Observation(time, ArmState(REST.copy(), REST.copy(), REST.copy(), float(time)), pose, scene)


def follow(policy, observe, start, dt=0.01, longest=8.0):
    """Move the tool exactly as commanded; return the path, the statuses and whether the motion has finished."""
    x = np.array(start, dtype=float)
    policy.reset(observation(0.0, x, observe(0.0)))
    path, commands = [x], []
    for k in range(round(longest / dt)):
        now = observation(k * dt, x, observe(k * dt))
        if policy.finished(now):
            return np.array(path), commands, True
        commands.append(policy.step(now, dt))
        x = x + dt * commands[-1].twist[:3]
        path.append(x)
    return np.array(path), commands, False


def meeting(skill, rng, family):
    """A sphere that meets the tool in the middle part of the motion."""
    T = skill.duration_
    times = T * (rng.uniform(0.3, 0.7) + np.array([-0.01, 0.0, 0.01]))
    before, here, after = skill.nominal(times).positions
    along = (after - before) / np.linalg.norm(after - before)
    side = rng.standard_normal(3)
    side -= side @ along * along
    side /= np.linalg.norm(side)
    direction = {"static": 0.0 * along, "crossing": side, "oncoming": -along, "chasing": 1.5 * along}[family]
    velocity = rng.uniform(0.2, 0.5) * direction
    return Sphere(here - times[1] * velocity, rng.uniform(0.025, 0.045), velocity=velocity)


def gap(path, ball, dt=0.01):
    centers = ball.center + dt * np.arange(len(path))[:, None] * ball.velocity
    return np.linalg.norm(path - centers, axis=1) - ball.radius - TOOL


@pytest.mark.parametrize("family", ["static", "crossing", "oncoming", "chasing"])
def test_the_tool_evades_an_obstacle_that_would_meet_it_and_arrives(skill, family):
    for seed in range(3):
        ball = meeting(skill, np.random.default_rng([seed, 5]), family)
        scene = Scene(obstacles=[ball])
        policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]])
        path, commands, finished = follow(policy, lambda t, scene=scene: scene, skill.start_.position)
        nominal = skill.nominal(np.linspace(0.0, skill.duration_, 201)).positions
        assert gap(nominal, ball, skill.duration_ / 200).min() < 0.0
        assert finished and gap(path, ball).min() > 0.01
        assert np.linalg.norm(path[-1] - skill.goal_.position) < 0.003
        assert any(command.status is Status.AVOIDING and "sphere 1" in command.reason for command in commands)


def test_without_obstacles_it_follows_the_primitive(skill):
    path, commands, finished = follow(RCAMO(skill), lambda t: Scene(), skill.start_.position)
    nominal = skill.generate(dt=0.01).positions
    assert finished and np.abs(path[: len(nominal)] - nominal[: len(path)]).max() < 1e-4
    assert {command.status for command in commands} == {Status.NOMINAL}


def test_it_is_registered_and_resumes_from_any_state(skill):
    policy = POLICIES["rcamo"].build(skill, tool_spheres=None, clearance=0.02, forbidden=(), arm=None)
    away = skill.nominal([0.5 * skill.duration_, 0.6 * skill.duration_]).positions[0] + [0.0, 0.05, 0.0]
    policy.resume(observation(3.0, away, Scene()), 0.5)
    assert policy.phase == 0.5
    x, time = away, 3.0
    for _ in range(300):
        now = observation(time, x, Scene())
        if policy.finished(now):
            break
        x, time = x + 0.01 * policy.step(now, 0.01).twist[:3], time + 0.01
    assert policy.finished(observation(time, x, Scene()))
