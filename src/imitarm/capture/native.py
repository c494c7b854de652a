"""imitarm's own file of skeletons: text that says what it holds, one skeleton a line."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.finding import Finding
from imitarm.capture.skeleton import FARTHEST, JOINTS, HandState, Skeleton
from imitarm.errors import FileFormatError
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
"""What the header says of the number of frames while they are still being written."""

_MARK = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s*[#%][^\n]*\n)*?\s*[#%]\s*format:\s*" + FORMAT.encode() + rb"\b")
_WHOLE = re.compile(rb"-?\d{1,20}")
_N = len(JOINTS)


def recognises(head: bytes) -> bool:
    """Tell by the remark ``# format: imitarm-skeletons``."""
    return _MARK.match(head.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) is not None


def header(source: str, frames: str) -> str:
    """Return the lines before the first skeleton.

    Args:
        source: where the skeletons are from.
        frames: how many there are, or :data:`UNFINISHED`; padded, so that it can be overwritten in place.
    """
    remarks = {
        "format": FORMAT,
        "version": VERSION,
        "frames": f"{frames:<20}",
        "units": "m s",
        "frame": "sensor: x to its left, y up, z away from it",
        "tracking": "0 lost, 1 inferred, 2 tracked",
        "hands": ", ".join(f"{state.value} {state.name.lower().replace('_', ' ')}" for state in HandState),
        "source": " ".join(source.split()),
    }
    lines = [f"# {key}: {value}" for key, value in remarks.items()]
    return "\n".join([*lines, ",".join(NAMES), ""])


def line_of(skeleton: Skeleton) -> str:
    """Return a skeleton as one line, which gives it back to the last bit."""
    left, right = skeleton.hand_states
    fields = [repr(skeleton.time), str(skeleton.person), str(int(left)), str(int(right))]
    for (x, y, z), tracking in zip(skeleton.positions.tolist(), skeleton.tracking.tolist(), strict=True):
        fields += (repr(x), repr(y), repr(z), str(tracking))
    return ",".join(fields) + "\n"


def read(path: str, content: bytes) -> tuple[list[Skeleton], list[Finding], str]:
    """Read the content of such a file.

    A recording that was not closed, because its writer was killed or is still at work, is read up to its last whole
    line, and what was lost is said.

    Args:
        path: for messages.
        content: of the file.

    Returns:
        the skeletons, what is worth knowing about the file, and where the skeletons were from.

    Raises:
        FileFormatError: when the file was cut off after it was closed, is of another version, or holds what is no
            skeleton; the message names file and line.
    """
    unfinished = _unfinished(content)
    torn = unfinished and not content.endswith(b"\n")
    if torn:
        content = content[: content.rfind(b"\n") + 1]
    if unfinished and content.rstrip().endswith(NAMES[-1].encode()):
        raise FileFormatError(f"{path}: was not closed and holds no whole frame; record it again")
    table = parse_table(path, content)
    version = table.remarks.get("version", "")
    if version != str(VERSION):
        raise FileFormatError(f"{path}: is of version {version!r}, this imitarm reads {VERSION}; update imitarm")
    if table.names != NAMES:
        raise FileFormatError(f"{path}: its columns are not those of version {VERSION}; record or convert it again")
    n = len(table.values)
    announced = table.remarks.get("frames", "")
    if not unfinished and announced != str(n):
        raise FileFormatError(
            f"{path}, line {int(table.lines[-1])}: ends after {n} frames where {announced} are announced: the file was "
            "cut off; copy it again, or write the number there is after '# frames:'"
        )
    findings = []
    if unfinished:
        lost = " and the frame that was being written is lost" if torn else ""
        message = f"was not closed: its writer was stopped or is still at work; {n} whole frames were read{lost}"
        findings.append(Finding("note", "not-closed", message, n - 1, remedy="save it under another name to keep it"))
    persons = _persons(table, content)
    joints = table.values[:, 4:].reshape(n, _N, 4)
    skeletons, far = assembled(table, table.values[:, 0], joints, table.values[:, 2:4], persons)
    return skeletons, findings + far, table.remarks.get("source", "")


def _unfinished(content: bytes) -> bool:
    head = content[:4096].replace(b"\r\n", b"\n")
    return re.search(rb"^#\s*frames:\s*" + UNFINISHED.encode() + rb"\s*$", head, re.MULTILINE) is not None


def _persons(table: Table, content: bytes) -> list[int]:
    """Return the column of persons: the Kinect SDK counts bodies in numbers too large for a float."""
    lines = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
    fields = [lines[line - 1].split(b",")[1].strip() for line in table.lines]
    _refuse(table, np.array([_WHOLE.fullmatch(field) is None for field in fields]), "the person is not a whole number")
    return [int(field) for field in fields]


def assembled(
    table: Table, times: Array, joints: Array, hands: Array | None = None, persons: Sequence[int] | None = None
) -> tuple[list[Skeleton], list[Finding]]:
    """Build skeletons from columns, whatever the format they are from.

    Args:
        table: what was read, for messages.
        times: shape (n,) [s].
        joints: x, y, z [m] and tracking state of each joint, shape (n, 25, 4).
        hands: state of the left and of the right hand, shape (n, 2); None: not in the file.
        persons: who each is; None: not in the file.

    Raises:
        FileFormatError: when a time is not finite, or a state is none; the message names file and line.
    """
    states = np.zeros((len(times), 2)) if hands is None else hands
    _refuse(table, ~np.isfinite(times), "the time is not a finite number")
    _refuse(table, ~np.isin(joints[..., 3], (0, 1, 2)).all(axis=1), "a tracking state is not 0, 1 or 2")
    _refuse(table, ~np.isin(states, range(len(HandState))).all(axis=1), "a hand's state is not one of 0 to 4")
    with np.errstate(invalid="ignore"):
        far = (joints[..., 3] > 0) & ~(np.abs(joints[..., :3]) <= FARTHEST).all(axis=2)
    skeletons = [
        Skeleton(time, frame[:, :3], frame[:, 3].astype(np.int8), (HandState(int(left)), HandState(int(right))), person)
        for time, frame, (left, right), person in zip(
            times.tolist(), joints, states, [0] * len(times) if persons is None else persons, strict=True
        )
    ]
    return skeletons, _far(table, times, far)


def _refuse(table: Table, bad: NDArray[np.bool_] | np.bool_, what: str) -> None:
    if np.any(bad):
        line = int(table.lines[np.argmax(bad)])
        raise FileFormatError(f"{table.path}, line {line}: {what}; mend or remove that line")


def _far(table: Table, times: Array, far: NDArray[np.bool_]) -> list[Finding]:
    """Return what to say about joints that can't have been measured."""
    if not far.any():
        return []
    frame = int(np.argmax(far.any(axis=1)))
    message = (
        f"{int(far.sum())} joints in {int(far.any(axis=1).sum())} frames are not finite or farther than "
        f"{FARTHEST:.0f} m, first {JOINTS[int(np.argmax(far[frame]))]} in line {int(table.lines[frame])}; "
        "they are taken as lost"
    )
    return [Finding("warning", "far-joint", message, frame, float(times[frame] - times[0]), "check units and sensor")]
