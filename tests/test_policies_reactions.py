"""Baselines among obstacles that move: the same equations, one control period at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.command import Status
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, POLICIES, Observation
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.reaction import changed
from imitarm.policies.baselines.stop_only import StopOnly
from imitarm.scene import Box, Scene, Sphere

SKILL, PATH = learn(planar=True)
TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
SPRINGS = ("dmp-steering", "dmp-potential", "dmp-ann", "gmm-dmp", "tp-gmm", "dmp-barrier")
FIELDS = ("barrier", "modulation")
REACTING = (*SPRINGS, *FIELDS, "apf", "gmm-irl")
STATE = ArmState(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
DT = 0.01


def build(name, **options):
    return POLICIES[name].build(
        SKILL, tool_spheres=TOOL, clearance=CLEARANCE, forbidden=HORIZONTAL_ONLY, pinned=(), **options
    )


def moved(policy, scene_at, *, until=2.0):
    """Let a policy move the tool, which follows every command exactly; return the positions, and the last command."""
    x, path, command = SKILL.start_.position.copy(), [], None
    policy.reset(observed(x, 0.0, scene_at))
    for k in range(round(until * SKILL.duration_ / DT)):
        path.append(x)
        now = observed(x, k * DT, scene_at)
        if policy.finished(now):
            break
        command = policy.step(now, DT)
        x = x + DT * command.twist[:3]
    return np.array(path), command


def observed(x, time, scene_at):
    return Observation(time, STATE, Pose(x, np.array([1.0, 0.0, 0.0, 0.0])), scene_at(time))


def crossing(speed=0.3):
    """A ball that crosses the learned path, and meets the tool in its middle."""
    at, half = PATH[len(PATH) // 2], 0.5 * SKILL.duration_
    velocity = np.array([0.0, speed, 0.0])
    return Sphere(at - half * velocity, 0.035, velocity=velocity)


def gaps(path, scene_at):
    return np.array([ToolGaps(scene_at(k * DT), TOOL).gaps(x).min() for k, x in enumerate(path)])


def far_away(time):
    return Scene(None, [Sphere([5.0, 5.0, 0.1], 0.03, velocity=[0.0, 0.1, 0.0])]).at(time)


@pytest.mark.parametrize("name", SPRINGS)
def test_step_by_step_a_spring_moves_as_it_plans(name):
    """In a scene that stands still, the reaction integrates the planned motion."""
    scene = sparse_clutter(3, PATH, n_obstacles=1, planar=True).scene
    policy = build(name)
    nominal = policy._path.between(SKILL, None, None).nominal
    times, planned = policy.tool_path(nominal, ToolGaps(scene, TOOL), scene)
    motion = policy.reaction(nominal, nominal.positions[0], np.zeros(3), 0.0)
    for position in planned[1:]:
        motion.advance(scene, times[1])
        np.testing.assert_allclose(motion.position, position, atol=1e-9)


@pytest.mark.parametrize("name", FIELDS)
def test_step_by_step_a_field_moves_as_it_plans(name):
    scene = sparse_clutter(3, PATH, n_obstacles=1, planar=True).scene
    policy = build(name)
    nominal = policy._path.between(SKILL, None, None).nominal
    times, planned = policy.tool_path(nominal, ToolGaps(scene, TOOL), scene)
    motion = policy.reaction(nominal, nominal.positions[0], np.zeros(3), 0.0)
    for position in planned[1:]:
        motion.advance(scene, times[1])
        np.testing.assert_allclose(motion.position, position, atol=1e-9)


def test_step_by_step_the_potential_field_moves_as_it_plans():
    scene = Scene(None, [Sphere(PATH[len(PATH) // 2] + [0.0, 0.09, 0.0], 0.03)])
    policy = build("apf")
    nominal = policy._path.between(SKILL, None, None).nominal
    times, planned = policy.tool_path(nominal, ToolGaps(scene, TOOL), scene)
    motion = policy.reaction(nominal, nominal.positions[0], np.zeros(3), 0.0)
    for position in planned[1:]:
        motion.advance(scene, times[1])
        np.testing.assert_allclose(motion.position, position, atol=1e-9)


@pytest.mark.parametrize("name", [n for n in REACTING if n != "apf"])
def test_an_obstacle_that_is_far_away_changes_nothing(name):
    path, command = moved(build(name), far_away)
    learned = SKILL.nominal(np.linspace(0.0, SKILL.duration_, 400))
    beside = [np.linalg.norm(learned.positions - x, axis=1).min() for x in path]
    assert max(beside) < 0.012  # the mixtures of gmm-dmp and tp-gmm are a few mm from the learned path
    assert np.linalg.norm(path[-1] - SKILL.goal_.position) < 0.005
    assert len(path) <= 1.4 * SKILL.duration_ / DT
    assert command.status is Status.NOMINAL or name in {"gmm-dmp", "tp-gmm", "dmp-ann"}


@pytest.mark.parametrize("name", ["dmp-potential", "dmp-barrier", "barrier", "modulation", "gmm-dmp", "apf", "gmm-irl"])
def test_a_crossing_obstacle_is_avoided_where_it_is(name):
    scene = Scene(None, [crossing()])
    path, _ = moved(build(name), scene.at)
    assert gaps(path, scene.at).min() > 0.0
    assert np.linalg.norm(path[-1] - SKILL.goal_.position) < 0.005


def test_a_control_barrier_keeps_the_clearance_from_a_moving_obstacle():
    for name in ("dmp-barrier", "barrier"):
        for speed in (-0.4, 0.2, 0.5):
            scene = Scene(None, [crossing(speed)])
            path, _ = moved(build(name), scene.at)
            assert gaps(path, scene.at).min() > CLEARANCE - 0.002, (name, speed)


@pytest.mark.parametrize("name", REACTING)
def test_a_scene_that_stands_still_is_planned_once(name):
    policy = build(name)
    scene = Scene(None, [Sphere(PATH[len(PATH) // 2] + [0.0, 0.095, 0.0], 0.03)])
    path, _ = moved(policy, scene.at, until=0.3)
    assert policy._reaction is None and len(path) > 10


@pytest.mark.parametrize("name", ["dmp-barrier", "barrier", "gmm-dmp"])
def test_an_obstacle_that_appears_is_avoided(name):
    """It appears in front of the tool after 40 % of the motion."""
    scene = Scene(None, [Sphere(PATH[int(0.65 * len(PATH))] + [0.0, 0.01, 0.0], 0.03)])
    when = 0.4 * SKILL.duration_

    def seen(time):
        return Scene(None, (), time) if time < when else scene.at(time)

    policy = build(name)
    path, _ = moved(policy, seen)
    late = path[round(when / DT) :]
    assert policy._reaction is not None
    assert min(ToolGaps(scene, TOOL).gaps(x).min() for x in late) > 0.0


def test_what_counts_as_a_change():
    ball = Sphere([0.3, 0.0, 0.1], 0.03)
    scene = Scene(None, [ball])
    assert not changed(scene.packed, scene.at(1.0).packed)
    assert changed(scene.packed, Scene(None, [replace(ball, velocity=[0.01, 0.0, 0.0])]).packed)
    assert changed(scene.packed, Scene(None, [Sphere([0.301, 0.0, 0.1], 0.03)]).packed)
    assert changed(scene.packed, Scene().packed) and changed(Scene().packed, scene.packed)


# --- stop-only ----------------------------------------------------------------------------------------------------


def test_the_separation_distance_has_the_published_terms():
    policy = build("stop-only", reaction=0.2, deceleration=4.0, intrusion=0.05, tool_uncertainty=0.01)
    found = policy.separation(np.array([1.6, 0.0]), 0.8, np.array([0.02, 0.0]))
    stopping = 0.8 / 4.0
    S = 1.6 * (0.2 + stopping) + 0.8 * 0.2 + 0.8**2 / (2.0 * 4.0) + 0.05 + 0.02 + 0.01
    assert found[0] == pytest.approx(S)
    assert found[1] == pytest.approx(S - 1.6 * 0.4 - 0.02)


def test_it_stops_while_an_obstacle_crosses_and_then_arrives():
    scene = Scene(None, [crossing(0.5)])
    policy = build("stop-only")
    path, command = moved(policy, scene.at)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / DT
    assert gaps(path, scene.at).min() > 0.0 and command.status is Status.NOMINAL
    assert (speed[30:-30] < 0.01).any()
    assert len(path) > SKILL.duration_ / DT
    learned = SKILL.nominal(np.linspace(0.0, SKILL.duration_, 1000)).positions
    assert max(np.linalg.norm(learned - x, axis=1).min() for x in path) < 0.005  # it never leaves the path


def test_it_waits_for_ever_in_front_of_an_obstacle_that_stays():
    scene = Scene(None, [Box(Pose(PATH[len(PATH) // 2], np.array([1.0, 0.0, 0.0, 0.0])), [0.05, 0.05, 0.05])])
    path, command = moved(build("stop-only"), scene.at, until=2.0)
    assert command.status is Status.WAITING and "mm from the tool" in command.reason
    assert gaps(path, scene.at).min() > CLEARANCE


def test_stop_only_must_be_reset_first():
    with pytest.raises(InputError, match="reset"):
        StopOnly(SKILL).step(observed(np.zeros(3), 0.0, far_away), DT)
