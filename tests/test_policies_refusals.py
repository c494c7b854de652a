"""Random scenes: what is accepted is clear, what is refused has no path; and the oracle that says so is checked."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark import families
from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.refusal_oracle import answer, is_solved
from imitarm.benchmark.refusal_proof import Answer, explored
from imitarm.benchmark.refusal_question import Question, separation
from imitarm.benchmark.refusals import adapted, evaluate_scene, question_of, scene_for, skills_to_adapt
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN, adapt
from imitarm.policies.component_path import ComponentPath
from imitarm.scene import Box, Scene, Sphere


@pytest.fixture(scope="module")
def skills():
    return skills_to_adapt()


@pytest.fixture(scope="module")
def cases(skills):
    """120 random scenes: skill, scene, and the skill adapted to it."""
    made = []
    for seed in range(120):
        skill = skills[seed % len(skills)]
        case = scene_for(skill, seed)
        made.append((skill, case, adapted(skill, case)))
    return made


@pytest.fixture(scope="module")
def planar():
    return learn(planar=True)


def walls(path, gap, *, beside=0.0, thick=0.02):
    """Two long walls across the middle of a planar path, with a gap whose centre is ``beside`` the path."""
    ahead = path[205] - path[195]
    yaw = np.arctan2(ahead[1], ahead[0])
    turned = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    centre = path[200] + beside * across
    return [
        Box(Pose(centre + side * (0.5 * gap + 1.0) * across, turned), [thick, 2.0, 0.3], name=name)
        for side, name in ((1.0, "left"), (-1.0, "right"))
    ]


def planar_question(skill, obstacles, *, clearance, radius=0.0):
    parts = ComponentPath.of_skill(skill)
    spheres = np.array([[0.0, 0.0, 0.0, radius]])
    forbidden = np.array(HORIZONTAL_ONLY)
    return Question(parts.nominal, parts.basis, tuple(obstacles), spheres, clearance, forbidden, parts.fixed_times)


def test_no_accepted_path_is_closer_than_required(cases):
    """Each of 4000 points is separated from each obstacle by a plane at the required distance."""
    accepted = 0
    for seed, (skill, case, adaptation) in enumerate(cases):
        if adaptation.feasible:
            accepted += 1
            path = adaptation.trajectory
            assert separation(question_of(skill, case), path.times, path.positions) >= -1e-9, seed
    assert accepted > 60


def test_forbidden_directions_hold_to_rounding_on_the_whole_path(cases):
    moved = 0
    for _, case, adaptation in cases:
        if not case.forbidden:
            continue
        away = adaptation.trajectory.positions - adaptation.nominal.positions
        moved += np.abs(away).max() > 0.01
        assert (away @ np.array(case.forbidden).T).max() <= 1e-15
    assert moved > 20


def test_oblique_forbidden_directions_hold_as_well(planar):
    skill, path = planar
    rng = np.random.default_rng(0)
    for seed in range(12):
        forbidden = rng.normal(size=(1 + seed % 4, 3))
        adaptation = adapt(skill, Scene(None, [Sphere(path[180], 0.03)]), tool_radius=0.01, forbidden=forbidden)
        away = adaptation.trajectory.positions - adaptation.nominal.positions
        assert (away @ forbidden.T).max() <= 1e-15


def test_the_jerk_is_limited_or_the_answer_says_why_not(cases):
    for _, _, adaptation in cases:
        path = adaptation.trajectory
        t = path.times
        if np.ptp(np.diff(t)) < 1e-9:
            jerk = [np.linalg.norm(np.diff(p.positions, 3, axis=0), axis=1).max() for p in (path, adaptation.nominal)]
            assert adaptation.jerk_ratio == pytest.approx(jerk[0] / jerk[1], rel=1e-6)
        assert (adaptation.jerk_ratio <= 10.0) == (adaptation.jerk_reason == "")


@pytest.mark.parametrize("clearance", [0.0, 0.001, 0.005])
def test_a_point_tool_goes_through_every_gap_that_is_wide_enough(planar, clearance):
    """What decides is the certificate, not a margin beyond the clearance."""
    skill, path = planar
    for more in (0.0005, 0.002, 0.01):
        for beside in (0.0, 0.008, -0.02):
            scene = Scene(None, walls(path, 2.0 * clearance + more, beside=beside))
            adaptation = adapt(skill, scene, tool_radius=0.0, clearance=clearance, forbidden=HORIZONTAL_ONLY)
            assert adaptation.feasible, (more, beside, adaptation.reason)


def test_a_gap_that_is_too_narrow_is_refused_and_the_oracle_proves_it(planar):
    skill, path = planar
    for lacking in (0.002, 0.01):
        obstacles = walls(path, 0.04 - lacking)
        adaptation = adapt(skill, Scene(None, obstacles), tool_radius=0.0, forbidden=HORIZONTAL_ONLY)
        assert not adaptation.feasible and "wall" not in adaptation.reason and "box" in adaptation.reason
        assert answer(planar_question(skill, obstacles, clearance=0.02)) is Answer.IMPOSSIBLE


def test_next_to_the_start_there_is_a_path_while_there_is_room(planar):
    """The obstacle is just ahead of the start, which it leaves clear by micrometres or by millimetres."""
    skill, path = planar
    for gap in (1e-5, 1e-4, 1e-3, 1e-2):
        for sideways in (0.3, -0.5):
            ahead = path[45] - path[0] + sideways * np.cross([0, 0, 1], path[45] - path[0])
            centre = path[0] + ahead / np.linalg.norm(ahead) * (0.03 + 0.03 + 0.02 + gap)
            scene = Scene(None, [Sphere(centre, 0.03)])
            adaptation = adapt(skill, scene, tool_radius=0.03, clearance=0.02, forbidden=NOT_DOWN)
            assert adaptation.feasible, (gap, sideways, adaptation.reason)
            np.testing.assert_array_equal(adaptation.trajectory.positions[0], adaptation.nominal.positions[0])


def test_the_oracle_proves_nothing_impossible_that_is_possible(planar):
    """Gaps that are wide enough by a millimetre, and scenes that were solved."""
    skill, path = planar
    for beside in (0.0, 0.015):
        question = planar_question(skill, walls(path, 0.041, beside=beside), clearance=0.02)
        assert not any(explored(question, timed=timed).answer is Answer.IMPOSSIBLE for timed in (False, True))
    spatial, spatial_path = learn(planar=False)
    for seed in range(4):
        scene = families.sparse_clutter(seed, spatial_path, n_obstacles=2, planar=False).scene
        parts = ComponentPath.of_skill(spatial)
        question = Question(
            parts.nominal,
            parts.basis,
            scene.obstacles,
            np.array([[0.0, 0.0, 0.0, 0.03]]),
            0.02,
            np.empty((0, 3)),
            parts.fixed_times,
        )
        assert explored(question, timed=False).answer is not Answer.IMPOSSIBLE
        assert is_solved(question)


def test_a_closed_box_around_the_goal_is_impossible(planar):
    skill, path = planar
    sides = [
        Box(Pose(path[-1] + 0.1 * side * np.eye(3)[axis], [1, 0, 0, 0]), np.where(np.arange(3) == axis, 0.02, 0.24))
        for axis in range(3)
        for side in (1.0, -1.0)
    ]
    adaptation = adapt(skill, Scene(None, sides), tool_radius=0.01, clearance=0.005)
    assert not adaptation.feasible
    parts = ComponentPath.of_skill(skill)
    spheres = np.array([[0.0, 0.0, 0.0, 0.01]])
    question = Question(parts.nominal, parts.basis, tuple(sides), spheres, 0.005, np.empty((0, 3)), parts.fixed_times)
    assert answer(question) is Answer.IMPOSSIBLE
    opened = Question(
        parts.nominal, parts.basis, tuple(sides[:-1]), spheres, 0.005, np.empty((0, 3)), parts.fixed_times
    )
    assert is_solved(opened)
    assert adapt(skill, Scene(None, sides[:-1]), tool_radius=0.01, clearance=0.005).feasible


@pytest.mark.slow
def test_refusals_are_right_and_accepted_scenes_are_solved_by_the_oracle(skills):
    verdicts = [evaluate_scene(skills[seed % len(skills)], seed) for seed in range(5000, 5040)]
    assert not [v for v in verdicts if v.is_violation]
    assert all(v.oracle is Answer.POSSIBLE for v in verdicts if v.accepted)
    refused = [v for v in verdicts if not v.accepted]
    assert len(refused) > 4
    assert sum(v.oracle is not Answer.IMPOSSIBLE for v in refused) <= 1
