from __future__ import annotations

import ast
import io
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from imitarm.capture import mediapipe_worker as worker
from imitarm.capture.mediapipe import N_LANDMARKS

PICTURE = np.zeros((72, 128, 3), np.uint8)


class Camera:
    """OpenCV's VideoCapture, for a film or a webcam that the test describes."""

    def __init__(self, name):
        self.film = self.films.get(name)
        self.at, self.released = -1, False

    def isOpened(self):
        return self.film is not None

    def get(self, key):
        times = self.film["times"]
        if key == "position":
            return 1000.0 * times[self.at] if times else 0.0
        return self.film.get(key, 0.0)

    def read(self):
        self.at += 1
        time.sleep(self.film.get("pause", 0.0))
        if self.at > self.film["pictures"] + 100:
            threading.Event().wait()  # the thread of a webcam that the test has left sleeps on
        return (True, PICTURE) if self.at < self.film["pictures"] else (False, None)

    def release(self):
        self.released = True


@pytest.fixture
def libraries(monkeypatch):
    """OpenCV and MediaPipe as the worker meets them; a person is in every picture but the second."""
    cv2, mediapipe = ModuleType("cv2"), ModuleType("mediapipe")
    cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_POS_MSEC = "rate", "announced", "position"
    cv2.COLOR_BGR2RGB, cv2.cvtColor = 4, lambda picture, _: picture
    Camera.films = {}
    cv2.VideoCapture = Camera
    world = SimpleNamespace(landmark=[SimpleNamespace(x=i, y=0.5, z=-1.0, visibility=0.25) for i in range(N_LANDMARKS)])
    image = SimpleNamespace(landmark=[SimpleNamespace(x=0.1, y=0.2, z=9.0, visibility=9.0) for _ in range(N_LANDMARKS)])

    class Pose:
        def __init__(self, **options):
            assert options["model_complexity"] == 1
            self.count = 0

        def process(self, picture):
            self.count += 1
            found = self.count != 2
            return SimpleNamespace(
                pose_world_landmarks=world if found else None, pose_landmarks=image if found else None
            )

    mediapipe.solutions = SimpleNamespace(pose=SimpleNamespace(Pose=Pose))
    monkeypatch.setitem(sys.modules, "cv2", cv2)
    monkeypatch.setitem(sys.modules, "mediapipe", mediapipe)
    return SimpleNamespace(cv2=cv2, mediapipe=mediapipe, films=Camera.films)


def lines(*arguments):
    out = io.StringIO()
    status = worker.main(list(arguments), out)
    return status, out.getvalue().splitlines()


def test_it_needs_nothing_of_imitarm_and_runs_on_python_3_9():
    source = Path(worker.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 9))
    imported = {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert imported <= {"__future__", "importlib", "os", "signal", "sys", "threading", "time", "typing"}


def test_a_film_becomes_lines(libraries):
    libraries.films["a.mp4"] = {"pictures": 3, "announced": 3, "rate": 25.0, "times": [0.0, 0.04, 0.08]}
    status, said = lines("video", "a.mp4")
    assert status == 0
    assert said[0] == "imitarm-mediapipe 1 128 72" and said[2] == "nobody 0.040000" and said[4] == "end 3"
    words = said[3].split(" ")
    assert words[:2] == ["frame", "0.080000"] and len(words) == 2 + 6 * N_LANDMARKS
    numbers = np.array(words[2:], dtype=float).reshape(N_LANDMARKS, 6)
    assert np.allclose(numbers[:, 0], range(N_LANDMARKS)) and np.allclose(numbers[:, 1:], [0.5, -1.0, 0.1, 0.2, 0.25])


@pytest.mark.parametrize(
    ("film", "expected"),
    [
        ({"times": [], "rate": 20.0}, [0.0, 0.05, 0.1, 0.15]),  # no times of its own
        ({"times": [0.0, 0.1, 0.1, 0.3], "rate": 20.0}, [0.0, 0.1, 0.15, 0.3]),  # one twice
        ({"times": [0.0, 0.1, 0.0, 0.01], "rate": 20.0}, [0.0, 0.1, 0.15, 0.2]),  # begins anew
    ],
)
def test_times_always_increase(film, expected, libraries):
    libraries.films["a.avi"] = {"pictures": 4, **film}
    _, said = lines("video", "a.avi")
    assert [float(line.split(" ")[1]) for line in said[1:-1]] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("film", "message"),
    [
        (None, "error is not a video that can be read"),
        ({"pictures": 0, "times": []}, "error the video contains no image"),
        ({"pictures": 4, "times": [], "rate": 0.0}, "error has neither time stamps nor a frame rate"),
        ({"pictures": 40, "announced": 100, "rate": 30.0, "times": []}, "error ends after 40 of 100 images"),
    ],
)
def test_what_is_no_film_says_so_last(film, message, libraries):
    libraries.films["a.mp4"] = film
    status, said = lines("video", "a.mp4")
    assert status == 1 and said[-1].startswith(message)


def test_a_webcam_gives_pictures_until_it_is_gone(libraries, monkeypatch):
    monkeypatch.setattr(worker, "_SILENT", 2.0)
    libraries.films[0] = {"pictures": 3, "times": [], "pause": 0.05}
    before = time.monotonic()
    status, said = lines("webcam", "0")
    times = [float(line.split(" ")[1]) for line in said[1:-1]]
    assert status == 1 and "camera 0 no longer delivers images" in said[-1]
    assert 1 <= len(times) <= 3 and times == sorted(times)
    assert before <= times[0] and times[-1] <= time.monotonic()
    assert lines("webcam", "1")[1] == ["error there is no camera number 1, or another program uses it"]


def test_a_mediapipe_that_will_not_do_is_named(libraries, monkeypatch):
    libraries.mediapipe.__version__ = "1.0"
    del libraries.mediapipe.solutions
    assert "mediapipe 1.0 has no module 'solutions'" in lines("video", "a.mp4")[1][0]
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert "has no usable cv2" in lines("video", "a.mp4")[1][0]
    assert "expected arguments: video FILE" in lines("film")[1][0]


def test_an_unforeseen_failure_is_one_line_and_a_traceback_for_the_log(libraries):
    libraries.films["a.mp4"] = {"pictures": 1, "times": [0.0]}
    libraries.cv2.cvtColor = lambda *_: 1 / 0
    out = io.StringIO()
    with pytest.raises(ZeroDivisionError):
        worker.main(["video", "a.mp4"], out)
    assert out.getvalue().splitlines()[-1] == "error ZeroDivisionError: division by zero"


def test_it_ends_with_the_one_who_started_it():
    left = threading.Event()
    worker._end_with(io.StringIO(""), lambda _: left.set())
    assert left.is_set()
