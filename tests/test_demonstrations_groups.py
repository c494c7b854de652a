from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.cli import main
from imitarm.demonstrations import align, group_by_path
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.pose import Pose
from imitarm.policies import ACFRA
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Trajectory

U = np.linspace(0.0, 1.0, 200)
SMOOTH = 10 * U**3 - 15 * U**4 + 6 * U**5


def passing(sideways, name, seed=0):
    """A reach of 0.4 m in 3 s that passes a place at its middle at a distance of ``sideways`` [m]."""
    noise = np.random.default_rng(seed).normal(size=2)
    bend = np.sin(np.pi * SMOOTH) ** 2
    y = sideways * bend + 0.002 * noise[0] * bend
    z = 0.3 + 0.002 * noise[1] * bend
    return Demonstration(Trajectory(3.0 * U, np.stack([0.4 + 0.4 * SMOOTH, y, z], axis=1)), task="pass", source=name)


LEFT = [passing(0.08, f"left{i}", i) for i in range(3)]
RIGHT = [passing(-0.06, f"right{i}", 10 + i) for i in range(3)]


@settings(max_examples=15, deadline=None)
@given(st.permutations(range(6)))
def test_two_ways_are_found_in_every_order(order):
    shown = [(LEFT + RIGHT)[i] for i in order]
    groups = group_by_path(shown)
    assert [{one.source.rstrip("012") for one in group} for group in groups] in (
        [{"left"}, {"right"}],
        [{"right"}, {"left"}],
    )
    assert all([shown.index(one) for one in group] == sorted(shown.index(one) for one in group) for group in groups)


def test_three_ways_and_the_largest_group_first():
    left, middle = ([passing(y, f"{y}, {i}", i) for i in range(n)] for y, n in ((0.12, 3), (0.0, 4)))
    right = [passing(-0.11, f"right{i}", i) for i in range(2)]
    assert group_by_path([*left, *right, *middle]) == [middle, left, right]


def test_one_way_stays_one_group():
    assert group_by_path(LEFT) == [LEFT]
    assert group_by_path(LEFT[:1]) == [LEFT[:1]]
    spread = [passing(0.01 * i, f"s{i}", i) for i in range(8)]  # a wide tolerance, but no gap
    assert group_by_path(spread) == [spread]


def test_nothing_to_group():
    with pytest.raises(InputError, match="no demonstrations"):
        group_by_path([])


def skills():
    return Skill(8).fit(align(LEFT)), Skill(8).fit(align(RIGHT))


def test_the_policy_takes_the_demonstrated_path_that_is_clear():
    left, right = skills()
    policy = ACFRA(left, alternatives=[right], tool_radius=0.01)
    free = policy.plan_motion(Scene(None, []))
    assert free.displaced.max() == 0.0 and free.trajectory.positions[100, 1] > 0.05
    blocked = Sphere([0.6, 0.08, 0.3], 0.03)  # on the left path
    plan = policy.plan_motion(Scene(None, [blocked]))
    assert plan.trajectory.positions[100, 1] < -0.03 and plan.displaced.max() < 5e-3
    assert blocked.signed_distance(plan.trajectory.positions).min() >= 0.03
    np.testing.assert_allclose(plan.trajectory.positions[[0, -1]], [left.start_.position, left.goal_.position])


def test_all_paths_have_the_goal_of_the_scene_and_refusals_count_them():
    left, right = skills()
    policy = ACFRA(left, alternatives=[right], tool_radius=0.01)
    goal = Pose(left.goal_.position + [0.05, 0.02, 0.0], [1, 0, 0, 0])
    plan = policy.plan_motion(Scene(goal, [Sphere([0.6, 0.08, 0.3], 0.03)]))
    np.testing.assert_allclose(plan.trajectory.positions[-1], goal.position, atol=1e-9)
    with pytest.raises(InfeasibleError, match="none of the 1 alternative paths is clear either"):
        policy.plan_motion(Scene(None, [Sphere(left.goal_.position, 0.05)]))


def test_the_command_learns_a_skill_from_each_path(tmp_path, capsys):
    for one in LEFT + RIGHT:
        one.save(tmp_path / f"{one.source}.csv")
    files, out = [str(tmp_path / f"{one.source}.csv") for one in LEFT + RIGHT], tmp_path / "pass.json"
    assert main(["learn", *files, "--out", str(out)]) == 2  # one skill would be the mean of both
    assert "two-paths" in (captured := capsys.readouterr()).out + captured.err and not out.exists()
    assert main(["learn", *files, "--each-path", "--components", "8", "--out", str(out)]) == 0
    ways = [Skill.load(tmp_path / f"pass-{i}.json").generate().positions[:, 1] for i in (1, 2)]
    assert ways[0].max() > 0.06 and ways[1].min() < -0.04 and not out.exists()
    assert main(["learn", *files, "--each-path", "--out", str(out)]) == 2  # would replace the files
    assert "pass-1.json" in capsys.readouterr().err
