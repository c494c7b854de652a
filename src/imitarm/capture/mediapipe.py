"""MediaPipeSource: skeletons of a person in a video or before a webcam, by MediaPipe in a process of its own."""

from __future__ import annotations

import importlib.resources
import time as clock
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from imitarm.capture.line_process import LineProcess
from imitarm.capture.mediapipe_environment import find_python
from imitarm.capture.mediapipe_landmarks import FIELD_OF_VIEW, N_LANDMARKS, LandmarkConverter, Landmarks
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.errors import InputError, TaskFailedError

PROTOCOL = 1
"""Version of the lines that are spoken; :mod:`imitarm.capture.mediapipe_worker` has them."""

_START = 60.0  # [s] in which the first picture must be through: the first start of all reads 400 MB
_SILENT = 20.0  # [s] after which a process without a word hangs
_TICK = 0.01  # [s] more, so that the time is over and not just about
_KEPT = 64  # pictures of a video that are tracked ahead
_NUMBERS = 6 * N_LANDMARKS
_ANEW = "make its environment anew: python -m imitarm.capture.mediapipe_environment"
_CHATTER = r"[IW]\d{4} |INFO: |WARNING: All log messages"  # what MediaPipe logs when all is well


class MediaPipeSource(SkeletonSource):
    """Skeletons of the person in a video, or before a webcam.

    MediaPipe tracks one person. It runs in another process, in another environment (see
    :mod:`imitarm.capture.mediapipe_environment`), and sends its landmarks as lines of text; what it makes of them is
    said in :class:`LandmarkConverter`. Times are the video's own, from zero; a webcam's are those of the monotonic
    clock when a picture came.

    Args:
        film: a video file, or the number of a webcam.
        realtime: give a video's skeletons not before their times; else as fast as they are tracked.
        field_of_view: of the longer side of the picture [deg].
        python: that has MediaPipe; None: the one that is found.

    Attributes:
        pictures: how many were looked at so far.

    Raises:
        InputError: when MediaPipe is not there, the file is no video, or there is no such webcam.
        TaskFailedError: from :meth:`read` too: when MediaPipe's process dies, hangs or speaks nonsense, the video is
            cut off, or the webcam is gone. What came before is good.
    """

    def __init__(
        self,
        film: str | Path | int,
        *,
        realtime: bool = False,
        field_of_view: float = FIELD_OF_VIEW,
        python: Path | None = None,
    ) -> None:
        webcam = isinstance(film, int)
        if isinstance(film, int):
            self.name = self._said = f"webcam:{film}"
            what = ["webcam", str(film)]
        else:
            self.name, self._said = f"video:{Path(film).name}", str(film)
            what = ["video", str(Path(film).resolve())]
        self.pictures = 0
        self._over, self._silent, self._last = False, 0.0, -np.inf
        self._realtime, self._began = realtime and not webcam, -np.inf
        self._next: Skeleton | None = None
        chosen = find_python() if python is None else python
        with ExitStack() as stack:
            worker = importlib.resources.files("imitarm.capture").joinpath("mediapipe_worker.py")
            path = stack.enter_context(importlib.resources.as_file(worker))
            try:  # -I: neither this folder nor the user's own packages are searched for modules
                self._process = LineProcess(
                    [chosen, "-I", path, *what], keep=1 if webcam else _KEPT, newest=webcam, chatter=_CHATTER
                )
            except OSError as error:
                raise InputError(f"{chosen}: can't be started: {error.strerror or error}; {_ANEW}") from error
            try:
                size = self._greeting(chosen)
                self._converter = LandmarkConverter(size, field_of_view)
            except BaseException:
                self.close()
                raise

    @property
    def over(self) -> bool:
        """Whether the video is over, or the source closed."""
        return self._over

    def close(self) -> None:
        """End MediaPipe's process; a second call does nothing."""
        self._over = True
        self._process.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton, or None when none came within ``timeout`` seconds or the source is over."""
        until = clock.monotonic() + timeout
        while not self._over:
            if self._next is None:
                line = self._line(max(until - clock.monotonic(), 0.0))
                self._next = None if line is None else self._understood(line)
            if self._next is not None and self._due(self._next.time, until):
                skeleton, self._next = self._next, None
                return skeleton
            if clock.monotonic() >= until:
                break
        return None

    def _due(self, time: float, until: float) -> bool:
        """Wait until a skeleton's time has come, if that is asked for; False when that is later than ``until``."""
        if not self._realtime:
            return True
        if self._began == -np.inf:
            self._began = clock.monotonic() - time
        wait = self._began + time - clock.monotonic()
        clock.sleep(max(min(wait, until - clock.monotonic()), 0.0))
        return wait <= 0.0 or clock.monotonic() >= self._began + time

    def _line(self, timeout: float) -> list[bytes] | None:
        """Return the next line's words; None when none came in time."""
        before = clock.monotonic()
        try:
            line = self._process.line(min(timeout, max(_SILENT - self._silent, 0.0) + _TICK))
        except EOFError:
            raise self._failed(f"MediaPipe's process is gone ({self._process.ended()})") from None
        if line is not None:
            self._silent = 0.0
            return line.split(b" ")
        self._silent += clock.monotonic() - before  # only waiting counts: nobody may have asked for long
        if self._silent > _SILENT:
            raise self._failed(f"MediaPipe's process has said nothing for {_SILENT:g} s; it was ended")
        return None

    def _greeting(self, python: Path) -> tuple[int, int]:
        """Return width and height of the pictures, which is what the process says first."""
        until = clock.monotonic() + _START
        try:
            line = self._process.line(_START)
        except EOFError:
            raise InputError(
                f"{self._said}: MediaPipe does not start with {python} ({self._process.ended()}); {_ANEW}"
            ) from None
        if line is None or clock.monotonic() > until:
            raise InputError(f"{self._said}: no picture within {_START:g} s; MediaPipe's process was ended")
        words = line.split(b" ")
        if words[0] == b"error":
            raise InputError(f"{self._said}: {_text(words[1:])}")
        if words[:2] != [b"imitarm-mediapipe", str(PROTOCOL).encode()] or len(words) != 4:
            raise InputError(f"{python} does not speak as MediaPipe's process should: {_text(words)[:80]!r}")
        if not (words[2].isdigit() and words[3].isdigit()):
            raise InputError(f"{python} gives no size of the pictures: {_text(words)[:80]!r}")
        return int(words[2]), int(words[3])

    def _understood(self, words: list[bytes]) -> Skeleton | None:
        """Return the skeleton in a line, None when there is nobody in the picture; know when it is the last."""
        kind = words[0]
        if kind == b"error":
            raise self._failed(_text(words[1:]))
        if kind == b"end" and len(words) == 2:
            self.close()
            return None
        try:
            numbers = np.array(words[1:], dtype=float)
        except ValueError:
            numbers = np.empty(0)
        n = {b"frame": 1 + _NUMBERS, b"nobody": 1}.get(kind, -1)
        if len(numbers) != n or not np.isfinite(numbers).all() or numbers[0] <= self._last:
            raise self._failed(f"MediaPipe's process sent what is no line of landmarks: {_text(words)[:80]!r}")
        self._last = float(numbers[0])
        self.pictures += 1
        if kind == b"nobody":
            return None
        each = numbers[1:].reshape(N_LANDMARKS, 6)
        return self._converter.skeleton(Landmarks(self._last, each[:, :3], each[:, 3:5], each[:, 5]))

    def _failed(self, why: str) -> TaskFailedError:
        """Close, and return the error that says why."""
        self.close()
        return TaskFailedError(f"{self._said}: {why}; {self.pictures} pictures were good")


def _text(words: list[bytes]) -> str:
    return b" ".join(words).decode("utf-8", "replace")
