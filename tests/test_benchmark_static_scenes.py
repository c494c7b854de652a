"""Scenes of the static benchmark: reproducible, really blocked, and solvable or not as their construction says."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.refusal_oracle import answer
from imitarm.benchmark.refusal_proof import Answer
from imitarm.benchmark.refusals import adapted, question_of
from imitarm.benchmark.static_scenes import ANY_SKILL, FAMILIES, SPLITS, learned_skill, static_case
from imitarm.demonstrations import align
from imitarm.errors import InputError, UnknownNameError
from imitarm.scene import Scene
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach
from imitarm.tasks.open_box import BOARDS
from imitarm.tasks.sweep import SweepTask

BOTH = [(family, dimension) for family in FAMILIES for dimension in (2, 3)]
BLOCKED = [(family, dimension) for family, dimension in BOTH if family != "S6"]


def cases(family, dimension, n=12):
    return [static_case(family, dimension, seed) for seed in range(2000, 2000 + n)]


def clearance_without_avoidance(case, *, primitive=False):
    """Smallest distance from the tool to the obstacles, by separating planes, at 4000 points of the learned path."""
    skill = case.skill
    points = skill.nominal(np.linspace(0.0, skill.duration_, 4000)).positions
    if primitive:
        points = skill.generate(dt=skill.duration_ / 2000).positions
    radius = case.tool_spheres[0, 3]
    return min(o.signed_distance(points).min() for o in case.scene.obstacles) - radius


@pytest.mark.parametrize("family, dimension", BOTH)
def test_a_seed_gives_the_same_scene_and_another_seed_another(family, dimension):
    first, again, other = (static_case(family, dimension, seed) for seed in (7, 7, 8))
    points = np.random.default_rng(0).uniform(-0.5, 1.0, (50, 3))
    np.testing.assert_array_equal(first.scene.distances(points), again.scene.distances(points))
    assert (first.pinned, first.must_refuse) == (again.pinned, again.must_refuse)
    assert first.skill is again.skill
    ours, theirs = (np.concatenate([o.bounds().ravel() for o in c.scene.obstacles]) for c in (first, other))
    assert ours.shape != theirs.shape or not np.allclose(ours, theirs)


@pytest.mark.parametrize("family, dimension", BLOCKED)
def test_without_avoidance_the_tool_touches_an_obstacle(family, dimension):
    for case in cases(family, dimension):
        assert clearance_without_avoidance(case) < 0.0
        assert clearance_without_avoidance(case, primitive=True) < 0.0


@pytest.mark.parametrize("family, dimension", BLOCKED)
def test_obstacles_leave_start_and_goal_free(family, dimension):
    for case in cases(family, dimension):
        ends = np.stack([case.skill.start_.position, case.skill.goal_.position])
        free = case.scene.clearance(ends) - case.tool_spheres[0, 3]
        assert free.min() >= case.clearance + 0.01 - 1e-9
        assert case.scene.goal is None


@pytest.mark.parametrize("dimension", [2, 3])
def test_where_a_point_is_covered_the_scene_must_be_refused(dimension):
    covered = set()
    for case in cases("S6", dimension, 30):
        assert case.must_refuse
        times = [0.0, *case.pinned, case.skill.duration_]
        at = case.skill.nominal(times).positions
        free = case.scene.clearance(at) - case.tool_spheres[0, 3]
        assert free.min() < case.clearance
        covered.add("contact" if case.pinned else "start" if np.argmin(free) == 0 else "goal")
        assert not adapted(case.skill, case).feasible
    assert covered == {"start", "goal", "contact"}


@pytest.mark.parametrize("family, dimension", [("S4", 2), ("S6", 2), ("S6", 3)])
def test_the_oracle_proves_that_scenes_that_must_be_refused_have_no_path(family, dimension):
    checked = 0
    for case in cases(family, dimension, 20):
        if case.must_refuse and checked < 3:
            checked += 1
            assert answer(question_of(case.skill, case)) is Answer.IMPOSSIBLE
    assert checked == 3


@pytest.mark.parametrize("family", ["S1", "S3", "S4", "S5"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_scenes_that_are_called_solvable_are_solved(family, dimension):
    """By the certified search, which misses one in twenty gaps; those are for the oracle (too slow here)."""
    solved = [adapted(c.skill, c).feasible for c in cases(family, dimension, 20) if c.must_refuse is False]
    assert len(solved) >= 12
    assert np.mean(solved) == 1.0 if family != "S4" else np.mean(solved) >= 0.8


@pytest.mark.parametrize("dimension", [2, 3])
def test_gaps_are_as_wide_as_announced_and_a_fifth_is_too_narrow(dimension):
    found = cases("S4", dimension, 60)
    widths = []
    for case in found:
        left, right = case.scene.obstacles[:2]
        apart = np.linalg.norm(left.pose.position - right.pose.position) - left.size[1]
        widths.append(apart)
        if case.must_refuse is not None:
            assert case.must_refuse == (apart < 2.0 * (0.03 + case.clearance))
    assert min(widths) >= 1.2 * 0.06 - 1e-9
    assert max(widths) <= 3.0 * 0.06 + 1e-9
    assert sum(case.must_refuse is True for case in found) >= 12


def test_each_family_has_the_obstacles_that_its_name_says():
    kinds = {
        family: [{o.kind for o in c.scene.obstacles} for c in cases(family, 3, 40)] for family in ("S1", "S2", "S3")
    }
    counts = {family: {len(c.scene.obstacles) for c in cases(family, 3, 40)} for family in ("S1", "S2", "S3")}
    assert counts == {"S1": {1, 2}, "S2": {4, 5, 6, 7, 8}, "S3": {1, 2, 3}}
    assert set().union(*kinds["S1"], *kinds["S2"]) == {"sphere", "box"}
    assert set().union(*kinds["S3"]) == {"sphere", "box", "capsule", "cylinder", "cone", "ellipsoid", "convex_hull"}


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_trap_is_open_towards_the_path(dimension):
    """There are walls to the left and to the right of the inside, and none behind it."""
    for case in cases("S5", dimension):
        bottom, left, right = case.scene.obstacles
        assert 0.05 <= left.size[0] <= 0.20
        np.testing.assert_array_equal(left.size, right.size)
        axis = bottom.pose.rotation[:, 0]
        assert (left.pose.position - bottom.pose.position) @ axis < 0.0
        inside = bottom.pose.position - 0.5 * (left.size[0] + bottom.size[0]) * axis
        width = np.linalg.norm(left.pose.position - right.pose.position) - left.size[1]
        assert width >= 1.2 * 0.06 - 1e-9
        rays = inside + np.linspace(0.0, 0.5, 200)[:, None] * bottom.pose.rotation[:, 1]
        assert case.scene.clearance(rays).min() < 0.0 and case.scene.clearance(2.0 * inside - rays).min() < 0.0
        assert case.scene.clearance(inside - np.linspace(0.0, 0.5, 200)[:, None] * axis).min() > 0.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_eight_seeds_in_a_row_are_the_eight_sweeping_tasks(dimension):
    for seed in range(2000, 2016):
        case = static_case("S7", dimension, seed)
        packaged = SweepTask.scene(f"T{1 + seed % 8}")
        assert [o.name for o in case.scene.obstacles] == [o.name for o in packaged.obstacles]
        assert len(case.scene.obstacles) == (2, 2, 2, 3, 3, 3, 4, 4)[seed % 8]
        for obstacle, original in zip(case.scene.obstacles, packaged.obstacles, strict=True):
            assert obstacle.bounds()[0, 2] == pytest.approx(0.0, abs=1e-9)
            assert np.linalg.norm(obstacle.pose.position - original.pose.position) < 0.05
        [time] = case.pinned
        at_dirt = case.skill.nominal([0.0, time, case.skill.duration_]).positions[1]
        assert np.linalg.norm(at_dirt - SweepTask.dirt.position) < 0.005
        assert case.tool_spheres[0, 3] == SweepTask.tool_radius


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_goal_is_in_the_box_and_only_obstacles_are_on_the_path(dimension):
    for case in cases("S9", dimension):
        boards, obstacles = case.scene.obstacles[:5], case.scene.obstacles[5:]
        assert [board.name for board in boards] == list(BOARDS)
        assert 1 <= len(obstacles) <= 3
        path = case.skill.nominal(np.linspace(0.0, case.skill.duration_, 400)).positions
        assert Scene(None, boards).clearance(path).min() > 0.03 + case.clearance
        bounds = np.array([board.bounds() for board in boards])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        assert np.all((low < path[-1]) & (path[-1] < high))


@pytest.mark.parametrize("family", ["S2", "S7", "S9"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_most_scenes_without_a_known_answer_have_a_path(family, dimension):
    found = cases(family, dimension)
    assert all(case.must_refuse is None for case in found)
    assert sum(adapted(case.skill, case).feasible for case in found) >= 10


def test_a_trap_is_upright_and_in_2d_only_horizontal_displacements_are_allowed():
    case = static_case("S5", 2, 2000)
    assert case.forbidden == ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    assert static_case("S5", 3, 2000).forbidden == ()


@pytest.mark.parametrize("family", ANY_SKILL)
def test_scenes_can_be_placed_on_the_path_of_any_skill(family):
    rng = np.random.default_rng(5)
    motion = s_shaped_reach(planar=False)
    shown = demonstrations_by(motion, 1)
    moved = [d.with_trajectory(d.trajectory.with_positions(d.trajectory.positions + rng.normal()), None) for d in shown]
    skill = Skill(6).fit(align(moved))
    case = static_case(family, 3, 2001, skill=skill)
    assert case.skill is skill
    assert case.must_refuse in ((True,) if family == "S6" else (None,))
    if family != "S6":
        assert clearance_without_avoidance(case) < 0.0


def test_a_path_that_is_short_gets_as_many_obstacles_as_fit():
    shown = demonstrations_by(s_shaped_reach(planar=False), 1)
    skill = Skill(6).fit(
        align([d.with_trajectory(d.trajectory.with_positions(0.6 * d.trajectory.positions), None) for d in shown])
    )
    counts = {len(static_case("S3", 3, seed, skill=skill).scene.obstacles) for seed in range(2000, 2010)}
    assert 3 not in counts and counts


def test_wrong_arguments_are_named():
    with pytest.raises(UnknownNameError, match=r"S0.*S1"):
        static_case("S0", 2, 0)
    with pytest.raises(InputError, match="dimension must be 2 or 3"):
        static_case("S1", 4, 0)
    with pytest.raises(InputError, match="scenes of S4 need the skill of this family"):
        static_case("S4", 2, 0, skill=learned_skill("S4", 2))
    short = Skill(4).fit(
        [
            d.with_trajectory(d.trajectory.with_positions(0.1 * d.trajectory.positions), None)
            for d in demonstrations_by(s_shaped_reach(planar=False), 1)
        ]
    )
    with pytest.raises(InputError, match="longer path"):
        static_case("S1", 3, 0, skill=short)


@pytest.mark.parametrize("dimension", [2, 3])
def test_dense_scenes_have_as_many_obstacles_as_requested(dimension):
    for n in (1, 2, 8, 20):
        case = static_case("S2", dimension, 2000, n_obstacles=n)
        assert len(case.scene.obstacles) == n
        assert clearance_without_avoidance(case) < 0.0
    with pytest.raises(InputError, match="needs the family S2"):
        static_case("S1", dimension, 2000, n_obstacles=3)


def test_the_splits_share_no_seed():
    seeds = [seed for first, end in SPLITS.values() for seed in range(first, end)]
    assert len(seeds) == len(set(seeds))


def test_skills_of_one_three_and_ten_teachers_differ_and_are_learned_once():
    skills = [learned_skill("S1", 3, teachers) for teachers in (1, 3, 10)]
    assert [skill.n_demonstrations_ for skill in skills] == [8, 24, 80]
    assert static_case("S1", 3, 5, teachers=3).skill is skills[1]
    times = np.linspace(0.0, 1.0, 50)
    paths = [skill.nominal(times * skill.duration_).positions for skill in skills]
    assert min(np.abs(paths[0] - paths[1]).max(), np.abs(paths[1] - paths[2]).max()) > 0.005
