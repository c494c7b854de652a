r"""What of a person's arm stands for what of the robot's: which side, which frames, what scale, what turns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import SIDES
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose, matrix_to_quaternion, quaternion_multiply
from imitarm.retarget.limbs import LimbLengths

Array = NDArray[np.float64]
Orientation = Literal["hand", "upright", "fixed"]

FACING = Pose(np.zeros(3), matrix_to_quaternion(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])))
"""``sensor_to_base`` of a person who faces the sensor and stands, in mind, where the robot stands: the person's
forward is the robot's x, the person's left its y, up its z."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    r"""What of a person's arm stands for what of the robot's.

    While the clutch is engaged the tool follows the hand relative to where both were when it engaged (METHODS A.5):

    .. math:: p_d = p_{home} + \rho\, R\,(W - W_0), \qquad R_d = R\,(R_H R_{H,0}^T)\,R^T R_{home}

    with :math:`R` the rotation from sensor to base, :math:`\rho` the scale, W the wrist and :math:`R_H` the hand.

    Attributes:
        side: which arm of the person, ``"left"`` or ``"right"``.
        sensor_to_base: where the sensor is, seen from the robot's base; for relative motion only its rotation counts.
        lengths: of the person's arm; None: they are learnt from the first frames.
        scale: robot's motion over person's motion, rho.
        orientation: what of the hand's turning the tool follows: ``"hand"`` all of it, ``"upright"`` only the turn
            about the vertical, so that a tool that looks down goes on looking down, ``"fixed"`` none.

    Raises:
        InputError: when a value is not usable.
    """

    side: str = "right"
    sensor_to_base: Pose = FACING
    lengths: LimbLengths | None = None
    scale: float = 1.0
    orientation: Orientation = "hand"

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise UnknownNameError.among("side", self.side, SIDES)
        if self.orientation not in get_args(Orientation):
            raise UnknownNameError.among("orientation", self.orientation, get_args(Orientation))
        if not 0.05 <= self.scale <= 10.0:
            raise InputError(f"Correspondence: scale must be between 0.05 and 10, got {self.scale!r}")

    def engage(self, wrist: ArrayLike, hand: Array, tool_to_base: Pose) -> Clutch:
        """Return the clutch that begins here.

        Args:
            wrist: position in the base frame, shape (3,) [m].
            hand: rotation in the base frame, quaternion wxyz, shape (4,).
            tool_to_base: pose of the tool: its position as measured, its rotation as last commanded.
        """
        return Clutch(self, np.array(wrist, dtype=float), np.array(hand, dtype=float), tool_to_base)


@dataclass(frozen=True, eq=False)
class Clutch:
    """Where hand and tool were when the person took hold, so that nothing jumps; see :class:`Correspondence`.

    Attributes:
        correspondence: what follows what.
        wrist: in the base frame when engaged, shape (3,) [m].
        hand: rotation in the base frame when engaged, shape (4,) wxyz.
        home: ``tool_to_base`` when engaged.
    """

    correspondence: Correspondence
    wrist: Array
    hand: Array
    home: Pose

    def target(self, wrist: Array, hand: Array) -> Pose:
        """Return ``tool_to_base`` as it should be for a wrist (3,) [m] and a hand (4,) wxyz in the base frame."""
        position = self.home.position + self.correspondence.scale * (wrist - self.wrist)
        kind = self.correspondence.orientation
        if kind == "fixed":
            return Pose.trusted(position, self.home.quaternion)
        if kind == "upright":
            return Pose.trusted(position, _about_vertical(hand, self.hand, self.home.quaternion))
        turn = quaternion_multiply(hand, self.hand * _CONJUGATE)
        quaternion = quaternion_multiply(turn, self.home.quaternion)
        return Pose.trusted(position, quaternion / math.sqrt(float(quaternion.dot(quaternion))))


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _about_vertical(hand: Array, before: Array, home: Array) -> Array:
    """Return ``home`` turned as the hand has turned about the base's z since ``before``; all are quaternions (4,).

    That is the twist of the swing-twist decomposition; in plain floats, since only two of the turn's numbers count.
    """
    (a, b, c, d), (e, f, g, h), (w, x, y, z) = hand.tolist(), before.tolist(), home.tolist()
    real, up = a * e + b * f + c * g + d * h, d * e - a * h + c * f - b * g
    length = math.sqrt(real * real + up * up)
    if length < 1e-9:  # upside down: no turn about the vertical is nearer than another
        return home
    real, up = real / length, up / length
    return np.array([real * w - up * z, real * x - up * y, real * y + up * x, real * z + up * w])
