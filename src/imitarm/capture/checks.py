"""Find faults in a recording of a person (``check``), and fix those faults that have only one remedy (``repaired``)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.filters import SideMemory
from imitarm.capture.issue import SEVERITIES, RecordingIssue, Severity
from imitarm.capture.plausibility import (
    FASTEST_HAND,
    LARGEST_STEP,
    PLAUSIBLE_RATE,
    axes_that_fit,
    find_spikes,
    hand_speed,
    joint_steps,
    length_unit_that_fits,
    repeats_previous,
    runs,
    time_unit_name,
    time_unit_that_fits,
)
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, Tracking
from imitarm.errors import UnknownNameError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEW = 10  # frames
_LOST = (0.05, 0.5)  # fraction of frames without the arm: a warning, an error
_INFERRED = 0.2  # fraction of frames in which a joint of the arm is inferred
_HAND_LOST = 0.3  # fraction of frames without the direction of the hand
_GAP = 0.1  # [s] retargeters extrapolate across shorter gaps
_STOP = 0.3  # [s] a robot stops in longer gaps
_LOW_RATE = (20.0, 10.0)  # [Hz] a lower rate is a warning, an error
_QUICK_HAND = 2.0  # [m/s] together with an implausible frame rate, an error
_SPREAD = 0.10  # variation of a limb's length over its length: a Kinect has 2 to 5 percent
_LIMB = (0.10, 0.60)  # [m]
_TURNED = 0.3  # fraction of frames in which left is where right should be
_REPEATED = 0.2  # fraction of frames that repeat the one before
_MAD_TO_SIGMA = 1.4826

_ARM = {
    side: np.array([JOINT[f"{part}_{side}"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")])
    for side in SIDES
}
_TIPS = {JOINT[f"{part}_{side}"] for part in ("hand_tip", "thumb") for side in SIDES}
_TRUNK = np.array([JOINT[name] for name in ("spine_base", "spine_mid", "spine_shoulder", "neck", "head")])


def check(recording: SkeletonRecording, side: str = "right") -> list[RecordingIssue]:
    """Return all faults of a recording. Errors come before warnings and notes.

    Args:
        recording: recording from a file or a camera.
        side: arm of the person that a robot should follow, ``"left"`` or ``"right"``.

    Raises:
        UnknownNameError: when ``side`` is neither left nor right.
    """
    if side not in SIDES:
        raise UnknownNameError.among("side", side, SIDES)
    issues = [*recording.issues, *_people(recording)]
    seen = [skeleton for skeleton in recording.skeletons if (skeleton.tracking > Tracking.LOST).any()]
    if seen:
        view = _View(recording, side)
        for look in (_times, _rate, _hand_speed, _axes, _gaps, _frozen, _spikes, _jumps, _arm, _hand, _limbs, _sides):
            issues += look(view)
    return sorted(issues, key=lambda issue: SEVERITIES.index(issue.severity))


def repaired(recording: SkeletonRecording) -> tuple[SkeletonRecording, list[str]]:
    """Fix those faults of a recording that have only one remedy, and report each change.

    If there are several persons, only the person with the most frames is kept. A frame is dropped if it is not later
    than the previous frame, or if it repeats the previous frame exactly. Two kinds of joints are marked as lost: joints
    that jump away and back within a few frames (a spike), and the joints of an arm that does not move at all while the
    body moves. If the camera swapped left and right from one frame to the next, the swap is undone.

    Returns:
        The repaired recording, and a list with one line of text for each kind of change. The list is empty if nothing
        was changed.
    """
    notes: list[str] = []
    frames = recording.skeletons
    if len(recording.persons) > 1:
        counts = {person: sum(s.person == person for s in frames) for person in recording.persons}
        main = max(counts, key=lambda person: counts[person])
        frames = tuple(s for s in frames if s.person == main)
        notes.append(f"kept person {main}; {len(recording) - len(frames)} frames of other persons dropped")
    kept: list[Skeleton] = []
    for skeleton in frames:
        if not kept or skeleton.time > kept[-1].time:
            kept.append(skeleton)
    if len(kept) < len(frames):
        notes.append(f"dropped {len(frames) - len(kept)} frames that were not later than the previous frame")
    kept = _without_repeats(kept, notes)
    memory = SideMemory()
    right = [memory.update(skeleton) for skeleton in kept]
    if memory.swaps:
        notes.append(f"swapped left and right back in {memory.swaps} frames in which the sensor had swapped them")
    return recording.with_skeletons(_without_spikes(right, notes)), notes


def _without_repeats(frames: list[Skeleton], notes: list[str]) -> list[Skeleton]:
    if len(frames) < 2:
        return frames
    positions = np.array([skeleton.positions for skeleton in frames])
    times = np.array([skeleton.time for skeleton in frames])
    whole = repeats_previous(positions)
    lost = np.zeros(positions.shape[:2], dtype=bool)
    for side in SIDES:
        for first, last in runs(repeats_previous(positions[:, _ARM[side]])):
            if times[last] - times[first] > _GAP:
                lost[first + 1 : last + 1, _ARM[side]] = True
    lost[1:][whole] = False
    if whole.any():
        longest = max(float(times[last] - times[first]) for first, last in runs(whole))
        note = f"dropped {int(whole.sum())} frames that repeat the previous frame, for up to {longest:.2f} s at a time"
        notes.append(note)
    if lost.any():
        notes.append(f"marked an arm as lost in {int(lost.any(axis=1).sum())} frames in which it was frozen")
    changed = [_with_lost(skeleton, joints) for skeleton, joints in zip(frames, lost, strict=True)]
    return [changed[0], *(s for s, repeated in zip(changed[1:], whole, strict=True) if not repeated)]


def _without_spikes(frames: list[Skeleton], notes: list[str]) -> list[Skeleton]:
    if len(frames) < 2:
        return frames
    times = np.array([skeleton.time for skeleton in frames])
    spikes, _ = find_spikes(times, np.array([skeleton.positions for skeleton in frames]))
    if not spikes.any():
        return frames
    notes.append(
        f"marked joints as lost in {int(spikes.any(axis=1).sum())} frames with a spike (joints that jump away and back)"
    )
    return [_with_lost(skeleton, joints) for skeleton, joints in zip(frames, spikes, strict=True)]


def _with_lost(skeleton: Skeleton, joints: Mask) -> Skeleton:
    """Return the skeleton with the given joints, shape (25,), marked as lost."""
    if not joints.any():
        return skeleton
    tracking = np.where(joints, Tracking.LOST, skeleton.tracking).astype(np.int8)
    return Skeleton(skeleton.time, skeleton.positions, tracking, skeleton.hand_states, skeleton.person)


class _View:
    """The skeletons of the person who appears in the most frames of a recording, as arrays."""

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
        self.positions = np.array([skeleton.positions for skeleton in self.skeletons])
        self.time_unit = recording.time_unit
        stamps = np.unique(self.times)
        self.period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
        later = np.concatenate([[True], self.times[1:] > np.maximum.accumulate(self.times)[:-1]])
        self.later = np.flatnonzero(later)  # frames whose times increase
        memory = SideMemory()
        right, self.swapped = [], []  # with corrected sides; frames in which the sides were exchanged
        for i, skeleton in enumerate(self.skeletons):
            right.append(memory.update(skeleton).positions)
            self.swapped += [i] if right[-1] is not skeleton.positions else []
        self.path = np.array(right)[self.later]
        self.spikes, self.spike_size = find_spikes(self.times[self.later], self.path)
        self.hand_speed = hand_speed(self.times[self.later], self.path, self.spikes)
        self.other_axes = axes_that_fit(self.positions)

    def issue(self, severity: Severity, code: str, message: str, remedy: str, i: int | None = None) -> RecordingIssue:
        """Build an issue about skeleton ``i`` of this view, or about the whole recording if ``i`` is None."""
        if i is None:
            return RecordingIssue(severity, code, message, remedy=remedy)
        return RecordingIssue(severity, code, message, self.frames[i], float(self.times[i] - self.times[0]), remedy)

    def unit_remedy(self) -> str:
        """Return a remedy for implausible times: the unit that fits or, if no unit fits, what to check instead."""
        fit = time_unit_that_fits(1.0 / self.period, self.time_unit)
        if fit is None:
            return (
                "check three causes: joints that jump, a wrong frame rate in the computation of the times, or a wrong "
                "unit of length"
            )
        name, factor = fit
        return (
            f"the times were read in units of {time_unit_name(self.time_unit)}, but they seem to be in {name} "
            f"({1.0 / (factor * self.period):.1f} frames per second): multiply them by {factor:.10g}"
        )


def _people(recording: SkeletonRecording) -> Iterator[RecordingIssue]:
    n = len(recording)
    if not any((skeleton.tracking > Tracking.LOST).any() for skeleton in recording.skeletons):
        message = f"nobody is visible in any of {n} frames" if n else "holds no frames"
        remedy = "stand 1.5 to 3 m in front of the sensor and record again"
        if any(issue.code == "far-joint" for issue in recording.issues):
            remedy = "convert the positions to metres, as the issue 'far-joint' says"
        yield RecordingIssue("error", "nobody", message, remedy=remedy)
        return
    if len(recording.persons) > 1:
        everybody = [skeleton.person for skeleton in recording.skeletons]
        shown = ", ".join(f"{person} ({everybody.count(person)} frames)" for person in recording.persons)
        second = next(i for i, person in enumerate(everybody) if person != everybody[0])
        yield RecordingIssue(
            "warning",
            "several-persons",
            f"the recording shows {len(recording.persons)} persons: {shown}; all other issues are about the person "
            "with the most frames",
            second,
            recording.skeletons[second].time - recording.skeletons[0].time,
            "choose one person: use --person NUMBER in a command, or .person(number) in Python",
        )


def _times(view: _View) -> Iterator[RecordingIssue]:
    steps = np.diff(view.times)
    if (steps <= 0.0).any():
        i = int(np.argmax(steps <= 0.0)) + 1
        count, back = int((steps <= 0.0).sum()), 1e3 * float(-steps.min())
        message = f"in {count} frames, the time stamp is the same as in the previous frame"
        if back > 0.0:
            message = f"in {count} frames, the time stamp is up to {back:.0f} ms earlier than in the previous frame"
        yield view.issue("error", "time-backwards", message, "repair the recording to drop these frames", i)
    if len(view.times) < _FEW:
        yield view.issue("error", "few-frames", f"{len(view.times)} frames only", "record for longer")


def _rate(view: _View) -> Iterator[RecordingIssue]:
    if view.period == 0.0:
        return
    rate = 1.0 / view.period
    message = f"{rate:.1f} frames per second"
    if rate > PLAUSIBLE_RATE[1]:
        speed = view.hand_speed
        quick = speed > _QUICK_HAND
        message = f"{rate:.1f} frames per second are more than a skeleton camera delivers"
        if quick:
            message = f"{message}; at this frame rate, the hands would move at up to {speed:.1f} m/s"
        yield view.issue("error" if quick else "warning", "frame-rate", message, view.unit_remedy())
    elif rate < _LOW_RATE[1]:
        message = (
            f"{rate:.1f} frames per second are too few: "
            "a robot that follows this recording would brake between two frames"
        )
        fits = time_unit_that_fits(rate, view.time_unit) is not None
        remedy = view.unit_remedy() if fits else "use a faster camera or computer; 30 frames per second are usual"
        yield view.issue("error", "frame-rate", message, remedy)
    elif rate < _LOW_RATE[0]:
        yield view.issue(
            "warning", "frame-rate", message, "use more light or a smaller model; 30 frames per second are usual"
        )


def _hand_speed(view: _View) -> Iterator[RecordingIssue]:
    speed = view.hand_speed
    if speed > FASTEST_HAND:
        message = (
            f"according to the recording, the hands move at {speed:.0f} m/s (90th percentile), which is faster than a "
            "person can move"
        )
        yield view.issue("error", "hand-speed", message, view.unit_remedy())


def _axes(view: _View) -> Iterator[RecordingIssue]:
    if view.other_axes is not None:
        fault, fit = view.other_axes
        remedy = "x must point to the sensor's left, y up, and z away from the sensor"
        if fit:
            remedy += f"; if the person faces the sensor, use the axes {fit} of the file as x, y, z"
        yield view.issue("error", "axes", fault, remedy)


def _gaps(view: _View) -> Iterator[RecordingIssue]:
    steps = np.diff(view.times)
    long = steps > max(_GAP, 3.0 * view.period)
    if long.any():
        i = int(np.argmax(steps))
        stops = int((steps > _STOP).sum())
        message = (
            f"{int(long.sum())} gaps between frames, the longest {steps[i]:.2f} s; in {stops} of these gaps, a robot "
            f"would stop, because they are longer than {_STOP:g} s"
        )
        yield view.issue("warning", "gap", message, "cut the recording there with trim, or record again", i)


def _frozen(view: _View) -> Iterator[RecordingIssue]:
    whole, arm = repeats_previous(view.positions), repeats_previous(view.positions[:, _ARM[view.side]])
    joints = {
        f"{view.side} {part}": repeats_previous(view.positions[:, [JOINT[f"{part}_{view.side}"]]])
        for part in ("elbow", "wrist")
    }
    for what, repeated in {"person": whole, f"{view.side} arm": arm, **joints}.items():
        lasting = [
            (view.times[b] - view.times[a], a) for a, b in runs(repeated) if view.times[b] - view.times[a] > _GAP
        ]
        if lasting:
            longest, first = max(lasting)
            message = f"the positions of the {what} do not change at all for {longest:.2f} s"
            if len(lasting) > 1:
                message = (
                    f"in {len(lasting)} periods, the positions of the {what} do not change at all; the longest period "
                    f"lasts {longest:.2f} s"
                )
            remedy = "record again: the sensor lost this joint while the other joints moved"
            if what not in joints:
                remedy = (
                    "repair the recording to drop these frames; if you need the motion in the gap that they leave, "
                    "record again"
                )
            yield view.issue("error" if longest > _STOP else "warning", "frozen", message, remedy, first)
            return
    fraction = whole.sum() / len(view.times)
    if fraction > _REPEATED and view.period > 0.0:
        rate = (1.0 - fraction) / view.period
        message = (
            f"{100 * fraction:.0f} % of the frames repeat the previous frame: only {rate:.1f} new frames per second"
        )
        yield view.issue(
            "warning", "frozen", message, "repair the recording to drop these frames", int(np.argmax(whole)) + 1
        )


def _spikes(view: _View) -> Iterator[RecordingIssue]:
    joints = _followed(view)
    spikes, size = view.spikes[:, joints], view.spike_size[:, joints]
    if spikes.any():
        frames = np.flatnonzero(spikes.any(axis=1))
        i, joint = divmod(int(np.argmax(size)), len(joints))
        message = (
            f"in {len(frames)} frame{'' if len(frames) == 1 else 's'}, joints jump away and back (a spike), by at "
            f"most {size[i, joint]:.2f} m ({JOINTS[joints[joint]]})"
        )
        remedy = "repair the recording to mark these joints as lost in these frames"
        severity = _severity_of(joints, spikes)
        yield view.issue(severity, "spike", message, remedy, int(view.later[frames[0]]))


def _jumps(view: _View) -> Iterator[RecordingIssue]:
    joints = _followed(view)
    step, speed = joint_steps(view.times[view.later], view.path)
    with np.errstate(invalid="ignore"):
        jump = (step > LARGEST_STEP) & (speed > FASTEST_HAND) & ~view.spikes[1:] & ~view.spikes[:-1]
    jump = jump[:, joints]
    if jump.any():
        size = np.where(jump, step[:, joints], 0.0)
        i, joint = divmod(int(np.argmax(size)), len(joints))
        count = int(jump.any(axis=1).sum())
        message = (
            f"{count} jump{'' if count == 1 else 's'} of a joint that does not return; the largest jump is "
            f"{size[i, joint]:.2f} m from one frame to the next ({JOINTS[joints[joint]]}, "
            f"{speed[i, joints[joint]]:.0f} m/s)"
        )
        remedy = "cut the recording there with trim, or record again"
        first = int(np.argmax(jump.any(axis=1))) + 1
        yield view.issue("warning", "jump", message, remedy, int(view.later[first]))


def _followed(view: _View) -> list[int]:
    """Return the joints that affect the robot: the joints of the arm and of the trunk."""
    return [*_ARM[view.side].tolist(), *_TRUNK.tolist()]


def _severity_of(joints: list[int], found: Mask) -> Severity:
    """Return ``"error"``, or ``"warning"`` if only finger tips and thumbs jump, because they do not move the tool."""
    return "error" if any(found[:, i].any() for i, joint in enumerate(joints) if joint not in _TIPS) else "warning"


def _arm(view: _View) -> Iterator[RecordingIssue]:
    known = view.confidence[:, :3].min(axis=1)
    lost, inferred = known == 0.0, (known > 0.0) & (known < 1.0)
    if lost.mean() > _LOST[0]:
        severity: Severity = "error" if lost.mean() > _LOST[1] else "warning"
        message = f"the {view.side} arm is lost in {100 * lost.mean():.0f} % of the frames"
        yield view.issue(
            severity, "arm-lost", message, "keep the arm in view, away from the body", int(np.argmax(lost))
        )
    elif lost.any():
        message = f"the {view.side} arm is lost in {int(lost.sum())} of {len(lost)} frames"
        yield view.issue("note", "arm-lost", message, "none needed", int(np.argmax(lost)))
    if inferred.mean() > _INFERRED:
        message = (
            f"in {100 * inferred.mean():.0f} % of the frames, the camera infers a joint of the {view.side} arm "
            "instead of tracking it"
        )
        yield view.issue("warning", "arm-inferred", message, "keep the arm in view", int(np.argmax(inferred)))


def _hand(view: _View) -> Iterator[RecordingIssue]:
    lost = view.confidence[:, [2, 4, 5]].min(axis=1) < 1.0
    if lost.mean() > _HAND_LOST:
        message = (
            f"in {100 * lost.mean():.0f} % of the frames, the wrist, the hand tip or the thumb is not tracked; in "
            "these frames, the tool will not rotate with the hand"
        )
        yield view.issue("note", "hand-lost", message, "use orientation 'fixed', or spread the thumb while recording")


def _limbs(view: _View) -> Iterator[RecordingIssue]:
    known = view.confidence[:, :3].min(axis=1)
    lengths = np.linalg.norm(np.diff(view.points[:, :3], axis=1), axis=2)
    tracked = lengths[known >= 1.0]
    for i, name in enumerate(("upper arm", "forearm")):
        seen = (tracked if len(tracked) >= _FEW else lengths[known > 0.0])[:, i]
        if len(seen) < _FEW:
            continue
        length = float(np.median(seen))
        deviation = _MAD_TO_SIGMA * float(np.median(np.abs(seen - length)))
        if not _LIMB[0] <= length <= _LIMB[1]:
            unit = length_unit_that_fits(length)
            remedy = "check the joints" if unit is None else f"the positions seem to be in {unit}: convert them"
            message = f"the {name} is {length:.2f} m long"
            yield view.issue("error", "limb-length", message, f"positions must be in metres; {remedy}")
        elif deviation > _SPREAD * length and len(tracked) >= _FEW:
            spread = f"{100 * deviation / length:.0f} % around its median of {100 * length:.0f} cm"
            message = f"the measured length of the {name} varies by {spread}"
            yield view.issue("warning", "limb-length", message, "record with more light, or face the sensor")


def _sides(view: _View) -> Iterator[RecordingIssue]:
    if view.swapped:
        message = f"left and right are swapped in {len(view.swapped)} frames"
        yield view.issue(
            "warning",
            "sides-swapped",
            message,
            "repair the recording to swap left and right back in these frames",
            view.swapped[0],
        )
    if view.other_axes is not None:
        return
    across = view.positions[:, JOINT["shoulder_right"], 0] - view.positions[:, JOINT["shoulder_left"], 0]
    seen = np.isfinite(across)
    turned = seen & (across < 0.0)
    if seen.any() and turned.sum() > max(_TURNED * seen.sum(), len(view.swapped)):
        message = (
            f"in {100 * turned.sum() / seen.sum():.0f} % of the frames, the left shoulder is where the right shoulder "
            "should be: the person faces away from the sensor, or the image is mirrored"
        )
        yield view.issue(
            "warning", "turned-away", message, "face the sensor, and do not mirror the image", int(np.argmax(turned))
        )
