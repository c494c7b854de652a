"""Playback: a hand's motion through a smooth curve, played out a moment later (METHODS A.6)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.retarget.baselines.nurbs import NURBS
from imitarm.retarget.baselines.nurbs_fit import Smoothing, fit_nurbs
from imitarm.retarget.baselines.rotation_curve import RotationCurve, fit_rotations

Array = NDArray[np.float64]

_DEGREE = 3
_MU = 1.0  # strength of the live curve; cross validation takes longer than a frame and finds about this
_SIGMA = 0.012  # [m] of a Kinect; what is 2.5 of it off the curve counts for less
_LATE = 0.02  # share by which the clock follows frames that come later than usual
_RESTART = 0.25  # [s] a source whose clock is off by more has begun anew


@dataclass(frozen=True, eq=False)
class HandSample:
    """Where a hand was in one frame.

    Attributes:
        time: on the source's clock [s].
        wrist: position in the base frame, shape (3,) [m].
        hand: rotation in the base frame, wxyz, shape (4,).
        confidence: of the position, and of the rotation, 0 to 1.
    """

    time: float
    wrist: Array
    hand: Array
    confidence: tuple[float, float]


@dataclass(frozen=True, eq=False)
class HandCurve:
    """A smooth motion of a hand.

    Attributes:
        wrist: position [m] over time [s].
        hand: rotation over time.
    """

    wrist: NURBS
    hand: RotationCurve

    @classmethod
    def through(cls, samples: Sequence[HandSample], smoothing: Smoothing = "gcv", *, robust: bool = True) -> HandCurve:
        """Fit both curves to samples, at least four.

        Raises:
            InputError: when there are fewer, or times do not increase.
        """
        if len(samples) <= _DEGREE:
            raise InputError(f"HandCurve: needs at least {_DEGREE + 1} frames that show the arm, got {len(samples)}")
        times = np.array([sample.time for sample in samples])
        confidence = np.array([sample.confidence for sample in samples])
        wrist = fit_nurbs(
            times,
            [sample.wrist for sample in samples],
            confidence[:, 0],
            degree=_DEGREE,
            smoothing=smoothing,
            sigma=_SIGMA,
            robust=robust,
        )
        hand = fit_rotations(
            times,
            [sample.hand for sample in samples],
            confidence[:, 1],
            degree=_DEGREE,
            smoothing=smoothing,
            robust=False,
        )
        return cls(wrist, hand)

    def at(self, time: float) -> tuple[Array, Array]:
        """Return wrist (3,) and hand (4,); beyond the ends those of the end."""
        return self.wrist.evaluate(time), self.hand.evaluate(time)


class Playback:
    """Smooths a hand's motion while it comes in: a curve through the last moments, read ``lag`` seconds late.

    A curve's end swings with every new frame; a little before it frames on both sides hold it, and that is what the lag
    buys. Frames come in bursts and gaps, so time is counted by the steps of the robot and only led by the frames'.

    Args:
        window: how much is fitted [s].
        lag: how late the curve is read [s].
        smooth: off, the newest frame is given as it is.
        whole: a curve to read instead, of a motion that is over already; its lag is none.
    """

    def __init__(
        self, window: float = 0.6, lag: float = 0.07, *, smooth: bool = True, whole: HandCurve | None = None
    ) -> None:
        if not 0.2 <= window <= 5.0 or not 0.0 <= lag <= 0.5 * window:
            raise InputError("Playback: window must be 0.2 to 5 s and lag at most half of it")
        self._window, self._smooth, self._whole = window, smooth, whole
        self._lag = lag if whole is None else 0.0
        self._samples: deque[HandSample] = deque()
        self._curve: HandCurve | None = None
        self._clock, self._ahead = 0.0, -math.inf

    def add(self, sample: HandSample) -> None:
        """Take in a frame later than the one before."""
        ahead = sample.time - self._clock
        off = ahead - self._ahead
        self._ahead = ahead if off > 0.0 or off < -_RESTART else self._ahead + _LATE * off
        seen = self._samples
        while seen and sample.time - seen[0].time > self._window:
            seen.popleft()
        seen.append(sample)
        if self._smooth and self._whole is None:
            self._curve = HandCurve.through(seen, _MU) if len(seen) > _DEGREE else None

    def step(self, dt: float) -> None:
        """Let time go on [s]."""
        self._clock += dt

    def now(self) -> tuple[Array, Array] | None:
        """Return wrist (3,) [m] and hand (4,) as they are to be followed now; None before the first frame."""
        if not self._samples:
            return None
        curve = self._curve if self._whole is None else self._whole
        if curve is None:
            return self._samples[-1].wrist, self._samples[-1].hand
        return curve.at(self._clock + self._ahead - self._lag)
