"""Determine the meaning of each column of a table, from the column names or from the number of columns without names.

An unknown unit is an error. A rotation that can't be read, such as Euler angles, is reported and left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reading import ReadOptions, SaidUnits
from imitarm.errors import FileFormatError
from imitarm.kinematics.pose import matrix_to_quaternion

Array = NDArray[np.float64]

# columns without names, by their number ("q": the four numbers of a quaternion)
UNNAMED = {2: "xy", 3: "xyz", 4: "txyz", 7: "xyzq", 8: "txyzq"}
COUNTS = (
    "a table without column names must have 2 (x y), 3 (x y z), 4 (t x y z), 7 (x y z and quaternion) or 8 columns "
    "(t x y z and quaternion)"
)

_UNIT_WORDS = {
    "length": {
        **{"m": "m/metre/metres/meter/meters", "cm": "cm/centimetre/centimetres/centimeter/centimeters"},
        **{"mm": "mm/millimetre/millimetres/millimeter/millimeters", "in": "in/inch/inches", "ft": "ft/foot/feet"},
    },
    "time": {
        **{"s": "s/sec/secs/second/seconds", "ms": "ms/msec/msecs/millis/millisec/millisecond/milliseconds"},
        **{
            "us": "us/usec/usecs/micros/microsec/microsecond/microseconds",
            "min": "min/minute/minutes",
            "h": "h/hr/hour/hours",
        },
        "ns": "ns/nsec/nsecs/nanos/nanosec/nanosecs/nanosecond/nanoseconds",
    },
    "angle": {"rad": "rad/rads/radian/radians", "deg": "deg/degs/degree/degrees/°/º"},
    "rotation": {"1": "1/-"},  # a quaternion has no unit
}
UNITS = {
    kind: {word: unit for unit, words in units.items() for word in words.split("/")}
    for kind, units in _UNIT_WORDS.items()
}
UNITS["rotation"][""] = "1"  # EuRoC writes ``q_RS_w []``
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
_TIME_PARTS = {word for word, unit in UNITS["time"].items() if unit in ("s", "ms", "us", "ns") and len(word) > 1}
_POSITIONS = ("", "p", "p_", "pos_", "position_", "translation_")
_ROTATIONS = ("q", "q_", "quat", "quat_", "quaternion_", "orientation_", "ori_", "orient_", "rotation_", "rot_")
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
_OTHER_ROTATION = re.compile(  # one name is enough
    r"(?:.*_)?(?:roll|pitch|yaw|rpy\w*|euler\w*|r[xyz]|rot\w*|rvec\w*|rodrigues\w*|orient\w*|ori|quat\w*|theta)(?:_.*|\d+)?"
    r"|(?:.*_)?(?:axis|angle|axis_angle)_?[xyz]|(?:r|rot|rotation|m|mat|matrix)_?[0-3]_?[0-3]"
)
_ROTATION_SETS = (  # all of them are needed: one letter may be anything
    *("q0 q1 q2 q3", "q1 q2 q3 q4", "q_0 q_1 q_2 q_3", "q_1 q_2 q_3 q_4", "qi qj qk", "qa qb qc qd"),
    *("a b c", "w p r", "u v w", "alpha beta gamma", "phi theta psi", "nx ny nz ox oy oz"),
)
_RATES = {
    *("vel", "velocity", "velocities", "speed", "rate", "rates", "acc", "accel", "acceleration", "dot"),
    *("v", "w", "gyro", "omega", "twist"),
}
_NOT_ORTHONORMAL = 0.05  # files with two decimals hold matrices this far from a rotation
_ELEMENT = re.compile(r"(?:r|rot|rotation)_?([0-3])_?([0-3])")
_EUROC = re.compile(r"p_rs_r_([xyz])|q_rs_([wxyz])")  # EuRoC: pose of the sensor S in the reference frame R
_UNREAD_UNITS = {  # words that are units after a quantity's name, but are not converted
    "length": {
        *("dm", "decimetre", "decimetres", "decimeter", "decimeters", "km", "um", "nm"),
        *("micron", "microns", "yd", "yard", "yards", "mil", "thou"),
    },
    "time": {"ds", "cs", "d", "day", "days"},
    "angle": {"rev", "revs", "turn", "turns", "grad", "gon", "mrad"},
}


@dataclass(frozen=True)
class Column:
    """The meaning of one column name.

    Attributes:
        what: quantity in the column: time ``t``, position ``x``, ``y``, ``z``, quaternion ``qw`` to ``qz``, or
            ``joint``; empty if the name is unknown.
        unit: unit that the column name states, in lower case; None if the name states no unit.
        joint: name of the joint, without prefixes such as ``position.``.
        not_angle: what the column of a joint contains instead of joint angles, for example ``"velocities"``; empty for
            joint angles.
    """

    what: str
    unit: str | None = None
    joint: str = ""
    not_angle: str = ""


def column_of(name: str) -> Column:
    """Return the meaning of a name such as ``x``, ``pose.position.x``, ``x [mm]``, ``time_ms`` or ``right_j0``."""
    base, unit = name.strip(), None
    if (match := _BRACKETS.fullmatch(base)) is not None:
        base = match["name"]
        unit = (match["unit"] if match["word"] is None else match["word"]).strip().lower()
        unit = unit.replace("\u00b5", "u").replace("\u03bc", "u")
    words = [word for word in re.split(r"[\s./:_-]+", base.lower()) if word]
    if unit is None and len(words) > 1 and any(words[-1] in known for known in UNITS.values()):
        shorter = Column(*_meaning(base[: base.lower().rindex(words[-1])].rstrip(" ./:_-"), words[:-1]))
        kind = _KINDS.get(shorter.what, "rotation")
        if shorter.what and words[-1] in UNITS[kind]:
            return replace(shorter, unit=words[-1])
    if unit is None and len(words) > 1 and any(words[-1] in unread for unread in _UNREAD_UNITS.values()):
        shorter = Column(*_meaning(base[: base.lower().rindex(words[-1])].rstrip(" ./:_-"), words[:-1]))
        if shorter.what and words[-1] in _UNREAD_UNITS.get(_KINDS.get(shorter.what, ""), ()):
            return replace(shorter, unit=words[-1])
    what, _, joint, not_angle = _meaning(base, words)
    if not what and words and words[-1] in _TIME_PARTS and set(words[:-1]) <= _WRAPPERS | _TIMES:
        return Column("t", words[-1])
    return Column(what, unit, joint, not_angle)


def _meaning(base: str, words: Sequence[str]) -> tuple[str, None, str, str]:
    plain = "_".join(words)
    while plain not in _MEANINGS and plain.partition("_")[0] in _WRAPPERS and "_" in plain:
        plain = plain.partition("_")[2]
    if (match := _EUROC.fullmatch(plain)) is not None:
        plain = match[1] or f"q{match[2]}"
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
    """Convert a table with column names to a demonstration.

    Args:
        source: name of the file, for messages.
        names: name of each column; joints are recognised by names such as ``right_j0`` or ``panda_joint1``.
        values: numbers in the columns, shape (n, len(names)).
        options: options for facts that the file does not state, such as units.
        said: units that the file states in its remarks, not in its column names.

    Raises:
        FileFormatError: when a unit is unknown, a quantity or a joint is given twice, or there is neither a position
            nor a joint angle.
        InputError: when the options do not fit the file.
    """
    said = said or SaidUnits()
    columns = _with_tum_positions([column_of(name) for name in names], names)
    place: dict[str, int] = {}
    for i, column in enumerate(columns):
        key = f"joint {column.joint.lower()}" if column.joint else column.what
        if key not in ("", "t") and place.setdefault(key, i) != i:
            raise FileFormatError(
                f"{source}: columns {names[place[key]]!r} and {names[i]!r} both hold {key}; remove one column"
            )
    units = {i: _unit_of(source, names[i], column) for i, column in enumerate(columns) if column.what}
    for group, needed in (("xyz", {"x", "y"}), ("quaternion", {"qw", "qx", "qy", "qz"})):
        missing = needed - set(place)
        if missing and set(place) & (needed | ({"z"} if group == "xyz" else set())):
            raise FileFormatError(
                f"{source}: the {group} columns lack {', '.join(sorted(missing))}; add these columns or "
                "remove the others"
            )
    joints = [i for i, column in enumerate(columns) if column.what == "joint"]
    if "x" not in place and not joints:
        raise FileFormatError(f"{source}: {_what_is_there(names, columns)}")
    axes = [place[axis] for axis in "xyz" if axis in place]
    stamps = {i: units[i] for i, column in enumerate(columns) if column.what == "t"}
    times = _times(source, names, values, stamps, options, said)
    positions = angles = unit = None
    if axes:
        unit = _one_unit(source, "length", names, units, axes, said.length)
        in_space = np.pad(values[:, axes], ((0, 0), (0, 3 - len(axes))))  # planar motions get z = 0
        positions = options.metres(source, in_space, unit)
    if joints:
        degrees = _one_unit(source, "angle", names, units, joints, said.angle) == "deg"
        angles = np.radians(values[:, joints]) if degrees else values[:, joints]
    ignored = [name for name, column in zip(names, columns, strict=True) if not column.what]
    quaternions = values[:, [place[part] for part in ("qw", "qx", "qy", "qz")]] if "qw" in place else None
    unread: tuple[str, ...] = ()
    if quaternions is None and axes:
        if elements := _matrix_elements(names):
            quaternions = _of_matrices(source, values[:, elements])
            ignored = [name for name in ignored if name not in {names[i] for i in elements}]
        else:
            unread = _unread_rotation(ignored)
    unused = [name for name in ignored if name not in unread]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    joint_names = tuple(columns[i].joint for i in joints)
    raw = RawDemonstration(
        source, times, positions, quaternions, angles, joint_names, options.task, notes=notes, unread_rotation=unread
    )
    time_unit = next((stated for stated in stamps.values() if stated is not None), said.time) if stamps else None
    return with_units(raw, options, unit, "s" if len(stamps) > 1 else time_unit)


def _with_tum_positions(columns: list[Column], names: Sequence[str]) -> list[Column]:
    """Return the columns; ``tx ty tz`` become positions if there is also a quaternion, as in the TUM trajectory format.

    If the table has no quaternion, or if it also has forces, ``tx ty tz`` may be torques and do not become positions.
    """
    plain = [name.strip().lower() for name in names]
    known = {column.what for column in columns}
    tum = {"tx", "ty", "tz"} <= set(plain) and {"qw", "qx", "qy", "qz"} <= known and not known & {"x", "y", "z"}
    if not tum or "fx" in plain:
        return columns
    return [Column(name[1]) if name in ("tx", "ty", "tz") else old for name, old in zip(plain, columns, strict=True)]


def _plain(name: str) -> str:
    """Return a name in lower case with underscores, without unit and without words such as ``pose``."""
    match = _BRACKETS.fullmatch(name.strip())
    words = [word for word in re.split(r"[\s./:_-]+", (match["name"] if match else name).lower()) if word]
    while len(words) > 1 and words[0] in _WRAPPERS:
        words = words[1:]
    return "_".join(words[:-1] if len(words) > 1 and words[-1] in UNITS["angle"] else words)


def _matrix_elements(names: Sequence[str]) -> list[int]:
    """Return the indices of the columns of a rotation matrix (``r11 ... r33`` or ``r00 ... r22``), or none."""
    found: dict[tuple[int, int], int] = {}
    for i, name in enumerate(names):
        if (match := _ELEMENT.fullmatch(_plain(name))) is not None:
            found.setdefault((int(match[1]), int(match[2])), i)
    for first in (0, 1):
        each = [(row, column) for row in range(first, first + 3) for column in range(first, first + 3)]
        if set(found) == set(each):
            return [found[element] for element in each]
    return []


def _of_matrices(source: str, elements: Array) -> Array:
    """Return the quaternions wxyz (n, 4) of rotation matrices (n, 9); rows that are not finite become nan.

    Raises:
        FileFormatError: when a matrix is not a rotation matrix.
    """
    matrices = elements.reshape(-1, 3, 3)
    finite = np.asarray(np.isfinite(elements).all(axis=1))
    matrices = np.where(finite[:, None, None], matrices, np.eye(3))
    off: Array = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > _NOT_ORTHONORMAL) | (np.linalg.det(matrices) < 0.0))
    if len(bad):
        raise FileFormatError(
            f"{source}, row {bad[0]}: columns r11 to r33 do not hold a rotation matrix; check or remove them"
        )
    return np.where(finite[:, None], matrix_to_quaternion(matrices), np.nan)


def _unread_rotation(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of columns that seem to contain a rotation in an unsupported form, such as Euler angles."""
    plain = [_plain(name) for name in names]
    in_sets = {word for words in _ROTATION_SETS if set(words.split()) <= set(plain) for word in words.split()}
    if in_sets == {"q1", "q2", "q3", "q4"} and {"q5", "q6"} & set(plain):
        in_sets = set()  # joints
    return tuple(
        name
        for name, word in zip(names, plain, strict=True)
        if word in in_sets or (_OTHER_ROTATION.fullmatch(word) and not set(word.split("_")) & _RATES)
    )


def _what_is_there(names: Sequence[str], columns: Sequence[Column]) -> str:
    others = sorted({column.not_angle for column in columns if column.not_angle})
    if others:
        example = names[next(i for i, column in enumerate(columns) if column.not_angle)]
        return (
            f"holds joint {' and '.join(others)} ({example}), not joint angles; record joint angles, or positions x y z"
        )
    return f"no columns are named x, y, z or like joints (right_j0, panda_joint1); found {', '.join(names)}"


def _unit_of(source: str, name: str, column: Column) -> str | None:
    """Return the symbol of the unit that a column's name states; None if it states no unit."""
    if column.unit is None:
        return None
    kind = _KINDS.get(column.what, "rotation")
    if column.unit not in UNITS[kind]:
        known = ", ".join(dict.fromkeys(UNITS[kind].values()))
        raise FileFormatError(
            f"{source}: column {name!r}: {column.unit!r} is not a known unit of {kind} ({known}); convert the column"
        )
    return UNITS[kind][column.unit]


def _one_unit(
    source: str,
    kind: str,
    names: Sequence[str],
    units: Mapping[int, str | None],
    columns: Iterable[int],
    elsewhere: str | None,
) -> str | None:
    """Return the unit that all ``columns`` share.

    ``elsewhere`` is the unit that a remark in the file states, or None. This unit applies to columns whose names state
    no unit.
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
            f"{source}: has different units of {kind}: {' and '.join(sorted(map(str, found)))}; convert all "
            "columns to one unit"
        )
    stated_units = {units[i] for i in columns} - {None}
    if elsewhere is not None and stated_units - {elsewhere}:
        raise FileFormatError(
            f"{source}: a remark states the unit {elsewhere}, but a column name states "
            f"{stated_units.pop()}; correct one of the two units"
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
    """Return the time stamps (n,) [s]; if whole seconds and fractions are in two columns, add the columns."""
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
        f"{source}: columns {both} both hold times, but are not whole seconds and fractions of a second; remove one"
    )


def unnamed_columns(
    source: str, values: Array, options: ReadOptions, said: SaidUnits | None = None
) -> RawDemonstration:
    """Convert a table without column names to a demonstration; the number of columns gives their meaning (``UNNAMED``).

    Raises:
        InputError: when the number of columns has no known meaning, or the options do not fit the file.
    """
    said = said or SaidUnits()
    layout = UNNAMED.get(values.shape[1])
    if layout is None:
        raise FileFormatError(
            f"{source}: {values.shape[1]} columns without names; {COUNTS}. Write the column names in the first line"
        )
    start, n = int(layout[0] == "t"), len(values)
    times = options.seconds(source, values[:, 0], said.time) if start else options.even_times(source, n)
    axes = slice(start, start + (2 if layout == "xy" else 3))
    positions = in_space(options.metres(source, values[:, axes], said.length))
    quaternions: Array | None = None
    notes: tuple[str, ...] = ()
    if layout.endswith("q"):
        quaternions = options.wxyz(source, values[:, start + 3 : start + 7], said.quaternion_order)
        notes = order_notes(options, said)
    raw = RawDemonstration(source, times, positions, quaternions, task=options.task, notes=notes)
    return with_units(raw, options, said.length, said.time)


def order_notes(options: ReadOptions, said: SaidUnits | None = None) -> tuple[str, ...]:
    """Return a note about the assumed order of quaternions; no note if the file or an option states the order."""
    if options.quaternion_order is not None or (said is not None and said.quaternion_order is not None):
        return ()
    return ("the quaternion columns have no names, so the order w x y z was assumed; the other order is x y z w",)


def with_units(raw: RawDemonstration, options: ReadOptions, length: str | None, time: str | None) -> RawDemonstration:
    """Store the units of the file in a demonstration; ``length`` and ``time`` are units that the file itself states."""
    stated = tuple(kind for kind, unit in (("length", length), ("time", time)) if unit is not None)
    return replace(
        raw,
        length_unit=length or options.units or "m",
        time_unit=time or options.time_units or "s",
        units_in_file=stated,
    )


def in_space(positions: Array) -> Array:
    """Return positions (n, 3); planar positions (n, 2) get z = 0."""
    return np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))
