from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics import ik
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import METHODS, IKSolver, solve_ik
from imitarm.kinematics.ik_problem import Box, Rows
from imitarm.kinematics.limits import JointLimits, WristSingularityLimit
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.tasks import ElbowTask, JointVelocityTask, PostureTask, TwistTask

ARMS = {name: ArmModel.load(name, tool="brush") for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
DT = 0.01
WEIGHTS = np.array([1, 1, 1, 0.3, 0.3, 0.3])
every_method = pytest.mark.parametrize("method", list(METHODS))
either = pytest.mark.parametrize("name", list(ARMS))
seeds = st.integers(0, 2**32 - 1)


def follow_out_of_reach(arm, method, *, distance=0.7, accelerations=False, max_speed=None):
    """Lead the tool from home to far outside the reach and back, then wait: return what the joints did."""
    there = 0.5 - 0.5 * np.cos(np.pi * np.arange(300) / 300)
    start = arm.tool_pose(arm.home)
    q, velocity, positions, velocities = arm.home, np.zeros(7), [], []
    for fraction in np.concatenate([there, there[::-1], np.zeros(150)]):
        target = ahead(start, distance * fraction)
        twist = arm.tool_pose(q).error_to(target) / DT
        before = velocity if accelerations else None
        velocity = solve_ik(arm, q, TwistTask(twist, max_speed=max_speed), method=method, dt=DT, velocity=before)
        q = q + DT * velocity
        positions.append(q)
        velocities.append(velocity)
    return np.array(positions), np.array(velocities), np.linalg.norm(arm.tool_pose(q).error_to(target))


def unbounded(solver, q, task):
    """The step's problem without its box."""
    problem = solver.problem(q, task)
    problem.box = Box(np.full(7, -np.inf), np.full(7, np.inf))
    return problem


def ahead(pose, x, y=0.0, z=0.0):
    return Pose(pose.position + np.array([x, y, z]), pose.quaternion)


@either
@every_method
def test_well_inside_the_reach_the_tool_moves_as_asked(name, method):
    arm = ARMS[name]
    rng = np.random.default_rng(0)
    for frame, jacobian in (("tool", arm.tool_jacobian), ("flange", arm.jacobian)):
        for _ in range(20):
            q = arm.home + 0.1 * rng.normal(size=7)
            twist = 0.03 * rng.normal(size=6)
            moved = jacobian(q) @ solve_ik(arm, q, TwistTask(twist, frame), method=method, dt=DT)
            assert np.allclose(moved, twist, atol=2e-3 * np.linalg.norm(twist))


@every_method
def test_a_loop_reaches_a_pose(method):
    arm = ARMS["panda"]
    q, velocity = arm.home.copy(), np.zeros(7)
    start = arm.tool_pose(q)
    turn = Pose([0, 0, 0], [np.cos(0.2), 0, np.sin(0.2), 0])
    target = Pose(ahead(start, 0.1, 0.15, -0.05).position, (turn @ start).quaternion)
    for _ in range(400):
        twist = 5.0 * arm.tool_pose(q).error_to(target)
        velocity = solve_ik(arm, q, TwistTask(twist), method=method, dt=DT, velocity=velocity)
        q = q + DT * velocity
    assert np.linalg.norm(arm.tool_pose(q).error_to(target)) < 1e-5


@either
@every_method
def test_no_limit_is_passed_on_a_path_that_leaves_the_reach(name, method):
    arm = ARMS[name]
    q, velocity, error = follow_out_of_reach(arm, method, accelerations=True)
    assert np.all(np.abs(velocity) <= arm.max_velocity * (1 + 1e-12))
    assert np.all(q <= arm.upper + 1e-9) and np.all(q >= arm.lower - 1e-9)
    change = np.abs(np.diff(velocity, axis=0, prepend=np.zeros((1, 7)))) / DT
    assert np.all(change <= arm.max_acceleration * (1 + 1e-9))
    assert error < 0.05  # after the hold of 1.5 s it is nearly back; what damping costs is another test


def test_damped_least_squares_freezes_when_its_step_is_not_clamped():
    """The damping of thesis Eq 3.9 grows with the error, so a far target holds the arm still."""
    *_, clamped = follow_out_of_reach(SAWYER, "dls")
    *_, frozen = follow_out_of_reach(SAWYER, "dls", max_speed=1e9)
    assert clamped < 1e-3
    assert frozen > 0.1


def test_the_quadratic_program_follows_closer_than_the_damping():
    def shortfall(method):
        q, *_ = follow_out_of_reach(SAWYER, method, distance=0.5)
        reached = SAWYER.tool_path(q)[0][:, 0]
        there = 0.5 - 0.5 * np.cos(np.pi * np.arange(300) / 300)
        wanted = SAWYER.tool_pose(SAWYER.home).position[0] + 0.5 * np.concatenate([there, there[::-1], np.zeros(150)])
        return np.sqrt(np.mean((reached - wanted) ** 2))

    assert shortfall("qp") < 0.5 * shortfall("dls")


@settings(deadline=None, max_examples=200)
@given(seeds)
def test_baerlocher_damping_keeps_the_norm_of_the_scaled_velocity(seed):
    """Thesis Eq 3.9 in scaled joints: |dq / v_max| <= 1 at any posture, singular ones too, for any twist."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(SAWYER.lower, SAWYER.upper)
    q[rng.random(7) < 0.4] = 0.0
    twist = rng.normal(size=6) * 10.0 ** rng.uniform(-3, 2)
    free = unbounded(IKSolver(SAWYER, dt=DT, method="dls"), q, TwistTask(twist, max_speed=1e9))
    scaled, target, _ = free.tasks[0]
    squares, basis = np.linalg.eigh(scaled @ scaled.T)
    least, d = np.sqrt(max(squares[0], 0.0)), np.linalg.norm(target)
    damping = 0.0 if least >= d else least * (d - least) if least >= d / 2 else d * d / 4
    expected = scaled.T @ (basis @ ((basis.T @ target) / (squares + damping)))
    assert np.linalg.norm(expected) <= 1.0 + 1e-6
    assert np.allclose(METHODS["dls"](free), expected * SAWYER.max_velocity, atol=1e-7)


def test_the_thesis_small_angle_term_weakens_the_damping():
    """Kept for comparison; the bound on the velocity no longer holds."""
    rng = np.random.default_rng(0)
    norms = {"dls": [], "dls_small_angle": []}
    for _ in range(2000):
        q, twist = rng.uniform(SAWYER.lower, SAWYER.upper), rng.normal(size=6)
        for method, found in norms.items():
            free = unbounded(IKSolver(SAWYER, dt=DT, method=method), q, TwistTask(twist, max_speed=10.0))
            found.append(np.linalg.norm(METHODS[method](free) / SAWYER.max_velocity))
    assert max(norms["dls"]) <= 1.0 + 1e-9
    assert max(norms["dls_small_angle"]) > 1.1


def test_svd_filter_is_the_pseudo_inverse_away_from_singularities_and_bounded_at_them():
    q = SAWYER.home
    weights = np.array([1, 1, 1, 0.3, 0.3, 0.3])
    twist = np.array([0.1, -0.05, 0.02, 0.1, 0.0, -0.1])
    exact = np.linalg.pinv(weights[:, None] * SAWYER.tool_jacobian(q)) @ (weights * twist)
    assert np.allclose(solve_ik(SAWYER, q, TwistTask(twist), method="svd"), exact, atol=1e-9)
    straight = np.zeros(7)  # fully stretched
    assert np.all(
        np.abs(solve_ik(SAWYER, straight, TwistTask([0.5, 0, 0, 0, 0, 0]), method="svd")) <= SAWYER.max_velocity
    )


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_the_quadratic_program_finds_the_least_cost(seed):
    """An independent general-purpose solver finds no better point in the box."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(SAWYER.lower, SAWYER.upper)
    before = 0.3 * rng.normal(size=7)
    tasks = [TwistTask(rng.normal(size=6), max_speed=1.0), PostureTask(SAWYER.home)]
    problem = IKSolver(SAWYER, dt=DT).problem(q, tasks, before)
    posture = np.clip(SAWYER.home - q, *problem.box)

    def cost(v):
        miss = problem.tasks[0].jacobian @ v - problem.tasks[0].target
        regular = ik._EFFORT * v @ v + ik._CHANGE * np.sum((v - before) ** 2) + 1e-4 * np.sum((v - posture) ** 2)
        return 0.5 * (miss @ miss + regular)

    ours = METHODS["qp"](problem)
    assert np.all(ours >= problem.box.lower) and np.all(ours <= problem.box.upper)
    other = minimize(cost, ours, bounds=list(zip(*problem.box, strict=True)), method="L-BFGS-B")
    assert cost(ours) <= other.fun + 1e-9


@every_method
def test_the_posture_is_approached_without_moving_the_tool(method):
    arm = ARMS["panda"]
    q_ref = arm.home + np.array([0.4, 0, -0.4, 0, 0.3, 0, 0])
    q, start = arm.home.copy(), arm.tool_pose(arm.home)
    for _ in range(500):
        twist = 10.0 * arm.tool_pose(q).error_to(start)
        q = q + DT * solve_ik(arm, q, [TwistTask(twist), PostureTask(q_ref)], method=method, dt=DT)
        assert np.linalg.norm(arm.tool_pose(q).error_to(start)) < 2e-3
    assert np.linalg.norm(q - q_ref) < 0.95 * np.linalg.norm(arm.home - q_ref)
    null = np.linalg.svd(arm.tool_jacobian(q))[2][-1]  # what is left of the wish moves the tool
    assert abs(null @ (q_ref - q)) < 0.02


def test_extra_rows_keep_the_arm_off_a_wall():
    """Spheres of the whole arm must stay behind a plane although the tool is led through it."""
    arm, clearance, wall = ARMS["panda"], 0.02, 0.62
    q, velocity = arm.home.copy(), np.zeros(7)
    start = arm.tool_pose(q)
    target = ahead(start, 0.3, 0.0, 0.1)
    nearest, solver = np.inf, IKSolver(arm, dt=DT)
    for _ in range(300):
        centers, radii = arm.collision_spheres(q)
        distances = wall - centers[:, 0] - radii
        nearest = min(nearest, distances.min())
        near = distances < 0.2
        normals = np.tile([-1.0, 0.0, 0.0], (near.sum(), 1))
        rows = Rows(
            np.einsum("mi,mij->mj", normals, arm.sphere_jacobians(q)[near]), -5.0 * (distances[near] - clearance)
        )
        tasks = [TwistTask(3.0 * arm.tool_pose(q).error_to(target)), PostureTask(arm.home)]
        step = solver.step(q, tasks, velocity=velocity, rows=rows)
        assert step.slack.shape == (near.sum(),)
        velocity = step.velocity
        q = q + DT * velocity
    assert nearest > clearance - 0.002
    assert nearest < clearance + 0.005  # it does come as near as it may
    assert np.linalg.norm(step.missing[0]) > 0.1  # and reports what it could not do


def test_rows_that_contradict_the_limits_give_way_and_are_reported():
    matrix = np.eye(7)[:1]
    step = IKSolver(SAWYER).step(SAWYER.home, TwistTask(np.zeros(6)), rows=Rows(matrix, [10.0]))
    assert step.velocity[0] == pytest.approx(SAWYER.max_velocity[0])
    assert step.slack[0] == pytest.approx(10.0 - SAWYER.max_velocity[0])
    assert step.limited[0]


def test_rows_that_hold_anyway_change_nothing():
    task = TwistTask([0.1, 0.05, 0, 0, 0, 0.1])
    free = solve_ik(SAWYER, SAWYER.home, task)
    rows = Rows(np.random.default_rng(0).normal(size=(5, 7)), np.full(5, -100.0))
    assert np.allclose(solve_ik(SAWYER, SAWYER.home, task, rows=rows), free, atol=1e-9)
    none = Rows(np.zeros((0, 7)), np.zeros(0))
    assert np.allclose(solve_ik(SAWYER, SAWYER.home, task, rows=[none, rows]), free, atol=1e-9)


def test_the_step_reports_what_is_missing():
    twist = np.array([0.1, 0, 0, 0, 0, 0.2])
    step = IKSolver(SAWYER).step(SAWYER.home, TwistTask(twist))
    assert np.array_equal(step.velocity, solve_ik(SAWYER, SAWYER.home, TwistTask(twist)))
    moved = WEIGHTS * (SAWYER.tool_jacobian(SAWYER.home) @ step.velocity)
    assert np.allclose(moved + step.missing[0], WEIGHTS * twist, atol=1e-12)
    assert np.linalg.norm(step.missing[0]) < 1e-3
    assert not step.limited.any() and step.slack.shape == (0,)


def test_the_twist_is_clamped_as_a_whole():
    velocity = solve_ik(SAWYER, SAWYER.home, TwistTask([3.0, 0, 4.0, 0, 0, 0], max_speed=0.1))
    moved = SAWYER.tool_jacobian(SAWYER.home) @ velocity
    assert np.allclose(moved[:3], [0.06, 0, 0.08], atol=1e-3)


STILL = TwistTask(np.zeros(6))


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"method": "newton"}, UnknownNameError, "unknown IK method 'newton'; known: dls, dls_small_angle, qp, svd"),
        ({"tasks": TwistTask(np.zeros(6), "elbow")}, UnknownNameError, "known: flange, tool"),
        ({"dt": 0.0}, InputError, "dt must be a finite number above 0"),
        ({"dt": float("nan")}, InputError, "dt must be a finite number above 0"),
        ({"tasks": TwistTask([0, 0, 0])}, InputError, "twist must be"),
        ({"tasks": TwistTask([0, 0, np.nan, 0, 0, 0])}, InputError, "twist must be"),
        ({"tasks": TwistTask(np.zeros(6), max_speed=-1.0)}, InputError, "max_speed must be a finite"),
        ({"tasks": TwistTask(np.zeros(6), max_speed=np.nan)}, InputError, "max_speed must be a finite"),
        ({"tasks": []}, InputError, "at least one task"),
        ({"tasks": [ElbowTask(0.1)]}, InputError, "must follow a task for the tool"),
        ({"tasks": [STILL, ElbowTask(0.1)], "method": "dls"}, InputError, "use method='qp'"),
        ({"tasks": [STILL, STILL], "method": "svd"}, InputError, "use method='qp'"),
        ({"tasks": JointVelocityTask(np.zeros(7)), "method": "svd"}, InputError, "use method='qp'"),
        ({"tasks": JointVelocityTask(np.zeros(6))}, InputError, "velocity must be 7"),
        ({"tasks": JointVelocityTask(np.zeros(7), -1.0)}, InputError, "weight must be"),
        ({"q": np.zeros(3)}, InputError, "must be 7 numbers"),
        ({"velocity": np.zeros(3)}, InputError, "velocity must be 7"),
        ({"tasks": [STILL, PostureTask([np.inf] * 7)]}, InputError, "q must be finite"),
        ({"tasks": [STILL, PostureTask(np.zeros(7), np.inf)]}, InputError, "gain must be a finite"),
        ({"rows": Rows(np.zeros((2, 6)), np.zeros(2))}, InputError, r"rows need shapes \(m, 7\)"),
        ({"rows": Rows(np.full((1, 7), np.nan), np.zeros(1))}, InputError, "rows must be finite"),
        ({"rows": Rows(np.zeros((1, 7)), np.zeros(1), -1.0)}, InputError, "price above 0"),
        ({"rows": Rows(np.zeros((1, 7)), np.zeros(1)), "method": "dls"}, InputError, "use method='qp'"),
        (
            {"limits": [JointLimits(SAWYER), WristSingularityLimit(SAWYER)], "method": "dls"},
            InputError,
            "use method='qp'",
        ),
    ],
)
def test_what_can_not_be_used_is_refused(change, error, said):
    options = {"q": SAWYER.home, "tasks": STILL, **change}
    q, tasks = options.pop("q"), options.pop("tasks")
    with pytest.raises(error, match=said):
        solve_ik(SAWYER, q, tasks, **options)


def random_rows_problem(seed, rows):
    """A loop's step near home with random rows."""
    rng = np.random.default_rng(seed)
    q, before = SAWYER.home + 0.2 * rng.normal(size=7), 0.2 * rng.normal(size=7)
    given = [Rows(rng.normal(size=(n, 7)), shift * rng.normal(size=n) - 0.05, price) for n, shift, price in rows]
    return IKSolver(SAWYER, dt=DT).problem(q, TwistTask(0.2 * rng.normal(size=6)), before, given)


def cost_of(problem, v):
    miss = problem.tasks[0].jacobian @ v - problem.tasks[0].target
    return 0.5 * (miss @ miss + ik._EFFORT * v @ v + ik._CHANGE * np.sum((v - problem.velocity) ** 2))


def violation(rows, v):
    """What is missing of each row [rad/s]."""
    return np.maximum(rows.lower - rows.matrix @ v, 0.0) / np.linalg.norm(rows.matrix, axis=1)


@settings(deadline=None, max_examples=60)
@given(seeds)
def test_rows_with_a_price_have_the_documented_cost(seed):
    problem = random_rows_problem(seed, [(1, 1.0, 0.1)])

    def cost(v):
        missing = violation(problem.rows[0], v)
        return cost_of(problem, v) + 0.05 * missing @ missing

    ours = METHODS["qp"](problem)
    other = minimize(cost, ours, bounds=list(zip(*problem.box, strict=True)), method="L-BFGS-B")
    assert cost(ours) <= (1.0 + 1e-5) * other.fun + 1e-7


@settings(deadline=None, max_examples=150)
@given(seeds, st.integers(1, 12), st.sampled_from([0.01, 0.05, 0.2]))
def test_rows_are_kept_wherever_the_box_allows_it_and_violated_least_where_not(seed, n, shift):
    """A known QP solver's own soft constraints fail this: they break rows that can be kept."""
    problem = random_rows_problem(seed, [(n, shift, np.inf)])
    bounds, rows = list(zip(*problem.box, strict=True)), problem.rows[0]

    def missing(v):
        part = violation(rows, v)
        return part @ part, -2.0 * (part / np.linalg.norm(rows.matrix, axis=1)) @ rows.matrix

    ours = METHODS["qp"](problem)
    assert np.all(ours >= problem.box.lower) and np.all(ours <= problem.box.upper)
    least = minimize(missing, np.mean(problem.box, axis=0), jac=True, bounds=bounds, tol=1e-14)
    assert missing(ours)[0] ** 0.5 <= least.fun**0.5 + 1e-4
    if least.fun < 1e-12:  # all can be kept: then none of the points that keep them costs less
        keep = {"type": "ineq", "fun": lambda v: rows.matrix @ v - rows.lower, "jac": lambda v: rows.matrix}
        other = minimize(lambda v: cost_of(problem, v), ours, bounds=bounds, constraints=keep, method="SLSQP")
        assert cost_of(problem, ours) <= (1.0 + 1e-4) * max(other.fun, 0.0) + 1e-6


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_joint_velocities_are_followed_where_the_limits_allow(seed):
    rng = np.random.default_rng(seed)
    wanted = rng.normal(size=7)
    solver = IKSolver(SAWYER, dt=DT)
    box = JointLimits(SAWYER).box(SAWYER.home, DT)
    assert np.allclose(solver.solve(SAWYER.home, JointVelocityTask(wanted)), np.clip(wanted, *box), atol=1e-3)
