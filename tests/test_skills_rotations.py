from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills import QuaternionDMP
from imitarm.skills.dynamical_systems import GAINS
from imitarm.skills.rotations import RotationReference, left_jacobian
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def turning(degrees: float, n: int = 201, duration: float = 2.0) -> Trajectory:
    t = np.linspace(0.0, duration, n)
    u = t / duration
    turn = np.deg2rad(degrees) * u * u * (3.0 - 2.0 * u)
    return Trajectory(t, np.zeros((n, 3)), quaternion_exp(turn[:, None] * AXIS))


def apart(p: Array, q: Array) -> Array:
    """Angles [deg] between rotations."""
    return np.rad2deg(np.linalg.norm(quaternion_log(quaternion_multiply(p, quaternion_conjugate(q))), axis=-1))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 179.0, 180.0, 270.0, 1080.0])
def test_turns_of_any_size_are_reproduced(degrees: float) -> None:
    """A form that uses log(q_goal conj(q)) is 177 degrees off on a turn of 270."""
    shown = turning(degrees)
    assert shown.quaternions is not None
    dmp = QuaternionDMP().fit(shown)
    done = dmp.target(dmp.begin(), shown.times / 2.0)
    assert apart(done, shown.quaternions).max() < 0.05
    assert np.rad2deg(np.linalg.norm(quaternion_log(np.array([1.0, 0, 0, 0])))) == 0.0
    travelled = apart(done[1:], done[:-1]).sum()
    assert travelled == pytest.approx(degrees, abs=0.5)


def test_signs_do_not_matter() -> None:
    shown = turning(200.0)
    assert shown.quaternions is not None
    flipped = shown.quaternions * np.where(np.arange(201) % 7 == 3, -1.0, 1.0)[:, None]
    a, b = QuaternionDMP().fit(shown), QuaternionDMP().fit(Trajectory(shown.times, shown.positions, flipped))
    np.testing.assert_allclose(a.coefficients_, b.coefficients_, atol=1e-12)


def test_noise_is_smoothed() -> None:
    shown = turning(270.0)
    assert shown.quaternions is not None
    noise = quaternion_exp(np.deg2rad(1.0) * np.random.default_rng(0).standard_normal((201, 3)))
    noisy = Trajectory(shown.times, shown.positions, quaternion_multiply(noise, shown.quaternions))
    assert noisy.quaternions is not None
    dmp = QuaternionDMP(n_pieces=15).fit(noisy)
    done = dmp.target(dmp.begin(), shown.times / 2.0)
    assert np.mean(apart(done, shown.quaternions)) < 0.6 * np.mean(apart(noisy.quaternions, shown.quaternions))


def test_other_ends_are_met_exactly() -> None:
    dmp = QuaternionDMP().fit(turning(270.0))
    start = quaternion_multiply(quaternion_exp([0.2, 0.0, -0.3]), dmp.start_)
    goal = quaternion_multiply(quaternion_exp([0.0, 1.5, 0.0]), dmp.goal_)
    turn = dmp.begin(start, goal)
    done = dmp.target(turn, np.array([0.0, 0.5, 1.0, 1.7]))
    np.testing.assert_allclose(apart(done, np.stack([start, done[1], goal, goal])), 0.0, atol=1e-9)
    assert apart(turn.quaternion, start) < 1e-9


def test_steps_equal_the_whole_motion() -> None:
    dmp = QuaternionDMP("thesis").fit(turning(300.0))
    turn = dmp.begin(goal=quaternion_multiply(quaternion_exp([0.4, 0.0, 0.0]), dmp.goal_))
    expected = dmp.target(turn, np.linspace(0.0, 1.0, 101))
    for k in range(101):
        assert apart(turn.quaternion, expected[k]) < 1e-6
        before, turn = turn.quaternion, dmp.step(turn, 0.01)
        assert before @ turn.quaternion > 0.0  # signs continuous


def test_a_push_decays_and_the_motion_is_found_again() -> None:
    dmp = QuaternionDMP().fit(turning(270.0))
    turn = dmp.begin()
    for k in range(100):
        turn = dmp.step(turn, 0.01, np.array([40.0, 0.0, 0.0]) if k < 20 else None)
        if k == 19:
            assert np.rad2deg(np.linalg.norm(turn.offset[0])) > 3.0
    assert apart(turn.quaternion, dmp.goal_) < 0.1


def test_a_constant_push_settles_where_the_spring_balances_it() -> None:
    dmp = QuaternionDMP().fit(turning(0.0))
    turn = dmp.begin()
    for _ in range(400):
        turn = dmp.step(turn, 0.01, np.array([0.0, 14.0, 0.0]))
    np.testing.assert_allclose(turn.offset[0], [0.0, 14.0 / GAINS["critical"].stiffness, 0.0], atol=1e-9)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 9])
def test_few_samples_are_enough(n: int) -> None:
    shown = turning(80.0, n=n)
    assert shown.quaternions is not None
    dmp = QuaternionDMP().fit(shown)
    assert apart(dmp.start_, shown.quaternions[0]) < 0.1
    assert apart(dmp.goal_, shown.quaternions[-1]) < 0.1


def test_uneven_stamps_and_epoch_times() -> None:
    rng = np.random.default_rng(0)
    fine = turning(270.0, n=2001)
    assert fine.quaternions is not None
    keep = np.unique(np.concatenate([[0, 2000], rng.choice(2001, 200)]))
    dmp = QuaternionDMP().fit(Trajectory(fine.times[keep] + 1.7e9, fine.positions[keep], fine.quaternions[keep]))
    assert apart(dmp.target(dmp.begin(), fine.times / 2.0), fine.quaternions).max() < 0.5


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="no quaternions"):
        QuaternionDMP().fit(Trajectory([0.0, 1.0], np.zeros((2, 3))))
    with pytest.raises(InputError, match="row 2 is rotated by 120 degrees"):
        q = quaternion_exp(np.deg2rad([0.0, 10.0, 130.0, 140.0, 150.0])[:, None] * AXIS)
        QuaternionDMP().fit(Trajectory(np.arange(5.0), np.zeros((5, 3)), q))
    with pytest.raises(InputError, match="not fitted"):
        QuaternionDMP().begin()
    with pytest.raises(InputError, match="goal: quaternion"):
        QuaternionDMP().fit(turning(10.0)).begin(goal=np.array([1.0, 1.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="n_pieces"):
        QuaternionDMP(n_pieces=0)


def test_from_spline_gives_the_same_motion_and_refuses_nonsense() -> None:
    dmp = QuaternionDMP().fit(turning(270.0))
    again = QuaternionDMP.from_spline(dmp.knots_, dmp.coefficients_, dmp.gains_)
    share = np.linspace(0.0, 1.0, 20)
    np.testing.assert_array_equal(again.target(again.begin(), share), dmp.target(dmp.begin(), share))
    for knots, coefficients in (
        (dmp.knots_[1:], dmp.coefficients_),
        (dmp.knots_[::-1], dmp.coefficients_),
        (2.0 * dmp.knots_, dmp.coefficients_),
        (dmp.knots_, 0.1 * dmp.coefficients_),
        (dmp.knots_, np.nan * dmp.coefficients_),
    ):
        with pytest.raises(InputError, match="from_spline"):
            QuaternionDMP.from_spline(knots, coefficients, dmp.gains_)


def rotating(degrees: float, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0.0, 1.0, n)
    return t, quaternion_exp((np.deg2rad(degrees) * t)[:, None] * AXIS)


@pytest.mark.parametrize(("degrees", "n_keys"), [(10.0, 1), (230.0, 1), (270.0, 5), (1500.0, 17)])
def test_the_simplest_reference_that_serves(degrees: float, n_keys: int) -> None:
    reference = RotationReference.among([rotating(degrees)])
    assert len(reference.times) == n_keys


@pytest.mark.parametrize("degrees", [10.0, 170.0, 270.0, 1080.0])
def test_vectors_and_back(degrees: float) -> None:
    t, q = rotating(degrees)
    reference = RotationReference.among([(t, q)])
    back = reference.to_quaternions(t, reference.to_vectors(t, -q))
    away = quaternion_log(quaternion_multiply(back, quaternion_conjugate(q)))
    assert np.abs(away).max() < 1e-9


def test_vectors_are_smooth_over_a_long_turn() -> None:
    t, q = rotating(900.0, 2000)
    vectors = RotationReference.among([(t, q)]).to_vectors(t, q)
    assert np.linalg.norm(np.diff(vectors, axis=0), axis=1).max() < 0.05


def test_it_is_held_outside_its_keys() -> None:
    reference = RotationReference.among([rotating(700.0)])
    np.testing.assert_allclose(reference.at([-1.0, 2.0]), reference.at([0.0, 1.0]))


@settings(max_examples=60, deadline=None)
@given(
    r=st.tuples(*[st.floats(-1.7, 1.7)] * 3),
    d=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)
def test_left_jacobian_equals_its_finite_difference(r: tuple[float, ...], d: tuple[float, ...]) -> None:
    r0, step = np.array(r), 1e-6 * np.array(d)
    change = quaternion_multiply(quaternion_exp(r0 + step), quaternion_conjugate(quaternion_exp(r0 - step)))
    expected = left_jacobian(r0[None])[0] @ (2.0 * step)
    np.testing.assert_allclose(quaternion_log(change), expected, atol=1e-11)


def test_left_jacobian_of_nothing_is_identity() -> None:
    np.testing.assert_allclose(left_jacobian(np.zeros((2, 3))), np.broadcast_to(np.eye(3), (2, 3, 3)))
    tiny, small = left_jacobian(np.array([[0.99e-4, 0.0, 0.0], [1.01e-4, 0.0, 0.0]]))
    np.testing.assert_allclose(tiny, small, atol=2e-6)


def test_bad_keys_are_refused() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
    with pytest.raises(InputError, match="each later than the one before"):
        RotationReference(np.array([1.0, 1.0]), q)
    with pytest.raises(InputError, match=r"shape \(1, 4\)"):
        RotationReference(np.array([0.0]), q)
    with pytest.raises(InputError, match="length"):
        RotationReference(np.array([0.0, 1.0]), 2.0 * q)
