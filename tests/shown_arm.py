"""Skeletons of an arm with given joint angles, for tests of methods that map joints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, HandState, Skeleton
from imitarm.retarget.correspondence import FACING
from imitarm.retarget.human_arm import human_arm_pose
from imitarm.retarget.limbs import LimbLengths

LENGTHS = LimbLengths(0.32, 0.26)
EASY = np.array([-0.3, 0.9, 2.4, 1.4, -2.0, 0.7, 0.3])
"""Angles of an arm before the chest, elbow low and outwards."""
_BODY = Person.from_seed(0)
_HAND, _TO_THUMB = 0.17, np.array([0.06, 0.06, 0.0])


def skeleton(time: float, angles: np.ndarray, *, closed: bool = False) -> Skeleton:
    """A person who faces the sensor, whose right arm has these seven angles in the axes of the robot's base."""
    elbow, wrist, hand = human_arm_pose(angles, LENGTHS)
    tip, thumb = wrist + _HAND * hand[:, 0], wrist + hand @ _TO_THUMB
    body = _BODY.skeleton(0.0, _BODY.shoulder() + np.array([0.1, -0.2, -0.3]))
    positions = np.array(body.positions)
    to_sensor = FACING.rotation.T
    for name, point in (
        ("shoulder", np.zeros(3)),
        ("elbow", elbow),
        ("wrist", wrist),
        ("hand", 0.5 * (wrist + tip)),
        ("hand_tip", tip),
        ("thumb", thumb),
    ):
        positions[JOINT[f"{name}_right"]] = _BODY.shoulder() + to_sensor @ point
    state = HandState.CLOSED if closed else HandState.OPEN
    return Skeleton(time, positions, hand_states=(HandState.UNKNOWN, state))


def shown(
    angles: Callable[[float], np.ndarray], duration: float, *, rate: float = 30.0, closed: bool = False
) -> list[Skeleton]:
    """Frames of an arm whose angles are a function of time [s]."""
    return [skeleton(k / rate, angles(k / rate), closed=closed) for k in range(int(duration * rate) + 1)]


def swing(joint: int, by: float, *, start: float = 1.0, over: float = 4.0, base: np.ndarray = EASY):
    """Angles that stand, then turn one joint ``by`` [rad] ``over`` so many seconds by minimum jerk, then stand."""

    def angles(time: float) -> np.ndarray:
        u = min(max((time - start) / over, 0.0), 1.0)
        q = base.copy()
        q[joint] += by * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        return q

    return angles
