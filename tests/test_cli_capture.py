from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from imitarm.capture.recording import SkeletonRecording, read_recording
from imitarm.capture.skeleton import JOINT
from imitarm.capture.stream import UdpSource
from imitarm.cli import main
from recording_samples import Listed, changed, exchanged, same, skeletons


@pytest.fixture
def wave(tmp_path):
    path = tmp_path / "wave.csv"
    SkeletonRecording(skeletons(90)).save(path)
    return path


def test_a_recording_is_shown_and_kept(wave, tmp_path, capsys):
    out = tmp_path / "out.csv"
    assert main(["capture", str(wave), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    rate, arm = "30.0 frames per second", "tracked in 100 %"
    for part in ("90", "2.97 s", rate, arm, "0 errors, 0 warnings, 0 notes", "wrote"):
        assert part in text
    assert all(map(same, read_recording(out).skeletons, read_recording(wave).skeletons))


def test_real_gestures_pass_the_check(real_data, tmp_path, capsys):
    for i, path in enumerate(sorted((real_data / "kinect_gestures").glob("*.csv"))):
        assert main(["capture", str(path), "--check", "--out", str(tmp_path / f"{i}.csv")]) == 0
        assert "0 errors, 0 warnings" in capsys.readouterr().out
        assert len(read_recording(tmp_path / f"{i}.csv")) == len(read_recording(path))


def test_trim_repair_and_one_person(tmp_path, capsys):
    frames = [exchanged(s) if i == 40 else s for i, s in enumerate(skeletons(90, person=1))]
    frames[50] = changed(frames[50], time=frames[49].time)
    both = sorted(frames + skeletons(60, person=2, away=0.8, start=0.5), key=lambda s: s.time)
    source, out = tmp_path / "two.csv", tmp_path / "out.csv"
    SkeletonRecording(both).save(source)
    assert main(["capture", str(source), "--out", str(out), "--trim", "0.5", "2", "--repair"]) == 0
    shown = capsys.readouterr()
    assert "kept person 1" in shown.err and "swapped left and right back in 1 frames" in shown.err
    back = read_recording(out)
    assert back.persons == (1,) and back.duration == pytest.approx(1.5, abs=0.05)
    assert main(["capture", str(source), "--out", str(out), "--person", "2", "--force"]) == 0
    assert read_recording(out).persons == (2,) and len(read_recording(out)) == 60
    assert main(["capture", str(source), "--person", "3"]) == 2
    assert "person 3 is not in this recording, which contains: 1, 2" in capsys.readouterr().err


def test_a_check_that_finds_an_error_is_told_by_the_exit_status(tmp_path, capsys):
    path = tmp_path / "slow.csv"
    SkeletonRecording(skeletons(30, rate=5.0)).save(path)
    assert main(["capture", str(path)]) == 0
    assert main(["capture", str(path), "--check"]) == 2
    assert "5.0 frames per second" in capsys.readouterr().out


def test_a_made_up_person_for_some_seconds(tmp_path):
    out = tmp_path / "made_up.csv"
    assert main(["capture", "synthetic:4", "--seconds", "2", "--out", str(out)]) == 0
    recording = read_recording(out)
    assert 1.8 < recording.duration <= 2.0 and len(recording) > 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "{}/no/a.csv"], "there is no folder"),
        (["--out", "{}/there.csv"], "already exists; name another file, or replace it with --force"),
        (["--out", "{}/wave.csv"], "is also the file of SOURCE"),
        (["--out", "{}/wave.csv", "--force"], "is also the file of SOURCE"),
        (["--out", "{}", "--force"], "is a folder; name a file in it"),
        (["--seconds", "0"], "--seconds must be above 0"),
        (["--trim", "3", "1"], "--trim must be two increasing times"),
        (["--trim", "7", "9"], "no frame between 7 and 9 s"),
    ],
)
def test_a_wrong_option_is_one_message(wave, tmp_path, capsys, options, message):
    before = wave.read_bytes()
    (tmp_path / "there.csv").write_text("precious")
    assert main(["capture", str(wave), *(option.format(tmp_path) for option in options)]) == 2
    text = capsys.readouterr().err
    assert message in text and text.startswith("imitarm: error: ") and "bug" not in text
    assert wave.read_bytes() == before and (tmp_path / "there.csv").read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["there.csv", "wave.csv"]


def test_the_film_of_a_video_source_is_not_written_over(tmp_path, capsys):
    film = tmp_path / "film.mp4"
    film.write_bytes(b"film")
    assert main(["capture", f"video:{film}", "--out", str(film), "--force"]) == 2
    assert "is also the file of SOURCE" in capsys.readouterr().err and film.read_bytes() == b"film"


@pytest.mark.parametrize(("persons", "said"), [((0,), "1 (number 0)"), ((2, 0), "2 (numbers 2, 0)")])
def test_persons_are_counted_and_their_numbers_said(tmp_path, capsys, persons, said):
    path = tmp_path / "seen.csv"
    frames = [one for i, person in enumerate(persons) for one in skeletons(20, person=person, start=0.01 * i)]
    SkeletonRecording(sorted(frames, key=lambda s: s.time)).save(path)
    assert main(["capture", str(path)]) == 0
    assert said in capsys.readouterr().out


def test_a_truncated_file_is_named(wave, capsys):
    wave.write_bytes(wave.read_bytes()[:-300])
    assert main(["capture", str(wave)]) == 2
    assert "wave.csv, line 99" in capsys.readouterr().err


def test_nobody_there_is_a_failure_and_leaves_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("imitarm.cli.capture.open_source", lambda word, realtime: Listed([None, None]))
    assert main(["capture", "webcam:0", "--out", str(tmp_path / "a.csv")]) == 1
    assert "nobody was seen, so nothing is written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_source_that_fails_loses_nothing(tmp_path, capsys, monkeypatch):
    class Unplugged(Listed):
        def read(self, timeout=1.0):
            if len(self.items) == 1:
                raise OSError("camera unplugged")
            return super().read(timeout)

    monkeypatch.setattr("imitarm.cli.capture.open_source", lambda word, realtime: Unplugged(skeletons(20)))
    assert main(["capture", "webcam:0", "--out", str(tmp_path / "a.csv")]) == 2
    assert "camera unplugged" in capsys.readouterr().err
    assert len(read_recording(tmp_path / "a.csv")) == 19


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize(("kind", "name"), [(signal.SIGINT, "live.csv"), (signal.SIGKILL, "live.csv.part")])
def test_a_capture_that_is_ended_keeps_what_came(tmp_path, kind, name):
    """Ctrl-C closes the recording; kill -9 leaves its part."""
    out = tmp_path / "live.csv"
    words = ["capture", "synthetic:1", "--realtime", "--out", str(out)]
    code = f"import sys; from imitarm.cli import main; sys.exit(main({words!r}))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        part, until = tmp_path / "live.csv.part", time.monotonic() + 120.0
        while time.monotonic() < until and (not part.exists() or part.stat().st_size < 40_000):
            time.sleep(0.02)
        process.send_signal(kind)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == (0 if kind == signal.SIGINT else -kind), errors
    assert [p.name for p in tmp_path.iterdir()] == [name]
    times = [s.time for s in read_recording(tmp_path / name).skeletons]
    assert len(times) > 5 and (np.diff(times) > 0).all()


def test_skeletons_are_sent_at_the_pace_at_which_they_happened(tmp_path, capsys):
    frames, path = skeletons(12), tmp_path / "short.csv"
    SkeletonRecording(frames).save(path)
    with UdpSource(0) as received:
        begin = time.monotonic()
        assert main(["capture", str(path), "--send", f"127.0.0.1:{received.address[1]}"]) == 0
        assert time.monotonic() - begin >= frames[-1].time - frames[0].time
        came = []
        while (skeleton := received.read(0.0)) is not None:
            came.append(skeleton)
        assert (
            all(map(same, came, frames[-len(came) :])) and len(came) + received.datagram_filter.dropped["stale"] == 12
        )
    assert "sent 12 skeletons to 127.0.0.1:" in capsys.readouterr().err
    assert main(["capture", str(path), "--send", f"127.0.0.1:{received.address[1]}"]) == 0
    assert "no program received them" in capsys.readouterr().err
    assert main(["capture", str(path), "--send", "nowhere"]) == 2
    assert "'nowhere' is not an address" in capsys.readouterr().err


def microseconds(frames):
    return [changed(s, time=0.1 * s.time) for s in frames]


def z_up(frames):
    return [changed(s, positions=s.positions @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])) for s in frames]


def frozen(frames):
    return [changed(s, positions=frames[60].positions) if 60 < i < 150 else s for i, s in enumerate(frames)]


def with_spikes(frames):
    leap = np.zeros((25, 3))
    leap[[JOINT["elbow_right"], JOINT["wrist_right"], JOINT["hand_right"]], 2] = 0.8
    return [changed(s, positions=s.positions + leap) if i % 40 == 20 else s for i, s in enumerate(frames)]


@pytest.mark.parametrize(
    ("spoil", "code", "retargeted"),
    [
        (
            microseconds,
            "frame-rate",
            "units of 100 ns, but they seem to be in us (30.0 frames per second): multiply them by 10",
        ),
        (z_up, "axes", "use the axes x, z, -y of the file as x, y, z"),
        (frozen, "frozen", "repaired: dropped 89 frames that repeat the previous frame, for up to 2.97 s at a time"),
        (with_spikes, "spike", "repaired: marked joints as lost in 6 frames with a spike"),
    ],
)
def test_an_implausible_recording_is_reported_by_capture_and_by_retarget(spoil, code, retargeted, tmp_path, capsys):
    frames = spoil(skeletons(240, seed=5))
    rows = [np.column_stack([s.positions, s.tracking]).ravel() for s in frames]
    lines = [
        ",".join([str(round(1e7 * s.time)), *(f"{x:.6f}" for x in row)]) for s, row in zip(frames, rows, strict=True)
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    assert main(["capture", str(path), "--check"]) == 2
    assert code in capsys.readouterr().out
    main(["retarget", str(path), "--orientation", "fixed"])
    assert retargeted in " ".join(capsys.readouterr().err.split())
