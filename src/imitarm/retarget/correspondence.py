"""Correspondence: which arm the robot follows, and how the motion of the hand is mapped to the tool."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import SIDES
from imitarm.kinematics.pose import Pose, matrix_to_quaternion, quaternion_multiply
from imitarm.retarget.limbs import LimbLengths
from imitarm.validation import choice, finite_number, instance

Array = NDArray[np.float64]
Orientation = Literal["hand", "upright", "fixed"]

FACING = Pose(np.zeros(3), matrix_to_quaternion(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])))
"""``sensor_to_base`` for a person who faces the sensor and imagines standing in the robot's place.

The robot's x axis points in the person's forward direction, its y axis to the person's left, and its z axis up.
"""


@dataclass(frozen=True, eq=False)
class Correspondence:
    r"""How the motion of a person's arm is mapped to the robot's tool.

    While the robot follows the person, the tool repeats the displacement and the rotation of the hand since the time at
    which the robot began to follow (docs/retargeting.md):

    .. math:: p_d = p_{home} + \rho\, R\,(W - W_0), \qquad R_d = R\,(R_H R_{H,0}^T)\,R^T R_{home}

    Here, :math:`p_d, R_d` is the desired pose of the tool, R is the rotation from sensor to base, and :math:`\rho` is
    the scale. In the sensor's frame, W is the position of the wrist and :math:`R_H` the rotation of the hand. When the
    robot began to follow, the wrist was at :math:`W_0`, the hand had the rotation :math:`R_{H,0}`, and the tool had the
    pose :math:`p_{home}, R_{home}`.

    Attributes:
        side: side of the person's arm that the robot follows, ``"left"`` or ``"right"``.
        sensor_to_base: pose of the sensor in the robot's base frame. The motion of the tool depends only on the
            rotation of this pose.
        lengths: bone lengths of the person's arm; None: they are measured in the first frames.
        scale: :math:`\rho`, displacement of the tool divided by the displacement of the wrist.
        orientation: how the tool rotates. ``"hand"``: like the hand. ``"upright"``: with the hand's rotation about the
            vertical only, so that a tool that points down always points down. ``"fixed"``: not at all.

    Raises:
        InputError: when a value has the wrong type or is out of range.
    """

    side: str = "right"
    sensor_to_base: Pose = FACING
    lengths: LimbLengths | None = None
    scale: float = 1.0
    orientation: Orientation = "hand"

    def __post_init__(self) -> None:
        choice(self.side, SIDES, "side")
        choice(self.orientation, get_args(Orientation), "orientation")
        instance(self.sensor_to_base, Pose, "Correspondence: sensor_to_base")
        if self.lengths is not None:
            instance(self.lengths, LimbLengths, "Correspondence: lengths")
        scale = finite_number(self.scale, "Correspondence: scale", at_least=0.05, at_most=10.0)
        object.__setattr__(self, "scale", scale)

    def engage(self, wrist: ArrayLike, hand: Array, tool_to_base: Pose) -> Clutch:
        """Return the clutch for a robot that begins to follow the person now, at these poses of hand and tool.

        Args:
            wrist: wrist position in the base frame, shape (3,) [m].
            hand: hand rotation in the base frame, quaternion wxyz, shape (4,).
            tool_to_base: pose of the tool in the base frame, with the measured position and the last commanded
                rotation.
        """
        return Clutch(self, np.array(wrist, dtype=float), np.array(hand, dtype=float), tool_to_base)


@dataclass(frozen=True, eq=False)
class Clutch:
    """The poses of hand and tool when the robot began to follow the person; see :class:`Correspondence`.

    Attributes:
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        wrist: wrist position in the base frame when the robot began to follow, shape (3,) [m].
        hand: hand rotation in the base frame when the robot began to follow, quaternion wxyz, shape (4,).
        home: pose of the tool in the base frame when the robot began to follow.
    """

    correspondence: Correspondence
    wrist: Array
    hand: Array
    home: Pose

    def target(self, wrist: Array, hand: Array) -> Pose:
        """Return the desired tool pose for a wrist (3,) [m] and a hand (4,) wxyz, all in the base frame."""
        position = self.home.position + self.correspondence.scale * (wrist - self.wrist)
        kind = self.correspondence.orientation
        if kind == "fixed":
            return Pose.trusted(position, self.home.quaternion)
        if kind == "upright":
            return Pose.trusted(position, _about_vertical(hand, self.hand, self.home.quaternion))
        rotation = quaternion_multiply(hand, self.hand * _CONJUGATE)
        quaternion = quaternion_multiply(rotation, self.home.quaternion)
        return Pose.trusted(position, quaternion / math.sqrt(float(quaternion.dot(quaternion))))


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _about_vertical(hand: Array, before: Array, home: Array) -> Array:
    """Rotate ``home`` about the base's z axis as the hand has rotated since ``before``; quaternions, shape (4,).

    The rotation about z is the twist of the swing-twist decomposition. The function computes the twist with plain
    floats, because two components of the twist's quaternion are zero.
    """
    (a, b, c, d), (e, f, g, h), (w, x, y, z) = hand.tolist(), before.tolist(), home.tolist()
    real, up = a * e + b * f + c * g + d * h, d * e - a * h + c * f - b * g
    length = math.sqrt(real * real + up * up)
    if length < 1e-9:  # upside down: the heading is undefined
        return home
    real, up = real / length, up / length
    return np.array([real * w - up * z, real * x - up * y, real * y + up * x, real * z + up * w])
