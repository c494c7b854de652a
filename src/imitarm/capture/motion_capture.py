"""MotionCapture: a right arm recorded by optical markers, and the reader that gives it the body of a person."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.issue import RecordingIssue
from imitarm.capture.motions import Truth
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.errors import FileFormatError, InputError

Array = NDArray[np.float64]

_MARKERS = ("right_shoulder", "right_elbow", "hand_left", "hand_right", "middle_middle", "thumb_middle")
_MEASURED = np.array([JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")])
_UPPER_ARM = (0.1, 0.6)  # [m]


def is_motion_capture(head: bytes) -> bool:
    """Return whether a file begins as an export of motion capture by QTM does: a table of markers with tabs."""
    return head.startswith(b"NO_OF_FRAMES\t") and b"\nMARKER_NAMES\t" in head


def read_motion_capture(path: str) -> tuple[list[Skeleton], list[RecordingIssue]]:
    """Read markers as :meth:`MotionCapture.load` does, and add a body to the arm.

    The right arm is the captured one, with its own bones, and is tracked. The rest of the body was not captured: it is
    that of an average person who stands upright in front of a sensor, and is given as inferred.

    Args:
        path: of the file.

    Returns:
        the skeletons, and what is worth knowing about the file.

    Raises:
        FileFormatError: when the file is damaged or lacks a marker of the right arm; the message names the line.
    """
    captured = MotionCapture.load(path)
    truth = captured.truth(Person.from_seed(0))
    tracking = np.full(len(JOINTS), Tracking.INFERRED, np.int8)
    tracking[_MEASURED] = Tracking.TRACKED
    times = captured.times - captured.times[0]
    skeletons = [Skeleton(time, truth(time).positions, tracking) for time in times.tolist()]
    message = "motion capture of a right arm; the rest of the body is synthetic"
    return skeletons, [RecordingIssue("note", "arm-only", message, remedy="follow the right arm")]


@dataclass(frozen=True, eq=False)
class MotionCapture:
    """A right arm recorded by optical motion capture, in axes x forward, y left, z up.

    Attributes:
        times: shape (n,) [s].
        points: shoulder, elbow, wrist, hand tip, thumb, shape (n, 5, 3) [m].
        source: the file.
    """

    times: Array
    points: Array
    source: str

    @classmethod
    def load(cls, path: str | Path, *, to_body: ArrayLike | None = None) -> MotionCapture:
        """Read markers of a right arm from a file of tab-separated values in millimetres.

        The wrist is taken midway between the two markers at the hand's near end.

        Args:
            path: the file.
            to_body: rotation from the file's axes to forward, left and up of the person, shape (3, 3); None: the
                file has these axes.

        Raises:
            FileFormatError: when the file is not such a recording; the message names the fault and the line.
            InputError: when ``to_body`` is not a rotation.
        """
        rotation = np.eye(3) if to_body is None else np.array(to_body, dtype=float)
        orthonormal = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        if not orthonormal or np.linalg.det(rotation) < 0.0:
            raise InputError(f"MotionCapture: to_body must be a rotation of shape (3, 3), got {to_body!r}")
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(f"{path}: can't be read as text ({error}); give a motion capture export") from error
        header = next((i for i, line in enumerate(lines) if line.startswith("MARKER_NAMES")), None)
        first = next((i for i, line in enumerate(lines) if line.startswith("Frame\tTime")), None)
        if header is None or first is None:
            raise FileFormatError(f"{path}: has no lines MARKER_NAMES and Frame; give a motion capture export as .tsv")
        names = lines[header].split("\t")[1:]
        missing = [name for name in _MARKERS if name not in names]
        if missing:
            raise FileFormatError(f"{path}, line {header + 1}: marker {missing[0]!r} is missing")
        columns = [2 + 3 * names.index(name) for name in _MARKERS]
        filled = [i for i in range(first + 1, len(lines)) if lines[i].strip()]
        if len(filled) < 2:
            raise FileFormatError(f"{path}: holds {len(filled)} frames; at least 2 are needed")
        table = np.array([_row(path, i + 1, lines[i], columns) for i in filled])
        back = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
        if len(back):
            raise FileFormatError(f"{path}, line {filled[back[0] + 1] + 1}: time does not increase; sort the frames")
        s, e, left, right, tip, thumb = np.moveaxis(table[:, 1:].reshape(len(table), -1, 3) * 1e-3 @ rotation.T, 1, 0)
        upper = float(np.median(np.linalg.norm(e - s, axis=1)))
        if not _UPPER_ARM[0] < upper < _UPPER_ARM[1]:
            raise FileFormatError(
                f"{path}: an upper arm of {upper:.3g} m, if its numbers are millimetres; export positions in mm"
            )
        return cls(table[:, 0], np.stack([s, e, 0.5 * (left + right), tip, thumb], axis=1), path.name)

    def truth(self, person: Person) -> Truth:
        """Return the motion as done by ``person`` in front of a sensor; the arm keeps its captured bones.

        It is interpolated linearly between frames, and still before the first and after the last one. The rest of the
        body stands upright where the person stands.
        """
        to_sensor = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
        points = self.points @ to_sensor.T
        points = points + (person.shoulder("right", 0.0) - points[:, 0].mean(axis=0))
        times = self.times - self.times[0]

        def truth(time: float) -> Skeleton:
            after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
            fraction = float(np.clip((time - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0))
            s, e, w, tip, thumb = points[after - 1] + fraction * (points[after] - points[after - 1])
            body = person.skeleton(time, w)
            positions = np.array(body.positions)
            positions[_MEASURED] = (s, e, w, 0.5 * (w + tip), tip, thumb)
            return Skeleton(time, positions, hand_states=body.hand_states)

        return truth

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return float(self.times[-1] - self.times[0])


def _row(path: Path, number: int, line: str, columns: list[int]) -> list[float]:
    fields = line.split("\t")
    try:
        values = [float(fields[1])] + [float(fields[c + k]) for c in columns for k in range(3)]
    except (ValueError, IndexError) as error:
        raise FileFormatError(f"{path}, line {number}: not a frame of numbers ({error}); is the file whole?") from error
    if not np.isfinite(values).all():
        raise FileFormatError(f"{path}, line {number}: a marker of the arm has a gap; fill it before exporting")
    return values
