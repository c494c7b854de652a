"""The compiled quadratic program finds what daqp finds, and leaves contradictory limits to daqp."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from compiled_code import by_numpy
from imitarm.kinematics import ik
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import IKProblem, Rows
from imitarm.kinematics.tasks import PostureTask, TwistTask

pytestmark = pytest.mark.usefixtures("compiled")

ARM = ArmModel.load("sawyer", tool="gripper")
SOLVER = IKSolver(ARM)


def problem_of(seed: int, spare: float) -> IKProblem:
    """Return a problem with up to 59 rows; the previous velocity keeps them with up to ``spare``, or misses a few."""
    rng = np.random.default_rng(seed)
    q = np.clip(ARM.home + rng.normal(0.0, 0.5, 7), ARM.lower + 0.1, ARM.upper - 0.1)
    velocity = np.clip(rng.choice([0.0, 0.3, 1.0]) * rng.normal(size=7), -ARM.max_velocity, ARM.max_velocity)
    m = int(rng.integers(0, 60))
    matrix = rng.normal(size=(m, 7)) * rng.uniform(0.01, 1.0, (m, 1))
    rows = [Rows(matrix, matrix @ velocity - rng.uniform(-0.02, spare, m))] if m else []
    tasks = [TwistTask(rng.normal(0.0, 0.5, 6)), *([PostureTask(ARM.home)] if rng.random() < 0.5 else [])]
    return SOLVER.problem(q, tasks, velocity if rng.random() < 0.7 else None, rows)


def compiled(problem: IKProblem) -> np.ndarray | None:
    """Return what compiled code finds."""
    jacobian, target = ik._stacked(problem.tasks)
    rows = problem.rows[0] if problem.rows else Rows(None, None)
    return ik._compiled(problem, jacobian, target, problem.tasks[0].effort, rows.matrix, rows.lower)


@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), spare=st.sampled_from([0.0, 0.05, 0.3]))
def test_both_solvers_find_the_same_velocity(seed, spare):
    problem = problem_of(seed, spare)
    velocity = ik.quadratic_program(problem)
    np.testing.assert_allclose(velocity, by_numpy(ik.quadratic_program, problem), rtol=0.0, atol=1e-9)
    assert (velocity >= problem.box.lower).all() and (velocity <= problem.box.upper).all()


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_solution_keeps_the_rows(seed):
    problem = problem_of(seed, 0.05)
    velocity = compiled(problem)
    if velocity is not None and problem.rows:
        assert (problem.rows[0].matrix @ velocity >= problem.rows[0].lower - 1e-10).all()


def test_contradictory_rows_are_left_to_daqp():
    row = np.eye(7)[:1]
    rows = Rows(np.concatenate([row, -row]), np.array([0.05, -0.04]))
    problem = SOLVER.problem(ARM.home, TwistTask(np.zeros(6)), np.zeros(7), rows)
    assert compiled(problem) is None
    np.testing.assert_allclose(ik.quadratic_program(problem)[0], 0.045, atol=1e-6)


def test_equal_rows_are_kept_once():
    row = np.ones((3, 7)) * np.array([[1.0], [1.0], [2.0]])
    problem = SOLVER.problem(ARM.home, TwistTask(np.zeros(6)), np.zeros(7), Rows(row, np.array([0.02, 0.02, 0.04])))
    velocity = compiled(problem)
    assert velocity is not None and velocity.sum() == pytest.approx(0.02, abs=1e-9)


def test_arms_with_more_than_64_joints_are_left_to_daqp():
    n = 65
    eye, zero = np.eye(n), np.zeros(n)
    arguments = eye.tobytes(), zero.tobytes(), 1e-5, 0.0, None, (zero - 1.0).tobytes(), (zero + 1.0).tobytes()
    assert ik.library().least_cost_velocity(n, n, *arguments, 0, None, None, zero.ctypes.data) == 1
