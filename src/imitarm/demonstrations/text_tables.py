"""Readers of text tables: imitarm's own CSV, and any other table of numbers.

Column names are read from a separate row or from a remark. The number of columns decides only when nothing in the file
looks like column names. A name, unit or remark that is not understood is an error.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.arrays import unnamed_columns
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reading import Reader, ReadOptions, SaidUnits
from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import Table, kind_of, read_table, split_names
from imitarm.trajectory import FORMAT, read_demonstration_table

Array = NDArray[np.float64]

_UNIT_WORDS = {
    "length": {
        **{"m": "m metre metres meter meters", "cm": "cm centimetre centimetres centimeter centimeters"},
        **{"mm": "mm millimetre millimetres millimeter millimeters", "in": "in inch inches", "ft": "ft foot feet"},
    },
    "time": {
        **{"s": "s sec secs second seconds", "ms": "ms msec msecs millis millisec millisecond milliseconds"},
        **{
            "us": "us usec usecs micros microsec microsecond microseconds",
            "min": "min minute minutes",
            "h": "h hr hour hours",
        },
        "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
    },
    "angle": {"rad": "rad rads radian radians", "deg": "deg degs degree degrees ° º"},
    "rotation": {"1": "1 -"},  # a quaternion has no unit
}
_UNITS = {
    kind: {word: unit for unit, words in units.items() for word in words.split()} for kind, units in _UNIT_WORDS.items()
}
_KINDS = {"t": "time", **dict.fromkeys("xyz", "length"), "joint": "angle"}

_WRAPPERS = {
    "field",
    "msg",
    "data",
    "header",
    "tv",
    "pose",
    "transform",
    "tool",
    "tcp",
    "ee",
    "actual",
    "measured",
    "state",
}
_TIMES = {"t", "time", "times", "timestamp", "time_stamp", "stamp", "elapsed", "elapsed_time"}
_TIME_PARTS = {word for word, unit in _UNITS["time"].items() if unit in ("s", "ms", "us", "ns") and len(word) > 1}
_POSITIONS = ("", "p", "p_", "pos_", "position_", "translation_")
_ROTATIONS = ("q", "q_", "quat_", "quaternion_", "orientation_", "rotation_", "rot_")
_MEANINGS = {
    **dict.fromkeys(_TIMES, "t"),
    **{prefix + axis: axis for prefix in _POSITIONS for axis in "xyz"},
    **{prefix + part: "q" + part for prefix in _ROTATIONS for part in "wxyz"},
}

_JOINT = re.compile(r"(?:.*_)?(?:j|joint)_?\d+")
_JOINT_INSIDE = re.compile(r"(?:^|_)(?:j|joint)_?\d+(?:_|$)")
_JOINT_WRAPPER = re.compile(
    r"(?:(?:joint_)?(?:states?|positions?|pos|angles?|actual|measured)[\s._/]+)+", re.IGNORECASE
)
_NUMBERED_ANGLE = re.compile(r"(?:j|joint)_(?:position|pos|angle)s?_?(\d+)")
_NO_ANGLE = {  # words in the name of a joint's column that say what else it holds
    "velocities": r"vel\w*|speed\w*|d?q?dot|q?d|dq",
    "accelerations": r"acc\w*|q?dd|ddq|jerk",
    "efforts": r"effort\w*|torque\w*|tau|force\w*|load|moments?|nm",
    "currents": r"current\w*|amps?",
    "commands": r"cmd|command\w*|desired|des|target|goal|setpoint|ref|reference|planned",
    "errors": r"err|errors?|deviation",
    "other quantities": r"temp\w*|volt\w*|power|stiff\w*|damp\w*|gains?|limits?|min|max|std|var|cov|status|mode|raw",
}
_BRACKETS = re.compile(r"(?P<name>.*?)\s*(?:[\[(](?P<unit>[^\])]*)[\])]|\sin\s(?P<word>\w+))\s*")
_NUMBERED = re.compile(r"(?:col(?:umn)?\s*)?\d+\s*[:=.)]\s*(?P<name>.+)", re.IGNORECASE)
_OTHER_ROTATION = re.compile(r"(?:.*[_.])?(?:roll|pitch|yaw|euler\w*|r[xyz]|rot\w*|quat\w*|q_?[0-3])\b.*")
_ENCLOSED = re.compile(r"^[(\[{]([^()\[\]{}]*)[)\]}]$")
_UNITS_REMARK = re.compile(r"(?:(?:length|position|time|angle|joint)s?[ _])?units?\s*[:=]\s*(.*)")
_OTHER_REMARK = re.compile(r"(?:task|source|date|version|format|(?:\w+[ _])?units?)\s*[:=].*", re.IGNORECASE)
_PROSE_UNIT = re.compile(r"\bin\s+((?!in\b|min\b|h\b)[^\W\d]+)")
_ORDER = re.compile(r"\b(xyzw|wxyz)\b", re.IGNORECASE)
_NATIVE_MARK = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s*[#%][^\n]*\n)*?\s*[#%]\s*format:\s*" + FORMAT.encode() + rb"\b")


@dataclass(frozen=True)
class Column:
    """The meaning of one column name.

    Attributes:
        what: quantity: ``t``, ``x``, ``y``, ``z``, ``qw`` to ``qz`` or ``joint``; empty when the name is not known.
        unit: unit in the name, in lower case; None if the name has no unit.
        joint: name of the joint, without words such as ``position.``.
        not_angle: the quantity in a joint's column if it is not its angle, for example ``"velocities"``.
    """

    what: str
    unit: str | None = None
    joint: str = ""
    not_angle: str = ""


def column_of(name: str) -> Column:
    """Return the meaning of a column name: ``x``, ``pose.position.x``, ``x [mm]``, ``time_ms`` or ``right_j0``."""
    base, unit = name.strip(), None
    if (match := _BRACKETS.fullmatch(base)) is not None:
        base = match["name"]
        unit = (match["unit"] if match["word"] is None else match["word"]).strip().lower()
        unit = unit.replace("\u00b5", "u").replace("\u03bc", "u")
    words = [word for word in re.split(r"[\s./:_-]+", base.lower()) if word]
    if unit is None and len(words) > 1 and any(words[-1] in known for known in _UNITS.values()):
        shorter = Column(*_meaning(base[: base.lower().rindex(words[-1])].rstrip(" ./:_-"), words[:-1]))
        kind = _KINDS.get(shorter.what, "rotation")
        if shorter.what and words[-1] in _UNITS[kind]:
            return replace(shorter, unit=words[-1])
    what, _, joint, not_angle = _meaning(base, words)
    if not what and words and words[-1] in _TIME_PARTS and set(words[:-1]) <= _WRAPPERS | _TIMES:
        return Column("t", words[-1])
    return Column(what, unit, joint, not_angle)


def _meaning(base: str, words: Sequence[str]) -> tuple[str, None, str, str]:
    plain = "_".join(words)
    while plain not in _MEANINGS and plain.partition("_")[0] in _WRAPPERS and "_" in plain:
        plain = plain.partition("_")[2]
    if plain in _MEANINGS:
        return _MEANINGS[plain], None, "", ""
    if (match := _NUMBERED_ANGLE.fullmatch(plain)) is not None:
        return "joint", None, f"joint_{match[1]}", ""
    if _JOINT_INSIDE.search(plain) is None:
        return "", None, "", ""
    for quantity, pattern in _NO_ANGLE.items():
        if any(re.fullmatch(pattern, word) for word in words):
            return "", None, "", quantity
    if _JOINT.fullmatch(plain) is None:
        return "", None, "", ""
    joint = re.split(r"[./]", _JOINT_WRAPPER.sub("", base, count=1))[-1]
    return "joint", None, re.sub(r"[\s:]+", "_", joint), ""


def named_columns(
    source: str, names: Sequence[str], values: Array, options: ReadOptions, said: SaidUnits | None = None
) -> RawDemonstration:
    """Assign the columns of a table by their names.

    Args:
        source: name of the file, for messages.
        names: name of each column; joints are recognised by names such as ``right_j0`` or ``panda_joint1``.
        values: numbers in the columns, shape (n, len(names)).
        options: facts that the file may not state.
        said: units that the file states outside its column names.

    Raises:
        FileFormatError: when a unit is unknown, a quantity or a joint is given twice, or there is neither a position
            nor a joint angle.
        InputError: when the options do not fit the file.
    """
    said = said or SaidUnits()
    columns = [column_of(name) for name in names]
    place: dict[str, int] = {}
    for i, column in enumerate(columns):
        key = f"joint {column.joint.lower()}" if column.joint else column.what
        if key not in ("", "t") and place.setdefault(key, i) != i:
            raise FileFormatError(
                f"{source}: columns {names[place[key]]!r} and {names[i]!r} both hold {key}; remove one"
            )
    units = {i: _unit_of(source, names[i], column) for i, column in enumerate(columns) if column.what}
    for group, needed in (("xyz", {"x", "y"}), ("quaternion", {"qw", "qx", "qy", "qz"})):
        missing = needed - set(place)
        if missing and set(place) & (needed | ({"z"} if group == "xyz" else set())):
            raise FileFormatError(
                f"{source}: the {group} columns lack {', '.join(sorted(missing))}; add or remove them"
            )
    joints = [i for i, column in enumerate(columns) if column.what == "joint"]
    if "x" not in place and not joints:
        raise FileFormatError(f"{source}: {_what_is_there(names, columns)}")
    axes = [place[axis] for axis in "xyz" if axis in place]
    stamps = {i: units[i] for i, column in enumerate(columns) if column.what == "t"}
    times = _times(source, names, values, stamps, options, said)
    positions = angles = None
    if axes:
        unit = _one_unit(source, "length", names, units, axes, said.length)
        in_space = np.pad(values[:, axes], ((0, 0), (0, 3 - len(axes))))  # planar motions get z = 0
        positions = options.metres(source, in_space, unit)
    if joints:
        unit = _one_unit(source, "angle", names, units, joints, said.angle)
        angles = np.radians(values[:, joints]) if unit == "deg" else values[:, joints]
    quaternions = values[:, [place[part] for part in ("qw", "qx", "qy", "qz")]] if "qw" in place else None
    ignored = [name for name, column in zip(names, columns, strict=True) if not column.what]
    notes = (f"columns not used: {', '.join(ignored)}",) if ignored else ()
    if quaternions is None and any(_OTHER_ROTATION.fullmatch(name.strip().lower()) for name in ignored):
        notes = (f"columns not used: {', '.join(ignored)} (rotations are read only as qw qx qy qz)",)
    joint_names = tuple(columns[i].joint for i in joints)
    return RawDemonstration(source, times, positions, quaternions, angles, joint_names, options.task, notes=notes)


def _what_is_there(names: Sequence[str], columns: Sequence[Column]) -> str:
    others = sorted({column.not_angle for column in columns if column.not_angle})
    if others:
        example = names[next(i for i, column in enumerate(columns) if column.not_angle)]
        return f"holds joint {' and '.join(others)} ({example}), not joint angles; record the angles, or x y z"
    return f"no column is named x y z or as a joint (right_j0, panda_joint1); found {', '.join(names)}"


def _unit_of(source: str, name: str, column: Column) -> str | None:
    """Return the unit in a column's name as one of the known symbols."""
    if column.unit is None:
        return None
    kind = _KINDS.get(column.what, "rotation")
    if column.unit not in _UNITS[kind]:
        known = ", ".join(dict.fromkeys(_UNITS[kind].values()))
        raise FileFormatError(
            f"{source}: column {name!r}: {column.unit!r} is not a known unit of {kind} ({known}); convert the column"
        )
    return _UNITS[kind][column.unit]


def _one_unit(
    source: str,
    kind: str,
    names: Sequence[str],
    units: Mapping[int, str | None],
    columns: Iterable[int],
    elsewhere: str | None,
) -> str | None:
    """Return the common unit of ``columns``.

    Columns without a unit in their names have the unit stated ``elsewhere``.
    """
    found = {units[i] or elsewhere for i in columns}
    if None in found and len(found) > 1:
        silent = next(names[i] for i in columns if units[i] is None)
        stated = next(names[i] for i in columns if units[i] is not None)
        raise FileFormatError(
            f"{source}: column {stated!r} has a unit, but column {silent!r} has none; add the unit to each name"
        )
    if len(found) > 1:
        raise FileFormatError(
            f"{source}: has different units of {kind}, {' and '.join(sorted(map(str, found)))}; convert them to one"
        )
    stated_units = {units[i] for i in columns} - {None}
    if elsewhere is not None and stated_units - {elsewhere}:
        raise FileFormatError(
            f"{source}: a remark says {elsewhere}, a column name {stated_units.pop()}; make them the same"
        )
    return found.pop() if found else None


def _times(
    source: str,
    names: Sequence[str],
    values: Array,
    units: Mapping[int, str | None],
    options: ReadOptions,
    said: SaidUnits,
) -> Array:
    """Return the time stamps (n,) [s]; a column of whole seconds and a column of fractions are added."""
    if not units:
        return options.even_times(source, len(values))
    if len(units) == 1:
        ((i, unit),) = units.items()
        return options.seconds(source, values[:, i], unit or said.time)
    fine = [i for i, unit in units.items() if unit in ("ms", "us", "ns")]
    whole = [i for i, unit in units.items() if unit in ("s", None)]
    if len(fine) == len(whole) == 1:
        factor = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}[str(units[fine[0]])]
        seconds, rest = values[:, whole[0]], values[:, fine[0]] * factor
        finite = np.isfinite(seconds) & np.isfinite(rest)
        if (seconds[finite] % 1.0 == 0.0).all() and ((rest[finite] >= 0.0) & (rest[finite] < 1.0)).all():
            return options.seconds(source, seconds + rest, "s")
    both = " and ".join(repr(names[i]) for i in units)
    raise FileFormatError(
        f"{source}: columns {both} both hold t, and are not whole seconds with fractions of a second; remove one"
    )


class ImitarmReader(Reader):
    """imitarm's own CSV: remarks with units and frame, columns t x y z, a quaternion, joints by name."""

    suffixes = (".csv",)

    def recognises(self, head: bytes) -> bool:
        """Return whether there is a remark ``# format: imitarm-demonstration`` before the numbers."""
        return _NATIVE_MARK.match(head.replace(b"\r\n", b"\n").replace(b"\r", b"\n")) is not None

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the demonstration in the file; its numbers are not checked."""
        table = read_demonstration_table(path)
        if options.units not in (None, "m") or options.time_units not in (None, "s"):
            raise InputError(f"{path}: is in m and s, as its header says; leave out units")
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
        )
        return [replace(raw, lines=table.lines)]


class TextTableReader(Reader):
    """Any text table of numbers, separated by comma, semicolon, tab or spaces, with or without column names.

    A remark ``# units: cm`` before the numbers, or a name such as ``x [cm]``, specifies the unit. Recordings of joint
    angles, such as those of Rethink's ``joint_recorder.py`` (``time,right_j0,...,right_j6``), are tables too.
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
        if raw.positions is None and options.units is not None:
            raise InputError(f"{path}: holds joint angles and no lengths; leave out units")
        limbs = {name.partition("_")[0] for name in raw.joint_names if re.fullmatch(r"(left|right)_.*", name)}
        if len(limbs) > 1:
            raise FileFormatError(f"{path}: holds joints of two limbs, left and right; keep the columns of one")
        return [replace(raw, lines=table.lines, task=table.remarks.get("task", "") or raw.task)]


def _said_units(table: Table) -> SaidUnits:
    """Return the units (``# units: cm``, ``# time unit: ms``) and the order of quaternions that the remarks state."""
    words: list[str] = []
    for _, text in table.remark_lines:
        if (match := _UNITS_REMARK.fullmatch(text.strip().lower())) is not None:
            listed = [word for word in re.split(r"[\s,;()\[\]]+", match[1]) if word not in ("", "and", "si")]
            words += [word for word in listed if word != "in" or len(listed) == 1]
    known = {word: (kind, unit) for kind in _UNITS for word, unit in _UNITS[kind].items()}
    prose = [word for _, text in table.remark_lines for word in _PROSE_UNIT.findall(text.lower()) if word in known]
    found: dict[str, str] = {}
    for word in [*words, *prose]:
        kind, unit = known.get(word, ("", ""))
        if not kind or found.setdefault(kind, unit) != unit:
            units = ", ".join(dict.fromkeys(unit for kind, unit in known.values() if kind != "rotation"))
            what = f"says two units of {kind}" if kind else f"says its unit is {word!r}"
            raise FileFormatError(f"{table.path}: {what}; known: {units}")
    orders = {match.lower() for _, text in table.remark_lines for match in _ORDER.findall(text)}
    if len(orders) > 1:
        raise FileFormatError(f"{table.path}: its remarks say both wxyz and xyzw; keep one")
    return SaidUnits(found.get("length"), found.get("time"), found.get("angle"), next(iter(orders), None))


def _names_of(table: Table) -> tuple[str, ...] | None:
    """Return the column names in a row or a remark; None if nothing in the file looks like names.

    Raises:
        FileFormatError: when a remark looks like column names and does not fit the columns.
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
    """Return ``width`` known names that are consecutive words of a remark and the only names in it."""
    known = [bool(column_of(word).what) for word in words]
    starts = [i for i, here in enumerate(known) if here and (i == 0 or not known[i - 1])]
    runs = [words[i : i + next((k for k, here in enumerate(known[i:]) if not here), len(words))] for i in starts]
    long = [run for run in runs if len(run) == width and _looks_like_names(run)]
    return tuple(long[0]) if len(long) == 1 else None


def _other_units(words: Sequence[str], run: Sequence[str], text: str) -> bool:
    """Return whether the other words contain a unit that :func:`_said_units` does not use."""
    beside = {word.lower() for word in words} - {word.lower() for word in run} - set(_PROSE_UNIT.findall(text.lower()))
    units = {word: unit for known in _UNITS.values() for word, unit in known.items()}
    return any(units.get(word, "m") not in ("m", "s", "rad") for word in beside - {"in"})


def _listed_name(text: str) -> str | None:
    """Return the name in a remark about one column: ``1: t [s]``, ``column 2: x``, or only ``x``."""
    match = _NUMBERED.fullmatch(text.strip())
    names = split_names(match["name"] if match is not None else text.strip())
    alone = bool(names) and (match is not None or len(names) == 1)
    return names[0] if alone and column_of(names[0]).what else None
