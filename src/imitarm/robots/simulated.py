"""A simulated robot: the arm with its real inertias and limits in a MuJoCo world, driven at joint level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.robots.clearance import ClearanceGauge
from imitarm.robots.robot import Robot
from imitarm.robots.world import COLLISION_GROUP, OBSTACLE, add_obstacles, arm_world, obstacle_position
from imitarm.scene import Scene

Array = NDArray[np.float64]
Control = Literal["position", "torque"]

_SERVO_FREQUENCY = 60.0  # [rad/s] stiffness of the position servos: kp = w^2 times the joint's own inertia
_COMPUTED_FREQUENCY = 40.0  # [rad/s] of the computed-torque error dynamics
_DRY_FRICTION_SPEED = 0.02  # [rad/s] below it the drives take only a part of the dry friction for granted
_LIGHTENED_FRICTION = 0.7  # share of the dry friction that the drives take off the hand
_GUIDED_DAMPING = 0.05  # [s/rad] damping of a guided joint over its rated torque


class SimulatedRobot(Robot):
    """An arm in a MuJoCo world, with drives that give at most their rated torques.

    Both kinds of control follow the set-point ``q_d(t)`` with gravity, inertia and friction fed forward; ``M`` is the
    inertia matrix, ``h`` gravity and Coriolis torques, ``f`` the joints' friction at ``v_d``, all of the simulated arm
    with its tool::

        "position"   tau = K (q_d - q) + D (v_d - v) + M a_d + h + f     each joint a stiff servo of its own
        "torque"     tau = M (a_d + w^2 (q_d - q) + 2 w (v_d - v)) + h + f     computed torque, the softer of the two

    ``K`` is diagonal: 60^2 times the diagonal of ``M`` at the arm's home posture, ``D = 2 K / 60``; ``w`` is 40 rad/s.
    Torques beyond ``arm.max_torque`` are cut off. Between two calls of :meth:`move` nothing moves; the same commands
    always give the same motion.

    Attributes:
        model: the compiled world.
        data: its state; read it, and let the robot change it.
        scene_at_start: the scene at time 0; obstacles with a velocity move from there.
        contacts: names of the pairs (arm geom, obstacle geom) that have touched since the last reset.
        contact_steps: number of physics steps with such a contact.
    """

    def __init__(
        self,
        arm: ArmModel,
        *,
        scene: Scene | None = None,
        world: mujoco.MjSpec | None = None,
        control: Control = "position",
        q: ArrayLike | None = None,
        timestep: float = 0.002,
    ) -> None:
        """Build and compile the world.

        Args:
            arm: the arm with its tool.
            scene: its obstacles become solid bodies; None for none.
            world: a world that holds the arm, as :func:`~imitarm.robots.world.arm_world` returns it, with more
                furniture; it is copied. None for a floor and a pedestal.
            control: ``"position"`` or ``"torque"``.
            q: joint angles to start at, shape (n_joints,) [rad]; None for ``arm.home``.
            timestep: of the physics and of the drives [s].

        Raises:
            InputError: when ``control`` is unknown, ``timestep`` is not in (0, 0.002], or ``q`` has a wrong shape or
                is beyond the joints' limits.
        """
        if control not in get_args(Control):
            raise UnknownNameError.among("control", control, get_args(Control))
        if not 0.0 < timestep <= 0.002:
            raise InputError(f"SimulatedRobot: timestep must be in (0, 0.002] s (500 Hz or faster), got {timestep!r}")
        self.scene_at_start = scene if scene is not None else Scene()
        self.control: Control = control
        self._q_start = _checked_start(arm, arm.home if q is None else q)
        spec = arm_world(arm) if world is None else world.copy()
        add_obstacles(spec, self.scene_at_start)
        _add_drives(spec, arm, timestep)
        self.model: mujoco.MjModel = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._index(arm)
        super().__init__(arm, self._q_start)
        self.contacts: set[tuple[str, str]] = set()
        self.contact_steps = 0
        self._servo = self._servo_stiffness(arm)
        self._stiff = False
        self.reset()

    def _index(self, arm: ArmModel) -> None:
        """Find the arm's joints, drives, tool and geoms in the compiled world."""
        m = self.model
        joints = [m.joint(name).id for name in arm.joint_names]
        self._qpos, self._dof = m.jnt_qposadr[joints], m.jnt_dofadr[joints]
        self._drives = np.array([m.actuator(f"drive/{name}").id for name in arm.joint_names])
        self._tool = m.site("tool").id
        arm_bodies = {m.body(body.name).id for body in arm.spec().bodies if body.name and body.name != "world"}
        in_arm = np.isin(m.geom_bodyid, list(arm_bodies)) & ((m.geom_contype | m.geom_conaffinity) != 0)
        if (m.geom_group[in_arm] == COLLISION_GROUP).any():  # an arm from a foreign file may not know the group
            in_arm &= m.geom_group == COLLISION_GROUP
        obstacles = [m.geom(f"{OBSTACLE}{i}").id for i in range(len(self.scene_at_start.obstacles))]
        self._gauge = ClearanceGauge(m, np.flatnonzero(in_arm).tolist(), obstacles)
        moving = [(i, o) for i, o in enumerate(self.scene_at_start.obstacles) if o.velocity.any()]
        self._moving = [
            (m.body_mocapid[m.body(f"{OBSTACLE}{i}").id], obstacle_position(o), o.velocity) for i, o in moving
        ]

    def _servo_stiffness(self, arm: ArmModel) -> Array:
        """Stiffness (n,) [N m/rad] that gives each joint the servo's frequency with its own inertia at home."""
        self.data.qpos[:] = arm.posture(self.model)
        mujoco.mj_forward(self.model, self.data)
        unit, column, inertia = np.zeros(self.model.nv), np.zeros(self.model.nv), []
        for dof in self._dof:
            unit[:] = 0.0
            unit[dof] = 1.0
            mujoco.mj_mulM(self.model, self.data, column, unit)
            inertia.append(column[dof])
        return np.array(inertia) * _SERVO_FREQUENCY**2

    def reset(self, q: ArrayLike | None = None) -> ArmState:
        """Put everything back to time 0, and the arm at rest at ``q``.

        Args:
            q: joint angles, shape (n_joints,) [rad]; None for those given at construction.

        Returns:
            The state.

        Raises:
            InputError: when ``q`` has a wrong shape or is beyond the joints' limits.
        """
        start = self._q_start if q is None else _checked_start(self.arm, q)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.arm.posture(self.model, start)
        self.contacts, self.contact_steps, self.fault = set(), 0, ""
        self._begin(start)
        self._use_servos(self.control == "position")
        mujoco.mj_forward(self.model, self.data)
        if self._stiff:  # the torque that holds still, so that the state at time 0 is that of a standing arm
            self.data.ctrl[self._drives] = start + self.data.qfrc_bias[self._dof] / self._servo
        else:
            self.data.ctrl[self._drives] = self.data.qfrc_bias[self._dof]
        mujoco.mj_forward(self.model, self.data)
        return self.state()

    @property
    def time(self) -> float:
        """Since the last reset [s]."""
        return float(self.data.time)

    @property
    def scene(self) -> Scene:
        """The scene as it truly is now."""
        return self.scene_at_start.after(self.time)

    @property
    def tool_to_base(self) -> Pose:
        """Pose of the tool as the simulator has it."""
        matrix = self.data.site_xmat[self._tool].reshape(3, 3)
        return Pose(self.data.site_xpos[self._tool], matrix_to_quaternion(matrix))

    def state(self) -> ArmState:
        """Return the measured joint angles, velocities and drive torques, and the time since the last reset."""
        return ArmState(
            q=self.data.qpos[self._qpos].copy(),
            velocity=self.data.qvel[self._dof].copy(),
            torque=self.data.actuator_force[self._drives].copy(),
            time=self.time,
        )

    def clearance(self) -> float:
        """Return the smallest distance from the arm or its tool to an obstacle [m].

        It is measured between the simulator's geoms, negative when they overlap and inf without obstacles.
        """
        return self._gauge.measure(self.data)[0]

    def report(self) -> Mapping[str, Any]:
        """Return ``contacts`` and ``contact_steps`` since the last reset."""
        return {"contacts": frozenset(self.contacts), "contact_steps": self.contact_steps}

    def nearest_pair(self) -> tuple[str, str] | None:
        """Return the names of the arm geom and the obstacle that have the :meth:`clearance`; None without any."""
        pair = self._gauge.measure(self.data)[1]
        return None if pair is None else self._names(pair)

    def _names(self, pair: tuple[int, int]) -> tuple[str, str]:
        arm_geom, obstacle = self.model.geom(pair[0]), self.model.geom(pair[1])
        index = int(obstacle.name.removeprefix(OBSTACLE))
        body = self.model.body(self.model.geom_bodyid[pair[0]]).name
        return arm_geom.name or body, self.scene_at_start.name_of(index)

    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        n = self._steps(dt)
        self._use_servos(self.control == "position")
        acceleration = (velocity - previous) / dt
        q_d, v_d, h = self.set_point.copy(), previous.copy(), dt / n
        for _ in range(n):
            if self._stiff:
                self._servo_step(q_d, v_d, acceleration)
            else:
                self._computed_torque_step(q_d, v_d, acceleration)
            q_d += h * (v_d + 0.5 * h * acceleration)
            v_d += h * acceleration
        mujoco.mj_kinematics(self.model, self.data)  # a step leaves the bodies where it found them

    def guide(self, wrench: ArrayLike, dt: float) -> ArmState:
        """Let a hand lead the arm by its tool for ``dt`` seconds while the drives carry the arm's weight.

        The drives give ``tau = h + 0.7 c sign(v) - D v``, with the joints' dry friction ``c`` and a light damping
        ``D``: what robot arms call zero gravity or free drive. Afterwards the set-point is where the arm is.

        Args:
            wrench: force [N] then torque [N m] of the hand on the tool's tip, in the base frame, shape (6,).
            dt: [s].

        Returns:
            The measured state after it.

        Raises:
            InputError: when ``wrench`` is not six finite numbers.
        """
        pull = np.asarray(wrench, dtype=float)
        if pull.shape != (6,) or not np.isfinite(pull).all():
            raise InputError(f"guide: wrench must be 6 finite numbers [N, N m], got {wrench!r}")
        self._use_servos(False)
        m, d = self.model, self.data
        body, damping = int(m.site_bodyid[self._tool]), _GUIDED_DAMPING * np.minimum(self.arm.max_torque, 100.0)
        dry = _LIGHTENED_FRICTION * m.dof_frictionloss[self._dof]
        for _ in range(self._steps(dt)):
            mujoco.mj_step1(m, d)
            velocity = d.qvel[self._dof]
            lightened = dry * np.tanh(velocity / _DRY_FRICTION_SPEED)
            d.ctrl[self._drives] = d.qfrc_bias[self._dof] + lightened - damping * velocity
            d.qfrc_applied[:] = 0.0
            mujoco.mj_applyFT(m, d, pull[:3], pull[3:], d.site_xpos[self._tool], body, d.qfrc_applied)
            mujoco.mj_step2(m, d)
            self._after_step()
        d.qfrc_applied[:] = 0.0
        mujoco.mj_kinematics(m, d)
        state = self.state()
        self._begin(state.q)
        return state

    def _steps(self, dt: float) -> int:
        n = round(dt / self.model.opt.timestep)
        if n < 1 or abs(n * self.model.opt.timestep - dt) > 1e-9:
            raise InputError(f"dt must be a multiple of the timestep {self.model.opt.timestep:g} s, got {dt!r}")
        return n

    def _use_servos(self, stiff: bool) -> None:
        """Let the drives be position servos, or plain torque sources."""
        self._stiff = stiff
        gain, bias = self.model.actuator_gainprm, self.model.actuator_biasprm
        gain[self._drives, 0] = self._servo if stiff else 1.0
        bias[self._drives, 1] = -self._servo if stiff else 0.0
        bias[self._drives, 2] = -2.0 / _SERVO_FREQUENCY * self._servo if stiff else 0.0

    def _servo_step(self, q_d: Array, v_d: Array, acceleration: Array) -> None:
        """Step with servos: what is fed forward is added to the position command, so the torque limit cuts the sum.

        The servo's damping is part of the drive, which the implicit integrator keeps stable at any stiffness.
        """
        forward = self._inertia_times(acceleration) + self.data.qfrc_bias[self._dof] + self._friction(v_d)
        self.data.ctrl[self._drives] = q_d + 2.0 / _SERVO_FREQUENCY * v_d + forward / self._servo
        mujoco.mj_step(self.model, self.data)
        self._after_step()

    def _computed_torque_step(self, q_d: Array, v_d: Array, acceleration: Array) -> None:
        m, d, w = self.model, self.data, _COMPUTED_FREQUENCY
        mujoco.mj_step1(m, d)
        error, rate = q_d - d.qpos[self._qpos], v_d - d.qvel[self._dof]
        known = d.qfrc_bias[self._dof] + self._friction(v_d)
        d.ctrl[self._drives] = self._inertia_times(acceleration + w * w * error + 2.0 * w * rate) + known
        mujoco.mj_step2(m, d)
        self._after_step()

    def _inertia_times(self, acceleration: Array) -> Array:
        """Return ``M a`` (n,) of the arm [N m]."""
        every, torque = np.zeros(self.model.nv), np.zeros(self.model.nv)
        every[self._dof] = acceleration
        mujoco.mj_mulM(self.model, self.data, torque, every)
        return torque[self._dof]

    def _friction(self, velocity: Array) -> Array:
        """Return the torque (n,) [N m] that the joints' viscous and dry friction take at ``velocity``."""
        dry = self.model.dof_frictionloss[self._dof] * np.tanh(velocity / _DRY_FRICTION_SPEED)
        return np.asarray(self.model.dof_damping[self._dof] * velocity + dry)

    def _after_step(self) -> None:
        """Note contacts and move what moves."""
        touching = self._gauge.touching(self.data)
        if touching:
            self.contact_steps += 1
            self.contacts.update(self._names(pair) for pair in touching)
        for mocap, position, velocity in self._moving:
            self.data.mocap_pos[mocap] = position + velocity * self.data.time


def _checked_start(arm: ArmModel, q: ArrayLike) -> Array:
    start = np.array(q, dtype=float)
    if start.shape != (arm.n_joints,) or not np.isfinite(start).all():
        raise InputError(f"SimulatedRobot: q must be {arm.n_joints} finite numbers [rad], got {q!r}")
    beyond = np.flatnonzero((start < arm.lower) | (start > arm.upper))
    if len(beyond):
        i = int(beyond[0])
        raise InputError(
            f"SimulatedRobot: joint {arm.joint_names[i]} at {start[i]:.3f} rad is beyond its limits "
            f"[{arm.lower[i]:.3f}, {arm.upper[i]:.3f}]"
        )
    return start


def _add_drives(spec: mujoco.MjSpec, arm: ArmModel, timestep: float) -> None:
    """Give every joint of the arm one drive with its rated torque, instead of any it had."""
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for actuator in list(spec.actuators):
        if actuator.target in arm.joint_names:
            spec.delete(actuator)
    for name, limit in zip(arm.joint_names, arm.max_torque, strict=True):
        spec.add_actuator(
            name=f"drive/{name}",
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
