"""Read demonstrations: the function ``read``, its options, and the registry of readers.

The first reader in ``READERS`` that recognises the content of a file converts the file to a
:class:`~imitarm.demonstrations.raw.RawDemonstration`. A raw demonstration whose numbers are all valid becomes a
:class:`~imitarm.trajectory.Demonstration`.
"""

from __future__ import annotations

import os
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.raw import RawDemonstration, check_notes
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import kind_of, read_bytes
from imitarm.registry import Registry
from imitarm.trajectory import Demonstration
from imitarm.validation import choice, finite_number, flag, text

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]
Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

LENGTH_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
QUATERNION_ORDERS = {"wxyz": (0, 1, 2, 3), "xyzw": (3, 0, 1, 2)}

_HEAD = 65536  # bytes of a file that a reader sees before it says whether it recognises the format


@dataclass(frozen=True)
class ReadOptions:
    """Options for facts that some files do not state, such as units.

    Attributes:
        units: unit of lengths, a key of ``LENGTH_UNITS``; None: the unit that the file states, else m.
        time_units: unit of time stamps, a key of ``TIME_UNITS``; None: the unit that the file states, else s.
        duration: duration of the motion [s], for files without time stamps.
        rate: samples per second [Hz], for files without time stamps.
        quaternion_order: ``"wxyz"`` or ``"xyzw"``, for quaternion columns without names; None: the order that the
            file states, else wxyz.
        task: name of the task; used if the file does not state a task.

    Raises:
        InputError: when a value is invalid.
    """

    units: str | None = None
    time_units: str | None = None
    duration: float | None = None
    rate: float | None = None
    quaternion_order: str | None = None
    task: str = ""

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("unit of length", self.units, LENGTH_UNITS),
            ("unit of time", self.time_units, TIME_UNITS),
            ("quaternion order", self.quaternion_order, QUATERNION_ORDERS),
        ):
            if name is not None:
                choice(name, known, kind)
        for what, value in (("duration", self.duration), ("rate", self.rate)):
            if value is not None:
                finite_number(value, what, above=0.0)
        if self.duration is not None and self.rate is not None:
            raise InputError("give duration or rate, not both")
        text(self.task, "task")

    def metres(self, source: str, positions: Array, said: str | None = None) -> Array:
        """Return ``positions`` in metres; ``said`` is the unit that the file states, or None.

        Raises:
            FileFormatError: when the file names an unknown unit.
            InputError: when the option contradicts the file.
        """
        return positions * _factor(source, "units", self.units, said, LENGTH_UNITS, "m")

    def seconds(self, source: str, times: Array, said: str | None = None) -> Array:
        """Return time stamps (n,) in seconds; ``said`` is the unit that the file states, or None.

        Raises:
            FileFormatError: when the file names an unknown unit.
            InputError: when the option contradicts the file, or when a duration or rate is given for a file with time
                stamps.
        """
        if self.duration is not None or self.rate is not None:
            raise InputError(f"{source}: has its own time stamps; leave out duration and rate")
        return times * _factor(source, "time_units", self.time_units, said, TIME_UNITS, "s")

    def even_times(self, source: str, n: int) -> Array:
        """Return evenly spaced times (n,) [s] for a file without time stamps.

        Raises:
            FileFormatError: when neither duration nor rate was given.
        """
        if self.duration is not None:
            return np.linspace(0.0, self.duration, n)
        if self.rate is not None:
            return np.arange(n) / self.rate
        raise FileFormatError(
            f"{source}: has no time stamps; give the duration of the motion, duration=10.0 [s], or the sample rate, "
            f"rate=100.0 [Hz]"
        )

    def wxyz(self, source: str, quaternions: Array, said: str | None = None) -> Array:
        """Return quaternions (..., 4) from columns without names, in the order w, x, y, z.

        ``said`` is the order that the file states; None if it states no order.

        Raises:
            InputError: when the option contradicts the file.
        """
        if None not in (self.quaternion_order, said) and self.quaternion_order != said:
            raise InputError(
                f"{source}: states the quaternion order {said}, but this contradicts "
                f"quaternion_order={self.quaternion_order!r}; "
                f"leave out that option"
            )
        return quaternions[..., list(QUATERNION_ORDERS[self.quaternion_order or said or "wxyz"])]


def _factor(
    source: str, option: str, asked: str | None, said: str | None, known: dict[str, float], default: str
) -> float:
    if said is not None and said not in known:
        raise FileFormatError(f"{source}: states the unit {said!r}; known units: {', '.join(known)}")
    if asked is not None and said is not None and asked != said:
        raise InputError(
            f"{source}: states the unit {said}, but this contradicts {option}={asked!r}; leave out the option"
        )
    return known[asked or said or default]


@dataclass(frozen=True)
class SaidUnits:
    """Units and quaternion order that the remarks of a file state; a value is None if no remark states it."""

    length: str | None = None
    time: str | None = None
    angle: str | None = None
    quaternion_order: str | None = None


class Reader(ABC):
    """Reads one file format.

    To add a format, write one subclass and register it. Inside this package, add the subclass to ``READERS``. In
    another package, declare an entry point in the group ``imitarm.readers``. The format then works in ``read``,
    ``imitarm lint`` and ``imitarm learn``.

    Attributes:
        suffixes: suffixes of file names in lower case, with the dot, such as ``(".csv", ".txt")``.
    """

    suffixes: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def recognises(self, head: bytes) -> bool:
        """Return whether a file has this format; ``head`` is its first 64 kB. The name of the file is not used."""

    @abstractmethod
    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Read a file of this format and return the motions in it.

        Raises:
            FileFormatError: when the file is damaged; the message names file, place and remedy.
            InputError: when the options do not fit the file.
        """


_BUILT_IN = {
    "imitarm CSV": "imitarm.demonstrations.text_tables:ImitarmReader",
    "NumPy arrays": "imitarm.demonstrations.arrays:NumpyReader",
    "text table": "imitarm.demonstrations.text_tables:TextTableReader",
}
READERS: Registry[type[Reader]] = Registry("reader", "imitarm.readers", _BUILT_IN)
"""Readers by name: the built-in readers, and readers that other packages add by entry points."""


def files_of(paths: Paths) -> list[str]:
    """Return the files to read; a folder is replaced by those of its files whose suffix belongs to a reader.

    The files of a folder are sorted in natural order, ``demo_2`` before ``demo_10``. Subfolders are ignored.

    Raises:
        InputError: when there are no files, or no file of a folder has a suffix that belongs to a reader.
    """
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    paths = list(paths) if isinstance(paths, Iterable) else [paths]
    if not all(isinstance(path, str | os.PathLike) for path in paths):
        raise InputError(f"paths must be a file, a folder or several of them, got {paths!r:.80}")
    files: list[str] = []
    for path in [os.fspath(path) for path in paths]:
        if Path(path).is_dir():
            suffixes = sorted({suffix for reader in READERS.values() for suffix in reader.suffixes})
            inside = [p for p in Path(path).iterdir() if p.suffix.lower() in suffixes]
            inside = [p for p in inside if p.is_file() and not p.name.startswith(".")]
            if not inside:
                raise InputError(f"{path}: the folder holds no demonstrations; known endings: {', '.join(suffixes)}")
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
    quaternion_order: str | None = None,
    task: str = "",
    thin: bool = False,
) -> list[RawDemonstration]:
    """Read files without checking the numbers in them; for the options, see :func:`read`.

    Raises:
        InputError: when a file can't be opened, or an option does not fit the file.
        FileFormatError: when a file can't be understood; the message names file, place and remedy.
    """
    flag(thin, "read: thin")
    options = ReadOptions(units, time_units, duration, rate, quaternion_order, task)
    raw = [one for path in files_of(paths) for one in _reader_of(path).read(path, options)]
    return [one.thinned() for one in raw] if thin else raw


def read(
    paths: Paths,
    *,
    units: str | None = None,
    time_units: str | None = None,
    duration: float | None = None,
    rate: float | None = None,
    quaternion_order: str | None = None,
    arm: ArmModel | None = None,
    task: str = "",
    repair: bool = False,
    thin: bool = False,
) -> list[Demonstration]:
    """Read demonstrations from a file, several files or a folder.

    The content of a file, not its name, decides its format.

    Args:
        paths: a file, a folder, or several of them.
        units: unit of lengths, ``"m"``, ``"cm"``, ``"mm"``, ``"in"`` or ``"ft"``; None: the unit that the file states,
            else m.
        time_units: unit of time stamps, ``"s"``, ``"ms"``, ``"us"``, ``"ns"``, ``"min"`` or ``"h"``; None: the unit
            that the file states, else s.
        duration: duration of each motion [s], for files without time stamps.
        rate: samples per second [Hz], for files without time stamps.
        quaternion_order: ``"wxyz"`` or ``"xyzw"``, for quaternion columns without names; None: the order that the
            file states, else wxyz.
        arm: arm that was recorded, with its tool; needed for files that contain only joint angles.
        task: name of the task; used if the file does not state a task.
        repair: whether to drop rows with numbers that are not finite, and rows whose time stamp is not later than that
            of the previous row. The ``source`` of the demonstration states how many rows were dropped.
        thin: whether to drop rows that only repeat the previous row (see :meth:`RawDemonstration.held`).

    Returns:
        One demonstration for each motion, in the order of the files. Planar motions (x y) get z = 0.

    Raises:
        InputError: when a file can't be opened, or an option does not fit the file.
        FileFormatError: when a file is damaged or can't be understood; the message names file, line and remedy.
    """
    flag(repair, "read: repair")
    raw = read_raw(
        paths,
        units=units,
        time_units=time_units,
        duration=duration,
        rate=rate,
        quaternion_order=quaternion_order,
        task=task,
        thin=thin,
    )
    for one in raw:
        if one.unread_rotation:
            warnings.warn(str(next(check_notes(one))), UserWarning, stacklevel=2)
    return [one.demonstration(arm, repair=repair) for one in raw]


def known_formats() -> str:
    """Return the names of all formats with their suffixes, for messages."""
    return ", ".join(f"{name} ({' '.join(reader.suffixes)})" for name, reader in READERS.items())


def _reader_of(path: str) -> Reader:
    """Return the reader that recognises the content of a file; the suffix of the file's name must not contradict it.

    Readers of other packages are tried first, because the built-in text table reader accepts any text. The built-in
    readers that know the suffix are tried next, and the other built-in readers last.
    """
    content = read_bytes(path)
    suffix, head = Path(path).suffix.lower(), content[:_HEAD]
    names = sorted(READERS, key=lambda name: (name in _BUILT_IN, suffix not in READERS[name].suffixes))
    name = next((name for name in names if READERS[name]().recognises(head)), None)
    kind = kind_of(content) or "text"
    if name is None:
        raise FileFormatError(f"{path}: this is {kind}; known formats: {known_formats()}")
    by_suffix = [name for name in names if suffix in READERS[name].suffixes]
    if by_suffix and name not in by_suffix and not any(READERS[name]().recognises(head) for name in by_suffix):
        raise FileFormatError(
            f"{path}: named {suffix} ({by_suffix[0]}), but its content is {kind} ({name}); rename the file with the "
            f"suffix of its format"
        )
    return READERS[name]()


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a sort key for a file name; numbers in names are compared by their values, so that 2 comes before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", path.name)]
