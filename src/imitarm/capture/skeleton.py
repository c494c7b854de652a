"""Skeleton: the joints of a person at one time, as a camera reports them. SkeletonSource: a source of skeletons."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.validation import finite_number, real_array, whole_number

Array = NDArray[np.float64]

JOINTS = (
    "spine_base",
    "spine_mid",
    "neck",
    "head",
    "shoulder_left",
    "elbow_left",
    "wrist_left",
    "hand_left",
    "shoulder_right",
    "elbow_right",
    "wrist_right",
    "hand_right",
    "hip_left",
    "knee_left",
    "ankle_left",
    "foot_left",
    "hip_right",
    "knee_right",
    "ankle_right",
    "foot_right",
    "spine_shoulder",
    "hand_tip_left",
    "thumb_left",
    "hand_tip_right",
    "thumb_right",
)
"""Names of the 25 joints, in the order of the Kinect v2 SDK; left and right are the person's left and right."""

JOINT = {name: index for index, name in enumerate(JOINTS)}
"""Index of each joint in :data:`JOINTS`, by name."""

SIDES = ("left", "right")
FARTHEST = 20.0  # [m] beyond the range of any skeleton camera: a joint farther away was not measured
_ARM_PARTS = ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")
ARM_JOINTS = {side: np.array([JOINT[f"{part}_{side}"] for part in _ARM_PARTS]) for side in SIDES}
"""Indices of shoulder, elbow, wrist, hand, hand tip and thumb of each side."""


class Tracking(IntEnum):
    """Whether a camera tracks a joint, infers its position, or has lost it.

    The numbers are those of the Kinect SDK.
    """

    LOST = 0
    INFERRED = 1
    TRACKED = 2


_LOST = int(Tracking.LOST)  # quicker to look up than a member


class HandState(IntEnum):
    """State of a hand, numbered as in the Kinect SDK."""

    UNKNOWN = 0
    NOT_TRACKED = 1
    OPEN = 2
    CLOSED = 3
    LASSO = 4


CONFIDENCE = np.array([0.0, 0.2, 1.0])
"""Confidence of a joint's position for each state of :class:`Tracking`; docs/retargeting.md describes its use."""
CONFIDENCE.setflags(write=False)


@dataclass(frozen=True, eq=False)
class Arm:
    """One arm of a person at one time, in the sensor's frame.

    Attributes:
        time: time of the exposure, on the source's clock [s].
        points: positions of shoulder, elbow, wrist, hand, hand tip, thumb, shape (6, 3) [m]; nan where lost.
        confidence: confidence of each point, 0 (lost) to 1 (tracked), shape (6,).
        hand_state: state of the hand, for example open or closed.
    """

    time: float
    points: Array
    confidence: Array
    hand_state: HandState = HandState.UNKNOWN

    @property
    def shoulder(self) -> Array:
        """Position of the shoulder, shape (3,) [m]."""
        return self.points[0]

    @property
    def elbow(self) -> Array:
        """Position of the elbow, shape (3,) [m]."""
        return self.points[1]

    @property
    def wrist(self) -> Array:
        """Position of the wrist, shape (3,) [m]."""
        return self.points[2]

    @property
    def seen(self) -> bool:
        """Whether shoulder, elbow and wrist are each tracked or inferred, not lost."""
        return min(self.confidence.tolist()[:3]) > 0.0


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The joints of a person at one time, as a camera reports them.

    The coordinate frame is that of the Kinect v2: origin in the sensor, x to the sensor's left, y up, z away from the
    sensor, right-handed. The right hand of a person who faces the sensor has a larger x than the left hand.

    A joint counts as lost if its position is not finite, or if the joint is more than 20 m away from the sensor. The
    position of every lost joint is nan.

    Attributes:
        time: time of the exposure, on the source's clock [s].
        positions: positions of the joints :data:`JOINTS`, shape (25, 3) [m]; nan where lost.
        tracking: :class:`Tracking` of each joint, shape (25,).
        hand_states: states of the left and the right hand.
        person: number that the source gives to the person.

    Raises:
        InputError: when a shape is wrong, the time is not finite, or a state has an unknown number.
    """

    time: float
    positions: Array
    tracking: NDArray[np.int8] = field(default_factory=lambda: np.full(len(JOINTS), Tracking.TRACKED, np.int8))
    hand_states: tuple[HandState, HandState] = (HandState.UNKNOWN, HandState.UNKNOWN)
    person: int = 0

    def __post_init__(self) -> None:
        n = len(JOINTS)
        time = finite_number(self.time, "Skeleton: time", "s")
        person = whole_number(self.person, "Skeleton: person")
        positions = np.array(real_array(self.positions, (n, 3), "Skeleton: positions", "m"))
        tracking: NDArray[Any] = self.tracking
        if type(tracking) is not np.ndarray or tracking.dtype != np.int8 or tracking.shape != (n,):
            tracking = real_array(tracking, (n,), "Skeleton: tracking")
        if not ((tracking == 0) | (tracking == 1) | (tracking == 2)).all():
            raise InputError(f"Skeleton: tracking must be 0, 1 or 2 (lost, inferred, tracked), got {tracking}")
        try:
            left, right = (state if type(state) is HandState else HandState(state) for state in self.hand_states)
        except (TypeError, ValueError) as error:
            raise InputError(f"Skeleton: hand_states must be two of 0 to 4, got {self.hand_states!r}") from error
        tracking = tracking.astype(np.int8)
        with np.errstate(invalid="ignore"):
            measured = np.abs(positions) <= FARTHEST
        if not measured.all():
            tracking[~measured.all(axis=1)] = Tracking.LOST
        lost = tracking == _LOST
        if lost.any():
            positions[lost] = np.nan
        positions.setflags(write=False)
        tracking.setflags(write=False)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "person", person)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "tracking", tracking)
        object.__setattr__(self, "hand_states", (left, right))

    def joint(self, name: str) -> Array:
        """Return the position of a joint, shape (3,) [m]; nan when lost.

        Raises:
            UnknownNameError: when there is no such joint.
        """
        if not isinstance(name, str) or name not in JOINT:
            raise UnknownNameError.among("joint", name, JOINTS)
        return self.positions[JOINT[name]]

    def arm(self, side: str = "right") -> Arm:
        """Return the arm of one side.

        Raises:
            UnknownNameError: when ``side`` is neither left nor right.
        """
        if not isinstance(side, str) or side not in ARM_JOINTS:
            raise UnknownNameError.among("side", side, SIDES)
        index = ARM_JOINTS[side]
        return Arm(
            self.time,
            self.positions.take(index, axis=0),  # three times as fast as [index]
            CONFIDENCE.take(self.tracking.take(index)),
            self.hand_states[SIDES.index(side)],
        )


def number_after_colon(word: str, what: str, text: str, largest: int) -> int:
    """Return the number after the colon in the name of a source, for example 0 in ``webcam:0``.

    Raises:
        InputError: when the text is not a whole number from 0 to ``largest``.
    """
    if not text.isdecimal() or int(text) > largest:
        raise InputError(f"source {word}:{text}: {what} must be a whole number from 0 to {largest}")
    return int(text)


class SkeletonSource(ABC):
    """A source of skeletons: a recording, a camera, a stream, or a synthetic person.

    Iteration yields skeletons in the order of their times until the source ends::

        with open_source("synthetic:7") as source:
            for skeleton in source:
                ...

    To write your own source, derive a class from this one and implement :meth:`read` and :attr:`over`::

        class GloveSource(SkeletonSource):
            argument, description, live = "PORT", "a data glove at a serial port", True

    Then declare the class in the ``pyproject.toml`` of your package. Every command of imitarm then accepts
    ``glove:PORT``::

        [project.entry-points."imitarm.sources"]
        glove = "my_package.glove:GloveSource"

    Attributes:
        name: name of the source in messages and in recordings, for example the file's name.
        argument: text that a user writes after the colon, for example ``"SEED"``; empty if there is no colon.
        description: one line that describes the source in ``--help``.
        live: whether the source runs until it is stopped.
        has_realtime: whether :meth:`open` implements ``realtime``. If not, :func:`~imitarm.capture.sources.open_source`
            delays the skeletons for a replay in real time.
    """

    name: str = "skeletons"
    argument: str = ""
    description: str = ""
    live: bool = False
    has_realtime: bool = False

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> SkeletonSource:
        """Open the source with the argument that a user wrote after the colon.

        The default implementation passes this argument to the constructor.

        Args:
            argument: the text after the colon; always empty for a source whose attribute ``argument`` is empty.
            realtime: whether a source that is not live returns its skeletons at the recorded speed.

        Raises:
            InputError: when the argument is wrong, or a device or a program is missing.
        """
        return cls(*((argument,) if cls.argument else ()))

    @abstractmethod
    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None if none arrives within ``timeout`` seconds, or if the source has ended."""

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether the source has ended, so that no more skeletons will follow."""

    def close(self) -> None:  # noqa: B027 (a source without anything to release needs none)
        """Release files, sockets and devices; a second call does nothing."""

    def __iter__(self) -> Iterator[Skeleton]:
        while not self.over:
            skeleton = self.read()
            if skeleton is not None:
                yield skeleton

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
