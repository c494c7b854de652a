r"""MediaPipe: skeletons of a person in a video or in front of a webcam, converted from MediaPipe's 33 landmarks.

MediaPipe reports two positions of each landmark: in the image, and in metres relative to the middle of the hips (x to
the image's right, y down, z away). The position in metres assumes a camera that looks straight at the person. The
sensor frame of :class:`~imitarm.capture.skeleton.Skeleton` (x to the sensor's left, y up, z away) is MediaPipe's frame
rotated by 180 degrees about z.
"""

from __future__ import annotations

import importlib.resources
import math
import time as clock
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.mediapipe_environment import LineProcess, find_python
from imitarm.capture.skeleton import JOINTS, SIDES, Skeleton, SkeletonSource, Tracking, number_after_colon
from imitarm.errors import InputError, TaskFailedError

Array = NDArray[np.float64]

N_LANDMARKS = 33
FIELD_OF_VIEW = 60.0  # [deg] of the longer side of the image: phones and webcams have 55 to 70
TRACKED, INFERRED = 0.5, 0.1  # least visibility of a landmark whose joint is tracked, inferred
DEPTH_MEMORY = 0.1  # [s] over which the distance is averaged
_GAP = 0.5  # [s] after a longer gap the earlier distance is not used
_NEAREST, _FARTHEST = 0.3, 15.0  # [m] plausible distances of a person
_TIP = 1.8  # distance from wrist to finger tip over that from wrist to knuckles
_FITTED = np.array([11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28])  # shoulders to wrists, hips to ankles
_ROUNDS = 3  # place and line of sight depend on each other: three rounds make them agree to a millimetre
_LEAST_WEIGHT = 2.0  # sum of the visibilities needed to locate a person


def _joint_weights() -> Array:
    """Return the weights, shape (25, 33), that compute joints from landmarks: joints = weights @ landmarks."""
    mixed: dict[str, dict[int, float]] = {
        "spine_base": {23: 0.5, 24: 0.5},
        "spine_mid": {11: 0.25, 12: 0.25, 23: 0.25, 24: 0.25},
        "spine_shoulder": {11: 0.5, 12: 0.5},
        "neck": {11: 1 / 3, 12: 1 / 3, 7: 1 / 6, 8: 1 / 6},  # a third of the way from the shoulders to the head
        "head": {7: 0.5, 8: 0.5},  # between the ears
    }
    for i, side in enumerate(SIDES):
        wrist, little, index = 15 + i, 17 + i, 19 + i
        named = {"shoulder": 11, "elbow": 13, "wrist": 15, "thumb": 21, "hip": 23, "knee": 25, "ankle": 27, "foot": 31}
        mixed |= {f"{part}_{side}": {first + i: 1.0} for part, first in named.items()}
        mixed[f"hand_{side}"] = {wrist: 0.2, little: 0.4, index: 0.4}  # the palm, short of the knuckles
        mixed[f"hand_tip_{side}"] = {wrist: 1.0 - _TIP, little: 0.5 * _TIP, index: 0.5 * _TIP}
    weights = np.zeros((len(JOINTS), N_LANDMARKS))
    for row, name in enumerate(JOINTS):
        for landmark, weight in mixed[name].items():
            weights[row, landmark] = weight
    return weights


_WEIGHTS = _joint_weights()
_USED = _WEIGHTS != 0.0
_TO_SENSOR = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class PoseLandmarks:
    """The landmarks that MediaPipe found in one image.

    Attributes:
        time: time of the image [s].
        world: positions relative to the middle of the hips (x to the image's right, y down, z away), shape (33, 3) [m].
        image: positions in the image, from 0 (left, top) to 1 (right, bottom), shape (33, 2). A landmark outside the
            image has a position below 0 or above 1.
        visibility: visibility of each landmark, 0 to 1, shape (33,).

    Raises:
        InputError: when a shape is wrong or a value is not finite.
    """

    time: float
    world: Array
    image: Array
    visibility: Array

    def __post_init__(self) -> None:
        n = N_LANDMARKS
        if self.world.shape != (n, 3) or self.image.shape != (n, 2) or self.visibility.shape != (n,):
            raise InputError(
                f"PoseLandmarks: needs {n} landmarks, with 3 numbers each in world, 2 in image and 1 in visibility"
            )
        finite = all(np.isfinite(part).all() for part in (self.time, self.world, self.image, self.visibility))
        if not finite:
            raise InputError("PoseLandmarks: time, world, image and visibility must be finite numbers")


class LandmarkConverter:
    r"""Converts landmarks to skeletons.

    **Position.** MediaPipe's positions in metres are relative to the hips. Without a correction, a hand at rest would
    therefore seem to move whenever the hips move. The translation t of the hips is chosen so that the projections of
    the landmarks :math:`X_j, Y_j, Z_j` [m] lie at their positions in the image. Let :math:`u_j, v_j` be the coordinates
    of landmark j relative to the image's middle, in units of the focal length. Let :math:`k_j` be the visibility of the
    landmark, from 0 to 1. The translation t solves

    .. math:: \min_t \sum_j k_j^2 \left( (X_j + t_x - u_j (Z_j + t_z))^2 + (Y_j + t_y - v_j (Z_j + t_z))^2 \right)

    Across the line of sight, t is accurate to centimetres. Along the line of sight, t is noisy, and its accuracy
    depends on MediaPipe's scale and on the field of view. The distance along the line of sight is therefore averaged
    over 0.1 s, and the other two components of t are then fitted again. The same t is added to the positions of all
    joints.

    **Perspective.** MediaPipe's positions in metres assume a camera that looks straight at the person. The positions
    are therefore rotated by the angle between the camera's axis and the line of sight to the hips.

    Args:
        size: width and height of the image [pixels]; only their ratio matters.
        field_of_view: field of view of the longer side [deg].

    Raises:
        InputError: when the size is not positive, or the field of view is not between 10 and 150 degrees.
    """

    def __init__(self, size: tuple[int, int], field_of_view: float = FIELD_OF_VIEW) -> None:
        if not (min(size) > 0 and 10.0 <= field_of_view <= 150.0):
            raise InputError(
                f"LandmarkConverter: needs an image size and a field of view of 10 to 150 degrees, got {size} and "
                f"{field_of_view!r}"
            )
        focal = 0.5 * max(size) / math.tan(math.radians(0.5 * field_of_view))
        self._scale = np.array(size, dtype=float) / focal
        self._distance: tuple[float, float] | None = None  # time and t_z of the image before

    def skeleton(self, landmarks: PoseLandmarks) -> Skeleton | None:
        """Return the skeleton; None when the person can't be located.

        The person can't be located if too few landmarks are visible, or if the computed distance is not between 0.3 and
        15 m.

        The position of a joint is a weighted sum of the positions of one or more landmarks. The least visible of these
        landmarks determines whether the joint is tracked, inferred or lost. A joint outside the image is inferred or
        lost. MediaPipe does not detect whether a hand is open or closed, so hand states are unknown.
        """
        uv = (landmarks.image - 0.5) * self._scale
        world, place = landmarks.world, None
        for _ in range(_ROUNDS):
            place = self._fit(world, uv, landmarks.visibility)
            if place is None:
                self._distance = None
                return None
            world = landmarks.world @ _rotation_towards(place).T
        assert place is not None
        depth = self._averaged(landmarks.time, place[2])
        weight = np.square(landmarks.visibility[_FITTED])[:, None]
        seen = uv[_FITTED] * (world[_FITTED, 2:] + depth) - world[_FITTED, :2]
        across = (weight * seen).sum(axis=0) / weight.sum()
        positions = _WEIGHTS @ (world + np.append(across, depth))
        return Skeleton(landmarks.time, positions * _TO_SENSOR, _tracking(landmarks))

    @staticmethod
    def _fit(world: Array, uv: Array, visibility: Array) -> Array | None:
        """Return the translation t of the hips relative to the camera, shape (3,) [m]; None if no translation fits."""
        weight = visibility[_FITTED]
        if weight.sum() < _LEAST_WEIGHT:
            return None
        u, x = uv[_FITTED], world[_FITTED]
        n = len(_FITTED)
        rows, sides = np.zeros((2, n, 3)), np.empty((2, n))
        for axis in (0, 1):
            rows[axis, :, axis] = weight
            rows[axis, :, 2] = -weight * u[:, axis]
            sides[axis] = weight * (u[:, axis] * x[:, 2] - x[:, axis])
        place = np.linalg.lstsq(rows.reshape(-1, 3), sides.ravel(), rcond=None)[0]
        if not _NEAREST <= place[2] <= _FARTHEST:
            return None
        return np.asarray(place)

    def _averaged(self, time: float, depth: float) -> float:
        """Return the distance from the camera to the hips, averaged over the last images [m]."""
        if self._distance is not None and 0.0 < time - self._distance[0] <= _GAP:
            before, past = self._distance
            depth = past + (1.0 - math.exp(-(time - before) / DEPTH_MEMORY)) * (depth - past)
        self._distance = (time, depth)
        return depth


def _rotation_towards(place: Array) -> Array:
    """Return the rotation from the camera's axis to the line of sight to a point, shape (3, 3)."""
    x, y, z = place / math.sqrt(float(place @ place))
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + z))


def _tracking(landmarks: PoseLandmarks) -> NDArray[np.int8]:
    """Return the tracking state of each joint, shape (25,)."""
    inside = ((landmarks.image >= 0.0) & (landmarks.image <= 1.0)).all(axis=1)
    known = (landmarks.visibility >= INFERRED).astype(np.int8)
    known += (landmarks.visibility >= TRACKED) & inside
    return np.asarray(np.where(_USED, known, Tracking.TRACKED).min(axis=1), dtype=np.int8)


# --- the process that runs MediaPipe

PROTOCOL = 1
"""Version of the text protocol; :mod:`imitarm.capture.mediapipe_worker` describes it."""

_START = 60.0  # [s] within which the first image must be processed: the very first start reads 400 MB
_SILENT = 20.0  # [s] without a line: the process hangs
_TICK = 0.01  # [s] added to a wait, so that the time is certainly over
_KEPT = 64  # images of a video that are processed ahead
_NUMBERS = 6 * N_LANDMARKS
_ANEW = "rebuild MediaPipe's environment: python -m imitarm.capture.mediapipe_environment"
_CHATTER = r"[IW]\d{4} |INFO: |WARNING: All log messages"  # what MediaPipe logs when all is well


class MediaPipeSource(SkeletonSource):
    """Skeletons of the person in a video or in front of a webcam.

    MediaPipe runs in its own process and its own Python environment (see :mod:`imitarm.capture.mediapipe_environment`).
    MediaPipe tracks only one person. The process sends landmarks as lines of text, and :class:`LandmarkConverter`
    converts the landmarks to skeletons. For a video, the times of the skeletons start at the beginning of the video.
    For a webcam, the time of a skeleton is the time at which the image arrived, measured by ``time.monotonic``.

    Args:
        film: path of a video file, or the number of a webcam.
        realtime: for videos only. True: return the skeletons at the speed of the video. False: return the skeletons as
            fast as MediaPipe tracks the person.
        field_of_view: field of view of the longer side of the image [deg].
        python: Python interpreter in whose environment MediaPipe is installed; None: the interpreter that
            :func:`~imitarm.capture.mediapipe_environment.find_python` finds.

    Attributes:
        images: number of images processed so far.

    Raises:
        InputError: when MediaPipe is not installed, the file is not a video, or there is no such webcam.
        TaskFailedError: from :meth:`read`, when MediaPipe's process dies, hangs or sends invalid lines, when the video
            is cut off, or when the webcam is unplugged.
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
            self.name = self._shown_name = f"webcam:{film}"
            what = ["webcam", str(film)]
        else:
            self.name, self._shown_name = f"video:{Path(film).name}", str(film)
            what = ["video", str(Path(film).resolve())]
        self.images = 0
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
        """Whether the video has ended or the source is closed."""
        return self._over

    def close(self) -> None:
        """End MediaPipe's process; a second call does nothing."""
        self._over = True
        self._process.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None if none arrives within ``timeout`` seconds, or if the source has ended."""
        until = clock.monotonic() + timeout
        while not self._over:
            if self._next is None:
                line = self._line(max(until - clock.monotonic(), 0.0))
                self._next = None if line is None else self._parsed(line)
            if self._next is not None and self._due(self._next.time, until):
                skeleton, self._next = self._next, None
                return skeleton
            if clock.monotonic() >= until:
                break
        return None

    def _due(self, time: float, until: float) -> bool:
        """Wait until a skeleton is due in real time, but not longer than ``until``; return whether it is due."""
        if not self._realtime:
            return True
        if self._began == -np.inf:
            self._began = clock.monotonic() - time
        wait = self._began + time - clock.monotonic()
        clock.sleep(max(min(wait, until - clock.monotonic()), 0.0))
        return wait <= 0.0 or clock.monotonic() >= self._began + time

    def _line(self, timeout: float) -> list[bytes] | None:
        """Return the words of the next line from MediaPipe's process; None when no line arrived in time."""
        before = clock.monotonic()
        try:
            line = self._process.line(min(timeout, max(_SILENT - self._silent, 0.0) + _TICK))
        except EOFError:
            raise self._failed(f"MediaPipe's process has ended ({self._process.ended()})") from None
        if line is not None:
            self._silent = 0.0
            return line.split(b" ")
        self._silent += clock.monotonic() - before  # only waiting counts: the caller may have been busy elsewhere
        if self._silent > _SILENT:
            raise self._failed(f"MediaPipe's process has sent nothing for {_SILENT:g} s, and was ended")
        return None

    def _greeting(self, python: Path) -> tuple[int, int]:
        """Return width and height of the images, which MediaPipe's process sends in its first line."""
        until = clock.monotonic() + _START
        try:
            line = self._process.line(_START)
        except EOFError:
            raise InputError(
                f"{self._shown_name}: MediaPipe does not start with {python} ({self._process.ended()}); {_ANEW}"
            ) from None
        if line is None or clock.monotonic() > until:
            raise InputError(
                f"{self._shown_name}: MediaPipe processed no image within {_START:g} s, and was ended; try again"
            )
        words = line.split(b" ")
        if words[0] == b"error":
            raise InputError(f"{self._shown_name}: {_text(words[1:])}")
        if words[:2] != [b"imitarm-mediapipe", str(PROTOCOL).encode()] or len(words) != 4:
            raise InputError(f"{python} sent an unexpected first line: {_text(words)[:80]!r}; {_ANEW}")
        if not (words[2].isdigit() and words[3].isdigit()):
            raise InputError(f"{python} sent a first line without an image size: {_text(words)[:80]!r}; {_ANEW}")
        return int(words[2]), int(words[3])

    def _parsed(self, words: list[bytes]) -> Skeleton | None:
        """Return the skeleton in a line, or None when the image shows nobody; close the source after the last line."""
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
            raise self._failed(f"MediaPipe's process sent an invalid line: {_text(words)[:80]!r}")
        self._last = float(numbers[0])
        self.images += 1
        if kind == b"nobody":
            return None
        each = numbers[1:].reshape(N_LANDMARKS, 6)
        return self._converter.skeleton(PoseLandmarks(self._last, each[:, :3], each[:, 3:5], each[:, 5]))

    def _failed(self, why: str) -> TaskFailedError:
        """Close the source, and return the error to raise."""
        self.close()
        return TaskFailedError(f"{self._shown_name}: {why}; {self.images} images were processed before this failure")


class VideoSource(MediaPipeSource):
    """Skeletons of the person in a video file."""

    argument = "FILE"
    description = "the person in a video, by MediaPipe"
    has_realtime = True

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> VideoSource:
        """Open the video file ``argument``; the command line calls this source ``video:FILE``.

        Raises:
            InputError: when the file does not exist or is not a video, or when MediaPipe is not installed.
        """
        if not Path(argument).is_file():
            raise InputError(f"source video:{argument}: there is no such file; check the path")
        return cls(argument, realtime=realtime)


class WebcamSource(MediaPipeSource):
    """Skeletons of the person in front of a webcam."""

    argument = "NUMBER"
    description = "the person in front of a webcam, by MediaPipe; 0 is the first webcam"
    live = True

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> WebcamSource:
        """Open the webcam with the number ``argument``; the command line calls this source ``webcam:NUMBER``.

        Raises:
            InputError: when ``argument`` is not a number, there is no webcam with this number, or MediaPipe is not
                installed.
        """
        return cls(number_after_colon("webcam", cls.argument, argument, 63))


def _text(words: list[bytes]) -> str:
    return b" ".join(words).decode("utf-8", "replace")
