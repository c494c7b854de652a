"""SkeletonRecorder: writes skeletons to a file as they come, so that nothing is lost when the program is killed."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from imitarm.capture.native import UNFINISHED, header, line_of
from imitarm.capture.skeleton import Skeleton
from imitarm.files.part_file import PartFile


class SkeletonRecorder:
    """Writes skeletons to ``PATH.part`` one whole line at a time, and renames it to ``PATH`` when it is closed.

    Each line is handed to the operating system before :meth:`write` returns: a program that is killed loses at most
    the frame it was writing, and :func:`~imitarm.capture.recording.read_recording` reads ``PATH.part``. An older file
    ``PATH`` stays whole until the new one is.

    Args:
        path: where to.
        source: where the skeletons are from, for whoever reads the file.
        replace: an existing file may be replaced.

    Attributes:
        path: where to.
        n_frames: written so far.

    Raises:
        InputError: when the file is there already and may not be replaced, another recorder has left or is writing
            ``PATH.part``, or it can't be written.
    """

    def __init__(self, path: str | Path, *, source: str = "", replace: bool = False) -> None:
        self.path, self.n_frames = Path(path), 0
        self._source = source
        self._file = PartFile(path, header(source, UNFINISHED), replace=replace)

    def write(self, skeleton: Skeleton) -> None:
        """Add a skeleton.

        Raises:
            InputError: when the recorder is closed, or the disk is full.
        """
        self._file.write(line_of(skeleton))
        self.n_frames += 1

    def close(self) -> None:
        """Write down how many frames there are and give the file its name; without any frame there is no file.

        A second call does nothing.

        Raises:
            InputError: when that is not possible; what was written stays in ``PATH.part``.
        """
        self._file.finish(self._take, begin=header(self._source, str(self.n_frames)))

    def _take(self, part: Path) -> bool:
        if self.n_frames:
            part.replace(self.path)
        return self.n_frames > 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
