"""Check the output files of a command before its work begins, so that no file is overwritten by accident."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from imitarm.errors import InputError

PAGE = "--report"
"""The option that names a report page; a new report may replace an older one without --force."""

_BEGINS = ("<!doctype html", "<html")  # first characters of an HTML page


def check_outputs(
    outputs: Sequence[tuple[str, Path | None]],
    inputs: Sequence[tuple[str, str | Path | None]],
    *,
    force: bool | None = None,
    new_folders: bool = False,
) -> None:
    """Reject outputs that would overwrite an input, another output or an existing file.

    Args:
        outputs: for each output, its option and its file; None instead of the file if this output is not written.
        inputs: for each input, the name of the option or argument, and its value: a file or the name of a source.
        force: whether existing files may be replaced; None if the command has no option ``--force``.
        new_folders: whether the command creates missing folders.

    Raises:
        InputError: when an output is a folder, its folder is missing, it is also an input or another output, or it
            exists and may not be replaced. An HTML page of ``--report`` may always be replaced.
    """
    taken = [(name, file) for name, word in inputs if word is not None for file in _files(word)]
    for option, path in outputs:
        if path is None:
            continue
        named = f"{option} {path}"
        if path.is_dir():
            raise InputError(f"{named}: is a folder; name a file in it")
        if not new_folders and not path.absolute().parent.is_dir():
            raise InputError(f"{named}: there is no folder {path.parent}; create it first")
        for name, other in taken:
            if same_place(path, other):
                raise InputError(f"{named}: is also the file of {name} and would be overwritten; name another file")
        taken.append((option, path))
        if path.exists() and not force and not (option == PAGE and _is_page(path)):
            what = "already exists and is not an HTML page" if option == PAGE else "already exists"
            remedy = "name another file" if force is None else "name another file, or replace it with --force"
            raise InputError(f"{named}: {what}; {remedy}")


def same_place(one: Path, other: Path) -> bool:
    """Return whether two paths denote the same file or folder, which need not exist yet."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return _place(one) == _place(other)


def _place(path: Path) -> str:
    return os.path.normcase(os.path.realpath(path))


def _files(word: str | Path) -> tuple[Path, ...]:
    """Return the files that the name of a source may refer to."""
    text = str(word)
    return Path(text), Path(text.removeprefix("video:"))


def _is_page(path: Path) -> bool:
    """Return whether a file is an HTML page or empty."""
    if not path.is_file():  # a pipe or a device: reading it could block
        return False
    try:
        with path.open("rb") as file:
            begin = file.read(256).removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    except OSError as error:
        raise InputError(f"{PAGE} {path}: cannot be read: {error.strerror or error}") from error
    return not begin or begin.startswith(tuple(text.encode() for text in _BEGINS))
