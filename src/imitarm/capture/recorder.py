"""SkeletonRecorder: writes skeletons to a file as they come, so that nothing is lost when the program is killed."""

from __future__ import annotations

import os
from io import TextIOWrapper
from pathlib import Path
from typing import Self

from imitarm.capture.native import UNFINISHED, header, line_of
from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError

PART = ".part"
"""What is added to a file's name while it is being written."""


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
        self._part = self.path.with_name(self.path.name + PART)
        if self.path.is_dir():
            raise InputError(f"{path}: is a folder; name a file in it")
        if self.path.exists() and not replace:
            raise InputError(f"{path}: is there already; name another file, or say that it may be replaced")
        try:
            self._file: TextIOWrapper | None = self._part.open("x", encoding="utf-8", newline="\n")
            self._file.write(header(source, UNFINISHED))
            self._file.flush()
        except FileExistsError as error:
            raise InputError(
                f"{self._part}: was left by a recording that was not closed, or is being written; read it and save it "
                "under another name, or remove it"
            ) from error
        except OSError as error:
            raise InputError(f"{self._part}: can't be written: {error.strerror or error}") from error
        self._source = source

    def write(self, skeleton: Skeleton) -> None:
        """Add a skeleton.

        Raises:
            InputError: when the recorder is closed, or the disk is full.
        """
        if self._file is None:
            raise InputError(f"{self.path}: this recorder is closed; make another one")
        try:
            self._file.write(line_of(skeleton))
            self._file.flush()
        except OSError as error:
            raise InputError(f"{self._part}: can't be written: {error.strerror or error}") from error
        self.n_frames += 1

    def close(self) -> None:
        """Write down how many frames there are and give the file its name; without any frame there is no file.

        A second call does nothing.

        Raises:
            InputError: when that is not possible; what was written stays in ``PATH.part``.
        """
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            with file:
                file.seek(0)
                file.write(header(self._source, str(self.n_frames)))
                file.flush()
                os.fsync(file.fileno())
            if self.n_frames:
                self._part.replace(self.path)
            else:
                self._part.unlink()
        except OSError as error:
            raise InputError(f"{self.path}: can't be written: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
