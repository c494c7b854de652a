from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.errors import InfeasibleError
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN, POLICIES
from imitarm.policies.baselines.barrier import Barrier, nearest_velocity
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.modulation import Modulation, modulated
from imitarm.policies.baselines.velocity_field import NearObstacles
from imitarm.policies.headings import allowed_axes
from imitarm.scene import HalfSpace, Scene, Sphere

SKILL, PATH = learn(planar=False)
TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
seeds = st.integers(0, 10_000)


def about_a_ball(x, center, radius, velocity=None):
    """NearObstacles of x (d,) with one ball."""
    outward = x - np.asarray(center)
    distance = np.linalg.norm(outward)
    velocity = np.zeros(len(x)) if velocity is None else velocity
    return NearObstacles(
        np.array([distance - radius]),
        outward[None] / distance,
        velocity[None],
        np.zeros(1),
        outward[None],
        np.array([radius]),
    )


def together(*parts):
    return NearObstacles(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@given(seeds)
def test_modulation_about_a_circle_is_the_potential_flow(seed):
    """Khansari-Zadeh and Billard 2012: v_r = U (1 - R^2/r^2) cos a, v_a = -U (1 + R^2/r^2) sin a."""
    rng = np.random.default_rng(seed)
    R, U, angle = rng.uniform(0.1, 2.0), rng.uniform(0.1, 3.0), rng.uniform(-np.pi, np.pi)
    r = R * rng.uniform(1.0, 5.0)
    radial, tangent = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    v = modulated(np.array([U, 0.0]), about_a_ball(r * radial, np.zeros(2), R))
    expected = U * ((1 - R**2 / r**2) * np.cos(angle) * radial - (1 + R**2 / r**2) * np.sin(angle) * tangent)
    np.testing.assert_allclose(v, expected, atol=1e-9)


def test_modulation_flows_along_the_streamlines_about_a_circle():
    """The stream function U (r - R^2/r) sin a is constant along each line of the published figure."""
    for y in (0.05, 0.2, 0.6):
        x, dt, values = np.array([-3.0, y]), 1e-3, []
        while x[0] < 3.0:
            r = np.linalg.norm(x)
            values.append((r - 1.0 / r) * x[1] / r)
            half = x + 0.5 * dt * modulated(np.array([1.0, 0.0]), about_a_ball(x, np.zeros(2), 1.0))
            x = x + dt * modulated(np.array([1.0, 0.0]), about_a_ball(half, np.zeros(2), 1.0))
        np.testing.assert_allclose(values, values[0], rtol=1e-3)
        assert x[1] == pytest.approx(y, rel=2e-3)  # the flow is symmetric


@given(seeds)
def test_modulated_velocities_do_not_enter_a_surface_that_moves_among_others(seed):
    rng = np.random.default_rng(seed)
    center, moving = rng.normal(size=3), rng.normal(size=3)
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    touched = about_a_ball(center + 0.5 * n, center, 0.5, moving)
    others = [about_a_ball(center + 0.5 * n, center + 3.0 * rng.normal(size=3), 0.01) for _ in range(2)]
    desired = rng.normal(size=3)
    for around in (touched, together(touched, *others)):
        v = modulated(desired, around, reactivity=rng.uniform(0.5, 3.0))
        inwards = (v - moving) @ n
        if (desired - moving) @ n < 0.0:
            assert inwards == pytest.approx(0.0, abs=1e-5)
        else:
            assert inwards > -1e-5


@given(seeds, st.floats(0.01, 0.4))
def test_a_tool_that_is_too_close_is_led_out_and_may_leave_freely(seed, depth):
    rng = np.random.default_rng(seed)
    n, desired = rng.normal(size=(2, 3))
    n /= np.linalg.norm(n)
    v = modulated(desired, about_a_ball((0.5 - depth) * n, np.zeros(3), 0.5))
    approach = float(desired @ n)
    assert v @ n == pytest.approx(
        approach if approach > 0.0 else (1.0 - (1.0 - min(2.0 * depth, 0.5)) ** -2) * approach
    )


def test_velocities_of_two_obstacles_that_are_too_close_are_averaged_by_depth():
    desired = np.array([-1.0, 0.0, 0.0])
    parts = [about_a_ball(np.zeros(3), center, 0.5) for center in ([-0.45, 0.0, 0.0], [0.48, 0.0, 0.0])]
    weights = 1.0 - (1.0 + np.array([-0.05, -0.02]) / 0.5) ** 2
    expected = weights @ np.stack([modulated(desired, part) for part in parts]) / weights.sum()
    far = about_a_ball(np.zeros(3), [0.0, 2.0, 0.0], 0.5)
    np.testing.assert_allclose(modulated(desired, together(*parts, far)), expected, atol=1e-12)


def test_modulation_vanishes_far_from_obstacles_and_keeps_the_speed_of_the_mean():
    desired = np.array([0.3, -0.1, 0.2])
    far = about_a_ball(np.zeros(3), np.array([0.0, 1e5, 0.0]), 0.1)
    np.testing.assert_allclose(modulated(desired, far), desired, atol=1e-9)
    np.testing.assert_allclose(modulated(desired, together(far, far)), desired, atol=1e-9)


@given(seeds)
def test_one_row_of_the_barrier_has_the_closed_form(seed):
    rng = np.random.default_rng(seed)
    u, n, b = rng.normal(size=3), rng.normal(size=3), rng.normal()
    n /= np.linalg.norm(n)
    np.testing.assert_allclose(nearest_velocity(u, n[None], np.array([b])), u + n * max(0.0, b - n @ u), atol=1e-12)


@given(seeds)
def test_the_barrier_finds_the_nearest_velocity_and_else_the_least_violation(seed):
    """First-order optimality: the change is a combination of the active rows with positive factors."""
    rng = np.random.default_rng(seed)
    u, rows = rng.normal(size=3), rng.normal(size=(5, 3))
    lower = rows @ rng.normal(size=3) - rng.uniform(0.0, 1.0, size=5)  # some velocity meets them all
    v = nearest_velocity(u, rows, lower)
    missing = lower - rows @ v
    assert missing.max() < 1e-5
    _, residual = nnls(rows[missing > -1e-5].T, v - u) if np.any(missing > -1e-5) else (0, np.linalg.norm(v - u))
    assert residual < 1e-4
    squeezed = nearest_velocity(u, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([0.3, 0.1]))
    np.testing.assert_allclose(squeezed, [0.1, u[1], u[2]], atol=1e-5)


@settings(max_examples=15)
@given(seeds, st.floats(0.2, 1.0))
def test_the_gap_stays_positive_among_moving_obstacles_at_fine_and_coarse_steps(seed, step):
    """h falls at most by the factor (1 - gamma dt) per step, if one obstacle or more allow a velocity."""
    rng = np.random.default_rng(seed)
    gamma = 5.0
    dt = step / gamma
    ball = Sphere([0.0, 0.0, 0.0], 0.3, velocity=0.3 * rng.normal(size=3))
    scene = Scene(None, (ball, HalfSpace([0.0, 0.0, -0.5], [0.0, 0.0, 1.0])))
    x = np.array([1.0, 0.0, 0.0])
    policy = Barrier(SKILL, gamma=gamma, clearance=0.0)
    gaps = ToolGaps(scene, None)
    before = gaps.gaps(x)
    for k in range(60):
        around = policy._obstacles(x, k * dt, np.zeros(3), gaps, scene.packed)
        x = x + dt * policy.velocity(2.0 * rng.normal(size=3) - x, around, np.zeros(0))
        now = gaps.gaps(x[None, None], [(k + 1) * dt])[:, 0, 0]
        assert np.all(now >= (1.0 - gamma * dt) * before - 1e-5)
        before = now


@pytest.mark.parametrize("name", ["modulation", "barrier"])
def test_velocity_fields_follow_the_learned_path_and_go_around_one_obstacle(name):
    clear = POLICIES[name](SKILL, tool_spheres=TOOL).plan_motion(Scene(None, ()))
    assert clear.trajectory.duration == pytest.approx(SKILL.duration_, rel=0.03)
    apart = np.linalg.norm(clear.trajectory.positions[:, None] - PATH, axis=2).min(axis=1)
    assert apart.max() < 2e-3
    for seed in range(4):
        case = sparse_clutter(seed, PATH, n_obstacles=1, planar=False)
        plan = POLICIES[name](SKILL, tool_spheres=TOOL, clearance=CLEARANCE).plan_motion(case.scene)
        points, _ = plan.trajectory.at(np.linspace(0.0, plan.trajectory.duration, 4000))
        assert case.scene.clearance(points).min() - TOOL_RADIUS > CLEARANCE - 1e-3
        assert np.linalg.norm(points[-1] - PATH[-1]) < 2e-3


@pytest.mark.parametrize("name", ["modulation", "barrier"])
def test_velocity_fields_keep_forbidden_directions_and_meet_moving_obstacles_on_schedule(name):
    still = Scene(None, (Sphere(PATH[200], 0.03),))
    learned = POLICIES[name](SKILL, tool_spheres=TOOL).plan_motion(Scene(None, ())).trajectory.positions
    plan = POLICIES[name](SKILL, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(still)
    assert not plan.only_on_schedule
    heights = plan.trajectory.positions[:, 2]
    assert learned[:, 2].min() - 1e-3 < heights.min() and heights.max() < learned[:, 2].max() + 1e-3
    plan = POLICIES[name](SKILL, tool_spheres=TOOL, forbidden=NOT_DOWN).plan_motion(still)
    assert plan.trajectory.positions[:, 2].min() > learned[:, 2].min() - 1e-3
    crossing = Scene(None, (Sphere(PATH[200] - [0.0, 0.6, 0.0], 0.03, velocity=[0.0, 0.3, 0.0]),))
    plan = POLICIES[name](SKILL, tool_spheres=TOOL).plan_motion(crossing)
    gaps = ToolGaps(crossing, TOOL).gaps(plan.trajectory.positions[:, None], plan.trajectory.times)
    assert plan.only_on_schedule and gaps.min() > CLEARANCE - 1e-3


def test_a_barrier_alone_stops_in_front_of_a_wall_across_the_path_and_refuses():
    wall = Scene(None, [HalfSpace(PATH[200], PATH[0] - PATH[-1])])
    with pytest.raises(InfeasibleError, match=r"Barrier: the tool is still .* from the goal"):
        Barrier(SKILL, tool_spheres=TOOL).plan_motion(wall)


def test_axes_of_the_allowed_space():
    axes, one_sided = allowed_axes(np.array(HORIZONTAL_ONLY, dtype=float))
    np.testing.assert_allclose(axes @ axes.T, np.diag([1.0, 1.0, 0.0]), atol=1e-12)
    assert one_sided.shape == (0, 2)
    axes, one_sided = allowed_axes(np.array(NOT_DOWN, dtype=float))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(one_sided @ axes.T, NOT_DOWN, atol=1e-12)


def test_options_of_the_fields_are_checked_and_can_be_tuned():
    for policy in (Modulation, Barrier):
        for option, (lowest, highest) in policy.search_space.items():
            assert 0.0 < lowest < highest
            policy(SKILL, **{option: lowest})
            with pytest.raises(ValueError, match=option):
                policy(SKILL, **{option: 0.0})
