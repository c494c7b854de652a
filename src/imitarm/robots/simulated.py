"""SimulatedRobot: the arm with its real inertias and limits in a MuJoCo world, driven at joint level."""

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
from imitarm.robots.clearance import ClearanceGauge
from imitarm.robots.drives import Drives, add_drives
from imitarm.robots.robot import Robot
from imitarm.robots.world import (
    COLLISION_GROUP,
    OBSTACLE,
    add_fixtures,
    add_obstacles,
    arm_world,
    fixture_names,
    standard_fixtures,
)
from imitarm.scene import MovingScene, Scene
from imitarm.scene.motion import Motion
from imitarm.validation import choice, finite_number, finite_vector, instance

Array = NDArray[np.float64]
Control = Literal["position", "torque"]


class SimulatedRobot(Robot):
    """An arm in a MuJoCo world, with drives that are limited to their rated torques.

    Both kinds of control follow the set-point ``q_d(t)`` and feed gravity, inertia and friction forward, see
    :class:`~imitarm.robots.drives.Drives`: ``"position"`` is a stiff servo at each joint, ``"torque"`` is computed
    torque and softer. Time advances only within :meth:`move` and :meth:`guide`, and the same commands always give the
    same motion.

    Attributes:
        model: the compiled world.
        data: its state; only to be read.
        scene_at_start: the scene at time 0.
        contacts: names of the pairs that have touched since the last reset: arm geom and obstacle, arm geom and
            fixture, or two geoms of different links of the arm (a self-contact).
        contact_steps: number of physics steps with such a contact.
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
            scene: its obstacles and fixtures become solid bodies; None for none. Its ``stamp`` is the time of the
                world's beginning. Without fixtures and ``world`` it gets a floor and a pedestal.
            motion: for some obstacles, by name or index, where they are at each time on the scene's clock: any function
                of time, or a recorded :class:`~imitarm.scene.motion.Track`. The others keep their velocities.
            world: a world that holds the arm, as :func:`~imitarm.robots.world.arm_world` returns it, with more
                furniture; it is copied. None: built from the scene.
            control: ``"position"`` or ``"torque"``.
            q: joint angles to start at, shape (n_joints,) [rad]; None for ``arm.home``.
            timestep: of the physics and of the drives [s].

        Raises:
            InputError: when ``control`` is unknown, ``timestep`` is not in (0, 0.002], ``q`` has a wrong shape or
                is beyond the joints' limits, or a link of the arm has no usable mass.
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
        """Find the arm's tool and geoms, the obstacles and what moves in the compiled world."""
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
        """Return the world to time 0, with the arm at rest at ``q``.

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
        mujoco.mj_forward(self.model, self.data)
        self._drives.hold()
        return self.state()

    @property
    def time(self) -> float:
        """Since the last reset [s]."""
        return float(self.data.time)

    @property
    def scene(self) -> Scene:
        """The scene as it truly is now, with true velocities; ``stamp`` is its time on the scene's clock."""
        return self._source.at(self.scene_at_start.stamp + self.time)

    @property
    def tool_to_base(self) -> Pose:
        """Pose of the tool as the simulator has it."""
        matrix = self.data.site_xmat[self._tool].reshape(3, 3)
        return Pose(self.data.site_xpos[self._tool], matrix_to_quaternion(matrix))

    def state(self) -> ArmState:
        """Return the measured joint angles, velocities and drive torques, and the time since the last reset."""
        return ArmState(self._drives.q.copy(), self._drives.velocity.copy(), self._drives.torque.copy(), self.time)

    def grasp(self, opening: float) -> None:
        """Begin to move the fingers of a mounted gripper; see :meth:`~imitarm.robots.robot.Robot.grasp`.

        The commanded opening changes at 0.12 m/s. The servo presses with its stiffness times the distance that is left,
        at most with the force that its file allows. :meth:`reset` cancels the command.
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

        It is measured between the simulator's geoms, negative when they overlap and inf without obstacles. While two
        links touch each other it is at most minus the depth of that contact.
        """
        return self._gauge.measure(self.data)[0]

    def report(self) -> Mapping[str, Any]:
        """Return ``contacts`` and ``contact_steps`` since the last reset."""
        return {"contacts": frozenset(self.contacts), "contact_steps": self.contact_steps}

    def nearest_pair(self) -> tuple[str, str] | None:
        """Return the names of the two geoms that have the :meth:`clearance`, the arm's first; None without any."""
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
        """Let a hand lead the arm by its tool for ``dt`` seconds while the drives carry the arm's weight.

        Makers of robot arms call this zero gravity or free drive. The drives also compensate most of the dry friction
        and damp a little, see :meth:`~imitarm.robots.drives.Drives.free`. Afterwards the set-point is where the arm is.

        Args:
            wrench: force [N] then torque [N m] of the hand on the tool's tip, in the base frame, shape (6,).
            dt: [s].

        Returns:
            The measured state after it.

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
        if self._moving:
            positions, quaternions = self._source.poses(self.scene_at_start.stamp + self.time)
            self.data.mocap_pos[self._mocap] = positions
            self.data.mocap_quat[self._mocap] = quaternions


def _checked_start(arm: ArmModel, q: ArrayLike) -> Array:
    start = finite_vector(q, arm.n_joints, "SimulatedRobot: q", "rad").copy()
    arm.check_limits(start)
    return start
