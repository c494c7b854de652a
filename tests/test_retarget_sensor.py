from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.retarget.calibration import fit_sensor_to_base
from imitarm.retarget.correspondence import FACING

BASE = np.array(
    [[0.5, -0.3, 0.2], [0.7, 0.0, 0.4], [0.5, 0.3, 0.2], [0.4, 0.1, 0.6], [0.6, -0.2, 0.5], [0.8, 0.2, 0.1]]
)
SENSOR = Pose([2.5, 0.1, 0.9], quaternion_multiply(FACING.quaternion, quaternion_exp([0.2, -0.4, 0.1])))


def seen(points=BASE, sigma=0.0, seed=0):
    """The points as the sensor has them."""
    return SENSOR.inverse().apply(points) + sigma * np.random.default_rng(seed).normal(size=np.shape(points))


def angle(a, b):
    return float(np.linalg.norm(quaternion_log(quaternion_multiply(a.quaternion * [1, -1, -1, -1], b.quaternion))))


@given(st.integers(0, 2**32 - 1), st.integers(4, 12))
def test_without_noise_the_pose_is_found_exactly(seed, n):
    rng = np.random.default_rng(seed)
    pose = Pose(rng.normal(size=3), quaternion_exp(rng.normal(size=3)))
    points = rng.uniform(-0.5, 0.5, (n, 3)) * [1.0, 1.0, rng.choice([0.0, 1.0])] + [0.3, 0.0, 0.0]
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(n)
    if spread[1] < 0.04:
        return  # a line; tested below
    fit = fit_sensor_to_base(pose.inverse().apply(points), points)
    np.testing.assert_allclose(fit.sensor_to_base.position, pose.position, atol=1e-9)
    assert angle(fit.sensor_to_base, pose) < 1e-6
    assert fit.rms < 1e-9 and fit.accepted and np.linalg.det(fit.sensor_to_base.rotation) == pytest.approx(1.0)


def test_the_standard_error_says_how_far_off_the_rotation_is():
    errors, told = [], []
    for seed in range(200):
        fit = fit_sensor_to_base(seen(sigma=0.008, seed=seed), BASE)
        errors.append(angle(fit.sensor_to_base, SENSOR))
        told.append(fit.angle_error)
        assert 0.002 < fit.rms < 0.02
    # the error is about three axes, the figure about the worst one
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) / np.mean(told) < np.sqrt(3.0)


def test_no_nearby_pose_fits_better():
    points = seen(sigma=0.01)
    fit = fit_sensor_to_base(points, BASE)
    rng = np.random.default_rng(1)
    for _ in range(200):
        turn = quaternion_multiply(fit.sensor_to_base.quaternion, quaternion_exp(0.01 * rng.normal(size=3)))
        other = Pose(fit.sensor_to_base.position + 0.005 * rng.normal(size=3), turn)
        assert np.sum((other.apply(points) - BASE) ** 2) > np.sum(fit.residuals**2)


def test_a_point_of_little_weight_counts_little():
    points = seen()
    points[0] += 0.03
    light = fit_sensor_to_base(points, BASE, [1e-6, 1, 1, 1, 1, 1])
    assert angle(light.sensor_to_base, SENSOR) < 1e-4 < angle(fit_sensor_to_base(points, BASE).sensor_to_base, SENSOR)


def test_points_on_a_plane_will_do_but_it_is_said():
    flat = BASE * [1, 1, 0] + [0, 0, 0.3]
    fit = fit_sensor_to_base(seen(flat, sigma=0.003), flat)
    assert fit.flat and fit.accepted and "mirrored axis would not be detected" in fit.notes()[0]
    assert angle(fit.sensor_to_base, SENSOR) < 0.03
    assert not fit_sensor_to_base(seen(), BASE).flat


def test_points_on_a_line_are_refused():
    line = np.linspace(0.0, 1.0, 6)[:, None] * [0.3, 0.2, 0.4] + [0.4, 0.0, 0.1]
    with pytest.raises(InputError, match=r"lie on a line.*add points well outside it"):
        fit_sensor_to_base(seen(line), line)
    with pytest.raises(InputError, match="lie on a line"):  # nearly is as bad
        fit_sensor_to_base(seen(line, sigma=0.005), line + 0.005 * np.random.default_rng(3).normal(size=line.shape))


@pytest.mark.parametrize(
    ("sensor", "base", "message"),
    [
        (seen()[:3], BASE[:3], "3 pairs of points, but at least 4"),
        (seen(), BASE[:5], r"shapes \(6, 3\) and \(5, 3\)"),
        (seen()[:, :2], BASE[:, :2], "shapes"),
        (seen(), np.where(np.arange(18).reshape(6, 3) == 7, np.nan, BASE), "point 3 is not finite; touch it again"),
        (seen(0.1 * BASE), 0.1 * BASE, r"points of the sensor lie within 2\.. cm of their mean; choose points"),
        (seen(), BASE * 100.0, "the robot's points are 100 times as far apart"),
        (seen() * 1000.0, BASE, "the robot's points are 0.001 times as far apart.*give both in metres"),
        (seen() * [-1, 1, 1], BASE, "mirrored: reverse the sensor's x axis"),
        (seen()[[3, 4, 0, 5, 1, 2]], BASE, "not the same points in the same order"),
    ],
)
def test_points_that_tell_nothing_are_refused(sensor, base, message):
    with pytest.raises(InputError, match=message):
        fit_sensor_to_base(sensor, base)


def test_weights_must_be_weights():
    for weights in ([1, 1, 1], [1, 1, 1, 1, 1, 0], [1, 1, 1, 1, 1, np.nan]):
        with pytest.raises(InputError, match="weights must be 6 positive"):
            fit_sensor_to_base(seen(), BASE, weights)


@pytest.mark.parametrize("i", range(6))
def test_the_one_point_that_was_missed_is_named(i):
    points = seen(sigma=0.001)
    points[i] += [0.08, -0.05, 0.06]
    fit = fit_sensor_to_base(points, BASE)
    assert fit.suspect == i and not fit.accepted
    assert f"point {i + 1} does not fit the others" in fit.notes()[0]
    points[i] += [0.4, 0.5, -0.3]
    with pytest.raises(InputError, match=f"point {i + 1} does not fit the others"):
        fit_sensor_to_base(points, BASE)


def test_points_that_are_all_poor_are_not_accepted():
    fit = fit_sensor_to_base(seen(sigma=0.04, seed=2), BASE)
    assert not fit.accepted and "20 to" not in fit.notes()[-1] and "should be at most 2 cm" in fit.notes()[-1]


def test_the_condition_grows_as_points_near_a_line():
    conditions = []
    for width in (1.0, 0.5, 0.25):
        line = BASE * [width, 1.0, width]
        conditions.append(fit_sensor_to_base(seen(line), line).condition)
    assert 1.0 <= conditions[0] < conditions[1] < conditions[2]
