"""ArmModel: kinematics and dynamics of a robot arm.

ArmState: joint positions, velocities and torques of an arm at one time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm_file import ArmFile, compiled, read_arm, without_geoms
from imitarm.kinematics.arm_kinematics import ArmKinematics
from imitarm.kinematics.joint_chain import JointChain
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_multiply, rotate
from imitarm.kinematics.spheres import SphereCover
from imitarm.validation import finite_number, finite_vector, flag, instance, text

Array = NDArray[np.float64]

_FLOAT64 = np.dtype(np.float64)


@dataclass(frozen=True, eq=False)
class ArmState:
    """Measured state of an arm at one time.

    Attributes:
        q: joint positions, shape (n,) [rad].
        velocity: joint velocities, shape (n,) [rad/s].
        torque: torques of the joints' drives, shape (n,) [N m].
        time: time of the measurement [s].

    Raises:
        InputError: if a number is not finite or the lengths differ.
    """

    q: Array
    velocity: Array
    torque: Array
    time: float

    def __post_init__(self) -> None:
        q, velocity, torque, time = self.q, self.velocity, self.torque, self.time
        if (  # the usual case is decided here: robots make a state in every control step
            type(q) is type(velocity) is type(torque) is np.ndarray
            and q.dtype is velocity.dtype is torque.dtype is _FLOAT64
            and type(time) is float
            and len(q.shape) == 1
            and q.shape == velocity.shape == torque.shape
            and math.isfinite(sum(q.tolist()) + sum(velocity.tolist()) + sum(torque.tolist()) + time)
        ):
            return
        n = len(self.q) if isinstance(self.q, np.ndarray | list | tuple) else 0
        for name, unit in (("q", "rad"), ("velocity", "rad/s"), ("torque", "N m")):
            object.__setattr__(self, name, finite_vector(getattr(self, name), n, f"ArmState: {name}", unit))
        object.__setattr__(self, "time", finite_number(self.time, "ArmState: time", "s"))


class ArmModel(ArmKinematics):
    r"""A robot arm, with or without a tool: kinematics, dynamics and limits.

    A model can't be changed after it is built.

    The links and the tool of the arm obey the following equation of motion (:meth:`inverse_dynamics`):

    .. math:: M(q) \ddot q + C(q, \dot q) \dot q + g(q) = \tau

    Here, :math:`M` is the rigid-body inertia, :math:`C` contains the Coriolis and centrifugal terms, :math:`g` is
    gravity and :math:`\tau` are the joint torques. The equation leaves out the rotor inertia (``armature``), the
    viscous damping and the dry friction of the joints. A simulated arm includes these effects; their values are in
    ``spec()``.

    All poses are in the base frame, whose origin is the origin of the robot's file. In Jacobians, the three rows of the
    linear velocity come before the three rows of the angular velocity. All methods take one posture ``q`` of shape
    (n_joints,) and raise :class:`InputError` if its shape is wrong or a number is not finite. Several threads can use
    one model.

    Attributes:
        name: for example ``"sawyer"``.
        joint_names: names of the joints from base to flange, without the joints of a gripper.
        n_joints: number of these joints.
        lower: lower limits of the joint positions, shape (n_joints,) [rad]; -inf where there is no limit.
        upper: upper limits of the joint positions, shape (n_joints,) [rad]; inf where there is no limit.
        max_velocity: largest joint speeds, shape (n_joints,) [rad/s].
        max_acceleration: largest joint accelerations, shape (n_joints,) [rad/s^2].
        max_torque: largest joint torques, shape (n_joints,) [N m]; inf where the file has no limit.
        home: posture in which the arm starts by default, shape (n_joints,) [rad].
        tool_to_flange: pose of the tool's tip in the flange frame; the identity without a tool.
        tool_radius: radius of the cylinder about the tool's axis that contains the tool's head [m]; 0 without a tool.
        sphere_bodies: name of the body of each sphere of :meth:`collision_spheres`.
        cover: object that computes the spheres of :meth:`collision_spheres`, and contains their radii and links.
        chain: object that computes kinematics and dynamics for many postures at once.
        landmarks: shoulder, elbow and wrist, from the sites ``shoulder``, ``elbow`` and ``wrist`` in the file; None if
            a site is missing.
        notes: assumptions about values that the file does not define, and joints that are not part of the arm.
    """

    lower: Array
    upper: Array
    max_velocity: Array
    max_acceleration: Array
    max_torque: Array
    home: Array
    tool_to_flange: Pose
    tool_radius: float
    sphere_bodies: tuple[str, ...]
    cover: SphereCover
    chain: JointChain
    notes: tuple[str, ...]

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        tool: str | Path | None = None,
        flange: str | None = None,
        package_path: str | Path | Sequence[str | Path] = (),
        discard_meshes: bool = False,
    ) -> ArmModel:
        """Load a packaged arm, or any MJCF or URDF file.

        Limits come from the file. For limits that the file does not define, the model assumes 2 rad/s and 10 rad/s^2
        for hinges, 0.2 m/s and 1 m/s^2 for slides, and unlimited torque; ``notes`` lists these assumptions. MJCF has no
        standard element for speed and acceleration limits. Write speed limits as ``<custom><numeric name="max_velocity"
        data="..."/></custom>``, with one value for each joint, and acceleration limits as ``max_acceleration`` in the
        same way.

        The posture ``home`` comes from the file's keyframe ``home``, or else from its first keyframe. If the file has
        no keyframe, ``home`` is the middle of the joints' ranges, provided that this posture is not singular and keeps
        the links at least 20 mm apart. If this posture does not meet the two criteria, ``home`` is the posture that
        meets them best among 1024 samples.

        Args:
            name_or_path: ``"sawyer"``, ``"panda"`` or a path.
            tool: ``"gripper"``, ``"brush"``, the path of an MJCF file with a site ``tool`` at its tip, or None.
            flange: name of the body or site that is the flange. If None, the flange is the site named ``flange``;
                without such a site, the flange is the last link of the arm before jaws and fingers.
            package_path: one or more folders to search for meshes and ROS packages.
            discard_meshes: whether to leave out all meshes. If True, contact and :meth:`collision_spheres` use only
                primitive shapes.

        Raises:
            UnknownNameError: if an arm, tool or flange of that name is not known.
            FileFormatError: if a file can't be read as a robot.
            InputError: if the file contains no arm, or more than one.
        """
        for what, value in (("robot", name_or_path), ("tool", tool)):
            if not isinstance(value, str | Path) and (value is not None or what == "robot"):
                raise InputError(f"{what} must be a name or a path, got {value!r}")
        folders = (package_path,) if isinstance(package_path, str | Path) else package_path
        if not isinstance(folders, Sequence) or not all(isinstance(folder, str | Path) for folder in folders):
            raise InputError(f"package_path must be one folder or several folders, got {package_path!r}")
        options = {
            "tool": tool,
            "flange": None if flange is None else text(flange, "flange"),
            "package_path": tuple(folders),
            "discard_meshes": flag(discard_meshes, "discard_meshes"),
        }
        return cls(read_arm(name_or_path, **options), (name_or_path, options))  # type: ignore[arg-type]

    def __init__(self, file: ArmFile, source: tuple[str | Path, dict[str, Any]]) -> None:
        """Build a model from the result of :func:`~imitarm.kinematics.arm_file.read_arm`.

        Users call :meth:`load` instead.
        """
        whole = compiled(file.spec, file.name)
        model = _working_model(file, whole)
        posture = np.array(model.qpos0)
        for name, position in file.home.items():
            joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            if joint >= 0:
                posture[model.jnt_qposadr[joint]] = position
        super().__init__(file.name, file.joints, model, posture)
        joints = np.array([model.joint(name).id for name in file.joints])
        limited = model.jnt_limited[joints].astype(bool)
        self._home = dict(file.home)  # of all joints, fingers too
        self._source, self._spec, self._mass_faults, self.notes = source, file.spec, file.mass_faults, file.notes
        self.lower = _frozen(np.where(limited, model.jnt_range[joints, 0], -np.inf))
        self.upper = _frozen(np.where(limited, model.jnt_range[joints, 1], np.inf))
        self.max_velocity = _frozen(file.max_velocity)
        self.max_acceleration = _frozen(file.max_acceleration)
        self.max_torque = _frozen(file.max_torque)
        self.home = _frozen(posture[self._qpos])
        self.tool_radius = file.tool_radius
        self.tool_to_flange = Pose.identity()
        if self.has_tool:
            self.tool_to_flange = self.forward_kinematics(self.home).inverse() @ self.tool_pose(self.home)
        self.cover = SphereCover(whole, model, file.joints)
        self.sphere_bodies = self.cover.bodies
        self.chain = JointChain(model, self.at(self.home).data, self.cover, self.home, self._tool)
        self._sealed = True

    def __setattr__(self, name: str, value: object) -> None:
        if getattr(self, "_sealed", False):
            raise AttributeError(f"an ArmModel can't be changed; load another model instead of setting {name!r}")
        object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        path, options = self._source
        return partial(ArmModel.load, path, **options), ()

    def __repr__(self) -> str:
        path, options = self._source
        return f"ArmModel.load({str(path)!r}, tool={options['tool']!r})"

    def spec(self) -> mujoco.MjSpec:
        """Return a new MuJoCo spec of the arm and its tool, for building a simulated world; the base is at the origin.

        Names are taken from the file; names of the tool begin with ``"tool/"``, except the site ``"tool"`` at its tip.
        The flange is the site ``"flange"``. Geoms of group 3 are used for contact, and all other geoms only for
        drawing. If a file does not separate its geoms in this way, the model changes their groups. The arm's joints
        have no actuators, so a world must add the actuators that it needs. The attribute ``actuatorfrcrange`` of each
        joint contains its torque limit. A gripper has one actuator, ``"tool/opening"``, a position servo of its opening
        [m]. The spec has no keyframes; :meth:`posture` gives the joint positions of a posture.
        """
        return self._spec.copy()

    def posture(self, model: mujoco.MjModel, q: ArrayLike | None = None, *, prefix: str = "") -> Array:
        """Return the joint positions (MuJoCo's ``qpos``) of a world in which this arm is at ``q``.

        Args:
            model: a compiled world.
            q: joint positions, shape (n_joints,) [rad]; None: ``home``.
            prefix: the prefix of the arm's names in the world.

        Returns:
            Joint positions of the world, shape (model.nq,). Joints that belong neither to the arm nor to its tool are
            at ``model.qpos0``.

        Raises:
            InputError: if the world does not contain this arm.
        """
        instance(model, mujoco.MjModel, "model")
        qpos = np.array(model.qpos0)
        values = self.home if q is None else self._checked(q, "q")
        positions = self._home | dict(zip(self.joint_names, values.tolist(), strict=True))
        for name, position in positions.items():
            joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, text(prefix, "prefix") + name)
            if joint < 0:
                raise InputError(f"the world has no joint {prefix + name!r}, so it does not contain {self.name}")
            qpos[model.jnt_qposadr[joint]] = position
        return qpos

    def collision_spheres(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return spheres that together cover all moving collision shapes of arm and tool.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            centers (m, 3) [m] in the base frame and radii (m,) [m].
        """
        return self.sphere_centers(q).copy(), self.cover.radii

    def sphere_centers(self, q: ArrayLike) -> Array:
        """Return the centers of :meth:`collision_spheres`, shape (m, 3) [m]; they are computed once for each posture.

        Do not change the array. It is valid until a method is called with another posture.
        """
        memory = self.at(q)
        if memory.centers is None:
            memory.centers = self.cover.centers(memory.data)
        return memory.centers

    @property
    def tool_spheres(self) -> Array:
        """Spheres that cover every part that moves rigidly with the tool: the last link, the hand and the fingers.

        Each row is x, y, z and radius in the tool's frame, shape (m, 4) [m]. A policy keeps the required clearance for
        these spheres.
        """
        centers, radii = self.collision_spheres(self.home)
        rigid = self.cover.follows_last_joint
        return np.column_stack([self.tool_pose(self.home).inverse().apply(centers[rigid]), radii[rigid]])

    def sphere_jacobians(self, q: ArrayLike) -> Array:
        """Return the Jacobians of the centers of :meth:`collision_spheres`, shape (m, 3, n_joints) [m/rad]."""
        return self.cover.jacobians(self.at(q).data)

    @property
    def has_masses(self) -> bool:
        """Whether every moving link has a mass and an inertia, which torques and simulation need."""
        return not self._mass_faults

    @property
    def has_dynamics(self) -> bool:
        """Whether every moving link has a mass and an inertia, which torques and simulation need."""
        return not self._mass_faults

    def check_dynamics(self) -> None:
        """Raise an error if a moving link lacks its mass or inertia, which torques and simulation need.

        Raises:
            InputError: if a link lacks its mass or inertia; the message names these links and their lines in the file.
        """
        if self._mass_faults:
            raise InputError(
                f"{self.name}: {'; '.join(self._mass_faults)}. Torques and simulation need the mass and inertia of "
                "every moving link (kinematics does not); add them to the file (<inertial>)"
            )

    def gravity_torque(self, q: ArrayLike) -> Array:
        """Return the torques g(q) that hold arm and tool against gravity, shape (n_joints,) [N m].

        Raises:
            InputError: if a link has no usable mass; see :meth:`check_dynamics`.
        """
        return self._recursive_newton_euler(q, None, None)

    def inverse_dynamics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the joint torques that a motion requires, by the recursive Newton-Euler algorithm.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            qd: joint velocities, shape (n_joints,) [rad/s].
            qdd: joint accelerations, shape (n_joints,) [rad/s^2].

        Returns:
            Joint torques, shape (n_joints,) [N m]. They do not include rotor inertia, damping and friction of the
            joints.

        Raises:
            InputError: if a link has no usable mass; see :meth:`check_dynamics`.
        """
        return self._recursive_newton_euler(q, self._checked(qd, "qd"), self._checked(qdd, "qdd"))

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the rigid-body inertia M(q), shape (n_joints, n_joints) [kg m^2], without rotor inertia.

        Raises:
            InputError: if a link has no usable mass; see :meth:`check_dynamics`.
        """
        self.check_dynamics()
        memory = self.at(q)
        full = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_crb(self._model, memory.data)
        mujoco.mj_fullM(self._model, memory.data, full)
        return full[self._dofs][:, self._dofs].copy()

    def check_limits(self, q: ArrayLike, *, tolerance: float = 1e-6) -> None:
        """Check that ``q`` is within the limits of the joints.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            tolerance: accepted distance outside a limit [rad].

        Raises:
            InputError: if a joint is outside its limits; the message names the first such joint, its position and its
                limits.
        """
        values, slack = self._checked(q, "q"), finite_number(tolerance, "tolerance", "rad", at_least=0.0)
        outside = (values < self.lower - slack) | (values > self.upper + slack)
        if outside.any():
            i = int(np.argmax(outside))
            raise InputError(
                f"joint {self.joint_names[i]} at {values[i]:.4f} rad is outside its limits "
                f"[{self.lower[i]:.4f}, {self.upper[i]:.4f}]"
            )

    def _recursive_newton_euler(self, q: ArrayLike, velocity: Array | None, acceleration: Array | None) -> Array:
        self.check_dynamics()
        memory = self.at(q)
        data = memory.data
        data.qvel[self._dofs] = 0.0 if velocity is None else velocity
        data.qacc[self._dofs] = 0.0 if acceleration is None else acceleration
        mujoco.mj_comVel(self._model, data)
        mujoco.mj_rne(self._model, data, acceleration is not None, memory.force)
        return memory.force[self._dofs].copy()


def _working_model(file: ArmFile, whole: mujoco.MjModel) -> mujoco.MjModel:
    """Return the MuJoCo model that computes the kinematics and dynamics.

    Shapes without mass are left out, which makes the kinematics about three times as fast. Joints that are not part of
    the arm, such as those of fingers, are fixed at their position in ``file.home``, so the Jacobians have columns only
    for the arm's joints. The model has no rotor inertia.
    """
    spec = without_geoms(file.spec, _massless)
    for part in (*spec.actuators, *spec.equalities, *spec.tendons, *spec.sensors):
        spec.delete(part)
    carriers = {joint.parent.name for joint in spec.joints if joint.name in file.joints}
    fixed = [joint for joint in spec.joints if joint.parent.name and joint.parent.name not in carriers]
    bodies = {joint.parent.name for joint in fixed}
    for joint in fixed:
        spec.delete(joint)
    model, data = compiled(spec, file.name), mujoco.MjData(whole)
    for name, position in file.home.items():
        data.qpos[whole.jnt_qposadr[whole.joint(name).id]] = position
    mujoco.mj_kinematics(whole, data)
    for name in bodies:
        body = model.body(name).id
        parent = model.body_parentid[body]
        back = quaternion_conjugate(data.xquat[parent])
        model.body_pos[body] = rotate(back, data.xpos[body] - data.xpos[parent])
        model.body_quat[body] = quaternion_multiply(back, data.xquat[body])
    model.dof_armature[:] = 0.0
    return model


def _massless(geom: mujoco.MjsGeom) -> bool:
    """Return whether ``geom`` has no mass, so that it can be left out (an unspecified mass is nan)."""
    return bool(geom.density == 0.0 and not geom.mass > 0.0)


def _frozen(values: Array) -> Array:
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array
