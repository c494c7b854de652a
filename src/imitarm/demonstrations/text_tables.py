"""Readers of text tables: imitarm's own CSV, and any other table of numbers.

Column names are in a separate row or in a remark. The remark may be anywhere in the file. A remark is a line that
starts with ``#`` or ``%``. If nothing in the file looks like column names, the meaning of the columns is derived from
their number. An unknown unit is an error. A remark that looks like column names but can't be understood is also an
error.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.columns import UNITS, column_of, named_columns, unnamed_columns
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reading import Reader, ReadOptions, SaidUnits
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import Table, kind_of, read_table, split_names
from imitarm.trajectory import FORMAT, read_demonstration_table

Array = NDArray[np.float64]

_NUMBERED = re.compile(r"(?:col(?:umn)?\s*)?\d+\s*[:=.)]\s*(?P<name>.+)", re.IGNORECASE)
_ENCLOSED = re.compile(r"^[(\[{]([^()\[\]{}]*)[)\]}]$")
_UNITS_REMARK = re.compile(r"(?:(?:length|position|time|angle|joint)s?[ _])?units?\s*[:=]\s*(.*)")
_OTHER_REMARK = re.compile(r"(?:task|source|date|version|(?:\w+[ _])?units?)\s*[:=].*", re.IGNORECASE)
_PROSE_UNIT = re.compile(r"\bin\s+((?!in\b|min\b|h\b)[^\W\d]+)")
_PROSE_RATE = re.compile(r"\bin\s+((?:m|cm|mm|rads?|deg|degrees|radians)\s*(?:/|per\s)\s*\w+(?:\^?[-\d]+)?)")
_ORDER = re.compile(r"\b(xyzw|wxyz)\b", re.IGNORECASE)
_SCALAR = re.compile(r"\b(?:scalar|real)(?:[\s_-]+part)?(?:[\s_-]+(?:is|comes))?[\s_-]+(first|last)\b", re.IGNORECASE)
_ANGLES = re.compile(r"\b(?:angles?|positions?)\b", re.IGNORECASE)
_NO_ANGLES = re.compile(
    r"\b(?:velocit(?:y|ies)|speeds?|accelerations?|efforts?|torques?|currents?|joint commands?)\b", re.IGNORECASE
)
_NATIVE_MARK = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s*[#%][^\n]*\n)*?\s*[#%]\s*format:\s*" + FORMAT.encode() + rb"\b")


class ImitarmReader(Reader):
    """Reads imitarm's own CSV format.

    Remarks state the units and the frame. The columns contain the time, the tool's position and quaternion, and the
    joint positions.
    """

    suffixes = (".csv",)

    def recognises(self, head: bytes) -> bool:
        """Return whether there is a remark ``# format: imitarm-demonstration`` before the numbers."""
        return _NATIVE_MARK.match(head.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) is not None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the demonstration in the file; its numbers are not checked."""
        table = read_demonstration_table(path)
        if options.units not in (None, "m") or options.time_units not in (None, "s"):
            raise InputError(f"{path}: its header states m and s; leave out the options for units")
        names = table.names or ()
        n_pose = 8 if "qw" in names else 4
        raw = RawDemonstration(
            path,
            options.seconds(path, table.values[:, 0], "s"),
            table.values[:, 1:4],
            table.values[:, 4:8] if n_pose == 8 else None,
            table.values[:, n_pose:] if len(names) > n_pose else None,
            names[n_pose:],
            table.remarks.get("task", "") or options.task,
            units_in_file=("length", "time"),
        )
        return [replace(raw, lines=table.lines)]


class TextTableReader(Reader):
    """Reads any text table of numbers, separated by comma, semicolon, tab or spaces, with or without column names.

    A remark ``# units: cm`` before the numbers, or a column name such as ``x [cm]``, specifies the unit. Recordings of
    joint angles, such as those of Rethink's ``joint_recorder.py`` (``time,right_j0,...,right_j6``), are tables too.
    """

    suffixes = (".csv", ".txt", ".tsv", ".dat")

    def recognises(self, head: bytes) -> bool:
        """Return whether the file is text."""
        return kind_of(head) is None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the motion in the file."""
        table = read_table(path)
        said = _said_units(table)
        names = _names_of(table)
        raw = named_columns(path, names, table.values, options, said) if names else None
        raw = raw or unnamed_columns(path, table.values, options, said)
        if raw.positions is None:
            _check_angles(table)
        if raw.positions is None and options.units is not None:
            raise InputError(f"{path}: holds joint angles but no lengths; leave out the option units")
        limbs = {name.partition("_")[0] for name in raw.joint_names if re.fullmatch(r"(left|right)_.*", name)}
        if len(limbs) > 1:
            raise FileFormatError(f"{path}: holds joints of two arms, left and right; keep the columns of one arm")
        return [replace(raw, lines=table.lines, task=table.remarks.get("task", "") or raw.task)]


def _said_units(table: Table) -> SaidUnits:
    """Return the units and the quaternion order that remarks state, such as ``# units: cm`` or ``# time unit: ms``."""
    words: list[str] = []
    for _, text in table.remark_lines:
        if (match := _UNITS_REMARK.fullmatch(text.strip().lower())) is not None:
            listed = [word for word in re.split(r"[\s,;()\[\]]+", match[1]) if word not in ("", "and", "si")]
            words += [word for word in listed if word != "in" or len(listed) == 1]
    known = {word: (kind, unit) for kind in UNITS for word, unit in UNITS[kind].items()}
    prose = [word for _, text in table.remark_lines for word in _PROSE_UNIT.findall(text.lower()) if word in known]
    found: dict[str, str] = {}
    for word in [*words, *prose]:
        kind, unit = known.get(word, ("", ""))
        if not kind or found.setdefault(kind, unit) != unit:
            units = ", ".join(dict.fromkeys(unit for kind, unit in known.values() if kind != "rotation"))
            what = f"its remarks state two units of {kind}" if kind else f"a remark states the unknown unit {word!r}"
            raise FileFormatError(f"{table.path}: {what}; known: {units}")
    rates = [match for _, text in table.remark_lines for match in _PROSE_RATE.findall(text.lower())]
    if rates:
        raise FileFormatError(
            f"{table.path}: a remark states the unit {rates[0]!r}, which is neither a length nor an angle; record "
            "positions or joint angles, or remove the remark"
        )
    orders = {match.lower() for _, text in table.remark_lines for match in _ORDER.findall(text)}
    orders |= {
        {"first": "wxyz", "last": "xyzw"}[match.lower()]
        for _, text in table.remark_lines
        for match in _SCALAR.findall(text)
    }
    if len(orders) > 1:
        raise FileFormatError(f"{table.path}: its remarks state both quaternion orders, wxyz and xyzw; keep one")
    return SaidUnits(found.get("length"), found.get("time"), found.get("angle"), next(iter(orders), None))


def _check_angles(table: Table) -> None:
    """Reject a table of joints if a remark says that the columns hold velocities, torques or the like.

    Raises:
        FileFormatError: when a remark names such a quantity, but neither angles nor positions.
    """
    for number, text in table.remark_lines:
        if (match := _NO_ANGLES.search(text)) is not None and _ANGLES.search(text) is None:
            raise FileFormatError(
                f"{table.path}, line {number}: the remark {text[:60]!r} says that the columns hold {match[0].lower()}, "
                "not joint angles; record joint angles, or remove the remark"
            )


def _names_of(table: Table) -> tuple[str, ...] | None:
    """Return the column names from a row or a remark; None if nothing in the file looks like column names.

    Raises:
        FileFormatError: when a remark looks like column names, but does not fit the columns.
    """
    if table.named_by_row:
        return table.names
    width = table.values.shape[1]
    misfit: tuple[int, str] | None = None
    remarks = [(number, text) for number, text in table.remark_lines if not _OTHER_REMARK.fullmatch(text.strip())]
    for number, text in reversed(remarks):
        for part in dict.fromkeys(_ENCLOSED.sub(r"\1", one.strip()) for one in (text, text.partition(":")[2])):
            names = split_names(part)
            fits = len(names) == width and _looks_like_names(names)
            words = re.findall(r"[^\W\d][\w.]*", part)
            if fits and all(column_of(name).what for name in names):
                return names
            if (run := _run_of_names(words, width)) is not None and not _other_units(words, run, part):
                return run
            if fits and run is None:
                return names
            if _looks_like_names(words):
                misfit = misfit or (number, text)
    listed = [name for _, text in remarks if (name := _listed_name(text)) is not None]
    if len(listed) == width and _looks_like_names(listed):
        return tuple(listed)
    if misfit is None and _looks_like_names(listed):
        misfit = remarks[0]
    if misfit is None and table.names is not None and table.names_line in dict(remarks):
        misfit = (table.names_line, " ".join(table.names))
    if misfit is not None:
        raise FileFormatError(
            f"{table.path}, line {misfit[0]}: the remark {misfit[1][:60]!r} looks like column names, but does not name "
            f"the {width} columns in a known way; name each column in a first line (t x y z qw qx qy qz, right_j0), or "
            "remove the remark"
        )
    return None


def _looks_like_names(words: Sequence[str]) -> bool:
    columns = [column_of(word) for word in words]
    known = {column.what for column in columns}
    joints = sum(column.what == "joint" or bool(column.not_angle) for column in columns)
    return {"x", "y"} <= known or len(known & {"qw", "qx", "qy", "qz"}) > 2 or joints > 1


def _run_of_names(words: Sequence[str], width: int) -> tuple[str, ...] | None:
    """Return the column names in a remark: ``width`` consecutive words that are known names.

    None if the remark holds no such sequence of words, or more than one.
    """
    known = [bool(column_of(word).what) for word in words]
    starts = [i for i, here in enumerate(known) if here and (i == 0 or not known[i - 1])]
    runs = [words[i : i + next((k for k, here in enumerate(known[i:]) if not here), len(words))] for i in starts]
    long = [run for run in runs if len(run) == width and _looks_like_names(run)]
    return tuple(long[0]) if len(long) == 1 else None


def _other_units(words: Sequence[str], run: Sequence[str], text: str) -> bool:
    """Return whether the words beside the column names contain a unit that :func:`_said_units` misses."""
    beside = {word.lower() for word in words} - {word.lower() for word in run} - set(_PROSE_UNIT.findall(text.lower()))
    units = {word: unit for known in UNITS.values() for word, unit in known.items()}
    return any(units.get(word, "m") not in ("m", "s", "rad") for word in beside - {"in"})


def _listed_name(text: str) -> str | None:
    """Return the column name in a remark about one column, such as ``1: t [s]``, ``column 2: x`` or ``x``."""
    match = _NUMBERED.fullmatch(text.strip())
    names = split_names(match["name"] if match is not None else text.strip())
    alone = bool(names) and (match is not None or len(names) == 1)
    return names[0] if alone and column_of(names[0]).what else None
