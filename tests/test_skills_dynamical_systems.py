from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from imitarm.errors import UnknownNameError
from imitarm.skills.dynamical_systems import (
    DECAY,
    GAINS,
    Gains,
    MovingTarget,
    PhaseBasis,
    basis_on_grid,
    fit_weights,
    phase_basis,
    propagator,
    roll_out,
    start_rate,
)
from imitarm.skills.rotations import rotodilatation


def test_thesis_gains_are_overdamped_and_critical_are_critical() -> None:
    assert Gains.of("thesis", "DMP") == (139.26, 28.0)
    assert Gains.of("thesis", "DMP").damping_ratio == pytest.approx(1.186, abs=1e-3)
    assert Gains.of("critical", "DMP").damping_ratio == pytest.approx(1.0)
    assert Gains.of("critical", "DMP").damping == pytest.approx(23.60, abs=5e-3)


def test_unknown_gains_list_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="critical, thesis"):
        Gains.of("soft", "DMP")


@pytest.mark.parametrize("gains", [*GAINS.values(), Gains(100.0, 5.0)])
@pytest.mark.parametrize("h", [0.3, 0.01])
def test_a_step_is_exact_for_a_parabola(gains: Gains, h: float) -> None:
    K, D = gains

    def y(t: float) -> float:
        return 0.3 - 2.0 * t + 5.0 * t * t

    def spring(t: float, z: np.ndarray) -> list[float]:
        return [z[1], K * (y(t) - z[0]) - D * z[1]]

    expected = solve_ivp(spring, (0.0, h), [0.4, -1.0], rtol=1e-11, atol=1e-13).y[:, -1]
    one = propagator(gains, h)
    got = one.transition @ [0.4, -1.0] + one.drive @ [y(t) for t in one.instants]
    np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-10)


def test_push_is_a_constant_acceleration() -> None:
    gains, h = GAINS["critical"], 0.05
    expected = solve_ivp(
        lambda _, z: [z[1], 7.0 - gains.stiffness * z[0] - gains.damping * z[1]],
        (0.0, h),
        [0.0, 0.0],
        rtol=1e-10,
        atol=1e-13,
    ).y[:, -1]
    np.testing.assert_allclose(propagator(gains, h).push * 7.0, expected, rtol=1e-6)


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 70), h=st.sampled_from([0.001, 0.005, 0.02]), seed=st.integers(0, 1000))
def test_all_steps_at_once_equal_one_after_another(n: int, h: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    step = propagator(GAINS["critical"], h)
    m = 2 * step.n_parts
    target = rng.standard_normal((m * n + 1, 3))
    z = rng.standard_normal((2, 3))
    x = roll_out(step, z, target)
    assert x.shape == (2, n + 1, 3)
    np.testing.assert_array_equal(x[:, 0], z)
    for k in range(n):
        z = step.transition @ z + step.drive @ target[m * k : m * k + m + 1]
        np.testing.assert_allclose(x[:, k + 1], z, atol=1e-11)


def test_two_half_steps_are_one_step() -> None:
    gains = GAINS["thesis"]
    np.testing.assert_allclose(
        np.linalg.matrix_power(propagator(gains, 0.05).transition, 2), propagator(gains, 0.1).transition, atol=1e-12
    )


@pytest.mark.parametrize(("n", "until"), [(2, 3.0), (10, 3.0), (40, 3.0), (300, 1.0)])
def test_the_functions_sum_to_the_phase(n: int, until: float) -> None:
    s = np.exp(-DECAY * np.linspace(0.0, until, 200))
    np.testing.assert_allclose(phase_basis(n).at(s).sum(axis=1), s, rtol=1e-12)


def test_far_past_the_end_nothing_is_left() -> None:
    values = phase_basis(300).at(np.array([1e-9, 0.0]))
    assert np.isfinite(values).all()
    assert np.abs(values).max() < 1e-8


def test_centers_are_equally_spread_in_time() -> None:
    basis = PhaseBasis(11)
    np.testing.assert_allclose(-np.log(basis.centers) / DECAY, np.linspace(0.0, 1.0, 11), atol=1e-12)


def test_every_function_is_largest_at_its_own_center() -> None:
    basis = phase_basis(20)
    relative = basis.at(basis.centers) / basis.centers[:, None]
    np.testing.assert_array_equal(np.argmax(relative, axis=1), np.arange(20))


def test_the_grid_holds_begin_middle_and_end_of_steps() -> None:
    s, basis = basis_on_grid(10, 4)
    assert s.shape == (9,)
    assert s[-1] == pytest.approx(0.01)
    np.testing.assert_allclose(basis, phase_basis(10).at(np.array(s)))
    assert not basis.flags.writeable


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


def moving_target() -> MovingTarget:
    drive = 0.1 * np.random.default_rng(0).standard_normal((12, 3))
    return MovingTarget(np.zeros(3), np.array([0.3, 0.2, 0.1]), 2.0, "progress", drive)


def test_the_target_ends_at_the_goal() -> None:
    c = moving_target()
    np.testing.assert_allclose(c.at(np.array([1e-12])), c.goal[None], atol=1e-9)
    np.testing.assert_allclose(c.on_grid(5)[[0, 10]], c.at(np.array([1.0, 0.01])), atol=1e-12)


def test_a_plan_is_made_the_second_time_and_equals_single_steps() -> None:
    c, gains, h = moving_target(), GAINS["critical"], 0.03
    assert c.plan(gains, h) is None
    plan = c.plan(gains, h)
    assert plan is not None
    assert plan is c.plan(gains, h)
    assert len(plan.pushes) == 34
    assert c.plan(gains, 0.05) is None


def test_no_plan_of_a_million_steps() -> None:
    c = moving_target()
    c.plan(GAINS["critical"], 1e-6)
    assert c.plan(GAINS["critical"], 1e-6) is None


FRACTION = np.linspace(0.0, 1.0, 201)


def minimum_jerk(u: np.ndarray) -> np.ndarray:
    return (u**3 * (10.0 + u * (6.0 * u - 15.0)))[:, None] * np.array([0.3, -0.2, 0.1])


def test_a_motion_from_rest_begins_exactly_at_rest() -> None:
    rng = np.random.default_rng(0)
    x = minimum_jerk(FRACTION)
    np.testing.assert_array_equal(start_rate(FRACTION, x), 0.0)
    np.testing.assert_array_equal(start_rate(FRACTION, x + 1e-3 * rng.standard_normal(x.shape)), 0.0)


def test_a_motion_under_way_is_seen() -> None:
    x = np.column_stack([np.sin(3.0 * FRACTION), 0.0 * FRACTION, FRACTION])
    np.testing.assert_allclose(start_rate(FRACTION, x), [3.0, 0.0, 1.0], atol=0.03)


def test_few_samples_give_no_rate() -> None:
    np.testing.assert_array_equal(start_rate(FRACTION[:4], minimum_jerk(FRACTION)[:4]), 0.0)


def test_noise_does_not_blow_up_the_weights() -> None:
    """1 mm of noise at 100 Hz multiplied the largest weight by 180 where differences were used."""
    x = minimum_jerk(FRACTION)
    noisy = x + 1e-3 * np.random.default_rng(1).standard_normal(x.shape)
    clean, other = (fit_weights(FRACTION, k, GAINS["critical"], 40, 1e-7) for k in (x, noisy))
    force = np.exp(-np.log(100.0) * np.linspace(0.0, 1.0, 40))[:, None]  # what a weight does: w_i s at its centre
    assert np.abs(other.weights * force).max() < 3.0 * np.abs(clean.weights * force).max()


def test_progress_is_the_share_of_the_path() -> None:
    learnt = fit_weights(FRACTION, minimum_jerk(FRACTION), GAINS["critical"], 40, 1e-7)
    assert learnt.path_length == pytest.approx(np.linalg.norm([0.3, -0.2, 0.1]), rel=1e-3)
    ratio = learnt.weights @ np.array([0.3, -0.2, 0.1]) / np.sum(np.square([0.3, -0.2, 0.1]))
    force = np.exp(-np.log(100.0) * np.linspace(0.0, 1.0, 40))
    np.testing.assert_allclose(learnt.progress_weights * force, ratio * force, atol=0.02)


def test_a_motion_of_no_length_has_a_progress_too() -> None:
    learnt = fit_weights(FRACTION, np.ones((201, 3)), GAINS["critical"], 20, 1e-7)
    assert learnt.path_length == pytest.approx(0.0, abs=1e-9)
    assert np.isfinite(learnt.progress_weights).all()


def test_a_noisy_end_is_no_reason_to_jerk() -> None:
    x = minimum_jerk(FRACTION)
    exact = fit_weights(FRACTION, x, GAINS["critical"], 40, 1e-7)
    np.testing.assert_array_equal(exact.start, x[0])
    np.testing.assert_array_equal(exact.goal, x[-1])
    x[-1] += [0.0, 0.0, 2e-3]
    beside = fit_weights(FRACTION, x, GAINS["critical"], 40, 1e-7)
    assert abs(beside.goal[2] - 0.1) < 1.5e-3


@pytest.mark.parametrize("moving", [False, True])
def test_the_target_is_the_goal_when_the_duration_is_over(moving: bool) -> None:
    x = np.column_stack([FRACTION, FRACTION**2, np.sin(4.0 * FRACTION)]) if moving else minimum_jerk(FRACTION)
    learnt = fit_weights(FRACTION, x, GAINS["critical"], 40, 1e-7)
    np.testing.assert_allclose(learnt.weights[-1], learnt.goal - learnt.start, atol=1e-12)
    assert learnt.progress_weights[-1] == 1.0
