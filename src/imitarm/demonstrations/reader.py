"""What every file format has in common, and the options with which files are read."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.raw import RawDemonstration
from imitarm.errors import FileFormatError, InputError, UnknownNameError

Array = NDArray[np.float64]

LENGTH_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
QUATERNION_ORDERS = {"wxyz": (0, 1, 2, 3), "xyzw": (3, 0, 1, 2)}


@dataclass(frozen=True)
class ReadOptions:
    """What a file may leave unsaid.

    Attributes:
        units: of lengths: ``"m"``, ``"cm"`` or ``"mm"``; None: as the file says, else m.
        time_units: of time stamps: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``; None: as the file says, else s.
        duration: of the motion [s], for files without time stamps.
        rate: samples a second [Hz], for files without time stamps.
        quaternion_order: ``"wxyz"`` or ``"xyzw"``, for quaternion columns without names.
        task: what is shown; used where the file does not say.

    Raises:
        InputError: when a value is not possible.
    """

    units: str | None = None
    time_units: str | None = None
    duration: float | None = None
    rate: float | None = None
    quaternion_order: str = "wxyz"
    task: str = ""

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("unit of length", self.units, LENGTH_UNITS),
            ("unit of time", self.time_units, TIME_UNITS),
            ("quaternion order", self.quaternion_order, QUATERNION_ORDERS),
        ):
            if name is not None and name not in known:
                raise UnknownNameError.among(kind, name, known)
        for what, value in (("duration", self.duration), ("rate", self.rate)):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"{what} must be a positive number, got {value!r}")
        if self.duration is not None and self.rate is not None:
            raise InputError("give duration or rate, not both: each follows from the other")

    def metres(self, source: str, positions: Array, said: str | None = None) -> Array:
        """Return ``positions`` in metres; ``said`` is the unit that the file itself names."""
        return positions * _factor(source, "units", self.units, said, LENGTH_UNITS, "m")

    def seconds(self, source: str, times: Array, said: str | None = None) -> Array:
        """Return time stamps (n,) in seconds; ``said`` is the unit that the file itself names.

        Raises:
            InputError: when a duration or rate was given for a file that has time stamps.
        """
        if self.duration is not None or self.rate is not None:
            raise InputError(f"{source}: has time stamps of its own; leave out duration and rate")
        return times * _factor(source, "time_units", self.time_units, said, TIME_UNITS, "s")

    def even_times(self, source: str, n: int) -> Array:
        """Return times (n,) [s] for a file without stamps.

        Raises:
            FileFormatError: when neither duration nor rate was given.
        """
        if self.duration is not None:
            return np.linspace(0.0, self.duration, n)
        if self.rate is not None:
            return np.arange(n) / self.rate
        raise FileFormatError(
            f"{source}: has no time stamps; say how long the motion took, duration=10.0 [s], or its rate=100.0 [Hz]"
        )

    def wxyz(self, quaternions: Array) -> Array:
        """Return unnamed quaternion columns (..., 4) in the order w, x, y, z."""
        return quaternions[..., list(QUATERNION_ORDERS[self.quaternion_order])]


def _factor(
    source: str, option: str, asked: str | None, said: str | None, known: dict[str, float], default: str
) -> float:
    if said is not None and said not in known:
        raise FileFormatError(f"{source}: says its unit is {said!r}; known: {', '.join(known)}")
    if asked is not None and said is not None and asked != said:
        raise InputError(f"{source}: says its unit is {said}, but {option}={asked!r} was asked for; leave it out")
    return known[asked or said or default]


class Reader(ABC):
    """One file format. A new one is a file with a subclass and a line in ``READERS``."""

    name: ClassVar[str]

    @abstractmethod
    def recognises(self, head: bytes) -> bool:
        """Tell by the first bytes of a file, never by its name, whether it is of this format."""

    @abstractmethod
    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return the motions in a file of this format.

        Raises:
            FileFormatError: when the file is damaged; the message names file, place and remedy.
            InputError: when the options do not fit the file.
        """
