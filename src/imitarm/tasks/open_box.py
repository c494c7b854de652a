"""OpenBoxTask: reach over obstacles into an open box (thesis Fig 5.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.robots.world import arm_world
from imitarm.scene import Box, Cone, Cylinder, HalfSpace, Obstacle, Scene, standard_fixtures
from imitarm.tasks.habits import Motion, along
from imitarm.trajectory import Rollout

Array = NDArray[np.float64]

LOOKING_DOWN = (0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0)  # wxyz: the tool points down, its fingers close along x
BOARDS = ("bottom", "far board", "near board", "left board", "right board")

_INSIDE = (0.30, 0.30, 0.14)  # [m] of the box
_THICK = 0.012  # [m] of a board
_PLACE = (0.50, 0.30)  # [m] of the box on the table
_LYING = (0.26, 0.30, 0.18)  # [m] inside of the box that lies on its side: width, height, depth
_LEVEL = 0.165  # [m] height of the planar reach
_BEHIND_GOAL = 0.08  # [m] from the goal of the planar reach to the bottom of the box
_RISE = 0.26  # [m] of the curve's control points above start and goal
_TABLE = (0.45, 0.0), (0.70, 1.20, 0.04)  # [m] its top is at height 0
_AT_GOAL = 0.01  # [m] largest distance to the goal at the end
_FREE = 0.05  # [m] obstacles are farther than this from the arm in its start posture, and from the box
_BLOCKS = 0.02  # [m] the first obstacle is nearer than this to the path
_BETWEEN = 0.2, 0.6  # progress between which obstacles stand
_ASIDE = 0.04  # [m] standard deviation of an obstacle's place about the path
_APART = 0.12  # [m] between the centres of two obstacles
_DRAWS = 5000


def open_box(pose: Pose, inside: tuple[float, float, float], thick: float = _THICK) -> tuple[Box, ...]:
    """Return the five boards of a box without a lid.

    Args:
        pose: pose of the box's frame. The origin is in the middle of the bottom's upper side; the box is open along
            positive z.
        inside: size of the inside [m].
        thick: thickness of the boards [m].
    """
    x, y, z = inside
    outer = x + 2.0 * thick
    places = (
        ((0.0, 0.0, -0.5 * thick), (outer, y + 2.0 * thick, thick)),
        ((0.0, 0.5 * (y + thick), 0.5 * z), (outer, thick, z)),
        ((0.0, -0.5 * (y + thick), 0.5 * z), (outer, thick, z)),
        ((-0.5 * (x + thick), 0.0, 0.5 * z), (thick, y, z)),
        ((0.5 * (x + thick), 0.0, 0.5 * z), (thick, y, z)),
    )
    return tuple(
        Box(Pose(pose.apply(place), pose.quaternion), np.array(size), name=name)
        for name, (place, size) in zip(BOARDS, places, strict=True)
    )


@dataclass(frozen=True)
class OpenBoxTask:
    """A Panda with a gripper reaches from one side of a table into an open box on the other side.

    Obstacles stand on the table between the start and the box. The task succeeds if the tool is at the goal inside the
    box and the arm has touched nothing. Contacts are measured with the simulator's geometry.

    Attributes:
        seed: seed of the obstacles.
        n_obstacles: number of obstacles.
    """

    seed: int = 0
    n_obstacles: int = 2

    start: ClassVar[Pose] = Pose(np.array([0.42, -0.42, 0.12]), np.array(LOOKING_DOWN))
    goal: ClassVar[Pose] = Pose(np.array([*_PLACE, 0.11]), np.array(LOOKING_DOWN))
    clearance: ClassVar[float] = 0.02  # [m] required clearance of a reproduction

    def __post_init__(self) -> None:
        if not 0 <= self.n_obstacles <= 3:
            raise InputError(f"OpenBoxTask: n_obstacles must be between 0 and 3, got {self.n_obstacles}")

    @staticmethod
    def arm() -> ArmModel:
        """Load the Panda with its gripper."""
        return ArmModel.load("panda", tool="gripper")

    @staticmethod
    def box(*, planar: bool = False) -> tuple[Box, ...]:
        """Return the five boards of the box.

        Args:
            planar: whether the box lies on its side, so that a motion at constant height leads into it.
        """
        if planar:
            quaternion = quaternion_exp(np.array([0.5 * np.pi, 0.0, 0.0]))  # its open side towards negative y
            return open_box(Pose(np.array([*_PLACE, _LEVEL]) + [0.0, _BEHIND_GOAL, 0.0], quaternion), _LYING)
        return open_box(Pose(np.array([*_PLACE, _THICK]), np.array([1.0, 0.0, 0.0, 0.0])), _INSIDE)

    @classmethod
    def motion(cls, *, planar: bool = False) -> Motion:
        """Return the motion that teachers with habits demonstrate: up, over the rim of the box, and down into the box.

        The curve is a cubic Bezier curve. The tool leaves the start vertically, and arrives at the goal vertically.
        Teachers exaggerate the height of the curve, and differ most in the middle of the motion.

        Args:
            planar: whether the reach leads at constant height into a box that lies on its side.
        """
        start, goal = cls.start.position, cls.goal.position
        away, back = np.array([0.0, 0.0, _RISE]), np.array([0.0, 0.0, _RISE])
        if planar:
            start, goal = np.array([*start[:2], _LEVEL]), np.array([*goal[:2], _LEVEL])
            away, back = np.array([0.35, 0.05, 0.0]), np.array([-0.1, -0.35, 0.0])
        points = np.stack([start, start + away, goal + back, goal])

        def curve(p: Array) -> Array:
            q = 1.0 - p
            return np.stack([q**3, 3.0 * q**2 * p, 3.0 * q * p**2, p**3], axis=1) @ points

        def spread(p: Array) -> Array:
            loose = np.sin(np.pi * p) ** 2
            return np.stack([along(0, 0.02 * loose), along(2, (0.0 if planar else 0.015) * loose)])

        height = 0 if planar else 2  # the axis along which the curve bends
        return Motion(
            "reach into an open box",
            curve,
            bend=lambda p: along(height, (curve(p) - start - p[:, None] * (goal - start))[:, height]),
            spread=spread,
            free=(1.0, 1.0, 0.0 if planar else 1.0),
            duration=5.0,
        )

    def scene(self) -> Scene:
        """Return the box, the obstacles, the table and the floor."""
        obstacles = self.obstacles(np.random.default_rng([51, self.seed]), self.n_obstacles)
        table = HalfSpace(np.zeros(3), name="table")
        return Scene(None, (*self.box(), *obstacles), fixtures=(table, *standard_fixtures()))

    @classmethod
    def obstacles(cls, rng: np.random.Generator, n_obstacles: int, path: Array | None = None) -> tuple[Obstacle, ...]:
        """Return boxes, cylinders and cones that stand on the table. The first obstacle stands on a path.

        Args:
            rng: source of the random numbers.
            n_obstacles: number of obstacles.
            path: positions along the path, shape (n, 3) [m]; None: the path of :meth:`motion`.

        Raises:
            InputError: when there is not enough space for so many obstacles.
        """
        path = cls.motion().curve(np.linspace(0.0, 1.0, 200)) if path is None else path
        centers, radii = _start_spheres()
        before_box = cls.box()[2].bounds()[0, 1] - _FREE
        made: list[Obstacle] = []
        for _ in range(_DRAWS):
            if len(made) == n_obstacles:
                return tuple(made)
            point = path[int(rng.uniform(*_BETWEEN) * len(path))]
            x, y = point[:2] + _ASIDE * rng.normal(size=2)
            obstacle = _standing(rng, x, y, point[2] + rng.uniform(-0.02, 0.06))
            apart = all(np.hypot(x - o.bounds()[:, 0].mean(), y - o.bounds()[:, 1].mean()) >= _APART for o in made)
            useful = made or obstacle.signed_distance(path).min() < _BLOCKS
            free = obstacle.bounds()[1, 1] < before_box and (obstacle.signed_distance(centers) - radii).min() >= _FREE
            if useful and apart and free:
                made.append(obstacle)
            elif rng.random() < 0.02:  # there may be no place left: begin again
                made.clear()
        raise InputError(f"OpenBoxTask: not enough space for {n_obstacles} obstacles; choose fewer")

    def world(self, arm: ArmModel) -> mujoco.MjSpec:
        """Return the world with arm and table, but without the box and the obstacles."""
        spec = arm_world(arm)
        (x, y), size = _TABLE
        half = 0.5 * np.array(size)
        table = spec.worldbody.add_body(name="table", pos=[x, y, -half[2]])
        table.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=(0.80, 0.68, 0.52, 1.0))
        return spec

    def robot(self, *, arm: ArmModel | None = None, control: Control = "position") -> SimulatedRobot:
        """Return the simulated robot in :meth:`scene`, with its tool at the start.

        Args:
            arm: the Panda with its gripper; None: loaded here.
            control: control mode of the drives.
        """
        arm = self.arm() if arm is None else arm
        return SimulatedRobot(
            arm, scene=self.scene(), world=self.world(arm), control=control, q=find_posture(arm, self.start)
        )

    def evaluate(self, robot: SimulatedRobot, rollout: Rollout) -> Rollout:
        """Return ``rollout`` with success or the reasons for failure (not at the goal, contact, not finished).

        The rollout's ``details`` contain ``"distance_to_goal"`` [m].
        """
        away = float(np.linalg.norm(robot.tool_to_base.position - self.goal.position))
        faults = [] if rollout.success else [rollout.reason]
        if away > _AT_GOAL:
            faults.append(f"the tool is {1e3 * away:.0f} mm from its goal in the box")
        if robot.contact_steps == 0 and rollout.min_clearance <= 0.0:
            faults.append(f"an obstacle was touched: clearance {1e3 * rollout.min_clearance:.1f} mm")
        details = {**rollout.details, "distance_to_goal": away}
        return replace(rollout, success=not faults, reason="; ".join(faults) or "in the box", details=details)


@lru_cache(maxsize=1)
def _start_spheres() -> tuple[Array, Array]:
    """Return centres (n, 3) and radii (n,) [m] of the spheres that cover the arm in its start posture."""
    arm = OpenBoxTask.arm()
    return arm.collision_spheres(find_posture(arm, OpenBoxTask.start))


def _standing(rng: np.random.Generator, x: float, y: float, height: float) -> Obstacle:
    """Return a box, a cylinder or a cone on the table."""
    kind, radius, yaw = int(rng.integers(3)), rng.uniform(0.025, 0.05), rng.uniform(-np.pi, np.pi)
    pose = Pose(np.array([x, y, 0.5 * height]), quaternion_exp(np.array([0.0, 0.0, yaw])))
    if kind == 0:
        return Box(pose, np.array([2.0 * radius, rng.uniform(0.04, 0.10), height]))
    return Cylinder(pose, radius, height) if kind == 1 else Cone(pose, radius + 0.02, height)
