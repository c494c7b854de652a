from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.benchmark.avoidance import learn
from imitarm.errors import InfeasibleError
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, POLICIES
from imitarm.policies.baselines.apf import APF, _Field
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.potential_field import (
    DISTANCE_FLOOR,
    attractive_force,
    attractive_potential,
    repulsive_force,
    repulsive_potential,
)
from imitarm.scene import Box, Scene, Sphere

SKILL, PATH = learn(planar=False)
PLANAR, PLANAR_PATH = learn(planar=True)
TOOL = [[0.0, 0.0, 0.0, 0.03]]
SHAPES = [Sphere([0.1, 0.0, 0.0], 0.05), Box(Pose([-0.2, 0.1, 0.0], [1, 0, 0, 0]), [0.2, 0.1, 0.1])]
seeds = st.integers(0, 10_000)


@given(seeds)
def test_forces_are_minus_the_gradients_of_their_potentials(seed):
    """Outside, near the surface, below the floor and inside; the force is minus the slope of the potential (Eq 2.17,
    2.19)."""
    rng = np.random.default_rng(seed)
    gaps = ToolGaps(Scene(None, SHAPES), None)
    x, goal, direction = rng.uniform(-0.4, 0.4, 3), rng.uniform(-0.4, 0.4, 3), rng.normal(size=3)
    stiffness, cap, gain, influence = rng.uniform(0.1, 5.0), rng.uniform(0.05, 0.5), 1e-6, rng.uniform(0.02, 0.3)
    distance, normal = gaps.gaps_and_normals(x)
    h = 1e-6 * direction / np.linalg.norm(direction)
    force = attractive_force(x, goal, stiffness, cap)
    slope = attractive_potential(x + h, goal, stiffness, cap) - attractive_potential(x - h, goal, stiffness, cap)
    assert -2.0 * force @ h == pytest.approx(slope, rel=1e-4, abs=1e-10)
    ahead, behind = gaps.gaps_and_normals(x + h), gaps.gaps_and_normals(x - h)
    if np.abs(ahead[1] - behind[1]).max() > 1e-3:  # an edge between the two, where the distance has no gradient
        return
    force = repulsive_force(distance, normal, gain, influence)
    slope = repulsive_potential(ahead[0], gain, influence) - repulsive_potential(behind[0], gain, influence)
    assert -2.0 * force @ h == pytest.approx(slope, rel=1e-3, abs=1e-3 * gain / DISTANCE_FLOOR**3 * 1e-6)


def test_closed_forms_of_the_attraction_and_the_repulsion():
    """Eq 2.15 and 2.17 within the cap, and Eq 2.18 and 2.19, for one obstacle."""
    x, goal = np.array([0.3, 0.0, 0.4]), np.zeros(3)
    assert attractive_potential(x, goal, 2.0, 1.0) == pytest.approx(0.25)
    np.testing.assert_allclose(attractive_force(x, goal, 2.0, 1.0), -2.0 * x)
    np.testing.assert_allclose(attractive_force(x, goal, 2.0, 0.1), -2.0 * 0.1 * x / 0.5)
    d, n = np.array([0.02]), np.array([[0.0, 1.0, 0.0]])
    assert repulsive_potential(d, 1e-4, 0.05) == pytest.approx(0.5e-4 * (1 / 0.02 - 1 / 0.05) ** 2)
    np.testing.assert_allclose(repulsive_force(d, n, 1e-4, 0.05), [0.0, 1e-4 * (50 - 20) * 2500, 0.0])
    assert repulsive_potential(np.array([0.05, 3.0]), 1.0, 0.05) == 0.0
    assert not repulsive_force(np.array([0.05, 3.0]), np.ones((2, 3)), 1.0, 0.05).any()


@given(seeds)
def test_the_potential_never_increases_and_the_clearance_is_kept_beside_one_obstacle(seed):
    rng = np.random.default_rng(seed)
    line = PATH[-1] - PATH[0]
    aside = np.cross(line / np.linalg.norm(line), rng.normal(size=3))
    aside *= rng.uniform(0.005, 0.08) / np.linalg.norm(aside)
    scene = Scene(None, [Sphere(PATH[0] + rng.uniform(0.35, 0.65) * line + aside, rng.uniform(0.02, 0.06))])
    policy = APF(SKILL, tool_spheres=TOOL)
    plan = policy.plan_motion(scene).trajectory
    gaps = ToolGaps(scene, TOOL)
    assert gaps.gaps(plan.positions).min() > policy.clearance
    np.testing.assert_allclose(plan.positions[[0, -1]], PATH[[0, -1]], atol=1e-3)
    stiffness = policy.speed * SKILL.gmr_.trajectory(200).path_length / SKILL.duration_ / policy.cap
    field = _Field(policy, gaps, SKILL.gmr_.trajectory(200).positions[-1], stiffness, moving=False)
    potential = [field.potential(x, field.distances(x, 0.0)[0]) for x in plan.positions]
    assert np.diff(potential).max() <= 1e-9


def test_without_obstacles_it_goes_straight_to_the_goal():
    plan = APF(SKILL).plan_motion(Scene(None, [])).trajectory
    line = (plan.positions[-1] - plan.positions[0]) / np.linalg.norm(plan.positions[-1] - plan.positions[0])
    offset = plan.positions - plan.positions[0]
    np.testing.assert_allclose(offset - np.outer(offset @ line, line), 0.0, atol=1e-12)
    assert 0.5 < plan.duration / SKILL.duration_ < 1.2
    speed = np.linalg.norm(np.diff(plan.positions, axis=0), axis=1) / np.diff(plan.times)
    assert speed[0] < 0.05 * speed.max() and speed[-1] < 0.05 * speed.max()


def test_it_stops_in_a_local_minimum_in_front_of_a_wall_and_refuses():
    """The published failure: between a goal and a wide obstacle, the forces cancel (Koren and Borenstein 1991)."""
    line = PLANAR_PATH[-1] - PLANAR_PATH[0]
    middle = PLANAR_PATH[0] + 0.5 * line
    heading = np.arctan2(line[1], line[0])
    wall = Box(Pose(middle, [np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]), [0.04, 0.5, 0.3])
    with pytest.raises(InfeasibleError, match=r"APF: the tool stops \d+ mm from the goal.*local minimum"):
        APF(PLANAR, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(Scene(None, [wall]))


def test_a_repulsion_has_no_part_in_a_forbidden_direction():
    scene = Scene(None, [Sphere(PLANAR_PATH[200] - [0.0, 0.02, 0.02], 0.03)])
    plan = APF(PLANAR, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(scene).trajectory
    np.testing.assert_allclose(plan.positions[:, 2], PLANAR_PATH[0, 2], atol=1e-6)


def test_it_yields_to_a_moving_obstacle():
    straight = APF(SKILL, tool_spheres=TOOL).plan_motion(Scene(None, [])).trajectory
    middle, when = straight.positions[len(straight) // 2], straight.times[len(straight) // 2]
    velocity = np.array([0.0, 0.15, 0.02])
    scene = Scene(None, [replace(Sphere(middle - when * velocity, 0.03), velocity=velocity)])
    gaps = ToolGaps(scene, TOOL)
    assert gaps.gaps(straight.positions, straight.times).min() < 0.0
    plan = APF(SKILL, tool_spheres=TOOL).plan_motion(scene).trajectory
    assert gaps.gaps(plan.positions, plan.times).min() > 0.015


def test_it_is_registered_with_options_to_search():
    assert POLICIES["apf"] is APF
    for name, (low, high) in APF.search_space.items():
        assert 0.0 < low < high and hasattr(APF(SKILL, **{name: low}), name)
