"""SyntheticSource: skeletons of a made-up person, as a made-up camera sees them; seeded."""

from __future__ import annotations

import time as clock

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import Truth, reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.errors import InputError


class SyntheticSource(SkeletonSource):
    """A made-up person before a made-up camera; the same seeds give the same skeletons.

    Args:
        truth: where every joint truly is at each time.
        camera: what is made of it.
        duration: [s].
        realtime: give each skeleton when its time has come, as a camera does; else as fast as it is asked.
        name: for messages.
    """

    def __init__(
        self,
        truth: Truth,
        camera: SkeletonCamera,
        duration: float,
        *,
        realtime: bool = False,
        name: str = "synthetic person",
    ) -> None:
        if not 0.0 < duration < 86400.0:
            raise InputError(f"SyntheticSource: duration must be positive and at most a day [s], got {duration!r}")
        self.truth, self.name = truth, name
        self._camera, self._duration, self._realtime = camera, duration, realtime
        self._next = 0.0
        self._started: float | None = None

    @classmethod
    def from_seed(
        cls, seed: int, *, duration: float = 12.0, kind: str = "inside", realtime: bool = False
    ) -> SyntheticSource:
        """Return person number ``seed``, who reaches about, before a camera of usual noise."""
        person = Person.from_seed(seed)
        truth = reaching(person, seed, duration=duration, kind=kind)
        return cls(truth, SkeletonCamera(seed), duration, realtime=realtime, name=f"synthetic:{seed}")

    @property
    def over(self) -> bool:
        """Whether the duration is over."""
        return self._next > self._duration

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None when the camera lost this frame, or it is later than ``timeout`` from now."""
        if self.over:
            return None
        if self._realtime:
            now = clock.monotonic()
            self._started = now if self._started is None else self._started
            wait = self._started + self._next - now
            if wait > timeout:
                clock.sleep(timeout)
                return None
            clock.sleep(max(wait, 0.0))
        seen = self._camera.see(self.truth(self._next))
        self._next = self._camera.next_time(self._next)
        return seen
