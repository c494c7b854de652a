"""Sweep dirt on a table into a dustpan, around what stands in the way (thesis Figs 4.5 to 4.8)."""

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
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.posture import find_posture
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.robots.world import arm_world
from imitarm.scene import Scene, load_scene
from imitarm.trajectory import Rollout, Trajectory

Array = NDArray[np.float64]

DEMONSTRATIONS = Path(__file__).parent / "data" / "sweep"  # one CSV file for each demonstration
SCENES = ("free", "two_boxes", "tall_and_low", "boxes_and_cone", "cone_first")

TABLE_CENTER, TABLE_SIZE = (0.66, 0.0), (0.72, 1.36, 0.04)  # [m] its top is at height 0
HOVER = 0.003  # [m] the bristles' tips above the table
SWEEPING = (0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0)  # wxyz: the tool looks down, its open side along the base's y

_PAN_INSIDE = (0.25, 0.15)  # [m] across and along the sweep
_PAN_WALL = (0.004, 0.025)  # [m] thickness and height
_PAN_BEFORE_GOAL = 0.085  # [m] from the pan's mouth to where the tool ends
_CRUMB = 0.004  # [m] half of a crumb's size
_SPREAD = 0.016  # [m] crumbs lie within this distance from the dirt's middle

_WOOD, _LEG, _PAN, _DIRT = (
    (0.80, 0.68, 0.52, 1.0),
    (0.30, 0.27, 0.25, 1.0),
    (0.16, 0.48, 0.52, 1.0),
    (0.24, 0.16, 0.10, 1.0),
)


@dataclass(frozen=True)
class SweepTask:
    """A Sawyer with a curved brush, dirt on a table, a dustpan let into it.

    The brush starts at S, goes to the dirt at T and pushes it to G inside the dustpan. It hovers above the table
    with its open side ahead, so its two arms keep the crumbs while it gives way to the left or right.
    Success is dirt in the pan and no contact of the arm or the brush with an obstacle.

    Attributes:
        seed: of the crumbs' positions.
        n_crumbs: how many crumbs lie about T.
        required_share: share of the crumbs that must end in the pan.
    """

    seed: int = 0
    n_crumbs: int = 6
    required_share: float = 1.0

    start: ClassVar[Pose] = Pose(np.array([0.58, -0.48, HOVER]), np.array(SWEEPING))  # S
    dirt: ClassVar[Pose] = Pose(np.array([0.61, -0.08, HOVER]), np.array(SWEEPING))  # T
    goal: ClassVar[Pose] = Pose(np.array([0.65, 0.40, HOVER]), np.array(SWEEPING))  # G
    tool_radius: ClassVar[float] = 0.058  # [m] the brush's own 55 mm, and 3 mm for its tilt and for lag
    clearance: ClassVar[float] = 0.02  # [m] that a reproduction should keep

    def __post_init__(self) -> None:
        if self.n_crumbs < 1 or not 0.0 < self.required_share <= 1.0:
            raise InputError(
                "SweepTask: needs at least one crumb and a required_share in (0, 1], "
                f"got {self.n_crumbs} and {self.required_share}"
            )

    @staticmethod
    def arm() -> ArmModel:
        """Return the Sawyer with the brush."""
        return ArmModel.load("sawyer", tool="brush")

    @staticmethod
    def scene(name: str) -> Scene:
        """Return the packaged scene ``name``, one of :data:`SCENES`.

        Raises:
            UnknownNameError: when there is no such scene.
        """
        if name not in SCENES:
            raise UnknownNameError.among("scene", name, SCENES)
        return Scene() if name == "free" else load_scene(DEMONSTRATIONS / "scenes" / f"{name}.yaml")

    @classmethod
    def scenes(cls) -> Mapping[str, Scene]:
        """Return all packaged scenes by name, the one without obstacles first."""
        return {name: cls.scene(name) for name in SCENES}

    def dirt_time(self, trajectory: Trajectory) -> float:
        """Return when ``trajectory`` is nearest to the dirt [s]: an instant at which a path should not give way."""
        away = np.linalg.norm(trajectory.positions - self.dirt.position, axis=1)
        return float(trajectory.times[np.argmin(away)])

    def crumb_positions(self) -> Array:
        """Return where the crumbs lie at first, shape (n_crumbs, 2) [m]: apart from each other, within 16 mm of T."""
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
        turns = np.random.default_rng([self.seed, 1]).uniform(0.0, np.pi, self.n_crumbs)
        for i, (place, turn) in enumerate(zip(self.crumb_positions(), turns, strict=True)):
            _add_crumb(spec, f"crumb/{i}", place, turn)
        return spec

    def robot(
        self, scene: Scene | None = None, *, arm: ArmModel | None = None, control: Control = "position"
    ) -> SimulatedRobot:
        """Return the simulated robot with its brush at S, in ``scene``.

        Args:
            scene: obstacles on the table; None for none.
            arm: the arm, when it is loaded already.
            control: of the drives.
        """
        arm = self.arm() if arm is None else arm
        return SimulatedRobot(arm, scene=scene, world=self.world(arm), control=control, q=self.start_posture(arm))

    def start_posture(self, arm: ArmModel) -> Array:
        """Return joint angles (n_joints,) [rad] with the brush at S."""
        return find_posture(arm, self.start)

    def swept(self, robot: SimulatedRobot) -> NDArray[np.bool_]:
        """Tell which crumbs lie in the pan now, shape (n_crumbs,)."""
        crumbs = np.array([robot.data.body(f"crumb/{i}").xpos for i in range(self.n_crumbs)])
        across, along = _PAN_INSIDE
        x, y, z = (crumbs - [self.goal.position[0], self.goal.position[1] - _PAN_BEFORE_GOAL, 0.0]).T
        return np.asarray((np.abs(x) < 0.5 * across) & (y > 0.0) & (y < along) & (z > 0.0) & (z < 2.0 * _PAN_WALL[1]))

    def judge(self, robot: SimulatedRobot, rollout: Rollout) -> Rollout:
        """Return ``rollout`` with the task's verdict: success is dirt in the pan, no contact, finished in time.

        ``details`` gets ``"swept_share"`` (of the crumbs) and ``"swept"`` (for each crumb).
        """
        swept = self.swept(robot)
        share = float(swept.mean())
        faults = [] if rollout.success else [rollout.reason]
        if share < self.required_share:
            faults.append(f"{int((~swept).sum())} of {self.n_crumbs} crumbs are not in the pan")
        if robot.contact_steps == 0 and rollout.min_clearance <= 0.0:
            faults.append(f"an obstacle was reached: clearance {1e3 * rollout.min_clearance:.1f} mm")
        details = {**rollout.details, "swept_share": share, "swept": swept}
        return replace(rollout, success=not faults, reason="; ".join(faults) or "dirt in the pan", details=details)


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
    pan.add_geom(  # its floor is flush with the table, so it is only seen
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


def _add_crumb(spec: mujoco.MjSpec, name: str, place: Array, turn: float) -> None:
    body = spec.worldbody.add_body(
        name=name, pos=[*place, _CRUMB], quat=[np.cos(0.5 * turn), 0.0, 0.0, np.sin(0.5 * turn)]
    )
    body.add_freejoint(name=name)
    size = [_CRUMB, _CRUMB, _CRUMB]
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, mass=0.001, rgba=_DIRT, friction=[0.5, 0.005, 0.0001]
    )
