"""PartFile: a text file that grows line by line as ``PATH.part``, and is renamed when it is complete."""

from __future__ import annotations

import os
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path

from imitarm.errors import InputError

PART = ".part"
"""The suffix that is added to a file's name while it is written."""


class PartFile:
    """A text file for recorders; the file is called ``PATH.part`` until it is finished, and ``PATH`` afterwards.

    :meth:`write` hands its text to the operating system before it returns. If the program is killed, ``PATH.part``
    therefore contains all written text. An older file ``PATH`` stays intact until the new one is complete.

    Args:
        path: path of the finished file.
        begin: text at the beginning of the file.
        replace: whether an existing file may be replaced.

    Attributes:
        path: path of the finished file.
        part: path of the file until it is finished.

    Raises:
        InputError: when the path is a folder, when the file exists and may not be replaced, or when it can't be
            written. Also when ``PATH.part`` exists, because another program is writing this file or was killed.
    """

    def __init__(self, path: str | Path, begin: str, *, replace: bool = False) -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART)
        if self.path.is_dir():
            raise InputError(f"{path}: is a folder; name a file in that folder")
        if self.path.exists() and not replace:
            raise InputError(f"{path}: already exists; name another file, or allow it to be replaced")
        try:
            self._file: TextIOWrapper | None = self.part.open("x", encoding="utf-8", newline="\n")
            self._file.write(begin)
            self._file.flush()
        except FileExistsError as error:
            raise InputError(
                f"{self.part}: an earlier recording left this file unfinished, or another program is writing it; "
                f"rename the file to keep it, or remove it"
            ) from error
        except OSError as error:
            raise InputError(f"{self.part}: can't be written: {error.strerror or error}") from error

    def write(self, text: str) -> None:
        """Append text to the file.

        Raises:
            InputError: when the file is finished, or the disk is full.
        """
        if self._file is None:
            raise InputError(f"{self.path}: this recorder is closed; create another one")
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            raise InputError(f"{self.part}: can't be written: {error.strerror or error}") from error

    def finish(self, take: Callable[[Path], bool], *, begin: str = "") -> None:
        """Write all text to the disk, then call ``take``, which creates ``PATH`` from ``PATH.part``.

        Calling this method again does nothing.

        Args:
            take: function that is called with the path ``part``. The function may create ``PATH`` from ``PATH.part``,
                and returns whether ``PATH.part`` was renamed. If ``take`` returns False, ``PATH.part`` is removed. If
                ``take`` returns True, no file is removed: a file ``PATH.part`` that exists now belongs to another
                recorder.
            begin: text that replaces the text ``begin`` of the constructor; the two texts must have the same length.

        Raises:
            InputError: when the file can't be completed; the written text stays in ``part``.
        """
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            with file:
                if begin:
                    file.seek(0)
                    file.write(begin)
                file.flush()
                os.fsync(file.fileno())
            if not take(self.part):
                self.part.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{self.path}: can't be written: {error.strerror or error}") from error
