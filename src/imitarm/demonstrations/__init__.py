"""Getting demonstrations ready to learn from: read, check, align.

A file becomes a :class:`RawDemonstration` by the first reader in ``READERS`` that recognises its content, and a
:class:`~imitarm.trajectory.Demonstration` when nothing in it is broken. ``lint`` names what is wrong with either,
``align`` trims and re-times demonstrations so that they can be learnt from.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from imitarm.demonstrations.align import Alignment, align, compute_alignment
from imitarm.demonstrations.arrays import NumpyReader
from imitarm.demonstrations.finding import Finding
from imitarm.demonstrations.intera import InteraReader
from imitarm.demonstrations.lint import lint
from imitarm.demonstrations.native import NativeReader
from imitarm.demonstrations.plain import PlainReader
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reader import Reader, ReadOptions
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import kind_of, read_bytes
from imitarm.trajectory import Demonstration

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
_HEAD = 65536  # bytes of a file that a reader may look at before it says whether it is its

# asked in this order; the last one takes any text
READERS: dict[str, Reader] = {
    reader.name: reader for reader in (NumpyReader(), NativeReader(), InteraReader(), PlainReader())
}
TEXT_SUFFIXES = frozenset({".csv", ".txt", ".tsv", ".dat"})
ARRAY_SUFFIXES = frozenset({".npy", ".npz"})

__all__ = [
    "READERS",
    "Alignment",
    "Finding",
    "RawDemonstration",
    "ReadOptions",
    "Reader",
    "align",
    "compute_alignment",
    "files_of",
    "lint",
    "read",
    "read_raw",
]


def files_of(paths: Paths) -> list[str]:
    """Return the files that ``paths`` means: a file itself, of a folder those with a known ending.

    Files of a folder come in natural order, ``demo_2`` before ``demo_10``; folders in it are not entered.

    Raises:
        InputError: when nothing is there, or a folder holds no such file.
    """
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    files: list[str] = []
    for path in [os.fspath(path) for path in paths]:
        if Path(path).is_dir():
            inside = [p for p in Path(path).iterdir() if p.suffix.lower() in TEXT_SUFFIXES | ARRAY_SUFFIXES]
            inside = [p for p in inside if p.is_file() and not p.name.startswith(".")]
            if not inside:
                endings = ", ".join(sorted(TEXT_SUFFIXES | ARRAY_SUFFIXES))
                raise InputError(f"{path}: the folder holds no demonstrations; known endings: {endings}")
            files += [str(p) for p in sorted(inside, key=_natural)]
        else:
            files.append(path)
    if not files:
        raise InputError("no demonstrations to read: name at least one file or folder")
    return files


def read_raw(
    paths: Paths,
    *,
    units: str | None = None,
    time_units: str | None = None,
    duration: float | None = None,
    rate: float | None = None,
    quaternion_order: str = "wxyz",
    task: str = "",
) -> list[RawDemonstration]:
    """Read files without judging what they say; options as in :func:`read`.

    Raises:
        InputError: when a file can't be opened or an option does not fit it.
        FileFormatError: when a file can't be understood; the message names file, place and remedy.
    """
    options = ReadOptions(units, time_units, duration, rate, quaternion_order, task)
    return [raw for path in files_of(paths) for raw in _reader_of(path).read(path, options)]


def read(
    paths: Paths,
    *,
    units: str | None = None,
    time_units: str | None = None,
    duration: float | None = None,
    rate: float | None = None,
    quaternion_order: str = "wxyz",
    arm: ArmModel | None = None,
    task: str = "",
    repair: bool = False,
) -> list[Demonstration]:
    """Read demonstrations from a file, several files or a folder. The format is told by the content.

    Args:
        paths: a file, a folder, or several of them.
        units: of lengths, ``"m"``, ``"cm"`` or ``"mm"``; None: as the file says, else m.
        time_units: of time stamps, ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; None: as the file says, else s.
        duration: how long each motion took [s], for files without time stamps.
        rate: samples a second [Hz], for files without time stamps.
        quaternion_order: ``"wxyz"`` or ``"xyzw"``, for quaternion columns without names.
        arm: the arm that was recorded, with its tool; needed for files that hold joint angles only.
        task: what was shown; used where the file does not say.
        repair: drop rows that are not finite or not later than the row before, and say so in ``source``.

    Returns:
        One demonstration for each motion, in the order of the files. Planar ones (x y) get z = 0.

    Raises:
        InputError: when a file can't be opened or an option does not fit it.
        FileFormatError: when a file is damaged or can't be understood; the message names file, line and remedy.
    """
    raw = read_raw(
        paths,
        units=units,
        time_units=time_units,
        duration=duration,
        rate=rate,
        quaternion_order=quaternion_order,
        task=task,
    )
    return [one.demonstration(arm, repair=repair) for one in raw]


def _reader_of(path: str) -> Reader:
    """Choose the reader by what the file holds; its name must not say otherwise."""
    content = read_bytes(path)
    suffix, kind = Path(path).suffix.lower(), kind_of(content)
    if (kind is not None and suffix in TEXT_SUFFIXES) or (kind is None and suffix in ARRAY_SUFFIXES):
        raise FileFormatError(f"{path}: named {suffix}, but it is {kind or 'text'}; give it its right name")
    for reader in READERS.values():
        if reader.recognises(content[:_HEAD]):
            return reader
    raise FileFormatError(f"{path}: this is {kind}; known formats: {', '.join(READERS)}")


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that takes the numbers in a name as numbers."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", path.name)]
