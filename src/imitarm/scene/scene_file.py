"""Scene files: a goal and obstacles in hand-written YAML (docs/scene.md).

In the file, the keys of an obstacle are the fields of its shape's class. Therefore, a new shape needs no code for
reading and writing once its class is in ``imitarm.scene.OBSTACLES``. The reader accepts only plain YAML (numbers, text,
lists and mappings) and never executes anything in a file.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from reprlib import repr as _shown  # a few items only, however much a file holds
from typing import Any

import numpy as np
import yaml

import imitarm.scene  # for its registry, which is complete only once all shapes are imported
from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import write_text
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.scene.motion import MovingScene, Track
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.scene import Scene
from imitarm.validation import file_path, instance

FORMAT = "imitarm-scene"
VERSION = 1
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}

_SMALLEST = 1e-3  # [m] of an obstacle; smaller sizes are in another unit
_NEAREST = 0.02  # [m] in a scene in cm or mm, something is farther from the base than this, which stands there
_FARTHEST = 15.0  # [m] from the robot's base; obstacles beyond it are in another unit
_FASTEST, _FASTEST_ROTATION = 20.0, 30.0  # [m/s], [rad/s] of an obstacle, likewise
_POINTS = ("center", "start", "end", "point", "normal", "points")  # keys that are no sizes

_TOP = ("format", "version", "units", "stamp", "goal", "obstacles", "fixtures")
_ROTATIONS = ("quaternion", "rpy_degrees", "yaw_degrees")
_COMMON = ("name", "velocity", "angular_velocity")
_TRACK = "track"  # rows of time and position, or of time, position and quaternion
_UNWRITTEN = ("covariance", "track_id")  # set by trackers only


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene file.

    Args:
        path: YAML file in the format of docs/scene.md.

    Returns:
        The scene in metres, regardless of the file's units. An obstacle with a track (a recorded motion) has the
        track's pose and velocity at the scene's stamp. The tracks are returned only by :func:`load_moving_scene`.

    Raises:
        InputError: when there is no such file or it can't be read.
        FileFormatError: when the file is not a scene file or an entry is wrong; the message names the file, the entry
            and the key, and lists the known keys or values.
    """
    moving = load_moving_scene(path)
    return moving.at(moving.scene.stamp) if moving.motions else moving.scene


def load_moving_scene(path: str | os.PathLike[str]) -> MovingScene:
    """Read a scene file with the tracks of its obstacles.

    Args:
        path: YAML file in the format of docs/scene.md.

    Returns:
        The scene in metres, regardless of the file's units. Obstacles without a track keep their velocity.

    Raises:
        InputError: when there is no such file or it can't be read.
        FileFormatError: when the file is not a scene file or an entry is wrong; the message names the file, the entry
            and the key, and lists the known keys or values.
    """
    path = file_path(path, "path")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"scene file {path} can't be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: not a text file in UTF-8 (byte {error.start}); save it as UTF-8") from error
    try:
        return _scene(_parsed(text))
    except InputError as error:
        raise FileFormatError(f"{path}: {error}") from error


def save_scene(scene: Scene | MovingScene, path: str | os.PathLike[str]) -> None:
    """Write a scene file in metres. Reading the file gives exactly the same numbers.

    If writing fails, an existing file at this path stays unchanged.

    Args:
        scene: scene with shapes from ``imitarm.scene.OBSTACLES``. The motions of a moving scene must be tracks.
        path: the file; its folder must exist.

    Raises:
        InputError: when an obstacle's shape is not registered, two obstacles have the same name, a motion is not a
            track, or the file can't be written.
    """
    tracks: dict[int, Track] = {}
    if isinstance(scene, MovingScene):
        tracks, scene = _tracks(scene), scene.scene
    instance(scene, Scene, "scene")
    path = file_path(path, "path")
    _check_names("obstacles", scene.obstacles)
    _check_names("fixtures", scene.fixtures)
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION, "units": "m"}
    if scene.goal is not None:
        content["goal"] = _pose_entry(scene.goal)
    if scene.stamp:
        content["stamp"] = scene.stamp
    content["obstacles"] = [_obstacle_entry(obstacle, tracks.get(i)) for i, obstacle in enumerate(scene.obstacles)]
    if scene.fixtures:
        content["fixtures"] = [_obstacle_entry(fixture) for fixture in scene.fixtures]
    text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
    write_text(path, text)


# plain decimal numbers; 0500, 1:30, 0x1F and 1_000 (in YAML 1.1: 320, 90, 31 and 1000) stay text, and are refused
_INTEGER = re.compile(r"[-+]?(0|[1-9]\d*)$")
_REAL = re.compile(r"[-+]?((0|[1-9]\d*)(\.\d*)?|\.\d+)([eE][-+]?\d+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
_ODD_NUMBER = re.compile(r"[-+]?[\d.][\w.:+-]*$")
_INTEGER_TAG, _REAL_TAG = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"


class _Loader(yaml.SafeLoader):
    """Plain YAML that rejects duplicate keys and numbers that are not plain decimals."""

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML's own attribute)
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_INTEGER_TAG, _REAL_TAG)]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    problem = f'key "{key.value}" is given twice; remove one'
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)

    def number(self, node: yaml.ScalarNode) -> int | float:
        """Return a number; a number with an explicit tag must also be a plain decimal."""
        if _INTEGER.match(node.value):
            return int(node.value)
        if _REAL.match(node.value):
            return float(self.construct_yaml_float(node))
        problem = f"{_shown(node.value)} is not a plain decimal number"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


class _Dumper(yaml.SafeDumper):
    """Writes quotes around text that a loader would read as a number."""


for _tag, _pattern in ((_INTEGER_TAG, _INTEGER), (_REAL_TAG, _REAL)):
    _Loader.add_constructor(_tag, _Loader.number)
    for _either in (_Loader, _Dumper):
        _either.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))


def _parsed(text: str) -> object:
    """Return the content of the YAML text in plain Python types."""
    try:
        return yaml.load(text, _Loader)  # a SafeLoader
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else ""
        raise InputError(f"{where}not readable as YAML: {problem}") from error
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        # errors that PyYAML does not convert: the 13th month, an explicit tag that does not fit its value, deep nesting
        raise InputError(f"not readable as YAML: {error}") from error


def _scene(content: object) -> MovingScene:
    if content is None:
        raise InputError(f'the file is empty; a scene file begins with "format: {FORMAT}"')
    if not isinstance(content, Mapping):
        raise InputError(f'not a scene file: the top must be keys and values, beginning with "format: {FORMAT}"')
    if content.get("format") != FORMAT:
        raise InputError(f'not a scene file: "format: {FORMAT}" is missing (format is {_shown(content.get("format"))})')
    version = content.get("version")
    if isinstance(version, bool) or version != VERSION:
        raise InputError(
            f"version is {_shown(version)}, but this imitarm reads version {VERSION}; update imitarm or the file"
        )
    _check_keys(content, _TOP, "the top level")
    units = content.get("units", "m")
    if not isinstance(units, str) or units not in UNITS:
        raise InputError(f"units: unknown unit {_shown(units)}{_suggestion(units, UNITS)}; known: {', '.join(UNITS)}")
    goal = content.get("goal")
    pose = None if goal is None else _goal(goal, UNITS[units])
    obstacles, fixtures = (_obstacles(content, key, UNITS[units]) for key in ("obstacles", "fixtures"))
    if units != "m":
        _check_distances(pose, (*obstacles, *fixtures), units)
    scene = Scene(pose, obstacles, _scaled(content.get("stamp", 0.0), "stamp", 1.0, 0), fixtures)
    tracks: dict[str | int, Track] = {}
    for i, entry in enumerate(content.get("obstacles") or []):
        if _TRACK in entry:
            tracks[i] = _track(entry, f"obstacles[{i}] ({scene.name_of(i)})", UNITS[units])
    return MovingScene(scene, tracks)


def _track(entry: Mapping[Any, Any], where: str, metres: float) -> Track:
    """Return the track of an obstacle from rows of time, position and, where it rotates, quaternion."""
    rows = _scaled(entry[_TRACK], f"{where}: {_TRACK}", 1.0)
    width = {len(row) if isinstance(row, list) else 0 for row in rows} if isinstance(rows, list) else {0}
    if len(width) != 1 or not width <= {4, 8}:
        form = "[time, x, y, z] or [time, x, y, z, qw, qx, qy, qz]"
        raise InputError(f"{where}: {_TRACK} must be a list of rows {form}, all of one kind")
    both = [key for key in ("velocity", "angular_velocity") if key in entry]
    if both:
        raise InputError(f"{where}: has both {both[0]} and {_TRACK}; remove one")
    table = np.array(rows)
    positions = metres * table[:, 1:4]
    try:
        track = Track(table[:, 0], positions, table[:, 4:] if width == {8} else None)
    except InputError as error:
        raise InputError(f"{where}: {str(error).replace('Track', _TRACK)}") from error
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(track.times)
    _check_speed(f"{_TRACK} with a speed", steps.max(initial=0.0), _FASTEST, "m/s", where)
    nearest = float(np.linalg.norm(positions, axis=1).min())
    if nearest > _FARTHEST:
        raise InputError(f"{where}: {_TRACK} stays {nearest:.3g} m from the robot's base; check units")
    return track


def _tracks(moving: MovingScene) -> dict[int, Track]:
    """Return the tracks of a moving scene by the index of the obstacle."""
    names = [obstacle.name for obstacle in moving.scene.obstacles]
    tracks = {}
    for key, motion in moving.motions.items():
        if not isinstance(motion, Track):
            raise InputError(f"a scene file can't hold the motion of obstacle {key!r}, because it is not a Track")
        tracks[key if isinstance(key, int) else names.index(key)] = motion
    return tracks


def _obstacles(content: Mapping[Any, Any], key: str, metres: float) -> tuple[Obstacle, ...]:
    entries = content.get(key)
    if entries is not None and not isinstance(entries, list):
        raise InputError(f"{key}: must be a list; begin each entry with a dash")
    may_move = key == "obstacles"
    obstacles = tuple(_obstacle(entry, f"{key}[{i}]", metres, may_move) for i, entry in enumerate(entries or []))
    _check_names(key, obstacles)
    return obstacles


def _check_names(key: str, obstacles: Sequence[Obstacle]) -> None:
    """Reject two obstacles with the same name, because obstacles and fixtures are identified by their names."""
    names = [obstacle.name for obstacle in obstacles]
    for i, name in enumerate(names):
        if name and (first := names.index(name)) < i:
            raise InputError(f'{key}[{first}] and {key}[{i}] are both named "{name}"; give each a name of its own')


def _check_distances(goal: Pose | None, obstacles: Iterable[Obstacle], units: str) -> None:
    """Reject a scene that lies within the robot's base, because its numbers are probably metres, not ``units``."""
    corners = [obstacle.bounds() for obstacle in obstacles] + ([] if goal is None else [goal.position])
    farthest = max((float(np.abs(corner).max()) for corner in corners), default=np.inf)
    if farthest < _NEAREST:
        raise InputError(
            f"units: in {units}, everything lies within {1e3 * farthest:.3g} mm of the robot's base; check units: are "
            "the numbers in metres?"
        )


def _goal(entry: object, metres: float) -> Pose:
    if not isinstance(entry, Mapping):
        raise InputError(f"goal: must have the keys position and quaternion, got {_shown(entry)}")
    _check_keys(entry, ("position", *_ROTATIONS), "goal")
    if not any(key in entry for key in _ROTATIONS):  # the tool of an arm rarely points up, so no rotation is assumed
        raise InputError(f"goal: the rotation of the tool is missing; give one of: {', '.join(_ROTATIONS)}")
    return _pose(entry, "goal", metres)


def _obstacle(entry: object, where: str, metres: float, may_move: bool) -> Obstacle:
    if not isinstance(entry, Mapping):
        raise InputError(f"{where}: must have the key type and the shape's own keys, got {_shown(entry)}")
    shape = _shape(entry.get("type"), where)
    kind = shape.kind
    name = entry.get("name", "")
    where += f' ({kind} "{name}")' if name else f" ({kind})"
    own = _own_keys(shape)
    posed = "pose" in own
    lengths = [key for key in own if key != "pose"]
    common = (*_COMMON, _TRACK) if may_move else _COMMON
    _check_keys(entry, ("type", *common, *(("position", *_ROTATIONS) if posed else ()), *lengths), where)
    if not isinstance(name, str):
        raise InputError(f'{where}: name must be text; put it in quotes: "{name}"')
    values: dict[str, Any] = {key: _scaled(_required(entry, key, where), f"{where}: {key}", metres) for key in lengths}
    if posed:
        values["pose"] = _pose(entry, where, metres)
    if "velocity" in entry:
        values["velocity"] = _scaled(entry["velocity"], f"{where}: velocity", metres)
    if "angular_velocity" in entry:
        values["angular_velocity"] = _scaled(entry["angular_velocity"], f"{where}: angular_velocity", 1.0)
    try:
        obstacle = shape(**values, name=name)
    except InputError as error:
        label = f'{shape.__name__} "{name}": ' if name else f"{shape.__name__}: "
        raise InputError(f"{where}: {str(error).replace(label, '')}") from error
    _check_speed("velocity", obstacle.velocity, _FASTEST, "m/s", where)
    _check_speed("angular_velocity", obstacle.angular_velocity, _FASTEST_ROTATION, "rad/s", where)
    _check_distance(obstacle, where)
    for key in lengths:
        if key not in _POINTS or key == "points":
            _check_size(key, values[key], where)
    return obstacle


def _check_speed(key: str, value: Any, fastest: float, unit: str, where: str) -> None:
    """Reject a velocity that is probably in another unit."""
    speed = float(np.linalg.norm(value))
    if speed > fastest:
        raise InputError(f"{where}: {key} of {speed:.3g} {unit} is beyond {fastest:g} {unit}; check its unit")


def _check_distance(obstacle: Obstacle, where: str) -> None:
    """Reject an obstacle far from the robot, because its numbers are probably centimetres, not metres."""
    nearest = float(np.linalg.norm(np.clip(0.0, *obstacle.bounds())))
    if nearest > _FARTHEST:
        raise InputError(f"{where}: is {nearest:.3g} m from the robot's base, where no arm reaches; check units")


def _check_size(key: str, value: Any, where: str) -> None:
    """Reject an obstacle of less than 1 mm, because its numbers are probably in another unit."""
    numbers = np.asarray(value)
    sizes = np.ptp(numbers, axis=0) if key == "points" else np.atleast_1d(numbers)
    smallest = float(sizes.min()) * (2.0 if key in ("radius", "semi_axes") else 1.0)
    if smallest < _SMALLEST * (1.0 - 1e-9):
        raise InputError(
            f"{where}: {key} makes the obstacle {1e3 * smallest:.3g} mm thick, less than 1 mm; check units"
        )


def _shape(kind: object, where: str) -> type[Obstacle]:
    known = imitarm.scene.OBSTACLES
    names = f"known types: {', '.join(known)}"
    if kind is None:
        raise InputError(f'{where}: key "type" is missing; {names}')
    if not isinstance(kind, str) or kind not in known:
        raise InputError(f"{where}: unknown type {_shown(kind)}{_suggestion(kind, known)}; {names}")
    return known[kind]


def _own_keys(shape: type[Obstacle]) -> list[str]:
    """Return the fields specific to this shape."""
    return [f.name for f in fields(shape) if f.init and f.name not in (*_COMMON, *_UNWRITTEN)]


def _pose(entry: Mapping[Any, Any], where: str, metres: float) -> Pose:
    given = [key for key in _ROTATIONS if key in entry]
    if len(given) > 1:
        raise InputError(f"{where}: {' and '.join(given)} both give the rotation; keep one")
    position = _scaled(_required(entry, "position", where), f"{where}: position", metres)
    quaternion: Any = [1.0, 0.0, 0.0, 0.0]
    if given:
        value = _scaled(entry[given[0]], f"{where}: {given[0]}", 1.0)
        quaternion = value if given[0] == "quaternion" else _from_degrees(given[0], value, where)
    try:
        return Pose(np.asarray(position), np.asarray(quaternion))
    except (InputError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error


def _from_degrees(key: str, value: Any, where: str) -> Any:
    """Return the quaternion of roll, pitch and yaw about the fixed x, y and z axes, in this order, or of yaw only."""
    numbers = value if isinstance(value, list) else [value]
    plain = all(isinstance(number, float) and math.isfinite(number) for number in numbers)
    if not plain or np.shape(value) != ((3,) if key == "rpy_degrees" else ()):
        wanted = "3 finite numbers (roll, pitch, yaw)" if key == "rpy_degrees" else "one finite number"
        raise InputError(f"{where}: {key} must be {wanted}, got {_shown(value)}")
    angles = np.deg2rad(numbers)
    if key == "yaw_degrees":
        return quaternion_exp([0.0, 0.0, angles[0]])
    roll, pitch, yaw = quaternion_exp(np.diag(angles))
    return quaternion_multiply(yaw, quaternion_multiply(pitch, roll))


def _required(entry: Mapping[Any, Any], key: str, where: str) -> Any:
    if entry.get(key) is None:
        raise InputError(f'{where}: key "{key}" is missing')
    return entry[key]


def _scaled(value: object, where: str, metres: float, depth: int = 2) -> Any:
    """Return a number, a list of numbers or a list of such lists, with each number multiplied by ``metres``."""
    if isinstance(value, list) and depth:
        return [_scaled(item, f"{where}[{i}]", metres, depth - 1) for i, item in enumerate(value)]
    if isinstance(value, str) and _ODD_NUMBER.match(value) and not (_INTEGER.match(value) or _REAL.match(value)):
        raise InputError(
            f"{where}: {_shown(value)} can be read as several numbers; write a plain decimal number, without leading "
            "zeros, colons or underscores"
        )
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} must be a number or a list of numbers, got {_shown(value)}")
    try:
        return float(value) * metres
    except OverflowError:
        raise InputError(f"{where} is too large for a number") from None


def _check_keys(entry: Mapping[Any, Any], known: Iterable[str], where: str) -> None:
    known = list(known)
    for key in entry:
        if key not in known:
            raise InputError(f'{where}: unknown key "{key}"{_suggestion(key, known)}; known keys: {", ".join(known)}')


def _suggestion(word: object, known: Iterable[str]) -> str:
    """Return a hint such as `` (did you mean "size"?)``, or an empty text."""
    close = difflib.get_close_matches(str(word).lower(), list(known), n=1, cutoff=0.5)
    return f' (did you mean "{close[0]}"?)' if close else ""


def _pose_entry(pose: Pose) -> dict[str, Any]:
    return {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}


def _obstacle_entry(obstacle: Obstacle, track: Track | None = None) -> dict[str, Any]:
    known = imitarm.scene.OBSTACLES
    if type(obstacle) is not known.get(obstacle.kind):
        raise InputError(f"a scene file can't hold a {type(obstacle).__name__}; known types: {', '.join(known)}")
    entry: dict[str, Any] = {"type": obstacle.kind}
    if obstacle.name:
        entry["name"] = obstacle.name
    for key in _own_keys(type(obstacle)):
        value = getattr(obstacle, key)
        entry.update(_pose_entry(value) if key == "pose" else {key: np.asarray(value).tolist()})
    if obstacle.velocity.any():
        entry["velocity"] = obstacle.velocity.tolist()
    if obstacle.angular_velocity.any():
        entry["angular_velocity"] = obstacle.angular_velocity.tolist()
    if track is not None:
        parts = [track.times[:, None], track.positions, *([] if track.quaternions is None else [track.quaternions])]
        entry[_TRACK] = np.concatenate(parts, axis=1).tolist()
        for key in ("velocity", "angular_velocity"):  # the track replaces them
            entry.pop(key, None)
    return entry
