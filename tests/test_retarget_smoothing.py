import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imitarm import InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_log
from imitarm.retarget.smoothing import Hampel, OneEuro, OneEuroRotation, smoothing_weight

T = 1 / 30


def test_it_is_calm_at_rest_and_quick_in_motion():
    rng = np.random.default_rng(0)
    noise = 0.005 * rng.normal(size=(600, 3))
    still = OneEuro()
    calm = np.array([still.filter(k * T, x) for k, x in enumerate(noise)])[60:]
    assert calm.std() < 0.6 * noise.std()
    moving, path = OneEuro(derivative_cutoff=3.0), np.arange(600)[:, None] * T * np.array([0.8, 0.0, 0.0])
    late = np.array([moving.filter(k * T, x) for k, x in enumerate(path)])[120:]
    assert np.abs(late - path[120:]).max() / 0.8 < 0.03  # [s] of lag at 0.8 m/s
    np.testing.assert_allclose(moving.velocity, [0.8, 0.0, 0.0], atol=1e-3)


def test_the_usual_speed_estimate_is_too_large_on_a_steady_motion_and_ours_is_not():
    path, speed = 0.8 * np.arange(120) * T, 0.0
    smooth = path[0]
    for x in path[1:]:  # the difference to the smoothed value, which is behind
        speed += smoothing_weight(3.0, T) * ((x - smooth) / T - speed)
        smooth += smoothing_weight(1.0 + 10.0 * speed, T) * (x - smooth)
    one = OneEuro(derivative_cutoff=3.0)
    for k, x in enumerate(path):
        one.filter(k * T, np.array([x]))
    assert speed > 1.2 * 0.8
    np.testing.assert_allclose(one.velocity, [0.8], rtol=1e-6)


def test_units_are_metres_a_beta_meant_for_millimetres_does_nothing():
    path = np.arange(300)[:, None] * T * np.array([0.8, 0.0, 0.0])
    lag = {}
    for beta in (0.01, 10.0):
        one = OneEuro(beta=beta)
        late = np.array([one.filter(k * T, x) for k, x in enumerate(path)])
        lag[beta] = np.abs(late - path)[-1, 0] / 0.8
    assert lag[0.01] > 0.12
    assert lag[10.0] < 0.04


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_is_the_same_in_every_direction(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=int(seed % 10000)).as_matrix()
    plain, turned = OneEuro(), OneEuro()
    for k, x in enumerate(rng.normal(size=(30, 3))):
        np.testing.assert_allclose(turned.filter(k * T, turn @ x), turn @ plain.filter(k * T, x), atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_several_vectors_at_once_are_smoothed_as_one_by_one(seed, count):
    """Each with its own speed and confidence, over dropped frames, gaps and frames that are not newer."""
    rng = np.random.default_rng(seed)
    together, alone = OneEuro(), [OneEuro() for _ in range(count)]
    time = 0.0
    for _ in range(40):
        time += rng.choice([0.0, T, T, T, 2 * T, 0.5])
        x = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 0, size=(count, 1))
        confidence = rng.uniform(size=(count, 1))
        smooth = together.filter(time, x, confidence)
        for i, one in enumerate(alone):
            np.testing.assert_allclose(smooth[i], one.filter(time, x[i], float(confidence[i, 0])), atol=1e-13)
            np.testing.assert_allclose(together.velocity[i], one.velocity, atol=1e-12)


def test_a_gap_begins_anew_and_an_old_frame_changes_nothing():
    one = OneEuro()
    one.filter(0.0, np.zeros(3))
    np.testing.assert_array_equal(one.filter(0.5, np.ones(3)), np.ones(3))
    np.testing.assert_array_equal(one.filter(0.4, np.zeros(3)), np.ones(3))
    np.testing.assert_array_equal(one.velocity, np.zeros(3))


def test_confidence_weighs_a_value():
    sure, unsure = OneEuro(), OneEuro()
    for one in (sure, unsure):
        one.filter(0.0, np.zeros(1))
    assert 0.0 < unsure.filter(T, np.ones(1), 0.2)[0] < 0.5 * sure.filter(T, np.ones(1), 1.0)[0]
    assert unsure.filter(2 * T, np.full(1, 9.0), 0.0)[0] == unsure.value[0]


def test_the_share_is_that_of_a_low_pass():
    assert smoothing_weight(1e9, T) == pytest.approx(1.0)
    assert smoothing_weight(1.0, 1.0 / (2.0 * np.pi)) == pytest.approx(0.5)


def test_rotations_are_smoothed_on_the_sphere_and_signs_do_not_matter():
    one = OneEuroRotation()
    rng = np.random.default_rng(1)
    for k in range(150):
        q = quaternion_exp(np.array([0.0, 0.0, 0.5 * k * T]) + 0.02 * rng.normal(size=3))
        smooth = one.filter(k * T, q if rng.random() < 0.5 else -q)
        assert np.linalg.norm(smooth) == pytest.approx(1.0)
    np.testing.assert_allclose(one.velocity, [0.0, 0.0, 0.5], atol=0.3)
    assert abs(np.linalg.norm(quaternion_log(smooth)) - 0.5 * 149 * T) < 0.2


def test_a_jump_is_an_outlier_and_a_motion_is_not():
    guard, rng = Hampel(least=0.05), np.random.default_rng(2)
    accepted = []
    for k in range(90):
        x = np.array([0.6 * k * T, 0.0, 0.0]) + 0.003 * rng.normal(size=3)
        accepted.append(guard.accept(k * T, x + (0.4 if k in {40, 60} else 0.0)))
    assert not accepted[40]
    assert not accepted[60]
    assert np.mean(accepted) > 0.95


def test_a_lasting_change_is_believed():
    guard = Hampel()
    verdicts = [guard.accept(k * T, np.full(3, 0.0 if k < 30 else 1.0)) for k in range(60)]
    assert not verdicts[30]
    assert all(verdicts[38:])


@pytest.mark.parametrize("options", [{"min_cutoff": 0.0}, {"beta": -1.0}, {"derivative_cutoff": 0.0}])
def test_settings_that_filter_nothing_are_refused(options):
    with pytest.raises(InputError, match="OneEuro"):
        OneEuro(**options)


def test_a_vector_of_another_length_is_refused():
    one = OneEuro()
    one.filter(0.0, np.zeros(3))
    with pytest.raises(InputError, match="shape"):
        one.filter(T, np.zeros(2))
