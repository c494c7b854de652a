"""HumanArmTracker: a person's joint angles, followed by increments of the Jacobian's pseudo-inverse (thesis 3.1)."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    quaternion_to_matrix,
)
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.human_arm import carried, human_arm_angles, human_arm_frames, human_arm_jacobian, human_arm_pose
from imitarm.retarget.limbs import LimbLengths, correct_limbs
from imitarm.retarget.smoothing import GAP

Array = NDArray[np.float64]

_NULL = 0.01  # share of the largest singular value below which the arm is taken not to move
_LARGEST = 0.5  # [rad] of one increment
_ARRIVED = 1e-5  # [m, rad] of error that needs no further one


class HumanArmTracker:
    r"""Follows a person's arm in joint angles (thesis 3.1.1 and 3.1.2, METHODS A.3 and A.4).

    From the angles :math:`\tau` of the frame before, one to three times

    .. math:: \tau \leftarrow \tau + J^+ \varepsilon, \qquad
        \varepsilon = \begin{pmatrix} p_d - p(\tau) \\ \log(R_d R(\tau)^T) \end{pmatrix}

    with p_d, R_d the wrist and hand as corrected, J the Jacobian of the person's arm, and directions in which a
    stretched arm can't move left out of :math:`J^+`. The first frame, and one after a gap, is solved in closed form.

    Attributes:
        angles: tau, shape (7,) [rad]; None before the first frame.

    Args:
        iterations: per frame.
        faults: what of the print to put back, of :data:`imitarm.retarget.baselines.thesis.PRINTED`: ``"limbs"``,
            ``"dh"``, ``"error"``, ``"rpy"`` and ``"step"`` concern this part.
    """

    def __init__(self, iterations: int = 3, faults: Collection[str] = ()) -> None:
        self._iterations = 1 if "step" in faults else iterations
        self._faults = frozenset(faults)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.angles: Array | None = None
        self._time = -math.inf

    def follow(self, estimate: ArmEstimate, lengths: LimbLengths) -> tuple[Array, Array]:
        """Take in a frame and return the wrist (3,) [m] and the hand's quaternion (4,) of the followed arm, base frame.

        Args:
            estimate: of the arm, its bones of the true lengths.
            lengths: these lengths.
        """
        elbow, wrist = estimate.elbow, estimate.wrist
        if "limbs" in self._faults:
            elbow, wrist = correct_limbs(estimate.shoulder, elbow, wrist, lengths, as_printed=True)
        hand = quaternion_to_matrix(estimate.hand)
        if self.angles is None or estimate.time - self._time > GAP:
            self.angles = human_arm_angles(
                _unit(elbow - estimate.shoulder), _unit(wrist - elbow), hand, previous=self.angles
            )
        self._time = estimate.time
        at, rotation = self._pose(lengths)
        for _ in range(self._iterations):
            error = np.concatenate([wrist - estimate.shoulder - at, self._turn(rotation, hand)])
            if float(error @ error) < _ARRIVED**2:
                break
            self._advance(-error if "error" in self._faults else error, lengths)
            at, rotation = self._pose(lengths)
        return estimate.shoulder + at, matrix_to_quaternion(rotation)

    def _advance(self, error: Array, lengths: LimbLengths) -> None:
        """Make one increment."""
        assert self.angles is not None
        increment = np.linalg.pinv(human_arm_jacobian(self.angles, lengths), rcond=_NULL) @ error
        increment *= min(1.0, _LARGEST / max(float(np.abs(increment).max()), 1e-12))
        self.angles = (self.angles + increment + math.pi) % (2.0 * math.pi) - math.pi

    def _pose(self, lengths: LimbLengths) -> tuple[Array, Array]:
        """Return wrist and hand, seen from the shoulder, by forward kinematics."""
        assert self.angles is not None
        if "dh" in self._faults:
            frames = human_arm_frames(self.angles, lengths, as_printed=True)
            return frames[5, :3, 3], _nearest_rotation(frames[7, :3, :3])
        _, wrist, hand = human_arm_pose(self.angles, lengths)  # the same chain, in a third of the time
        return wrist, hand

    def _turn(self, rotation: Array, wanted: Array) -> Array:
        """Return the rotational part of the error, shape (3,) [rad]."""
        if "rpy" in self._faults:
            return roll_pitch_yaw(wanted) - roll_pitch_yaw(rotation)
        return quaternion_log(
            quaternion_multiply(matrix_to_quaternion(wanted), quaternion_conjugate(matrix_to_quaternion(rotation)))
        )


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return roll, pitch and yaw of a rotation Rz(yaw) Ry(pitch) Rx(roll), shape (3,) [rad].

    Their differences are what the thesis takes for the error of orientation: they wrap at half a turn, lock at a pitch
    of a quarter, and are no rotation vector.
    """
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    return np.array(
        [
            math.atan2(rotation[2, 1], rotation[2, 2]),
            pitch,
            math.atan2(rotation[1, 0], rotation[0, 0]),
        ]
    )


def _unit(vector: Array) -> Array:
    length = math.sqrt(float(vector @ vector))
    return vector / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])


def _nearest_rotation(matrix: Array) -> Array:
    """Return the rotation nearest to what the printed matrices multiply to."""
    left, values, right = np.linalg.svd(matrix)
    if values[1] < 1e-9:  # hardly a direction is left
        return carried(None, None, left[:, 0])
    left[:, 2] *= np.linalg.det(left @ right)
    return np.asarray(left @ right)
