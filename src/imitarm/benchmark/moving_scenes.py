"""Scenes of ``imitarm benchmark moving``: in every scene, moving obstacles hit a tool that follows the learned motion.

| family | obstacles |
|---|---|
| M1 | an obstacle that crosses the path at an angle of 50 to 130 degrees |
| M2 | an obstacle that comes towards the tool |
| M3 | an obstacle that moves in the direction of the tool, and overtakes the tool or is overtaken |
| M4 | an obstacle that crosses the path, and stops several times on its way |
| M5 | an obstacle that weaves or moves on a circle, so that its velocity is never constant |
| M6 | 3 to 6 obstacles, whose paths cross one another |
| M7 | an obstacle that appears suddenly, 10 to 30 cm from the tool |
| M8 | one moving obstacle, and one or two obstacles at rest on the path |
| M9 | an obstacle that rotates about its centre while it moves |
| M10 | a person's arm, as two capsules, from recordings of real persons |

At a random time, an obstacle is where the tool would be on the learned path. The speed of an obstacle is 0.1 to 0.6
m/s. A random scene is used only if it meets three conditions. The learned motion touches an obstacle. No obstacle
covers the start at the beginning. No obstacle covers the goal between 1 and 1.6 times the learned duration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.families import ALL_KINDS, CLEARANCE, TOOL_RADIUS, obstacles_apart, random_obstacle
from imitarm.benchmark.moving_motions import appearing, stop_and_go, straight, turning, weaving
from imitarm.benchmark.person_arm import person_arm
from imitarm.benchmark.static_scenes import BLOCKED, Directions, learned_skill
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_exp, rotate
from imitarm.policies.adaptation import HORIZONTAL_ONLY
from imitarm.scene import Box, Capsule, Ellipsoid, MovingScene, Obstacle, Scene
from imitarm.scene.motion import Motion
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

SLOWEST, FASTEST = 0.1, 0.6
"""Smallest and largest speed of an obstacle [m/s]. A person's arm (family M10) has its recorded speed instead."""
LONGEST = 1.6
"""From the end of the learned motion until this multiple of the learned duration, no obstacle covers the goal."""
_MET = 0.25, 0.7  # fractions of the duration between which an obstacle meets the tool
_OFF = 0.012  # [m] standard deviation of the meeting point about the path
_FREE = TOOL_RADIUS + CLEARANCE + 0.005  # [m] from the tool's tip, at the start and at the goal
_DENSE = 200  # times per duration at which the learned motion is checked
_DRAWS = 3000  # of a scene
_APPEARS = 0.10, 0.30  # [m] from the tool
_EARLIEST = 0.3  # [s] at which something appears
_KNOWN = 0.5  # [s] before the start, from which on obstacles must not overlap the tool
_APART = 0.005  # [m] between two obstacles


@dataclass(frozen=True, eq=False)
class MovingCase:
    """One scene with moving obstacles.

    Attributes:
        family: name of the family, one of :data:`FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: number of the scene.
        skill: the skill whose motion the obstacles block.
        truth: the true motion of the obstacles, which begins before time 0.
        touched: time at which the learned motion without avoidance first touches an obstacle [s].
        tool_spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required clearance [m].
        forbidden: directions in which the path must not be displaced.
    """

    family: str
    dimension: int
    seed: int
    skill: Skill
    truth: MovingScene
    touched: float
    tool_spheres: Array = field(default_factory=lambda: np.array([[0.0, 0.0, 0.0, TOOL_RADIUS]]))
    clearance: float = CLEARANCE
    forbidden: Directions = ()


class _Placed(NamedTuple):
    """Obstacles at time 0, and the motions of some of them."""

    obstacles: tuple[Obstacle, ...]
    motions: dict[str | int, Motion]


class _Draw(NamedTuple):
    """Input of the functions that place obstacles: random numbers, and the learned path."""

    rng: np.random.Generator
    path: Trajectory
    planar: bool

    def meeting(self) -> tuple[float, Array, Array]:
        """Return a random time, a place near the tool at this time, and the unit vector along the path there."""
        time = float(self.rng.uniform(*_MET)) * self.path.duration
        before, at, after = self.path.at([time - 0.02, time, time + 0.02])[0]
        ahead = (after - before) / np.linalg.norm(after - before)
        return time, at + _OFF * self.rng.normal(size=3) * self._free(), ahead

    def heading(self, ahead: Array, least: float, most: float) -> Array:
        """Return a random unit vector, ``least`` to ``most`` degrees from ``ahead``."""
        angle = math.radians(self.rng.uniform(least, most))
        across = self.rng.normal(size=3) * self._free()
        forward = ahead * self._free()
        forward = forward / np.linalg.norm(forward)
        across -= (across @ forward) * forward
        return np.asarray(math.cos(angle) * forward + math.sin(angle) * across / np.linalg.norm(across))

    def speed(self, least: float = SLOWEST, most: float = FASTEST) -> float:
        """Return a random speed [m/s]."""
        return float(self.rng.uniform(least, most))

    def obstacle(self, centre: Array) -> Obstacle:
        """Return an obstacle of a random shape."""
        return random_obstacle(self.rng, centre, planar=self.planar, kinds=ALL_KINDS)

    def aimed(self, least: float, most: float) -> Obstacle:
        """Return an obstacle that meets the tool, at an angle from the tool's direction in degrees."""
        time, at, ahead = self.meeting()
        velocity = self.speed() * self.heading(ahead, least, most)
        return replace(self.obstacle(at - time * velocity), velocity=velocity)

    def _free(self) -> Array:
        return np.array([1.0, 1.0, 0.0 if self.planar else 1.0])


def moving_case(family: str, dimension: int, seed: int, *, skill: Skill | None = None) -> MovingCase:
    """Return one scene. The same arguments give the same scene on every machine.

    Args:
        family: one of :data:`FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: seed of the scene. Seeds 1000 to 1199 are for tuning, and seeds 2000 to 3999 are for testing.
        skill: skill whose path the obstacles block; None: the S-shaped reach of the static benchmark.

    Raises:
        UnknownNameError: when there is no such family.
        InputError: when an argument is out of range, recordings are missing (M10), or no scene is found.
    """
    if family not in FAMILIES:
        raise UnknownNameError.among("family of moving scenes", family, FAMILIES)
    if dimension not in (2, 3) or seed < 0:
        raise InputError(f"moving_case: dimension must be 2 or 3 and seed at least 0, got {dimension} and {seed}")
    own = learned_skill("S1", dimension) if skill is None else skill
    times = np.linspace(0.0, own.duration_, 400)
    path = own.nominal(times)
    rng = np.random.default_rng([100 + int(family[1:]), dimension, seed])
    draw = _Draw(rng, path, dimension == 2)
    for _ in range(_DRAWS):
        placed = _FAMILIES[family](draw)
        if placed is None:
            continue
        truth = MovingScene(Scene(None, placed.obstacles), placed.motions)
        truth = MovingScene(Scene(None, truth.at(0.0).obstacles), placed.motions)  # each begins where its motion does
        touched = _touched(truth, path)
        if touched is not None:
            forbidden = HORIZONTAL_ONLY if dimension == 2 else ()
            return MovingCase(family, dimension, seed, own, truth, touched, forbidden=forbidden)
    raise InputError(
        f"no scene of {family} could be made in which obstacles block the path but not its start and goal; choose "
        "another skill"
    )


def distances_in_time(truth: MovingScene | Scene, times: Array, points: Array) -> Array:
    """Return the signed distance between a moving point and each obstacle, shape (n_obstacles, n) [m].

    Args:
        truth: the true obstacles over time.
        times: shape (n,) [s].
        points: position of the point at each time, shape (n, 3) [m].
    """
    scene = truth if isinstance(truth, Scene) else truth.scene
    found = np.empty((len(scene.obstacles), len(times)))
    places = [truth.poses(float(t)) for t in times]
    for i, obstacle in enumerate(scene.obstacles):
        solid = obstacle.solid()
        at = np.array([positions[i] for positions, _ in places])
        turned = np.array([quaternions[i] for _, quaternions in places])
        found[i] = obstacle.signed_distance(_as_seen(points, at, turned, solid.position, solid.quaternion))
    return found


def _as_seen(points: Array, positions: Array, quaternions: Array, home: Array, at_home: Array) -> Array:
    """Return the points, moved so that they stand to the obstacle at home as they stand to the moved obstacle."""
    local = rotate(quaternion_conjugate(quaternions), points - positions)
    return np.asarray(rotate(np.broadcast_to(at_home, quaternions.shape), local) + home)


def _touched(truth: MovingScene, path: Trajectory) -> float | None:
    """Return when the tool of the learned motion touches an obstacle; None if the scene is void."""
    start, goal, duration = path.positions[0], path.positions[-1], path.duration
    early, late = np.linspace(-_KNOWN, 0.15, 14), np.linspace(duration, LONGEST * duration, 40)
    for times, point in ((early, start), (late, goal)):
        if distances_in_time(truth, times, np.broadcast_to(point, (len(times), 3))).min() < _FREE:
            return None
    times = np.linspace(0.0, duration, _DENSE)
    gap = distances_in_time(truth, times, path.at(times)[0]).min(axis=0) - TOOL_RADIUS
    if gap.min() >= -BLOCKED or _overlap(truth, duration):
        return None
    return float(times[int(np.argmax(gap <= 0.0))])


def _overlap(truth: MovingScene, duration: float) -> bool:
    """Return whether two obstacles are in the same place at some time, by the spheres that contain them."""
    n = len(truth.scene.obstacles)
    if n == 1 or any(isinstance(o, Capsule) and o.name for o in truth.scene.obstacles):  # parts of one arm
        return False
    radii = truth.scene.packed.radii
    at = np.array([truth.poses(float(t))[0] for t in np.linspace(0.0, LONGEST * duration, 60)])
    apart = np.linalg.norm(at[:, :, None] - at[:, None], axis=3).min(axis=0)
    pairs = np.triu_indices(n, 1)
    return bool((apart - radii[:, None] - radii)[pairs].min() < -0.5 * _APART - 0.6 * radii.min())


def _one(obstacle: Obstacle, motion: Motion | None = None) -> _Placed:
    return _Placed((obstacle,), {} if motion is None else {0: motion})


def _crossing(draw: _Draw) -> _Placed:
    return _one(draw.aimed(50.0, 130.0))


def _oncoming(draw: _Draw) -> _Placed:
    return _one(draw.aimed(150.0, 180.0))


def _chasing(draw: _Draw) -> _Placed:
    return _one(draw.aimed(0.0, 30.0))


def _stopping(draw: _Draw) -> _Placed:
    time, at, ahead = draw.meeting()
    obstacle = draw.obstacle(at)
    velocity = draw.speed(0.2) * draw.heading(ahead, 40.0, 180.0)
    return _one(obstacle, stop_and_go(draw.rng, obstacle, time, velocity, LONGEST * draw.path.duration))


def _manoeuvring(draw: _Draw) -> _Placed:
    time, at, ahead = draw.meeting()
    obstacle = draw.obstacle(at)
    velocity = draw.speed(0.1, 0.4) * draw.heading(ahead, 40.0, 180.0)
    side = draw.heading(velocity, 90.0, 90.0)
    make = weaving if draw.rng.random() < 0.5 else turning
    return _one(obstacle, make(draw.rng, obstacle, time, velocity, side, FASTEST))


def _many(draw: _Draw) -> _Placed:
    """One obstacle meets the tool. All other obstacles pass near this obstacle, on paths that cross its path."""
    first = draw.aimed(30.0, 180.0)
    made = [first]
    for _ in range(int(draw.rng.integers(2, 6))):
        time = float(draw.rng.uniform(0.1, 1.1)) * draw.path.duration
        beside = draw.rng.uniform(0.08, 0.2) * draw.heading(first.velocity, 0.0, 180.0)
        velocity = draw.speed() * draw.heading(first.velocity, 30.0, 180.0)
        there = first.solid().position + time * first.velocity + beside
        made.append(replace(draw.obstacle(there - time * velocity), velocity=velocity))
    return _Placed(tuple(made), {})


def _sudden(draw: _Draw) -> _Placed | None:
    """An obstacle that nobody sees until it is 10 to 30 cm from the tool."""
    obstacle = draw.aimed(40.0, 180.0)
    times = np.arange(0.0, draw.path.duration, 0.01)
    gap = distances_in_time(Scene(None, (obstacle,)), times, draw.path.at(times)[0])[0] - TOOL_RADIUS
    near = np.flatnonzero(gap < draw.rng.uniform(*_APPEARS))
    if not len(near) or times[near[0]] < _EARLIEST or gap[near[0]] < _APPEARS[0] - 0.01:
        return None
    return _one(replace(obstacle, velocity=np.zeros(3)), appearing(straight(obstacle), float(times[near[0]])))


def _with_standing(draw: _Draw) -> _Placed | None:
    """One that moves, and one or two that stand on the path."""
    n = int(draw.rng.integers(1, 3))
    try:
        standing = obstacles_apart(draw.rng, draw.path.positions, n, planar=draw.planar, kinds=ALL_KINDS)
    except InputError:
        return None
    moving = draw.aimed(30.0, 180.0)
    touches = _touched(MovingScene(Scene(None, (moving,))), draw.path)
    return None if touches is None else _Placed((moving, *standing), {})


def _rotating(draw: _Draw) -> _Placed:
    """A long obstacle that rotates and drifts; in 2-D about the vertical axis."""
    time, at, ahead = draw.meeting()
    long, thick = draw.rng.uniform(0.06, 0.11), draw.rng.uniform(0.012, 0.025)
    velocity = draw.speed(0.0, 0.3) * draw.heading(ahead, 0.0, 180.0)
    spin = np.array([0.0, 0.0, 1.0]) if draw.planar else draw.rng.normal(size=3)
    spin *= draw.rng.choice([-1.0, 1.0]) * draw.rng.uniform(0.5, 2.0) / np.linalg.norm(spin)
    turn = quaternion_exp(np.array([0.0, 0.0, draw.rng.uniform(-np.pi, np.pi)]))
    pose = Pose(at + draw.rng.uniform(0.0, long) * draw.heading(ahead, 0.0, 180.0) - time * velocity, turn)
    kind = int(draw.rng.integers(3))
    if kind == 0:
        body: Obstacle = Box(pose, 2.0 * np.array([long, thick, thick]))
    elif kind == 1:
        body = Ellipsoid(pose, np.array([long, thick, thick]))
    else:
        half = pose.rotation[:, 0] * (long - thick)
        body = Capsule(pose.position - half, pose.position + half, thick)
    return _one(replace(body, velocity=velocity, angular_velocity=spin))


def _person(draw: _Draw) -> _Placed:
    time, at, _ = draw.meeting()
    arm, motions = person_arm(draw.rng, time, at, LONGEST * draw.path.duration)
    return _Placed(arm, dict(enumerate(motions)))


_FAMILIES: dict[str, Callable[[_Draw], _Placed | None]] = {
    "M1": _crossing,
    "M2": _oncoming,
    "M3": _chasing,
    "M4": _stopping,
    "M5": _manoeuvring,
    "M6": _many,
    "M7": _sudden,
    "M8": _with_standing,
    "M9": _rotating,
    "M10": _person,
}
FAMILIES: tuple[str, ...] = tuple(_FAMILIES)
