"""Contact of the arm, detected from the torques of its joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.validation import finite_number, finite_numbers, finite_vector, instance

Array = NDArray[np.float64]

_DRY_FRICTION_SPEED = 0.02  # [rad/s] below it the direction of the dry friction is uncertain
_SHARE = 0.15  # of the rated torque
_UNRATED = 10.0  # [N m] for a joint without a rated torque
_GAP = 0.1  # [s] after a longer gap between two states the observer starts again


class Contact(NamedTuple):
    """A contact that the torques of the joints show.

    Attributes:
        joint: name of the joint with the largest ratio of external torque to threshold.
        torque: external torque on this joint [N m].
        threshold: largest torque that does not count as a contact [N m].
        time: time on the robot's clock [s].
    """

    joint: str
    torque: float
    threshold: float
    time: float

    def __str__(self) -> str:
        return (
            f"contact: an external torque of {self.torque:.1f} N m acts on {self.joint} "
            f"({self.threshold:.1f} N m are allowed)"
        )


class ContactDetector:
    r"""Detects contacts from the external torques on the joints, which a momentum observer estimates.

    Let M be the mass matrix of the arm. The generalised momentum of the arm, :math:`p = M(q)\,\dot q`, changes because
    of five torques. They come from the drives (:math:`\tau`), gravity (g), Coriolis forces (matrix C), friction
    (:math:`\tau_f`), and an external force F (:math:`\tau_e = J^T F`). The observer (De Luca, Albu-Schaeffer, Haddadin
    and Hirzinger, "Collision detection and safe reaction with the DLR-III lightweight manipulator arm", IROS 2006)
    compares the momentum with the integral of the other four torques. Its residual r is

    .. math:: r = K \Big( p - \int (\tau - \tau_f + C^T \dot q - g + r)\, dt \Big), \qquad \dot r = K (\tau_e - r) .

    The residual r is therefore the external torque after a low-pass filter with the time constant 1/K. The observer
    needs no measured acceleration. For each pair of successive states, the observer computes the inverse dynamics
    :math:`\dot p - C^T \dot q + g` once. For this, it uses the means of the two joint positions and of the two joint
    velocities. The acceleration is the change of the joint velocity divided by the time between the states. The thesis
    mentions torque sensors that "help the robot detect collision" (3.2.3), but does not describe how.

    While a joint stands still, dry friction can balance an external torque. The residual is then uncertain by up to the
    torque of the dry friction.

    Args:
        arm: model of the arm with its tool, including all masses.
        threshold: external torque of each joint that counts as a contact, one number or shape (n_joints,) [N m]; None:
            0.15 times the rated torque of the joint (10 N m if no rated torque is known), plus the dry friction of the
            joint. With this default, a tool that is 5 % heavier than in the model, or a payload of half a kilogram, is
            not reported as a contact.
        gain: gain K of the observer [1/s].

    Attributes:
        threshold: external torque of each joint that counts as a contact, shape (n_joints,) [N m].
        residual: estimated external torques r, shape (n_joints,) [N m].

    Raises:
        InputError: when a number can't be used, or a link of the arm has no usable mass.
    """

    def __init__(self, arm: ArmModel, *, threshold: ArrayLike | None = None, gain: float = 25.0) -> None:
        self.arm = instance(arm, ArmModel, "ContactDetector: arm")
        arm.check_dynamics()
        self.gain = finite_number(gain, "ContactDetector: gain", "1/s", above=0.0)
        model = arm.spec().compile()
        dofs = [int(model.jnt_dofadr[model.joint(name).id]) for name in arm.joint_names]
        self._rotors, self._damping = np.array(model.dof_armature[dofs]), np.array(model.dof_damping[dofs])
        self._dry = np.array(model.dof_frictionloss[dofs])
        if threshold is None:
            self.threshold = _SHARE * np.where(np.isfinite(arm.max_torque), arm.max_torque, _UNRATED / _SHARE)
            self.threshold += self._dry
        else:
            given = finite_numbers(threshold, "ContactDetector: threshold", "N m")
            given = np.repeat(given, arm.n_joints) if len(given) == 1 else given
            self.threshold = finite_vector(given, arm.n_joints, "ContactDetector: threshold", "N m").copy()
            if self.threshold.min() <= 0.0:
                raise InputError(f"ContactDetector: threshold must be above 0 [N m], got {self.threshold.min():g}")
        self.reset()

    def reset(self) -> None:
        """Restart the observer: forget all states received so far."""
        self._last: ArmState | None = None
        self.residual: Array = np.zeros(self.arm.n_joints)

    def update(self, state: ArmState) -> Contact | None:
        """Update the estimate with the next measured state, and return a contact if one is detected.

        Args:
            state: positions, velocities and drive torques of the joints. If all torques are exactly 0, they count as
                not measured.

        Returns:
            The contact; None when no external torque exceeds its threshold.

        Raises:
            InputError: when ``state`` is not an ArmState, or has another number of joints than the arm.
        """
        instance(state, ArmState, "ContactDetector.update: state")
        finite_vector(state.q, self.arm.n_joints, "ContactDetector.update: q of the state", "rad")
        last, self._last = self._last, state
        dt = 0.0 if last is None else state.time - last.time
        if last is None or not 0.0 < dt <= _GAP or not state.torque.any():
            return None
        velocity, acceleration = 0.5 * (last.velocity + state.velocity), (state.velocity - last.velocity) / dt
        explained = self.arm.inverse_dynamics(0.5 * (last.q + state.q), velocity, acceleration)
        explained += self._rotors * acceleration + self._damping * velocity
        explained += self._dry * np.tanh(velocity / _DRY_FRICTION_SPEED)
        weight = -np.expm1(-self.gain * dt)  # the exact solution of the filter for a constant torque
        self.residual = self.residual + weight * (explained - state.torque - self.residual)
        ratio = np.abs(self.residual) / self.threshold
        joint = int(ratio.argmax())
        if ratio[joint] <= 1.0:
            return None
        torque, most = float(self.residual[joint]), float(self.threshold[joint])
        return Contact(self.arm.joint_names[joint], torque, most, state.time)
