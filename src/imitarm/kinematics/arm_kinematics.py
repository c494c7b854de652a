"""ArmKinematics: poses and Jacobians of an arm, and the posture in which its tool has a given pose."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError, UnreachableError
from imitarm.kinematics.pose import Pose
from imitarm.validation import finite_array, finite_vector, instance, text, whole_number

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]
Columns = slice | NDArray[np.int32]

ROTATION_LENGTH = 0.3
"""[m/rad] A rotation of 1 rad is weighted like a displacement of 0.3 m."""

_FLOAT64 = np.dtype(np.float64)
_LANDMARKS = ("shoulder", "elbow", "wrist")  # sites that mark the three points
_TOLERANCE = 1e-7  # [m], weighted
_STEPS = 120
_LONGEST_STEP = 0.4  # [rad] of one joint in one step
_DRIFT = 0.05  # fraction of the distance to the reference posture that one step covers
_MOST_RESTARTS = 100_000


@dataclass(frozen=True)
class Landmarks:
    """Shoulder, elbow and wrist of an arm, defined by the sites of these names, and the joints at elbow and wrist.

    The site ``elbow`` is on the link that the elbow joint moves. The site ``wrist`` is on the link that is moved by the
    joint that bends the wrist.

    Attributes:
        sites: indices of the three sites.
        elbow: index, among the arm's joints, of the elbow joint.
        wrist: index, among the arm's joints, of the joint that bends the wrist.
        elbow_straight: position of the elbow joint at which the arm is stretched and singular [rad]. The value comes
            from the file's ``<custom><numeric name="elbow_straight" data="..."/></custom>``, or is 0 if the file has no
            such entry.
    """

    sites: tuple[int, int, int]
    elbow: int
    wrist: int
    elbow_straight: float

    @classmethod
    def find(cls, model: mujoco.MjModel, joints: NDArray[np.int_]) -> Landmarks | None:
        """Return the landmarks of a model whose arm has ``joints``; None if a site or joint is missing."""
        sites = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in _LANDMARKS]
        if min(sites) < 0:
            return None
        bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
        owners = [int(model.site_bodyid[site]) for site in sites]
        if owners[1] not in bodies or owners[2] not in bodies:
            return None
        numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "elbow_straight")
        straight = float(model.numeric_data[model.numeric_adr[numeric]]) if numeric >= 0 else 0.0
        return cls((sites[0], sites[1], sites[2]), bodies.index(owners[1]), bodies.index(owners[2]), straight)


class ArmMemory:
    """MuJoCo's working memory for one arm in one thread, with the kinematics of one posture.

    Attributes:
        data: MuJoCo's data, with the kinematics of the posture.
        jacobian: Jacobian of the last requested site, shape (6, nv), linear rows first.
        linear: first three rows of ``jacobian``.
        angular: last three rows of ``jacobian``.
        sites: positions of the sites in the base frame, shape (nsite, 3) [m].
        force: generalised forces, shape (nv,).
        centers: centres of the spheres that cover the arm, shape (m, 3) [m]; None until they are computed for the
            posture.
        posture: the joint positions as bytes.
        n_joints: number of the arm's joints.
        kept: arrays that compiled code reuses in every step, by name.
    """

    def __init__(
        self, model: mujoco.MjModel, home: Array, positions: Columns, joints: Columns, landmarks: tuple[int, ...]
    ) -> None:
        """Begin at ``home``.

        Args:
            model: the arm.
            home: positions of all joints, including fingers, shape (nq,).
            positions: indices of the arm's joints in qpos.
            joints: indices of the arm's joints in qvel.
            landmarks: sites for which :meth:`landmarks` returns positions and :meth:`landmark_jacobians` returns
                Jacobians.
        """
        self.data = mujoco.MjData(model)
        self.data.qpos[:] = home
        self.jacobian = np.zeros((6, model.nv))
        self.linear, self.angular = self.jacobian[:3], self.jacobian[3:]
        self.force = np.zeros(model.nv)
        self.centers: Array | None = None
        self.kept: dict[str, Any] = {}
        self._model, self._positions, self._joints, self.posture = model, positions, joints, b""
        self.n_joints = self.data.qpos[positions].size
        stacked = np.zeros((len(landmarks), 3, model.nv))
        self._stacked = stacked.reshape(-1, model.nv)
        # Views, where the joints are side by side: creating them again takes as long as the computation itself.
        self._views = None
        if isinstance(joints, slice):
            self._views = self.jacobian[:, joints], self._stacked[:, joints]
        self._landmarks = list(zip(landmarks, stacked, strict=True))
        self._landmark_sites = np.array(landmarks, dtype=np.intp)
        self.sites, self._rotations = self.data.site_xpos, self.data.site_xmat
        self._qpos = self.data.qpos  # asking MuJoCo for it takes as long as the kinematics of one link

    def move_to(self, q: Array) -> None:
        """Compute the kinematics at ``q``, shape (n,); if the last computation was for the same posture, do nothing."""
        posture = q.tobytes()
        if posture != self.posture:
            self._qpos[self._positions] = q
            mujoco.mj_kinematics(self._model, self.data)
            mujoco.mj_comPos(self._model, self.data)
            self.posture, self.centers = posture, None

    def site_pose(self, site: int) -> Pose:
        """Return the pose of a site in the base frame."""
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self._rotations[site])
        return Pose.trusted(self.sites[site].copy(), quaternion)

    def site_jacobian(self, site: int) -> Array:
        """Return the Jacobian of a site, shape (6, n), as a view that the next call overwrites."""
        mujoco.mj_jacSite(self._model, self.data, self.linear, self.angular, site)
        return self.jacobian[:, self._joints] if self._views is None else self._views[0]

    def landmarks(self) -> list[list[float]]:
        """Return the positions of the landmarks in the base frame, three floats each [m]."""
        positions: list[list[float]] = self.sites.take(self._landmark_sites, axis=0).tolist()
        return positions

    def landmark_jacobians(self) -> Array:
        """Return the stacked Jacobians of the landmarks, (3 m, n), as a view that the next call overwrites."""
        for site, rows in self._landmarks:
            mujoco.mj_jacSite(self._model, self.data, rows, None, site)
        return self._stacked[:, self._joints] if self._views is None else self._views[1]


class ArmKinematics:
    """How the joints of an arm move its flange, its tool and its links; base class of :class:`~imitarm.ArmModel`.

    Attributes:
        n_joints: number of joints from base to flange.
    """

    name: str
    joint_names: tuple[str, ...]
    n_joints: int
    landmarks: Landmarks | None

    def __init__(self, name: str, joint_names: tuple[str, ...], model: mujoco.MjModel, posture: Array) -> None:
        """Prepare the kinematics of a compiled model.

        Args:
            name: name of the arm.
            joint_names: the joints from base to flange, in order.
            model: a model with a site ``flange`` and, with a tool, a site ``tool``.
            posture: positions of all joints of the model, including fingers, shape (nq,).
        """
        joints = [model.joint(joint).id for joint in joint_names]
        self.name, self.joint_names, self.n_joints = name, joint_names, len(joint_names)
        self.landmarks = Landmarks.find(model, np.array(joints))
        self._model, self._posture, self._shape = model, posture, (len(joints),)
        self._qpos = _columns(model.jnt_qposadr[joints])
        self._dofs = _columns(model.jnt_dofadr[joints])
        self._flange = model.site("flange").id
        sites = [model.site(i).name for i in range(model.nsite)]
        self._tool = sites.index("tool") if "tool" in sites else self._flange
        self._local = threading.local()

    @property
    def has_tool(self) -> bool:
        """Whether a tool is mounted, so that ``tool_pose`` differs from ``forward_kinematics``."""
        return self._tool != self._flange

    def at(self, q: ArrayLike) -> ArmMemory:
        """Return this thread's working memory with the kinematics at ``q``.

        Use this memory in loops that need several results for one posture. The kinematics are computed again only for a
        new posture. They are valid until a method is called with another posture.
        """
        memory: ArmMemory
        try:
            memory = self._local.memory
        except AttributeError:  # the first time in this thread
            sites = () if self.landmarks is None else self.landmarks.sites
            memory = self._local.memory = ArmMemory(self._model, self._posture, self._qpos, self._dofs, sites)
        # The usual cases are decided here: they are on the path of every control step.
        if type(q) is np.ndarray and q.dtype is _FLOAT64 and q.shape == self._shape:
            if q.tobytes() == memory.posture:
                return memory
            if not math.isfinite(sum(q.tolist())):
                q = self._checked(q, "q")
        else:
            q = self._checked(q, "q")
        memory.move_to(q)
        return memory

    def site(self, frame: str) -> int:
        """Return the index of the site that marks the frame ``"tool"`` or ``"flange"``.

        Raises:
            UnknownNameError: if ``frame`` is neither ``"tool"`` nor ``"flange"``.
        """
        if text(frame, "frame") not in ("tool", "flange"):
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
            joints: joint positions, shape (n, n_joints) or (n_joints,) [rad].

        Returns:
            positions (n, 3) [m] and quaternions wxyz (n, 4).
        """
        postures = np.atleast_2d(finite_array(joints, (..., self.n_joints), f"{self.name}: joints", "rad"))
        if postures.ndim != 2:
            raise InputError(
                f"{self.name}: joints must be an array of shape (n, {self.n_joints}), got {postures.shape}"
            )
        poses = [self.at(q).site_pose(self._tool) for q in postures]
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
            point: position of the point at ``q`` in the base frame, shape (3,) [m].

        Returns:
            shape (3, n_joints) [m/rad].

        Raises:
            UnknownNameError: if the arm has no body of that name.
        """
        position = finite_vector(point, 3, "point", "m")
        index = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, text(body, "body"))
        if index < 0:
            known = [self._model.body(i).name for i in range(1, self._model.nbody)]
            raise UnknownNameError.among(f"body of {self.name}:", body, known)
        memory = self.at(q)
        mujoco.mj_jac(self._model, memory.data, memory.linear, None, position[:, None], index)
        return np.array(memory.linear[:, self._dofs])

    def sew_points(self, q: ArrayLike) -> Array:
        """Return the positions of shoulder, elbow and wrist in the base frame, shape (3, 3) [m].

        Raises:
            InputError: if the arm's file does not define shoulder, elbow and wrist.
        """
        return np.array(self.at(q).sites[list(self.required_landmarks().sites)])

    def sew_jacobians(self, q: ArrayLike) -> Array:
        """Return the Jacobians of shoulder, elbow and wrist, shape (3, 3, n_joints) [m/rad].

        Raises:
            InputError: if the arm's file does not define shoulder, elbow and wrist.
        """
        self.required_landmarks()
        return np.array(self.at(q).landmark_jacobians()).reshape(3, 3, -1)

    def required_landmarks(self) -> Landmarks:
        """Return ``landmarks``, or raise an error if the arm has none.

        Raises:
            InputError: if the arm's file does not define shoulder, elbow and wrist.
        """
        if self.landmarks is None:
            raise InputError(
                f"{self.name} does not say where its shoulder, elbow and wrist are: add sites named 'shoulder', "
                "'elbow' and 'wrist' to its MJCF file, on the links that these joints move"
            )
        return self.landmarks

    def _checked(self, values: ArrayLike, what: str) -> Array:
        unit = "rad" if what == "q" else "rad/s" if what == "qd" else "rad/s^2"
        return finite_vector(values, self.n_joints, f"{self.name}: {what}", unit)


def _columns(indices: NDArray[np.int32]) -> Columns:
    """Return consecutive indices as a slice, because slicing an array is several times faster."""
    first = int(indices[0])
    return slice(first, first + len(indices)) if np.all(np.diff(indices) == 1) else indices


def find_posture(
    arm: ArmModel,
    pose: Pose,
    *,
    q0: ArrayLike | None = None,
    frame: str = "tool",
    restarts: int = 40,
    seed: int = 0,
) -> Array:
    r"""Find joint positions within the limits that bring the tool to ``pose``.

    The method is Levenberg-Marquardt (Sugihara, IEEE T-RO 27(5), 2011). Each step moves the joints that are not at a
    limit by :math:`J^T(JJ^T+\mu)^{-1}e`, where the damping :math:`\mu` is proportional to the squared error
    :math:`|e|^2`. In the null space, the joints drift towards the starting posture. The search starts from ``q0``, then
    from ``home``, then from random postures.

    Args:
        arm: the arm.
        pose: desired pose in the base frame.
        q0: posture from which the search starts, and near which the result should be, shape (n_joints,) [rad]; None:
            ``home``.
        frame: frame to bring to this pose, ``"tool"`` or ``"flange"``.
        restarts: number of random start postures.
        seed: seed of the random postures.

    Returns:
        Joint positions, shape (n_joints,) [rad]. They bring the frame to within 1e-6 m and 1e-6 rad of ``pose``.

    Raises:
        UnreachableError: if no posture reaches the pose; the message names the pose and the error of the best posture.
        UnknownNameError: if ``frame`` is neither ``"tool"`` nor ``"flange"``.
        InputError: if another argument can't be used.
    """
    if not isinstance(arm, ArmKinematics):
        raise InputError(f"find_posture: arm must be an ArmModel, got {arm!r}")
    arm.site(frame)
    instance(pose, Pose, "pose")
    whole_number(restarts, "restarts", at_least=0, at_most=_MOST_RESTARTS)
    whole_number(seed, "seed", at_least=0)
    best, least = arm.home, math.inf
    for start in _starts(arm, q0, restarts, seed):
        q, error = _descend(arm, start, pose, frame)
        if error < least:
            best, least = q, error
        if error <= _TOLERANCE:
            return q
    missing = _error(arm, best, pose, frame)
    raise UnreachableError(
        f"{arm.name} can't bring its {frame} to position {np.round(pose.position, 4).tolist()} m, quaternion "
        f"{np.round(pose.quaternion, 4).tolist()}: the best posture within its limits is "
        f"{1e3 * float(np.linalg.norm(missing[:3])):.1f} mm and {math.degrees(float(np.linalg.norm(missing[3:]))):.1f} "
        "degrees off; move the pose nearer to the arm or rotate it"
    )


def _starts(arm: ArmModel, q0: ArrayLike | None, restarts: int, seed: int) -> Iterator[Array]:
    if q0 is not None:
        yield np.clip(finite_vector(q0, arm.n_joints, f"{arm.name}: q0", "rad"), arm.lower, arm.upper)
    yield np.array(arm.home)
    low, high = np.maximum(arm.lower, -math.pi), np.minimum(arm.upper, math.pi)
    random = np.random.default_rng(seed)
    for _ in range(restarts):
        yield random.uniform(low, high)


def _error(arm: ArmModel, q: Array, pose: Pose, frame: str) -> Array:
    now = arm.tool_pose(q) if frame == "tool" else arm.forward_kinematics(q)
    return now.error_to(pose)


def _descend(arm: ArmModel, start: Array, pose: Pose, frame: str) -> tuple[Array, float]:
    """Search from ``start``, and return the best posture and its weighted error [m]."""
    weights = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
    q, best, least, since = start, start, math.inf, 0
    for _ in range(_STEPS):
        error = weights * _error(arm, q, pose, frame)
        size = float(np.linalg.norm(error))
        since = 0 if size < 0.99 * least else since + 1
        if size < least:
            best, least = q, size
        if least <= _TOLERANCE or since > 12:
            break
        jacobian = weights[:, None] * (arm.tool_jacobian(q) if frame == "tool" else arm.jacobian(q))
        q = np.clip(q + _step(arm, q, jacobian, error, start), arm.lower, arm.upper)
    return best, least


def _step(arm: ArmModel, q: Array, jacobian: Array, error: Array, reference: Array) -> Array:
    """Return one step of the search; a joint at a limit does not move beyond the limit."""
    free = np.ones(len(q), dtype=bool)
    step = np.zeros(len(q))
    damping = 1e-3 * float(error @ error) + 1e-12
    for _ in range(len(q)):
        part = jacobian * free
        inverse = part.T @ np.linalg.inv(part @ part.T + damping * np.eye(6))
        drift = _DRIFT * free * (reference - q)
        step = inverse @ error + drift - inverse @ (part @ drift)
        pressed = free & (((q >= arm.upper) & (step > 0.0)) | ((q <= arm.lower) & (step < 0.0)))
        if not pressed.any():
            break
        free &= ~pressed
    longest = float(np.max(np.abs(step)))
    return step * min(1.0, _LONGEST_STEP / longest) if longest > 0.0 else step
