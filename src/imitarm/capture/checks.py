"""check: says what is wrong with a recording of a person before a robot follows it; repaired: mends what is safe."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.filters import SideMemory
from imitarm.capture.issue import SEVERITIES, RecordingIssue, Severity
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINT, SIDES, Skeleton, Tracking
from imitarm.errors import UnknownNameError

Array = NDArray[np.float64]

_FEW = 10  # frames
_LOST = (0.05, 0.5)  # share of frames without the arm: a warning, an error
_INFERRED = 0.2  # share of frames in which a joint of the arm is guessed
_HAND_LOST = 0.3  # share of frames without a hand's direction
_GAP = 0.1  # [s] longer ones are bridged by coasting no more (METHODS A.9)
_STOP = 0.3  # [s] longer ones stop a robot
_RATE = (20.0, 10.0)  # [Hz] less is worth a warning, an error
_SPREAD = 0.10  # of a limb's length: a Kinect has 2 to 5 percent
_LIMB = (0.10, 0.60)  # [m]
_TURNED = 0.3  # share of frames in which left is where right should be
_MAD_TO_SIGMA = 1.4826


def check(recording: SkeletonRecording, side: str = "right") -> list[RecordingIssue]:
    """Return all that is wrong with a recording, errors first.

    Args:
        recording: as it was read or captured.
        side: of the arm that a robot is to follow.

    Raises:
        UnknownNameError: when ``side`` is neither left nor right.
    """
    if side not in SIDES:
        raise UnknownNameError.among("side", side, SIDES)
    findings = [*recording.issues, *_people(recording)]
    seen = [skeleton for skeleton in recording.skeletons if (skeleton.tracking > Tracking.LOST).any()]
    if seen:
        view = _View(recording, side)
        for look in (_times, _rate, _gaps, _arm, _hand, _limbs, _sides):
            findings += look(view)
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def repaired(recording: SkeletonRecording) -> tuple[SkeletonRecording, list[str]]:
    """Mend what can be mended without guessing, and say what was done.

    Of several persons the one with the most frames is kept; a frame that is not later than the one before is dropped;
    left and right that were exchanged from one frame to the next are exchanged back.

    Returns:
        the mended recording, and a line for each kind of change; no lines: nothing was changed.
    """
    notes: list[str] = []
    frames = recording.skeletons
    if len(recording.persons) > 1:
        counts = {person: sum(s.person == person for s in frames) for person in recording.persons}
        main = max(counts, key=lambda person: counts[person])
        frames = tuple(s for s in frames if s.person == main)
        notes.append(f"kept person {main}; {len(recording) - len(frames)} frames of others dropped")
    kept: list[Skeleton] = []
    for skeleton in frames:
        if not kept or skeleton.time > kept[-1].time:
            kept.append(skeleton)
    if len(kept) < len(frames):
        notes.append(f"dropped {len(frames) - len(kept)} frames that were not later than the one before")
    memory = SideMemory()
    right = [memory.update(skeleton) for skeleton in kept]
    if memory.swaps:
        notes.append(f"exchanged left and right back in {memory.swaps} frames")
    return SkeletonRecording(right, name=recording.name, issues=recording.issues), notes


class _View:
    """The arm of the person with the most frames, as arrays."""

    def __init__(self, recording: SkeletonRecording, side: str) -> None:
        everybody = [skeleton.person for skeleton in recording.skeletons]
        main = max(recording.persons, key=everybody.count)
        self.side = side
        self.frames = [i for i, person in enumerate(everybody) if person == main]
        self.skeletons = [recording.skeletons[i] for i in self.frames]
        arms = [skeleton.arm(side) for skeleton in self.skeletons]
        self.times = np.array([arm.time for arm in arms])
        self.points = np.array([arm.points for arm in arms])
        self.confidence = np.array([arm.confidence for arm in arms])
        stamps = np.unique(self.times)
        self.period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0

    def finding(self, severity: Severity, code: str, message: str, remedy: str, i: int | None = None) -> RecordingIssue:
        """Build a finding about sample ``i``."""
        if i is None:
            return RecordingIssue(severity, code, message, remedy=remedy)
        return RecordingIssue(severity, code, message, self.frames[i], float(self.times[i] - self.times[0]), remedy)


def _people(recording: SkeletonRecording) -> Iterator[RecordingIssue]:
    n = len(recording)
    if not any((skeleton.tracking > Tracking.LOST).any() for skeleton in recording.skeletons):
        message = f"nobody is seen in any of {n} frames" if n else "holds no frames"
        yield RecordingIssue("error", "nobody", message, remedy="stand 1.5 to 3 m before the sensor and record again")
        return
    if len(recording.persons) > 1:
        everybody = [skeleton.person for skeleton in recording.skeletons]
        shares = ", ".join(f"{person} ({everybody.count(person)} frames)" for person in recording.persons)
        second = next(i for i, person in enumerate(everybody) if person != everybody[0])
        yield RecordingIssue(
            "warning",
            "several-persons",
            f"{len(recording.persons)} persons: {shares}; the rest of these findings is about the one seen most",
            second,
            recording.skeletons[second].time - recording.skeletons[0].time,
            "choose one by --person, or .person(number)",
        )


def _times(view: _View) -> Iterator[RecordingIssue]:
    steps = np.diff(view.times)
    if (steps <= 0.0).any():
        i = int(np.argmax(steps <= 0.0)) + 1
        message = f"time runs backwards or stands still in {int((steps <= 0.0).sum())} frames, by up to "
        message += f"{1e3 * max(-float(steps.min()), 0.0):.0f} ms"
        yield view.finding("error", "time-backwards", message, "repair drops these frames", i)
    if len(view.times) < _FEW:
        yield view.finding("error", "few-frames", f"{len(view.times)} frames only", "record for longer")


def _rate(view: _View) -> Iterator[RecordingIssue]:
    if view.period == 0.0:
        return
    rate = 1.0 / view.period
    message = f"{rate:.1f} frames a second"
    if rate < _RATE[1]:
        message += ": between two frames a robot that follows would already brake"
        yield view.finding("error", "frame-rate", message, "use a faster camera or computer; 30 are usual")
    elif rate < _RATE[0]:
        yield view.finding("warning", "frame-rate", message, "more light or a smaller model; 30 are usual")


def _gaps(view: _View) -> Iterator[RecordingIssue]:
    steps = np.diff(view.times)
    long = steps > max(_GAP, 3.0 * view.period)
    if long.any():
        i = int(np.argmax(steps))
        stops = int((steps > _STOP).sum())
        message = f"{int(long.sum())} gaps between frames, the longest {steps[i]:.2f} s; {stops} are long enough "
        message += f"(over {_STOP:g} s) for a robot to stop"
        yield view.finding("warning", "gap", message, "cut there by trim, or record again", i)


def _arm(view: _View) -> Iterator[RecordingIssue]:
    known = view.confidence[:, :3].min(axis=1)
    lost, guessed = known == 0.0, (known > 0.0) & (known < 1.0)
    if lost.mean() > _LOST[0]:
        severity: Severity = "error" if lost.mean() > _LOST[1] else "warning"
        message = f"the {view.side} arm is lost in {100 * lost.mean():.0f} % of the frames"
        yield view.finding(severity, "arm-lost", message, "keep it in view, away from the body", int(np.argmax(lost)))
    elif lost.any():
        message = f"the {view.side} arm is lost in {int(lost.sum())} of {len(lost)} frames"
        yield view.finding("note", "arm-lost", message, "none needed", int(np.argmax(lost)))
    if guessed.mean() > _INFERRED:
        message = f"a joint of the {view.side} arm is guessed, not seen, in {100 * guessed.mean():.0f} % of the frames"
        yield view.finding("warning", "arm-inferred", message, "keep it in view", int(np.argmax(guessed)))


def _hand(view: _View) -> Iterator[RecordingIssue]:
    lost = view.confidence[:, [2, 4, 5]].min(axis=1) < 1.0
    if lost.mean() > _HAND_LOST:
        message = f"wrist, hand tip and thumb are not all tracked in {100 * lost.mean():.0f} % of the frames; the tool "
        message += "will not turn with the hand there"
        yield view.finding("note", "hand-lost", message, "use orientation 'fixed', or spread the thumb")


def _limbs(view: _View) -> Iterator[RecordingIssue]:
    tracked = view.points[view.confidence[:, :3].min(axis=1) >= 1.0, :3]
    if len(tracked) < _FEW:
        return
    lengths = np.linalg.norm(np.diff(tracked, axis=1), axis=2)
    middle = np.median(lengths, axis=0)
    spread = _MAD_TO_SIGMA * np.median(np.abs(lengths - middle), axis=0)
    for name, length, deviation in zip(("upper arm", "forearm"), middle, spread, strict=True):
        if not _LIMB[0] <= length <= _LIMB[1]:
            message = f"the {name} is {length:.2f} m long"
            yield view.finding("error", "limb-length", message, "positions must be in metres: is this an arm?")
        elif deviation > _SPREAD * length:
            message = f"the {name}'s length varies by {100 * deviation / length:.0f} % about {100 * length:.0f} cm"
            yield view.finding("warning", "limb-length", message, "more light, or turn to the sensor")


def _sides(view: _View) -> Iterator[RecordingIssue]:
    memory = SideMemory()
    first: int | None = None
    for i, skeleton in enumerate(view.skeletons):
        memory.update(skeleton)
        if memory.swaps and first is None:
            first = i
    if memory.swaps:
        message = f"left and right are exchanged in {memory.swaps} frames"
        yield view.finding("warning", "sides-swapped", message, "repair exchanges them back", first)
    positions = np.array([skeleton.positions for skeleton in view.skeletons])
    across = positions[:, JOINT["shoulder_right"], 0] - positions[:, JOINT["shoulder_left"], 0]
    seen = np.isfinite(across)
    turned = seen & (across < 0.0)
    if seen.any() and turned.sum() > max(_TURNED * seen.sum(), memory.swaps):
        message = (
            f"the left shoulder is where the right one should be in {100 * turned.sum() / seen.sum():.0f} % of the "
        )
        message += "frames: the person has the back to the sensor, or the picture is mirrored"
        yield view.finding("warning", "turned-away", message, "face the sensor; do not mirror", int(np.argmax(turned)))
