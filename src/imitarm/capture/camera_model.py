"""SkeletonCamera: what a skeleton camera makes of a person: noise, bias, jitter, dropouts, occlusion; seeded."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, HandState, Skeleton, Tracking
from imitarm.errors import InputError

Array = NDArray[np.float64]

WHITE = 0.12  # share of sigma that is new in every frame: in real Kinect recordings the rest changes slowly
MEMORY = 0.35  # [s] time constant of the rest, which is smooth: two low-pass filters in a row
DEPTH = 1.4  # the error along the line of sight over that across it
_HAND_PARTS = np.array([JOINT[f"{part}_{side}"] for side in ("left", "right") for part in ("hand_tip", "thumb")])
_RESTLESS = 2.0  # the tips of hands are seen worse
_ARM = {
    side: np.array([JOINT[f"{part}_{side}"] for part in ("elbow", "wrist", "hand", "hand_tip", "thumb")])
    for side in ("left", "right")
}
_HIDDEN = 3.0  # an inferred joint's error over that of a tracked one
_SKIPPED, _SLIPPED = 0.03, 0.01  # share of frame intervals that are twice as long; of frames that are lost
_MISREAD = 0.02  # share of frames in which the hand state begins to be misread, for one or two frames
_DROP_LENGTH = (2, 20)  # [frames] of a dropout
_TORSO = 0.16  # [m] half the width of what hides a hand that is behind it
_BEFORE = math.radians(3.0)  # a hand in line with the elbow hides it


class SkeletonCamera:
    r"""A skeleton camera with the faults of a real one (METHODS B, "noise model").

    A joint is seen at :math:`x + b + c(t) + n`: ``c`` a smooth Gauss-Markov process of second order, ``n`` white,
    together with standard deviation ``sigma`` on each axis across the line of sight and 1.4 of it along; ``b`` a bias
    of the elbow's depth. In real recordings of a Kinect v2 the white part is 0.2 to 3 mm, a small share of the 1 to
    2 cm by which limbs change their lengths: ``docs/capture.md``.

    * Frames come at ``rate``, with 1.5 ms of jitter; 3 % of the intervals are twice as long, 1 % of the frames
      show nobody.
    * Dropouts: at ``dropout`` a second an arm is inferred (error three times as large) or lost for 2 to 20 frames.
    * Occlusion: a forearm behind the torso, and an elbow behind its own hand, are inferred.
    * The hand's state is misread for one or two frames now and then.

    Args:
        seed: of everything random.
        sigma: [m].
        rate: frames a second [Hz].
        dropout: dropouts of the arm a second [Hz].
        elbow_bias: largest bias of the elbow's depth [m]; the person's own is uniform within it.
        faultless: no dropouts, occlusions, jitter, misreadings; with ``sigma=0`` and ``elbow_bias=0`` the truth.
    """

    def __init__(
        self,
        seed: int,
        *,
        sigma: float = 0.012,
        rate: float = 30.0,
        dropout: float = 0.1,
        elbow_bias: float = 0.02,
        faultless: bool = False,
    ) -> None:
        if not (0.0 <= sigma <= 0.1 and 1.0 <= rate <= 200.0 and 0.0 <= dropout <= 5.0 and 0.0 <= elbow_bias <= 0.1):
            raise InputError("SkeletonCamera: needs sigma and elbow_bias to 0.1 m, rate 1 to 200 Hz, dropout to 5 Hz")
        self._rng = np.random.default_rng([30311, seed])
        self.sigma, self.rate, self.dropout, self.faultless = sigma, rate, dropout, faultless
        self._bias = self._rng.uniform(-elbow_bias, elbow_bias)
        self._scale = np.tile([1.0, 1.0, DEPTH], (len(JOINTS), 1))
        self._scale[_HAND_PARTS] *= _RESTLESS
        self._drive = self._rng.normal(size=(len(JOINTS), 3))
        self._slow = math.sqrt(0.5) * (self._drive + self._rng.normal(size=self._drive.shape))
        self._time = -math.inf
        self._dropped = {"left": (0, Tracking.INFERRED), "right": (0, Tracking.INFERRED)}
        self._misread = [(0, HandState.UNKNOWN), (0, HandState.UNKNOWN)]

    @classmethod
    def ideal(cls, rate: float = 30.0) -> SkeletonCamera:
        """Return a camera that sees the truth."""
        return cls(0, sigma=0.0, rate=rate, dropout=0.0, elbow_bias=0.0, faultless=True)

    def next_time(self, time: float) -> float:
        """Return when the frame after one at ``time`` is exposed [s]."""
        period = 1.0 / self.rate
        if self.faultless:
            return time + period
        if self._rng.random() < _SKIPPED:
            period *= 2.0
        return time + period + float(np.clip(self._rng.normal(0.0, 0.0015), -0.004, 0.004))

    def see(self, truth: Skeleton) -> Skeleton | None:
        """Return the skeleton the camera reports, or None when it reports none.

        Args:
            truth: of one instant; later than that of the call before.
        """
        period = max(truth.time - self._time, 0.0) if math.isfinite(self._time) else 0.0
        self._time = truth.time
        keep = math.exp(-period / MEMORY)
        self._drive = keep * self._drive + math.sqrt(1.0 - keep * keep) * self._rng.normal(size=self._slow.shape)
        self._slow = keep * self._slow + (1.0 - keep) * math.sqrt(2.0) * self._drive
        white = self._rng.normal(size=self._slow.shape)
        error = math.sqrt(1.0 - WHITE**2) * self._slow + WHITE * white
        tracking = np.array(truth.tracking)
        if not self.faultless:
            if self._rng.random() < _SLIPPED:
                return None
            self._drop(tracking, period)
            self._hide(truth.positions, tracking)
        scale = self.sigma * self._scale * np.where(tracking == Tracking.INFERRED, _HIDDEN, 1.0)[:, None]
        positions = truth.positions + error * scale
        for side in ("left", "right"):
            positions[JOINT[f"elbow_{side}"], 2] += self._bias
        hands = truth.hand_states if self.faultless else (self._read(truth, 0), self._read(truth, 1))
        return Skeleton(truth.time, positions, tracking, hands, truth.person)

    def _drop(self, tracking: NDArray[np.int8], period: float) -> None:
        for side, index in _ARM.items():
            left, kind = self._dropped[side]
            if left == 0 and self._rng.random() < self.dropout * period:
                left = int(self._rng.integers(_DROP_LENGTH[0], _DROP_LENGTH[1] + 1))
                kind = Tracking.LOST if self._rng.random() < 0.3 else Tracking.INFERRED
            if left > 0:
                tracking[index] = kind
            self._dropped[side] = (max(left - 1, 0), kind)

    @staticmethod
    def _hide(points: Array, tracking: NDArray[np.int8]) -> None:
        """Mark as inferred what something nearer to the sensor hides."""
        top, low = points[JOINT["spine_shoulder"]], points[JOINT["spine_base"]]
        for index in _ARM.values():
            arm = points[index]
            behind = (arm[:, 2] > low[2] + 0.05) & (np.abs(arm[:, 0] - low[0]) < _TORSO)
            behind &= (arm[:, 1] > low[1]) & (arm[:, 1] < top[1])
            elbow, wrist = arm[0], arm[1]
            sight = float(elbow @ wrist / max(np.linalg.norm(elbow) * np.linalg.norm(wrist), 1e-9))
            behind[0] |= math.acos(min(max(sight, -1.0), 1.0)) < _BEFORE and wrist[2] < elbow[2]
            tracking[index[behind]] = np.minimum(tracking[index[behind]], Tracking.INFERRED)

    def _read(self, truth: Skeleton, hand: int) -> HandState:
        left, shown = self._misread[hand]
        if left == 0 and self._rng.random() < _MISREAD:
            left = int(self._rng.integers(1, 3))
            shown = HandState(int(self._rng.choice([HandState.UNKNOWN, HandState.OPEN, HandState.CLOSED])))
        self._misread[hand] = (max(left - 1, 0), shown)
        return shown if left > 0 else truth.hand_states[hand]
