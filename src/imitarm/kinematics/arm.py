"""ArmModel: how a robot arm moves and what it weighs; ArmState: what it does at one instant."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm_file import ArmFile, quiet, read_arm
from imitarm.kinematics.arm_limits import compiled
from imitarm.kinematics.arm_memory import ArmMemories, ArmMemory, columns
from imitarm.kinematics.landmarks import Landmarks
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.spheres import SphereCover

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ArmState:
    """What an arm does at one instant.

    Attributes:
        q: joint positions, shape (n,) [rad].
        velocity: joint velocities, shape (n,) [rad/s].
        torque: torques of the joints' drives, shape (n,) [N m].
        time: when [s].
    """

    q: Array
    velocity: Array
    torque: Array
    time: float


class ArmModel:
    r"""A robot arm, with or without a tool: kinematics, dynamics and limits. It never changes once built.

    The equation of motion of the arm's links and tool, which :meth:`inverse_dynamics` evaluates, is

    .. math:: M(q) \ddot q + C(q, \dot q) \dot q + g(q) = \tau

    with the rigid-body inertia :math:`M` alone. Rotor inertia (``armature``), viscous damping and dry friction of
    the joints, which a simulated arm also has, are no part of it; their values are in ``spec()``.

    All poses are in the base frame, whose origin is that of the file. Jacobians have the linear rows first. Methods
    take one posture ``q`` of shape (n_joints,) and raise :class:`InputError` when its shape is wrong or a number
    is not finite. One model can be used by several threads.

    Attributes:
        name: for example ``"sawyer"``.
        joint_names: from base to flange; joints of a gripper are not among them.
        lower: least joint positions, shape (n_joints,) [rad]; -inf where there is no limit.
        upper: largest joint positions, shape (n_joints,) [rad].
        max_velocity: shape (n_joints,) [rad/s].
        max_acceleration: shape (n_joints,) [rad/s^2].
        max_torque: shape (n_joints,) [N m]; inf where the file names none.
        home: a comfortable posture, shape (n_joints,) [rad].
        tool_to_flange: where the tool's tip is; the identity when there is no tool.
        tool_radius: radius of the cylinder about the tool's axis that holds the tool's head [m]; 0 without a tool.
        sphere_bodies: for each sphere of :meth:`collision_spheres` the name of its body.
        cover: the spheres themselves.
        landmarks: shoulder, elbow and wrist, from sites of these names in the file; None when it has none.
    """

    name: str
    joint_names: tuple[str, ...]
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
    landmarks: Landmarks | None

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        tool: str | Path | None = None,
        flange: str | None = None,
        discard_meshes: bool = False,
    ) -> ArmModel:
        """Load a packaged arm, or any MJCF or URDF file.

        Limits come from the file. What a format has no place for is looked up in MJCF elements
        ``<custom><numeric name="max_velocity" data="..."/></custom>`` (and ``max_acceleration``) and in a URDF's
        ``<limit velocity= effort=>``; where nothing is said, 2 rad/s and 10 rad/s^2 are taken (0.2 m/s and 1 m/s^2
        for slides), and no limit of torque. ``home`` is the keyframe of that name, else the first keyframe, else the
        middle of the joints' ranges.

        Args:
            name_or_path: ``"sawyer"``, ``"panda"`` or a path.
            tool: ``"gripper"``, ``"brush"``, the path of an MJCF file with a site ``tool`` at its tip, or None.
            flange: name of the body or site that is the flange; None: a site named ``flange``, else the last body of
                the longest chain of joints (where two equally long ones part, as fingers do, it ends).
            discard_meshes: leave out all meshes, for a file whose meshes are elsewhere; links keep only their
                primitive shapes, so contact and :meth:`collision_spheres` see no more than those.

        Raises:
            UnknownNameError: when an arm, tool or flange of that name is not known.
            FileFormatError: when a file can't be read as a robot.
            InputError: when there is no joint between the base and the flange, or one that is neither hinge nor slide.
        """
        file = read_arm(name_or_path, tool, flange, discard_meshes)
        kept = {"tool": tool, "flange": flange, "discard_meshes": discard_meshes}
        return cls(file, (name_or_path, kept))

    def __init__(self, file: ArmFile, source: tuple[str | Path, dict[str, Any]]) -> None:
        """Build from what :func:`~imitarm.kinematics.arm_file.read_arm` returned; use :meth:`load` instead."""
        whole = compiled(file.spec, file.name)
        # Shapes without mass are left out of the working model: its kinematics then takes a third of the time.
        model = compiled(quiet(file.spec, _massless), file.name)
        model.dof_armature[:] = 0.0
        joints = [model.joint(name).id for name in file.joints]
        limited = model.jnt_limited[joints].astype(bool)
        posture = np.array(model.qpos0)
        for name, position in file.home.items():
            posture[model.jnt_qposadr[model.joint(name).id]] = position
        self._source, self._spec, self._model = source, file.spec, model
        self._qpos = columns(model.jnt_qposadr[joints])
        self._dofs = columns(model.jnt_dofadr[joints])
        self.landmarks = Landmarks.find(model, np.array(joints))
        marked = () if self.landmarks is None else self.landmarks.sites
        self._memories = ArmMemories(model, posture, self._qpos, self._dofs, marked)
        self._joints = np.array(joints)
        self._flange = model.site("flange").id
        names = [model.site(i).name for i in range(model.nsite)]
        self._tool = names.index("tool") if "tool" in names else self._flange

        self.name, self.joint_names = file.name, file.joints
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
        self.cover = SphereCover(whole, self._joints)
        self.sphere_bodies = self.cover.bodies
        self._sealed = True

    def __setattr__(self, name: str, value: object) -> None:
        if getattr(self, "_sealed", False):
            raise AttributeError(f"ArmModel never changes; load another one instead of setting {name!r}")
        object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        path, options = self._source
        return partial(ArmModel.load, path, **options), ()

    def __repr__(self) -> str:
        path, options = self._source
        return f"ArmModel.load({str(path)!r}, tool={options['tool']!r})"

    @property
    def n_joints(self) -> int:
        """Number of joints from base to flange."""
        return len(self.joint_names)

    @property
    def has_tool(self) -> bool:
        """Whether a tool is mounted, so that ``tool_pose`` differs from ``forward_kinematics``."""
        return self._tool != self._flange

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh copy of the arm and its tool, for composing worlds; the base stands at the origin.

        Names are those of the file; those of the tool begin with ``"tool/"``, except the site ``"tool"`` at its tip.
        The flange is the site ``"flange"``. Geoms of group 3 count for contact, all others are looks (a
        file that does not part the two is put in order so). The arm's
        joints have no actuators, so that a world adds the ones it needs (joints carry their torque limit as
        ``actuatorfrcrange``); a gripper has one, ``"tool/opening"``, a position servo of its opening [m].
        There are no keyframes: take :meth:`posture`.
        """
        return self._spec.copy()

    def posture(self, model: mujoco.MjModel, q: ArrayLike | None = None, *, prefix: str = "") -> Array:
        """Return the whole ``qpos`` of a world that holds this arm: the arm at ``q``, the rest as the world has it.

        Args:
            model: a compiled world.
            q: joint positions, shape (n_joints,) [rad]; None: ``home``.
            prefix: what the world has put before the arm's names.

        Returns:
            shape (model.nq,).
        """
        qpos = np.array(model.qpos0)
        mine, home = self._model, self._memories.mine.data.qpos
        for joint in range(mine.njnt):  # fingers too
            address = model.jnt_qposadr[model.joint(prefix + mine.joint(joint).name).id]
            qpos[address] = home[mine.jnt_qposadr[joint]]
        values = self.home if q is None else self._checked(q, "q")
        for name, value in zip(self.joint_names, values, strict=True):
            qpos[model.jnt_qposadr[model.joint(prefix + name).id]] = value
        return qpos

    def at(self, q: ArrayLike) -> ArmMemory:
        """Return this thread's working memory with kinematics at ``q``, for loops that ask for much of one posture.

        It is computed only when the posture is a new one, and holds until the next is asked for.
        """
        memory = self._memories.mine
        memory.move_to(self._checked(q, "q"))
        return memory

    def site(self, frame: str) -> int:
        """Return the index of the site of a frame, ``"tool"`` or ``"flange"``, in :meth:`at`.

        Raises:
            UnknownNameError: when the frame is not known.
        """
        if frame not in {"tool", "flange"}:
            raise UnknownNameError.among("frame", frame, ("tool", "flange"))
        return self._tool if frame == "tool" else self._flange

    def forward_kinematics(self, q: ArrayLike) -> Pose:
        """Return the pose of the flange: ``flange_to_base``."""
        return self.at(q).site_pose(self._flange)

    def tool_pose(self, q: ArrayLike) -> Pose:
        """Return the pose of the tool's tip: ``tool_to_base``."""
        return self.at(q).site_pose(self._tool)

    def tool_path(self, joints: ArrayLike) -> tuple[Array, Array]:
        """Return the poses of the tool's tip for many postures.

        Args:
            joints: shape (n, n_joints) [rad].

        Returns:
            positions (n, 3) [m] and quaternions wxyz (n, 4).
        """
        poses = [self.at(q).site_pose(self._tool) for q in np.atleast_2d(np.asarray(joints, dtype=float))]
        positions = np.array([pose.position for pose in poses]).reshape(-1, 3)
        return positions, np.array([pose.quaternion for pose in poses]).reshape(-1, 4)

    def jacobian(self, q: ArrayLike) -> Array:
        """Return the Jacobian of the flange, shape (6, n_joints), linear rows first, in the base frame."""
        return np.array(self.at(q).site_jacobian(self._flange))

    def tool_jacobian(self, q: ArrayLike) -> Array:
        """Return the Jacobian of the tool's tip, shape (6, n_joints), linear rows first, in the base frame."""
        return np.array(self.at(q).site_jacobian(self._tool))

    def point_jacobian(self, q: ArrayLike, body: str, point: ArrayLike) -> Array:
        """Return the Jacobian of a point that moves with ``body``.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            body: name of the body, as in ``spec()``.
            point: where it is now in the base frame, shape (3,) [m].

        Returns:
            shape (3, n_joints) [m/rad].

        Raises:
            UnknownNameError: when there is no such body.
        """
        index = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, body)
        if index < 0:
            known = [self._model.body(i).name for i in range(1, self._model.nbody)]
            raise UnknownNameError.among(f"body of {self.name}:", body, known)
        scratch = self.at(q)
        position = np.asarray(point, dtype=float).reshape(3, 1)
        mujoco.mj_jac(self._model, scratch.data, scratch.linear, None, position, index)
        return np.array(scratch.linear[:, self._dofs])

    def sew_points(self, q: ArrayLike) -> Array:
        """Return shoulder, elbow and wrist in the base frame, shape (3, 3) [m].

        Raises:
            InputError: when the arm's file does not say where they are.
        """
        return np.array(self.at(q).sites[list(self.marked().sites)])

    def sew_jacobians(self, q: ArrayLike) -> Array:
        """Return the Jacobians of shoulder, elbow and wrist, shape (3, 3, n_joints) [m/rad]; as ``sew_points``."""
        self.marked()
        return np.array(self.at(q).marked_jacobians()).reshape(3, 3, -1)

    def marked(self) -> Landmarks:
        """Return ``landmarks``.

        Raises:
            InputError: when the arm's file does not say where shoulder, elbow and wrist are.
        """
        if self.landmarks is None:
            raise InputError(
                f"{self.name} does not say where its shoulder, elbow and wrist are: add sites named 'shoulder', "
                "'elbow' and 'wrist' to its MJCF file, on the links that these joints move"
            )
        return self.landmarks

    def collision_spheres(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return spheres that together cover all moving collision shapes of arm and tool.

        Args:
            q: joint positions, shape (n_joints,) [rad].

        Returns:
            centers (m, 3) [m] in the base frame and radii (m,) [m].
        """
        return self.cover.centers(self.at(q).data), self.cover.radii

    @property
    def tool_spheres(self) -> Array:
        """Spheres that hold all that moves rigidly with the tool: last link, hand, fingers as they are at home.

        Rows x y z r in the tool's frame, shape (m, 4) [m]; what a policy keeps clear of obstacles.
        """
        centers, radii = self.collision_spheres(self.home)
        rigid = self.cover.follows_last_joint
        return np.column_stack([self.tool_pose(self.home).inverse().apply(centers[rigid]), radii[rigid]])

    def sphere_jacobians(self, q: ArrayLike) -> Array:
        """Return the Jacobians of the spheres' centers, shape (m, 3, n_joints) [m/rad]."""
        return self.cover.jacobians(self.at(q).data)

    def gravity_torque(self, q: ArrayLike) -> Array:
        """Return the torques g(q) that hold arm and tool against gravity, shape (n_joints,) [N m]."""
        return self._recursive_newton_euler(self.at(q), None, None)

    def inverse_dynamics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the torques of a motion by the recursive Newton-Euler algorithm.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            qd: joint velocities, shape (n_joints,) [rad/s].
            qdd: joint accelerations, shape (n_joints,) [rad/s^2].

        Returns:
            shape (n_joints,) [N m]; without rotor inertia, damping and friction of the joints.
        """
        velocity, acceleration = self._checked(qd, "qd"), self._checked(qdd, "qdd")
        return self._recursive_newton_euler(self.at(q), velocity, acceleration)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the rigid-body inertia M(q), shape (n_joints, n_joints) [kg m^2], without rotor inertia."""
        scratch = self.at(q)
        full = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_crb(self._model, scratch.data)
        mujoco.mj_fullM(self._model, scratch.data, full)
        return full[self._dofs][:, self._dofs].copy()

    def check_limits(self, q: ArrayLike, *, tolerance: float = 1e-6) -> None:
        """Do nothing when ``q`` (n_joints,) is within the joints' limits.

        Raises:
            InputError: naming the first joint that is outside, its position and its limits.
        """
        values = self._checked(q, "q")
        outside = (values < self.lower - tolerance) | (values > self.upper + tolerance)
        if outside.any():
            i = int(np.argmax(outside))
            raise InputError(
                f"joint {self.joint_names[i]} at {values[i]:.4f} rad is outside its limits "
                f"[{self.lower[i]:.4f}, {self.upper[i]:.4f}]"
            )

    def _checked(self, values: ArrayLike, what: str) -> Array:
        array = np.asarray(values, dtype=float)
        if array.shape != self.lower.shape:
            raise InputError(f"{self.name}: {what} needs {self.n_joints} numbers, got shape {array.shape}")
        if not math.isfinite(sum(array.tolist())):
            raise InputError(f"{self.name}: {what} must be finite numbers, got {array}")
        return array

    def _recursive_newton_euler(self, scratch: ArmMemory, velocity: Array | None, acceleration: Array | None) -> Array:
        data = scratch.data
        data.qvel[self._dofs] = 0.0 if velocity is None else velocity
        data.qacc[self._dofs] = 0.0 if acceleration is None else acceleration
        mujoco.mj_comVel(self._model, data)
        mujoco.mj_rne(self._model, data, acceleration is not None, scratch.force)
        return scratch.force[self._dofs].copy()


def _massless(geom: mujoco.MjsGeom) -> bool:
    """Return whether leaving out ``geom`` changes no link's mass (a mass that was not given is nan)."""
    return bool(geom.density == 0.0 and not geom.mass > 0.0)


def _frozen(values: Array) -> Array:
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array
