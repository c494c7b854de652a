from dataclasses import replace

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.cli.following import Following
from imitarm.cli.merit import warnings_of, winding
from imitarm.evaluation.mapping_metrics import measure
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.retarget import Correspondence, ModernRetargeter
from recording_samples import skeletons


@pytest.fixture(scope="module")
def run():
    arm = ArmModel.load("sawyer", tool="gripper")
    return ModernRetargeter(arm, Correspondence(orientation="fixed")).run(skeletons(60))


def turned(run, angles):
    """The same run with a target that turns about the vertical, and with quaternions of either sign."""
    axis = np.column_stack([np.zeros((len(angles), 2)), angles])
    signs = np.where(np.arange(len(angles)) % 2, 1.0, -1.0)[:, None]
    turns = signs * quaternion_multiply(quaternion_exp(axis), np.array([0.0, 1.0, 0.0, 0.0]))
    return replace(run, targets=(run.targets[0], turns))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 170.0, 250.0, 410.0])
def test_full_turns_are_counted_whatever_the_signs_of_the_quaternions(run, degrees):
    angles = np.radians(degrees) * np.sin(np.linspace(0.0, np.pi / 2.0, len(run.times)))
    assert np.degrees(winding(turned(run, angles))) == pytest.approx(degrees, abs=1e-6)


def test_a_tool_that_winds_is_told_and_what_to_do(run):
    def said(degrees):
        wound = turned(run, np.radians(degrees) * np.linspace(0.0, 1.0, len(run.times)))
        metrics = measure(wound, Correspondence(orientation="fixed"))
        return " ".join(warnings_of(wound, metrics, Following.of("modern", wound, metrics)))

    assert "--orientation fixed" in said(410.0)
    assert "410 degrees" in said(410.0)
    assert "orientation" not in said(120.0)


def test_a_run_without_a_target_has_not_wound(run):
    assert winding(replace(run, targets=(run.targets[0], np.full((len(run.times), 4), np.nan)))) == 0.0


@pytest.mark.parametrize(("seconds", "told"), [(0.0, False), (0.02, False), (0.1, True)])
def test_no_time_is_told_that_rounds_to_none(run, seconds, told):
    metrics = measure(run, Correspondence(orientation="fixed"))
    following = replace(Following.of("modern", run, metrics), far_time=seconds, farthest=0.06)
    assert ("from its target for" in " ".join(warnings_of(run, metrics, following))) == told
