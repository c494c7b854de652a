from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.synthetic import SyntheticSource
from imitarm.evaluation.mapping_metrics import measure
from imitarm.evaluation.tracking import TrueArm
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter, Retargeting

ARM = ArmModel.load("sawyer", tool="gripper")
PERSON = Person.from_seed(4)


@pytest.fixture(scope="module")
def followed():
    truth = reaching(PERSON, 4, duration=5.0)
    source = SyntheticSource(truth, SkeletonCamera.ideal(100.0), 9.0)
    lengths = LimbLengths(PERSON.upper_arm, PERSON.forearm)
    correspondence = Correspondence(lengths=lengths, scale=0.5, orientation="fixed")
    frames = list(source)
    run = ModernRetargeter(ARM, correspondence).run(frames)
    return run, correspondence, TrueArm.of(truth, run.times, correspondence, start=frames[0].time)


def test_a_good_follower_before_a_faultless_camera(followed):
    run, correspondence, true = followed
    found = measure(run, correspondence, true)
    assert found.tool_rms_without_lag < 0.015 <= found.tool_rms + 0.015
    assert 0.0 < found.lag < 0.12
    assert found.tool_rms_without_lag < found.tool_rms
    assert found.tool_rms_from_first == pytest.approx(found.tool_rms)  # it was engaged once
    assert found.engagements == 1
    assert found.executed_rms == pytest.approx(found.tool_rms, rel=0.01)  # its commands are within the limits
    assert found.executed_rms_without_lag == pytest.approx(found.tool_rms_without_lag, rel=0.01)
    assert found.limit_violations == 0
    assert found.settling_time < 0.6
    assert found.orientation_rms < 0.02
    assert 0.9 < found.engaged_fraction <= 1.0
    assert found.duration == pytest.approx(9.0, abs=0.02)


def test_energy_is_that_of_its_parts(followed):
    run, correspondence, true = followed
    found = measure(run, correspondence, true)
    n = len(run.times)
    assert found.effort == pytest.approx(sum(t * t for t in found.rms_torque) * n * 0.01, rel=1e-9)
    assert all(mean <= root + 1e-12 for mean, root in zip(found.mean_torque, found.rms_torque, strict=True))
    share = max(r / rated for r, rated in zip(found.rms_torque, ARM.max_torque, strict=True))
    assert found.peak_torque_ratio >= share


def test_they_are_plain_values(followed):
    run, correspondence, true = followed
    for value in dataclasses.asdict(measure(run, correspondence, true)).values():
        assert type(value) in {int, float, tuple}
        if isinstance(value, tuple):
            assert len(value) == 7
            assert all(type(item) is float for item in value)


def test_what_needs_the_truth_is_nan_without_it_and_the_rest_is_the_same(followed):
    run, correspondence, true = followed
    blind, seeing = measure(run, correspondence), measure(run, correspondence, true)
    needing = {
        *("tool_rms", "tool_rms_without_lag", "lag", "tool_rms_from_first", "orientation_rms"),
        *("elbow_direction_rms", "elbow_angle_rms", "settling_time", "executed_rms", "executed_rms_without_lag"),
    }
    for field in dataclasses.fields(blind):
        value = getattr(blind, field.name)
        if field.name in needing:
            assert math.isnan(value)
        else:
            assert value == getattr(seeing, field.name)


def test_a_robot_that_never_moved_has_followed_nobody(followed):
    run, correspondence, true = followed
    n = len(run.times)
    still = Retargeting(
        *("still", ARM, run.times, np.tile(ARM.home, (n, 1)), np.zeros((n, 7))),
        *((np.full((n, 3), np.nan), np.full((n, 4), np.nan)), np.full((n, 3), np.nan)),
        *(np.zeros(n, bool), np.array(["waiting"] * n), {"teaching_time": 12.5, "failures": 2.0}),
    )
    found = measure(still, correspondence, true)
    assert found.engaged_fraction == 0.0
    assert math.isnan(found.tool_rms)
    assert math.isnan(found.settling_time)
    assert found.path_length == 0.0
    assert found.mean_torque == pytest.approx(np.abs(ARM.gravity_torque(ARM.home)))
    assert found.mean_motion_torque == pytest.approx(np.zeros(7), abs=1e-9)
    assert (found.teaching_time, found.failures) == (12.5, 2)


def test_a_slowed_motion_is_compared_with_the_moment_it_reproduces(followed):
    """Every sample twice, as if it were done at half the speed: as accurate as before, when its clock is told."""
    run, correspondence, true = followed
    n = len(run.times)
    twice = np.repeat(np.arange(n), 2)
    slowed = Retargeting(
        *("slow", ARM, 0.01 * np.arange(2 * n), run.joints[twice], 0.5 * run.velocities[twice]),
        *((run.targets[0][twice], run.targets[1][twice]), run.elbows[twice], run.closed[twice], run.states[twice], {}),
    )
    told = TrueArm(run.times[twice], *(a[twice] for a in (true.shoulder, true.elbow, true.wrist, true.hand)))
    found, before = measure(slowed, correspondence, told), measure(run, correspondence, true)
    assert found.tool_rms == pytest.approx(before.tool_rms, rel=0.02)
    assert found.lag == pytest.approx(before.lag, abs=0.01)
    assert found.duration > 1.9 * before.duration
