from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from imitarm.command import Command
from imitarm.control_loop.reproduce import reproduce
from imitarm.demonstrations import align, read
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose
from imitarm.policies import ACFRA, Policy
from imitarm.policies.adaptation import HORIZONTAL_ONLY
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene, load_scene, save_scene
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS, MOVING_SCENES, NUMBERED_SCENES, SCENES, SWEEPING, SweepTask
from imitarm.trajectory import Trajectory

ARM = SweepTask.arm()
CROWDED = SCENES[1:]


def nominal(duration=8.0):
    """The smooth path through S, T and G."""
    points = np.array([pose.position for pose in (SweepTask.start, SweepTask.dirt, SweepTask.goal)])
    still = [(1, np.zeros(3)), (2, np.zeros(3))]
    path = make_interp_spline(np.array([0.0, 0.48, 1.0]) * duration, points, k=5, bc_type=(still, still))
    times = np.linspace(0.0, duration, 400)
    return Trajectory(times, path(times), np.tile(SWEEPING, (400, 1)))


class Follow(Policy):
    """Track a path, blind to the scene."""

    def __init__(self, path):
        self.path = path

    def reset(self, observation):
        pass

    def step(self, observation, dt):
        positions, quaternions = self.path.at([observation.time, observation.time + dt])
        forward = np.concatenate([(positions[1] - positions[0]) / dt, np.zeros(3)])
        return Command(forward + 4.0 * observation.tool_to_base.error_to(Pose(positions[0], quaternions[0])))

    def finished(self, observation):
        return observation.time > self.path.times[-1] + 0.3


@pytest.fixture(scope="module")
def skill():
    return Skill(12).fit(align(read(DEMONSTRATIONS)))


def test_following_the_nominal_path_sweeps_the_dirt_into_the_pan():
    task = SweepTask(seed=7)
    robot = task.robot(arm=ARM)
    assert not task.swept(robot).any()
    path = nominal()
    rollout = task.evaluate(robot, reproduce(Follow(path), robot, lambda t: Scene()))
    assert rollout.success
    assert rollout.reason == "dirt in the pan"
    assert rollout.details["swept_fraction"] == 1.0
    assert rollout.min_clearance == np.inf
    wanted, _ = path.at(rollout.trajectory.times)
    assert np.linalg.norm(rollout.trajectory.positions - wanted, axis=1).max() < 2e-3
    assert np.all(np.abs(rollout.torques).max(axis=0) < 0.8 * ARM.max_torque)


@pytest.mark.parametrize("name", CROWDED)
def test_without_avoidance_every_scene_is_a_collision(name):
    task = SweepTask()
    scene = task.scene(name)
    robot = task.robot(scene, arm=ARM)
    blind = SafetyFilter(ARM, clearance=None)
    rollout = task.evaluate(robot, reproduce(Follow(nominal()), robot, lambda t: scene, safety=blind))
    assert not rollout.success
    assert "touched" in rollout.reason
    assert "crumbs are not in the pan" in rollout.reason
    assert rollout.min_clearance <= 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name, control", [*((f"T{i}", "position") for i in (3, 6, 8)), ("T5", "torque")])
def test_the_adapted_skill_sweeps_around_what_stands_in_the_way(skill, name, control):
    task = SweepTask(seed=3)
    scene = task.scene(name)
    robot = task.robot(scene, arm=ARM, control=control)
    pinned = (task.dirt_time(skill.generate()),)
    policy = ACFRA(
        skill, tool_radius=task.tool_radius, clearance=task.clearance, forbidden=HORIZONTAL_ONLY, pinned=pinned
    )
    rollout = task.evaluate(robot, reproduce(policy, robot, lambda t: scene))
    assert rollout.success, rollout.reason
    assert not robot.contacts
    assert rollout.min_clearance > task.clearance - 0.5e-3
    assert rollout.details["swept"].all()


@pytest.mark.parametrize("name", CROWDED)
def test_obstacles_stand_on_the_table_and_leave_start_dirt_and_goal_free(name):
    scene = SweepTask.scene(name)
    for obstacle in scene.obstacles:
        low, high = obstacle.bounds()
        assert low[2] == pytest.approx(0.0, abs=1e-9)
        assert 0.05 <= high[2] <= 0.15
    for pose in (SweepTask.start, SweepTask.dirt, SweepTask.goal):
        assert scene.clearance(pose.position) > SweepTask.tool_radius + 2 * SweepTask.clearance
    on_the_way = scene.clearance(nominal().positions)
    assert on_the_way.min() < 0.045  # the brush is 90 mm wide


def test_scenes_are_different_and_as_many_as_the_thesis_has():
    scenes = SweepTask.scenes()
    assert tuple(scenes) == SCENES
    assert [len(scene.obstacles) for scene in scenes.values()] == [0, 2, 2, 2, 3, 3, 3, 4, 4]
    assert {o.kind for scene in scenes.values() for o in scene.obstacles} == {"box", "cone"}
    assert tuple(NUMBERED_SCENES) == ("T1", "T2", "T3", "T4", "T5", "T6", "T7", "T8")
    for number, name in NUMBERED_SCENES.items():
        assert SweepTask.scene(number).obstacles[0].name == scenes[name].obstacles[0].name
    places = [tuple(o.bounds().ravel()) for scene in scenes.values() for o in scene.obstacles]
    assert len(set(places)) == len(places)
    with pytest.raises(UnknownNameError, match=r"nowhere.*T8.*boxes_and_cone"):
        SweepTask.scene("nowhere")


@pytest.mark.parametrize("name", CROWDED)
def test_a_packaged_scene_survives_saving(name, tmp_path):
    scene = SweepTask.scene(name)
    save_scene(scene, tmp_path / "again.yaml")
    points = np.random.default_rng(0).uniform(-0.5, 1.0, (50, 3))
    again = load_scene(tmp_path / "again.yaml")
    np.testing.assert_allclose(again.distances(points), scene.distances(points), atol=1e-9)


def test_crumbs_lie_about_the_dirt_apart_and_as_the_seed_says():
    for seed in range(20):
        crumbs = SweepTask(seed=seed).crumb_positions()
        assert np.all(np.linalg.norm(crumbs - SweepTask.dirt.position[:2], axis=1) <= 0.016)
        apart = np.linalg.norm(crumbs[:, None] - crumbs[None], axis=2) + np.eye(len(crumbs))
        assert apart.min() > 0.007
        np.testing.assert_array_equal(crumbs, SweepTask(seed=seed).crumb_positions())
    assert not np.array_equal(SweepTask(seed=1).crumb_positions(), SweepTask(seed=2).crumb_positions())


def test_the_verdict_names_lost_crumbs_and_touches():
    task = SweepTask(n_crumbs=4, required_fraction=0.75)
    robot = task.robot(arm=ARM)
    rollout = reproduce(Follow(nominal(0.5)), robot, lambda t: Scene(), timeout=0.1)
    slow = task.evaluate(robot, rollout)
    assert "not finished" in slow.reason
    assert "4 of 4 crumbs are not in the pan" in slow.reason
    pan = SweepTask.goal.position
    for i in range(3):  # three of four are enough here
        robot.data.joint(f"crumb/{i}").qpos[:3] = pan + np.array([0.02 * i, 0.0, 0.002])
    robot.move(np.zeros(7), 0.01)
    finished = replace(rollout, success=True)
    assert task.evaluate(robot, finished).success
    assert task.evaluate(robot, finished).details["swept_fraction"] == 0.75
    assert not replace(task, required_fraction=1.0).evaluate(robot, finished).success
    overlapped = task.evaluate(robot, replace(finished, clearance=np.full(len(finished.trajectory), -0.001)))
    assert "clearance -1.0 mm" in overlapped.reason


def test_the_brush_begins_at_the_start():
    robot = SweepTask().robot(arm=ARM)
    error = robot.tool_to_base.error_to(SweepTask.start)
    assert np.linalg.norm(error) < 1e-4
    assert robot.time == 0.0


def test_dirt_time_is_when_the_path_meets_the_dirt():
    path = nominal()
    position, _ = path.at([SweepTask().dirt_time(path)])
    assert np.linalg.norm(position[0] - SweepTask.dirt.position) < 2e-3


@pytest.mark.parametrize("options", [{"n_crumbs": 0}, {"required_fraction": 0.0}, {"required_fraction": 1.1}])
def test_a_task_without_dirt_is_refused(options):
    with pytest.raises(InputError, match="n_crumbs must be at least 1"):
        SweepTask(**options)


@pytest.mark.parametrize("name", MOVING_SCENES)
def test_moving_scenes_begin_and_end_clear_of_the_brush_and_cross_its_path(name):
    moving = SweepTask.moving_scene(name)
    path = SweepTask.motion().curve(np.linspace(0.0, 1.0, 200))
    first, last = moving.at(0.0), moving.at(60.0)
    assert first.clearance(path[0]) > 0.1 and last.clearance(path[-1]) > 0.1
    crossed = [moving.at(t).clearance(path).min() for t in np.linspace(0.0, 11.0, 56)]
    assert min(crossed) < SweepTask.tool_radius
    assert first.fixtures[0].name == "table"
    robot = SweepTask().robot(moving)
    assert robot._moving
    np.testing.assert_allclose(robot.scene.packed.positions, first.packed.positions, atol=1e-9)


def test_an_unknown_moving_scene_is_refused():
    with pytest.raises(UnknownNameError, match="pushed_box"):
        SweepTask.moving_scene("pushed_boxes")
