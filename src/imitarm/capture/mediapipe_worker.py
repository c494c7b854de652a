"""The process that runs MediaPipe: it reads images and writes landmarks as lines of text.

The process runs in another Python environment (3.9 to 3.12) that has mediapipe 0.10.21 but not imitarm, so this file
must not import imitarm. The class ``MediaPipeSource`` of imitarm starts the process and reads its standard output.

Each line of the output has one of these forms:

* ``imitarm-mediapipe 1 WIDTH HEIGHT`` is the first line. The process writes this line when it has read the first image.
  The line contains the version of this protocol and the size of the images in pixels.
* ``frame TIME NUMBERS`` is an image with a person. For each of 33 landmarks, NUMBERS contains the world position x y z
  [m], the image position x y (0 to 1) and the visibility.
* ``nobody TIME`` is an image without a person.
* ``end IMAGES`` is the last line of a video and contains the number of images.
* ``error TEXT`` is the last line if the process can't continue.

For a video, TIME is the time in the video. For a webcam, TIME is the time at which the image arrived, measured by
``time.monotonic``.

To start the process by hand, run::

    .venv-mediapipe/bin/python -I src/imitarm/capture/mediapipe_worker.py video FILE
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
from typing import Any, Callable, Iterator, TextIO  # noqa: UP035 (runs on Python 3.9 too)

VERSION = 1
_SILENT = 5.0  # [s] without an image: the webcam is gone
_WHOLE = 0.9  # least fraction of the announced images: their number is an estimate in some kinds of file
_SLIP = 1e-4  # [s] each image must be later than the one before by more than this


class StopError(Exception):
    """Raised when the process must stop; the text is the reason, in one line."""


def main(arguments: list[str], out: TextIO) -> int:
    """Write the landmarks of ``video FILE`` or ``webcam NUMBER``; return the exit status."""
    try:
        if len(arguments) != 2 or arguments[0] not in {"video", "webcam"}:
            raise StopError("expected arguments: video FILE, or webcam NUMBER")
        cv2, pose = _imported("cv2"), _pose(_imported("mediapipe"))
        images = _film(cv2, arguments[1]) if arguments[0] == "video" else _webcam(cv2, int(arguments[1]))
        count = -1
        for count, (when, image) in enumerate(images):
            if count == 0:
                height, width = image.shape[:2]
                _say(out, f"imitarm-mediapipe {VERSION} {width} {height}")
            _say(out, _line(when, pose.process(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))))
        if count < 0:
            raise StopError("the video contains no image")
        _say(out, f"end {count + 1}")
        return 0
    except StopError as error:
        _say(out, f"error {error}")
        return 1
    except Exception as error:
        _say(out, f"error {type(error).__name__}: {' '.join(str(error).split())[:500]}")
        raise


def _say(out: TextIO, line: str) -> None:
    out.write(line + "\n")
    out.flush()


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise StopError(f"{sys.executable} has no usable {name}: {' '.join(str(error).split())[:300]}") from error


def _pose(mediapipe: Any) -> Any:
    """Return a pose tracker with model 1, which is part of the package; models 0 and 2 would be downloaded."""
    if not hasattr(mediapipe, "solutions"):
        version = getattr(mediapipe, "__version__", "of unknown version")
        raise StopError(f"mediapipe {version} has no module 'solutions' with the models; version 0.10.21 is needed")
    return mediapipe.solutions.pose.Pose(model_complexity=1, smooth_landmarks=True)


def _line(when: float, result: Any) -> str:
    if not (result.pose_world_landmarks and result.pose_landmarks):
        return f"nobody {when:.6f}"
    pairs = zip(result.pose_world_landmarks.landmark, result.pose_landmarks.landmark)  # noqa: B905 (Python 3.9)
    numbers = (
        f"{w.x:.5f} {w.y:.5f} {w.z:.5f} {i.x:.5f} {i.y:.5f} {min(max(w.visibility, 0.0), 1.0):.3f}" for w, i in pairs
    )
    return f"frame {when:.6f} " + " ".join(numbers)


def _film(cv2: Any, path: str) -> Iterator[tuple[float, Any]]:
    """Yield each image of a video with its time [s]; the times always increase."""
    film = cv2.VideoCapture(path)
    if not film.isOpened():
        raise StopError("is not a video that can be read (damaged, cut off, or of an unknown kind)")
    rate, announced = film.get(cv2.CAP_PROP_FPS), film.get(cv2.CAP_PROP_FRAME_COUNT)
    period = 1.0 / rate if 0.5 <= rate <= 1000.0 else None
    last, count = None, 0
    try:
        while True:
            known, image = film.read()
            if not known:
                if 0 < count < _WHOLE * announced:
                    raise StopError(
                        f"ends after {count} of {announced:.0f} images: the file is cut off or damaged there"
                    )
                return
            count += 1
            when = film.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
            if last is not None and when <= last + _SLIP:  # a file without times of its own
                if period is None:
                    raise StopError("has neither time stamps nor a frame rate; convert it, for example to mp4")
                when = last + period
            last = when
            yield when, image
    finally:
        film.release()


def _webcam(cv2: Any, number: int) -> Iterator[tuple[float, Any]]:
    """Yield each new image of a webcam and the time at which it arrived [s]."""
    camera = cv2.VideoCapture(number)
    if not camera.isOpened():
        raise StopError(f"there is no camera number {number}, or another program uses it")
    latest: list[Any] = [None, 0.0]
    came = threading.Condition()

    def watch() -> None:  # in a thread, so that images that came while the tracker worked don't pile up
        while True:
            known, image = camera.read()
            if not known:
                time.sleep(0.02)
                continue
            with came:
                latest[:] = image, time.monotonic()
                came.notify()

    threading.Thread(target=watch, daemon=True).start()
    while True:
        with came:
            if not came.wait_for(lambda: latest[0] is not None, _SILENT):
                raise StopError(f"camera {number} no longer delivers images; is it still plugged in?")
            image, when = latest
            latest[0] = None
        yield when, image


def _end_with(parent: TextIO, leave: Callable[[int], Any] = os._exit) -> None:
    """End this process as soon as its standard input is closed, which also happens when its parent process ends."""
    parent.read()
    leave(0)


def _start() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one
    os.environ.setdefault("MPLBACKEND", "Agg")
    out = os.fdopen(os.dup(1), "w", encoding="utf-8", newline="\n")
    os.dup2(2, 1)  # output of libraries must not come between the lines
    threading.Thread(target=_end_with, args=(sys.stdin,), daemon=True).start()
    try:
        status = main(sys.argv[1:], out)
    except BrokenPipeError:
        status = 0
    os._exit(status)  # without waiting for a thread that a camera holds


if __name__ == "__main__":
    sys.exit(_start())
