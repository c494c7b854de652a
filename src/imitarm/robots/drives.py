"""The drives of a simulated arm (position servos, computed torque, hand guiding) and of its gripper."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

SERVO_FREQUENCY = 60.0  # [rad/s] stiffness of the position servos: K = w^2 times the joint's own inertia
COMPUTED_FREQUENCY = 40.0  # [rad/s] of the computed-torque error dynamics
GRIPPER = "tool/opening"  # the actuator of a mounted gripper
FINGER_SPEED = 0.12  # [m/s] at which a gripper's opening changes, as electric parallel grippers do
_DRY_FRICTION_SPEED = 0.02  # [rad/s] below it the drives compensate only a part of the dry friction
_LIGHTENED_FRICTION = 0.7  # fraction of the dry friction that is compensated in hand guiding
_GUIDED_DAMPING = 0.05  # [s/rad] damping of a guided joint per rated torque


def add_drives(spec: mujoco.MjSpec, arm: ArmModel) -> None:
    """Give every joint of the arm one drive with its rated torque, in place of its own actuators.

    Args:
        spec: the world that holds the arm; changed in place.
        arm: its joints and rated torques are used.
    """
    for actuator in list(spec.actuators):
        if actuator.target in arm.joint_names:
            spec.delete(actuator)
    for name, limit in zip(arm.joint_names, arm.max_torque, strict=True):
        limited = bool(np.isfinite(limit))
        spec.add_actuator(
            name=f"drive/{name}",
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=limited,
            forcerange=[-limit, limit] if limited else [0.0, 0.0],
        )


class Drives:
    """One drive for each joint; every method makes one physics step.

    ``M`` is the inertia matrix with the rotors, ``h`` the torques of gravity and Coriolis forces, and ``f`` the joints'
    viscous and dry friction at ``v_d``. ``q_d``, ``v_d`` and ``a_d`` are the set-point. The rated torques are never
    exceeded.

    Args:
        model: the compiled world, with the drives that :func:`add_drives` has added.
        data: its state.
        arm: the arm.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, arm: ArmModel) -> None:
        self._model, self._data = model, data
        joints = [model.joint(name).id for name in arm.joint_names]
        self._qpos, self._dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._ids = np.array([model.actuator(f"drive/{name}").id for name in arm.joint_names])
        servos = (model.actuator_gainprm[:, 0] > 0.0) & (model.actuator_biasprm[:, 1] == -model.actuator_gainprm[:, 0])
        self._servos = np.setdiff1d(np.flatnonzero(servos), self._ids)
        names = {model.actuator(i).name for i in range(model.nu)}
        self._gripper = model.actuator(GRIPPER).id if GRIPPER in names else None
        self._opening_wanted: float | None = None
        self._stiff: bool | None = None
        self._guided_damping = _GUIDED_DAMPING * np.minimum(arm.max_torque, 100.0)
        self._every, self._torque = np.zeros(model.nv), np.zeros(model.nv)
        data.qpos[:] = arm.posture(model)
        mujoco.mj_forward(model, data)
        inertia = np.array([self._inertia_times(row)[i] for i, row in enumerate(np.eye(arm.n_joints))])
        self._stiffness = SERVO_FREQUENCY**2 * inertia
        self._damping = 2.0 * SERVO_FREQUENCY * inertia

    @property
    def q(self) -> Array:
        """Joint angles, shape (n,) [rad]."""
        return np.asarray(self._data.qpos[self._qpos])

    @property
    def velocity(self) -> Array:
        """Joint velocities, shape (n,) [rad/s]."""
        return np.asarray(self._data.qvel[self._dof])

    @property
    def torque(self) -> Array:
        """Torques of the drives, shape (n,) [N m]."""
        return np.asarray(self._data.actuator_force[self._ids])

    @property
    def opening(self) -> float:
        """Opening between the gripper's fingers [m]; nan without a gripper."""
        return float("nan") if self._gripper is None else float(self._data.actuator_length[self._gripper])

    @property
    def widest_opening(self) -> float:
        """Opening of the gripper when it is wide open [m]; nan without a gripper."""
        return float("nan") if self._gripper is None else float(self._model.actuator_ctrlrange[self._gripper, 1])

    def grasp(self, opening: float) -> None:
        """Move the gripper to ``opening`` [m] at 0.12 m/s; its servo presses with at most its rated force.

        Raises:
            InputError: when there is no gripper, or the opening is out of its range.
        """
        if self._gripper is None:
            raise InputError(f"grasp: this world has no gripper (no actuator {GRIPPER!r}); load the arm with one")
        least, most = self._model.actuator_ctrlrange[self._gripper]
        if not least <= opening <= most:
            raise InputError(f"grasp: opening must be between {least:g} and {most:g} m, got {opening!r}")
        self._opening_wanted = float(opening)

    def hold(self) -> None:
        """Hold the arm still and keep the opening of the gripper, without a physics step."""
        self._use_servos(False)
        self._data.ctrl[self._servos] = self._data.actuator_length[self._servos]
        self._opening_wanted = None
        self._data.ctrl[self._ids] = self._data.qfrc_bias[self._dof]
        mujoco.mj_forward(self._model, self._data)

    def servo(self, q_d: Array, v_d: Array, a_d: Array) -> None:
        """Step with a stiff servo at each joint: ``tau = K (q_d - q) + D (v_d - v) + M a_d + h + f``.

        ``K`` is diagonal, 60^2 times the diagonal of ``M`` at the arm's home posture, and ``D = 2 K / 60``.
        The feed-forward torque is part of the servo's position command, so that the torque limit applies to the sum.
        The damping is part of the drive, so that the implicit integrator keeps it stable.
        """
        self._prepare(True)
        forward = self._inertia_times(a_d) + self._data.qfrc_bias[self._dof] + self._friction(v_d)
        self._data.ctrl[self._ids] = q_d + (self._damping * v_d + forward) / self._stiffness
        mujoco.mj_step(self._model, self._data)

    def computed_torque(self, q_d: Array, v_d: Array, a_d: Array) -> None:
        """Step with ``tau = M (a_d + w^2 (q_d - q) + 2 w (v_d - v)) + h + f``, with ``w`` = 40 rad/s."""
        self._prepare(False)
        mujoco.mj_step1(self._model, self._data)
        w = COMPUTED_FREQUENCY
        wanted = a_d + w * w * (q_d - self.q) + 2.0 * w * (v_d - self.velocity)
        self._data.ctrl[self._ids] = self._inertia_times(wanted) + self._data.qfrc_bias[self._dof] + self._friction(v_d)
        mujoco.mj_step2(self._model, self._data)

    def free(self, force: Array, torque: Array, site: int) -> None:
        """Step with ``tau = h + 0.7 c sign(v) - D v``, with ``c`` the dry friction, while a hand pulls at a site.

        Args:
            force: of the hand, in the base frame, shape (3,) [N].
            torque: of the hand, shape (3,) [N m].
            site: id of the site.
        """
        m, d = self._model, self._data
        self._prepare(False)
        mujoco.mj_step1(m, d)
        velocity = self.velocity
        lightened = _LIGHTENED_FRICTION * m.dof_frictionloss[self._dof] * np.tanh(velocity / _DRY_FRICTION_SPEED)
        d.ctrl[self._ids] = d.qfrc_bias[self._dof] + lightened - self._guided_damping * velocity
        mujoco.mj_applyFT(m, d, force, torque, d.site_xpos[site], int(m.site_bodyid[site]), d.qfrc_applied)
        mujoco.mj_step2(m, d)
        d.qfrc_applied[:] = 0.0

    def _prepare(self, stiff: bool) -> None:
        """Before a step: switch the drives to their mode and move the set-point of the fingers on."""
        self._use_servos(stiff)
        if self._opening_wanted is not None:
            now, most = float(self._data.ctrl[self._gripper]), FINGER_SPEED * self._model.opt.timestep
            self._data.ctrl[self._gripper] = now + min(max(self._opening_wanted - now, -most), most)

    def _use_servos(self, stiff: bool) -> None:
        """Switch the drives to position servos, or to plain sources of torque."""
        if stiff is self._stiff:
            return
        self._stiff = stiff
        gain, bias = self._model.actuator_gainprm, self._model.actuator_biasprm
        gain[self._ids, 0] = self._stiffness if stiff else 1.0
        bias[self._ids, 1] = -self._stiffness if stiff else 0.0
        bias[self._ids, 2] = -self._damping if stiff else 0.0

    def _inertia_times(self, acceleration: Array) -> Array:
        """Return ``M a`` (n,) [N m]."""
        self._every[self._dof] = acceleration
        mujoco.mj_mulM(self._model, self._data, self._torque, self._every)
        return self._torque[self._dof]

    def _friction(self, velocity: Array) -> Array:
        """Return the torque of the joints' friction (n,) [N m] at ``velocity``."""
        dry = self._model.dof_frictionloss[self._dof] * np.tanh(velocity / _DRY_FRICTION_SPEED)
        return np.asarray(self._model.dof_damping[self._dof] * velocity + dry)
