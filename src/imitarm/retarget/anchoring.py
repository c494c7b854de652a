r"""Anchoring: where a joint is taken to be when the camera begins to guess it, and when it sees it again."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]


class Anchoring:
    r"""Takes a jump that comes with a change of tracking for an error of the camera, not for a motion.

    A joint that is hidden is inferred, and its error is then another one and several times larger. The step between
    the last tracked and the first inferred position is mostly that, and so is the step back. So at each change of a
    joint's confidence its offset o is set such that the motion goes on as it was,

    .. math:: o = x_p + v\,\Delta t - \tilde x, \qquad x = \tilde x + o

    with :math:`x_p` the position before and v its velocity. While the joint is guessed the offset stands: its
    motion is followed, its place is not believed. While it is seen the offset fades, with time and with the way that
    the joint goes,

    .. math:: o \leftarrow o\,\exp(-\Delta t / T - |\Delta x| / L).

    A person who looks at the robot never notices that; a robot that jumped and jumped back would be noticed.

    Args:
        time: T [s].
        way: L [m].

    Raises:
        InputError: when one of them is not positive.
    """

    def __init__(self, time: float = 10.0, way: float = 0.15) -> None:
        if not (time > 0.0 and way > 0.0):
            raise InputError(f"Anchoring: time [s] and way [m] must be positive, got {time!r} and {way!r}")
        self._time, self._way = time, way
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._confidence: list[float] = []
        self._measured: Array = np.zeros((0, 3))
        self._offsets: Array | None = None

    def anchor(self, points: Array, confidence: list[float], velocity: Array, period: float) -> Array:
        """Return where the joints are taken to be, shape (k, 3) [m].

        Args:
            points: as measured, shape (k, 3) [m].
            confidence: of each, k numbers; 1 when it is seen.
            velocity: of each as it was estimated before, shape (k, 3) [m/s].
            period: since the call before [s].
        """
        before, self._confidence = self._confidence, confidence
        measured, self._measured = self._measured, points
        if not before:
            return points
        offsets = self._offsets
        if offsets is None and confidence == before:  # nothing was ever hidden
            return points
        was = np.zeros_like(points) if offsets is None else offsets
        steps = points - measured
        ways = np.sqrt((steps * steps).sum(axis=1)).tolist()
        offsets = np.empty_like(points)
        for i, (now, then, way) in enumerate(zip(confidence, before, ways, strict=True)):
            if now != then:
                offsets[i] = was[i] - steps[i] + period * velocity[i]
            elif now >= 1.0:
                offsets[i] = was[i] * math.exp(-period / self._time - way / self._way)
            else:
                offsets[i] = was[i]
        self._offsets = offsets
        return points + offsets
