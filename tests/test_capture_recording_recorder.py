from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from imitarm.capture.recording import SkeletonRecorder, read_recording
from imitarm.errors import FileFormatError, InputError
from recording_samples import same, skeletons

_WRITER = """
import sys
from recording_samples import skeletons
from imitarm.capture.recording import SkeletonRecorder
recorder = SkeletonRecorder(sys.argv[1], source="to be killed")
frames = skeletons(50)
i = 0
while True:
    recorder.write(frames[i % 50])
    i += 1
    print(i, flush=True)
"""


def recorded(path, n):
    """A recorder that has written n frames and is still open."""
    recorder = SkeletonRecorder(path, source="test")
    for skeleton in skeletons(n):
        recorder.write(skeleton)
    return recorder


def test_the_file_has_its_name_only_when_it_is_whole(tmp_path):
    path = tmp_path / "a.csv"
    recorder = recorded(path, 3)
    assert not path.exists() and (tmp_path / "a.csv.part").exists() and recorder.n_frames == 3
    recorder.close()
    recorder.close()
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
    assert all(map(same, read_recording(path).skeletons, skeletons(3)))
    with pytest.raises(InputError, match="closed"):
        recorder.write(skeletons(1)[0])


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_killed_recorder_loses_no_whole_frame(tmp_path):
    path = tmp_path / "killed.csv"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    with subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        for _ in range(40):
            assert process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        told = [int(line) for line in process.stdout.read().split()]
    written = max(told, default=40)
    assert process.returncode == -signal.SIGKILL and not path.exists()
    recording = read_recording(tmp_path / "killed.csv.part")
    assert len(recording) >= written >= 40
    frames = skeletons(50)
    assert all(same(one, frames[i % 50]) for i, one in enumerate(recording.skeletons))
    assert [finding.code for finding in recording.issues] == ["not-closed"]


def test_a_torn_last_line_is_left_out_and_said_wherever_it_was_torn(tmp_path):
    part = tmp_path / "a.csv.part"
    recorder = recorded(tmp_path / "a.csv", 3)
    content = part.read_bytes()
    start = content.rstrip(b"\n").rfind(b"\n") + 1
    for n in range(start + 1, len(content), 37):
        part.write_bytes(content[:n])
        recording = read_recording(part)
        assert len(recording) == 2
        assert "2 complete frames were read; the frame that was being written is lost" in recording.issues[0].message
    part.write_bytes(content[: content.index(b"\nt,") + 40])
    with pytest.raises(FileFormatError, match=r"a\.csv\.part"):
        read_recording(part)
    recorder.close()


def test_what_was_not_closed_can_be_saved_under_another_name(tmp_path):
    recorder = recorded(tmp_path / "a.csv", 4)
    read_recording(tmp_path / "a.csv.part").save(tmp_path / "b.csv")
    assert read_recording(tmp_path / "b.csv").issues == ()
    recorder.close()


def test_no_frames_leave_no_file(tmp_path):
    with SkeletonRecorder(tmp_path / "a.csv"):
        pass
    assert list(tmp_path.iterdir()) == []
    part = SkeletonRecorder(tmp_path / "b.csv")
    with pytest.raises(FileFormatError, match="contains no complete frame"):
        read_recording(tmp_path / "b.csv.part")
    part.close()


def test_an_error_while_recording_keeps_what_came(tmp_path):
    def fails():
        with SkeletonRecorder(tmp_path / "a.csv") as recorder:
            recorder.write(skeletons(1)[0])
            raise RuntimeError("camera unplugged")

    with pytest.raises(RuntimeError):
        fails()
    assert len(read_recording(tmp_path / "a.csv")) == 1


def test_nothing_that_is_there_is_overwritten(tmp_path):
    path = tmp_path / "a.csv"
    recorded(path, 2).close()
    with pytest.raises(InputError, match="already exists"):
        SkeletonRecorder(path)
    first = SkeletonRecorder(path, replace=True)
    with pytest.raises(InputError, match=r"a\.csv\.part: an earlier recording left .* is writing it"):
        SkeletonRecorder(path, replace=True)
    assert len(read_recording(path)) == 2  # until the new one is whole
    first.write(skeletons(1)[0])
    first.close()
    assert len(read_recording(path)) == 1
    with pytest.raises(InputError, match="folder"):
        SkeletonRecorder(tmp_path)
    with pytest.raises(InputError, match="can't be written"):
        SkeletonRecorder(tmp_path / "no" / "a.csv")


def test_writing_keeps_up_with_any_camera(tmp_path):
    """It takes a sixth of the time between two frames at most; processor time, which the load hardly changes."""
    frames = skeletons(90)
    with SkeletonRecorder(tmp_path / "a.csv") as recorder:
        began = time.process_time()
        for skeleton in frames:
            recorder.write(skeleton)
        assert (time.process_time() - began) / len(frames) < 0.005  # measured: 0.1 ms


def test_another_recorder_that_begins_when_this_one_has_its_name_keeps_its_file(tmp_path, monkeypatch):
    path, frames, others = tmp_path / "a.csv", skeletons(2), []
    rename = Path.replace

    def rename_and_begin(part, target):
        rename(part, target)
        others.append(SkeletonRecorder(path, replace=True))

    first = SkeletonRecorder(path)
    first.write(frames[0])
    monkeypatch.setattr(Path, "replace", rename_and_begin)
    first.close()
    monkeypatch.undo()
    others[0].write(frames[1])
    others[0].close()
    assert same(read_recording(path).skeletons[0], frames[1])
