from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills.rotation_reference import RotationReference, left_jacobian

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def turning(degrees: float, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0.0, 1.0, n)
    return t, quaternion_exp((np.deg2rad(degrees) * t)[:, None] * AXIS)


@pytest.mark.parametrize(("degrees", "n_keys"), [(10.0, 1), (230.0, 1), (270.0, 5), (1500.0, 17)])
def test_the_simplest_reference_that_serves(degrees: float, n_keys: int) -> None:
    reference = RotationReference.among([turning(degrees)])
    assert len(reference.times) == n_keys


@pytest.mark.parametrize("degrees", [10.0, 170.0, 270.0, 1080.0])
def test_vectors_and_back(degrees: float) -> None:
    t, q = turning(degrees)
    reference = RotationReference.among([(t, q)])
    back = reference.to_quaternions(t, reference.to_vectors(t, -q))
    away = quaternion_log(quaternion_multiply(back, quaternion_conjugate(q)))
    assert np.abs(away).max() < 1e-9


def test_vectors_are_smooth_over_a_long_turn() -> None:
    t, q = turning(900.0, 2000)
    vectors = RotationReference.among([(t, q)]).to_vectors(t, q)
    assert np.linalg.norm(np.diff(vectors, axis=0), axis=1).max() < 0.05


def test_it_is_held_outside_its_keys() -> None:
    reference = RotationReference.among([turning(700.0)])
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
