"""Synthetic teachers: habits that stay the same for one teacher and differ between teachers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.benchmark.static_scenes import learned_skill
from imitarm.errors import InputError
from imitarm.tasks.habits import Habits, demonstrations_by, s_shaped_demonstrations, s_shaped_reach
from imitarm.tasks.open_box import OpenBoxTask
from imitarm.tasks.sweep import SweepTask

MOTIONS = [
    *(s_shaped_reach(planar=planar) for planar in (True, False)),
    *(OpenBoxTask.motion(planar=planar) for planar in (True, False)),
    SweepTask.motion(),
]


@given(st.integers(0, 10_000))
def test_every_teacher_moves_from_start_to_goal_without_stepping_back(seed):
    progress = Habits.from_seed(seed).progress(np.linspace(0.0, 1.0, 500))
    assert np.diff(progress).min() >= 0.0
    np.testing.assert_allclose(progress[[0, -1]], [0.0, 1.0], atol=1e-12)


@given(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3))
def test_eagerness_brings_the_teacher_forward_and_hesitation_slows_the_middle(eagerness, hesitation):
    u = np.linspace(0.0, 1.0, 1001)
    p = Habits(eagerness=eagerness, hesitation=hesitation).progress(u)
    middle = Habits().progress(u)
    assert np.sign(np.round((p - middle)[500], 9)) == np.sign(np.round(eagerness, 9))
    slope = (p[501] - p[499]) / (middle[501] - middle[499])
    if abs(eagerness) < 1e-9 and abs(hesitation) > 1e-6:
        assert (slope < 1.0) == (hesitation > 0.0)


@pytest.mark.parametrize("motion", MOTIONS)
def test_demonstrations_start_and_end_where_the_motion_does_and_are_precise_there(motion):
    ideal = motion.curve(np.array([0.0, 1.0]))
    for demonstration in demonstrations_by(motion, 10):
        ends = demonstration.trajectory.positions[[0, -1]]
        np.testing.assert_allclose(ends, ideal, atol=1e-9)


@pytest.mark.parametrize("motion", MOTIONS)
def test_what_must_not_move_does_not_move(motion):
    held = np.array(motion.free) == 0.0
    p = np.linspace(0.0, 1.0, 50)
    assert not motion.spread(p)[:, :, held].any()
    assert not motion.bend(p)[:, held].any()
    for demonstration in demonstrations_by(motion, 3):
        assert np.all(np.ptp(demonstration.trajectory.positions, axis=0)[held] < 1e-15)


@pytest.mark.parametrize("motion", MOTIONS)
def test_bends_and_spread_leave_start_and_goal_where_they_are(motion):
    ends = np.array([0.0, 1.0])
    np.testing.assert_allclose(motion.bend(ends), 0.0, atol=1e-12)
    np.testing.assert_allclose(motion.spread(ends), 0.0, atol=1e-12)


def test_every_teacher_of_the_sweep_meets_the_dirt():
    for demonstration in demonstrations_by(SweepTask.motion(), 10):
        away = np.linalg.norm(demonstration.trajectory.positions - SweepTask.dirt.position, axis=1)
        assert away.min() < 0.008


def test_repeats_of_one_teacher_are_more_alike_than_demonstrations_of_different_teachers():
    shown = demonstrations_by(s_shaped_reach(planar=False), 10)
    duration = np.array([d.trajectory.duration for d in shown]).reshape(10, 8)
    assert np.ptp(duration, axis=1).max() < 1e-9
    assert np.ptp(duration[:, 0]) > 1.0
    middles = np.array([d.trajectory.positions for d in shown]).reshape(10, 8, 200, 3)
    between = middles.mean(axis=1).std(axis=0)
    within = middles.std(axis=1).mean(axis=0)
    assert np.linalg.norm(between, axis=1).mean() > np.linalg.norm(within, axis=1).mean()


def test_the_first_teachers_are_the_same_however_many_there_are():
    motion = s_shaped_reach(planar=True)
    three, ten = demonstrations_by(motion, 3), demonstrations_by(motion, 10)
    assert len({d.source for d in ten}) == 80
    for one, other in zip(three, ten, strict=False):
        assert one.source == other.source
        np.testing.assert_array_equal(one.trajectory.positions, other.trajectory.positions)


@pytest.mark.parametrize("dimension", [2, 3])
def test_one_teacher_passes_on_his_habits_and_ten_teachers_do_not(dimension):
    ideal = s_shaped_reach(planar=dimension == 2).curve(np.linspace(0.0, 1.0, 2000))
    errors = []
    for teachers in (1, 3, 10):
        skill = learned_skill("S1", dimension, teachers)
        path = skill.nominal(np.linspace(0.0, skill.duration_, 200)).positions
        errors.append(np.linalg.norm(path[:, None] - ideal, axis=2).min(axis=1).mean())
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.5 * errors[0]


def test_a_teacher_without_habits_demonstrates_the_ideal_motion_on_average():
    shown = s_shaped_demonstrations(planar=False, n_demonstrations=400)
    mean = np.mean([d.trajectory.positions for d in shown], axis=0)
    u = np.linspace(0.0, 1.0, 200)
    assert np.abs(mean - s_shaped_reach(planar=False).curve(Habits().progress(u))).max() < 0.005


@pytest.mark.parametrize("numbers", [(0, 8), (1, 0)])
def test_at_least_one_teacher_demonstrates_at_least_once(numbers):
    teachers, repeats = numbers
    with pytest.raises(InputError, match="at least 1"):
        demonstrations_by(s_shaped_reach(planar=True), teachers, repeats=repeats)
