from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.cli.retarget import suggestion
from imitarm.evaluation.mapping_metrics import measure
from imitarm.evaluation.run_evaluation import FAR, FAR_FRACTION, TargetTracking, warnings_of, winding
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.retarget import Correspondence, ModernRetargeter
from recording_samples import skeletons

ARM = ArmModel.load("sawyer", tool="gripper")
GOOD = TargetTracking("modern", 0.01, 0.0, 0.0, 0.03, 1, 0.95, 0)


@pytest.mark.parametrize(
    ("changes", "followed", "words"),
    [
        (
            {},
            True,
            "modern: follows its target (RMS distance 10 mm; the distance exceeds 5 cm for 0 % of the time); the "
            "person controlled the robot for",
        ),
        ({"rms": FAR}, True, "follows"),
        ({"rms": 1.01 * FAR}, False, "does not follow"),
        ({"far_fraction": FAR_FRACTION}, True, "the distance exceeds 5 cm for 10 % of the time"),
        ({"far_fraction": 1.01 * FAR_FRACTION}, False, "does not follow"),
        ({"far_fraction": 0.001}, True, "for under 1 % of the time"),
        ({"far_fraction": 0.999, "rms": 1.0}, False, "for over 99 % of the time"),
        ({"engaged_fraction": 0.49}, False, "nobody controlled the robot for most of the time"),
        ({"rms": np.nan, "far_fraction": np.nan, "farthest": np.nan}, False, "followed nothing"),
        ({"violations": 3}, True, "limits are exceeded in 3 frames"),
    ],
)
def test_the_headline_says_whether_it_followed_and_is_good_only_then(changes, followed, words):
    found = replace(GOOD, **changes)
    assert found.followed == followed
    assert found.good == (followed and not found.violations)
    assert words in found.verdict()
    assert ("no joint exceeds a limit" in found.verdict()) == (found.violations == 0)


@given(off=st.lists(st.floats(0.0, 0.2), min_size=110, max_size=110))
def test_distances_are_those_between_tool_and_target(off):
    """Targets are put at known distances; frames without one do not count."""
    frames = skeletons(40)
    run = ModernRetargeter(ARM, Correspondence(orientation="fixed")).run(frames, ARM.home)
    n, away = len(run.times), np.zeros(len(run.times))
    away[-min(n, 110) :] = off[-min(n, 110) :]
    tool = run.arm.tool_path(run.joints)[0]
    targets = tool + away[:, None] * np.array([0.0, 0.6, 0.8])
    targets[:5] = np.nan
    moved = replace(run, targets=(targets, run.targets[1]))
    found = TargetTracking.of(moved, measure(moved, Correspondence()))
    counted = away[5:]
    assert found.rms == pytest.approx(np.sqrt(np.mean(counted**2)), abs=1e-9)
    assert found.farthest == pytest.approx(counted.max(), abs=1e-9)
    assert found.far_fraction == pytest.approx(np.mean(np.linalg.norm(targets - tool, axis=1)[5:] > FAR), abs=1e-12)
    assert found.far_time == pytest.approx(found.far_fraction * len(counted) * 0.01, abs=1e-9)


def showing(left: float, right: float) -> list[Skeleton]:
    """A person whose wrists go up and down by so many metres."""
    made = []
    for k, skeleton in enumerate(skeletons(60)):
        positions = np.array(skeleton.positions)
        for side, height in (("left", left), ("right", right)):
            positions[JOINT[f"wrist_{side}"]] = positions[JOINT[f"shoulder_{side}"]] + [
                0.0,
                height * np.sin(k / 5),
                0.4,
            ]
        made.append(Skeleton(skeleton.time, positions, np.full(25, 2, np.int8)))
    return made


BAD = replace(GOOD, rms=0.15, far_fraction=0.7)


def test_the_arm_that_shows_something_is_named_first_and_one_that_hangs_never():
    right = Correspondence(orientation="upright")
    assert "try --side left" in suggestion(BAD, showing(0.4, 0.05), right, fitted=True, pace=1.0)
    assert "--side" not in suggestion(BAD, showing(0.05, 0.4), right, fitted=True, pace=1.0)
    assert suggestion(BAD, showing(0.4, 0.4), right, fitted=True, pace=1.0).endswith(
        "--side left (if the person demonstrates with the other arm)"
    )
    assert "try --side right" in suggestion(BAD, showing(0.05, 0.4), replace(right, side="left"), fitted=True, pace=1.0)


def test_only_what_was_not_done_yet_is_advised():
    frames = showing(0.05, 0.4)
    words = suggestion(BAD, frames, Correspondence(orientation="upright"), fitted=False, pace=0.5)
    assert "--orientation fixed" in words and "--fit" in words and "--pace 0.25" in words and "--scale 0.5" in words
    words = suggestion(BAD, frames, Correspondence(orientation="fixed"), fitted=True, pace=1.0)
    assert "--orientation" not in words and "--fit" not in words and "--pace 0.5" in words
    assert suggestion(GOOD, frames, Correspondence(), fitted=False, pace=1.0) == ""
    assert "keep the arm in view" in suggestion(
        replace(GOOD, engaged_fraction=0.2), frames, Correspondence(), fitted=True, pace=1.0
    )


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


def test_a_tool_that_winds_is_reported_and_what_to_do(run):
    def said(degrees):
        wound = turned(run, np.radians(degrees) * np.linspace(0.0, 1.0, len(run.times)))
        metrics = measure(wound, Correspondence(orientation="fixed"))
        return " ".join(warnings_of(wound, metrics, TargetTracking.of(wound, metrics)))

    assert "--orientation fixed" in said(410.0)
    assert "410 degrees" in said(410.0)
    assert "orientation" not in said(120.0)


def test_a_run_without_a_target_has_not_wound(run):
    assert winding(replace(run, targets=(run.targets[0], np.full((len(run.times), 4), np.nan)))) == 0.0


@pytest.mark.parametrize(("seconds", "reported"), [(0.0, False), (0.02, False), (0.1, True)])
def test_no_time_is_reported_that_rounds_to_zero(run, seconds, reported):
    metrics = measure(run, Correspondence(orientation="fixed"))
    tracking = replace(TargetTracking.of(run, metrics), far_time=seconds, farthest=0.06)
    assert ("from its target for" in " ".join(warnings_of(run, metrics, tracking))) == reported
