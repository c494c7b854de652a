"""Which column of a table means what, by its name or, when it has none, by how many there are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reader import LENGTH_UNITS, TIME_UNITS, ReadOptions
from imitarm.errors import FileFormatError

Array = NDArray[np.float64]

# without names: how many columns, and what they are ("q": four of a quaternion)
UNNAMED = {2: "xy", 3: "xyz", 4: "txyz", 7: "xyzq", 8: "txyzq"}
COUNTS = "2 (x y), 3 (x y z), 7 (x y z and quaternion), with the time before them 4 or 8"

_TIME_NAMES = {"t", "time", "times", "timestamp", "time_stamp", "stamp", "sec", "secs", "seconds"}
_POSITION_PREFIXES = ("", "p", "p_", "pos_", "position_", "pose_position_", "tool_", "ee_")
_ROTATION_PREFIXES = ("q", "q_", "quat_", "quaternion_", "orientation_", "pose_orientation_", "rot_")
_MEANINGS = {
    **dict.fromkeys(_TIME_NAMES, "t"),
    **{prefix + axis: axis for prefix in _POSITION_PREFIXES for axis in "xyz"},
    **{prefix + part: "q" + part for prefix in _ROTATION_PREFIXES for part in "wxyz"},
}
_JOINT = re.compile(r"(?:.*_)?(?:j|joint)_?\d+", re.IGNORECASE)
_NAME_AND_UNIT = re.compile(r"(?P<name>.*?)(?:\s*[\[(](?P<bracket>\w+)[\])]|_(?P<suffix>mm|cm|ms|us|ns|s))?")


@dataclass(frozen=True)
class Meaning:
    """What one column holds: ``t``, ``x``, ``y``, ``z``, ``qw`` to ``qz``, ``joint``, or nothing that is known."""

    what: str
    unit: str | None


def meaning_of(name: str) -> Meaning:
    """Read a column name such as ``x``, ``pose.position.x``, ``x [mm]``, ``time_ms`` or ``right_j0``."""
    plain = re.sub(r"[\s.]+", "_", name.strip().lower())
    if plain in _MEANINGS:
        return Meaning(_MEANINGS[plain], None)
    match = _NAME_AND_UNIT.fullmatch(name.strip().lower())
    assert match is not None  # the pattern takes any text
    base, unit = re.sub(r"[\s.]+", "_", match["name"]), match["bracket"] or match["suffix"]
    what = _MEANINGS.get(base, "joint" if _JOINT.fullmatch(base) else "")
    return Meaning(what, {"sec": "s", "seconds": "s"}.get(unit, unit) if unit else None)


def named_columns(
    source: str, names: Sequence[str], values: Array, options: ReadOptions, *, units: str | None = None
) -> RawDemonstration:
    """Sort the columns of a table by their names.

    Args:
        source: named in messages.
        names: one for each column; joints are known by names such as ``right_j0`` or ``panda_joint1``.
        values: shape (n, len(names)).
        options: what the file may leave unsaid.
        units: the unit of length that the file names outside its columns.

    Raises:
        FileFormatError: when a column is there twice, or there is neither a position nor a joint.
        InputError: when the options do not fit.
    """
    meanings = [meaning_of(name) for name in names]
    place: dict[str, int] = {}
    for column, meaning in enumerate(meanings):
        if meaning.what not in ("", "joint") and place.setdefault(meaning.what, column) != column:
            raise FileFormatError(
                f"{source}: columns {names[place[meaning.what]]!r} and {names[column]!r} both hold {meaning.what}; "
                "remove one"
            )
    joints = [column for column, meaning in enumerate(meanings) if meaning.what == "joint"]
    notes = _ignored(names, meanings)
    for group, needed in (("xyz", {"x", "y"}), ("quaternion", {"qw", "qx", "qy", "qz"})):
        missing = needed - set(place)
        if missing and missing != needed:
            raise FileFormatError(
                f"{source}: the {group} columns lack {', '.join(sorted(missing))}; add or remove them"
            )
    if "x" not in place and not joints:
        raise FileFormatError(
            f"{source}: no column is named x y z or as a joint (right_j0, panda_joint1); found {', '.join(names)}"
        )
    return RawDemonstration(
        source,
        _times(source, values, place, meanings, options),
        _positions(source, values, place, meanings, options, units),
        values[:, [place[part] for part in ("qw", "qx", "qy", "qz")]] if "qw" in place else None,
        _angles(source, values, joints, meanings) if joints else None,
        tuple(re.sub(r"\s*[\[(]\w+[\])]$", "", names[column]) for column in joints),
        options.task,
        notes=notes,
    )


def unnamed_columns(source: str, values: Array, options: ReadOptions, *, units: str | None = None) -> RawDemonstration:
    """Sort the columns of a table without names by how many there are (see ``UNNAMED``).

    Raises:
        FileFormatError: when there is no meaning for that many.
        InputError: when the options do not fit.
    """
    layout = UNNAMED.get(values.shape[1])
    if layout is None:
        raise FileFormatError(
            f"{source}: {values.shape[1]} columns without names; known are {COUNTS}. Name them in a first line"
        )
    start = int(layout[0] == "t")
    times = options.seconds(source, values[:, 0]) if start else options.even_times(source, len(values))
    n_axes = 2 if layout == "xy" else 3
    positions = in_space(options.metres(source, values[:, start : start + n_axes], units))
    quaternions = options.wxyz(values[:, start + 3 : start + 7]) if layout.endswith("q") else None
    return RawDemonstration(source, times, positions, quaternions, task=options.task)


def in_space(positions: Array) -> Array:
    """Return positions (n, 3); planar ones (n, 2) get z = 0."""
    return np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))


def _ignored(names: Sequence[str], meanings: Sequence[Meaning]) -> tuple[str, ...]:
    ignored = [name for name, meaning in zip(names, meanings, strict=True) if not meaning.what]
    return (f"columns not used: {', '.join(ignored)}",) if ignored else ()


def _times(
    source: str, values: Array, place: dict[str, int], meanings: Sequence[Meaning], options: ReadOptions
) -> Array:
    if "t" not in place:
        return options.even_times(source, len(values))
    unit = meanings[place["t"]].unit
    return options.seconds(source, values[:, place["t"]], unit if unit in TIME_UNITS else None)


def _positions(
    source: str,
    values: Array,
    place: dict[str, int],
    meanings: Sequence[Meaning],
    options: ReadOptions,
    units: str | None,
) -> Array | None:
    if "x" not in place:
        return None
    said = {meanings[place[axis]].unit for axis in "xyz" if axis in place} | {units}
    known = [unit for unit in said if unit in LENGTH_UNITS]
    if len(known) > 1:
        raise FileFormatError(f"{source}: says different units of length, {' and '.join(sorted(known))}; make them one")
    positions = in_space(values[:, [place[axis] for axis in "xyz" if axis in place]])
    return options.metres(source, positions, known[0] if known else None)


def _angles(source: str, values: Array, joints: Sequence[int], meanings: Sequence[Meaning]) -> Array:
    """Return the joint columns in rad."""
    units = {meanings[column].unit for column in joints} - {None, "rad"}
    if units - {"deg", "degrees"}:
        raise FileFormatError(f"{source}: joints in {', '.join(sorted(map(str, units)))}; known: rad, deg")
    angles = values[:, list(joints)]
    degrees = np.array([meanings[column].unit in ("deg", "degrees") for column in joints])
    return np.where(degrees, np.radians(angles), angles)
