"""Passages between obstacles: what the grid proves closed has no path, and what it proposes is found."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.refusals import adapted, scene_for, skills_to_adapt
from imitarm.benchmark.static_scenes import static_case
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, adapt
from imitarm.policies.adaptation import allowed_directions
from imitarm.policies.certificate import ToolAmongObstacles
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import MAX_DISPLACEMENT
from imitarm.policies.passages import Passages
from imitarm.scene import Box, Scene, Sphere


@pytest.fixture(scope="module")
def planar():
    return learn(planar=True)


def passages_of(skill, obstacles, forbidden=(), *, spheres=((0.0, 0.0, 0.0, 0.01),), clearance=0.005, pinned=()):
    path = ComponentPath.of_skill(skill, pinned=pinned)
    tool = ToolAmongObstacles.along(path.nominal, np.array(spheres), tuple(obstacles))
    return Passages(path, tool, clearance, allowed_directions(forbidden)), tool


def shelf(path, *, opens):
    """Three boards around the start of a path in a plane; the side towards which it opens is given in radians."""
    ahead = path[20] - path[0]
    yaw = np.arctan2(ahead[1], ahead[0])
    boards = []
    for turn in (0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi):
        if not np.isclose(np.cos(turn - opens), 1.0):
            angle = yaw + turn
            out = np.array([np.cos(angle), np.sin(angle), 0.0])
            boards.append(
                Box(Pose(path[0] + 0.1 * out, [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]), [0.02, 0.22, 0.3])
            )
    return boards


def test_no_scene_with_a_path_is_proved_closed():
    skills = skills_to_adapt()
    closed = checked = 0
    for seed in range(150):
        skill = skills[seed % len(skills)]
        case = scene_for(skill, seed)
        allowed = allowed_directions(case.forbidden)
        if allowed.dimension < 2:
            continue
        path = ComponentPath.of_skill(skill, n_samples=case.n_samples, pinned=case.pinned)
        tool = ToolAmongObstacles.along(path.nominal, case.tool_spheres, case.scene.obstacles)
        found = Passages(path, tool, case.clearance, allowed).are_closed
        assert not (found and adapted(skill, case).feasible), seed
        closed += found
        checked += 1
    assert checked > 100 and closed > 10


def test_a_gap_that_is_too_narrow_is_closed_and_a_wide_one_is_not(planar):
    skill, path = planar
    for lacking, closed in ((0.01, True), (-0.002, False)):
        ends = [path[200] + side * np.array([0.0, 0.5 * (0.03 - lacking) + 1.0, 0.0]) for side in (1.0, -1.0)]
        walls = [Box(Pose(end, [1.0, 0.0, 0.0, 0.0]), [0.02, 2.0, 0.3]) for end in ends]
        assert passages_of(skill, walls, HORIZONTAL_ONLY)[0].are_closed == closed


def test_obstacles_that_move_and_tools_that_reach_aside_prove_nothing(planar):
    skill, path = planar
    wall = Box(Pose(path[200], [1.0, 0.0, 0.0, 0.0]), [0.05, 4.0, 3.0])
    assert passages_of(skill, [wall])[0].are_closed
    moving = Box(Pose(path[200], [1.0, 0.0, 0.0, 0.0]), [0.05, 4.0, 3.0], velocity=[0.0, 0.1, 0.0])
    for passages, _ in (
        passages_of(skill, [moving]),
        passages_of(skill, [wall], spheres=[(0.0, 0.0, 0.05, 0.01)]),
        passages_of(skill, []),
    ):
        assert not passages.are_closed
        assert passages.route() is None


def test_a_pinned_point_must_be_reached_too(planar):
    skill, path = planar
    at = 0.5 * skill.duration_
    sides = [
        Box(Pose(path[200] + 0.06 * side * np.eye(3)[axis], [1, 0, 0, 0]), np.where(np.arange(3) == axis, 0.02, 0.14))
        for axis in range(2)
        for side in (1.0, -1.0)
    ]
    assert passages_of(skill, sides, HORIZONTAL_ONLY, pinned=(at,))[0].are_closed
    assert not passages_of(skill, sides, HORIZONTAL_ONLY)[0].are_closed


def test_the_proposed_route_is_within_the_limits_and_nearly_clear(planar):
    skill, path = planar
    passages, tool = passages_of(skill, shelf(path, opens=np.pi), HORIZONTAL_ONLY)
    route = passages.route()
    nominal = ComponentPath.of_skill(skill).nominal.positions
    np.testing.assert_allclose(route[[0, -1]], 0.0, atol=1e-12)
    assert np.abs(route[:, 2]).max() < 1e-12
    assert np.linalg.norm(route, axis=1).max() < MAX_DISPLACEMENT
    assert tool.clearance_of(nominal + route).lowest > -0.02


@pytest.mark.parametrize("opens", [0.5 * np.pi, np.pi, 1.5 * np.pi])
def test_the_path_leaves_a_shelf_that_opens_to_another_side(planar, opens):
    skill, path = planar
    scene = Scene(None, shelf(path, opens=opens))
    found = adapt(skill, scene, tool_radius=0.01, clearance=0.005, forbidden=HORIZONTAL_ONLY)
    assert found.feasible, found.reason


@pytest.mark.parametrize(("dimension", "seed"), [(2, 2019), (3, 2105), (3, 2382)])
def test_windows_that_were_refused_are_passed(dimension, seed):
    case = static_case("S4", dimension, seed)
    found = adapted(case.skill, case)
    assert found.feasible, found.reason


def test_an_obstacle_without_a_rotation_needs_no_aligned_grid(planar):
    skill, path = planar
    around = [Sphere(path[0] + 0.1 * np.array([np.cos(a), np.sin(a), 0.0]), 0.04) for a in np.arange(0.0, 6.2, 0.5)]
    assert passages_of(skill, around, HORIZONTAL_ONLY)[0].are_closed
    assert not passages_of(skill, around[:9], HORIZONTAL_ONLY)[0].are_closed
