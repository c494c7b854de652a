"""BodyCamera: what cameras that track bodies themselves have in common."""

from __future__ import annotations

import time as clock
from abc import abstractmethod
from collections import deque

from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.errors import InputError, TaskFailedError

INSTEAD = (
    "without it: record elsewhere as a table of the Kinect SDK and open the file, receive udp:PORT from a machine that "
    "has the camera, or use webcam:NUMBER or video:FILE"
)
"""What else can be done where a camera can't be opened."""

_SILENT = 3.0  # [s] without a frame: a camera sends them with or without a person
_TURN = 0.5  # [s] that one wait takes at most, so that Ctrl-C is heard


class BodyCamera(SkeletonSource):
    """A camera whose driver gives frames of all bodies in view.

    Attributes:
        name: for messages.
    """

    def __init__(self) -> None:
        self._waiting: deque[Skeleton] = deque()
        self._over, self._silent = False, 0.0
        self._numbers: dict[int, int] = {}

    @abstractmethod
    def _frame(self, timeout: float) -> list[Skeleton] | None:
        """Return all bodies of the next frame, or None when none came within ``timeout`` seconds.

        Raises:
            TaskFailedError: when the driver reports a failure.
        """

    def _release(self) -> None:
        """Let go of the device."""

    @property
    def over(self) -> bool:
        """Whether the source is closed, or the camera gone."""
        return self._over

    def close(self) -> None:
        """Let go of the camera; a second call does nothing."""
        if not self._over:
            self._over = True
            self._release()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton, or None when none came within ``timeout`` seconds or the source is over.

        Raises:
            TaskFailedError: when the driver fails, or no frame came for 3 s, as when the camera is unplugged.
        """
        until = clock.monotonic() + timeout
        while not self._over and not self._waiting:
            began = clock.monotonic()
            if not self._take(min(max(until - began, 0.0), _TURN)):
                self._silent += clock.monotonic() - began
                if self._silent > _SILENT:
                    raise self._failed(f"no frames for {_SILENT:g} s; is the camera still plugged in?")
            if clock.monotonic() >= until:
                break
        return self._waiting.popleft() if self._waiting and not self._over else None

    def _take(self, timeout: float) -> bool:
        """Take in the next frame; return whether there was one."""
        bodies = self._frame(timeout)
        if bodies is None:
            return False
        self._silent = 0.0
        self._waiting.extend(bodies)
        return True

    def _wait_for_first(self, seconds: float, missing: str) -> None:
        """Wait for the first frame of all.

        Raises:
            InputError: when none came within ``seconds``, or the driver fails; the camera is let go.
        """
        until = clock.monotonic() + seconds
        try:
            while not self._take(_TURN):
                if clock.monotonic() >= until:
                    raise InputError(f"{self.name}: no frame within {seconds:g} s; {missing}; {INSTEAD}")
        except TaskFailedError as error:
            raise InputError(f"{error}; {missing}; {INSTEAD}") from error
        except BaseException:
            self.close()
            raise

    def _number(self, driver_id: int) -> int:
        """Return which person a driver's number stands for: 0 for the first who was seen, and so on."""
        return self._numbers.setdefault(int(driver_id), len(self._numbers))

    def _failed(self, why: str) -> TaskFailedError:
        """Close, and return the error that says why."""
        self.close()
        return TaskFailedError(f"{self.name}: {why}")
