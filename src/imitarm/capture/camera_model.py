"""SkeletonCamera: a simulated skeleton camera with the errors of a real camera. One seed determines all errors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, HandState, Skeleton, Tracking
from imitarm.validation import finite_number, whole_number

Array = NDArray[np.float64]

# Measured on real recordings of a Kinect v2; tests/test_capture_sensor_quality_noise.py compares.
MEMORY_LENGTH = 0.08  # [m] the error of a moving joint is correlated over this path length
MEMORY = 5.0  # [s] the error of a joint at rest is correlated over this time
DEPTH = 1.4  # error along the line of sight over that across it
TIPS = 1.5  # error of finger tips and thumbs over that of other joints
_WHITE = {"elbow": (0.02, 0.40), "wrist": (0.02, 0.40), "hand": (0.075, 0.12), "hand_tip": (0.14, 0.08)}
_WHITE |= {"thumb": (0.16, 0.30)}  # white noise over sigma (and TIPS): at rest, and its increase per m/s
_WHITE_BODY = (0.01, 0.20)
# correlation of the second joint's error with the first one's
_MIDDLE_CHAIN = (
    ("spine_base", "spine_mid", 0.9),
    ("spine_mid", "spine_shoulder", 0.9),
    ("spine_shoulder", "neck", 0.9),
    ("neck", "head", 0.8),
)
_SIDE_CHAIN = (
    ("spine_shoulder", "shoulder", 0.7),
    ("shoulder", "elbow", 0.4),
    ("elbow", "wrist", 0.95),
    ("wrist", "hand", 0.6),
    ("hand", "hand_tip", 0.8),
    ("wrist", "thumb", 0.5),
    ("spine_base", "hip", 0.9),
    ("hip", "knee", 0.7),
    ("knee", "ankle", 0.7),
    ("ankle", "foot", 0.7),
)

_ARM = {
    side: np.array([JOINT[f"{part}_{side}"] for part in ("elbow", "wrist", "hand", "hand_tip", "thumb")])
    for side in SIDES
}
_HIDDEN = 3.0  # error of an inferred joint over that of a tracked one
_SKIPPED, _SLIPPED = 0.03, 0.01  # fraction of frame intervals that are twice as long; of frames that are lost
_MISREAD = 0.02  # fraction of frames at which a wrong hand state begins; it lasts one or two frames
_DROP_LENGTH = (2, 20)  # [frames] of a dropout
_NOBODY, _LOST = 0.1, 0.3  # fraction of dropouts in which nobody is seen; of the others, in which the arm is lost
_TORSO = 0.16  # [m] half the width of the torso, which hides a hand behind it
_IN_LINE = math.radians(3.0)  # a hand that is this close to the line of sight to its elbow hides the elbow


def _mixing() -> Array:
    """Return the matrix M, shape (25, 25), which correlates the errors of the joints; its rows have unit length."""
    rows = np.eye(len(JOINTS))
    sides = [
        (near if near in JOINT else f"{near}_{side}", f"{far}_{side}", correlation)
        for side in SIDES
        for near, far, correlation in _SIDE_CHAIN
    ]
    for near, far, correlation in (*_MIDDLE_CHAIN, *sides):
        rows[JOINT[far]] *= math.sqrt(1.0 - correlation**2)
        rows[JOINT[far]] += correlation * rows[JOINT[near]]
    return rows


def _white_ratios() -> Array:
    """Return each joint's white noise at rest, and its increase per m/s of speed, relative to sigma, shape (2, 25)."""
    return np.array([_WHITE.get(name.removesuffix("_left").removesuffix("_right"), _WHITE_BODY) for name in JOINTS]).T


_MIXING, _WHITE_RATIOS = _mixing(), _white_ratios()
_SHAPE = (len(JOINTS), 3)


class SkeletonCamera:
    r"""A simulated skeleton camera with the errors of a real camera.

    docs/capture.md describes how we measured the errors of real cameras. In each frame, the camera marks every joint as
    *tracked* (seen), as *inferred* (estimated from other joints), or as *lost*.

    The measured position of a joint at position x is :math:`x + b + M c + n`, with three errors: a bias b, a slow error
    c, and a white noise n. The standard deviation of the slow error is ``sigma`` across the line of sight, and ``1.4
    sigma`` along the line of sight. For finger tips and thumbs, it is 1.5 times as large. The slow error is a random
    process with a Matern covariance of order 3/2. Its variable u increases with the time t and with the length of the
    joint's path x:

    .. math:: du = dt / 5\,\mathrm{s} + |dx| / 8\,\mathrm{cm}, \qquad
              \mathrm{E}\,[c(0)\,c(u)] = \sigma^2 (1 + u)\,e^{-u},

    The slow error depends on the path, because we observed this in recordings of a Kinect v2. In these recordings, the
    measured length of a bone hardly changes while the arm is at rest. It changes by 1 to 2 cm when a joint moves by 10
    to 20 cm. The matrix ``M`` correlates the errors of neighbouring joints. As a result, the measured length of the
    forearm varies less than that of the upper arm. The white noise ``n`` grows with the speed of the joint. With a
    ``sigma`` of 12 mm, the standard deviation of ``n`` for elbow and wrist is 0.2 mm at rest, and 5 mm more for each
    m/s of speed. The bias ``b`` is a constant error of the elbow's depth.

    * Timing: on average, ``rate`` frames arrive per second, and the time between frames varies by ``jitter``. 3 % of
      the intervals between frames are twice the usual length, and 1 % of the frames show nobody.
    * Dropouts: for each arm, a dropout begins ``dropout`` times per second on average and lasts 2 to 20 frames. During
      a dropout, the camera infers the arm with three times the usual error, loses the arm, or loses the whole person.
    * Occlusion: the camera infers the joints of an arm that are behind the torso. It infers an elbow that is behind the
      hand of the same arm.
    * Hand states: occasionally, the camera reports a wrong state of a hand (open or closed) for one or two frames.

    Args:
        seed: number that determines all random values of the camera.
        sigma: standard deviation of the slow error across the line of sight [m].
        rate: frames per second [Hz].
        jitter: standard deviation of the time between frames [s].
        dropout: mean number of dropouts per second for each arm [Hz].
        occlusion: True: hidden joints are inferred. False: they are tracked as if they were visible.
        elbow_bias: largest magnitude of the bias of the elbow's depth [m]. The bias is random, uniform between minus
            and plus this value.
        faultless: whether to omit dropouts, occlusions, jitter and wrong hand states. With ``sigma=0`` and
            ``elbow_bias=0``, a faultless camera reports the true positions.

    Raises:
        InputError: when a value is out of range.
    """

    def __init__(
        self,
        seed: int,
        *,
        sigma: float = 0.012,
        rate: float = 30.0,
        jitter: float = 0.0015,
        dropout: float = 0.1,
        occlusion: bool = True,
        elbow_bias: float = 0.02,
        faultless: bool = False,
    ) -> None:
        whole_number(seed, "SkeletonCamera: seed", at_least=0)
        finite_number(sigma, "SkeletonCamera: sigma", "m", at_least=0.0, at_most=0.1)
        finite_number(rate, "SkeletonCamera: rate", "Hz", at_least=1.0, at_most=200.0)
        finite_number(dropout, "SkeletonCamera: dropout", "Hz", at_least=0.0, at_most=5.0)
        finite_number(elbow_bias, "SkeletonCamera: elbow_bias", "m", at_least=0.0, at_most=0.1)
        longest = 0.2 / rate  # a fifth of the period
        finite_number(jitter, f"SkeletonCamera: jitter at {rate:g} Hz", "s", at_least=0.0, at_most=longest)
        self._rng = np.random.default_rng([30311, seed])
        self.sigma, self.rate, self.jitter, self.dropout = sigma, rate, jitter, dropout
        self.occlusion, self.faultless = occlusion, faultless
        self._bias = self._rng.uniform(-elbow_bias, elbow_bias)
        self._scale = np.tile([1.0, 1.0, DEPTH], (len(JOINTS), 1))
        self._scale[[JOINT[f"{part}_{side}"] for part in ("hand_tip", "thumb") for side in SIDES]] *= TIPS
        self._slow, self._slope = self._rng.normal(size=(2, *_SHAPE))
        self._time, self._last = -math.inf, np.zeros(_SHAPE)
        self._dropped = dict.fromkeys(SIDES, (0, Tracking.INFERRED))
        self._nobody = 0
        self._misread = [(0, HandState.UNKNOWN), (0, HandState.UNKNOWN)]

    @classmethod
    def from_seed(cls, seed: int, *, rate: float = 30.0) -> SkeletonCamera:
        """Return a camera with a random ``sigma`` between 1 and 2 cm; all other errors have their default sizes."""
        return cls(seed, sigma=float(np.random.default_rng([30314, seed]).uniform(0.01, 0.02)), rate=rate)

    @classmethod
    def ideal(cls, rate: float = 30.0) -> SkeletonCamera:
        """Return a camera that reports the true positions without any error."""
        return cls(0, sigma=0.0, rate=rate, jitter=0.0, dropout=0.0, elbow_bias=0.0, faultless=True)

    def next_time(self, time: float) -> float:
        """Return the time of the next frame after ``time`` [s]."""
        period = 1.0 / self.rate
        if self.faultless:
            return time + period
        if self._rng.random() < _SKIPPED:
            period *= 2.0
        return time + period + self.jitter * float(np.clip(self._rng.normal(), -2.7, 2.7))

    def see(self, truth: Skeleton) -> Skeleton | None:
        """Return the skeleton that the camera reports, or None if the frame shows nobody.

        Args:
            truth: the true skeleton. Its time must be later than that of the previous call.
        """
        period = max(truth.time - self._time, 0.0) if math.isfinite(self._time) else 0.0
        error = self._error(truth.positions, period)
        self._time, self._last = truth.time, truth.positions
        tracking = np.array(truth.tracking)
        if not self.faultless:
            if self._nobody > 0 or self._rng.random() < _SLIPPED:
                self._nobody = max(self._nobody - 1, 0)
                return None
            self._drop(tracking, period)
            if self._nobody > 0:
                self._nobody -= 1
                return None
            if self.occlusion:
                self._hide(truth.positions, tracking)
        scale = self.sigma * self._scale * np.where(tracking == Tracking.INFERRED, _HIDDEN, 1.0)[:, None]
        positions = truth.positions + error * scale
        for side in SIDES:
            positions[JOINT[f"elbow_{side}"], 2] += self._bias
        hands = truth.hand_states if self.faultless else (self._read(truth, 0), self._read(truth, 1))
        return Skeleton(truth.time, positions, tracking, hands, truth.person)

    def _error(self, points: Array, period: float) -> Array:
        """Return the errors M c + n of this frame, relative to sigma and to the axis factors, shape (25, 3)."""
        step = points - self._last if period > 0.0 else np.zeros(_SHAPE)
        path = np.nan_to_num(np.sqrt(np.sum(step * step, axis=1)))[:, None]
        u = period / MEMORY + path / MEMORY_LENGTH
        # exact step of the process (slow, slope) with unit covariance: A = e^-u [[1+u, u], [-u, 1-u]], Q = 1 - A A^T
        keep = np.exp(-u)
        s, v = self._slow, self._slope
        q_ss, q_sv = 1.0 - keep**2 * ((1.0 + u) ** 2 + u * u), 2.0 * (keep * u) ** 2
        q_vv = np.maximum(1.0 - keep**2 * ((1.0 - u) ** 2 + u * u), 1e-300)
        new, other, white = self._rng.normal(size=(3, *_SHAPE))
        self._slow = keep * ((1.0 + u) * s + u * v) + (
            q_sv / np.sqrt(q_vv) * new + np.sqrt(np.maximum(q_ss - q_sv**2 / q_vv, 0.0)) * other
        )
        self._slope = keep * ((1.0 - u) * v - u * s) + np.sqrt(q_vv) * new
        at_rest, with_speed = _WHITE_RATIOS
        speed = path[:, 0] / period if period > 0.0 else 0.0
        return np.asarray(_MIXING @ self._slow + (at_rest + with_speed * speed)[:, None] * white)

    def _drop(self, tracking: NDArray[np.int8], period: float) -> None:
        for side, index in _ARM.items():
            left, kind = self._dropped[side]
            if left == 0 and self._rng.random() < self.dropout * period:
                left = int(self._rng.integers(_DROP_LENGTH[0], _DROP_LENGTH[1] + 1))
                kind = Tracking.LOST if self._rng.random() < _LOST else Tracking.INFERRED
                if self._rng.random() < _NOBODY:
                    left, self._nobody = 0, left
            if left > 0:
                tracking[index] = kind
            self._dropped[side] = (max(left - 1, 0), kind)

    @staticmethod
    def _hide(points: Array, tracking: NDArray[np.int8]) -> None:
        """Mark a joint as inferred if a part of the body hides it from the sensor."""
        top, low = points[JOINT["spine_shoulder"]], points[JOINT["spine_base"]]
        for index in _ARM.values():
            arm = points[index]
            behind = (arm[:, 2] > low[2] + 0.05) & (np.abs(arm[:, 0] - low[0]) < _TORSO)
            behind &= (arm[:, 1] > low[1]) & (arm[:, 1] < top[1])
            elbow, wrist = arm[0], arm[1]
            sight = float(elbow @ wrist / max(np.linalg.norm(elbow) * np.linalg.norm(wrist), 1e-9))
            behind[0] |= math.acos(min(max(sight, -1.0), 1.0)) < _IN_LINE and wrist[2] < elbow[2]
            tracking[index[behind]] = np.minimum(tracking[index[behind]], Tracking.INFERRED)

    def _read(self, truth: Skeleton, hand: int) -> HandState:
        left, shown = self._misread[hand]
        if left == 0 and self._rng.random() < _MISREAD:
            left = int(self._rng.integers(1, 3))
            shown = HandState(int(self._rng.choice([HandState.UNKNOWN, HandState.OPEN, HandState.CLOSED])))
        self._misread[hand] = (max(left - 1, 0), shown)
        return shown if left > 0 else truth.hand_states[hand]
