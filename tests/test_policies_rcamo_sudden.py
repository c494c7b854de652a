"""RCAMO evades an obstacle that starts to move suddenly."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.moving import build
from imitarm.benchmark.moving_scenes import MovingCase
from imitarm.benchmark.moving_world import run_tool
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.demonstrations import align
from imitarm.perception import ObstacleTracker
from imitarm.scene import MovingScene, Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach

BALL, TOOL = 0.04, 0.03  # [m] radii
ACCELERATION, SPEED = 3.0, 0.8  # [m/s^2], [m/s]


@pytest.fixture(scope="module")
def skill():
    return Skill(6).fit(align(demonstrations_by(s_shaped_reach(planar=False), 3)))


def travelled(time):
    """The way of the ball, which rests until time 0 [m]."""
    ramp = SPEED / ACCELERATION
    accelerated = np.clip(time, 0.0, ramp)
    return 0.5 * ACCELERATION * accelerated**2 + SPEED * max(time - ramp, 0.0)


def smallest_gap(skill, seed, **options):
    """The smallest distance of tool and ball, when the ball starts 0.4 s before it meets the learned motion [m]."""
    rng = np.random.default_rng(seed)
    begins, direction = rng.uniform(0.8, 2.2), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    meets = begins + 0.4
    home = skill.nominal([0.0, meets]).positions[1] - travelled(0.4) * direction

    def motion(time):
        return home + travelled(time - begins) * direction

    truth = MovingScene(Scene(None, [Sphere(home, BALL, name="ball")]), {"ball": motion})
    case = MovingCase("M1", 3, seed, skill, truth, meets)
    observe = TrackedScene(truth, SensorModel(seed=seed), ObstacleTracker("imm"))
    run = run_tool(build("rcamo", case, tuple(options.items())), case, observe)
    assert run.arrived
    places = np.array([motion(time) for time in run.times])
    return np.linalg.norm(run.positions - places, axis=1).min() - BALL - TOOL


@pytest.mark.parametrize("seed", range(4))
def test_the_growing_margin_keeps_the_tool_farther_from_an_obstacle_that_starts_suddenly(skill, seed):
    gap = smallest_gap(skill, seed)
    assert gap > 0.015
    assert gap > smallest_gap(skill, seed, growth=0.0) + 0.01
