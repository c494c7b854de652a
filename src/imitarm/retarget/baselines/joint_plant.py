"""JointPlant: an arm with its real inertias, rotors and friction that is given torques; no contact, no drives."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

_SUBSTEP = 0.002  # [s] longest step of the physics


class JointPlant:
    """What a joint controller is tried on: the arm in MuJoCo, gravity on, contacts off.

    It holds what ``ArmModel`` does not: inertia of the rotors, viscous damping and dry friction of the joints. A
    controller that knows the arm by its ``ArmModel`` does not know these.

    Args:
        arm: whose dynamics.
        dt: for how long a torque is held [s].

    Attributes:
        substeps: steps of the physics in ``dt``.
        energy: kinetic and potential energy [J]; of the last state that was stepped from.

    Raises:
        InputError: when ``dt`` is not positive.
    """

    def __init__(self, arm: ArmModel, dt: float) -> None:
        if not 0.0 < dt <= 0.1:
            raise InputError(f"JointPlant: dt must be above 0 and at most 0.1 s, got {dt!r}")
        spec = arm.spec()
        self.substeps = math.ceil(dt / _SUBSTEP - 1e-9)
        spec.option.timestep = dt / self.substeps
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self._model, self._arm = spec.compile(), arm
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name).id for name in arm.joint_names]
        self._qpos, self._dofs = self._model.jnt_qposadr[joints], self._model.jnt_dofadr[joints]
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Be at rest at ``q``, shape (n_joints,) [rad]; the fingers of a gripper stay as they are at home."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._arm.posture(self._model, q)
        mujoco.mj_forward(self._model, self._data)
        self._data.ctrl[:] = self._data.actuator_length

    @property
    def q(self) -> Array:
        """Joint positions, shape (n_joints,) [rad]."""
        return np.asarray(self._data.qpos[self._qpos])

    @property
    def velocity(self) -> Array:
        """Joint velocities, shape (n_joints,) [rad/s]."""
        return np.asarray(self._data.qvel[self._dofs])

    @property
    def energy(self) -> float:
        """Kinetic and potential energy [J]."""
        return float(self._data.energy.sum())

    def step(self, torque: Array) -> None:
        """Go on for ``dt`` with torques (n_joints,) [N m] on the joints."""
        self._data.qfrc_applied[self._dofs] = torque
        mujoco.mj_step(self._model, self._data, self.substeps)
