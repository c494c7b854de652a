"""Read and write files of skeletons: imitarm's text format, tables of the Kinect SDK, and motion capture of an arm."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.issue import RecordingIssue
from imitarm.capture.motions import Truth
from imitarm.capture.person import Person
from imitarm.capture.plausibility import length_unit_that_fits, time_unit_that_fits
from imitarm.capture.skeleton import FARTHEST, JOINT, JOINTS, HandState, Skeleton, Tracking
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import Table, parse_table

Array = NDArray[np.float64]

FORMAT = "imitarm-skeletons"
VERSION = 1
NAMES = (
    "t",
    "person",
    "hand_left",
    "hand_right",
    *(f"{joint}_{part}" for joint in JOINTS for part in ("x", "y", "z", "tracking")),
)
UNFINISHED = "not closed"
"""Text in the header of a file that is still being written. It stands in the place of the number of frames."""

TICK = 1e-7  # [s] time unit of the Kinect SDK
_KINECT_COLUMNS = 1 + 4 * len(JOINTS)
_FASTEST_RATE = 1000.0  # [Hz] a table with more frames per second has its times in another unit for certain
_MARK = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s*[#%][^\n]*\n)*?\s*[#%]\s*format:\s*" + FORMAT.encode() + rb"\b")
_WHOLE = re.compile(rb"-?\d{1,20}")
_LIMBS = [
    (JOINT[f"{a}_{side}"], JOINT[f"{b}_{side}"])
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"))
]
_MARKERS = ("right_shoulder", "right_elbow", "hand_left", "hand_right", "middle_middle", "thumb_middle")
_MEASURED = np.array([JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")])
_UPPER_ARM = (0.1, 0.6)  # [m] of motion capture


# --- imitarm's own format


def is_native(head: bytes) -> bool:
    """Return whether a file begins with ``# format: imitarm-skeletons``, the first line of imitarm's own format."""
    return _MARK.match(head.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) is not None


def native_header(source: str, frames: str) -> str:
    """Return the header of imitarm's own format: the lines before the first skeleton.

    Args:
        source: name of the source of the skeletons.
        frames: number of frames, or :data:`UNFINISHED`. The header pads it with spaces, so that a number can later
            overwrite the text.
    """
    remarks = {
        "format": FORMAT,
        "version": VERSION,
        "frames": f"{frames:<20}",
        "units": "m s",
        "frame": "axes of the sensor: x to the sensor's left, y up, z away from the sensor",
        "tracking": "0 lost, 1 inferred, 2 tracked",
        "hands": ", ".join(f"{state.value} {state.name.lower().replace('_', ' ')}" for state in HandState),
        "source": " ".join(source.split()),
    }
    lines = [f"# {key}: {value}" for key, value in remarks.items()]
    return "\n".join([*lines, ",".join(NAMES), ""])


def native_line(skeleton: Skeleton) -> str:
    """Return a skeleton as one line of text. Reading the line gives exactly the same numbers."""
    left, right = skeleton.hand_states
    fields = [repr(skeleton.time), str(skeleton.person), str(int(left)), str(int(right))]
    for (x, y, z), tracking in zip(skeleton.positions.tolist(), skeleton.tracking.tolist(), strict=True):
        fields += (repr(x), repr(y), repr(z), str(tracking))
    return ",".join(fields) + "\n"


def read_native(path: str, content: bytes) -> tuple[list[Skeleton], list[RecordingIssue]]:
    """Read imitarm's own format.

    The program that writes a recording may have been killed, or it may still be running. In this case, the recording is
    read up to the last complete line, and an issue reports that the recording was not closed.

    Args:
        path: path of the file, for messages.
        content: content of the file.

    Returns:
        The skeletons, and the issues found while reading.

    Raises:
        FileFormatError: when a complete file was cut off, the file has another format version, or a line is not a
            skeleton. The message names file and line.
    """
    unfinished = _is_unfinished(content)
    torn = unfinished and not content.endswith(b"\n")
    if torn:
        content = content[: content.rfind(b"\n") + 1]
    if unfinished and content.rstrip().endswith(NAMES[-1].encode()):
        raise FileFormatError(f"{path}: the recording was not closed and contains no complete frame; record again")
    table = parse_table(path, content)
    version = table.remarks.get("version", "")
    if version != str(VERSION):
        raise FileFormatError(
            f"{path}: has format version {version!r}, but this imitarm reads version {VERSION}; update imitarm"
        )
    if table.names != NAMES:
        raise FileFormatError(
            f"{path}: the columns differ from those of format version {VERSION}; record or convert the file again"
        )
    n = len(table.values)
    announced = table.remarks.get("frames", "")
    if not unfinished and announced != str(n):
        raise FileFormatError(
            f"{path}, line {int(table.lines[-1])}: the file ends after {n} frames, but its header announces "
            f"{announced}; copy the complete file again, or correct the number after '# frames:'"
        )
    issues = []
    if unfinished:
        lost = "; the frame that was being written is lost" if torn else ""
        message = (
            f"the recording was not closed, because the program that writes it was stopped or is still running; {n} "
            f"complete frames were read{lost}"
        )
        issues.append(
            RecordingIssue(
                "note",
                "not-closed",
                message,
                n - 1,
                remedy=("save the recording under another name to keep these frames"),
            )
        )
    persons = _persons(table, content)
    joints = table.values[:, 4:].reshape(n, len(JOINTS), 4)
    skeletons, far = _skeletons(table, table.values[:, 0], joints, table.values[:, 2:4], persons)
    return skeletons, issues + far


def _is_unfinished(content: bytes) -> bool:
    head = content[:4096].replace(b"\r\n", b"\n")
    return re.search(rb"^#\s*frames:\s*" + UNFINISHED.encode() + rb"\s*$", head, re.MULTILINE) is not None


def _persons(table: Table, content: bytes) -> list[int]:
    """Return the person numbers as integers, because the Kinect SDK's body numbers are too large for a float."""
    lines = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
    fields = [lines[line - 1].split(b",")[1].strip() for line in table.lines]
    bad = np.array([_WHOLE.fullmatch(field) is None for field in fields])
    _refuse(table, bad, "the person number is not a whole number")
    return [int(field) for field in fields]


# --- the table of the Kinect SDK


def read_kinect_table(path: str, content: bytes) -> tuple[list[Skeleton], list[RecordingIssue]]:
    """Read a Kinect SDK table of 101 columns: time [100 ns], then x, y, z [m] and state of 25 joints in SDK order.

    The returned times begin with 0 at the first frame. A table of this kind does not contain person numbers or hand
    states. A comma at the end of a line is accepted.

    Args:
        path: path of the file, for messages.
        content: content of the file.

    Returns:
        The skeletons, and the issues found while reading.

    Raises:
        FileFormatError: when the file is not a Kinect SDK table, was cut off, or has a field that is not a number. The
            message names file and line.
    """
    table = parse_table(path, content)
    n, columns = table.values.shape
    if columns != _KINECT_COLUMNS:
        raise FileFormatError(
            f"{path}, line {int(table.lines[0])}: a recording of skeletons can't have {columns} columns; export it in "
            "imitarm's own format, which begins with '# format: imitarm-skeletons', or as a Kinect SDK table of "
            f"{_KINECT_COLUMNS} columns (time, then x, y, z and state of 25 joints)"
        )
    times = (table.values[:, 0] - table.values[0, 0]) * TICK
    skeletons, issues = _skeletons(table, times, table.values[:, 1:].reshape(n, len(JOINTS), 4))
    period = abs(float(times[-1])) / max(n - 1, 1)
    if n > 1 and period < 1.0 / _FASTEST_RATE:
        fit = time_unit_that_fits(1.0 / period, TICK) if period > 0.0 else None
        unit = "" if fit is None else f"the times seem to be in {fit[0]}: multiply them by {fit[1]:.10g}; "
        raise FileFormatError(
            f"{path}: {n} frames within {abs(float(times[-1])):.3g} s, if the times are in units of 100 ns, as in a "
            f"table of the Kinect SDK; {unit}if the times are in seconds, multiply them by 10 000 000"
        )
    return skeletons, issues


# --- what both tables have in common


def _skeletons(
    table: Table, times: Array, joints: Array, hands: Array | None = None, persons: Sequence[int] | None = None
) -> tuple[list[Skeleton], list[RecordingIssue]]:
    """Build skeletons from the columns of a table.

    Args:
        table: table from which the columns were read, for messages.
        times: time stamps, shape (n,) [s].
        joints: x, y, z [m] and tracking state of each joint, shape (n, 25, 4).
        hands: states of the left and the right hand, shape (n, 2); None: the file has no hand states.
        persons: number of the person in each frame; None: the file has no person numbers.

    Raises:
        FileFormatError: when a time is not finite, or a state has an unknown number; the message names file and line.
    """
    states = np.zeros((len(times), 2)) if hands is None else hands
    _refuse(table, ~np.isfinite(times), "the time is not a finite number")
    _refuse(table, ~np.isin(joints[..., 3], (0, 1, 2)).all(axis=1), "a tracking state is not 0, 1 or 2")
    _refuse(table, ~np.isin(states, range(len(HandState))).all(axis=1), "the state of a hand is not 0, 1, 2, 3 or 4")
    skeletons = [
        Skeleton(time, frame[:, :3], frame[:, 3].astype(np.int8), (HandState(int(left)), HandState(int(right))), person)
        for time, frame, (left, right), person in zip(
            times.tolist(), joints, states, [0] * len(times) if persons is None else persons, strict=True
        )
    ]
    return skeletons, _far_joints(table, times, joints)


def _refuse(table: Table, bad: NDArray[np.bool_] | np.bool_, what: str) -> None:
    if np.any(bad):
        line = int(table.lines[np.argmax(bad)])
        raise FileFormatError(f"{table.path}, line {line}: {what}; correct or remove that line")


def _far_joints(table: Table, times: Array, joints: Array) -> list[RecordingIssue]:
    """Return an issue about implausible joint positions, with the unit of length that fits, if any."""
    with np.errstate(invalid="ignore"):
        far = (joints[..., 3] > 0) & ~(np.abs(joints[..., :3]) <= FARTHEST).all(axis=2)
    if not far.any():
        return []
    frame = int(np.argmax(far.any(axis=1)))
    message = (
        f"{int(far.sum())} joint positions in {int(far.any(axis=1).sum())} frames are not finite or more than "
        f"{FARTHEST:.0f} m from the sensor; the first is {JOINTS[int(np.argmax(far[frame]))]} in line "
        f"{int(table.lines[frame])}; these joints count as lost"
    )
    remedy = "check the unit of length (metres) and the sensor"
    if far.mean() > 0.5:
        with np.errstate(invalid="ignore", over="ignore"):
            lengths = [np.linalg.norm(joints[:, a, :3] - joints[:, b, :3], axis=1) for a, b in _LIMBS]
        finite = np.concatenate(lengths)[np.isfinite(np.concatenate(lengths))]
        unit = length_unit_that_fits(float(np.median(finite))) if len(finite) else None
        if unit is not None:
            remedy = f"positions must be in metres, but these positions seem to be in {unit}: convert them"
    return [RecordingIssue("warning", "far-joint", message, frame, float(times[frame] - times[0]), remedy)]


# --- motion capture of an arm


def is_motion_capture(head: bytes) -> bool:
    """Return whether a file begins like a table of markers from QTM (Qualisys Track Manager), separated by tabs."""
    return head.startswith(b"NO_OF_FRAMES\t") and b"\nMARKER_NAMES\t" in head


def read_motion_capture(path: str) -> tuple[list[Skeleton], list[RecordingIssue]]:
    """Read a motion capture of an arm with :meth:`MotionCapture.load`, and add a synthetic body to the arm.

    The captured arm becomes the right arm, with its measured bone lengths, and is marked as tracked. The rest of the
    body is synthetic and is marked as inferred. It belongs to an average person who stands upright in front of a
    sensor.

    Args:
        path: path of the file.

    Returns:
        The skeletons, and the issues found while reading.

    Raises:
        FileFormatError: when the file is damaged or lacks a marker of the right arm. The message names the line.
    """
    captured = MotionCapture.load(path)
    truth = captured.truth(Person.from_seed(0))
    tracking = np.full(len(JOINTS), Tracking.INFERRED, np.int8)
    tracking[_MEASURED] = Tracking.TRACKED
    times = captured.times - captured.times[0]
    skeletons = [Skeleton(time, truth(time).positions, tracking) for time in times.tolist()]
    message = "motion capture of a right arm; the rest of the body is synthetic"
    return skeletons, [RecordingIssue("note", "arm-only", message, remedy="let the robot follow the right arm")]


@dataclass(frozen=True, eq=False)
class MotionCapture:
    """The motion of a right arm that was recorded by optical motion capture. The axes are x forward, y left, z up.

    Attributes:
        times: time stamps, shape (n,) [s].
        points: positions of shoulder, elbow, wrist, hand tip and thumb, shape (n, 5, 3) [m].
        source: path of the file.
    """

    times: Array
    points: Array
    source: str

    @classmethod
    def load(cls, path: str | Path, *, to_body: ArrayLike | None = None) -> MotionCapture:
        """Read markers of a right arm from a file of tab-separated values in millimetres.

        The wrist is the midpoint between the markers ``hand_left`` and ``hand_right``, which are on the hand near the
        forearm.

        Args:
            path: path of the file.
            to_body: rotation matrix, shape (3, 3), from the axes of the file to the axes of the person (x forward, y
                left, z up); None: the file uses the axes of the person.

        Raises:
            FileFormatError: when the file is not a motion capture of a right arm. The message names the fault and the
                line.
            InputError: when ``to_body`` is not a rotation matrix.
        """
        rotation = np.eye(3) if to_body is None else np.array(to_body, dtype=float)
        orthonormal = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        if not orthonormal or np.linalg.det(rotation) < 0.0:
            raise InputError(f"MotionCapture: to_body must be a rotation matrix of shape (3, 3), got {to_body!r}")
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(
                f"{path}: can't be read as text ({error}); give a motion capture export as .tsv"
            ) from error
        header = next((i for i, line in enumerate(lines) if line.startswith("MARKER_NAMES")), None)
        first = next((i for i, line in enumerate(lines) if line.startswith("Frame\tTime")), None)
        if header is None or first is None:
            raise FileFormatError(
                f"{path}: a line that begins with MARKER_NAMES or a line that begins with Frame is missing; give a "
                "motion capture export as .tsv"
            )
        names = lines[header].split("\t")[1:]
        missing = [name for name in _MARKERS if name not in names]
        if missing:
            raise FileFormatError(
                f"{path}, line {header + 1}: marker {missing[0]!r} is missing; export all markers of the arm"
            )
        columns = [2 + 3 * names.index(name) for name in _MARKERS]
        filled = [i for i in range(first + 1, len(lines)) if lines[i].strip()]
        if len(filled) < 2:
            raise FileFormatError(f"{path}: holds {len(filled)} frames; at least 2 are needed")
        table = np.array([_row(path, i + 1, lines[i], columns) for i in filled])
        back = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
        if len(back):
            raise FileFormatError(
                f"{path}, line {filled[back[0] + 1] + 1}: the time is not later than in the previous frame; sort the "
                "frames by time"
            )
        s, e, left, right, tip, thumb = np.moveaxis(table[:, 1:].reshape(len(table), -1, 3) * 1e-3 @ rotation.T, 1, 0)
        upper = float(np.median(np.linalg.norm(e - s, axis=1)))
        if not _UPPER_ARM[0] < upper < _UPPER_ARM[1]:
            raise FileFormatError(
                f"{path}: the upper arm would be {upper:.3g} m long if the positions were in millimetres; export the "
                "positions in millimetres"
            )
        return cls(table[:, 0], np.stack([s, e, 0.5 * (left + right), tip, thumb], axis=1), path.name)

    def truth(self, person: Person) -> Truth:
        """Return the motion as a sensor in front of ``person`` would see it, with the bone lengths of the captured arm.

        The arm is interpolated linearly between frames, and is at rest before the first and after the last frame. The
        person stands upright.
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
        raise FileFormatError(
            f"{path}, line {number}: a field of the frame is not a number or is missing ({error}); export the "
            "complete recording again"
        ) from error
    if not np.isfinite(values).all():
        raise FileFormatError(
            f"{path}, line {number}: the position of a marker of the arm is missing; fill the gap before exporting"
        )
    return values
