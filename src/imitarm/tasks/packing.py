"""PackingTask: pick a cube, follow a moving packing box and put the cube into it (thesis Fig 5.6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from imitarm.demonstrations import align
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.robots.world import OBSTACLE, arm_world
from imitarm.scene import Box, Cylinder, HalfSpace, MovingScene, Obstacle, Scene, standard_fixtures
from imitarm.scene.motion import Motion as Movement
from imitarm.skills.skill import Skill
from imitarm.tasks.habits import Motion, along, demonstrations_by
from imitarm.tasks.open_box import LOOKING_DOWN, open_box
from imitarm.trajectory import Demonstration, Rollout

Array = NDArray[np.float64]

OPEN, CLOSED = 0.08, 0.0  # [m] commanded openings of the gripper; the cube stops the closing fingers earlier
BOX, BOTTLE, CUBE = "packing box", "bottle", "cube"
BOX_COLOR, BOTTLE_COLOR, CUBE_COLOR = (0.55, 0.38, 0.16), (0.20, 0.42, 0.70), (0.75, 0.12, 0.10)  # red, green, blue

_SIDE = 0.04  # [m] of the cube
_MASS, _FRICTION = 0.05, [0.6, 0.005, 0.0001]
_STIFF = [0.004, 1.0]  # solref of contacts: two timesteps, critically damped
_CUBE_AT, _CUBE_OFFSET = (0.56, -0.34), 0.02  # [m] place on the table, and its largest random change
_INSIDE, _THICK = (0.22, 0.22, 0.09), 0.01  # [m] of the box
_BOX_AT, _BOX_TRAVEL = (0.58, 0.34), 0.06  # [m] mean place of the box, and amplitude of its motion along x
_BOX_PERIOD = 8.0, 14.0  # [s]
_BOTTLE = (0.033, 0.22)  # [m] radius and height
_ON_PATH = ((0.53, 0.63), (-0.12, 0.08))  # [m] ranges of x and y of places in the way of the gripper
_ASIDE = (0.72, 0.82), (0.40, 0.44)  # [m] ranges of x on both sides of them
_PUSH_SPEED = 0.1, 0.3  # [m/s] mean speeds of the pushes
_PAUSE = 0.3, 1.5  # [s] between two pushes
_LONGEST = 60.0  # [s] for which motions are drawn
_SAME_SIZE = 0.05  # [m] largest difference of the size by which the box is recognised
_RELEASE = 0.1  # [m] of the tool above the rim of the box
_RISE = 0.26  # [m] of the carrying curve's control points
_TABLE = (0.50, 0.0), (0.80, 1.30, 0.04)  # [m] its top is at height 0


@dataclass(frozen=True)
class PackingTask:
    """A Sawyer with a gripper puts a cube into a moving packing box, while a bottle is pushed into the arm's way.

    The box slides back and forth on the table. At random times, the bottle is pushed from the side into the way of the
    gripper, and later out of the way. The task succeeds if the cube is in the box, and the arm has not touched the
    bottle or the box.

    Attributes:
        seed: seed of the places and motions of cube, box and bottle.
        moving: whether box and bottle move.
    """

    seed: int = 0
    moving: bool = True

    start: ClassVar[Pose] = Pose(np.array([0.50, -0.16, 0.26]), np.array(LOOKING_DOWN))
    clearance: ClassVar[float] = 0.02  # [m] required clearance of a reproduction
    timeout: ClassVar[float] = 40.0  # [s]

    @staticmethod
    def arm() -> ArmModel:
        """Load the Sawyer with the gripper."""
        return ArmModel.load("sawyer", tool="gripper")

    @property
    def rim(self) -> float:
        """Height of the rim of the box above the table [m]."""
        return _THICK + _INSIDE[2]

    @property
    def cube(self) -> Array:
        """Centre of the cube at the start, shape (3,) [m]."""
        place = np.random.default_rng([560, self.seed]).uniform(-_CUBE_OFFSET, _CUBE_OFFSET, 2)
        return np.array([*(np.array(_CUBE_AT) + place), 0.5 * _SIDE])

    @property
    def grasp(self) -> Pose:
        """Pose of the tool in which the fingers close on the cube."""
        return self.grasp_at(self.cube)

    @staticmethod
    def grasp_at(cube: Array) -> Pose:
        """Return the pose of the tool in which the fingers close on a cube on the table.

        Args:
            cube: centre of the cube, shape (3,) [m]; only x and y are used.
        """
        return Pose(np.array([cube[0], cube[1], 0.5 * _SIDE]), np.array(LOOKING_DOWN))

    def box_at(self, time: float) -> Array:
        """Return the middle of the inner side of the box's bottom at ``time`` [s], shape (3,) [m]."""
        rng = np.random.default_rng([561, self.seed])
        period, angle = rng.uniform(*_BOX_PERIOD), rng.uniform(0.0, 2.0 * np.pi)
        travel = _BOX_TRAVEL * np.sin(2.0 * np.pi * time / period + angle) if self.moving else 0.0
        return np.array([_BOX_AT[0] + travel, _BOX_AT[1], _THICK])

    def bottle_at(self, time: float) -> Array:
        """Return the centre of the bottle at ``time`` [s], shape (3,) [m]."""
        course = _pushes(self.seed)
        x, y = course(np.clip(time, 0.0, _LONGEST) if self.moving else 0.0)
        return np.array([x, y, 0.5 * _BOTTLE[1]])

    def release(self, scene: Scene) -> Pose | None:
        """Return the pose of the tool above the middle of the box in an observed scene; None if the scene has no box.

        The box is recognised by its name, or by its size if the sensor reports no names.
        """
        for obstacle in scene.obstacles:
            low, high = obstacle.bounds()
            if obstacle.name == BOX or np.abs(high - low - self.outer).max() < _SAME_SIZE:
                middle = 0.5 * (low + high)
                return Pose(np.array([*middle[:2], self.rim + _RELEASE]), np.array(LOOKING_DOWN))
        return None

    def truth(self) -> MovingScene:
        """Return the true motions of the box (as one solid body) and the bottle, which a sensor observes."""
        return MovingScene(
            Scene(None, (self._solid_box(0.0), self._bottle()), fixtures=packing_fixtures()),
            {BOX: lambda t: self._solid_box(t).pose.position, BOTTLE: self.bottle_at},
        )

    @property
    def outer(self) -> Array:
        """Outer size of the box, shape (3,) [m]."""
        x, y, z = _INSIDE
        return np.array([x + 2.0 * _THICK, y + 2.0 * _THICK, z + _THICK])

    def box_around(self, middle: Array) -> Box:
        """Return the box as one solid body on the table; ``middle`` is x and y of its centre, shape (2,) [m]."""
        center = np.array([*middle, 0.5 * self.rim])
        return Box(Pose(center, np.array([1.0, 0.0, 0.0, 0.0])), self.outer, name=BOX)

    def _solid_box(self, time: float) -> Box:
        return self.box_around(self.box_at(time)[:2])

    def _bottle(self) -> Cylinder:
        pose = Pose(self.bottle_at(0.0), np.array([1.0, 0.0, 0.0, 0.0]))
        return Cylinder(pose, *_BOTTLE, name=BOTTLE)

    def robot(self, *, arm: ArmModel | None = None, control: Control = "torque") -> SimulatedRobot:
        """Return the simulated robot with its open gripper above the table, with cube, box and bottle.

        Args:
            arm: the Sawyer with the gripper; None: loaded here.
            control: control mode of the drives. The default is computed torque, which is compliant, because the gripper
                touches the cube.
        """
        arm = self.arm() if arm is None else arm
        boards = open_box(Pose(self.box_at(0.0), np.array([1.0, 0.0, 0.0, 0.0])), _INSIDE, _THICK)
        obstacles: tuple[Obstacle, ...] = (*boards, self._bottle())
        motions: dict[str | int, Movement] = {BOTTLE: self.bottle_at}
        motions |= {board.name: self._along_with_box(board) for board in boards}
        robot = SimulatedRobot(
            arm,
            scene=Scene(None, obstacles, fixtures=packing_fixtures()),
            motion=motions,
            world=self._world(arm),
            control=control,
            q=start_posture(arm),
        )
        for i, color in enumerate([BOX_COLOR] * len(boards) + [BOTTLE_COLOR]):
            robot.model.geom(f"{OBSTACLE}{i}").rgba = (*color, 1.0)
        robot.grasp(OPEN)
        return robot

    def _along_with_box(self, board: Box) -> Movement:
        away = board.pose.position - self.box_at(0.0)
        return lambda time: self.box_at(time) + away

    def _world(self, arm: ArmModel) -> mujoco.MjSpec:
        """Return the world without obstacles: arm, table and cube."""
        spec = arm_world(arm, fixtures=packing_fixtures())
        spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0  # so that the cube does not slip
        (x, y), size = _TABLE
        half = 0.5 * np.array(size)
        table = spec.worldbody.add_body(name="table top", pos=[x, y, -half[2]])
        surface = {"friction": _FRICTION, "condim": 4, "solref": _STIFF}
        shape = mujoco.mjtGeom.mjGEOM_BOX
        table.add_geom(name="table top", type=shape, size=half, rgba=(0.80, 0.68, 0.52, 1.0), **surface)
        body = spec.worldbody.add_body(name=CUBE, pos=self.cube)
        body.add_freejoint(name=CUBE)
        body.add_geom(name=CUBE, type=shape, size=[0.5 * _SIDE] * 3, mass=_MASS, rgba=(*CUBE_COLOR, 1.0), **surface)
        return spec

    def evaluate(self, robot: SimulatedRobot, rollout: Rollout) -> Rollout:
        """Return ``rollout`` with success or the reasons for failure: cube not in the box, contact, not finished."""
        away = robot.data.body(CUBE).xpos - self.box_at(robot.time)
        half = 0.5 * np.array(_INSIDE)
        inside = bool(np.all(np.abs(away[:2]) < half[:2]) and 0.0 < away[2] < _INSIDE[2])
        faults = [] if rollout.success else [rollout.reason]
        if not inside:
            faults.append(f"the cube is {1e3 * np.linalg.norm(away[:2]):.0f} mm from the middle of the box")
        return replace(rollout, success=not faults, reason="; ".join(faults) or "the cube is in the box")


def start_posture(arm: ArmModel) -> Array:
    """Return joint angles (n_joints,) [rad] with the tool at the start."""
    return find_posture(arm, PackingTask.start)


def packing_fixtures() -> tuple[Obstacle, ...]:
    """Return the table, the floor and the pedestal."""
    return (HalfSpace(np.zeros(3), name="table"), *standard_fixtures())


@lru_cache(maxsize=64)
def _pushes(seed: int) -> PchipInterpolator:
    """Return the place (x, y) of the bottle over time: pushes in and out of the gripper's way, at rest between them."""
    rng = np.random.default_rng([562, seed])

    def drawn(x: tuple[float, float]) -> Array:
        return np.array([rng.uniform(*x), rng.uniform(*_ON_PATH[1])])

    times, places, aside = [0.0], [drawn(_ASIDE[rng.integers(2)])], False
    while times[-1] < _LONGEST:
        times.append(times[-1] + float(rng.uniform(*_PAUSE)))
        places.append(places[-1])
        target = drawn(_ON_PATH[0]) if not aside else drawn(_ASIDE[rng.integers(2)])
        aside = not aside
        way = float(np.linalg.norm(target - places[-1]))
        times.append(times[-1] + way / float(rng.uniform(*_PUSH_SPEED)) + 1e-3)
        places.append(target)
    return PchipInterpolator(times, places)  # it rests between two equal places and does not overshoot


def reach(start: Array, goal: Array, rise: float) -> Motion:
    """Return a cubic Bezier curve that leaves the start upwards and arrives at the goal from above.

    Args:
        start: start position of the tool, shape (3,) [m].
        goal: goal position of the tool, shape (3,) [m].
        rise: height of the curve's control points above start and goal [m].
    """
    up = np.array([0.0, 0.0, rise])
    points = np.stack([start, start + up, goal + up, goal])

    def curve(p: Array) -> Array:
        q = 1.0 - p
        return np.stack([q**3, 3.0 * q**2 * p, 3.0 * q * p**2, p**3], axis=1) @ points

    def spread(p: Array) -> Array:
        loose = np.sin(np.pi * p) ** 2
        return np.stack([along(0, 0.02 * loose), along(2, 0.015 * loose)])

    def bend(p: Array) -> Array:
        return along(2, (curve(p) - start - p[:, None] * (goal - start))[:, 2])

    return Motion("reach", curve, bend=bend, spread=spread, free=(1.0, 1.0, 1.0), duration=4.0)


@lru_cache(maxsize=4)
def packing_skills(teachers: int = 3) -> tuple[Skill, Skill]:
    """Return the two skills of the task, learned from synthetic teachers: reach the cube, and carry it over the box.

    In the demonstrations, the cube and the box are at their mean places. In a run, the cube and the box are at other
    places, so the goals differ from the demonstrated goals.

    Args:
        teachers: number of teachers, with eight demonstrations each.

    Raises:
        InputError: when ``teachers`` is below 1.
    """
    if teachers < 1:
        raise InputError(f"packing_skills: teachers must be at least 1, got {teachers}")
    cube = np.array([*_CUBE_AT, 0.5 * _SIDE])
    over = np.array([*_BOX_AT, _INSIDE[2] + _THICK + _RELEASE])
    shown = (reach(PackingTask.start.position, cube, 0.10), reach(cube, over, _RISE))
    first, second = (
        Skill(8).fit(align([_looking_down(one) for one in demonstrations_by(motion, teachers)])) for motion in shown
    )
    return first, second


def _looking_down(demonstration: Demonstration) -> Demonstration:
    """Return the demonstration with the tool's rotation, which is constant."""
    trajectory = demonstration.trajectory
    quaternions = np.tile(LOOKING_DOWN, (len(trajectory), 1))
    return replace(demonstration, trajectory=replace(trajectory, quaternions=quaternions))
