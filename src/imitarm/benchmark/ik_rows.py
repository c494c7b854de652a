"""What ``make bench`` times of inverse kinematics: one step of the Sawyer, alone and against another library."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from itertools import cycle
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.timing import Row
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import ElbowTask, IKSolver
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.self_clearance import SelfClearance

Array = NDArray[np.float64]

DT = 0.01
_ELBOW = ElbowTask(-0.3)  # a little higher than at home


class State(NamedTuple):
    """What a control loop knows at one of its steps."""

    q: Array
    twist: Array
    velocity: Array


def on_the_way(solver: IKSolver, n: int = 64, sew: ElbowTask | None = None) -> list[State]:
    """Return the states of a control loop in which the tool goes round at a hand's usual speed."""
    q, velocity, states = solver.arm.home, np.zeros(solver.arm.n_joints), []
    for step in range(n + 50):  # the first steps, from rest, are left out
        turn = 0.05 * step
        twist = np.array([0.1 * np.cos(turn), 0.1 * np.sin(turn), 0.03, 0.2 * np.cos(turn), 0.0, 0.1])
        states.append(State(q, twist, velocity))
        velocity = solver.solve(q, twist, velocity=velocity, sew=sew)
        q = q + DT * velocity
    return states[-n:]


def damped_step() -> Row:
    """One step of damped least squares inside the limits of position and velocity."""
    solver = IKSolver(ArmModel.load("sawyer", tool="gripper"), "dls", dt=DT)
    states = on_the_way(solver)
    turns = cycle(states)

    def step() -> Array:
        q, twist, _ = next(turns)
        return solver.solve(q, twist)

    def check() -> tuple[bool, str]:
        missing = max(np.linalg.norm(solver.step(q, twist).error) for q, twist, _ in states)
        return bool(missing < 1e-9), f"the tool moves as asked to {missing:.0e}"

    return Row("IK step, dls", step, most_seconds=20e-6, check=check, repeats=41)


def quadratic_step() -> Row:
    """One step of the QP: limits of position, velocity, acceleration and singularity, and the elbow's angle."""
    solver = IKSolver(ArmModel.load("sawyer", tool="gripper"), dt=DT, singularity_bounds=True)
    states = on_the_way(solver, sew=_ELBOW)
    turns = cycle(states)

    def step() -> Array:
        q, twist, velocity = next(turns)
        return solver.solve(q, twist, velocity=velocity, sew=_ELBOW)

    def check() -> tuple[bool, str]:
        most = solver.arm.max_acceleration * DT
        used = max(np.max(np.abs(solver.solve(q, t, velocity=v, sew=_ELBOW) - v) / most) for q, t, v in states)
        return bool(used <= 1.0 + 1e-9), f"accelerates with {100 * used:.0f} % of what it may, never more"

    name = "IK step, qp with all limits and the elbow"
    return Row(name, step, most_seconds=60e-6, check=check, repeats=41)


def self_clearance_rows() -> Row:
    """Rows that keep the arm and its gripper off themselves."""
    arm = ArmModel.load("sawyer", tool="gripper")
    own, turns = SelfClearance(arm), cycle(on_the_way(IKSolver(arm, dt=DT)))

    def check() -> tuple[bool, str]:
        return own.n_pairs > 0, f"{own.n_pairs} pairs of spheres watched"

    return Row("self clearance rows", lambda: own.rows(next(turns).q), most_seconds=150e-6, check=check, repeats=41)


def steps_against_mink() -> Row:
    """From posture and target to velocity: position and velocity limits on both sides, ours the acceleration too."""
    arm = ArmModel.load("sawyer", tool="gripper")
    solver = IKSolver(arm, dt=DT)
    states = on_the_way(solver)
    target = arm.tool_pose(states[-1].q + 0.01)
    turns, theirs = cycle(states), cycle(states)

    def step() -> Array:
        q, _, velocity = next(turns)
        return solver.solve(q, 5.0 * arm.tool_pose(q).error_to(target), velocity=velocity)

    name = "IK step, pose to velocity, qp (ours also keeps accelerations)"
    peer, check = _mink(arm, [state.q for state in states], target)
    return Row(
        name, step, lambda: peer(next(theirs).q), f"mink {version('mink')}", least_ratio=1.0, check=check, repeats=41
    )


def _mink(
    arm: ArmModel, postures: list[Array], target: Pose
) -> tuple[Callable[[Array], Array], Callable[[], tuple[bool, str]]]:
    """Return the peer's step, with daqp as its solver, and a check that both do the same where no limit is near."""
    import mink  # noqa: PLC0415  (a peer that need not be installed)

    spec = arm.spec()
    for geom in [geom for geom in spec.geoms if geom.density == 0.0]:
        spec.delete(geom)  # shapes cost it time and do nothing here, as in ours
    model = spec.compile()
    configuration = mink.Configuration(model)
    task = mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=0.3, gain=1.0)
    task.set_target(mink.SE3(np.concatenate([target.quaternion, target.position])))
    speeds = dict(zip(arm.joint_names, arm.max_velocity, strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]

    whole = {posture.tobytes(): arm.posture(model, posture) for posture in postures}  # with the gripper's fingers

    def step(posture: Array) -> Array:
        configuration.update(whole[posture.tobytes()])
        return np.asarray(mink.solve_ik(configuration, [task], DT, "daqp", damping=1e-5, limits=limits))

    def check() -> tuple[bool, str]:
        near = postures[0]
        goal = arm.tool_pose(near + 1e-3)
        task.set_target(mink.SE3(np.concatenate([goal.quaternion, goal.position])))
        theirs = step(near)[: arm.n_joints]
        task.set_target(mink.SE3(np.concatenate([target.quaternion, target.position])))
        moved = arm.tool_jacobian(near)
        ours = IKSolver(arm, dt=DT).solve(near, arm.tool_pose(near).error_to(goal) / DT)
        apart = float(np.linalg.norm(moved @ (ours - theirs)) / np.linalg.norm(moved @ ours))
        return apart < 0.02, f"tool velocities agree to {100 * apart:.2g} % where no limit is near"

    return step, check


ROWS: tuple[Callable[[], Row], ...] = (damped_step, quadratic_step, self_clearance_rows, steps_against_mink)
