from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.capture.recording import SkeletonRecording, read_recording
from imitarm.capture.skeleton import JOINTS, HandState, Skeleton, Tracking
from imitarm.errors import FileFormatError, InputError
from recording_samples import CLOSED, changed, same, skeletons


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "wave.csv"
    SkeletonRecording(skeletons(12), name="a wave").save(path)
    return path


def spoilt(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


# --- our own format


def test_every_skeleton_comes_back_to_the_last_bit(tmp_path):
    frames = skeletons(5)
    tracking = np.array(frames[1].tracking)
    tracking[[3, 8]] = Tracking.LOST, Tracking.INFERRED
    frames[1] = changed(frames[1], tracking=tracking, hand_states=CLOSED)
    frames.insert(2, changed(frames[1], person=72057594037944738))  # Kinect counts bodies in large numbers
    SkeletonRecording(frames).save(tmp_path / "a.csv")
    back = read_recording(tmp_path / "a.csv")
    assert len(back) == 6 and all(map(same, back.skeletons, frames))
    assert back.issues == () and back.name == "a.csv"
    assert back.persons == (0, 72057594037944738)


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(
            st.floats(-1e6, 1e6),
            st.lists(st.floats(-15.0, 15.0, allow_subnormal=True) | st.just(np.inf), min_size=75, max_size=75),
            st.lists(st.sampled_from([0, 1, 2]), min_size=25, max_size=25),
            st.integers(0, 4),
            st.integers(0, 2**64 - 1),
        ),
        min_size=1,
        max_size=3,
    )
)
def test_whatever_a_skeleton_holds_is_kept(tmp_path_factory, rows):
    frames = [
        Skeleton(t, np.reshape(x, (25, 3)), np.array(k), (HandState(h), HandState.OPEN), p) for t, x, k, h, p in rows
    ]
    path = tmp_path_factory.mktemp("kept") / "a.csv"
    SkeletonRecording(frames).save(path)
    assert all(map(same, read_recording(path).skeletons, frames))


def test_the_file_says_what_it_holds(saved):
    lines = saved.read_text().splitlines()
    head = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    assert head["format"] == "imitarm-skeletons" and head["version"] == "1"
    assert head["frames"].strip() == "12" and head["source"] == "a wave" and head["units"] == "m s"
    names = next(line for line in lines if not line.startswith("#")).split(",")
    assert names[:4] == ["t", "person", "hand_left", "hand_right"] and len(names) == 4 + 4 * len(JOINTS)


def test_a_file_from_windows_is_read(saved):
    content = saved.read_bytes()
    saved.write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"))
    assert len(read_recording(saved)) == 12


def test_a_cut_off_file_is_refused_wherever_it_was_cut(saved, tmp_path):
    """After any byte of the last rows: no frame is made up, and the message says what to do."""
    content = saved.read_bytes()
    first_row = content.index(b"\n", content.index(b"\nt,") + 1) + 1
    for n in [first_row - 5, first_row + 400, *range(len(content) - 40, len(content) - 1)]:
        path = tmp_path / "cut.csv"
        path.write_bytes(content[:n])
        if n == len(content) - 1:
            continue
        with pytest.raises(FileFormatError, match=r"cut\.csv"):
            read_recording(path)


def test_a_file_cut_between_two_rows_knows_how_many_there_were(saved):
    saved.write_text("".join(saved.read_text().splitlines(keepends=True)[:-2]))
    message = r"wave\.csv, line 19: the file ends after 10 frames, but its header announces 12.*copy"
    with pytest.raises(FileFormatError, match=message):
        read_recording(saved)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# version: 1", "# version: 2", "version '2'.*update imitarm"),
        ("spine_base_x", "spine_bass_x", "columns"),
        ("\n0.0,0,", "\nnan,0,", "line 10: the time is not a finite number"),
        ("\n0.0,0,", "\n0.0,0.5,", "line 10: the person number is not a whole number"),
        ("\n0.0,0,", "\n0.0,nan,", "line 10: the person number is not a whole number"),
        ("\n0.0,0,2,", "\n0.0,0,7,", "line 10: the state of a hand"),
        (",2\n", ",9\n", "line 10: a tracking state"),
        (",2\n", ",1.5\n", "line 10: a tracking state"),
        (",2\n", ",two\n", "line 10, column 104: 'two' is not a number"),
        (",2\n", "\n", "line 10: 103 values where 104 are expected"),
    ],
)
def test_what_is_no_skeleton_is_refused_with_file_and_line(saved, old, new, message):
    spoilt(saved, old, new)
    with pytest.raises(FileFormatError, match=rf"wave\.csv.*{message}"):
        read_recording(saved)


def test_a_joint_at_infinity_is_lost_and_is_said(saved):
    lines = saved.read_text().splitlines(keepends=True)
    fields = lines[11].split(",")
    fields[4 + 4 * 10], fields[4 + 4 * 11] = "inf", "1e9"
    lines[11] = ",".join(fields)
    saved.write_text("".join(lines))
    recording = read_recording(saved)
    skeleton = recording.skeletons[2]
    assert skeleton.tracking[10] == skeleton.tracking[11] == Tracking.LOST and not skeleton.arm("right").seen
    (finding,) = recording.issues
    assert finding.code == "far-joint" and finding.frame == 2
    assert "2 joint positions in 1 frames" in finding.message and "wrist_right in line 12" in finding.message


# --- Kinect SDK tables


def test_the_real_gestures_are_read(real_data):
    paths = sorted((real_data / "kinect_gestures").glob("*.csv"))
    assert len(paths) == 4
    for path in paths:
        recording = read_recording(path)
        lines = path.read_text().splitlines()
        assert len(recording) == len(lines) and recording.skeletons[0].time == 0.0
        assert recording.rate == pytest.approx(30.3, abs=0.1) and 5.0 < recording.duration < 8.0
        first = lines[-1].split(",")
        np.testing.assert_array_equal(recording.skeletons[-1].positions[24], [float(x) for x in first[97:100]])
        assert recording.skeletons[-1].arm("right").seen and recording.issues == ()


def kinect_table(tmp_path, n=6, tick=10_000_000 / 30, end=",\n"):
    """A table as the SDK's programs write it."""
    path = tmp_path / "kinect.csv"
    rows = []
    for i, one in enumerate(skeletons(n)):
        joints = np.column_stack([one.positions, one.tracking]).tolist()
        fields = [str(round(89810293609 + i * tick)), *(f"{x:g}" for joint in joints for x in joint)]
        rows.append(",".join(fields) + end)
    path.write_text("".join(rows))
    return path


def test_a_kinect_table_is_told_by_its_content_and_counts_from_zero(tmp_path):
    recording = read_recording(kinect_table(tmp_path))
    np.testing.assert_allclose([s.time for s in recording.skeletons], np.arange(6) / 30, atol=1e-7)
    assert len(read_recording(kinect_table(tmp_path, end="\n"))) == 6


def test_a_truncated_kinect_table_names_file_line_and_remedy(tmp_path):
    path = kinect_table(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[:-200])
    with pytest.raises(
        FileFormatError, match=r"kinect\.csv, line 6: .* values where 101 .* cut off: record it again or"
    ):
        read_recording(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"t,x,y,z\n0,1,2,3\n1,2,3,4\n", "line 2: a recording of skeletons can't have 4 columns.* 101 columns"),
        (b"Frame\tTime\tx\n1\t0.0\t2\n", "line 2: .* 3 columns"),
        (b"\x89PNG\0\0\0", "binary"),
        (b"PK\x03\x04abc", "zip"),
        (b"hello\nworld\n", "not a number|rows"),
        (b"# format: imitarm-demonstration\nt,x,y,z\n0,1,2,3\n1,1,2,3\n", "line 3: .* 4 columns"),
    ],
)
def test_a_foreign_file_is_refused(tmp_path, content, message):
    path = tmp_path / "foreign.csv"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=rf"foreign\.csv.*({message})"):
        read_recording(path)


def test_times_that_are_no_kinect_ticks_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r"units of 100 ns, as in a table of the Kinect SDK.*multiply"):
        read_recording(kinect_table(tmp_path, tick=1.0 / 30))


def test_random_bytes_are_refused_and_never_crash(tmp_path):
    rng = np.random.default_rng(0)
    content = kinect_table(tmp_path, n=3).read_bytes()
    path = tmp_path / "random.csv"
    for _ in range(150):
        spoilt_content = bytearray(content)
        for at in rng.integers(0, len(content), 3):
            spoilt_content[at] = rng.integers(0, 256)
        path.write_bytes(bytes(spoilt_content))
        try:
            assert len(read_recording(path)) >= 1
        except InputError as error:
            assert "random.csv" in str(error)


# --- parts and replay


def test_trim_counts_from_the_first_frame():
    recording = SkeletonRecording(skeletons(31, start=100.0))
    cut = recording.trim(0.2, 0.5)
    assert [cut.skeletons[0].time, cut.skeletons[-1].time] == pytest.approx([100.2, 100.5])
    assert len(cut) == 10 and len(recording.trim(0.5)) == 16
    with pytest.raises(InputError, match=r"no frame between 5 and 6 s; the recording goes from 0 to 1\.00 s"):
        recording.trim(5.0, 6.0)


def test_one_person_of_several():
    recording = SkeletonRecording(skeletons(4) + skeletons(3, person=5))
    assert recording.persons == (0, 5)
    assert {s.person for s in recording.person(5).skeletons} == {5} and len(recording.person(5)) == 3
    with pytest.raises(InputError, match="person 2 is not in this recording, which contains: 0, 5"):
        recording.person(2)


def test_every_loop_over_a_recording_is_over_all_of_it():
    recording = SkeletonRecording(skeletons(5))
    assert len(list(recording)) == len(list(recording)) == 5


def test_it_replays_once_and_again_after_rewind():
    recording = SkeletonRecording(skeletons(4))
    assert len(list(recording)) == 4 and recording.over and recording.read() is None
    recording.rewind()
    assert len(list(recording)) == 4


def test_in_real_time_a_frame_comes_when_it_is_due(monkeypatch):
    now = [100.0]

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr("imitarm.capture.recording.clock", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    recording = SkeletonRecording(skeletons(7, rate=30.0), realtime=True)
    assert recording.read() is not None
    assert recording.read(timeout=0.0) is None  # not yet
    assert recording.read(timeout=0.02) is None and now[0] == pytest.approx(100.02)
    assert len(list(recording)) == 6
    assert now[0] == pytest.approx(100.2)


def test_nothing_can_be_saved_of_nothing(tmp_path):
    empty = SkeletonRecording([])
    assert empty.over and empty.duration == 0.0 and empty.rate == 0.0
    with pytest.raises(InputError, match="holds no skeletons"):
        empty.save(tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file_and_one_whose_part_is_there(tmp_path):
    with pytest.raises(InputError, match=r"a\.csv: can't be read"):
        read_recording(tmp_path / "a.csv")
    (tmp_path / "a.csv.part").write_text("x")
    with pytest.raises(InputError, match=r"read .*a\.csv\.part instead, which an interrupted recording left"):
        read_recording(tmp_path / "a.csv")
