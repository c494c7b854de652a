"""A Panda sweeps while a cube is pushed onto its path (thesis Fig 5.5)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, MovingScene, Scene, Sphere
from imitarm.tasks.pushed_cube import CUBE, CUBE_OBSERVERS, learned_sweep, pushed_cube, run_pushed_cube
from imitarm.tasks.sweep import MOVING_SCENES, SweepTask
from imitarm.tasks.watching import WATCHES, delayed


@pytest.fixture(scope="module")
def panda():
    return SweepTask.arm("panda")


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_cube_blocks_the_path_twice_and_never_pushes_the_dirt(seed):
    skill = learned_sweep()
    path = skill.gmr_.trajectory(300)
    truth = pushed_cube(seed, skill)
    times = np.linspace(0.0, 2.0 * skill.duration_, 2001)
    places = np.array([truth.at(t).obstacles[0].pose.position for t in times])
    half = 0.5 * truth.scene.obstacles[0].size[0]
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / (times[1] - times[0])
    assert speeds.max() <= 0.4 + 1e-9
    assert np.allclose(places[:, 2], half)  # on the table
    from_dirt = np.abs(places[:, :2] - SweepTask.dirt.position[:2]).max(axis=1) - half
    assert from_dirt.min() > 0.03  # crumbs lie within 16 mm, and are 8 mm wide
    gap = np.array([np.linalg.norm(path.positions[:, :2] - p[:2], axis=1).min() for p in places]) - half
    blocks = gap < SweepTask.tool_radius
    assert np.count_nonzero(np.diff(blocks.astype(int)) == 1) == 2
    assert not blocks[0] and not blocks[times > skill.duration_ + 4.0].any()


def test_a_seed_gives_the_same_scene_and_seeds_differ():
    first, again, other = (pushed_cube(seed, learned_sweep()).at(3.0).obstacles[0] for seed in (1, 1, 2))
    assert np.array_equal(first.pose.position, again.pose.position) and np.array_equal(first.size, again.size)
    assert first.name == CUBE and not np.array_equal(first.size, other.size)


@pytest.mark.parametrize("observer", ["sensor", "camera"])
def test_the_panda_sweeps_the_dirt_and_touches_nothing(panda, observer):
    statuses = set()
    done = run_pushed_cube(
        1, arm=panda, observer=CUBE_OBSERVERS[observer], on_step=lambda step: statuses.add(step.command.status.value)
    )
    assert done.success, done.reason
    assert "avoiding" in statuses and done.min_clearance > 0.02


def test_without_the_camera_the_cube_is_hit(panda):
    truth_only = run_pushed_cube(1, arm=panda, observer=lambda truth, robot, seed: SweepTask.scene("free").at)
    assert not truth_only.success and "cube" in truth_only.reason


@pytest.mark.parametrize("name", MOVING_SCENES)
def test_the_packaged_moving_scenes_block_the_learned_path(name):
    skill = learned_sweep()
    path, moving = skill.gmr_.trajectory(300), SweepTask.moving_scene(name)
    blocked = set()
    for time, position in zip(path.times, path.positions, strict=True):
        for obstacle in moving.at(time).obstacles:
            if obstacle.distances_at(position[None], False)[0][0] < SweepTask.tool_radius:
                blocked.add(obstacle.name)
    assert len(blocked) == (2 if "bottle" in name else 1), blocked


def test_a_delayed_scene_is_the_scene_one_second_later():
    still = Sphere(np.array([0.5, 0.0, 0.1]), 0.05, velocity=np.array([0.1, 0.0, 0.0]))
    tracked = Box(Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), np.full(3, 0.1), name="box")
    truth = MovingScene(Scene(None, (still, tracked)), {"box": lambda time: np.array([time**2, 0.0, 0.0])})
    late = delayed(truth)
    for time in (0.0, 0.7, 3.0):
        np.testing.assert_allclose(late.poses(time + WATCHES)[0], truth.poses(time)[0], atol=1e-12)
