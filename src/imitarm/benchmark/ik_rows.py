"""What ``make bench`` times of inverse kinematics: one step of the Sawyer, alone and against another library."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.timing import Row
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import ElbowTask, IKSolver
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.self_clearance import SelfClearance

Array = NDArray[np.float64]

DT = 0.01
_TWIST = np.array([0.05, 0.02, -0.03, 0.1, 0.0, 0.05])  # a hand's usual speed
_ELBOW = ElbowTask(0.3)


def _sawyer() -> tuple[ArmModel, list[Array]]:
    """Return the arm with its gripper and postures about its home; no two calls in turn ask for the same one."""
    arm = ArmModel.load("sawyer", tool="gripper")
    return arm, list(arm.home + 0.1 * np.random.default_rng(0).normal(size=(64, arm.n_joints)))


def damped_step() -> Row:
    """One step of damped least squares inside the limits of position and velocity."""
    arm, postures = _sawyer()
    solver, q = IKSolver(arm, "dls", dt=DT), cycle(postures)

    def check() -> tuple[bool, str]:
        missing = max(np.linalg.norm(arm.tool_jacobian(p) @ solver.solve(p, _TWIST) - _TWIST) for p in postures)
        return bool(missing < 1e-9), f"the tool moves as asked to {missing:.0e}"

    return Row("IK step, dls", lambda: solver.solve(next(q), _TWIST), most_seconds=20e-6, check=check, repeats=41)


def quadratic_step() -> Row:
    """One step of the QP: limits of position, velocity, acceleration and singularity, and the elbow's angle."""
    arm, postures = _sawyer()
    solver, q = IKSolver(arm, dt=DT, singularity_bounds=True), cycle(postures)
    before = solver.solve(arm.home, _TWIST)

    def step() -> Array:
        return solver.solve(next(q), _TWIST, velocity=before, sew=_ELBOW)

    def check() -> tuple[bool, str]:
        most = max(np.max(np.abs(step() - before) / (arm.max_acceleration * DT)) for _ in postures)
        return bool(most <= 1.0 + 1e-9), f"accelerates with {100 * most:.0f} % of what it may, never more"

    name = "IK step, qp with all limits and the elbow"
    return Row(name, step, most_seconds=60e-6, check=check, repeats=41)


def self_clearance_rows() -> Row:
    """Rows that keep the arm and its gripper off themselves."""
    arm, postures = _sawyer()
    own, q = SelfClearance(arm), cycle(postures)

    def check() -> tuple[bool, str]:
        return own.n_pairs > 0, f"{own.n_pairs} pairs of spheres watched"

    return Row("self clearance rows", lambda: own.rows(next(q)), most_seconds=200e-6, check=check, repeats=41)


def steps_against_mink() -> Row:
    """From posture and target to velocity: position and velocity limits on both sides, ours the acceleration too."""
    arm, postures = _sawyer()
    target = arm.tool_pose(arm.home + 0.05)
    solver, q, theirs = IKSolver(arm, dt=DT), cycle(postures), cycle(postures)
    before = np.zeros(arm.n_joints)

    def step() -> Array:
        posture = next(q)
        return solver.solve(posture, arm.tool_pose(posture).error_to(target) / DT, velocity=before)

    name = "IK step, pose to velocity, qp (ours also keeps accelerations)"
    peer, check = _mink(arm, postures, target)
    return Row(
        name, step, lambda: peer(next(theirs)), f"mink {version('mink')}", least_ratio=1.0, check=check, repeats=41
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
