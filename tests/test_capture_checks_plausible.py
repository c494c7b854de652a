"""Recordings that no person can have made: units, axes, frozen frames, spikes; and good ones, which must pass."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.checks import check, repaired
from imitarm.capture.formats import TICK
from imitarm.capture.motions import DRAWINGS, REACHES
from imitarm.capture.plausibility import hand_speed
from imitarm.capture.recording import SkeletonRecording, read_recording
from imitarm.capture.skeleton import JOINT, SIDES, Tracking
from imitarm.capture.synthetic import MOTIONS, SyntheticSource
from imitarm.errors import FileFormatError
from recording_samples import changed, skeletons

IMPLAUSIBLE = {"frame-rate", "hand-speed", "axes", "frozen", "spike", "jump"}


def issues(frames, **options):
    return {issue.code: issue for issue in check(SkeletonRecording(frames, **options))}


def moved(skeleton, joints, by):
    """The skeleton with some joints moved [m]."""
    positions = np.array(skeleton.positions)
    positions[[JOINT[name] for name in joints]] += by
    return changed(skeleton, positions=positions)


def mapped(frames, matrix):
    return [changed(s, positions=s.positions @ np.array(matrix, dtype=float).T) for s in frames]


def kinect_table(path, frames, *, unit=TICK):
    """Write a table of the Kinect SDK with its times in some unit [s]."""
    lines = []
    for s in frames:
        fields = [str(round(s.time / unit))]
        for position, tracking in zip(s.positions, s.tracking, strict=True):
            fields += [*(f"{x:.6f}" for x in position), str(tracking)]
        lines.append(",".join(fields))
    path.write_text("\n".join(lines) + "\n")
    return path


# --- units of time and length


@pytest.mark.parametrize("seed", [3, 11, 26])
def test_microseconds_in_a_kinect_table_are_an_error_that_names_the_unit(tmp_path, seed):
    path = kinect_table(tmp_path / "a.csv", skeletons(90, seed=seed), unit=1e-6)
    found = {issue.code: issue for issue in check(read_recording(path))}
    assert found["frame-rate"].severity in {"error", "warning"}
    assert "300.0 frames per second" in found["frame-rate"].message
    assert "seem to be in us (30.0 frames per second)" in found["frame-rate"].remedy
    assert "multiply them by 10" in found["frame-rate"].remedy


def test_quick_hands_at_an_implausible_rate_are_an_error():
    source = SyntheticSource.from_seed(3, kind="wave", duration=6.0)
    frames = [changed(s, time=0.1 * s.time) for s in source]
    issue = issues(frames, time_unit=TICK)["frame-rate"]
    assert (
        issue.severity == "error"
        and "hands would move at up to" in issue.message
        and "seem to be in us" in issue.remedy
    )


@pytest.mark.parametrize(("unit", "name"), [(1e-3, "ms"), (1.0, "s")])
def test_a_kinect_table_in_far_too_long_units_is_refused_with_the_unit(tmp_path, unit, name):
    path = kinect_table(tmp_path / "a.csv", skeletons(40, rate=0.9 if unit == 1.0 else 30.0), unit=unit)
    expected = (
        "if the times are in units of 100 ns"
        if name == "s"
        else f"the times seem to be in {name}: multiply them by 10000"
    )
    with pytest.raises(FileFormatError, match=expected):
        read_recording(path)


@pytest.mark.parametrize(("unit", "name"), [(1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")])
def test_times_that_are_too_slow_name_the_unit_too(unit, name):
    issue = issues([changed(s, time=s.time / unit) for s in skeletons(60)])["frame-rate"]
    assert issue.severity == "error" and f"seem to be in {name} (30.0 frames per second)" in issue.remedy


@pytest.mark.parametrize("seed", [1, 8, 40])
def test_hands_faster_than_ten_metres_a_second_are_an_error(seed):
    arm = [name for name in JOINT if name.endswith("_right")]
    frames = [
        moved(changed(s, time=0.1 * s.time), arm, [0.4 * np.sin(5.0 * s.time), 0.0, 0.0])
        for s in skeletons(90, seed=seed, rate=11.0)
    ]
    issue = issues(frames, time_unit=TICK)["hand-speed"]
    assert issue.severity == "error" and "seem to be in us" in issue.remedy


def test_a_fast_motion_capture_of_a_calm_hand_is_only_a_warning():
    issue = issues(skeletons(400, rate=200.0))["frame-rate"]
    assert issue.severity == "warning" and "200.0 frames per second" in issue.message


@pytest.mark.parametrize(("scale", "unit"), [(100.0, "cm"), (1000.0, "mm"), (39.37, "inches"), (3.281, "feet")])
def test_a_length_in_another_unit_is_named(tmp_path, scale, unit):
    frames = skeletons(40, seed=5)
    positions = [scale * s.positions for s in frames]
    lines = []
    for s, points in zip(frames, positions, strict=True):
        fields = [str(round(s.time / TICK))]
        for point, tracking in zip(points, s.tracking, strict=True):
            fields += [*(f"{x:.6f}" for x in point), str(tracking)]
        lines.append(",".join(fields))
    (tmp_path / "a.csv").write_text("\n".join(lines))
    found = check(read_recording(tmp_path / "a.csv"))
    assert any(f"seem to be in {unit}" in issue.remedy for issue in found), found


# --- axes

AXES = [
    ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], "x, z, -y"),  # z up, y towards the sensor: as ROS bodies
    ([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "-y, x, z"),  # on its side
    ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], "y, -x, z"),  # on its other side
    ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], "-x, -y, z"),  # a camera's: x right, y down
    ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y, z, x"),  # x forward, y left, z up
    ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], "-x, y, -z"),  # graphics: x right, y up, z backwards
]


@pytest.mark.parametrize(("matrix", "remedy"), AXES)
@pytest.mark.parametrize("seed", [2, 9])
def test_other_axes_are_an_error_that_says_which_fit(matrix, remedy, seed):
    frames = mapped(skeletons(60, seed=seed), matrix)
    found = issues(frames)
    assert found["axes"].severity == "error"
    assert f"{remedy} of the file as x, y, z" in found["axes"].remedy
    assert "turned-away" not in found and not {"spike", "jump", "frozen"} & set(found)
    back = {"x": 0, "y": 1, "z": 2}
    parts = remedy.split(", ")
    rows = np.zeros((3, 3))
    for row, part in enumerate(parts):
        rows[row, back[part[-1]]] = -1.0 if part[0] == "-" else 1.0
    assert not issues(mapped(frames, rows))  # what it proposes is right


def test_mirrored_axes_are_named_as_such():
    found = issues(mapped(skeletons(60), np.diag([1, -1, 1])))
    assert "x, -y, z of the file" in found["axes"].remedy and "mirrored" in found["axes"].remedy


def test_a_person_who_bends_down_for_a_while_or_turns_has_no_issue_of_axes():
    frames = skeletons(90)
    hip = frames[0].joint("spine_base")
    bent = [[1, 0, 0], [0, 0.2, 0.98], [0, -0.98, 0.2]]
    frames[30:60] = [changed(s, positions=(s.positions - hip) @ np.array(bent).T + hip) for s in frames[30:60]]
    assert "axes" not in issues(frames)
    about = np.diag([-1.0, 1.0, -1.0])
    turned = [changed(s, positions=(s.positions - hip) @ about + hip) for s in skeletons(60)]
    assert "axes" not in issues(turned) and "turned-away" in issues(turned)


# --- frozen frames


@pytest.mark.parametrize(("first", "last", "severity"), [(20, 200, "error"), (0, 15, "error"), (60, 66, "warning")])
def test_frozen_frames_are_found_and_dropped(first, last, severity):
    frames = skeletons(240, seed=6)
    frozen = [changed(s, positions=frames[first].positions) if first < i <= last else s for i, s in enumerate(frames)]
    issue = issues(frozen)["frozen"]
    assert issue.severity == severity and issue.frame == first
    assert f"{(last - first) / 30:.2f} s" in issue.message
    mended, notes = repaired(SkeletonRecording(frozen))
    assert len(mended) == 240 - (last - first) and any("repeat" in note for note in notes)
    assert "frozen" not in issues(mended.skeletons)


def test_an_arm_that_is_frozen_while_the_body_moves_is_found_and_lost():
    frames = skeletons(120, seed=4)
    arm = [JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")]
    for i in range(41, 100):
        positions = np.array(frames[i].positions)
        positions[arm] = frames[40].positions[arm]
        frames[i] = changed(frames[i], positions=positions)
    issue = issues(frames)["frozen"]
    assert issue.severity == "error" and issue.frame == 40 and "right arm" in issue.message
    mended, _ = repaired(SkeletonRecording(frames))
    assert len(mended) == 120 and not mended.skeletons[70].arm("right").seen and mended.skeletons[70].arm("left").seen


@pytest.mark.parametrize("part", ["elbow", "wrist"])
def test_one_joint_that_is_frozen_while_the_arm_moves_is_found(part):
    frames = skeletons(120, seed=4)
    joint = JOINT[f"{part}_right"]
    for i in range(41, 100):
        positions = np.array(frames[i].positions)
        positions[joint] = frames[40].positions[joint]
        frames[i] = changed(frames[i], positions=positions)
    issue = issues(frames)["frozen"]
    assert issue.severity == "error" and issue.frame == 40 and f"right {part}" in issue.message
    assert "record again" in issue.remedy


def test_frames_that_all_come_twice_are_a_warning_with_the_true_rate():
    frames = [s for s in skeletons(60, rate=15.0) for _ in range(2)]
    frames = [changed(s, time=i / 30.0) for i, s in enumerate(frames)]
    issue = issues(frames)["frozen"]
    assert issue.severity == "warning" and "15.0 new frames per second" in issue.message


# --- spikes and jumps


@pytest.mark.parametrize(
    ("joints", "by", "at", "width"),
    [
        (["wrist_right", "hand_right", "hand_tip_right", "thumb_right"], [0.0, 0.0, 0.8], [20, 50, 80], 1),
        (["elbow_right"], [0.0, 0.0, -0.5], [33], 1),
        (["elbow_right", "wrist_right", "hand_right", "hand_tip_right", "thumb_right"], [0.0, 0.6, 0.0], [10, 60], 2),
        (["wrist_right"], [0.25, 0.0, 0.0], [40], 3),  # too slow to be known by its speed: by the bone
        (list(JOINT), [0.0, 0.0, 0.7], [45], 1),  # the whole body: no bone is changed
    ],
)
def test_spikes_are_found_and_taken_as_lost(joints, by, at, width):
    frames = skeletons(100, seed=7)
    wrong = {i + k for i in at for k in range(width)}
    spiky = [moved(s, joints, by) if i in wrong else s for i, s in enumerate(frames)]
    issue = issues(spiky)["spike"]
    assert issue.severity == "error" and issue.frame == min(at) and f"in {len(wrong)} frame" in issue.message
    assert f"by at most {np.linalg.norm(by):.1f}" in issue.message
    mended, notes = repaired(SkeletonRecording(spiky))
    assert any("spike" in note for note in notes) and "spike" not in issues(mended.skeletons)
    for i, (s, good) in enumerate(zip(mended.skeletons, frames, strict=True)):
        lost = s.tracking == Tracking.LOST
        assert lost[[JOINT[name] for name in joints]].all() == (i in wrong)
        assert np.array_equal(s.positions[~lost], good.positions[~lost])


def test_leaping_finger_tips_are_a_warning():
    frames = skeletons(100, seed=7)
    frames[40] = moved(frames[40], ["hand_tip_right", "thumb_right"], [0.0, 0.0, 0.5])
    frames[70:] = [moved(s, ["hand_tip_right"], [0.0, 0.4, 0.0]) for s in frames[70:]]
    found = issues(frames)
    assert found["spike"].severity == found["jump"].severity == "warning"


@pytest.mark.parametrize("at", [0, 99])
def test_a_spike_in_the_first_or_the_last_frame_is_found(at):
    frames = skeletons(100, seed=8)
    frames[at] = moved(frames[at], ["wrist_right", "hand_right"], [0.0, 0.0, 0.8])
    assert issues(frames)["spike"].frame == at
    assert "spike" not in issues(repaired(SkeletonRecording(frames))[0].skeletons)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_jump_that_does_not_come_back_is_found(seed):
    frames = skeletons(100, seed=seed)
    frames[50:] = [moved(s, list(JOINT), [0.6, 0.0, 0.3]) for s in frames[50:]]
    issue = issues(frames)["jump"]
    assert issue.severity == "warning" and issue.frame == 50 and "0.67 m" in issue.message
    assert "spike" not in issues(frames)


# --- no false alarms


@pytest.mark.parametrize("kind", [*REACHES, *DRAWINGS])
@pytest.mark.parametrize("seed", range(4))
def test_a_synthetic_person_has_no_issue_of_plausibility(kind, seed):
    assert kind in MOTIONS
    recording = SkeletonRecording(SyntheticSource.from_seed(seed, kind=kind))
    assert not IMPLAUSIBLE & {issue.code for side in ("left", "right") for issue in check(recording, side)}
    mended, notes = repaired(recording)
    assert len(mended) == len(recording) and not any("spike" in n or "repeat" in n for n in notes)


def test_real_gestures_stay_far_below_the_limits(real_data):
    excursions, speeds = [], []
    for path in sorted((real_data / "kinect_gestures").glob("*.csv")):
        skeletons = read_recording(path).skeletons
        points, times = np.array([s.positions for s in skeletons]), np.array([s.time for s in skeletons])
        points = points[
            :, [JOINT[f"{part}_{side}"] for part in ("shoulder", "elbow", "wrist", "hand") for side in SIDES]
        ]
        excursions.append(np.linalg.norm(points[1:-1] - 0.5 * (points[2:] + points[:-2]), axis=2).max())
        speeds.append(hand_speed(times, np.array([s.positions for s in skeletons]), np.zeros((len(times), 25), bool)))
    assert max(excursions) < 0.105 and max(speeds) < 2.25


@pytest.mark.parametrize("folder", ["kinect_gestures/*.csv", "mocap_arm/*.tsv"])
def test_real_recordings_have_no_issue_of_plausibility(real_data, folder):
    files = sorted(real_data.glob(folder))
    assert files
    for path in files:
        recording = read_recording(path)
        assert not IMPLAUSIBLE & {issue.code for side in ("left", "right") for issue in check(recording, side)}
        mended, notes = repaired(recording)
        assert len(mended) == len(recording) and not notes


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "mm"), (1e2, "cm")])
def test_nobody_is_told_to_record_again_when_only_the_unit_is_wrong(tmp_path, scale, unit):
    frames = [
        ",".join([str(round(s.time / TICK)), *(f"{scale * x:.4f},{y:.4f},{z:.4f},2" for x, y, z in positions)])
        for s, positions in ((s, s.positions * [1, scale, scale]) for s in skeletons(40))
    ]
    (tmp_path / "a.csv").write_text("\n".join(frames))
    found = {issue.code: issue for issue in check(read_recording(tmp_path / "a.csv"))}
    assert "metres" in found["nobody"].remedy and f"seem to be in {unit}" in found["far-joint"].remedy


def test_a_repeated_time_stamp_is_not_said_to_go_back():
    frames = skeletons(60)
    frames[30] = changed(frames[30], time=frames[29].time)
    assert "time stamp is the same" in issues(frames)["time-backwards"].message
