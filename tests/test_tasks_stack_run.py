from __future__ import annotations

import pickle

import numpy as np
import pytest

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.person import Person
from imitarm.errors import InputError
from imitarm.retarget.modern import ModernRetargeter
from imitarm.tasks.stack import StackTask
from imitarm.tasks.stack_run import DT, IdealFollower, calibrate_limbs, ideal_camera, run_stack, stack_correspondence
from imitarm.tasks.stacking_operator import SimulatedOperator


@pytest.fixture(scope="module")
def arm():
    return StackTask.arm()


@pytest.fixture(scope="module")
def short(arm):
    return run_stack(1, 0, ModernRetargeter, arm=arm, timeout=4.0)


@pytest.mark.slow
def test_a_person_stacks_with_an_ideal_follower(arm):
    result = run_stack(0, 0, IdealFollower, arm=arm, camera=ideal_camera, latency=0.0)
    assert result.success, result.reason
    assert result.method == "ideal"
    assert result.stacked == 4
    assert 10.0 < result.time < 60.0
    assert 1.0 < result.path_length < 4.0
    assert len(result.truth) == len(result.skeletons)  # the ideal camera loses nothing


def test_a_trial_is_repeated_exactly_by_its_seeds(arm, short):
    again = run_stack(1, 0, ModernRetargeter, arm=arm, timeout=4.0)
    np.testing.assert_array_equal(again.joints, short.joints)
    np.testing.assert_array_equal(again.torques, short.torques)
    other = run_stack(1, 1, ModernRetargeter, arm=arm, timeout=4.0)
    assert np.abs(other.tool[: len(short.tool)] - short.tool[: len(other.tool)]).max() > 1e-3


def test_the_log_is_complete_and_consistent(arm, short):
    n = round(4.0 / DT)
    assert short.time == pytest.approx(4.0)
    assert short.times.shape == (n,)
    assert short.joints.shape == short.torques.shape == (n, 7)
    np.testing.assert_allclose(np.diff(short.times), DT, atol=1e-9)
    np.testing.assert_allclose(short.tool[::50], arm.tool_path(short.joints[::50])[0], atol=1e-4)
    steps = np.linalg.norm(np.diff(short.tool, axis=0), axis=1)
    assert short.path_length == pytest.approx(steps.sum())
    assert short.path_length > 0.05  # it has begun
    assert np.all(np.abs(short.torques) <= arm.max_torque + 1e-9)
    assert (short.success, short.failure) == (False, "not grasped")
    assert short.reason


def test_a_result_can_be_pickled(short):
    back = pickle.loads(pickle.dumps(short))
    np.testing.assert_array_equal(back.joints, short.joints)
    assert back.reason == short.reason
    assert len(back.truth) == len(short.truth) > 100
    np.testing.assert_array_equal(back.truth[-1].positions, short.truth[-1].positions)


def test_the_camera_sees_the_truth_with_its_noise(short):
    truth = {skeleton.time: skeleton for skeleton in short.truth}
    pairs = [(seen.joint("wrist_right"), truth[seen.time].joint("wrist_right")) for seen in short.skeletons]
    away = np.linalg.norm([a - b for a, b in pairs], axis=1)
    assert len(short.truth) > len(short.skeletons)  # frames were lost
    assert short.method == "modern"
    assert 0.002 < np.nanmedian(away) < 0.03


def test_an_arm_is_measured_before_a_trial():
    person = Person.from_seed(2)
    exact = calibrate_limbs(person, SkeletonCamera.ideal())
    assert exact.upper_arm == pytest.approx(person.upper_arm, abs=1e-6)
    assert exact.forearm == pytest.approx(person.forearm, abs=1e-6)
    measured = calibrate_limbs(person, SkeletonCamera.from_seed(3))
    assert measured.upper_arm == pytest.approx(person.upper_arm, abs=0.03)
    assert stack_correspondence(person, measured).lengths is measured
    assert stack_correspondence(person).lengths.upper_arm == person.upper_arm


def test_the_ideal_follower_is_where_the_hand_is(arm):
    """The tool's way is the hand's, up to the follower's lag."""
    result = run_stack(1, 0, IdealFollower, arm=arm, camera=ideal_camera, latency=0.0, timeout=5.0)
    person = SimulatedOperator(1).person
    rotation = stack_correspondence(person).sensor_to_base.rotation
    hand = np.array([rotation @ truth.joint("wrist_right") for truth in result.truth])
    times = np.array([truth.time for truth in result.truth])
    late = [np.interp(result.times - DT - 0.04, times, hand[:, i] - hand[0, i]) for i in range(3)]
    away = result.tool - result.tool[0] - np.stack(late, axis=1)
    assert np.linalg.norm(away, axis=1).max() < 0.012
    assert np.ptp(hand, axis=0).max() > 0.1


@pytest.mark.parametrize("options", [{"timeout": 0.0}, {"timeout": np.inf}, {"latency": -0.1}])
def test_unusable_options_are_named(arm, options):
    with pytest.raises(InputError, match="timeout must be above 0 and at most 3600 s, latency from"):
        run_stack(0, 0, IdealFollower, arm=arm, **options)
