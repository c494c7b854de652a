"""SweepTask: sweep dirt on a table into a dustpan, around obstacles (thesis Figs 4.5 to 4.8, Table 4.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.robots.world import arm_world
from imitarm.scene import Box, HalfSpace, MovingScene, Scene, load_moving_scene, load_scene, standard_fixtures
from imitarm.tasks.habits import Motion, along
from imitarm.tasks.reaching_person import ReachingPerson
from imitarm.trajectory import Rollout, Trajectory

Array = NDArray[np.float64]

DEMONSTRATIONS = Path(__file__).parent / "data" / "sweep"  # one CSV file for each demonstration
SCENES = (
    "free",
    *("two_boxes", "tall_and_low", "box_and_cone"),
    *("boxes_and_cone", "cone_first", "three_boxes"),
    *("two_boxes_two_cones", "three_boxes_and_cone"),
)
PERSON_REACHES = "person_reaches"
"""Name of the scene in which a person reaches across the path of the brush."""
MOVING_SCENES = ("pushed_box", "pushed_box_and_bottle", PERSON_REACHES)  # obstacles that move while the arm sweeps
NUMBERED_SCENES = {f"T{i}": name for i, name in enumerate(SCENES) if i}  # eight tasks, as in thesis Table 4.1

TABLE_CENTER, TABLE_SIZE = (0.66, 0.0), (0.72, 1.36, 0.04)  # [m] its top is at height 0
HOVER = 0.003  # [m] the bristles' tips above the table
SWEEPING = (
    0.0,
    np.sqrt(0.5),
    np.sqrt(0.5),
    0.0,
)  # wxyz: the tool points down, its open side along the base's y axis

_PAN_INSIDE = (0.25, 0.15)  # [m] across and along the sweep
_PAN_WALL = (0.004, 0.025)  # [m] thickness and height
_PAN_BEFORE_GOAL = 0.085  # [m] from the edge of the pan to the goal of the tool
_CRUMB = 0.004  # [m] half of a crumb's size
_SPREAD = 0.016  # [m] crumbs lie within this distance from T

_WOOD, _LEG, _PAN, _DIRT = (
    (0.80, 0.68, 0.52, 1.0),
    (0.30, 0.27, 0.25, 1.0),
    (0.16, 0.48, 0.52, 1.0),
    (0.24, 0.16, 0.10, 1.0),
)


@dataclass(frozen=True)
class SweepTask:
    """An arm with a curved brush, dirt on a table, and a dustpan recessed into the table.

    The brush starts at the point S, moves to the dirt at the point T, and pushes the dirt to the point G in the
    dustpan. The brush moves just above the table. The open side of the brush points in the direction of motion. The two
    ends of the curved brush therefore keep the crumbs inside when the brush moves to the left or right. The task
    succeeds if the dirt is in the pan and the arm with its brush has not touched an obstacle.

    Attributes:
        seed: seed of the positions of the crumbs.
        n_crumbs: number of crumbs around T.
        required_fraction: fraction of the crumbs that must end in the pan.
    """

    seed: int = 0
    n_crumbs: int = 6
    required_fraction: float = 1.0

    start: ClassVar[Pose] = Pose(np.array([0.58, -0.48, HOVER]), np.array(SWEEPING))  # S
    dirt: ClassVar[Pose] = Pose(np.array([0.61, -0.08, HOVER]), np.array(SWEEPING))  # T
    goal: ClassVar[Pose] = Pose(np.array([0.65, 0.40, HOVER]), np.array(SWEEPING))  # G
    tool_radius: ClassVar[float] = 0.058  # [m] 55 mm of the brush, and 3 mm for its tilt and the lag of the arm
    clearance: ClassVar[float] = 0.02  # [m] required clearance of a reproduction

    def __post_init__(self) -> None:
        if self.n_crumbs < 1 or not 0.0 < self.required_fraction <= 1.0:
            raise InputError(
                "SweepTask: n_crumbs must be at least 1 and required_fraction in (0, 1], "
                f"got {self.n_crumbs} and {self.required_fraction}"
            )

    @staticmethod
    def arm(robot: str = "sawyer") -> ArmModel:
        """Load an arm with the brush.

        Args:
            robot: name of the arm: ``"sawyer"``, ``"panda"``, or another arm that reaches the points S, T and G.
        """
        return ArmModel.load(robot, tool="brush")

    @staticmethod
    def scene(name: str) -> Scene:
        """Return a packaged scene; ``name`` is one of :data:`SCENES`, or "T1" to "T8", the numbers in thesis Table 4.1.

        Raises:
            UnknownNameError: when there is no such scene.
        """
        name = NUMBERED_SCENES.get(name, name)
        if name not in SCENES:
            raise UnknownNameError.among("scene", name, (*SCENES, *NUMBERED_SCENES))
        scene = Scene() if name == "free" else load_scene(DEMONSTRATIONS / "scenes" / f"{name}.yaml")
        table = HalfSpace(np.zeros(3), name="table")
        return replace(scene, fixtures=(table, *standard_fixtures()))

    @staticmethod
    def moving_scene(name: str) -> MovingScene:
        """Return a packaged scene with moving obstacles; ``name`` is one of :data:`MOVING_SCENES`.

        Raises:
            UnknownNameError: when there is no such scene.
        """
        if name not in MOVING_SCENES:
            raise UnknownNameError.among("moving scene", name, MOVING_SCENES)
        if name == PERSON_REACHES:
            moving = ReachingPerson.scene()
        else:
            moving = load_moving_scene(DEMONSTRATIONS / "scenes" / f"{name}.yaml")
        table = HalfSpace(np.zeros(3), name="table")
        return replace(moving, scene=replace(moving.scene, fixtures=(table, *standard_fixtures())))

    @classmethod
    def scenes(cls) -> Mapping[str, Scene]:
        """Return all packaged scenes with obstacles at rest, by name; the first scene has no obstacles."""
        return {name: cls.scene(name) for name in SCENES}

    @classmethod
    def motion(cls) -> Motion:
        """Return the sweep that teachers with habits demonstrate: over the dirt into the pan, at constant height.

        The motion is precise at the start, at the dirt and at the goal. Between these three points, teachers bend the
        path to the left or to the right.
        """
        start, dirt, goal = (pose.position for pose in (cls.start, cls.dirt, cls.goal))
        at_dirt = float((dirt - start)[1] / (goal - start)[1])
        x = np.polynomial.Polynomial.fit([0.0, at_dirt, 1.0], [start[0], dirt[0], goal[0]], 2)

        def halves(p: Array) -> tuple[Array, Array]:
            before, after = np.clip(p / at_dirt, 0.0, 1.0), np.clip((p - at_dirt) / (1.0 - at_dirt), 0.0, 1.0)
            return np.sin(np.pi * before) ** 2, np.sin(np.pi * after) ** 2

        return Motion(
            "sweep",
            curve=lambda p: np.stack([x(p), start[1] + p * (goal - start)[1], np.full_like(p, start[2])], axis=1),
            bend=lambda p: along(0, 0.04 * (halves(p)[0] - halves(p)[1])),
            spread=lambda p: np.stack([along(0, 0.012 * half) for half in halves(p)]),
            free=(1.0, 1.0, 0.0),
            duration=10.0,
        )

    def dirt_time(self, trajectory: Trajectory) -> float:
        """Return the time at which ``trajectory`` is nearest to the dirt [s].

        A policy should not displace the path at this time, because the brush must meet the dirt.
        """
        away = np.linalg.norm(trajectory.positions - self.dirt.position, axis=1)
        return float(trajectory.times[np.argmin(away)])

    def crumb_positions(self) -> Array:
        """Return the initial positions of the crumbs (n_crumbs, 2) [m], within 16 mm of T and without contact."""
        rng = np.random.default_rng(self.seed)
        places: list[Array] = []
        apart = min(2.9 * _CRUMB, 1.2 * _SPREAD / np.sqrt(self.n_crumbs))
        while len(places) < self.n_crumbs:
            place = rng.uniform(-_SPREAD, _SPREAD, 2)
            if np.hypot(*place) <= _SPREAD and all(np.hypot(*(place - other)) > apart for other in places):
                places.append(place)
        return np.array(places) + self.dirt.position[:2]

    def world(self, arm: ArmModel) -> mujoco.MjSpec:
        """Return the world without obstacles: arm, table, dustpan, crumbs."""
        spec = arm_world(arm)
        _add_table(spec)
        _add_dustpan(spec, self.goal.position)
        rotations = np.random.default_rng([self.seed, 1]).uniform(0.0, np.pi, self.n_crumbs)
        for i, (place, rotation) in enumerate(zip(self.crumb_positions(), rotations, strict=True)):
            _add_crumb(spec, f"crumb/{i}", place, rotation)
        return spec

    def robot(
        self, scene: Scene | MovingScene | None = None, *, arm: ArmModel | None = None, control: Control = "position"
    ) -> SimulatedRobot:
        """Return the simulated robot in ``scene``, with its brush at S.

        Args:
            scene: obstacles on the table, which may follow tracks; None for no obstacles.
            arm: the arm with the brush; None: the Sawyer, loaded here.
            control: control mode of the drives.
        """
        arm = self.arm() if arm is None else arm
        start, world, motion = self.start_posture(arm), self.world(arm), None
        if isinstance(scene, MovingScene):
            scene, motion = scene.scene, scene.motions
        return SimulatedRobot(arm, scene=scene, motion=motion, world=world, control=control, q=start)

    def start_posture(self, arm: ArmModel) -> Array:
        """Return joint angles (n_joints,) [rad] with the brush at S."""
        return find_posture(arm, self.start)

    def swept(self, robot: SimulatedRobot) -> NDArray[np.bool_]:
        """Return whether each crumb is in the pan, shape (n_crumbs,)."""
        crumbs = np.array([robot.data.body(f"crumb/{i}").xpos for i in range(self.n_crumbs)])
        across, along = _PAN_INSIDE
        x, y, z = (crumbs - [self.goal.position[0], self.goal.position[1] - _PAN_BEFORE_GOAL, 0.0]).T
        return np.asarray((np.abs(x) < 0.5 * across) & (y > 0.0) & (y < along) & (z > 0.0) & (z < 2.0 * _PAN_WALL[1]))

    def evaluate(self, robot: SimulatedRobot, rollout: Rollout) -> Rollout:
        """Return ``rollout`` with success or the reasons for failure (dirt outside the pan, contact, not finished).

        The rollout's ``details`` contain ``"swept"`` (whether each crumb is in the pan) and ``"swept_fraction"`` (the
        fraction of these crumbs).
        """
        swept = self.swept(robot)
        fraction = float(swept.mean())
        faults = [] if rollout.success else [rollout.reason]
        if fraction < self.required_fraction:
            faults.append(f"{int((~swept).sum())} of {self.n_crumbs} crumbs are not in the pan")
        if robot.contact_steps == 0 and rollout.min_clearance <= 0.0:
            faults.append(f"an obstacle was touched: clearance {1e3 * rollout.min_clearance:.1f} mm")
        details = {**rollout.details, "swept_fraction": fraction, "swept": swept}
        return replace(rollout, success=not faults, reason="; ".join(faults) or "dirt in the pan", details=details)


def table_top() -> Box:
    """Return the table top as a box of finite size; beyond its edges, a camera sees the floor."""
    place = Pose(np.array([*TABLE_CENTER, -0.5 * TABLE_SIZE[2]]), np.array([1.0, 0.0, 0.0, 0.0]))
    return Box(place, np.array(TABLE_SIZE), name="table")


def _add_table(spec: mujoco.MjSpec) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    half = 0.5 * np.array(TABLE_SIZE)
    table = spec.worldbody.add_body(name="table", pos=[*TABLE_CENTER, -half[2]])
    table.add_geom(name="table", type=box, size=half, rgba=_WOOD, friction=[0.5, 0.005, 0.0001])
    for i, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        place = [sx * (half[0] - 0.04), sy * (half[1] - 0.04), -half[2] - 0.355]
        table.add_geom(name=f"table/leg{i}", type=box, size=[0.025, 0.025, 0.355], pos=place, rgba=_LEG)


def _add_dustpan(spec: mujoco.MjSpec, goal: Array) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    (across, along), (thick, high) = _PAN_INSIDE, _PAN_WALL
    pan = spec.worldbody.add_body(name="dustpan", pos=[goal[0], goal[1] - _PAN_BEFORE_GOAL + 0.5 * along, 0.0])
    pan.add_geom(  # its floor is level with the table, so it is only visual
        name="dustpan/floor", type=box, size=[0.5 * across, 0.5 * along, 0.0005], rgba=_PAN, contype=0, conaffinity=0
    )
    side = [0.5 * thick, 0.5 * along + thick, 0.5 * high]
    for name, x in (("near", -1.0), ("far", 1.0)):
        place = [x * 0.5 * (across + thick), 0.0, 0.5 * high]
        pan.add_geom(name=f"dustpan/{name}", type=box, size=side, pos=place, rgba=_PAN)
    back = [0.5 * across, 0.5 * thick, 0.5 * high]
    pan.add_geom(name="dustpan/back", type=box, size=back, pos=[0.0, 0.5 * (along + thick), 0.5 * high], rgba=_PAN)
    pan.add_geom(
        name="dustpan/handle",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.010, 0.05, 0.0],
        pos=[0.0, 0.5 * along + 0.065, 0.02],
        quat=[np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0],
        rgba=_PAN,
    )


def _add_crumb(spec: mujoco.MjSpec, name: str, place: Array, rotation: float) -> None:
    body = spec.worldbody.add_body(
        name=name, pos=[*place, _CRUMB], quat=[np.cos(0.5 * rotation), 0.0, 0.0, np.sin(0.5 * rotation)]
    )
    body.add_freejoint(name=name)
    size = [_CRUMB, _CRUMB, _CRUMB]
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, mass=0.001, rgba=_DIRT, friction=[0.5, 0.005, 0.0001]
    )
