"""PartFile: a text file that grows line by line beside its name, and is given that name when it is whole."""

from __future__ import annotations

import os
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path

from imitarm.errors import InputError

PART = ".part"
"""What is added to a file's name while it is being written."""


class PartFile:
    """What a recorder writes to: ``PATH.part``, until it is finished.

    Each text is handed to the operating system before :meth:`write` returns: a program that is killed leaves all of it
    in ``PATH.part``. An older file ``PATH`` stays whole until the new one is.

    Args:
        path: where to in the end.
        begin: what is written first.
        replace: an existing file may be replaced.

    Attributes:
        path: where to in the end.
        part: where to until then.

    Raises:
        InputError: when the path is a folder, the file is there already and may not be replaced, another program has
            left or is writing ``PATH.part``, or it can't be written.
    """

    def __init__(self, path: str | Path, begin: str, *, replace: bool = False) -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART)
        if self.path.is_dir():
            raise InputError(f"{path}: is a folder; name a file in it")
        if self.path.exists() and not replace:
            raise InputError(f"{path}: is there already; name another file, or say that it may be replaced")
        try:
            self._file: TextIOWrapper | None = self.part.open("x", encoding="utf-8", newline="\n")
            self._file.write(begin)
            self._file.flush()
        except FileExistsError as error:
            raise InputError(
                f"{self.part}: was left by a recording that was not closed, or is being written; give it another "
                "name to keep it, or remove it"
            ) from error
        except OSError as error:
            raise InputError(f"{self.part}: can't be written: {error.strerror or error}") from error

    def write(self, text: str) -> None:
        """Add a text.

        Raises:
            InputError: when it is finished, or the disk is full.
        """
        if self._file is None:
            raise InputError(f"{self.path}: this recorder is closed; make another one")
        try:
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            raise InputError(f"{self.part}: can't be written: {error.strerror or error}") from error

    def finish(self, take: Callable[[Path], bool], *, begin: str = "") -> None:
        """Let all of it reach the disk, and give it its name or remove it.

        A second call does nothing.

        Args:
            take: is given ``part`` and makes ``path`` of it, or nothing; returns whether it renamed it. If not, it is
                removed; if so, another recorder may have begun one of that name, which is left alone.
            begin: replaces what was written first, and is as long.

        Raises:
            InputError: when that is not possible; what was written stays in ``part``.
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
