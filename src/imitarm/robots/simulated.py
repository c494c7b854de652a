"""SimulatedRobot: an arm in a MuJoCo world, with the inertias and limits of the real arm and a drive for each joint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.robots.robot import Robot
from imitarm.robots.world import (
    COLLISION_GROUP,
    OBSTACLE,
    ClearanceGauge,
    add_fixtures,
    add_obstacles,
    arm_world,
    fixture_names,
)
from imitarm.scene import MovingScene, Scene, standard_fixtures
from imitarm.scene.motion import Motion
from imitarm.validation import choice, finite_number, finite_vector, instance

Array = NDArray[np.float64]
Control = Literal["position", "torque"]
SERVO_FREQUENCY = 60.0  # [rad/s] stiffness of the position servos: K = w^2 times the joint's own inertia
COMPUTED_FREQUENCY = 40.0  # [rad/s] of the computed-torque error dynamics
GRIPPER = "tool/opening"  # the actuator of a mounted gripper
FINGER_SPEED = 0.12  # [m/s] at which a gripper's opening changes, as electric parallel grippers do
_DRY_FRICTION_SPEED = 0.02  # [rad/s] below it the drives compensate only a part of the dry friction
_LIGHTENED_FRICTION = 0.7  # fraction of the dry friction that is compensated in hand guiding
_GUIDED_DAMPING = 0.05  # [s/rad] damping of a guided joint per rated torque


class SimulatedRobot(Robot):
    """An arm in a MuJoCo world, with drives that are limited to their rated torques.

    There are two kinds of control: ``"position"`` is a stiff servo at each joint, and ``"torque"`` is the softer
    computed-torque control. Both follow the set-point ``q_d(t)``, with a feed-forward of gravity, inertia and friction
    (see :class:`Drives`). Time advances only within :meth:`move` and :meth:`guide`, and the same commands always give
    the same motion.

    Attributes:
        model: the compiled world.
        data: state of the simulation; read only.
        scene_at_start: the scene at time 0.
        contacts: names of the pairs of geoms (shapes of the simulator) that have touched since the last reset. Each
            pair contains a geom of the arm. The other geom belongs to an obstacle, a fixture, or another link (a
            self-contact).
        contact_steps: number of physics steps in which at least one such pair was in contact.
    """

    def __init__(
        self,
        arm: ArmModel,
        *,
        scene: Scene | None = None,
        motion: Mapping[str | int, Motion] | None = None,
        world: mujoco.MjSpec | None = None,
        control: Control = "position",
        q: ArrayLike | None = None,
        timestep: float = 0.002,
    ) -> None:
        """Build and compile the world.

        Args:
            arm: the arm with its tool.
            scene: scene whose obstacles and fixtures become solid bodies; None: no obstacles. The scene's ``stamp`` is
                the start time of the world. If the scene has no fixtures and ``world`` is None, a floor and a pedestal
                are added.
            motion: motions of some obstacles, by name or index. Each motion is a function of the time on the scene's
                clock, or a recorded :class:`~imitarm.scene.motion.Track`. Other obstacles keep their velocities.
            world: world with the arm, built by :func:`~imitarm.robots.world.arm_world`, possibly with added furniture;
                the robot uses a copy of it. None: the world is built from the scene.
            control: ``"position"`` or ``"torque"``.
            q: start posture, shape (n_joints,) [rad]; None: ``arm.home``.
            timestep: time step of the physics and of the drives [s].

        Raises:
            InputError: when ``control`` is unknown, or ``timestep`` is not above 0 and at most 0.002 s. Also when ``q``
                has a wrong shape or is beyond the joints' limits, or a link of the arm has no usable mass.
        """
        choice(control, get_args(Control), "control")
        timestep = finite_number(timestep, "SimulatedRobot: timestep", "s", above=0.0, at_most=0.002)
        arm = instance(arm, ArmModel, "SimulatedRobot: arm")
        arm.check_dynamics()
        scene = Scene() if scene is None else instance(scene, Scene, "SimulatedRobot: scene")
        if world is None and not scene.fixtures:
            scene = replace(scene, fixtures=standard_fixtures())
        self._source = scene if motion is None else MovingScene(scene, motion)
        self.scene_at_start = self._source.at(scene.stamp)
        self.control: Control = control
        self._q_start = _checked_start(arm, arm.home if q is None else q)
        spec = arm_world(arm, fixtures=scene.fixtures) if world is None else world.copy()
        add_fixtures(spec, scene.fixtures)
        add_obstacles(spec, self.scene_at_start)
        add_drives(spec, arm)
        spec.option.timestep = timestep
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model: mujoco.MjModel = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._index(arm)
        super().__init__(arm, self._q_start)
        self._drives = Drives(self.model, self.data, arm)
        self.contacts: set[tuple[str, str]] = set()
        self.contact_steps = 0
        self.reset()

    def _index(self, arm: ArmModel) -> None:
        """Find the arm's tool and geoms, the obstacles and the moving bodies in the compiled world."""
        m = self.model
        self._tool = m.site("tool" if arm.has_tool else "flange").id
        arm_bodies = {m.body(body.name).id for body in arm.spec().bodies if body.name and body.name != "world"}
        in_arm = np.isin(m.geom_bodyid, list(arm_bodies)) & ((m.geom_contype | m.geom_conaffinity) != 0)
        if (m.geom_group[in_arm] == COLLISION_GROUP).any():  # an arm from a foreign file may not know the group
            in_arm &= m.geom_group == COLLISION_GROUP
        scene = self.scene_at_start
        obstacles = [m.geom(f"{OBSTACLE}{i}").id for i in range(len(scene.obstacles))]
        self._fixtures = [m.geom(name).id for name in fixture_names(scene.fixtures)]
        arm_geoms = np.flatnonzero(in_arm)
        above = np.zeros(m.nbody, dtype=int)  # how many of the arm's joints move each body
        for name in arm.joint_names:
            above[m.joint(name).bodyid] += 1
        for body in range(1, m.nbody):  # parents have smaller indices
            above[body] += above[m.body_parentid[body]]
        links = above[m.geom_bodyid[arm_geoms]].tolist()
        self._gauge = ClearanceGauge(m, arm_geoms.tolist(), obstacles, self._fixtures, links)
        self.data.qpos[:] = arm.posture(m, arm.home)
        mujoco.mj_forward(m, self.data)
        self._gauge.ignore_present_self_contacts(self.data)
        count = len(scene.obstacles)
        self._mocap = np.array([m.body_mocapid[m.body(f"{OBSTACLE}{i}").id] for i in range(count)], dtype=int)
        self._moving = isinstance(self._source, MovingScene) or any(obstacle.moves for obstacle in scene.obstacles)

    def reset(self, q: ArrayLike | None = None) -> ArmState:
        """Reset the world to time 0, with the arm at rest at ``q``.

        Args:
            q: joint angles, shape (n_joints,) [rad]; None: the angles given to the constructor.

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
        mujoco.mj_forward(self.model, self.data)
        self._drives.hold()
        return self.state()

    def show(self, q: ArrayLike, time: float) -> ArmState:
        """Place the arm at rest at ``q`` and all obstacles where they are at ``time``, without a simulated motion.

        A second robot with the same scene can thereby show the state of a simulation that runs in another process, for
        example to a depth camera. All other bodies stay where they are.

        Args:
            q: joint angles, shape (n_joints,) [rad]. They are not checked against the limits, because a simulated joint
                can be slightly beyond its limit.
            time: time since the last reset [s].

        Returns:
            The state.

        Raises:
            InputError: when ``q`` has a wrong shape, or a number is not finite.
        """
        place = finite_vector(q, self.arm.n_joints, "show: q", "rad")
        self.data.time = finite_number(time, "show: time", "s")
        self._drives.place(place)
        self._begin(place)
        self._move_obstacles()
        mujoco.mj_kinematics(self.model, self.data)
        return self.state()

    @property
    def time(self) -> float:
        """Time since the last reset [s]."""
        return float(self.data.time)

    @property
    def scene(self) -> Scene:
        """The true current scene, with true velocities; ``stamp`` is its time on the scene's clock."""
        return self._source.at(self.scene_at_start.stamp + self.time)

    @property
    def tool_to_base(self) -> Pose:
        """True pose of the tool in the simulator."""
        matrix = self.data.site_xmat[self._tool].reshape(3, 3)
        return Pose(self.data.site_xpos[self._tool], matrix_to_quaternion(matrix))

    def state(self) -> ArmState:
        """Return the measured joint angles, velocities and drive torques, and the time since the last reset."""
        return ArmState(self._drives.q, self._drives.velocity, self._drives.torque, self.time)

    def grasp(self, opening: float) -> None:
        """Begin to move the fingers of a mounted gripper; see :meth:`~imitarm.robots.robot.Robot.grasp`.

        The commanded opening changes at 0.12 m/s. The fingers' servo applies its stiffness times the remaining
        distance, but at most the force given in the gripper's file. :meth:`reset` cancels the command.
        """
        self._drives.grasp(opening)

    @property
    def opening(self) -> float:
        """Opening between the gripper's fingers [m]; nan without a gripper."""
        return self._drives.opening

    @property
    def widest_opening(self) -> float:
        """Largest opening of the gripper [m]; nan without a gripper."""
        return self._drives.widest_opening

    def clearance(self) -> float:
        """Return the smallest distance from the arm or its tool to an obstacle [m].

        The distance is measured between the simulator's geoms. The distance is negative when geoms overlap, and inf
        without obstacles. While two links of the arm touch each other, the result is negative; its magnitude is at
        least the depth of their contact.
        """
        return self._gauge.measure(self.data)[0]

    def report(self) -> Mapping[str, Any]:
        """Return ``contacts`` and ``contact_steps`` since the last reset."""
        return {"contacts": frozenset(self.contacts), "contact_steps": self.contact_steps}

    def nearest_pair(self) -> tuple[str, str] | None:
        """Return the names of the two nearest geoms (the arm's geom first); None if no clearance was measured."""
        pair = self._gauge.measure(self.data)[1]
        return None if pair is None else self._names(pair)

    def _names(self, pair: tuple[int, int]) -> tuple[str, str]:
        second = self.model.geom(pair[1]).name
        if second.startswith(OBSTACLE):
            name = self.scene_at_start.name_of(int(second.removeprefix(OBSTACLE)))
        elif pair[1] in self._fixtures:
            name = second
        else:
            name = self._arm_geom(pair[1])
        return self._arm_geom(pair[0]), name

    def _arm_geom(self, geom: int) -> str:
        return str(self.model.geom(geom).name or self.model.body(self.model.geom_bodyid[geom]).name)

    def _send(self, previous: Array, velocity: Array, dt: float) -> None:
        n = self._steps(dt)
        step = self._drives.servo if self.control == "position" else self._drives.computed_torque
        acceleration = (velocity - previous) / dt
        q_d, v_d, h = self.set_point.copy(), previous.copy(), dt / n
        for _ in range(n):
            step(q_d, v_d, acceleration)
            self._after_step()
            q_d += h * (v_d + 0.5 * h * acceleration)
            v_d += h * acceleration
        mujoco.mj_kinematics(self.model, self.data)  # a step leaves the bodies where it found them

    def guide(self, wrench: ArrayLike, dt: float) -> ArmState:
        """Let a hand guide the arm by its tool for ``dt`` seconds while the drives compensate the arm's weight.

        Manufacturers of robot arms call this mode zero gravity or free drive. The drives also compensate most of the
        dry friction and add a little damping, see :meth:`Drives.free`. Afterwards, the set-point is the posture that
        the arm has reached.

        Args:
            wrench: force [N] then torque [N m] of the hand on the tool's tip, in the base frame, shape (6,).
            dt: duration [s].

        Returns:
            The measured state after ``dt``.

        Raises:
            InputError: when ``wrench`` is not six finite numbers.
        """
        pull = finite_vector(wrench, 6, "guide: wrench", "N, N m")
        for _ in range(self._steps(dt)):
            self._drives.free(pull[:3], pull[3:], self._tool)
            self._after_step()
        mujoco.mj_kinematics(self.model, self.data)
        state = self.state()
        self._begin(state.q)
        return state

    def _steps(self, dt: float) -> int:
        n = round(finite_number(dt, "dt", "s") / self.model.opt.timestep)
        if n < 1 or abs(n * self.model.opt.timestep - dt) > 1e-9:
            raise InputError(f"dt must be a multiple of the timestep {self.model.opt.timestep:g} s, got {dt!r}")
        return n

    def _after_step(self) -> None:
        """Record contacts and move the obstacles."""
        touching = self._gauge.touching(self.data)
        if touching:
            self.contact_steps += 1
            self.contacts.update(self._names(pair) for pair in touching)
        self._move_obstacles()

    def _move_obstacles(self) -> None:
        if self._moving:
            positions, quaternions = self._source.poses(self.scene_at_start.stamp + self.time)
            self.data.mocap_pos[self._mocap] = positions
            self.data.mocap_quat[self._mocap] = quaternions


def _slice(indices: NDArray[np.int32]) -> slice | NDArray[np.int32]:
    """Return successive indices as a slice, which numpy reads several times as fast as an array of indices."""
    first, last = int(indices[0]), int(indices[-1])
    return slice(first, last + 1) if np.array_equal(indices, np.arange(first, last + 1)) else indices


def _checked_start(arm: ArmModel, q: ArrayLike) -> Array:
    start = finite_vector(q, arm.n_joints, "SimulatedRobot: q", "rad").copy()
    arm.check_limits(start)
    return start


def add_drives(spec: mujoco.MjSpec, arm: ArmModel) -> None:
    """Replace the arm's actuators by one drive for each joint, with the rated torque.

    Args:
        spec: world that contains the arm; changed in place.
        arm: arm whose joints and rated torques are used.
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
    """One drive for each joint; ``servo``, ``computed_torque`` and ``free`` each make one physics step.

    The set-point has the position ``q_d``, the velocity ``v_d`` and the acceleration ``a_d``. In the equations, ``M``
    is the inertia matrix, including the inertia of the drives' rotors. ``h`` are the torques of gravity and Coriolis
    forces, and ``f`` the torques of the joints' viscous and dry friction at ``v_d``. The rated torques are never
    exceeded.

    Args:
        model: the compiled world, with the drives that :func:`add_drives` has added.
        data: state of this world.
        arm: arm whose joints are driven.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, arm: ArmModel) -> None:
        self._model, self._data = model, data
        joints = [model.joint(name).id for name in arm.joint_names]
        self._qpos, self._dof = _slice(model.jnt_qposadr[joints]), _slice(model.jnt_dofadr[joints])
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
        return np.array(self._data.qpos[self._qpos])

    @property
    def velocity(self) -> Array:
        """Joint velocities, shape (n,) [rad/s]."""
        return np.array(self._data.qvel[self._dof])

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
        """Largest opening of the gripper [m]; nan without a gripper."""
        return float("nan") if self._gripper is None else float(self._model.actuator_ctrlrange[self._gripper, 1])

    def place(self, q: Array) -> None:
        """Place the joints at the angles ``q`` (n,) [rad], at rest."""
        self._data.qpos[self._qpos] = q
        self._data.qvel[self._dof] = 0.0

    def grasp(self, opening: float) -> None:
        """Move the gripper to ``opening`` [m] at 0.12 m/s; its servo applies at most its rated force.

        Raises:
            InputError: when there is no gripper, or the opening is out of its range.
        """
        if self._gripper is None:
            raise InputError(f"grasp: this world has no gripper (no actuator {GRIPPER!r}); load the arm with a gripper")
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
        """Simulate one step in which a hand pulls at a site and the drives let the arm move freely.

        The torques are ``tau = h + 0.7 c sign(v) - D v``, where ``v`` is the joint velocity. The drives compensate the
        torques ``h`` of gravity and Coriolis forces and 70 % of the dry friction ``c``, and add the damping ``D``.

        Args:
            force: force of the hand, in the base frame, shape (3,) [N].
            torque: torque of the hand, shape (3,) [N m].
            site: id of the MuJoCo site at which the hand pulls.
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
        """Prepare a step: switch the drives to the right mode and advance the set-point of the fingers."""
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
