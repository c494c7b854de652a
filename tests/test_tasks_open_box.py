"""The open box: five boards, obstacles that stand in the way, and a success test by the simulator's geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm.command import Command
from imitarm.control_loop import reproduce
from imitarm.demonstrations import align
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.policies import ACFRA, Policy
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by
from imitarm.tasks.open_box import BOARDS, OpenBoxTask, open_box

ARM = OpenBoxTask.arm()


@pytest.fixture(scope="module")
def skill():
    return Skill(8).fit(align(demonstrations_by(OpenBoxTask.motion(), 3)))


def test_five_boards_enclose_the_inside_and_leave_the_top_open():
    pose = Pose(np.array([0.3, -0.1, 0.2]), quaternion_exp(np.array([0.4, -0.3, 0.8])))
    boards = open_box(pose, (0.2, 0.3, 0.1), thick=0.01)
    assert tuple(board.name for board in boards) == BOARDS
    box = Scene(None, boards)
    rng = np.random.default_rng(0)
    inside = pose.apply(rng.uniform([-0.1, -0.15, 0.0], [0.1, 0.15, 0.1], (200, 3)))
    assert box.clearance(inside).min() > -1e-9
    directions = rng.normal(size=(200, 3)) * [1.0, 1.0, 0.4]
    directions[:, 2] = -np.abs(directions[:, 2])
    middle = np.array([0.0, 0.0, 0.05])
    for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):  # sideways or down: a board
        ray = pose.apply(middle + np.linspace(0.0, 0.4, 400)[:, None] * direction)
        assert box.clearance(ray).min() < 1e-3
    up = pose.apply(middle + np.linspace(0.0, 0.4, 100)[:, None] * [0.0, 0.0, 1.0])
    assert box.clearance(up).min() == pytest.approx(0.05)


@pytest.mark.parametrize("planar", [False, True])
def test_the_motion_leads_into_the_box_and_touches_no_board(planar):
    motion, box = OpenBoxTask.motion(planar=planar), Scene(None, OpenBoxTask.box(planar=planar))
    path = motion.curve(np.linspace(0.0, 1.0, 500))
    assert box.clearance(path).min() > 0.07
    boards = np.array([board.bounds() for board in OpenBoxTask.box(planar=planar)])
    low, high = boards[:, 0].min(axis=0), boards[:, 1].max(axis=0)
    assert np.all((low < path[-1]) & (path[-1] < high))
    assert not np.all((low < path[0]) & (path[0] < high))
    if not planar:
        np.testing.assert_allclose(path[[0, -1]], [OpenBoxTask.start.position, OpenBoxTask.goal.position], atol=1e-12)


def test_obstacles_stand_on_the_table_and_leave_the_start_and_the_box_free():
    centers, radii = ARM.collision_spheres(OpenBoxTask().robot(arm=ARM).state().q)
    path = OpenBoxTask.motion().curve(np.linspace(0.0, 1.0, 500))
    box = OpenBoxTask.box()
    for seed in range(15):
        task = OpenBoxTask(seed, n_obstacles=1 + seed % 3)
        scene = task.scene()
        assert scene.obstacles[:5] != box and [o.name for o in scene.obstacles[:5]] == list(BOARDS)
        standing = scene.obstacles[5:]
        assert len(standing) == task.n_obstacles
        for obstacle in standing:
            assert obstacle.bounds()[0, 2] == pytest.approx(0.0, abs=1e-9)
            assert obstacle.bounds()[1, 1] < box[2].bounds()[0, 1] - 0.04
            assert (obstacle.signed_distance(centers) - radii).min() > 0.04
        assert min(obstacle.signed_distance(path).min() for obstacle in standing) < 0.02
        again = replace(task).scene()
        np.testing.assert_array_equal(scene.distances(path), again.distances(path))


def test_the_whole_arm_reaches_into_the_box_around_obstacles(skill):
    task = OpenBoxTask(seed=0, n_obstacles=3)
    robot = task.robot(arm=ARM)
    policy = ACFRA(skill, arm=ARM, clearance=task.clearance)
    scene = task.scene()
    safety = SafetyFilter(ARM, clearance=task.clearance)
    rollout = task.evaluate(robot, reproduce(policy, robot, scene.at, safety=safety, timeout=20.0))
    assert rollout.success and rollout.reason == "in the box"
    assert rollout.min_clearance > task.clearance - 0.5e-3
    assert rollout.details["distance_to_goal"] < 0.005
    assert not robot.contacts
    assert policy.adaptation.certified_clearance >= task.clearance


def test_without_avoidance_an_obstacle_is_touched(skill):
    task = OpenBoxTask(seed=0, n_obstacles=2)
    robot = task.robot(arm=ARM)
    policy = ACFRA(skill, arm=ARM, clearance=task.clearance)
    blind = SafetyFilter(ARM, clearance=None)
    empty = Scene(None, (), fixtures=task.scene().fixtures)
    rollout = task.evaluate(robot, reproduce(policy, robot, lambda _: empty, safety=blind, timeout=20.0))
    assert not rollout.success
    assert "touched" in rollout.reason
    assert robot.contacts


class Finished(Policy):
    """Stays where it is."""

    def __init__(self):
        pass

    def reset(self, observation):
        pass

    def step(self, observation, dt):
        return Command(np.zeros(6))

    def finished(self, observation):
        return observation.time > 0.1


def test_the_evaluation_names_what_is_wrong():
    task = OpenBoxTask(n_obstacles=0)
    robot = task.robot(arm=ARM)
    stayed = reproduce(Finished(), robot, lambda _: Scene())
    assert "mm from its goal in the box" in task.evaluate(robot, stayed).reason
    assert task.evaluate(robot, stayed).details["distance_to_goal"] == pytest.approx(
        np.linalg.norm(task.goal.position - task.start.position), abs=1e-3
    )


@pytest.mark.parametrize("n", [-1, 4])
def test_more_obstacles_than_fit_are_refused(n):
    with pytest.raises(InputError, match="between 0 and 3"):
        OpenBoxTask(n_obstacles=n)
