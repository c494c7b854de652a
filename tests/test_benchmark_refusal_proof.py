"""The oracle's proofs: blocked cells are blocked, free cells are free, and each kind of hard scene is decided."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from imitarm.benchmark.refusal_oracle import decide
from imitarm.benchmark.refusal_proof import Answer, Cells, classified, explored
from imitarm.benchmark.refusal_question import (
    MAX_DISPLACEMENT,
    MAX_STEP_RATIO,
    TIME_LEVELS,
    Leg,
    Question,
    separation,
)
from imitarm.benchmark.refusal_routes import beside, even, short
from imitarm.benchmark.refusals import question_of, scene_for, skills_to_adapt
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.policies import HORIZONTAL_ONLY
from imitarm.policies.component_path import ComponentPath
from imitarm.scene import Box


@pytest.fixture(scope="module")
def skills():
    return skills_to_adapt()


def question(skill, obstacles, *, clearance=0.005, radius=0.01, forbidden=()):
    path = ComponentPath.of_skill(skill)
    spheres = np.array([[0.0, 0.0, 0.0, radius]])
    directions = np.array(forbidden, dtype=float).reshape(-1, 3)
    return Question(path.nominal, path.basis, tuple(obstacles), spheres, clearance, directions, path.fixed_times)


def wall(skill, gap, *, beside=0.0, thick=0.02, high=2.0):
    """Two boxes across the middle of a path, with a gap between them."""
    path = skill.gmr_.trajectory(401).positions
    ahead = path[205] - path[195]
    yaw = np.arctan2(ahead[1], ahead[0])
    turned = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    centre = path[200] + beside * across
    return [
        Box(Pose(centre + side * (0.5 * gap + 1.0) * across, turned), [thick, 2.0, high]) for side in (1.0, -1.0)
    ], (centre, turned)


def random_cells(leg, rng, n):
    """Cells of all sizes about the path."""
    low, high = leg.tip_box(np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp))
    level = rng.integers(0, TIME_LEVELS + 1, n)
    at = (rng.random(n) * 2**level).astype(np.intp)
    corner = low - 0.3 + rng.random((n, leg.dimension)) * (high - low + 0.6)
    size = 10.0 ** rng.uniform(-4, -0.7, (n, leg.dimension))
    return Cells.unknown(corner, corner + size, level, at, rng.integers(0, 4, n))


def test_what_holds_for_a_cell_holds_at_every_position_and_time(skills):
    """Scenes of all kinds: rotating tools, moving obstacles, forbidden directions."""
    rng = np.random.default_rng(5)
    n_blocked = n_free = 0
    for seed in range(30):
        skill = skills[seed % len(skills)]
        asked = question_of(skill, scene_for(skill, seed))
        axes = asked.axes()
        for start, end in pairwise(asked.fixed_times):
            leg = Leg(asked, axes, start, end)
            cells, blocked = classified(leg, random_cells(leg, rng, 60), timed=True)
            first, last = cells.times()
            for i in np.flatnonzero(blocked | cells.free).tolist():
                times = rng.uniform(first[i], last[i], 30)
                positions = leg.positions(rng.uniform(cells.low[i], cells.high[i], (30, len(axes))), times)
                times = start + times * (end - start)
                tip, relative = asked.at(times)
                away = positions - tip
                room = MAX_DISPLACEMENT - np.linalg.norm(away, axis=1)
                for f in asked.forbidden:
                    if np.linalg.norm(axes @ f) > 1e-9:
                        room = np.minimum(room, -(away @ f) / np.linalg.norm(f))
                for obstacle in asked.obstacles:
                    for sphere, offset in zip(asked.spheres, relative, strict=True):
                        distance = obstacle.signed_distance(positions + offset - times[:, None] * obstacle.velocity)
                        room = np.minimum(room, distance - sphere[3] - asked.clearance)
                if blocked[i]:
                    assert room.max() < 1e-9
                    n_blocked += 1
                else:
                    assert room.min() > -1e-9
                    n_free += 1
    assert n_blocked > 200 and n_free > 200


def test_the_halves_of_a_cell_fill_it_and_touch(skills):
    leg = Leg(question(skills[0], []), np.eye(3), 0.0, skills[0].duration_)
    rng = np.random.default_rng(1)
    cells = random_cells(leg, rng, 50)
    cells = Cells(**{**vars(cells), "axis": np.where(cells.level < TIME_LEVELS, rng.integers(0, 4, 50), 1)})
    halves = cells.halves()
    one, two = np.arange(50), np.arange(50, 100)
    assert halves.touch(one, two).all()
    for name, pick in (("low", np.minimum), ("high", np.maximum)):
        values = getattr(halves, name)
        np.testing.assert_allclose(pick(values[one], values[two]), getattr(cells, name))
    (start, end), (first, last) = halves.times(), cells.times()
    np.testing.assert_allclose(np.minimum(start[one], start[two]), first)
    np.testing.assert_allclose(np.maximum(end[one], end[two]), last)
    sizes = np.prod(halves.high - halves.low, axis=1) * (end - start)
    np.testing.assert_allclose(sizes[one] + sizes[two], np.prod(cells.high - cells.low, axis=1) * (last - first))


@pytest.mark.parametrize("lacking", [0.0002, 0.002])
def test_a_gap_that_is_too_narrow_is_proved_while_the_path_rises(skills, lacking):
    """The path may be displaced only horizontally, but moves up and down itself."""
    walls, _ = wall(skills[0], 0.03 - lacking)
    asked = question(skills[0], walls, forbidden=HORIZONTAL_ONLY)
    assert np.ptp(asked.nominal.positions[:, 2]) > 0.02
    assert explored(asked, timed=False).answer is Answer.IMPOSSIBLE


def test_a_gap_with_a_millimetre_to_spare_is_passed(skills):
    for spare in (0.0005, 0.002):
        walls, _ = wall(skills[0], 0.03 + spare, beside=0.12)
        asked = question(skills[0], walls, forbidden=HORIZONTAL_ONLY)
        found, path = decide(asked)
        assert found is Answer.POSSIBLE
        assert separation(asked, asked.nominal.times, path) >= 0.0


@pytest.mark.parametrize("spare", [-0.002, -0.0003, 0.0005, 0.004])
def test_a_window_is_decided_by_its_size(skills, spare):
    """A window in a wall, a little lower or higher than the tool needs, and beside the path."""
    walls, (centre, turned) = wall(skills[0], 0.05, beside=-0.1)
    height = 0.03 + spare
    sills = [
        Box(Pose(centre + [0.0, 0.0, side * 0.5 * (height + 1.0)], turned), [0.02, 0.05, 1.0]) for side in (1.0, -1.0)
    ]
    asked = question(skills[0], [*walls, *sills])
    assert decide(asked)[0] is (Answer.POSSIBLE if spare > 0.0 else Answer.IMPOSSIBLE)


@pytest.mark.parametrize("thick", [0.004, 0.018])
def test_a_closed_box_about_the_goal_is_proved_whatever_its_rotation(skills, thick):
    goal = skills[0].gmr_.trajectory(10).positions[-1]
    pose = Pose(goal, quaternion_exp(np.array([0.4, -0.2, 0.8])))
    sides = []
    for axis in range(3):
        for side in (1.0, -1.0):
            size = np.where(np.arange(3) == axis, thick, 0.3)
            sides.append(Box(Pose(pose.apply(0.15 * side * np.eye(3)[axis]), pose.quaternion), size))
    assert decide(question(skills[0], sides))[0] is Answer.IMPOSSIBLE
    assert decide(question(skills[0], sides[1:]))[0] is Answer.POSSIBLE


def test_a_way_is_short_and_followed_within_the_limits():
    rng = np.random.default_rng(3)
    low = rng.random((12, 2)) * 0.2
    high = low + 0.1
    route = short(np.zeros(2), np.ones(2), low, high)
    assert np.all((route[1:-1] >= low) & (route[1:-1] <= high))
    others = rng.uniform(low, high, (200, 12, 2))
    steps = [np.sum(np.diff(np.concatenate([route[:1], p, route[-1:]]), axis=0) ** 2) for p in (route[1:-1], *others)]
    assert min(steps) == steps[0]
    earliest = np.sort(rng.random(12) * 0.5)
    times = even(route, earliest, earliest + 0.3)
    assert times[0] == 0.0 and times[-1] == 1.0 and np.all(np.diff(times) >= 0.0)
    assert np.all((times[1:-1] >= earliest - 1e-9) & (times[1:-1] <= earliest + 0.3 + 1e-9))


def test_a_path_beside_the_nominal_one_is_never_too_fast():
    samples = np.linspace(0.0, 1.0, 100)
    nominal = np.stack([samples, 0.0 * samples], axis=1)
    route = np.array([[0.0, 0.0], [0.2, 0.3], [0.9, 0.3], [1.0, 0.0]])
    times, points = beside(route, samples, nominal)
    assert np.array_equal(times, samples)
    np.testing.assert_allclose(points[[0, -1]], route[[0, -1]], atol=1e-12)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= MAX_STEP_RATIO * (nominal[1, 0] - nominal[0, 0])
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(route, axis=0), axis=1)))
    steady = np.stack([np.interp(samples * length[-1], length, column) for column in route.T], axis=1)
    assert np.sum((points - nominal) ** 2) < np.sum((steady - nominal) ** 2)
