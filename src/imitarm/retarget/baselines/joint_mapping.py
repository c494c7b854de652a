"""JointMapping: maps a person's joint angles to the robot's joints, as the baselines M1 and M2 do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Clutch
from imitarm.retarget.human_arm import AXES, human_arm_angles, human_arm_pose
from imitarm.retarget.limbs import LimbLengths
from imitarm.validation import flag

Array = NDArray[np.float64]

_STRETCHED = ((0.0,) * 7, (0.0, 0.5 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, -0.5 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0))
"""Postures in which the arm of a robot may be stretched forward; the mapping uses the first one that fits.

Sawyer's arm is stretched forward if all joint positions are zero. The Panda's arm is stretched forward if its second
joint is at 90 degrees and all others are zero.
"""
_ALIGNED = 0.999  # smallest cosine between a joint's axis and the person's
_ANY = LimbLengths(0.3, 0.26)  # where only rotations matter
_AHEAD = np.array([1.0, 0.0, 0.0])


class JointMapping:
    r"""Maps the seven joint angles of a person's arm to a robot arm whose seven joints have the same axes.

    When a person's arm is stretched forward, its joints rotate about z, y, x, y, x, y, x
    (:mod:`imitarm.retarget.human_arm`). Let :math:`q^*` be the posture in which the robot's joints have the same axes.
    For Sawyer, all joint positions are zero in this posture. For the Panda, the second joint is at 90 degrees, and some
    axes point in the opposite direction. Let :math:`\sigma_i = \pm 1` be the direction of axis i, and :math:`\theta_i`
    the person's angle. The mapping is

    .. math:: q_i = q^*_i + \sigma_i\,\theta_i \quad\text{(absolute)}, \qquad
              q_i = q_{i,0} + \sigma_i\,(\theta_i - \theta_{i,0}) \quad\text{(relative)},

    where :math:`q_{i,0}` and :math:`\theta_{i,0}` are the joint positions of robot and person when the robot began to
    follow the person. These equations determine the first four joints (shoulder and elbow). The last three joints are
    computed from the desired rotation of the tool. In the absolute mapping with the orientation ``"hand"``, this is the
    rotation of the person's hand. Otherwise, it is the rotation of :meth:`Clutch.target
    <imitarm.retarget.correspondence.Clutch.target>`. The mapping does not use link lengths, so the tool does not have
    the position of the hand.

    The angles do not jump by 360 degrees between frames. An angle that is undefined keeps its last value.

    Args:
        arm: the robot's arm.
        relative: True: the relative mapping; False: the absolute mapping.

    Attributes:
        zero: the posture :math:`q^*`, in which the arm is stretched forward, shape (7,) [rad].
        sense: the directions :math:`\sigma`, shape (7,): 1 if a joint rotates like the person's joint, -1 if it rotates
            in the opposite direction.

    Raises:
        InputError: when the arm does not have the joint axes of a person's arm.
    """

    def __init__(self, arm: ArmModel, *, relative: bool) -> None:
        self.arm, self.relative = arm, flag(relative, "JointMapping: relative")
        self.zero, self.sense = _chain_of(arm)
        stretched = arm.tool_pose(self.zero).rotation
        self._tool_to_hand = stretched.T  # chain(theta) = R_tool(q) R_tool(q*)^T
        self.start(arm.home)

    def start(self, q: Array) -> None:
        """Restart with the robot at ``q``, shape (7,) [rad]."""
        self._q = np.array(q, dtype=float)
        self._person: Array | None = None  # angles of the last frame
        self._origin: tuple[Array, Array] | None = None  # robot's joints and person's angles when engaged

    def resume(self, q: Array) -> None:
        """Continue at joint positions ``q``, shape (7,) [rad], in order to map a part of a motion again.

        A relative mapping keeps the joint positions at which the robot began to follow the person.
        """
        self._q = np.array(q, dtype=float)
        if self._origin is not None:
            q0, theta0 = self._from
            self._person = theta0 + self.sense * (self._q - q0)

    def joints(self, estimate: ArmEstimate, clutch: Clutch) -> Array:
        """Return the robot's joint positions for one estimate of the person's arm, without limits, shape (7,) [rad].

        Args:
            estimate: estimate of the person's arm.
            clutch: the poses of hand and tool when the robot began to follow the person.
        """
        hand = quaternion_to_matrix(estimate.hand)
        theta = self.angles(estimate.elbow - estimate.shoulder, estimate.wrist - estimate.elbow, hand)
        whole = not self.relative and clutch.correspondence.orientation == "hand"
        wanted = hand if whole else clutch.target(estimate.wrist, estimate.hand).rotation @ self._tool_to_hand
        return self.onto_robot(theta, wanted)

    @property
    def _from(self) -> tuple[Array, Array]:
        """The joint positions of robot and person at which the changes that the mapping transfers are zero."""
        if self.relative and self._origin is not None:
            return self._origin
        return self.zero, np.zeros(7)

    def angles(self, upper: Array, forearm: Array, hand: Array) -> Array:
        """Return the angles of the person's arm, continuous with the previous angles, shape (7,) [rad].

        Args:
            upper: vector from shoulder to elbow, shape (3,), of any length.
            forearm: vector from elbow to wrist, shape (3,), of any length.
            hand: rotation of the hand, shape (3, 3).
        """
        before = self._person
        theta = human_arm_angles(_unit(upper), _unit(forearm), hand, before)
        if before is not None:
            theta = continued(theta, before)
        self._person = theta
        return theta

    def onto_robot(self, theta: Array, hand: Array) -> Array:
        """Return the robot's joint positions for the angles of a person's arm, shape (7,) [rad].

        Args:
            theta: the person's angles, shape (7,) [rad].
            hand: desired rotation of the tool relative to its rotation in the posture :attr:`zero`, in the base frame,
                shape (3, 3).
        """
        begins = self._origin is None
        if self._origin is None:
            self._origin = self._q, theta
        q0, theta0 = self._from
        q = q0 + self.sense * (theta - theta0)
        q[:4] = continued(q[:4], self._q[:4])
        if begins:  # a full rotation may bring a joint within its limits; later it would be a jump
            q[:4] = _whole_turn_inside(q[:4], self.arm.lower[:4], self.arm.upper[:4])
        chain = self.sense * (q - self.zero)
        _, _, forearm = human_arm_pose(np.concatenate([chain[:4], np.zeros(3)]), _ANY)
        held = np.concatenate([np.zeros(4), self.sense[4:] * (self._q[4:] - self.zero[4:])])
        wrist = human_arm_angles(_AHEAD, _AHEAD, forearm.T @ hand, held)[4:]  # for an arm whose forearm points forward
        q[4:] = self.zero[4:] + self.sense[4:] * wrist
        q[4:] = continued(q[4:], self._q[4:])
        self._q = q
        return q


class Approach:
    """Moves the joints to a goal at limited speed; after the first arrival, it returns every goal unchanged.

    Args:
        arm: arm with the velocity limits of the joints.
        dt: control period [s].
        fraction: largest joint speeds before the arrival, as a fraction of the velocity limits.
    """

    def __init__(self, arm: ArmModel, dt: float, fraction: float = 0.6) -> None:
        self._most = fraction * dt * arm.max_velocity
        self.active = True

    def towards(self, q: Array, goal: Array) -> Array:
        """Return the joint positions one control period after ``q``.

        Before the first arrival, this is a step towards ``goal``; afterwards, it is ``goal``.
        """
        if self.active:
            reached = q + np.clip(goal - q, -self._most, self._most)
            self.active = bool((reached != goal).any())
            return np.asarray(reached)
        return goal


def continued(angles: Array, before: Array) -> Array:
    """Add multiples of 2 pi to angles (n,) [rad], so that each is as close as possible to ``before`` (n,)."""
    return np.asarray(before + (angles - before + np.pi) % (2.0 * np.pi) - np.pi)


def _whole_turn_inside(angles: Array, lower: Array, upper: Array) -> Array:
    """Shift an angle by 360 degrees if it exceeds its limits and the shift brings it inside; all arrays (n,) [rad]."""
    turned = angles - 2.0 * np.pi * np.sign(angles)
    helps = ((angles < lower) | (angles > upper)) & (turned >= lower) & (turned <= upper)
    return np.where(helps, turned, angles)


def _chain_of(arm: ArmModel) -> tuple[Array, Array]:
    """Return the posture in which the arm is stretched forward, and the joints' directions, shape (7,) each."""
    axes = np.eye(3)[["xyz".index(name) for name in AXES]]
    if arm.n_joints == len(AXES):
        for stretched in _STRETCHED:
            cosines = np.sum(arm.jacobian(stretched)[3:].T * axes, axis=1)
            if np.abs(cosines).min() > _ALIGNED:
                return np.array(stretched), np.sign(cosines)
    raise InputError(
        f"{arm.name}: its joints don't correspond to a person's arm (seven joints about z, y, x, y, x, y, x when "
        "stretched forward), so joint angles can't be mapped; use a method that maps the tool: modern, thesis, m3"
    )


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.sqrt(vector @ vector)), 1e-9))
