from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from imitarm.errors import UnknownNameError
from imitarm.skills.spring import GAINS, Gains, gains_named, propagator, roll_out


def test_thesis_gains_are_overdamped_and_critical_are_critical() -> None:
    assert gains_named("thesis") == (139.26, 28.0)
    assert gains_named("thesis").damping_ratio == pytest.approx(1.186, abs=1e-3)
    assert gains_named("critical").damping_ratio == pytest.approx(1.0)
    assert gains_named("critical").damping == pytest.approx(23.60, abs=5e-3)


def test_unknown_gains_list_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="critical, thesis"):
        gains_named("soft")


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
