r"""Anchoring: where a joint is taken to be when the camera begins to guess it, and when it sees it again."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]


FARTHEST = 0.2  # [m] no camera's guess is farther off: an offset beyond was a motion
_NONE = [0.0, 0.0, 0.0]  # the offset of a joint that was never hidden
_AGAIN = 0.12  # [s] a joint that is seen, or guessed, again so soon has the offset that it had then


class Anchoring:
    r"""Takes a jump that comes with a change of tracking for an error of the camera, not for a motion.

    A joint that is hidden is inferred, and its error is then another one and several times larger. The step between
    the last tracked and the first inferred position is mostly that, and so is the step back. So when a joint is
    guessed, its offset o is set such that the motion goes on as it was,

    .. math:: o = x_p + v\,\Delta t - \tilde x, \qquad x = \tilde x + o

    with :math:`x_p` the position before and v its velocity. While the joint is guessed the offset stands: its
    motion is followed, its place is not believed. When it is seen again it is anchored once more, and while it is
    seen the offset fades, with time and with the way that the joint goes,

    .. math:: o \leftarrow o\,\exp(-\Delta t / T - |\Delta x| / L).

    A person who looks at the robot never notices that; a robot that jumped and jumped back would be noticed.

    A joint that flickers between seen and guessed is anchored once: for an eighth of a second both keep their own
    offset. Else the place that is measured would never count, and the estimate would go on at its own velocity. An
    offset is never longer than 0.2 m.

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
        self._clock = 0.0
        self._confidence: list[float] = []
        self._measured: list[list[float]] = []
        self._offsets: list[list[float]] | None = None
        # of joint and confidence: when, and its offset
        self._kept: dict[tuple[int, float], tuple[float, list[float]]] = {}

    def shift(self, joint: int) -> float:
        """Return how far a joint is taken to be from where it is measured [m]."""
        return 0.0 if self._offsets is None else math.hypot(*self._offsets[joint])

    def anchor(self, points: Array, confidence: list[float], velocity: Array, period: float) -> Array:
        """Return where the joints are taken to be, shape (k, 3) [m].

        Args:
            points: as measured, shape (k, 3) [m].
            confidence: of each, k numbers; 1 when it is seen.
            velocity: of each as it was estimated before, shape (k, 3) [m/s].
            period: since the call before [s].
        """
        before, self._confidence = self._confidence, confidence
        last, self._measured = self._measured, points.tolist()
        if not before:
            return points
        self._clock += period
        if self._offsets is None and confidence == before:  # nothing was ever hidden
            return points
        was = [_NONE] * len(before) if self._offsets is None else self._offsets
        offsets = list(was)
        for i, (now, then) in enumerate(zip(confidence, before, strict=True)):
            x, o = self._measured[i], was[i]
            if now != then:
                self._kept[i, then] = self._clock, o
                by_axis = zip(o, last[i], x, velocity[i].tolist(), strict=True)
                going_on = [a + b + period * v - c for a, b, c, v in by_axis]
                offsets[i] = self._anchored(i, now, going_on)
            elif now >= 1.0 and o is not _NONE:
                left = math.exp(-period / self._time - math.dist(x, last[i]) / self._way)
                offsets[i] = [left * a for a in o]
        self._offsets = offsets
        return points + np.array(offsets)

    def _anchored(self, joint: int, confidence: float, going_on: list[float]) -> list[float]:
        """Return the offset of a joint whose tracking has changed: the one it had a moment ago, or a new one."""
        when, offset = self._kept.get((joint, confidence), (-math.inf, going_on))
        if self._clock - when > _AGAIN:
            offset = going_on
        length = math.hypot(*offset)
        return offset if length <= FARTHEST else [a * (FARTHEST / length) for a in offset]
