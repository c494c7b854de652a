from __future__ import annotations

import gc
import time

import numpy as np
import pytest

from imitarm.capture import mediapipe
from imitarm.capture.mediapipe import MediaPipeSource
from imitarm.capture.mediapipe_environment import VARIABLE
from imitarm.capture.mediapipe_worker import VERSION
from imitarm.capture.sources import open_source
from imitarm.cli import main
from imitarm.errors import InputError, TaskFailedError
from mediapipe_samples import SIZE, alive, line, player, seen, standing

PLACE = np.array([0.1, 0.0, 2.4])
HELLO = f"imitarm-mediapipe 1 {SIZE[0]} {SIZE[1]}"
FOREVER = "time.sleep(600)"


def frame(i, rate=30.0):
    return line(seen(standing(), PLACE, time=i / rate))


def said(*lines):
    return "\n".join(f"print({text!r}, flush=True)" for text in lines)


@pytest.fixture
def film(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"a film")
    return path


@pytest.fixture
def worker(tmp_path, monkeypatch):
    """Let a program play MediaPipe's Python."""

    def play(program):
        monkeypatch.setenv(VARIABLE, str(player(tmp_path, program)))

    return play


def test_worker_and_source_speak_the_same_version():
    assert VERSION == mediapipe.PROTOCOL


def test_skeletons_come_with_the_films_times_and_the_process_is_gone_afterwards(worker, film):
    lines = [HELLO, frame(0), "nobody 0.033333", *(frame(i) for i in range(2, 90)), "end 90"]
    worker(said(*lines))
    with open_source(f"video:{film}") as source:
        assert isinstance(source, MediaPipeSource) and source.name == "video:film.mp4"
        skeletons = list(source)
        assert source.over and source.images == 90 and source.read(0.0) is None
        assert not alive(source._process.pid)
    assert [s.time for s in skeletons] == pytest.approx([i / 30 for i in range(90) if i != 1], abs=1e-6)
    wrist = (standing()[16] + PLACE) * (-1.0, -1.0, 1.0)
    assert np.allclose([s.joint("wrist_right") for s in skeletons], wrist, atol=2e-3)
    assert {s.person for s in skeletons} == {0}


def test_the_worker_is_told_what_to_read_and_may_not_import_what_lies_around(worker, film):
    worker(said(HELLO) + "\nprint('error', *sys.argv[1:], flush=True)")
    with pytest.raises(TaskFailedError) as error:
        list(MediaPipeSource(film))
    isolated, script, kind, path = str(error.value).split(": ", 1)[1].split(";")[0].split(" ")
    assert isolated == "-I" and script.endswith("mediapipe_worker.py") and (kind, path) == ("video", str(film))
    with pytest.raises(TaskFailedError, match="webcam 3;"):
        list(MediaPipeSource(3))


@pytest.mark.parametrize(
    ("program", "error", "message"),
    [
        (said("error is not a video that can be read"), InputError, r"film\.mp4: is not a video that can be read$"),
        ("sys.exit('no module named cv2')", InputError, "does not start.*no module named cv2.*rebuild MediaPipe.s"),
        (said("hello world"), InputError, "unexpected first line: 'hello world'; rebuild"),
        (said("imitarm-mediapipe 2 1280 720"), InputError, "unexpected first line"),
        (said("imitarm-mediapipe 1 wide high"), InputError, "without an image size"),
        (said("imitarm-mediapipe 1 0 720"), InputError, "needs an image size"),
        (said(HELLO, frame(0)) + "\nos.kill(os.getpid(), signal.SIGKILL)", TaskFailedError, "end.*status -9.*1 image"),
        (said(HELLO, frame(0), "error it is cut off"), TaskFailedError, "it is cut off; 1 images were processed"),
        (said(HELLO, frame(0), "frame 0.1 1 2 3"), TaskFailedError, "sent an invalid line: 'frame 0.1 1 2 3'"),
        (said(HELLO, frame(0), frame(1)[:-3] + "nan"), TaskFailedError, "sent an invalid line"),
        (said(HELLO, frame(1), frame(0)), TaskFailedError, "sent an invalid line"),
        (said(HELLO, frame(0), "nobody soon"), TaskFailedError, "sent an invalid line"),
        (said(HELLO, frame(0), ""), TaskFailedError, "sent an invalid line: ''"),
        (said(HELLO, frame(0), "x" * 100000), TaskFailedError, "sent an invalid line: 'xxx"),
        (said(HELLO) + "\nos.write(1, os.urandom(5000))", TaskFailedError, "invalid line|gone"),
    ],
)  # fmt: skip
def test_a_worker_that_fails_is_told_from_one_that_is_done(program, error, message, worker, film):
    worker(program)
    with pytest.raises(error, match=message):
        list(MediaPipeSource(film))


def test_a_python_that_can_not_be_started_is_told(film, tmp_path):
    with pytest.raises(InputError, match=r"python: can't be started: No such file.*rebuild MediaPipe.s environment"):
        MediaPipeSource(film, python=tmp_path / "python")


def test_a_worker_that_hangs_is_ended(worker, film, monkeypatch):
    monkeypatch.setattr(mediapipe, "_SILENT", 1.0)
    worker("signal.signal(signal.SIGTERM, signal.SIG_IGN)\n" + said(HELLO, frame(0)) + "\n" + FOREVER)
    source = MediaPipeSource(film)
    assert source.read(60.0) is not None
    time.sleep(1.2)  # nobody asks: that is no silence
    assert source.read(0.1) is None
    with pytest.raises(TaskFailedError, match=r"sent nothing for 1 s"):
        source.read(60.0)
    assert source.over and not alive(source._process.pid)
    monkeypatch.setattr(mediapipe, "_START", 0.3)
    worker(FOREVER)
    with pytest.raises(InputError, match=r"no image within 0\.3 s"):
        MediaPipeSource(film)


def test_close_and_the_last_reference_end_the_worker(worker, film):
    worker(said(HELLO, *(frame(i) for i in range(300))) + "\n" + FOREVER)
    source = MediaPipeSource(film)
    source.read()
    source.close()
    source.close()
    assert source.over and source.read(0.0) is None and not alive(source._process.pid)
    source = MediaPipeSource(film)
    pid = source._process.pid
    del source
    gc.collect()
    assert not alive(pid)


def test_a_webcam_gives_its_newest_picture(worker):
    worker(said(HELLO, *(frame(i) for i in range(500))) + "\n" + FOREVER)
    with MediaPipeSource(0) as source:
        assert source.name == "webcam:0"
        late = source.read()
        time.sleep(1.0)  # a retargeter that is late
        until = time.monotonic() + 120.0
        while late.time < 499 / 30 - 1e-6 and time.monotonic() < until:
            late = source.read(1.0) or late
        assert late.time == pytest.approx(499 / 30, abs=1e-6) and source.images < 500


def test_realtime_gives_a_film_at_its_own_pace(worker, film):
    worker(said(HELLO, *(frame(i) for i in (0, 30, 33, 36)), "end 4"))
    with open_source(f"video:{film}", realtime=True) as source:
        assert source.read().time == 0.0
        began = time.monotonic()
        assert source.read(0.0) is None
        assert [s.time for s in source] == pytest.approx([1.0, 1.1, 1.2], abs=1e-6)
        assert time.monotonic() - began >= 1.1  # 1.2 s less what went by before


def test_no_person_at_all_is_said_by_the_command(worker, film, tmp_path, capsys):
    worker(said(HELLO, "nobody 0.0", "nobody 0.1", "end 2"))
    out = tmp_path / "out.csv"
    assert main(["capture", f"video:{film}", "--out", str(out)]) == 1
    assert "nobody was seen" in capsys.readouterr().err and not out.exists()


def test_a_film_that_is_cut_off_loses_nothing(worker, film, tmp_path, capsys):
    worker(said(HELLO, *(frame(i) for i in range(20)), "error ends after 20 of 90 pictures"))
    out = tmp_path / "out.csv"
    assert main(["capture", f"video:{film}", "--out", str(out)]) == 1
    assert "ends after 20 of 90 pictures; 20 images were processed before" in capsys.readouterr().err
    assert len(list(open_source(out))) == 20
