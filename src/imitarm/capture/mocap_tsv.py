"""Reader of optical motion capture of a right arm, as QTM exports it: a table of markers, separated by tabs."""

from __future__ import annotations

import numpy as np

from imitarm.capture.finding import Finding
from imitarm.capture.motions import MotionCapture
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking

_MEASURED = np.array([JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")])


def recognises(content: bytes) -> bool:
    """Whether a file's beginning is that of such an export."""
    return content.startswith(b"NO_OF_FRAMES\t") and b"\nMARKER_NAMES\t" in content


def read(path: str, content: bytes) -> tuple[list[Skeleton], list[Finding], str]:
    """Read markers as :meth:`~imitarm.capture.motions.MotionCapture.load` does, and put a body to the arm.

    The right arm is what was captured, bones and all, and tracked. The rest of the body was not: it is that of an
    average person who stands upright before a sensor, and is given as inferred.

    Args:
        path: of the file.
        content: of the file; not used, its lines are read again.

    Returns:
        the skeletons, what is worth knowing about the file, and where the skeletons were from.

    Raises:
        FileFormatError: when the file is damaged or has not the markers of a right arm; the message names the line.
    """
    captured = MotionCapture.load(path)
    truth = captured.truth(Person.from_seed(0))
    tracking = np.full(len(JOINTS), Tracking.INFERRED, np.int8)
    tracking[_MEASURED] = Tracking.TRACKED
    times = captured.times - captured.times[0]
    skeletons = [Skeleton(time, truth(time).positions, tracking) for time in times.tolist()]
    message = "motion capture of a right arm; the rest of the body is made up"
    return skeletons, [Finding("note", "arm-only", message, remedy="follow the right arm")], "motion capture"
