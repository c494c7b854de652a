"""What ``make bench`` times at each control tick of the arm: inverse kinematics, self clearance, obstacle clearance."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.limits import JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.tasks import ElbowTask, Task, TwistTask
from imitarm.scene import Scene, Sphere
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit
from timing import Row
from yardsticks import DT, MinkStep, mink_step, named

Array = NDArray[np.float64]

_ELBOW = ElbowTask(-0.3)  # [rad] a little higher than at home
_CLEARANCE = 0.02  # [m]


class State(NamedTuple):
    """What a control loop knows at one of its ticks."""

    q: Array
    twist: Array
    velocity: Array


def loop_states(solver: IKSolver, *more: Task, n: int = 64) -> list[State]:
    """Return the states of a control loop in which the tool moves in a circle at the usual speed of a hand."""
    q, velocity, states = solver.arm.home, np.zeros(solver.arm.n_joints), []
    for step in range(n + 50):  # the first steps, from rest, are left out
        angle = 0.05 * step
        twist = np.array([0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.03, 0.2 * np.cos(angle), 0.0, 0.1])
        states.append(State(q, twist, velocity))
        velocity = solver.solve(q, [TwistTask(twist), *more], velocity=velocity)
        q = q + DT * velocity
    return states[-n:]


def damped_step() -> Row:
    """One step of damped least squares inside the limits of position and velocity."""
    arm = ArmModel.load("sawyer", tool="gripper")
    solver, states = IKSolver(arm, dt=DT, method="dls"), loop_states(IKSolver(arm, dt=DT))
    ticks = cycle(states)

    def step() -> Array:
        q, twist, _ = next(ticks)
        return solver.solve(q, TwistTask(twist))

    def check() -> tuple[bool, str]:
        missing = max(np.linalg.norm(solver.step(q, TwistTask(twist)).missing[0]) for q, twist, _ in states)
        return bool(missing < 1e-9), f"error of the tool's twist: {missing:.0e}"

    return Row("IK step, dls", step, mink_step(), f"{named('mink')}, qp", faster=6.0, check=check)


def quadratic_step() -> Row:
    """One step of the QP: limits of position, velocity, acceleration and singularity, and the elbow's angle."""
    arm = ArmModel.load("sawyer", tool="gripper")
    solver = IKSolver(arm, [JointLimits(arm), *singularity_limits(arm)], dt=DT)
    states = loop_states(solver, _ELBOW)
    ticks = cycle(states)

    def step() -> Array:
        q, twist, velocity = next(ticks)
        return solver.solve(q, [TwistTask(twist), _ELBOW], velocity=velocity)

    def check() -> tuple[bool, str]:
        most = solver.arm.max_acceleration * DT
        used = max(np.max(np.abs(solver.solve(q, [TwistTask(t), _ELBOW], velocity=v) - v) / most) for q, t, v in states)
        return bool(used <= 1.0 + 1e-9), f"uses at most {100 * used:.0f} % of the acceleration limits"

    name = "IK step, qp, all limits and the elbow"
    return Row(name, step, mink_step(), f"{named('mink')}, two limits", faster=1.5, check=check)


def steps_against_mink() -> Row:
    """From posture and target to velocity: limits of position and velocity on both sides, ours of acceleration too."""
    arm = ArmModel.load("sawyer", tool="gripper")
    solver = IKSolver(arm, dt=DT)
    states = loop_states(solver)
    target = arm.tool_pose(states[-1].q + 0.01)
    peer = MinkStep(arm, [state.q for state in states], target)
    ticks, theirs = cycle(states), cycle(states)

    def step() -> Array:
        q, _, velocity = next(ticks)
        return solver.solve(q, TwistTask(5.0 * arm.tool_pose(q).error_to(target)), velocity=velocity)

    def check() -> tuple[bool, str]:
        near = states[0].q
        goal = arm.tool_pose(near + 1e-3)
        peer.aim(goal)
        moved, their_velocity = arm.tool_jacobian(near), peer(near)[: arm.n_joints]
        peer.aim(target)
        ours = IKSolver(arm, dt=DT).solve(near, TwistTask(arm.tool_pose(near).error_to(goal) / DT))
        apart = float(np.linalg.norm(moved @ (ours - their_velocity)) / np.linalg.norm(moved @ ours))
        return apart < 0.02, f"tool velocities differ by {100 * apart:.2g} % where no limit is near"

    name = "IK step, pose to velocity, qp"
    return Row(name, step, lambda: peer(next(theirs).q), named("mink"), faster=2.0, check=check)


def self_clearance_rows() -> Row:
    """The inequalities that keep the arm and its gripper clear of themselves."""
    arm = ArmModel.load("sawyer", tool="gripper")
    own, ticks = SelfClearance(arm), cycle(loop_states(IKSolver(arm, dt=DT)))

    def check() -> tuple[bool, str]:
        return own.n_pairs > 0, f"{own.n_pairs} pairs of spheres"

    return Row(
        "self clearance rows",
        lambda: own.rows(next(ticks).q),
        mink_step(),
        named("mink") + ", step",
        cost=2.0,
        check=check,
    )


def obstacles(arm: ArmModel, n: int) -> Scene:
    """Return spheres of 4 cm radius on a circle of 22 cm about the tool at home: all near, none touched."""
    tool, angles = arm.tool_pose(arm.home).position, 2.0 * np.pi * np.arange(n) / n
    offsets = 0.22 * np.column_stack([np.cos(angles), np.sin(angles), 0.2 * np.cos(3.0 * angles)])
    return Scene(None, tuple(Sphere(tool + offset, 0.04) for offset in offsets))


def obstacle_rows() -> Row:
    """The inequalities that keep the whole arm clear of 10 obstacles."""
    arm = ArmModel.load("sawyer", tool="gripper")
    limit, scene, ticks = ClearanceLimit(arm, _CLEARANCE), obstacles(arm, 10), cycle(loop_states(IKSolver(arm, dt=DT)))

    def check() -> tuple[bool, str]:
        rows = limit.rows(arm.home, scene)
        return rows is not None, f"{0 if rows is None else len(rows.lower)} rows"

    name = "clearance rows of the arm, 10 obstacles"
    return Row(
        name,
        lambda: limit.rows(next(ticks).q, scene),
        mink_step(),
        f"{named('mink')}, step",
        cost=0.9,  # a third of what rows of covering spheres took
        check=check,
    )


def shaped(arm: ArmModel) -> tuple[mujoco.MjSpec, list[str]]:
    """Return the arm without what is only drawn, and the names of its shapes."""
    spec = arm.spec()
    for geom in [geom for geom in spec.geoms if not geom.name]:
        spec.delete(geom)
    return spec, [geom.name for geom in spec.geoms]


def avoiding_mink(arm: ArmModel, scene: Scene, states: list[State], target: Pose) -> MinkStep:
    """Return a step of mink that keeps the arm's own shapes 2 cm away from spheres."""
    import mink

    spec, links = shaped(arm)
    for i, sphere in enumerate(scene.obstacles):
        assert isinstance(sphere, Sphere)
        spec.worldbody.add_geom(
            name=f"obstacle {i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[sphere.radius, 0, 0], pos=sphere.center
        )
    names = [f"obstacle {i}" for i in range(len(scene.obstacles))]
    return MinkStep(
        arm,
        [state.q for state in states],
        target,
        spec=spec,
        limits=lambda model: [
            mink.CollisionAvoidanceLimit(
                model,
                [(links, names)],
                minimum_distance_from_collisions=_CLEARANCE,
                collision_detection_distance=_CLEARANCE + 0.15,
            )
        ],
    )


def avoiding_steps_against_mink() -> Row:
    """Clearance rows and IK with 5 obstacles, against mink with its collision avoidance of the same shapes."""
    arm = ArmModel.load("sawyer", tool="gripper")
    limit, solver, scene = ClearanceLimit(arm, _CLEARANCE), IKSolver(arm, dt=DT), obstacles(arm, 5)
    states = loop_states(solver)
    target = arm.tool_pose(states[-1].q + 0.01)
    peer = avoiding_mink(arm, scene, states, target)
    ticks, theirs = cycle(states), cycle(states)

    def step() -> Array:
        q, _, velocity = next(ticks)
        rows = limit.rows(q, scene)
        task = TwistTask(5.0 * arm.tool_pose(q).error_to(target))
        return solver.solve(q, task, velocity=velocity, rows=rows)

    def check() -> tuple[bool, str]:
        near = states[0].q
        rows, moved = limit.rows(near, scene), peer(near)
        count = 0 if rows is None else len(rows.lower)
        return bool(np.all(np.isfinite(moved))) and count > 0, f"{count} rows of ours"

    name = "clearance rows and IK step, 5 obstacles"
    return Row(
        name, step, lambda: peer(next(theirs).q), f"{named('mink')}, CollisionAvoidanceLimit", faster=1.0, check=check
    )


def scene_at_a_time() -> Row:
    """Ten moving obstacles, predicted to another time."""
    arm = ArmModel.load("sawyer", tool="gripper")
    still = obstacles(arm, 10)
    scene = Scene(None, tuple(Sphere(o.center, o.radius, velocity=(0.1, 0.0, 0.0)) for o in still.obstacles))  # type: ignore[attr-defined]

    def check() -> tuple[bool, str]:
        moved = scene.at(0.5).obstacles[0].center - still.obstacles[0].center  # type: ignore[attr-defined]
        return bool(np.allclose(moved, [0.05, 0.0, 0.0])), "moves by velocity times time"

    return Row(
        "ten obstacles at another time",
        lambda: scene.at(0.5),
        mink_step(),
        f"{named('mink')}, step",
        cost=0.03,  # a twentieth of what it took before the obstacles were packed into arrays
        check=check,
    )


ROWS: tuple[Callable[[], Row], ...] = (
    damped_step,
    quadratic_step,
    steps_against_mink,
    self_clearance_rows,
    obstacle_rows,
    avoiding_steps_against_mink,
    scene_at_a_time,
)
