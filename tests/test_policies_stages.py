"""Motions one after another, with a gripper between them."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import Observation, Policy, Stage, StagedPolicy
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks.habits import s_shaped_demonstrations

SKILL = Skill(4).fit(s_shaped_demonstrations(planar=False))
AHEAD = Pose(np.array([0.3, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0]))


class Straight(Policy):
    """Moves straight to the goal of the scene; refuses while an obstacle contains it."""

    def reset(self, observation):
        scene = observation.scene
        if scene.obstacles and scene.clearance(scene.goal.position) < 0.0:
            raise InfeasibleError("the goal is blocked")
        self.begins = observation.tool_to_base.position

    def step(self, observation, dt):
        away = observation.scene.goal.position - observation.tool_to_base.position
        return Command(np.concatenate([away / max(dt, np.linalg.norm(away) / 0.5), np.zeros(3)]), progress=0.5)

    def finished(self, observation):
        return np.linalg.norm(observation.scene.goal.position - observation.tool_to_base.position) < 1e-3


def at(time, position, scene):
    state = ArmState(np.zeros(7), np.zeros(7), np.zeros(7), time)
    return Observation(time, state, Pose(position, np.array([1.0, 0.0, 0.0, 0.0])), scene)


def moved(policy, scenes, position, seconds, dt=0.01):
    """Let an ideal tool follow a policy; return positions, commands, and whether it finished."""
    policy.reset(at(0.0, position, scenes(0.0)))
    path, commands = [np.array(position)], []
    for k in range(round(seconds / dt)):
        seen = at(k * dt, path[-1], scenes(k * dt))
        if policy.finished(seen):
            return np.array(path), commands, True
        commands.append(policy.step(seen, dt))
        path.append(path[-1] + dt * commands[-1].twist[:3])
    return np.array(path), commands, False


def two_stages(hold=0.3):
    first, second = Pose([0.3, 0.0, 0.0], [1, 0, 0, 0]), Pose([0.3, 0.2, 0.0], [1, 0, 0, 0])
    return StagedPolicy(
        [
            Stage("reach", Straight(SKILL), goal=lambda scene: first, opening=0.0, hold=hold),
            Stage("carry", Straight(SKILL), goal=lambda scene: second, opening=0.08, hold=hold),
        ]
    )


def test_stages_follow_each_other_and_the_gripper_moves_between_them():
    path, commands, finished = moved(two_stages(), lambda t: Scene(), [0.0, 0.0, 0.0], 5.0)
    assert finished
    np.testing.assert_allclose(path[-1], [0.3, 0.2, 0.0], atol=1e-3)
    assert np.linalg.norm(path - [0.3, 0.0, 0.0], axis=1).min() < 1e-3
    openings = [command.opening for command in commands]
    closing, opening = openings.index(0.0), openings.index(0.08)
    assert all(value is None for value in openings[:closing]) and closing < opening
    still = np.linalg.norm(np.diff(path, axis=0), axis=1) < 1e-12
    assert still[closing : closing + 29].all() and still[opening:].all()
    progress = [command.progress for command in commands]
    assert all(0.0 <= value <= 1.0 for value in progress) and progress[-1] > 0.9


def test_a_goal_may_follow_an_object():
    def scene(time):
        return Scene(None, [Sphere([0.3 + 0.05 * time, 0.0, -0.5], 0.05)], stamp=time)

    def above(scene):
        return Pose(scene.obstacles[0].center + [0.0, 0.0, 0.5], [1, 0, 0, 0])

    path, _, finished = moved(StagedPolicy([Stage("follow", Straight(SKILL), goal=above)]), scene, [0, 0, 0], 5.0)
    assert finished and path[-1][0] > 0.32


def test_a_later_stage_that_refuses_is_tried_again_while_the_arm_waits():
    def scene(time):
        return Scene(None, [Sphere([0.3, 0.2, 0.0], 0.05)] if time < 2.0 else [], stamp=time)

    _, commands, finished = moved(two_stages(), scene, [0.0, 0.0, 0.0], 6.0)
    assert finished
    waiting = [command for command in commands if command.status is Status.WAITING]
    assert waiting and all("carry can't start: the goal is blocked" in command.reason for command in waiting)
    assert not any(command.twist.any() for command in waiting)


def test_the_first_stage_may_refuse_before_anything_moves():
    with pytest.raises(InfeasibleError, match="blocked"):
        moved(two_stages(), lambda t: Scene(None, [Sphere([0.3, 0.0, 0.0], 0.05)]), [0, 0, 0], 1.0)


def test_stages_are_checked():
    with pytest.raises(InputError, match="stages is empty"):
        StagedPolicy([])
    with pytest.raises(InputError, match="goal must be a function"):
        Stage("reach", Straight(SKILL), goal=AHEAD)
    with pytest.raises(InputError, match="hold"):
        Stage("reach", Straight(SKILL), hold=-1.0)
    with pytest.raises(InputError, match="opening"):
        Command(np.zeros(6), opening=-0.01)


def test_a_scene_with_another_goal_keeps_its_obstacles_and_their_motion():
    scene = Scene(None, [Sphere([0.1, 0.0, 0.0], 0.05, velocity=[0.2, 0.0, 0.0])], stamp=1.0)
    for one in (scene, scene.at(2.0)):
        other = one.with_goal(AHEAD)
        assert other.goal is AHEAD and one.goal is None and other.stamp == one.stamp
        later = other.at(3.0)
        assert later.goal is AHEAD
        np.testing.assert_allclose(later.obstacles[0].center, [0.5, 0.0, 0.0], atol=1e-12)
        np.testing.assert_array_equal(other.packed.positions, one.packed.positions)
    with pytest.raises(InputError, match="goal must be a Pose"):
        scene.with_goal([0, 0, 0])
