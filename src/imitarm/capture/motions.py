"""What a made-up person does with a hand: seeded reaches, and a real arm from motion capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline

from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.errors import FileFormatError, InputError, UnknownNameError

Array = NDArray[np.float64]
Truth = Callable[[float], Skeleton]
"""A person in motion: from a time [s] to where every joint truly is."""

REACHES = ("inside", "edge")
REST = 1.0  # [s] with a still hand at the beginning, so that a robot can take hold
_INSIDE = np.array([[-0.15, 0.5], [-0.7, 0.1], [0.7, 1.0]])  # direction from the shoulder: out, up, forward
_AWAY = (0.55, 0.85)  # of the reach
_SPEED = (0.25, 0.55)  # [m/s] mean speed of a reach
_UPPER_ARM = (0.1, 0.6)  # [m]
_MARKERS = ("right_shoulder", "right_elbow", "hand_left", "hand_right", "middle_middle", "thumb_middle")


def minimum_jerk(points: ArrayLike, times: ArrayLike) -> BSpline:
    """Return the quintic spline through ``points`` (n, d) at ``times`` (n,) that is at rest at both ends.

    It is the path of least jerk through these points (Flash and Hogan 1985).
    """
    at = np.asarray(points, dtype=float)
    zero = np.zeros(at.shape[1])
    return make_interp_spline(
        np.asarray(times, dtype=float), at, k=5, bc_type=([(1, zero), (2, zero)], [(1, zero), (2, zero)])
    )


def reaching(person: Person, seed: int, *, duration: float = 12.0, kind: str = "inside") -> Truth:
    """Return a person who reaches from place to place with the right hand.

    Args:
        person: who.
        seed: of the places and the pace.
        duration: [s]; the first second is still.
        kind: ``"inside"``: where an arm works with ease. ``"edge"``: every second reach goes out to the full stretch of
            the arm and stays there for a while, as far as a robot of the same proportions gets and farther.

    Raises:
        UnknownNameError: when there is no such kind.
        InputError: when the duration is shorter than 4 s.
    """
    if kind not in REACHES:
        raise UnknownNameError.among("kind of reach", kind, REACHES)
    if not duration >= 4.0:
        raise InputError(f"reaching: duration must be at least 4 s, got {duration!r}")
    rng = np.random.default_rng([30312, person.seed, seed])
    place = _comfortable(rng, person)
    places, times = [place], [REST]
    out = False
    while times[-1] < duration:
        out = kind == "edge" and not out
        place = _stretched(rng, person) if out else _comfortable(rng, person)
        pace = max(float(np.linalg.norm(place - places[-1])) / rng.uniform(*_SPEED), 0.6)
        places.append(place)
        times.append(times[-1] + pace)
        if out:
            places.append(place + rng.normal(0.0, 0.003, 3))
            times.append(times[-1] + 0.6)
    path = minimum_jerk(places, times)

    def truth(time: float) -> Skeleton:
        away = path(np.clip(time, times[0], times[-1]))
        return person.skeleton(time, person.shoulder("right", 0.0) + away)

    return truth


def _comfortable(rng: np.random.Generator, person: Person) -> Array:
    out, up, forward = rng.uniform(_INSIDE[:, 0], _INSIDE[:, 1])
    way = np.array([out, up, -forward])
    return np.asarray(rng.uniform(*_AWAY) * person.reach * way / np.linalg.norm(way))


def _stretched(rng: np.random.Generator, person: Person) -> Array:
    side, up = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.15)
    way = np.array([side, up, -1.0])
    return np.asarray(1.1 * person.reach * way / np.linalg.norm(way))


@dataclass(frozen=True, eq=False)
class MotionCapture:
    """A right arm recorded by optical motion capture, in axes x forward, y left, z up.

    Attributes:
        times: shape (n,) [s].
        points: shoulder, elbow, wrist, hand tip, thumb, shape (n, 5, 3) [m].
        source: the file.
    """

    times: Array
    points: Array
    source: str

    @classmethod
    def load(cls, path: str | Path, *, to_body: ArrayLike | None = None) -> MotionCapture:
        """Read markers of a right arm from a file of tab-separated values in millimetres.

        The wrist is taken midway between the two markers at the hand's near end.

        Args:
            path: the file.
            to_body: rotation from the file's axes to forward, left and up of the person, shape (3, 3); None: the
                file's axes are these.

        Raises:
            FileFormatError: when the file is not such a recording, naming what is wrong and in which line.
            InputError: when ``to_body`` is no rotation.
        """
        turn = np.eye(3) if to_body is None else np.array(to_body, dtype=float)
        if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0.0:
            raise InputError(f"MotionCapture: to_body must be a rotation of shape (3, 3), got {to_body!r}")
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise FileFormatError(f"{path}: can't be read as text ({error}); give a motion capture export") from error
        header = next((i for i, line in enumerate(lines) if line.startswith("MARKER_NAMES")), None)
        first = next((i for i, line in enumerate(lines) if line.startswith("Frame\tTime")), None)
        if header is None or first is None:
            raise FileFormatError(f"{path}: has no lines MARKER_NAMES and Frame; give a motion capture export as .tsv")
        names = lines[header].split("\t")[1:]
        missing = [name for name in _MARKERS if name not in names]
        if missing:
            raise FileFormatError(f"{path}, line {header + 1}: marker {missing[0]!r} is missing")
        columns = [2 + 3 * names.index(name) for name in _MARKERS]
        filled = [i for i in range(first + 1, len(lines)) if lines[i].strip()]
        if len(filled) < 2:
            raise FileFormatError(f"{path}: holds {len(filled)} frames; at least 2 are needed")
        table = np.array([_row(path, i + 1, lines[i], columns) for i in filled])
        back = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
        if len(back):
            raise FileFormatError(f"{path}, line {filled[back[0] + 1] + 1}: time does not increase; sort the frames")
        s, e, left, right, tip, thumb = np.moveaxis(table[:, 1:].reshape(len(table), -1, 3) * 1e-3 @ turn.T, 1, 0)
        upper = float(np.median(np.linalg.norm(e - s, axis=1)))
        if not _UPPER_ARM[0] < upper < _UPPER_ARM[1]:
            raise FileFormatError(
                f"{path}: an upper arm of {upper:.3g} m, if its numbers are millimetres; export positions in mm"
            )
        return cls(table[:, 0], np.stack([s, e, 0.5 * (left + right), tip, thumb], axis=1), path.name)

    def truth(self, person: Person) -> Truth:
        """Return the motion as done by ``person`` before a sensor; the arm is the captured one, bones and all.

        Between frames it is interpolated, before the first and after the last one it is still. The rest of the body
        stands upright where the person stands.
        """
        to_sensor = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
        points = self.points @ to_sensor.T
        points = points + (person.shoulder("right", 0.0) - points[:, 0].mean(axis=0))
        times = self.times - self.times[0]

        def truth(time: float) -> Skeleton:
            after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
            share = float(np.clip((time - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0))
            s, e, w, tip, thumb = points[after - 1] + share * (points[after] - points[after - 1])
            body = person.skeleton(time, w)
            positions = np.array(body.positions)
            for name, point in zip(
                ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb"),
                (s, e, w, 0.5 * (w + tip), tip, thumb),
                strict=True,
            ):
                positions[JOINT[f"{name}_right"]] = point
            return Skeleton(time, positions, hand_states=body.hand_states)

        return truth

    @property
    def duration(self) -> float:
        """From the first to the last frame [s]."""
        return float(self.times[-1] - self.times[0])


def _row(path: Path, number: int, line: str, columns: list[int]) -> list[float]:
    fields = line.split("\t")
    try:
        values = [float(fields[1])] + [float(fields[c + k]) for c in columns for k in range(3)]
    except (ValueError, IndexError) as error:
        raise FileFormatError(f"{path}, line {number}: not a frame of numbers ({error}); is the file whole?") from error
    if not np.isfinite(values).all():
        raise FileFormatError(f"{path}, line {number}: a marker of the arm has a gap; fill it before exporting")
    return values
