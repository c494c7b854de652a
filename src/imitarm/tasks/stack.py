"""Stack four numbered cubes in the order of their numbers (thesis 3.3, Fig 3.5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.robots.world import arm_world

Array = NDArray[np.float64]

N_CUBES = 4
SIDE = 0.032  # [m] of a cube
OPEN, CLOSED = 0.08, 0.0  # [m] commanded openings of the gripper; a cube stops the closing fingers earlier
LOOKING_DOWN = (
    0.0,
    np.sqrt(0.5),
    np.sqrt(0.5),
    0.0,
)  # wxyz: the tool points down, its fingers close along the base's x axis
FAILURES = (
    "protective stop",
    "tower fell",
    "dropped",
    "misplaced",
    "knocked over",
    "not grasped",
    "timeout",
)
"""Kinds of failure, in the order in which :meth:`StackTask.evaluate` checks them."""

_PLACES = np.array([[0.62, 0.0], [0.62, 0.10], [0.62, -0.10], [0.62, -0.20]])  # [m] of cubes 1 to 4
_MAX_OFFSET, _MAX_ROTATION = 0.004, 0.06  # [m], [rad] largest random change of a cube's place and rotation
_TABLE = ((0.66, 0.0), (0.72, 1.36, 0.04))  # [m] center and size; the top is at height 0
_MASS = 0.025  # [kg] a wooden cube
_FRICTION = [0.6, 0.005, 0.0001]
_STIFF = [0.004, 1.0]  # solref of contacts: two timesteps, critically damped
_LEVEL = 0.003  # [m] largest error of a cube's height in the tower
_UPRIGHT = np.cos(np.radians(5.0))  # vertical component of the normal of the upper face
_STILL = 0.02  # [m/s] slower cubes are at rest
_LIFTED = 0.015  # [m] height above its first one at which a cube counts as lifted
_MOVED = 0.03  # [m] a cube that was never lifted and is farther than this from its place was pushed
_WOOD = (0.80, 0.68, 0.52, 1.0)
_COLORS = ((0.75, 0.18, 0.16, 1.0), (0.16, 0.38, 0.68, 1.0), (0.93, 0.70, 0.18, 1.0), (0.22, 0.52, 0.32, 1.0))
_PIPS = {
    1: ((0, 0),),
    2: ((-1, -1), (1, 1)),
    3: ((-1, -1), (0, 0), (1, 1)),
    4: ((-1, -1), (-1, 1), (1, -1), (1, 1)),
}


@dataclass(frozen=True)
class StackEvaluation:
    """Success or failure of a stacking run.

    Attributes:
        success: whether all four cubes are stacked in order, without support by the gripper.
        failure: one of :data:`FAILURES`; empty on success.
        stacked: number of cubes in the tower, counted from cube 1.
        reason: explanation of success or failure.
    """

    success: bool
    failure: str
    stacked: int
    reason: str


@dataclass
class CubeHistory:
    """What has happened to the cubes so far; :meth:`StackTask.watch` updates this history.

    Attributes:
        highest: largest height of each cube's center so far, shape (4,) [m].
        tallest: largest number of cubes in the tower so far, counted only while the gripper touched no cube.
        lost: indices of the cubes that left the gripper while they were in the air.
        held: index of the cube in the gripper; None if there is none.
    """

    highest: Array = field(default_factory=lambda: np.zeros(N_CUBES))
    tallest: int = 0
    lost: set[int] = field(default_factory=set)
    held: int | None = None


@dataclass(frozen=True)
class StackTask:
    """A Sawyer with a parallel gripper at a table with four cubes of 32 mm, which are numbered from 1 to 4.

    The colour and the dots of each cube show its number. Cube 1 stays in its place; cubes 2, 3 and 4 are stacked on
    cube 1 in this order. The task succeeds if the cubes stand in the order of their numbers, and the gripper does not
    support them. Cubes 2 to 4 must be centred on the cube below them, with an error of at most ``tolerance``.

    Contacts use MuJoCo's elliptic friction cones with ``impratio`` 10, because a grasped cube could otherwise slip out
    of the fingers. The setting ``condim`` 4 gives the finger pads torsional friction.

    Attributes:
        seed: seed of the small random changes of the cubes' positions and rotations.
        tolerance: largest horizontal distance between the centers of a cube and the cube below it [m], less than
            half a side.
    """

    seed: int = 0
    tolerance: float = 0.014

    start: ClassVar[Pose] = Pose(np.array([0.62, -0.05, 0.19]), np.array(LOOKING_DOWN))  # pose of the tool

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 0.5 * SIDE:
            raise InputError(f"StackTask: tolerance must be between 0 and {0.5 * SIDE:g} m, got {self.tolerance!r}")

    @staticmethod
    def arm() -> ArmModel:
        """Load the Sawyer with the gripper."""
        return ArmModel.load("sawyer", tool="gripper")

    def places(self) -> tuple[Array, Array]:
        """Return the initial positions of the cubes, (4, 2) [m], and their rotations about the vertical, (4,) [rad]."""
        rng = np.random.default_rng([3035, self.seed])
        return _PLACES + rng.uniform(-_MAX_OFFSET, _MAX_OFFSET, (N_CUBES, 2)), rng.uniform(
            -_MAX_ROTATION, _MAX_ROTATION, N_CUBES
        )

    def world(self, arm: ArmModel) -> mujoco.MjSpec:
        """Return the world: arm, table, cubes."""
        spec = arm_world(arm)
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        _add_table(spec)
        for i, (place, rotation) in enumerate(zip(*self.places(), strict=True)):
            _add_cube(spec, i + 1, place, rotation)
        return spec

    def robot(self, arm: ArmModel | None = None, *, control: Control = "torque") -> SimulatedRobot:
        """Return the simulated robot with its open gripper above the table.

        Args:
            arm: the Sawyer with the gripper; None: loaded here.
            control: control mode of the drives. Contacts are expected, so the default is computed torque, which is more
                compliant than position control.
        """
        arm = self.arm() if arm is None else arm
        robot = SimulatedRobot(arm, world=self.world(arm), control=control, q=self.start_posture(arm))
        robot.grasp(OPEN)
        return robot

    def start_posture(self, arm: ArmModel) -> Array:
        """Return joint angles (n_joints,) [rad] with the tool at ``start``."""
        return find_posture(arm, self.start)

    @staticmethod
    def cubes(robot: SimulatedRobot) -> Array:
        """Return the centers of the cubes, shape (4, 3) [m]."""
        return np.array([robot.data.body(f"cube/{i + 1}").xpos for i in range(N_CUBES)])

    def stacked(self, robot: SimulatedRobot) -> int:
        """Return the number of cubes in the tower on cube 1; 0 if cube 1 does not stand upright on the table."""
        cubes = self.cubes(robot)
        level = self._level(robot)
        for i in range(N_CUBES):
            height = cubes[i, 2] - (0.0 if i == 0 else cubes[i - 1, 2] + 0.5 * SIDE) - 0.5 * SIDE
            away = 0.0 if i == 0 else float(np.hypot(*(cubes[i] - cubes[i - 1])[:2]))
            if abs(height) > _LEVEL or away > self.tolerance or not level[i]:
                return i
        return N_CUBES

    def standing(self, robot: SimulatedRobot) -> bool:
        """Return whether all four cubes stand in order and at rest while the gripper touches none of them."""
        speed = max(float(np.linalg.norm(robot.data.body(f"cube/{i + 1}").cvel[3:])) for i in range(N_CUBES))
        return self.stacked(robot) == N_CUBES and speed < _STILL and not any(self.touched(robot))

    @staticmethod
    def touched(robot: SimulatedRobot) -> tuple[bool, ...]:
        """Return for each cube whether the arm or gripper touches it."""
        body, names = robot.model.geom_bodyid, [f"cube/{i + 1}" for i in range(N_CUBES)]
        cubes = [robot.model.body(name).id for name in names]
        solid = {*cubes, robot.model.body("table").id, 0}
        pairs = [(int(body[a]), int(body[b])) for a, b in robot.data.contact.geom]
        return tuple(any(cube in pair and not set(pair) <= solid for pair in pairs) for cube in cubes)

    def watch(self, robot: SimulatedRobot, history: CubeHistory) -> None:
        """Update the history of the cubes; call it every few hundredths of a second."""
        cubes, touched = self.cubes(robot), self.touched(robot)
        history.highest = np.maximum(history.highest, cubes[:, 2])
        if not any(touched):
            history.tallest = max(history.tallest, self.stacked(robot))
        before, history.held = history.held, None
        for i in range(N_CUBES):
            if touched[i] and _free_below(cubes, i):
                history.held = i
        if before is not None and history.held != before and not touched[before] and _free_below(cubes, before):
            history.lost.add(before)

    def evaluate(self, robot: SimulatedRobot, history: CubeHistory) -> StackEvaluation:  # noqa: PLR0911 (one for each kind of failure)
        """Return success, or the first kind of failure that applies.

        Failures are checked in this order:

        * The robot has made a protective stop.
        * The tower has lost a cube that was in it before.
        * A cube left the gripper in the air and is not in the tower.
        * A cube was put down outside the tower.
        * A cube was pushed or turned over without having been lifted.
        * The next cube for the tower was never lifted.
        * None of these failures applies: the time limit was reached.
        """
        n = self.stacked(robot)
        if self.standing(robot):
            return StackEvaluation(True, "", n, "four cubes stand in order")
        if robot.fault:
            return StackEvaluation(False, "protective stop", n, robot.fault)
        if n < history.tallest:
            return StackEvaluation(False, "tower fell", n, f"{history.tallest} cubes stood, now {n}")
        waiting = range(n, N_CUBES)
        lost = sorted(history.lost.intersection(waiting))
        if lost:
            return StackEvaluation(False, "dropped", n, f"cube {lost[0] + 1} fell out of the gripper")
        touched, lifted = self.touched(robot), history.highest > 0.5 * SIDE + _LIFTED
        cubes, level = self.cubes(robot), self._level(robot)
        for i in waiting:
            if lifted[i] and not touched[i]:
                return StackEvaluation(False, "misplaced", n, f"cube {i + 1} was not put down on cube {i}")
        for i in waiting:
            away = float(np.hypot(*(cubes[i, :2] - self.places()[0][i])))
            if not lifted[i] and (not level[i] or away > _MOVED or cubes[i, 2] < 0.0):
                return StackEvaluation(
                    False, "knocked over", n, f"cube {i + 1} was pushed by {1e3 * away:.0f} mm or turned over"
                )
        if n < N_CUBES and not lifted[max(n, 1)]:
            return StackEvaluation(False, "not grasped", n, f"cube {max(n, 1) + 1} was never lifted")
        return StackEvaluation(False, "timeout", n, f"{n} of {N_CUBES} cubes in the tower when the time was up")

    @staticmethod
    def _level(robot: SimulatedRobot) -> NDArray[np.bool_]:
        """Return for each cube whether its initial top face is still on top and level."""
        up = np.array([robot.data.body(f"cube/{i + 1}").xmat[8] for i in range(N_CUBES)])
        return np.asarray(up > _UPRIGHT)


def _free_below(cubes: Array, i: int) -> bool:
    """Return whether a cube is in the air: it rests neither on the table nor on another cube."""
    bottom = cubes[i, 2] - 0.5 * SIDE
    near = np.hypot(*(cubes[:, :2] - cubes[i, :2]).T) < SIDE
    below = near & (cubes[:, 2] < cubes[i, 2] - 0.5 * SIDE)
    support = float((cubes[below, 2] + 0.5 * SIDE).max()) if below.any() else 0.0
    return bool(bottom > support + 0.01)


def _add_table(spec: mujoco.MjSpec) -> None:
    box, (center, size) = mujoco.mjtGeom.mjGEOM_BOX, _TABLE
    half = 0.5 * np.array(size)
    table = spec.worldbody.add_body(name="table", pos=[*center, -half[2]])
    table.add_geom(name="table", type=box, size=half, rgba=_WOOD, friction=_FRICTION, condim=4, solref=_STIFF)
    for i, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        place = [sx * (half[0] - 0.04), sy * (half[1] - 0.04), -half[2] - 0.355]
        table.add_geom(name=f"table/leg{i}", type=box, size=[0.025, 0.025, 0.355], pos=place, rgba=(0.3, 0.27, 0.25, 1))


def _add_cube(spec: mujoco.MjSpec, number: int, place: Array, rotation: float) -> None:
    name, half = f"cube/{number}", 0.5 * SIDE
    body = spec.worldbody.add_body(
        name=name, pos=[*place, half], quat=[np.cos(0.5 * rotation), 0, 0, np.sin(0.5 * rotation)]
    )
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half, half],
        mass=_MASS,
        rgba=_COLORS[number - 1],
        friction=_FRICTION,
        condim=4,
        solref=_STIFF,
    )
    for face, (axis, sign) in enumerate(((2, 1), (0, 1), (0, -1), (1, 1), (1, -1))):
        for pip, (a, b) in enumerate(_PIPS[number]):
            at = np.roll([sign * half, 0.5 * half * a, 0.5 * half * b], axis)
            size = np.roll([0.0002, 0.003, 0.003], axis)
            body.add_geom(
                name=f"{name}/pip{face}{pip}",
                type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
                size=size + 1e-4,
                pos=at,
                mass=0.0,
                contype=0,
                conaffinity=0,
                group=2,
                rgba=(0.97, 0.97, 0.95, 1.0),
            )
