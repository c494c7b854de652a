from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.skills.course import Course, rotodilatation
from imitarm.skills.spring import GAINS

vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.05)


@settings(max_examples=60, deadline=None)
@given(a=vectors, b=vectors)
def test_rotodilatation_takes_one_vector_to_the_other(a: np.ndarray, b: np.ndarray) -> None:
    M = rotodilatation(a, b, float(np.linalg.norm(a)))
    np.testing.assert_allclose(M @ a, b, atol=1e-6)
    ratio = np.linalg.norm(b) / np.linalg.norm(a)
    np.testing.assert_allclose(M.T @ M, ratio**2 * np.eye(3), atol=1e-6 * ratio**2)
    assert np.linalg.det(M) > 0.0


def test_rotodilatation_straight_back() -> None:
    a = np.array([0.3, 0.0, 0.0])
    M = rotodilatation(a, -a, 0.3)
    np.testing.assert_allclose(M @ a, -a, atol=1e-15)
    assert np.linalg.det(M) == pytest.approx(1.0)


def test_rotodilatation_of_a_closed_motion_is_identity() -> None:
    np.testing.assert_array_equal(rotodilatation(np.array([0.001, 0, 0]), np.array([0.05, 0, 0]), 1.0), np.eye(3))
    np.testing.assert_array_equal(rotodilatation(np.zeros(3), np.array([0.05, 0, 0]), 0.0), np.eye(3))
    np.testing.assert_array_equal(rotodilatation(np.array([0.3, 0, 0]), np.zeros(3), 0.3), np.zeros((3, 3)))


def course() -> Course:
    drive = 0.1 * np.random.default_rng(0).standard_normal((12, 3))
    return Course(np.zeros(3), np.array([0.3, 0.2, 0.1]), 2.0, "progress", drive)


def test_the_target_ends_at_the_goal() -> None:
    c = course()
    np.testing.assert_allclose(c.target(np.array([1e-12])), c.goal[None], atol=1e-9)
    np.testing.assert_allclose(c.target_on_grid(5)[[0, 10]], c.target(np.array([1.0, 0.01])), atol=1e-12)


def test_a_plan_is_made_the_second_time_and_equals_single_steps() -> None:
    c, gains, h = course(), GAINS["critical"], 0.03
    assert c.plan(gains, h) is None
    plan = c.plan(gains, h)
    assert plan is not None
    assert plan is c.plan(gains, h)
    assert len(plan.pushes) == 34
    assert c.plan(gains, 0.05) is None


def test_no_plan_of_a_million_steps() -> None:
    c = course()
    c.plan(GAINS["critical"], 1e-6)
    assert c.plan(GAINS["critical"], 1e-6) is None
