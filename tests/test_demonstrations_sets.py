"""Demonstrations that do not belong together are found, from two on; those that belong together are left alone."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from demonstration_samples import motion, motions
from imitarm.demonstrations import lint, read_raw
from imitarm.kinematics.pose import quaternion_exp
from imitarm.trajectory import Demonstration, Trajectory

PHASE = np.linspace(0.0, 1.0, 240)
SMOOTH = PHASE**3 * (10.0 - 15.0 * PHASE + 6.0 * PHASE**2)
TIMES = 4.0 * PHASE


def shown(positions, source, quaternions=None):
    return Demonstration(Trajectory(TIMES, positions, quaternions), source=f"folder/{source}")


def reach(sideways, source="one", seed=0):
    """A reach of 0.4 m that bends sideways by so much [m]."""
    offset = 1e-3 * np.random.default_rng(seed).normal(size=3)
    positions = np.stack([0.3 + 0.4 * SMOOTH, sideways * np.sin(np.pi * SMOOTH), 0.2 + 0.05 * SMOOTH**2], axis=1)
    return shown(positions + offset, source)


def reached(one, *, until=1.0, since=0.0, source="part"):
    """Part of a motion, in the same time."""
    trajectory = one.trajectory
    times = (since + (until - since) * PHASE) * trajectory.times[-1]
    return shown(trajectory.at(times)[0], source)


def reversed_(one, source="back"):
    return shown(one.trajectory.positions[::-1], source)


def worrying(demonstrations):
    return [(f.code, f.severity, f.source.rpartition("/")[2]) for f in lint(demonstrations) if f.severity != "note"]


@pytest.mark.parametrize("others", [1, 2, 5])
@pytest.mark.parametrize(
    "one",
    [reach(0.04, "a"), motion(source="folder/a")],
    ids=["a reach", "over a bump"],
)
def test_one_that_runs_backwards(one, others):
    company = [shown(one.trajectory.resample(240).positions + [0, 1e-3 * i, 0], f"b{i}") for i in range(others)]
    findings = worrying([*company, reversed_(company[0])])
    assert findings == [("direction", "error", "back")]


def test_one_that_goes_round_a_loop_the_other_way():
    angle = 2.0 * np.pi * SMOOTH
    loop = np.stack([0.4 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.2 + 0.0 * angle], axis=1)
    assert worrying([shown(loop, "a"), shown(loop + 1e-3, "b"), reversed_(shown(loop, "c"))]) == [
        ("direction", "error", "back")
    ]
    assert worrying([shown(loop, "a"), shown(loop + 1e-3, "b")]) == []


def test_there_and_back_has_no_direction():
    there_and_back = np.stack([0.3 + 0.4 * np.sin(np.pi * SMOOTH), 0.0 * SMOOTH, 0.2 + 0.0 * SMOOTH], axis=1)
    assert worrying([shown(there_and_back, "a"), reversed_(shown(there_and_back, "b"))]) == []


@pytest.mark.parametrize("others", [1, 2, 4])
@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"until": 0.6}, "stops at"),
        ({"until": 0.5}, "stops at"),
        ({"since": 0.5}, "begins at"),
    ],
)
def test_one_that_is_incomplete(others, part, words):
    company = [reach(0.04 + 0.003 * i, f"b{i}", seed=i) for i in range(others)]
    demonstrations = [*company, reached(reach(0.04), **part)]
    assert worrying(demonstrations) == [("incomplete", "error", "part")]
    (finding,) = [f for f in lint(demonstrations) if f.code == "incomplete"]
    assert words in finding.message and "% of the path of b" in finding.message


def test_two_of_three_that_are_incomplete():
    parts = [reached(reach(0.04), until=0.55, source=name) for name in "ab"]
    found = worrying([*parts, reach(0.042, "whole")])
    assert found == [("incomplete", "error", "a"), ("incomplete", "error", "b")]


@pytest.mark.parametrize(("left", "right"), [(1, 1), (1, 2), (2, 1), (2, 2), (3, 3), (2, 5)])
def test_two_ways_round(left, right):
    ways = [reach(0.09 + 0.004 * i, f"l{i}", i) for i in range(left)]
    ways += [reach(-0.09 - 0.004 * i, f"r{i}", 9 + i) for i in range(right)]
    demonstrations = [*ways[::2], *ways[1::2]]
    assert {f[:2] for f in worrying(demonstrations)} - {("outlier", "warning")} == {("two-paths", "error")}
    (finding,) = [f for f in lint(demonstrations) if f.code == "two-paths"]
    assert "l0" in finding.message and "r0" in finding.message and "mm apart" in finding.message


def test_three_that_all_go_other_ways():
    assert ("two-paths", "error") in {f[:2] for f in worrying([reach(0.15, "a"), reach(-0.15, "b"), reach(0.0, "c")])}


@pytest.mark.parametrize("n", [2, 3, 6])
def test_goals_that_differ(n):
    company = [reach(0.05, f"a{i}", i) for i in range(n - 1)]
    turned = company[0].trajectory.positions - company[0].trajectory.positions[0]
    elsewhere = shown(turned[:, [1, 0, 2]] + company[0].trajectory.positions[0], "elsewhere")
    findings = worrying([*company, elsewhere])
    assert "ends" in {code for code, _, _ in findings}
    ends = next(f for f in lint([*company, elsewhere]) if f.code == "ends")
    assert ends.message.startswith("the goals of elsewhere and of a0" if n > 2 else "the goals of")


def test_motions_shown_in_two_frames():
    frames = [reach(0.05, "a"), shown(reach(0.05).trajectory.positions + [0.0, 0.3, 0.0], "b")]
    assert [f[0] for f in worrying(frames)] == ["ends", "ends"]


@pytest.mark.parametrize("n", [2, 3, 4])
def test_rotations_in_two_ways(n):
    straight = reach(0.05).trajectory.positions
    turns = [quaternion_exp(np.outer(sign * 1.2 * np.sin(np.pi * SMOOTH), [0, 0, 1])) for sign in (1, -1, 1, -1)[:n]]
    found = worrying([shown(straight, f"a{i}", q) for i, q in enumerate(turns)])
    assert [f[0] for f in found] == ["two-rotations"]


def test_motions_that_only_rotate_are_compared_by_rotation():
    still = np.tile([0.4, 0.1, 0.3], (240, 1))

    def turning(until, source):
        return shown(still, source, quaternion_exp(np.outer(until * SMOOTH, [0.0, 0.6, 0.8])))

    assert worrying([turning(1.0, "a"), turning(1.02, "b"), turning(0.98, "c")]) == []
    assert worrying([turning(1.0, "a"), turning(1.0, "b"), turning(0.55, "c")]) == [("incomplete", "error", "c")]
    back = quaternion_exp(np.outer(1.0 - SMOOTH, [0.0, 0.6, 0.8]))
    assert worrying([turning(1.0, "a"), turning(1.0, "b"), shown(still, "c", back)]) == [("direction", "error", "c")]


@pytest.mark.parametrize("n", [2, 3])
def test_clean_motions_belong_together(n):
    for seed in range(2):
        family = motions(5, noise=1e-3, spread=0.01, seed=seed, rotations=bool(seed % 2))
        for few in itertools.combinations(family, n):
            assert worrying(list(few)) == []


def test_pairs_of_real_recordings_belong_together(real_data):
    for name in ("bottle2shelf", "letter_e", "letter_l"):
        family = read_raw(real_data / "panda_kinesthetic" / f"{name}.npy", units="cm", duration=10.0)[::2]
        for few in itertools.combinations(family, 2):
            assert worrying(list(few)) == []


def turned(degrees, source, seed=0):
    """A reach with a tool rotated by ``degrees`` about the vertical."""
    half = 0.5 * np.radians(degrees) + 0.1 * SMOOTH
    quaternions = np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], axis=1)
    return shown(reach(0.04, seed=seed).trajectory.positions, source, quaternions)


@pytest.mark.parametrize(
    ("degrees", "odd"),
    [
        ([0, 170], None),
        ([0, 3, 170], "c"),
        ([0, 172, 4, 170], None),
        ([0, 2, 4, -3, 170], "e"),
        ([0, 30, 60, 90, 120], None),
    ],
)
def test_opposed_rotations_are_an_error(degrees, odd):
    demonstrations = [
        turned(angle, name, seed) for seed, (angle, name) in enumerate(zip(degrees, "abcde", strict=False))
    ]
    errors = [f for f in lint(demonstrations) if f.severity == "error"]
    assert [f.code for f in errors] == ["two-rotations"]
    assert "at the same fraction of the motion" in errors[0].message
    assert odd is None or errors[0].source.endswith(odd)


@pytest.mark.parametrize("degrees", [[0, 80], [0, 50, 3], [0, 40, 80]])
def test_rotations_less_than_90_degrees_apart_are_a_warning_at_most(degrees):
    demonstrations = [turned(angle, name) for angle, name in zip(degrees, "abc", strict=False)]
    assert {f.severity for f in lint(demonstrations) if "rotation" in f.code} <= {"warning"}
