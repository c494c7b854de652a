"""Person: a synthetic person with limb lengths, a position and an elbow posture, all determined by a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import ARM_JOINTS, JOINT, JOINTS, SIDES, HandState, Skeleton
from imitarm.errors import InputError, UnknownNameError
from imitarm.validation import finite_number, finite_vector, real_array, whole_number

Array = NDArray[np.float64]

STRETCHED = 0.98  # reach over the arm's length: nobody stretches the arm completely
SENSOR_HEIGHT = 1.1  # [m] above the floor
_TREMOR_BAND = (4.0, 9.0)  # [Hz] physiological tremor
_WAVES = 4

# Lengths over the stature (Drillis and Contini 1966)
_UPPER_ARM, _FOREARM, _HAND = 0.186, 0.146, 0.108
_SHOULDER_HEIGHT, _HALF_SHOULDERS = 0.818, 0.1295
_HEIGHTS = {
    "head": 0.93,
    "neck": 0.85,
    "spine_shoulder": 0.818,
    "spine_mid": 0.68,
    "spine_base": 0.54,
    "hip": 0.53,
    "knee": 0.285,
    "ankle": 0.039,
    "foot": 0.01,
}
_HALF_HIPS, _FOOT = 0.0955, 0.10
_FORWARD, _UP, _DOWN = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, 0.0])
_TO_HAND, _TO_TIP, _TO_THUMB = (
    0.45,
    0.85,
    (0.35, 0.35),
)  # distances from the wrist over the hand's length, as a Kinect reports them


@dataclass(frozen=True, eq=False)
class Person:
    r"""A synthetic person who stands upright and faces a sensor, in the sensor's frame (x left, y up, z away).

    An arm consists of two straight bones with lengths :math:`L_U` and :math:`L_F`. For a given shoulder S and wrist W,
    the elbow E lies on a circle about the line from S to W. Let :math:`\hat w` be the unit vector along this line, and
    :math:`\hat d` and :math:`\hat o` two unit vectors perpendicular to it. When the arm points forward, :math:`\hat d`
    points down and :math:`\hat o` points outwards; both vectors rotate with the arm. With the swivel angle
    :math:`\psi`, the elbow is at

    .. math:: E = S + a\,\hat w + h\,(\cos\psi\,\hat d + \sin\psi\,\hat o), \qquad
              a = \frac{L_U^2 + r^2 - L_F^2}{2r},\quad h = \sqrt{L_U^2 - a^2},\quad r = |W - S| .

    Attributes:
        seed: seed from which :meth:`from_seed` computed the other attributes.
        stature: height [m].
        upper_arm: distance from shoulder to elbow [m].
        forearm: distance from elbow to wrist [m].
        hand: distance from wrist to finger tip [m].
        position: position of the point on the floor between the feet, x and z in the sensor's frame, shape (2,) [m].
        swivel: swivel angle psi while the wrist is more than 0.3 m below the shoulder [rad].
        lift: increase of psi per metre that the wrist rises above this height [rad/m].
        tremor: n sine waves of the hand's tremor along each of three axes, shape (3, n, 3). The first index selects
            amplitude [m], frequency [rad/s] or phase [rad].
        sway: sine waves of the body's sway along x and z, shape (3, 2). The first index selects amplitude [m],
            frequency [rad/s] or phase [rad].
    """

    seed: int
    stature: float
    upper_arm: float
    forearm: float
    hand: float
    position: Array
    swivel: float
    lift: float
    tremor: Array
    sway: Array

    @classmethod
    def from_seed(cls, seed: int) -> Person:
        """Return a random person determined by ``seed``.

        The limb lengths deviate by up to 15 % from the average lengths for the person's stature.
        """
        rng = np.random.default_rng([30310, whole_number(seed, "Person.from_seed: seed", at_least=0)])
        stature = float(np.clip(rng.normal(1.72, 0.09), 1.50, 1.95))
        proportion = np.clip(rng.normal(1.0, 0.05, 3), 0.85, 1.15)
        tremor = np.stack(
            [
                rng.uniform(0.05e-3, 0.3e-3, (_WAVES, 3)),
                2.0 * np.pi * rng.uniform(*_TREMOR_BAND, (_WAVES, 3)),
                rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3)),
            ]
        )
        sway = np.stack(
            [rng.uniform(0.001, 0.004, 2), 2.0 * np.pi * rng.uniform(0.15, 0.4, 2), rng.uniform(0.0, 2.0 * np.pi, 2)]
        )
        return cls(
            seed,
            stature,
            float(stature * _UPPER_ARM * proportion[0]),
            float(stature * _FOREARM * proportion[1]),
            float(stature * _HAND * proportion[2]),
            np.array([rng.uniform(-0.2, 0.2), rng.uniform(2.0, 2.7)]),
            float(rng.normal(0.35, 0.12)),
            float(rng.uniform(0.3, 0.9)),
            tremor,
            sway,
        )

    @property
    def reach(self) -> float:
        """Largest distance from shoulder to wrist [m]."""
        return STRETCHED * (self.upper_arm + self.forearm)

    def shoulder(self, side: str = "right", time: float = 0.0) -> Array:
        """Return the position of a shoulder, including the body's sway, shape (3,) [m].

        Raises:
            UnknownNameError: when ``side`` is neither left nor right.
        """
        return self._middle(time) + _to_shoulder(self.stature, side)

    def skeleton(
        self,
        time: float,
        wrist: ArrayLike,
        *,
        swivel: float | None = None,
        hand: ArrayLike | None = None,
        closed: bool = False,
        side: str = "right",
    ) -> Skeleton:
        """Return a skeleton with true positions: one arm reaches to ``wrist``, and the other arm hangs down.

        Args:
            time: time at which tremor and sway are evaluated [s].
            wrist: desired position of the wrist in the sensor's frame, shape (3,) [m]; if the position is out of
                reach, the arm stretches towards it.
            swivel: angle psi of the elbow [rad]; None: the person's usual angle at this height of the wrist.
            hand: rotation of the hand in the sensor's frame, shape (3, 3), with x along the hand and y towards the
                thumb; None: in line with the forearm, and with the thumb up when the forearm points forward.
            closed: whether the hand is a fist.
            side: side of the arm that moves.

        Raises:
            InputError: when the wrist is not three finite numbers, the swivel is not finite, or the hand is not a
                rotation.
            UnknownNameError: when ``side`` is neither left nor right.
        """
        wanted = finite_vector(wrist, 3, "Person.skeleton: wrist", "m")
        if swivel is not None:
            finite_number(swivel, "Person.skeleton: swivel", "rad")
        if hand is not None and not _is_rotation(real_array(hand, (3, 3), "Person.skeleton: hand")):
            raise InputError(f"Person.skeleton: hand must be a rotation of shape (3, 3), got {hand!r}")
        middle = self._middle(time)
        points = _standing(self.stature) + middle
        other = "left" if side == "right" else "right"
        shoulder = middle + _to_shoulder(self.stature, other)
        hanging = shoulder + np.array([_outwards(other) * 0.06, -0.97 * self.reach, -0.05])
        self._place_arm(points, other, shoulder, hanging, None, None)
        amplitude, frequency, phase = self.tremor
        shake = (amplitude * np.sin(frequency * time + phase)).sum(axis=0)
        self._place_arm(points, side, middle + _to_shoulder(self.stature, side), wanted + shake, swivel, hand)
        states = {side: HandState.CLOSED if closed else HandState.OPEN, other: HandState.OPEN}
        return Skeleton(time, points, hand_states=(states["left"], states["right"]))

    def elbow(self, shoulder: Array, wrist: Array, swivel: float, side: str = "right") -> tuple[Array, Array]:
        """Return the positions of the elbow, for a swivel angle [rad], and of the wrist, shape (3,) [m] each.

        A wrist that is out of reach is moved along the line from the shoulder until it is within reach.
        """
        to_wrist = wrist - shoulder
        distance = math.sqrt(to_wrist @ to_wrist)
        along = to_wrist / distance if distance > 1e-6 else _FORWARD
        nearest = abs(self.upper_arm - self.forearm) + 0.03
        r = min(max(distance, nearest), self.reach)
        a = (self.upper_arm**2 + r * r - self.forearm**2) / (2.0 * r)
        h = math.sqrt(max(self.upper_arm**2 - a * a, 0.0))
        down = _rotated(_DOWN, along)
        out = _cross(down, along) if side == "right" else _cross(along, down)
        return shoulder + a * along + h * (math.cos(swivel) * down + math.sin(swivel) * out), shoulder + r * along

    def _middle(self, time: float) -> Array:
        amplitude, frequency, phase = self.sway
        x, z = self.position + amplitude * np.sin(frequency * time + phase)
        return np.array([x, 0.0, z])

    def _place_arm(
        self, points: Array, side: str, shoulder: Array, wrist: Array, swivel: float | None, hand: ArrayLike | None
    ) -> None:
        psi = self.swivel + self.lift * max(float(wrist[1] - shoulder[1]) + 0.3, 0.0) if swivel is None else swivel
        elbow, at = self.elbow(shoulder, wrist, psi, side)
        rotation = _hand_along(at - elbow) if hand is None else np.asarray(hand, dtype=float)
        along, across = rotation[:, 0], rotation[:, 1]
        thumb_long, thumb_wide = _TO_THUMB
        points[ARM_JOINTS[side]] = (
            shoulder,
            elbow,
            at,
            at + _TO_HAND * self.hand * along,
            at + _TO_TIP * self.hand * along,
            at + self.hand * (thumb_long * along + thumb_wide * across),
        )


@lru_cache(maxsize=64)
def _to_shoulder(stature: float, side: str) -> Array:
    """Return the position of a shoulder relative to the point on the floor between the feet, shape (3,) [m]."""
    return np.array([_outwards(side) * _HALF_SHOULDERS * stature, _SHOULDER_HEIGHT * stature - SENSOR_HEIGHT, 0.0])


@lru_cache(maxsize=64)
def _standing(stature: float) -> Array:
    """Return the joints of an upright body without arms, relative to the point between its feet, (25, 3) [m]."""
    points = np.zeros((len(JOINTS), 3))
    for name, height in _HEIGHTS.items():
        y = height * stature - SENSOR_HEIGHT
        if name in JOINT:
            points[JOINT[name]] = [0.0, y, 0.0]
            continue
        forward = -_FOOT * stature if name == "foot" else 0.0
        for side in SIDES:
            points[JOINT[f"{name}_{side}"]] = [_outwards(side) * _HALF_HIPS * stature, y, forward]
    points.setflags(write=False)
    return points


def _outwards(side: str) -> float:
    """Return the sign of x on the given side of a person who faces the sensor."""
    if side not in SIDES:
        raise UnknownNameError.among("side", side, SIDES)
    return 1.0 if side == "right" else -1.0


def _is_rotation(matrix: Array) -> bool:
    if matrix.shape != (3, 3) or not np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6:
        return False
    return bool(_cross(matrix[:, 0], matrix[:, 1]) @ matrix[:, 2] > 0.0)


def _hand_along(forearm: Array) -> Array:
    """Return the rotation of a hand in line with the forearm; if the forearm points forward, the thumb points up."""
    x = forearm / math.sqrt(forearm @ forearm)
    y = _rotated(_UP, x)
    return np.array([x, y, _cross(x, y)]).T


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors (3,), faster than ``np.cross``."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _rotated(vector: Array, direction: Array) -> Array:
    """Rotate a vector by the smallest rotation that takes the person's forward axis to ``direction``.

    The vector, shape (3,), must be perpendicular to the forward axis. When the arm moves, the result changes
    continuously, except when the arm points straight backwards.
    """
    both = direction + _FORWARD
    square = float(both @ both)
    rotated = vector - (2.0 * float(direction @ vector) / square) * both if square > 1e-12 else -vector
    rotated = rotated - float(direction @ rotated) * direction
    return np.asarray(rotated / math.sqrt(rotated @ rotated))
