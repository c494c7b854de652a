"""SkeletonRecording: skeletons that were recorded, to look at, cut and replay; read_recording reads them."""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from imitarm.capture import kinect_csv, mocap_tsv, native
from imitarm.capture.finding import Finding
from imitarm.capture.recorder import SkeletonRecorder
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.errors import InputError
from imitarm.files.part_file import PART
from imitarm.files.table import read_bytes


class SkeletonRecording(SkeletonSource):
    """Skeletons in the order in which they were recorded; as a source it replays them once.

    Nothing is judged and nothing is changed: times may run backwards, several persons may be in it. What is wrong is
    said by :func:`~imitarm.capture.checks.check`.

    Args:
        skeletons: in the order they came.
        name: for messages, for example the file's name.
        realtime: replay at the pace at which they were recorded; else as fast as they are asked for.
        findings: what was found while reading.

    Attributes:
        skeletons: all of them.
        findings: what was found while reading.
    """

    def __init__(
        self,
        skeletons: Iterable[Skeleton],
        *,
        name: str = "recording",
        realtime: bool = False,
        findings: Iterable[Finding] = (),
    ) -> None:
        self.skeletons = tuple(skeletons)
        self.findings = tuple(findings)
        self.name = name
        self._realtime = realtime
        self.rewind()

    def __len__(self) -> int:
        return len(self.skeletons)

    @property
    def duration(self) -> float:
        """From the earliest to the latest frame [s]."""
        times = [skeleton.time for skeleton in self.skeletons]
        return max(times) - min(times) if times else 0.0

    @property
    def persons(self) -> tuple[int, ...]:
        """Who is in it, in order of appearance."""
        return tuple(dict.fromkeys(skeleton.person for skeleton in self.skeletons))

    @property
    def rate(self) -> float:
        """Frames a second, from the median time between frames [Hz]; 0 when there are fewer than two."""
        steps = np.diff(np.unique([skeleton.time for skeleton in self.skeletons]))
        return float(1.0 / np.median(steps)) if len(steps) else 0.0

    # --- parts of it

    def person(self, number: int) -> SkeletonRecording:
        """Return what concerns one person.

        Raises:
            InputError: when that person is not in it; the message says who is.
        """
        kept = [skeleton for skeleton in self.skeletons if skeleton.person == number]
        if not kept:
            who = ", ".join(str(person) for person in self.persons) or "nobody"
            raise InputError(f"{self.name}: person {number} is not in it; there is: {who}")
        return self._with(kept)

    def trim(self, start: float = 0.0, end: float | None = None) -> SkeletonRecording:
        """Return what was recorded between two moments; times stay as they are.

        Args:
            start: since the first frame [s].
            end: since the first frame [s]; None: to the last one.

        Raises:
            InputError: when nothing is left.
        """
        first = min((skeleton.time for skeleton in self.skeletons), default=0.0)
        last = self.duration if end is None else end
        kept = [s for s in self.skeletons if start - 1e-9 <= s.time - first <= last + 1e-9]
        if not kept:
            raise InputError(
                f"{self.name}: no frame between {start:g} and {last:g} s; it goes from 0 to {self.duration:.2f} s"
            )
        return self._with(kept)

    def _with(self, skeletons: Iterable[Skeleton]) -> SkeletonRecording:
        return SkeletonRecording(skeletons, name=self.name, realtime=self._realtime, findings=self.findings)

    def save(self, path: str | Path, *, replace: bool = True) -> None:
        """Write imitarm's own format, from which every skeleton is read back to the last bit.

        Args:
            path: where to; written aside and renamed.
            replace: an existing file may be replaced.

        Raises:
            InputError: when there is nothing to write, or it can't be written.
        """
        if not self.skeletons:
            raise InputError(f"{path}: not written: {self.name} holds no skeletons; was a person in the picture?")
        with SkeletonRecorder(path, source=self.name, replace=replace) as recorder:
            for skeleton in self.skeletons:
                recorder.write(skeleton)

    # --- as a source

    def rewind(self) -> None:
        """Replay from the first frame again."""
        self._next = 0
        self._began: float | None = None

    def __iter__(self) -> Iterator[Skeleton]:
        if self.over:  # so that a second loop is over all of it, too
            self.rewind()
        return super().__iter__()

    @property
    def over(self) -> bool:
        """Whether all of it has been replayed."""
        return self._next >= len(self.skeletons)

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None when it is over, or in real time not due within ``timeout`` seconds."""
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
    """Read a recording: imitarm's own format, a table of the Kinect SDK, or motion capture; the content tells which.

    Args:
        path: the file; also the ``.part`` of a recorder that was killed.
        realtime: replay at the pace at which it was recorded.

    Raises:
        InputError: when there is no such file.
        FileFormatError: when it is no recording of skeletons or was cut off; the message names file, line and remedy.
    """
    path = Path(path)
    part = path.with_name(path.name + PART)
    if not path.exists() and part.exists():
        raise InputError(f"{path}: is not there, but {part} is, left by a recording that was not closed; read that one")
    content = read_bytes(path)
    head = content[:65536]
    if mocap_tsv.recognises(head):
        skeletons, findings, _ = mocap_tsv.read(str(path), content)
    else:
        reader = native if native.recognises(head) else kinect_csv
        skeletons, findings, _ = reader.read(str(path), content)
    return SkeletonRecording(skeletons, name=path.name, realtime=realtime, findings=findings)
