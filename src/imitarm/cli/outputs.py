"""Where a command writes: whatever would be lost by that is found out before the work."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from imitarm.errors import InputError

PAGE = "--report"
"""The option that names a page; an older page may be replaced by it."""

_BEGINS = ("<!doctype html", "<html")  # of an HTML page


def check_outputs(
    outputs: Sequence[tuple[str, Path | None]],
    inputs: Sequence[tuple[str, str | Path | None]],
    *,
    force: bool | None = None,
    new_folders: bool = False,
) -> None:
    """Refuse to write where an input, another output or a file that was there would be lost.

    Args:
        outputs: the option and the file of each that is written; None: it is not.
        inputs: the option or the argument of each that is read, and the file, or a source that may be none.
        force: files that are there may be replaced; None: the command has no such option.
        new_folders: the command makes folders that are missing.

    Raises:
        InputError: when an output is a folder or in no folder, is the file of an input or of another output, or is
            there already and may not be replaced. ``--report`` replaces an HTML page always.
    """
    taken = [(name, file) for name, word in inputs if word is not None for file in _files(word)]
    for option, path in outputs:
        if path is None:
            continue
        said = f"{option} {path}"
        if path.is_dir():
            raise InputError(f"{said}: is a folder; name a file in it")
        if not new_folders and not path.absolute().parent.is_dir():
            raise InputError(f"{said}: there is no folder {path.parent}; make it first")
        for name, other in taken:
            if same_place(path, other):
                raise InputError(f"{said}: is the file of {name}, too, and would be lost; name another one")
        taken.append((option, path))
        if path.exists() and not force and not (option == PAGE and _is_page(path)):
            what = " and is no HTML page" if option == PAGE else ""
            way = "" if force is None else ", or replace it with --force"
            raise InputError(f"{said}: is there already{what}; name another file{way}")


def same_place(one: Path, other: Path) -> bool:
    """Whether two paths lead to the same file or folder, which need not be there yet."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return _place(one) == _place(other)


def _place(path: Path) -> str:
    return os.path.normcase(os.path.realpath(path))


def _files(word: str | Path) -> tuple[Path, ...]:
    """Return the files that a source may mean."""
    text = str(word)
    return Path(text), Path(text.removeprefix("video:"))


def _is_page(path: Path) -> bool:
    """Whether a file is an HTML page, or empty, so that nothing is lost."""
    if not path.is_file():  # a pipe or a device, which must not be waited for
        return False
    try:
        with path.open("rb") as file:
            begin = file.read(256).removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    except OSError as error:
        raise InputError(f"{PAGE} {path}: can't be read: {error.strerror or error}") from error
    return not begin or begin.startswith(tuple(text.encode() for text in _BEGINS))
