import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.retarget.baselines.hand_curve import fit_rotations

TIMES = np.linspace(0.0, 4.0, 121)


def away(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.linalg.norm(quaternion_log(quaternion_multiply(p, quaternion_conjugate(q))), axis=1)


def turning(degrees: float) -> np.ndarray:
    """A turn about a slanted axis by so many degrees, signs of the quaternions at random."""
    axis = np.array([0.6, 0.0, 0.8])
    q = quaternion_exp(np.radians(degrees) * np.sin(0.5 * np.pi * TIMES / 4.0)[:, None] * axis)
    q = quaternion_multiply(q, Rotation.from_euler("xyz", [0.4, 1.5, -2.0]).as_quat(scalar_first=True))
    return q * np.random.default_rng(0).choice([-1.0, 1.0], (121, 1))


@pytest.mark.parametrize("degrees", [20.0, 170.0, 300.0, 350.0])
def test_a_turn_of_less_than_a_whole_one_is_followed_through_noise(degrees):
    truth = turning(degrees)
    noise = quaternion_exp(np.random.default_rng(1).normal(0.0, 0.05, (121, 3)))
    curve = fit_rotations(TIMES, quaternion_multiply(noise, truth))
    found = curve.evaluate(TIMES)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    assert away(found, truth)[3:-3].max() < 0.08
    assert np.sqrt(np.mean(away(found, truth) ** 2)) < 0.05
    assert curve.evaluate(1.0).shape == (4,)


def test_it_does_not_matter_what_the_rotations_are_seen_from():
    truth, turn = turning(90.0), Rotation.random(random_state=3).as_quat(scalar_first=True)
    here = fit_rotations(TIMES, truth).evaluate(TIMES)
    there = fit_rotations(TIMES, quaternion_multiply(turn, truth)).evaluate(TIMES)
    assert away(quaternion_multiply(turn, here), there).max() < 1e-6


def test_angles_of_roll_pitch_and_yaw_could_not_be_smoothed():
    """At a pitch of a quarter turn they jump where the rotation does not move."""
    truth = turning(90.0)
    angles = Rotation.from_quat(truth, scalar_first=True).as_euler("xyz")
    steps = away(truth[1:], truth[:-1]).max()
    assert np.abs(np.diff(angles, axis=0)).max() > 20.0 * steps


def test_quaternions_of_a_wrong_shape_are_refused():
    with pytest.raises(InputError, match="shape"):
        fit_rotations(TIMES, np.zeros((121, 3)))
