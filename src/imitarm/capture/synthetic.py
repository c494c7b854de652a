"""SyntheticSource: skeletons of a synthetic person, measured by a simulated camera; a seed determines both."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from functools import partial

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import DRAWINGS, REACHES, Truth, drawing, reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton, SkeletonSource, number_after_colon
from imitarm.errors import UnknownNameError
from imitarm.validation import finite_number

MOTIONS: dict[str, Callable[..., Truth]] = {
    **{kind: partial(reaching, kind=kind) for kind in REACHES},
    **{kind: partial(drawing, kind=kind) for kind in DRAWINGS},
}
"""Kinds of motion, by name: each function takes a synthetic person, a seed and ``duration`` [s], and returns the true
skeleton as a function of time.
"""


class SyntheticSource(SkeletonSource):
    """A synthetic person in front of a simulated camera; the same seeds give the same skeletons.

    The measured positions can be compared with the true positions::

        source = SyntheticSource.from_seed(3, kind="edge")
        for skeleton in source: error = skeleton.positions - source.truth(skeleton.time).positions

    Args:
        truth: true positions of all joints, as a function of time.
        camera: the simulated camera.
        duration: duration of the motion [s].
        realtime: True: return the skeletons in real time, as a camera does. False: return them as fast as they are
            read.
        name: name of the source in messages.

    Attributes:
        truth: function that returns the true positions of all joints at a time [s].

    Raises:
        InputError: when the duration is not positive, or longer than a day.
    """

    argument = "SEED"
    description = "a synthetic person in front of a simulated camera with realistic errors"
    has_realtime = True

    def __init__(
        self,
        truth: Truth,
        camera: SkeletonCamera,
        duration: float,
        *,
        realtime: bool = False,
        name: str = "synthetic person",
    ) -> None:
        finite_number(duration, "SyntheticSource: duration", "s", above=0.0, at_most=86400.0)
        self.truth, self.name = truth, name
        self._camera, self._duration, self._realtime = camera, duration, realtime
        self._next = 0.0
        self._started: float | None = None

    @classmethod
    def from_seed(
        cls, seed: int, *, duration: float = 12.0, kind: str = "inside", realtime: bool = False
    ) -> SyntheticSource:
        """Return a random person, motion and camera, all determined by ``seed``; the camera's noise is 1 to 2 cm.

        Args:
            seed: seed of person, motion and camera.
            duration: duration of the motion [s]; the hand is at rest during the first second.
            kind: kind of motion, one of :data:`MOTIONS`.
            realtime: whether to return the skeletons in real time.

        Raises:
            UnknownNameError: when there is no such motion.
        """
        if not isinstance(kind, str) or kind not in MOTIONS:
            raise UnknownNameError.among("motion", kind, MOTIONS)
        truth = MOTIONS[kind](Person.from_seed(seed), seed, duration=duration)
        name = f"synthetic:{seed}" if kind == "inside" else f"synthetic:{seed}:{kind}"
        return cls(truth, SkeletonCamera.from_seed(seed), duration, realtime=realtime, name=name)

    @classmethod
    def open(cls, argument: str, *, realtime: bool = False) -> SyntheticSource:
        """Return the synthetic person with the seed ``argument``.

        The command line calls this source ``synthetic:SEED``.

        Raises:
            InputError: when the seed is not a whole number.
        """
        return cls.from_seed(number_after_colon("synthetic", cls.argument, argument, 2**31 - 1), realtime=realtime)

    @property
    def over(self) -> bool:
        """Whether the duration has elapsed."""
        return self._next > self._duration

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None when the next frame is lost or is not due within ``timeout`` seconds."""
        if self.over:
            return None
        if self._realtime:
            now = clock.monotonic()
            self._started = now if self._started is None else self._started
            wait = self._started + self._next - now
            clock.sleep(min(max(wait, 0.0), max(timeout, 0.0)))
            if wait > timeout:
                return None
        seen = self._camera.see(self.truth(self._next))
        self._next = self._camera.next_time(self._next)
        return seen
