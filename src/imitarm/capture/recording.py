"""SkeletonRecording: recorded skeletons, to be inspected, cut, slowed down, replayed and saved."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Final, Self

import numpy as np

from imitarm.capture.formats import (
    TICK,
    UNFINISHED,
    is_motion_capture,
    is_native,
    native_header,
    native_line,
    read_kinect_table,
    read_motion_capture,
    read_native,
)
from imitarm.capture.issue import RecordingIssue
from imitarm.capture.skeleton import Skeleton, SkeletonSource, Tracking
from imitarm.errors import InputError
from imitarm.files.part_file import PART, PartFile
from imitarm.files.table import read_bytes
from imitarm.validation import finite_number, instance

SLOWEST: Final = 0.05
_GAP: Final = 0.25  # [s] a longer gap in a recording is not filled with frames


class SkeletonRecording(SkeletonSource):
    """Skeletons in the order in which they were recorded.

    A recording is also a source that replays its skeletons.

    The constructor does not check the skeletons: their times may decrease, and they may show several persons.
    :func:`~imitarm.capture.checks.check` lists the faults.

    Args:
        skeletons: skeletons in the order in which they were recorded.
        name: name of the recording in messages, for example the file's name.
        realtime: True: replay at the recorded speed. False: replay as fast as the skeletons are read.
        issues: issues found while the file was read.
        time_unit: unit of the file's time stamps, given by its length [s]. Messages about implausible times name this
            unit.

    Attributes:
        skeletons: all skeletons, in the order in which they were recorded.
        issues: issues found while the file was read.
        time_unit: unit of the file's time stamps, given by its length [s].
    """

    argument = "FILE"
    description = "a recording: imitarm's own format, a Kinect SDK table, or motion capture"
    has_realtime = True

    def __init__(
        self,
        skeletons: Iterable[Skeleton],
        *,
        name: str = "recording",
        realtime: bool = False,
        issues: Iterable[RecordingIssue] = (),
        time_unit: float = 1.0,
    ) -> None:
        self.skeletons = tuple(instance(s, Skeleton, "SkeletonRecording: each item of skeletons") for s in skeletons)
        self.issues = tuple(issues)
        self.time_unit = time_unit
        self.name = name
        self._realtime = realtime
        self.rewind()

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> SkeletonRecording:
        """Read a recording; see :func:`read_recording`."""
        return read_recording(argument, realtime=realtime)

    def __len__(self) -> int:
        return len(self.skeletons)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest frame [s]."""
        times = [skeleton.time for skeleton in self.skeletons]
        return max(times) - min(times) if times else 0.0

    @property
    def persons(self) -> tuple[int, ...]:
        """Numbers of the recorded persons, in order of appearance."""
        return tuple(dict.fromkeys(skeleton.person for skeleton in self.skeletons))

    @property
    def rate(self) -> float:
        """Inverse of the median time between frames [Hz]; 0 if the recording has fewer than two frames."""
        steps = np.diff(np.unique([skeleton.time for skeleton in self.skeletons]))
        return float(1.0 / np.median(steps)) if len(steps) else 0.0

    # --- parts of it

    def person(self, number: int) -> SkeletonRecording:
        """Return the skeletons of one person.

        Raises:
            InputError: when the person is not in the recording; the message lists the persons in it.
        """
        kept = [skeleton for skeleton in self.skeletons if skeleton.person == number]
        if not kept:
            who = ", ".join(str(person) for person in self.persons) or "nobody"
            raise InputError(f"{self.name}: person {number} is not in this recording, which contains: {who}")
        return self.with_skeletons(kept)

    def trim(self, start: float = 0.0, end: float | None = None) -> SkeletonRecording:
        """Return the part of the recording between two times; the time stamps do not change.

        Args:
            start: start of the part, counted from the first frame [s].
            end: end of the part, counted from the first frame [s]; None: the last frame.

        Raises:
            InputError: when there is no frame between the two times.
        """
        start = finite_number(start, "SkeletonRecording.trim: start", "s")
        first = min((skeleton.time for skeleton in self.skeletons), default=0.0)
        last = self.duration if end is None else finite_number(end, "SkeletonRecording.trim: end", "s")
        kept = [s for s in self.skeletons if start - 1e-9 <= s.time - first <= last + 1e-9]
        if not kept:
            raise InputError(
                f"{self.name}: no frame between {start:g} and {last:g} s; "
                f"the recording goes from 0 to {self.duration:.2f} s"
            )
        return self.with_skeletons(kept)

    def with_skeletons(self, skeletons: Iterable[Skeleton]) -> SkeletonRecording:
        """Return a recording with the given skeletons; name, issues and time unit are those of this recording."""
        return SkeletonRecording(
            skeletons, name=self.name, realtime=self._realtime, issues=self.issues, time_unit=self.time_unit
        )

    def save(self, path: str | Path, *, replace: bool = True) -> None:
        """Write the recording in imitarm's own format, which preserves all numbers exactly.

        Args:
            path: file to write; its name ends in ``.part`` until the file is complete.
            replace: whether an existing file may be replaced.

        Raises:
            InputError: when there are no skeletons, or the file can't be written.
        """
        if not self.skeletons:
            raise InputError(f"{path}: not written: {self.name} holds no skeletons; was a person in view?")
        with SkeletonRecorder(path, source=self.name, replace=replace) as recorder:
            for skeleton in self.skeletons:
                recorder.write(skeleton)

    # --- as a source

    def rewind(self) -> None:
        """Restart the replay at the first frame."""
        self._next = 0
        self._began: float | None = None

    def __iter__(self) -> Iterator[Skeleton]:
        if self.over:  # so that a second loop is over all of it, too
            self.rewind()
        return super().__iter__()

    @property
    def over(self) -> bool:
        """Whether the whole recording has been replayed."""
        return self._next >= len(self.skeletons)

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None at the end, or if a real-time replay waits longer than ``timeout`` seconds."""
        if self.over:
            return None
        skeleton = self.skeletons[self._next]
        if self._realtime:
            now = clock.monotonic()
            self._began = now if self._began is None else self._began
            wait = self._began + skeleton.time - self.skeletons[0].time - now
            clock.sleep(min(max(wait, 0.0), max(timeout, 0.0)))
            if wait > timeout:
                return None
        self._next += 1
        return skeleton


def read_recording(path: str | Path, *, realtime: bool = False) -> SkeletonRecording:
    """Read a recording: imitarm's own format, a Kinect SDK table, or motion capture.

    The format is detected from the content.

    Args:
        path: path of the file, or of the ``.part`` file that a killed recorder left.
        realtime: whether to replay at the recorded speed.

    Raises:
        InputError: when there is no such file.
        FileFormatError: when the file is not a recording of skeletons or was cut off; the message names file, line and
            remedy.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    if not path.exists() and part.exists():
        raise InputError(f"{path}: this file does not exist; read {part} instead, which an interrupted recording left")
    content = read_bytes(path)
    head = content[:65536]
    unit = 1.0
    if is_motion_capture(head):
        skeletons, issues = read_motion_capture(str(path))
    elif is_native(head):
        skeletons, issues = read_native(str(path), content)
    else:
        skeletons, issues = read_kinect_table(str(path), content)
        unit = TICK
    return SkeletonRecording(skeletons, name=path.name, realtime=realtime, issues=issues, time_unit=unit)


class SkeletonRecorder:
    """Writes each skeleton as a line of ``PATH.part``, and renames the file to ``PATH`` when the recorder is closed.

    Each line is handed to the operating system before :meth:`write` returns. A program that is killed therefore loses
    at most the frame that it was writing. :func:`read_recording` can read the file ``PATH.part`` that such a program
    leaves. An older file ``PATH`` stays intact until the new one is complete.

    Args:
        path: path of the file.
        source: where the skeletons come from; this text is written into the file.
        replace: whether an existing file may be replaced.

    Attributes:
        path: path of the file.
        n_frames: number of frames written so far.

    Raises:
        InputError: when the file exists and may not be replaced, or when it can't be written. Also when ``PATH.part``
            exists, because another recorder is writing this file or was killed.
    """

    def __init__(self, path: str | Path, *, source: str = "", replace: bool = False) -> None:
        self.path, self.n_frames = Path(path), 0
        self._source = source
        self._file = PartFile(path, native_header(source, UNFINISHED), replace=replace)

    def write(self, skeleton: Skeleton) -> None:
        """Add a skeleton.

        Raises:
            InputError: when the recorder is closed, or the disk is full.
        """
        self._file.write(native_line(skeleton))
        self.n_frames += 1

    def close(self) -> None:
        """Write the number of frames into the header and rename the file; a recorder without frames leaves no file.

        A second call does nothing.

        Raises:
            InputError: when the file can't be completed; the frames stay in ``PATH.part``.
        """
        self._file.finish(self._take, begin=native_header(self._source, str(self.n_frames)))

    def _take(self, part: Path) -> bool:
        if self.n_frames:
            part.replace(self.path)
        return self.n_frames > 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def slowed(skeletons: Sequence[Skeleton], pace: float) -> list[Skeleton]:
    """Slow a recording down, for a robot whose joints are slower than a person's.

    Frames are inserted so that the frame rate stays about the same. In an inserted frame, the joints are interpolated
    linearly between the previous and the next original frame. A joint that is lost in one of the two original frames
    keeps its position from the previous frame. If two original frames are more than 0.25 s apart, no frames are
    inserted between them.

    Args:
        skeletons: skeletons in the order of their times.
        pace: fraction of the recorded speed, 0.05 to 1.

    Raises:
        InputError: when the pace is out of range.
    """
    finite_number(pace, "pace (a recording can only be slowed)", at_least=SLOWEST, at_most=1.0)
    if pace == 1.0 or not skeletons:
        return list(skeletons)
    start, parts = skeletons[0].time, int(np.ceil(1.0 / pace))
    slow = [replace(skeleton, time=start + (skeleton.time - start) / pace) for skeleton in skeletons]
    done: list[Skeleton] = []
    for before, after in pairwise(slow):
        done.append(before)
        if after.time - before.time <= _GAP / pace:
            done += [_between(before, after, k / parts) for k in range(1, parts)]
    return [*done, slow[-1]]


def _between(before: Skeleton, after: Skeleton, fraction: float) -> Skeleton:
    """Interpolate between two skeletons of a person, at ``fraction`` of the time from the first to the second."""
    tracking = np.minimum(before.tracking, after.tracking)
    lost = tracking == Tracking.LOST
    positions = before.positions + fraction * (after.positions - before.positions)
    positions[lost], tracking[lost] = before.positions[lost], before.tracking[lost]
    return Skeleton(
        before.time + fraction * (after.time - before.time), positions, tracking, before.hand_states, before.person
    )
