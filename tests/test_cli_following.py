from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.cli.following import FAR, MOSTLY, Following, remedy
from imitarm.evaluation.mapping_metrics import measure
from imitarm.retarget import Correspondence, ModernRetargeter
from recording_samples import skeletons

ARM = ArmModel.load("sawyer", tool="gripper")
GOOD = Following("modern", 0.01, 0.0, 0.0, 0.03, 1, 0.95, 0)


@pytest.mark.parametrize(
    ("changes", "followed", "words"),
    [
        (
            {},
            True,
            "modern: follows its target, 10 mm from it (RMS), farther than 5 cm for 0 % of the time; the person led",
        ),
        ({"rms": FAR}, True, "follows"),
        ({"rms": 1.01 * FAR}, False, "does not follow"),
        ({"far_share": MOSTLY}, True, "farther than 5 cm for 10 % of the time"),
        ({"far_share": 1.01 * MOSTLY}, False, "does not follow"),
        ({"far_share": 0.001}, True, "for under 1 % of the time"),
        ({"far_share": 0.999, "rms": 1.0}, False, "for over 99 % of the time"),
        ({"led_share": 0.49}, False, "mostly led by nobody"),
        ({"rms": np.nan, "far_share": np.nan, "farthest": np.nan}, False, "followed nothing"),
        ({"broken": 3}, True, "limits are broken in 3 frames"),
    ],
)
def test_the_headline_says_whether_it_followed_and_is_good_only_then(changes, followed, words):
    found = replace(GOOD, **changes)
    assert found.followed == followed
    assert found.good == (followed and not found.broken)
    assert words in found.verdict()
    assert ("no joint breaks a limit" in found.verdict()) == (found.broken == 0)


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
    found = Following.of("modern", moved, measure(moved, Correspondence()))
    counted = away[5:]
    assert found.rms == pytest.approx(np.sqrt(np.mean(counted**2)), abs=1e-9)
    assert found.farthest == pytest.approx(counted.max(), abs=1e-9)
    assert found.far_share == pytest.approx(np.mean(np.linalg.norm(targets - tool, axis=1)[5:] > FAR), abs=1e-12)
    assert found.far_time == pytest.approx(found.far_share * len(counted) * 0.01, abs=1e-9)


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


BAD = replace(GOOD, rms=0.15, far_share=0.7)


def test_the_arm_that_shows_something_is_named_first_and_one_that_hangs_never():
    right = Correspondence(orientation="upright")
    assert "try --side left" in remedy(BAD, showing(0.4, 0.05), right, fitted=True, pace=1.0)
    assert "--side" not in remedy(BAD, showing(0.05, 0.4), right, fitted=True, pace=1.0)
    assert remedy(BAD, showing(0.4, 0.4), right, fitted=True, pace=1.0).endswith(
        "--side left (if the other arm is meant)"
    )
    assert "try --side right" in remedy(BAD, showing(0.05, 0.4), replace(right, side="left"), fitted=True, pace=1.0)


def test_only_what_was_not_done_yet_is_advised():
    frames = showing(0.05, 0.4)
    words = remedy(BAD, frames, Correspondence(orientation="upright"), fitted=False, pace=0.5)
    assert "--orientation fixed" in words and "--fit" in words and "--pace 0.25" in words and "--scale 0.5" in words
    words = remedy(BAD, frames, Correspondence(orientation="fixed"), fitted=True, pace=1.0)
    assert "--orientation" not in words and "--fit" not in words and "--pace 0.5" in words
    assert remedy(GOOD, frames, Correspondence(), fitted=False, pace=1.0) == ""
    assert "keep the arm in view" in remedy(
        replace(GOOD, led_share=0.2), frames, Correspondence(), fitted=True, pace=1.0
    )
