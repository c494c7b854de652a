"""What ``make bench`` times of the safety layer: a whole control tick among obstacles, and contact detection."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from itertools import count, cycle
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ik_rows import State, avoiding_mink, loop_states, obstacles, shaped
from imitarm.command import Command
from imitarm.control_loop import ContactDetector
from imitarm.kinematics import ik
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.pose import Pose
from imitarm.perception import Detection, ObstacleTracker
from imitarm.policies import RCAMO, Observation
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach
from timing import Row
from yardsticks import DT, mink_step, named

Array = NDArray[np.float64]

_CLEARANCE = 0.02  # [m]


def _moving(scene: Scene) -> Scene:
    """Return the spheres of a scene at 0.1 m/s, across the arm."""
    return Scene(None, tuple(Sphere(o.center, o.radius, velocity=(0.1, 0.0, 0.0)) for o in scene.obstacles))  # type: ignore[attr-defined]


def _setup() -> tuple[ArmModel, SafetyFilter, Scene, list[State], Pose]:
    arm = ArmModel.load("sawyer", tool="gripper")
    states = loop_states(IKSolver(arm, dt=DT))
    target = arm.tool_pose(states[-1].q + 0.01)
    return arm, SafetyFilter(arm, dt=DT, clearance=_CLEARANCE), obstacles(arm, 5), states, target


def _tick(arm: ArmModel, keeper: SafetyFilter, scene: Scene, states: list[State], target: Pose) -> Callable[[], Array]:
    """Return one control tick of the whole filter: rows of all links and of the arm itself, and the IK."""
    ticks = cycle(states)

    def step() -> Array:
        q, _, velocity = next(ticks)
        return keeper.step(Command(5.0 * arm.tool_pose(q).error_to(target)), q, velocity, scene).velocity

    return step


def tick_against_mink() -> Row:
    """The safety filter with 5 moving obstacles and self-clearance, against mink with its collision avoidance alone."""
    arm, keeper, scene, states, target = _setup()
    peer, theirs = avoiding_mink(arm, scene, states, target), cycle(states)
    moving = _moving(scene)

    def check() -> tuple[bool, str]:
        steps = [keeper.step(Command(np.zeros(6)), state.q, state.velocity, moving) for state in states]
        return all(
            step.safe for step in steps
        ), "a safe motion in every tick; theirs: obstacles at rest, no self-clearance"

    name = "safety filter, 5 moving obstacles, all links and self"
    reference = f"{named('mink')}, CollisionAvoidanceLimit"
    ours = _tick(arm, keeper, moving, states, target)
    return Row(name, ours, lambda: peer(next(theirs).q), reference, faster=1.0, check=check)


def _whole_tick(arm: ArmModel, keeper: SafetyFilter, scene: Scene, states: list[State]) -> Callable[[], Array]:
    """Return one control tick with everything in it: detections, tracker, RCAMO, the filter of all links, IK."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        skill = Skill(6).fit(demonstrations_by(s_shaped_reach(planar=False), 3))
    policy, tracker, ticks, noise = RCAMO(skill, arm=arm), ObstacleTracker(), count(), 1e-6 * np.eye(3)
    rest = np.zeros(arm.n_joints)
    n = len(states)
    # the obstacles move to and fro, so that they stay near in a measurement of any length
    there = [scene.at(DT * (k if k < n else 2 * n - k)).obstacles for k in range(2 * n)]
    frames = [[Detection(obstacle, noise) for obstacle in obstacles] for obstacles in there]

    def tick() -> Array:
        k = next(ticks)
        q, _, velocity = states[k % n]
        tracker.update(k * DT, frames[k % (2 * n)])
        now = Observation(k * DT, ArmState(q, velocity, rest, k * DT), arm.tool_pose(q), tracker.scene(k * DT))
        if k == 0:
            policy.reset(now)
        elif k % n == 0:
            policy.resume(now, 0.5)
        return keeper.step(policy.step(now, DT), q, velocity, now.scene).velocity

    return tick


def whole_tick_against_mink() -> Row:
    """A control tick with tracker, RCAMO and safety filter among 5 moving obstacles, against mink alone."""
    arm, keeper, scene, states, target = _setup()
    peer, theirs = avoiding_mink(arm, scene, states, target), cycle(states)
    ours = _whole_tick(arm, keeper, _moving(scene), states)

    def check() -> tuple[bool, str]:
        finite = all(bool(np.all(np.isfinite(ours()))) for _ in range(200))
        return finite, "ours: tracker, policy, all links and self; theirs: obstacles at rest, known exactly"

    name = "whole control tick, 5 moving obstacles"
    reference = f"{named('mink')}, CollisionAvoidanceLimit"
    return Row(name, ours, lambda: peer(next(theirs).q), reference, faster=1.0, check=check)


class OinkStep:
    """One step of roboplan's Oink: a frame task, limits of position and velocity, a barrier of the nearest pairs."""

    def __init__(self, arm: ArmModel, scene: Scene, states: list[State]) -> None:
        from roboplan import core, optimal_ik

        spec, _ = shaped(arm)
        spec.compile()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.xml"
            path.write_text(spec.to_xml(), encoding="utf-8")
            robot = core.Scene("arm", core.loadMjcfModel(path))
        self.shapes = len(robot.getRobotCollisionGeometryIds())
        robot.allowAdjacentLinkCollisions()
        for i, sphere in enumerate(scene.obstacles):
            place = np.eye(4, order="F")
            place[:3, 3] = sphere.center  # type: ignore[attr-defined]
            robot.addSphereGeometry(f"obstacle {i}", "universe", core.Sphere(sphere.radius), place, np.ones(4))  # type: ignore[attr-defined]
        robot.addGroup("joints", list(arm.joint_names))
        oink = optimal_ik.Oink(robot, "joints")
        tip = arm.cover.bodies[int(np.argmax(arm.cover.links))]
        whole = np.array(robot.toFullJointPositions("joints", states[-1].q + 0.01))
        pose = np.asfortranarray(robot.forwardKinematics(whole, tip))
        self._tasks = [optimal_ik.FrameTask(oink, robot, core.CartesianConfiguration("universe", tip, pose))]
        self._limits = [optimal_ik.PositionLimit(oink), optimal_ik.VelocityLimit(oink, DT, arm.max_velocity)]
        options = optimal_ik.SelfCollisionBarrierOptions(
            n_collision_pairs=20, d_min=_CLEARANCE, d_max=_CLEARANCE + 0.15
        )
        self._barriers = [optimal_ik.SelfCollisionBarrier(oink, robot, DT, options)]
        self._oink, self._found = oink, np.zeros(oink.num_variables)
        self._whole = {s.q.tobytes(): np.array(robot.toFullJointPositions("joints", s.q)) for s in states}

    def __call__(self, posture: Array) -> Array:
        """Return the change of the joint positions in one control period [rad]."""
        whole = self._whole[posture.tobytes()]
        self._oink.solveIk(whole, self._tasks, self._limits, self._barriers, self._found, 1e-6)
        return self._found


def tick_against_roboplan() -> Row:
    """The safety filter with 5 obstacles at rest, against roboplan's Oink with a barrier of the 20 nearest pairs."""
    arm, keeper, scene, states, target = _setup()
    peer, theirs = OinkStep(arm, scene, states), cycle(states)

    def check() -> tuple[bool, str]:
        finite = all(np.all(np.isfinite(peer(state.q))) for state in states)
        return finite, f"roboplan keeps {peer.shapes} shapes of the arm's file, of {len(shaped(arm)[1])}"

    name = "safety filter, 5 obstacles, all links and self"
    ours = _tick(arm, keeper, scene, states, target)
    return Row(name, ours, lambda: peer(next(theirs).q), f"{named('roboplan')}, Oink", faster=1.0, check=check)


def _by_daqp(tick: Callable[[], Array]) -> Callable[[], Array]:
    """Return a control tick in which daqp solves the quadratic program, as it does without compiled code."""
    compiled = ik._compiled

    def step() -> Array:
        ik._compiled = lambda *_: None
        try:
            return tick()
        finally:
            ik._compiled = compiled

    return step


def tick_against_daqp() -> Row:
    """The safety filter with 5 obstacles at rest: our solver of the quadratic program, against daqp."""
    setup = _setup()

    def check() -> tuple[bool, str]:
        ours, theirs = _tick(*setup), _by_daqp(_tick(*setup))
        largest = max(float(np.abs(ours() - theirs()).max()) for _ in setup[3])
        return largest < 1e-6, f"largest difference {largest:.0e} rad/s"

    name = "safety filter, 5 obstacles, compiled quadratic program"
    return Row(name, _tick(*setup), _by_daqp(_tick(*setup)), f"the same with {named('daqp')}", faster=1.2, check=check)


def contact_detection() -> Row:
    """One update of the momentum observer."""
    arm = ArmModel.load("sawyer", tool="gripper")
    detector, states = ContactDetector(arm), loop_states(IKSolver(arm, dt=DT))
    ticks = iter(range(10**9))

    def step() -> object:
        k = next(ticks)
        state = states[k % len(states)]
        return detector.update(ArmState(state.q, state.velocity, np.ones(arm.n_joints), k * DT))

    def check() -> tuple[bool, str]:
        step()
        return bool(np.all(np.isfinite(detector.residual))), "one residual for each joint"

    return Row("contact detection", step, mink_step(), f"{named('mink')}, step", cost=0.5, check=check)


ROWS: tuple[Callable[[], Row], ...] = (
    tick_against_mink,
    whole_tick_against_mink,
    tick_against_roboplan,
    tick_against_daqp,
    contact_detection,
)
