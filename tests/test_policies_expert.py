from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.expert import expert_paths, jerk_cost
from imitarm.scene import Box, HalfSpace, Scene, Sphere
from imitarm.trajectory import Trajectory

TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
SKILL, PATH = learn(planar=False)
NOMINAL = SKILL.gmr_.trajectory(200)
SAMPLES = NOMINAL.at(np.linspace(0.0, NOMINAL.duration, 100))[0]
DT = NOMINAL.duration / 99
_U = np.linspace(0.0, 1.0, 100)
STRAIGHT = Trajectory(2.0 * _U, np.outer(_U, [0.5, 0.0, 0.0]))


def solve(*obstacles, nominal=NOMINAL, **options):
    gaps = ToolGaps(Scene(None, obstacles), TOOL)
    return gaps, expert_paths(nominal, gaps, clearance=CLEARANCE, **options)


def dense(path):
    u = np.linspace(0.0, 99.0, 4000)
    return np.stack([np.interp(u, np.arange(100), column) for column in path.T], axis=1)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 999), st.integers(1, 3))
def test_every_path_keeps_the_clearance_and_both_ends_with_their_velocity_and_acceleration(seed, n):
    case = sparse_clutter(seed, PATH, n_obstacles=n, planar=False)
    gaps, paths = solve(*case.scene.obstacles)
    assert paths
    for path in paths:
        assert gaps.gaps(path).min() >= CLEARANCE - 1e-5
        assert gaps.gaps(dense(path)).min() >= CLEARANCE - 1e-3
        np.testing.assert_array_equal(path[[0, 1, 2, -3, -2, -1]], SAMPLES[[0, 1, 2, -3, -2, -1]])
    costs = [jerk_cost(path - SAMPLES, DT) for path in paths]
    assert costs == sorted(costs)


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_the_gradient_of_the_cost_is_a_combination_of_the_active_constraints(shape):
    """First-order optimality: no feasible direction lowers the cost; gradients by finite differences."""
    middle = PATH[200] + [0.0, 0.01, 0.005]
    gaps, paths = solve(
        Sphere(middle, 0.03) if shape == "sphere" else Box(Pose(middle, [1.0, 0.0, 0.0, 0.0]), [0.05] * 3)
    )
    path = paths[0]
    step = 1e-5
    gradient = np.zeros((94, 3))
    for i, axis in np.ndindex(94, 3):
        change = np.zeros((100, 3))
        change[i + 3, axis] = step
        up, down = (jerk_cost(path + sign * change - SAMPLES, DT) for sign in (1.0, -1.0))
        gradient[i, axis] = (up - down) / (2.0 * step)
    gap = gaps.gaps(path)[0, 3:-3]
    active = np.flatnonzero(gap < CLEARANCE + 1e-5)
    assert 0 < len(active) < 40
    columns = np.zeros((94, 3, len(active)))
    for k, i in enumerate(active):
        for axis in range(3):
            offset = step * np.eye(3)[axis]
            up, down = (gaps.gaps(path[i + 3] + sign * offset)[0] for sign in (1.0, -1.0))
            columns[i, axis, k] = (up - down) / (2.0 * step)
    multipliers, residual = nnls(columns.reshape(-1, len(active)), gradient.ravel())
    assert residual < 1e-3 * np.linalg.norm(gradient)
    assert multipliers.max() > 0.0


def test_a_path_through_the_middle_of_a_ball_has_mirrored_solutions_in_a_plane():
    _, paths = solve(Sphere([0.25, 0.0, 0.0], 0.03), nominal=STRAIGHT, forbidden=HORIZONTAL_ONLY)
    assert len(paths) == 2
    np.testing.assert_allclose(paths[0], paths[1] * [1.0, -1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(paths[0], [0.5, 0.0, 0.0] - paths[0][::-1] * [1.0, -1.0, 1.0], atol=1e-4)


def test_beside_a_wall_the_deviation_is_the_least_one_in_closed_form():
    """One active constraint: the deviation is the column of the inverse of the cost's matrix, scaled to touch."""
    wall = HalfSpace([0.25, 0.0, -0.05], [0.0, 0.0, 1.0])
    bump = np.exp(-0.5 * ((np.arange(100) - 50.0) / 8.0) ** 2)
    path = np.stack([np.linspace(0.0, 0.5, 100), np.zeros(100), 0.05 - 0.06 * bump], axis=1)
    _, paths = solve(wall, nominal=Trajectory(STRAIGHT.times, path))
    third = np.diff(np.eye(100), 3, axis=0)[:, 3:-3]
    column = np.linalg.inv(third.T @ third)[:, 47]
    expected = column / column[47] * 0.01
    assert len(paths) == 1
    np.testing.assert_allclose(paths[0][3:-3, 2] - path[3:-3, 2], expected, atol=1e-5)


def test_forbidden_directions_are_kept():
    middle = PATH[200] + [0.0, 0.0, 0.02]  # below it is nearer
    gaps, paths = solve(Sphere(middle, 0.03), forbidden=NOT_DOWN)
    assert paths
    assert min((path - SAMPLES)[:, 2].min() for path in paths) >= -1e-5
    _, free = solve(Sphere(middle, 0.03))
    assert (free[0] - SAMPLES)[:, 2].min() < -1e-3
    assert gaps.gaps(paths[0]).min() >= CLEARANCE - 1e-5


def test_a_clear_scene_changes_nothing_and_a_covered_end_has_no_path():
    for obstacles in ((), (Sphere([2.0, 0.0, 0.0], 0.1),)):
        (path,) = solve(*obstacles)[1]
        np.testing.assert_array_equal(path, SAMPLES)
    assert solve(Sphere(PATH[-1], 0.02))[1] == []


def test_the_same_scene_gives_the_same_paths():
    first, second = (solve(Sphere(PATH[150], 0.03))[1] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_crossing_obstacle_is_avoided_at_the_times_of_the_samples():
    moving = Sphere([0.25, -0.4, 0.0], 0.04, velocity=[0.0, 0.4, 0.0])  # crosses the path when the tool is there
    gaps, paths = solve(moving, nominal=STRAIGHT)
    times = np.linspace(0.0, 2.0, 100)
    assert paths
    assert gaps.gaps(paths[0][:, None], times).min() >= CLEARANCE - 1e-5
