"""Which recordings the mapping benchmark has: plain values that say all of one, and seed what is random in it."""

from __future__ import annotations

from dataclasses import dataclass

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.errors import InputError, UnknownNameError

KINDS = ("inside", "edge", "drawing", "stacking")
"""Kinds of recordings of made-up people: reaches where an arm works with ease; the same with the arm stretched out
every few seconds, beyond what the robot reaches; circles, eights and waves; a whole stacking of four cubes."""
CAPTURED = "captured"
"""The kind that needs real data: an arm recorded by motion capture, before a made-up camera."""

REPEATS = 100
"""Recordings of one kind that a person has at most: more would have the seeds of the next person."""
_LONGEST = 120.0  # [s] of a recording


@dataclass(frozen=True)
class Plan:
    """Which recording; plain values that say all of it.

    Attributes:
        kind: one of :data:`KINDS`, or :data:`CAPTURED`.
        person: seed of the person, whose limbs and habits differ.
        repeat: which of this person, 0 to 99: seeds motion and camera; of the captured arm: before which camera.
        seconds: of motion; reaches and drawings take about so long, a capture is cut to it, stacking as it takes.
        sigma: of the camera's error [m]; None: 1 to 2 cm, by the seed.
        data: folder of real recordings, for :data:`CAPTURED`.

    Raises:
        UnknownNameError: when there is no such kind.
        InputError: when a number is out of range.
    """

    kind: str
    person: int
    repeat: int = 0
    seconds: float = 10.0
    sigma: float | None = None
    data: str = ""

    def __post_init__(self) -> None:
        if self.kind not in {*KINDS, CAPTURED}:
            raise UnknownNameError.among("kind of recording", self.kind, (*KINDS, CAPTURED))
        if self.person < 0 or not 0 <= self.repeat < REPEATS or not 4.0 <= self.seconds <= _LONGEST:
            raise InputError(
                f"Plan: person must be at least 0, repeat 0 to {REPEATS - 1}, seconds 4 to {_LONGEST:g}; got {self}"
            )
        if self.sigma is not None and not 0.0 <= self.sigma <= 0.1:
            raise InputError(f"Plan: sigma must be between 0 and 0.1 m, got {self.sigma!r}")

    @property
    def number(self) -> int:
        """A number of its own, whoever the person is, to seed what is random in it."""
        return 10 * (REPEATS * self.person + self.repeat) + (*KINDS, CAPTURED).index(self.kind)

    def camera(self, number: int) -> SkeletonCamera:
        """Return a camera with all the faults of a real one."""
        return SkeletonCamera.from_seed(number) if self.sigma is None else SkeletonCamera(number, sigma=self.sigma)
