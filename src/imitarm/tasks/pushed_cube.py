"""run_pushed_cube: a Panda sweeps with the policy RCAMO while a cube is pushed into the way of the brush."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.control_loop.camera_observer import CameraObserver
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.control_loop.reproduce import Step, reproduce
from imitarm.demonstrations import align, read
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import ObstacleTracker
from imitarm.policies import HORIZONTAL_ONLY
from imitarm.policies.rcamo import RCAMO
from imitarm.robots.simulated import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, HalfSpace, MovingScene, Scene, Track, standard_fixtures
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS, SweepTask, table_top
from imitarm.tasks.watching import PERIOD, delayed, watched
from imitarm.trajectory import Rollout

Array = NDArray[np.float64]
Observer = Callable[[MovingScene, SimulatedRobot, int], Callable[[float], Scene]]

LINKS = 0.01
"""Clearance that the safety filter keeps between the arm and obstacles [m]."""
_TIME_CONSTANT = 1.5  # [s] of RCAMO
_MAX_ACCELERATION = 4.0  # [m/s^2] of the brush of the Panda
_TIMEOUT = 2.0  # longest duration over the learned duration
_EYE, _MIDDLE = np.array([1.55, 0.0, 0.95]), np.array([0.58, -0.02, 0.05])  # [m]
_WORKSPACE = ((0.25, -0.65, 0.032), (1.05, 0.50, 0.5))  # [m] above the dirt and the walls of the dustpan

CUBE = "cube"
"""Name of the cube in the scene."""

_SIDES = (0.05, 0.09)  # [m] of the cube
_OUTSIDE = 0.21  # [m] from the path to the place where the cube waits between two pushes
_SPEEDS = (0.1, 0.4)  # [m/s] of a push
_BESIDE = (-0.02, 0.06)  # [m] from the path to the place to which the cube is pushed, towards the waiting place
_EARLY = (0.3, 1.5)  # [s] the cube arrives on the path so long before the learned motion does
_STAYS = (0.5, 2.5)  # [s] the cube stands on the path
_WAY = ((-0.36, -0.24), (0.10, 0.24))  # [m] range of y of the two pushes: before the dirt, and behind it


class _Push(NamedTuple):
    """One push: when the cube arrives on the path [s], where (2,) [m], how long it stays [s], its speed [m/s]."""

    time: float
    place: Array
    stays: float
    speed: float


def pushed_cube(seed: int, skill: Skill) -> MovingScene:
    """Return a scene in which a cube is pushed onto the path of the sweep twice (thesis Fig 5.5).

    The first push reaches the path before the dirt, the second push behind the dirt, so the cube never moves the dirt.
    The size of the cube, the side from which it is pushed, and the places, times and speeds of the pushes are random.
    After each push, the cube stands still on the path for some time, and is then pulled back.

    Args:
        seed: seed of the random numbers.
        skill: the learned sweep. The cube arrives at the path shortly before the brush would on the learned path.
    """
    rng = np.random.default_rng([55, seed])
    side = rng.uniform(*_SIDES)
    towards = rng.choice([-1.0, 1.0])  # the cube waits on this side of the path
    path = skill.gmr_.trajectory(400)
    pushes, outside = [], []
    for low, high in _WAY:
        y = rng.uniform(low, high)
        k = int(np.argmin(np.abs(path.positions[:, 1] - y)))
        x = float(path.positions[k, 0])
        place = np.array([x + towards * rng.uniform(*_BESIDE), y])
        early, stays, speed = rng.uniform(*_EARLY), rng.uniform(*_STAYS), rng.uniform(*_SPEEDS)
        pushes.append(_Push(float(path.times[k]) - early, place, stays, speed))
        outside.append(np.array([x + towards * (_OUTSIDE + 0.5 * side), y + rng.uniform(-0.05, 0.05)]))
    track = _track(pushes, outside, 0.5 * side)
    cube = Box(Pose(track.positions[0], np.array([1.0, 0.0, 0.0, 0.0])), np.full(3, side), name=CUBE)
    fixtures = (HalfSpace(np.zeros(3), name="table"), *standard_fixtures())
    return MovingScene(Scene(None, (cube,), fixtures=fixtures), {CUBE: track})


def _track(pushes: list[_Push], outside: list[Array], height: float) -> Track:
    """Return the way of the cube: wait outside, be pushed in, stand, be pulled out, for each push."""
    times, places = [0.0], [outside[0]]
    for push, wait in zip(pushes, outside, strict=True):
        lasts = float(np.linalg.norm(push.place - wait)) / push.speed
        along = float(np.linalg.norm(wait - places[-1])) / _SPEEDS[1]  # from one waiting place to the next
        begins = max(push.time - lasts, times[-1] + along + 0.1)
        ends = begins + lasts
        times += [begins, ends, ends + push.stays, ends + push.stays + lasts]
        places += [wait, push.place, push.place, wait]
    positions = np.column_stack([np.array(places), np.full(len(places), height)])
    return Track(np.array(times), positions)


@lru_cache(maxsize=1)
def learned_sweep() -> Skill:
    """Learn the sweep from the packaged demonstrations, and return the skill."""
    return Skill().fit(align(read(DEMONSTRATIONS)))


def sweeping_rcamo(
    skill: Skill, task: SweepTask, *, max_acceleration: float, tool_spheres: ArrayLike | None = None
) -> RCAMO:
    """Return the policy RCAMO for the sweep.

    The brush stays on the table and avoids obstacles only to the left or right.

    Args:
        skill: the learned sweep.
        task: the task, with the radius of the brush and the required clearance.
        max_acceleration: largest acceleration of the brush away from the learned path [m/s^2]. If the joints of the arm
            can't follow this acceleration, the brush tilts and touches the table.
        tool_spheres: spheres that keep the clearance, rows x, y, z, radius in the tool's frame [m]; None: one sphere
            around the brush.
    """
    return RCAMO(
        skill,
        tool_spheres=[[0.0, 0.0, 0.0, task.tool_radius]] if tool_spheres is None else tool_spheres,
        clearance=task.clearance,
        forbidden=HORIZONTAL_ONLY,
        time_constant=_TIME_CONSTANT,
        max_acceleration=max_acceleration,
        max_push=max_acceleration,
    )


def run_pushed_cube(
    seed: int,
    *,
    arm: ArmModel | None = None,
    observer: Observer | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Rollout:
    """Sweep once with the Panda while a cube is pushed onto the path (thesis Fig 5.5).

    Args:
        seed: seed of the cube's motion, of the dirt and of the noise.
        arm: the arm with the brush; None: the Panda, loaded here.
        observer: function of the true scene, the simulated robot and the seed, one of :data:`CUBE_OBSERVERS`. It
            returns the argument ``observe`` of :func:`~imitarm.control_loop.reproduce`. None: :func:`sensed_cube`.
        on_step: function called after each control step.

    Returns:
        The measured motion, evaluated by :meth:`SweepTask.evaluate`.
    """
    task, skill = SweepTask(seed), learned_sweep()
    arm = SweepTask.arm("panda") if arm is None else arm
    truth = pushed_cube(seed, skill)
    robot = task.robot(delayed(truth) if observer is watched_cube else truth, arm=arm)
    observe = (sensed_cube if observer is None else observer)(truth, robot, seed)
    done = reproduce(
        sweeping_rcamo(skill, task, max_acceleration=_MAX_ACCELERATION),
        robot,
        observe,
        dt=PERIOD,
        timeout=_TIMEOUT * skill.duration_,
        safety=SafetyFilter(arm, dt=PERIOD, clearance=LINKS),
        on_step=on_step,
    )
    return task.evaluate(robot, done)


def sensed_cube(truth: MovingScene, robot: SimulatedRobot, seed: int) -> Callable[[float], Scene]:
    """Observe the cube with a simulated sensor (noise 5 mm, 30 Hz, latency 33 ms) and a tracker."""
    del robot
    return TrackedScene(truth, SensorModel(seed=seed), ObstacleTracker())


def exact_cube(truth: MovingScene, robot: SimulatedRobot, seed: int) -> Callable[[float], Scene]:
    """Observe the true cube, with its true velocity and without delay."""
    del robot, seed
    return truth.at


def watched_cube(truth: MovingScene, robot: SimulatedRobot, seed: int) -> CameraObserver:
    """Observe the cube with a depth camera in front of the table; the camera starts one second before the arm moves."""
    surfaces, fixtures = [table_top(), *standard_fixtures()], truth.scene.fixtures
    return watched(robot, _EYE, _MIDDLE, _WORKSPACE, surfaces=surfaces, fixtures=fixtures, seed=seed)


CUBE_OBSERVERS: dict[str, Observer] = {"exact": exact_cube, "sensor": sensed_cube, "camera": watched_cube}
"""Ways to observe the cube, by name."""
