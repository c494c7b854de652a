"""Static scenes of ``imitarm benchmark static``. Each family of scenes has a different kind of obstacles.

| family | obstacles | solution, by the construction of the scene |
|---|---|---|
| S1 | sparse: 1 or 2 spheres and boxes on the path | yes |
| S2 | dense: 4 to 8 spheres and boxes on and beside the path | not known |
| S3 | mixed: 1 to 3 obstacles of all shapes on the path | yes |
| S4 | a wall with a gap, 1.2 to 3 times as wide as the tool | depends on the width of the gap |
| S5 | a trap: three boxes in the shape of a U that opens towards the path, 5 to 20 cm deep | yes |
| S6 | an obstacle over the start, the goal or a contact point | no |
| S7 | the sweep around 2 to 4 boxes and cones: the scenes T1 to T8 with small changes | not known |
| S9 | reach into an open box, with 1 to 3 obstacles on the path | not known |

The learned motion is an S-shaped reach in S1 to S6, the sweep of :class:`~imitarm.tasks.sweep.SweepTask` in S7, and the
reach of :class:`~imitarm.tasks.open_box.OpenBoxTask` in S9. Scenes for the whole arm (S8) are in
:mod:`imitarm.benchmark.placements`. In every scene except those of S6, a tool on the learned path would touch an
obstacle.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.families import (
    ALL_KINDS,
    CLEARANCE,
    SIMPLE,
    TOOL_RADIUS,
    covering_sphere,
    obstacles_apart,
    random_obstacle,
    wall_with_gap,
)
from imitarm.demonstrations import align
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.policies.adaptation import HORIZONTAL_ONLY, NOT_DOWN
from imitarm.scene import Box, Obstacle, Scene
from imitarm.scene.obstacle import PosedObstacle
from imitarm.skills.gmm import DegenerateAxisWarning
from imitarm.skills.skill import Skill
from imitarm.tasks.habits import Motion, demonstrations_by, s_shaped_reach
from imitarm.tasks.open_box import OpenBoxTask
from imitarm.tasks.sweep import NUMBERED_SCENES, SweepTask

Array = NDArray[np.float64]
Directions = tuple[tuple[float, float, float], ...]

SPLITS = {"train": (0, 1000), "validation": (1000, 1200), "test": (2000, 4000)}  # seeds [first, end)
PATH_SAMPLES = 400  # of the learned path, on which obstacles are placed
BLOCKED = 0.003  # [m] depth to which the tool would enter an obstacle on the learned path

_FREE = 0.01  # [m] beyond the required clearance, that obstacles leave to the tool at points that must not move
_FREE_ENDS = TOOL_RADIUS + CLEARANCE + _FREE  # [m] likewise, for the tool of the reach
_COMPONENTS = 8  # of a skill
_DRAWS = 500  # of a scene, before its path counts as too short
_FAILURES = 6  # to find places for obstacles, likewise
_SPREAD_DENSE = 0.06  # [m] standard deviation of an obstacle's centre about the path, in dense scenes
_SKEW = 0.15  # [rad] standard deviation of the angle between a trap and the path
_TIGHT = 0.002  # [m] a gap with less than this to spare counts as neither solvable nor unsolvable
_MOVED, _ROTATED = 0.008, 0.1  # [m], [rad] standard deviations of the obstacles of a sweep from those of its scene
_BEFORE_BOX = 0.7  # fraction of the path before the box, on which obstacles stand
_MIDDLE = 0.3, 0.7  # fractions of the path between which a contact point or a trap is


@dataclass(frozen=True, eq=False)
class StaticCase:
    """One static scene around the path of a skill.

    A method must solve the scene if a solution exists, and refuse it otherwise.

    Attributes:
        family: name of the family, one of :data:`FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: seed of the scene.
        skill: the skill whose path the obstacles block.
        scene: the obstacles. The motion keeps its learned start and goal.
        tool_spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required [m].
        forbidden: directions in which the path must not be displaced.
        pinned: times at which the path must not be displaced [s]. At these times, the tool meets a contact point, such
            as dirt.
        must_refuse: True if no path exists; False if a path exists; None if the construction of the scene does not
            decide it.
        n_samples: number of samples along the path.
    """

    family: str
    dimension: int
    seed: int
    skill: Skill
    scene: Scene
    tool_spheres: Array
    clearance: float
    forbidden: Directions
    pinned: tuple[float, ...]
    must_refuse: bool | None
    n_samples: int = 200


class _Placed(NamedTuple):
    """Obstacles, with what their construction tells."""

    obstacles: tuple[Obstacle, ...]
    must_refuse: bool | None = None
    contact: float | None = None  # fraction of the duration


class _Draw(NamedTuple):
    """Input of the functions that place obstacles: random numbers, the learned path, and the number of obstacles."""

    rng: np.random.Generator
    path: Array  # (n, 3) [m]
    planar: bool
    seed: int
    n_obstacles: int | None  # None: at random

    def number(self, first: int, last: int) -> int:
        """Return a random number of obstacles from ``first`` to ``last``, or the requested one."""
        drawn = int(self.rng.integers(first, last + 1))
        return drawn if self.n_obstacles is None else self.n_obstacles


_Place = Callable[[_Draw], _Placed]


class _Family(NamedTuple):
    """A family of scenes: which motion is blocked, and how its obstacles are placed."""

    place: _Place
    motion: Callable[[bool], Motion]  # the argument: whether it is planar
    any_skill: bool = False  # whether the obstacles can be placed on any path
    tool_radius: float = TOOL_RADIUS  # [m]
    forbidden: Directions = ()  # in 3-D
    solvable: bool = True  # whether start, goal and contact point are free


@lru_cache(maxsize=32)
def learned_skill(family: str, dimension: int, teachers: int = 1) -> Skill:
    """Learn the skill of a family of scenes from synthetic teachers, with 8 Gaussian components.

    Args:
        family: one of :data:`FAMILIES`. Families with the same motion have the same skill.
        dimension: 2 or 3.
        teachers: number of teachers, with eight demonstrations each.
    """
    planar = dimension == 2
    first = next(name for name, other in _FAMILIES.items() if other.motion is _FAMILIES[family].motion)
    if first != family:
        return learned_skill(first, dimension, teachers)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateAxisWarning)  # a planar motion has no spread in z, on purpose
        return Skill(_COMPONENTS).fit(align(demonstrations_by(_FAMILIES[family].motion(planar), teachers)))


def learned_path(skill: Skill, n: int = PATH_SAMPLES) -> Array:
    """Return ``n`` positions along the nominal path of a skill, shape (n, 3) [m]."""
    return skill.nominal(np.linspace(0.0, skill.duration_, n)).positions


def static_case(
    family: str,
    dimension: int,
    seed: int,
    *,
    teachers: int = 1,
    skill: Skill | None = None,
    n_obstacles: int | None = None,
) -> StaticCase:
    """Return one static scene. The same arguments give the same scene on every machine.

    Args:
        family: one of :data:`FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: seed of the scene. :data:`SPLITS` lists the seeds for training, for tuning and for testing.
        teachers: number of teachers from whom the skill was learned.
        skill: skill whose path the obstacles block, only for the families in :data:`ANY_SKILL`; None: the skill of the
            family.
        n_obstacles: number of obstacles, only for the family S2; None: the seed determines the number.

    Raises:
        UnknownNameError: when there is no such family.
        InputError: when an argument is out of range, or the path of ``skill`` is too short for the obstacles.
    """
    if family not in FAMILIES:
        raise UnknownNameError.among("family of static scenes", family, FAMILIES)
    if dimension not in (2, 3) or seed < 0:
        raise InputError(f"static_case: dimension must be 2 or 3 and seed at least 0, got {dimension} and {seed}")
    if skill is not None and family not in ANY_SKILL:
        raise InputError(
            f"static_case: scenes of {family} need the skill of this family; omit skill=..., or choose a family from "
            f"{', '.join(ANY_SKILL)}"
        )
    if n_obstacles is not None and (family != "S2" or n_obstacles < 1):
        raise InputError(
            f"static_case: n_obstacles must be at least 1 and needs the family S2, got {n_obstacles} and {family}"
        )
    rng = np.random.default_rng([int(family[1:]), dimension, seed])
    its = _FAMILIES[family]
    own = learned_skill(family, dimension, teachers) if skill is None else skill
    placed = _blocking(its, _Draw(rng, learned_path(own), dimension == 2, seed, n_obstacles))
    known = placed.must_refuse if skill is None or placed.must_refuse else None  # another path may come back
    return StaticCase(
        family,
        dimension,
        seed,
        own,
        Scene(None, placed.obstacles),
        np.array([[0.0, 0.0, 0.0, its.tool_radius]]),
        CLEARANCE,
        HORIZONTAL_ONLY if dimension == 2 else its.forbidden,
        () if placed.contact is None else (placed.contact * own.duration_,),
        known,
    )


def _blocking(family: _Family, draw: _Draw) -> _Placed:
    """Draw scenes until the tool would enter an obstacle on the path, and the points that must not move are free."""
    failures = 0
    for _ in range(_DRAWS):
        try:
            placed = family.place(draw)
        except InputError:  # no place for so many obstacles: perhaps for fewer
            failures += 1
            if failures < _FAILURES:
                continue
            raise
        if not family.solvable:
            return placed
        scene = Scene(None, placed.obstacles)
        fixed = [0, -1, *(() if placed.contact is None else (round(placed.contact * (len(draw.path) - 1)),))]
        blocked = float(np.min(scene.clearance(draw.path))) < family.tool_radius - BLOCKED
        if blocked and float(np.min(scene.clearance(draw.path[fixed]))) >= family.tool_radius + CLEARANCE + _FREE:
            return placed
    raise InputError(
        "no scene could be made in which obstacles block the path but not its ends; choose a skill with a longer path"
    )


def _sparse(draw: _Draw) -> _Placed:
    return _Placed(obstacles_apart(draw.rng, draw.path, draw.number(1, 2), planar=draw.planar, kinds=SIMPLE), False)


def _mixed(draw: _Draw) -> _Placed:
    return _Placed(obstacles_apart(draw.rng, draw.path, draw.number(1, 3), planar=draw.planar, kinds=ALL_KINDS), False)


def _dense(draw: _Draw) -> _Placed:
    """Obstacles about the path, which may overlap; those that cover start or goal are drawn again."""
    made: list[Obstacle] = []
    n = draw.number(4, 8)
    for _ in range(_DRAWS):
        aside = _SPREAD_DENSE * draw.rng.normal(size=3) * ([1.0, 1.0, 0.0] if draw.planar else [1.0, 1.0, 1.0])
        obstacle = random_obstacle(
            draw.rng, draw.path[draw.rng.integers(len(draw.path))] + aside, planar=draw.planar, kinds=SIMPLE
        )
        if obstacle.signed_distance(draw.path[[0, -1]]).min() >= _FREE_ENDS:
            made.append(obstacle)
        if len(made) == n:
            break
    return _Placed(tuple(made), None)


def _gap(draw: _Draw) -> _Placed:
    """A wall with a gap; in 3-D, the gap is a window that is at least as high as it is wide."""
    width = 2.0 * TOOL_RADIUS * draw.rng.uniform(1.2, 3.0)
    walls = wall_with_gap(draw.rng, draw.path, width, shift=0.15, height=0.3 if draw.planar else 2.0)
    slack = width - 2.0 * (TOOL_RADIUS + CLEARANCE)
    must_refuse = None if 0.0 <= slack < _TIGHT else bool(slack < 0.0)
    if draw.planar:
        return _Placed(walls, must_refuse)
    height, level = draw.rng.uniform(1.0, 2.0) * width, draw.path[len(draw.path) // 2, 2] + draw.rng.uniform(-0.1, 0.1)
    left, right = walls
    centre, quaternion = 0.5 * (left.pose.position + right.pose.position), left.pose.quaternion
    sills = [
        Box(
            Pose(np.array([centre[0], centre[1], level + side * 0.5 * (height + 1.0)]), quaternion),
            np.array([left.size[0], width, 1.0]),
            name=name,
        )
        for side, name in ((1.0, "lintel"), (-1.0, "sill"))
    ]
    return _Placed((*walls, *sills), must_refuse)


def _trap(draw: _Draw) -> _Placed:
    """Three boxes in the shape of a U, into which the path leads; the hull of the U leaves start and goal free."""
    at = int(draw.rng.uniform(*_MIDDLE) * len(draw.path))
    ahead = draw.path[at + 5] - draw.path[at - 5]
    yaw = np.arctan2(ahead[1], ahead[0]) + draw.rng.normal(0.0, _SKEW)
    frame = Pose(draw.path[at], quaternion_exp(np.array([0.0, 0.0, yaw])))
    depth, thick = draw.rng.uniform(0.05, 0.20), draw.rng.uniform(0.01, 0.03)
    inside, height = 2.0 * TOOL_RADIUS * draw.rng.uniform(1.2, 2.5), 0.3 if draw.planar else draw.rng.uniform(0.1, 0.3)

    def box(name: str, x: float, y: float, length: float, width: float) -> Box:
        return Box(Pose(frame.apply([x, y, 0.0]), frame.quaternion), np.array([length, width, height]), name=name)

    outside, aside = inside + 2.0 * thick, 0.5 * (inside + thick)
    boxes = (
        box("bottom", 0.5 * thick, 0.0, thick, outside),
        box("left arm", -0.5 * depth, aside, depth, thick),
        box("right arm", -0.5 * depth, -aside, depth, thick),
    )
    hull = box("hull", 0.5 * (thick - depth), 0.0, depth + thick, outside)
    return _Placed(boxes if hull.signed_distance(draw.path[[0, -1]]).min() >= _FREE_ENDS else (), False)


def _over_a_point(draw: _Draw) -> _Placed:
    """An obstacle over the start, the goal or a contact point."""
    where = int(draw.rng.integers(3))
    contact = float(draw.rng.uniform(*_MIDDLE)) if where == 2 else None
    sample = round((len(draw.path) - 1) * (0.0, 1.0, contact or 0.0)[where])
    if contact is not None:
        contact = sample / (len(draw.path) - 1)
    return _Placed((covering_sphere(draw.rng, draw.path[sample], planar=draw.planar),), True, contact)


def _sweep(draw: _Draw) -> _Placed:
    """One of the scenes T1 to T8, each obstacle moved and rotated a little; the path must not move at the dirt."""
    scene = SweepTask.scene(list(NUMBERED_SCENES)[draw.seed % len(NUMBERED_SCENES)])
    made: list[Obstacle] = []
    for obstacle in scene.obstacles:
        turn = quaternion_exp(np.array([0.0, 0.0, draw.rng.normal(0.0, _ROTATED)]))
        shift = _MOVED * draw.rng.normal(size=3) * [1.0, 1.0, 0.0]
        assert isinstance(obstacle, PosedObstacle)
        pose = obstacle.pose
        made.append(replace(obstacle, pose=Pose(pose.position + shift, quaternion_multiply(turn, pose.quaternion))))
    at = int(np.argmin(np.linalg.norm(draw.path - SweepTask.dirt.position, axis=1)))
    return _Placed(tuple(made), contact=at / (len(draw.path) - 1))


def _open_box(draw: _Draw) -> _Placed:
    """The box, and obstacles on the path to it."""
    boards, n = OpenBoxTask.box(planar=draw.planar), draw.number(1, 3)
    if draw.planar:
        before = draw.path[: round(_BEFORE_BOX * len(draw.path))]
        return _Placed((*boards, *obstacles_apart(draw.rng, before, n, planar=True, kinds=ALL_KINDS)))
    return _Placed((*boards, *OpenBoxTask.obstacles(draw.rng, n, draw.path)))


def _reach(planar: bool) -> Motion:
    return s_shaped_reach(planar=planar)


def _sweep_motion(planar: bool) -> Motion:
    return SweepTask.motion()


def _box_motion(planar: bool) -> Motion:
    return OpenBoxTask.motion(planar=planar)


_FAMILIES: dict[str, _Family] = {
    "S1": _Family(_sparse, _reach, any_skill=True),
    "S2": _Family(_dense, _reach, any_skill=True),
    "S3": _Family(_mixed, _reach, any_skill=True),
    "S4": _Family(_gap, _reach),
    "S5": _Family(_trap, _reach),
    "S6": _Family(_over_a_point, _reach, any_skill=True, solvable=False),
    "S7": _Family(_sweep, _sweep_motion, tool_radius=SweepTask.tool_radius, forbidden=NOT_DOWN),
    "S9": _Family(_open_box, _box_motion, forbidden=NOT_DOWN),
}
FAMILIES: tuple[str, ...] = tuple(_FAMILIES)
ANY_SKILL = tuple(name for name, family in _FAMILIES.items() if family.any_skill)
