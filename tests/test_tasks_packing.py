"""Pick a cube, follow a moving box, and put the cube into it while a bottle is pushed about."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.control_loop import reproduce
from imitarm.errors import InputError
from imitarm.policies import ACFRA, Stage, StagedPolicy
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene, Sphere
from imitarm.tasks.packing import BOTTLE, BOX, CLOSED, CUBE, OPEN, PackingTask, packing_skills, reach
from imitarm.tasks.packing_run import Watched, run_packing

ARM = PackingTask.arm()


@pytest.mark.parametrize("seed", range(4))
def test_bottle_and_box_move_at_ordinary_speeds_and_stay_in_their_places(seed):
    task, times = PackingTask(seed), np.linspace(0.0, 40.0, 8001)
    bottle = np.array([task.bottle_at(t) for t in times])
    box = np.array([task.box_at(t) for t in times])
    speed = np.linalg.norm(np.diff(bottle, axis=0), axis=1) / np.diff(times)
    assert 0.1 < speed.max() < 0.61 and np.mean(speed < 1e-9) > 0.1  # a push is 1.5 to 2 times as fast as its mean
    assert np.linalg.norm(np.diff(box, axis=0), axis=1).max() / (times[1] - times[0]) < 0.06
    assert np.ptp(bottle[:, 2]) == 0.0 and np.ptp(box[:, 1:], axis=0).max() == 0.0
    assert (bottle[:, 1] + 0.05 < box[:, 1].min() - 0.12).all()
    in_the_way = np.abs(bottle[:, 0] - 0.58) < 0.08
    assert 0.1 < in_the_way.mean() < 0.9
    assert np.array_equal(PackingTask(seed, moving=False).bottle_at(9.0), task.bottle_at(0.0))


def test_the_sensor_sees_the_same_motion_as_the_simulator():
    task = PackingTask(3)
    robot = task.robot(arm=ARM)
    for time in (0.0, 2.5, 7.0):
        seen, true = task.truth().at(time), robot._source.at(time)
        boards = np.array([board.bounds() for board in true.obstacles[:-1]])
        box = next(obstacle for obstacle in seen.obstacles if obstacle.name == BOX)
        np.testing.assert_allclose(box.bounds(), [boards[:, 0].min(axis=0), boards[:, 1].max(axis=0)], atol=1e-12)
        assert true.obstacles[-1].name == seen.obstacles[-1].name == BOTTLE
        np.testing.assert_allclose(true.obstacles[-1].pose.position, seen.obstacles[-1].pose.position)
        goal = task.release(seen)
        np.testing.assert_allclose(goal.position[:2], task.box_at(time)[:2], atol=1e-12)
        assert goal.position[2] > box.bounds()[1, 2] + 0.04
    assert task.release(robot.scene_at_start) is None  # only boards: no box is seen
    assert task.release(Scene(None, [Sphere([0.5, 0.3, 0.1], 0.1)])) is None


def test_the_cube_is_picked_and_packed_while_everything_else_stands():
    task = PackingTask(1, moving=False)
    robot = task.robot(arm=ARM)
    first, second = packing_skills()
    options = {"tool_spheres": ARM.tool_spheres, "clearance": task.clearance}
    policy = StagedPolicy(
        [
            Stage("reach", ACFRA(first, **options), goal=lambda scene: task.grasp, opening=CLOSED, hold=1.0),
            Stage("carry", ACFRA(second, **options), goal=task.release, opening=OPEN, hold=0.8),
        ]
    )
    safety = SafetyFilter(ARM, dt=0.01, clearance=0.005)
    done = reproduce(policy, robot, task.truth().at, dt=0.01, timeout=task.timeout, safety=safety)
    assert task.evaluate(robot, done).success, done.reason
    before = PackingTask(1, moving=False).robot(arm=ARM)
    outside = task.evaluate(before, done)
    assert not outside.success and "mm from the middle of the box" in outside.reason
    assert before.data.body(CUBE).xpos[2] == pytest.approx(0.02, abs=1e-3)


def test_the_cube_is_packed_while_box_and_bottle_move_as_a_sensor_and_a_tracker_see_them():
    done = run_packing(PackingTask(2), arm=ARM)
    assert done.success, done.reason
    assert done.min_clearance > 0.0 and not done.details["contacts"]
    assert done.details["statuses"]["avoiding"] > 0


def test_a_camera_sees_the_cube_the_box_and_the_bottle():
    task = PackingTask(0)
    robot = task.robot(arm=ARM)
    watched = Watched(task, robot)
    assert robot.time == pytest.approx(1.0)
    scene = watched(0.0)
    assert sorted({obstacle.name for obstacle in scene.obstacles}) == [BOTTLE, BOX]
    np.testing.assert_allclose(watched.grasp().position, task.grasp.position, atol=0.012)
    np.testing.assert_allclose(task.release(scene).position[:2], task.box_at(1.0)[:2], atol=0.02)
    bottle = next(obstacle for obstacle in scene.obstacles if obstacle.name == BOTTLE)
    np.testing.assert_allclose(bottle.bounds().mean(axis=0)[:2], task.bottle_at(1.0)[:2], atol=0.03)


def test_the_demonstrated_motions_begin_and_end_where_they_should():
    motion = reach(np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.5, 0.1]), 0.2)
    path = motion.curve(np.linspace(0.0, 1.0, 100))
    np.testing.assert_allclose(path[[0, -1]], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.1]], atol=1e-12)
    assert path[50:, 2].max() > 0.25  # it arrives from above
    with pytest.raises(InputError, match="teachers"):
        packing_skills(0)
