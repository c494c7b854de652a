from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.checks import check, repaired
from imitarm.capture.issue import RecordingIssue
from imitarm.capture.recording import SkeletonRecording, read_recording
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.errors import UnknownNameError
from recording_samples import changed, exchanged, same, skeletons


def found(frames, side="right"):
    """Findings by their codes."""
    findings = check(SkeletonRecording(frames), side)
    assert all(f.message and (f.remedy or f.severity == "note") for f in findings)
    return {f.code: f for f in findings}


def without(skeleton, *joints, state=Tracking.LOST):
    tracking = np.array(skeleton.tracking)
    tracking[[JOINT[name] for name in joints]] = state
    return changed(skeleton, tracking=tracking)


def test_a_good_recording_has_no_findings(real_data):
    assert found(skeletons(90)) == {}
    for path in sorted((real_data / "kinect_gestures").glob("*.csv")):
        for side in ("left", "right"):
            assert check(read_recording(path), side) == []


def test_nobody():
    lost = np.full(len(JOINTS), Tracking.LOST)
    for frames in ([], [Skeleton(i / 30, np.zeros((25, 3)), lost) for i in range(40)]):
        assert list(found(frames)) == ["nobody"]
        assert found(frames)["nobody"].severity == "error"


def test_a_lost_arm():
    frames = skeletons(100)
    for share, severity in ((0.03, "note"), (0.2, "warning"), (0.7, "error")):
        spoilt = [without(s, "elbow_right") if 20 <= i < 20 + 100 * share else s for i, s in enumerate(frames)]
        finding = found(spoilt)["arm-lost"]
        assert (finding.severity, finding.frame, finding.place) == (severity, 20, "frame 20 (0.67 s)")
        assert "arm-lost" not in found(spoilt, "left")
    guessed = [without(s, "wrist_right", state=Tracking.INFERRED) if i < 30 else s for i, s in enumerate(frames)]
    assert found(guessed)["arm-inferred"].severity == "warning"
    assert found([without(s, "thumb_right") for s in frames])["hand-lost"].severity == "note"


def test_gaps():
    frames = skeletons(90)
    finding = found(frames[:30] + frames[45:])["gap"]
    assert "the longest 0.53 s; in 1 of these gaps, a robot would stop" in finding.message and finding.frame == 29
    assert "gap" not in found(frames[:30] + frames[31:])  # one frame slipped is usual


@pytest.mark.parametrize(("rate", "severity"), [(5.0, "error"), (15.0, "warning")])
def test_a_frame_rate_that_is_too_low(rate, severity):
    finding = found(skeletons(60, rate=rate))["frame-rate"]
    assert finding.severity == severity and f"{rate:.1f} frames per second" in finding.message


def test_time_that_runs_backwards_or_stands_still():
    frames = skeletons(60)
    back = [changed(s, time=s.time - 0.5) if i >= 30 else s for i, s in enumerate(frames)]
    finding = found(back)["time-backwards"]
    assert finding.severity == "error" and finding.frame == 30 and "up to 467 ms earlier" in finding.message
    assert "time-backwards" in found([*frames[:30], frames[29], *frames[30:]])
    mended, notes = repaired(SkeletonRecording(back))
    assert notes == ["dropped 15 frames that were not later than the previous frame"]
    assert "time-backwards" not in found(mended.skeletons)


def test_swapped_sides_are_found_and_mended():
    frames = skeletons(60)
    wrong = [exchanged(s) if 20 <= i < 24 else s for i, s in enumerate(frames)]
    wrong[40] = exchanged(wrong[40], ("wrist", "hand", "hand_tip", "thumb"))
    finding = found(wrong)["sides-swapped"]
    assert finding.frame == 20 and "in 5 frames" in finding.message
    mended, notes = repaired(SkeletonRecording(wrong))
    assert all(map(same, mended.skeletons, frames)) and notes == [
        "swapped left and right back in 5 frames in which the sensor had swapped them"
    ]


def test_a_person_with_the_back_to_the_sensor():
    away = found([exchanged(s) for s in skeletons(60)])
    assert away["turned-away"].severity == "warning" and "sides-swapped" not in away


def test_a_second_person_and_the_one_who_is_kept():
    frames = sorted(skeletons(60, person=3) + skeletons(20, person=8, start=0.51, away=0.8), key=lambda s: s.time)
    finding = found(frames)["several-persons"]
    assert "3 (60 frames), 8 (20 frames)" in finding.message and finding.frame == 16
    mended, notes = repaired(SkeletonRecording(frames))
    assert mended.persons == (3,) and notes == ["kept person 3; 20 frames of other persons dropped"]


def test_limbs_of_changing_length_and_of_impossible_length():
    rng = np.random.default_rng(0)
    shaken = []
    for s in skeletons(60):
        positions = np.array(s.positions)
        positions[JOINT["elbow_right"]] += rng.normal(0.0, 0.06, 3)
        shaken.append(changed(s, positions=positions))
    assert found(shaken)["limb-length"].severity == "warning"
    tiny = [changed(s, positions=0.1 * s.positions) for s in skeletons(60)]
    assert found(tiny)["limb-length"].severity == "error"


def test_joints_at_infinity_are_found_when_the_file_is_read(tmp_path):
    SkeletonRecording(skeletons(20)).save(tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    fields = lines[-1].split(",")
    fields[4] = "-inf"
    (tmp_path / "a.csv").write_text("\n".join([*lines[:-1], ",".join(fields), ""]))
    (finding,) = check(read_recording(tmp_path / "a.csv"))
    assert finding.code == "far-joint" and "spine_base" in finding.message


def test_few_frames_and_an_unknown_side():
    assert found(skeletons(3))["few-frames"].severity == "error"
    with pytest.raises(UnknownNameError, match="left, right"):
        check(SkeletonRecording([]), "both")


def test_errors_come_first_and_read_well():
    frames = [without(s, "elbow_right") if i < 80 else s for i, s in enumerate(skeletons(100, rate=15.0))]
    findings = check(SkeletonRecording(frames))
    assert [f.severity for f in findings] == sorted(
        (f.severity for f in findings), key=["error", "warning", "note"].index
    )
    assert str(findings[0]) == (
        "error arm-lost: frame 0 (0.00 s): the right arm is lost in 80 % of the frames; "
        "keep the arm in view, away from the body"
    )
    assert str(RecordingIssue("note", "x", "all is well")) == "note x: all is well"


def test_nothing_is_mended_where_nothing_is_wrong():
    frames = skeletons(30)
    mended, notes = repaired(SkeletonRecording(frames))
    assert notes == [] and all(a is b for a, b in zip(mended.skeletons, frames, strict=True))
