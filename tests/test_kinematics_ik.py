from __future__ import annotations

import inspect

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics import ik, ik_methods
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import METHODS, IKSolver, clearance_rows, solve_ik, solve_ik_step
from imitarm.kinematics.pose import Pose

ARMS = {name: ArmModel.load(name, tool="brush") for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
DT = 0.01
every_method = pytest.mark.parametrize("method", list(METHODS))
either = pytest.mark.parametrize("name", list(ARMS))
seeds = st.integers(0, 2**32 - 1)


def follow_out_of_reach(arm, method, *, distance=0.7, accelerations=False, **options):
    """Lead the tool from home to far outside the reach and back, then wait: return what the joints did."""
    there = 0.5 - 0.5 * np.cos(np.pi * np.arange(300) / 300)
    start = arm.tool_pose(arm.home)
    q, velocity, positions, velocities = arm.home, np.zeros(7), [], []
    for way in np.concatenate([there, there[::-1], np.zeros(150)]):
        target = ahead(start, distance * way)
        twist = arm.tool_pose(q).error_to(target) / DT
        before = velocity if accelerations else None
        velocity = solve_ik(arm, q, twist, method=method, dt=DT, velocity=before, **options)
        q = q + DT * velocity
        positions.append(q)
        velocities.append(velocity)
    return np.array(positions), np.array(velocities), np.linalg.norm(arm.tool_pose(q).error_to(target))


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
            moved = jacobian(q) @ solve_ik(arm, q, twist, method=method, dt=DT, frame=frame)
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
        velocity = solve_ik(arm, q, twist, method=method, dt=DT, velocity=velocity)
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
    """METHODS A.7: the damping grows with the error, so a far target holds the arm still."""
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
    """METHODS A.7: |dq / v_max| <= 1 at any posture, singular ones too, for any twist."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(SAWYER.lower, SAWYER.upper)
    q[rng.random(7) < 0.4] = 0.0
    twist = rng.normal(size=6) * 10.0 ** rng.uniform(-3, 2)
    task = IKSolver(SAWYER, "dls", dt=DT, max_speed=1e9).task(q, twist)
    free = task._replace(lower=np.full(7, -np.inf), upper=np.full(7, np.inf))
    squares, basis = np.linalg.eigh((scaled := task.jacobian) @ scaled.T)
    least, d = np.sqrt(max(squares[0], 0.0)), np.linalg.norm(task.twist)
    damping = 0.0 if least >= d else least * (d - least) if least >= d / 2 else d * d / 4
    expected = scaled.T @ (basis @ ((basis.T @ task.twist) / (squares + damping)))
    assert np.linalg.norm(expected) <= 1.0 + 1e-6
    assert np.allclose(METHODS["dls"](free), expected * task.max_velocity, atol=1e-7)


def test_the_thesis_small_angle_term_weakens_the_damping():
    """METHODS A.8: kept for comparison; the bound on the velocity no longer holds."""
    rng = np.random.default_rng(0)
    norms = {"thesis": [], None: []}
    for _ in range(2000):
        q, twist = rng.uniform(SAWYER.lower, SAWYER.upper), rng.normal(size=6)
        for variant, found in norms.items():
            task = IKSolver(SAWYER, "dls", dt=DT, max_speed=10.0, small_angle=variant).task(q, twist)
            free = task._replace(lower=np.full(7, -np.inf), upper=np.full(7, np.inf))
            found.append(np.linalg.norm(METHODS["dls"](free) / SAWYER.max_velocity))
    assert max(norms[None]) <= 1.0 + 1e-9
    assert max(norms["thesis"]) > 1.1


def test_svd_filter_is_the_pseudo_inverse_away_from_singularities_and_bounded_at_them():
    q = SAWYER.home
    weights = np.array([1, 1, 1, 0.3, 0.3, 0.3])
    twist = np.array([0.1, -0.05, 0.02, 0.1, 0.0, -0.1])
    exact = np.linalg.pinv(weights[:, None] * SAWYER.tool_jacobian(q)) @ (weights * twist)
    assert np.allclose(solve_ik(SAWYER, q, twist, method="svd"), exact, atol=1e-9)
    straight = np.zeros(7)  # fully stretched
    assert np.all(np.abs(solve_ik(SAWYER, straight, [0.5, 0, 0, 0, 0, 0], method="svd")) <= SAWYER.max_velocity)


@settings(deadline=None, max_examples=40)
@given(seeds)
def test_the_quadratic_program_finds_the_least_cost(seed):
    """An independent general-purpose solver finds no better point in the box."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(SAWYER.lower, SAWYER.upper)
    before = 0.3 * rng.normal(size=7)
    task = IKSolver(SAWYER, dt=DT, max_speed=1.0).task(q, rng.normal(size=6), velocity=before, q_ref=SAWYER.home)

    def cost(v):
        miss = task.jacobian @ v - task.twist
        regular = (
            ik_methods._EFFORT * v @ v
            + ik_methods._CHANGE * np.sum((v - before) ** 2)
            + ik_methods._POSTURE * np.sum((v - task.posture) ** 2)
        )
        return 0.5 * (miss @ miss + regular)

    ours = METHODS["qp"](task)
    assert np.all(ours >= task.lower) and np.all(ours <= task.upper)
    other = minimize(cost, ours, bounds=list(zip(task.lower, task.upper, strict=True)), method="L-BFGS-B")
    assert cost(ours) <= other.fun + 1e-9


@every_method
def test_the_posture_is_approached_without_moving_the_tool(method):
    arm = ARMS["panda"]
    q_ref = arm.home + np.array([0.4, 0, -0.4, 0, 0.3, 0, 0])
    q, start = arm.home.copy(), arm.tool_pose(arm.home)
    for _ in range(500):
        twist = 10.0 * arm.tool_pose(q).error_to(start)
        q = q + DT * solve_ik(arm, q, twist, method=method, dt=DT, q_ref=q_ref)
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
    nearest = np.inf
    for _ in range(300):
        centers, radii = arm.collision_spheres(q)
        distances = wall - centers[:, 0] - radii
        nearest = min(nearest, distances.min())
        near = distances < 0.2
        normals = np.tile([-1.0, 0.0, 0.0], (near.sum(), 1))
        rows = clearance_rows(arm.sphere_jacobians(q)[near], normals, distances[near], clearance=clearance)
        step = solve_ik_step(
            arm, q, 3.0 * arm.tool_pose(q).error_to(target), dt=DT, velocity=velocity, rows=rows, q_ref=arm.home
        )
        assert step.slack.shape == (near.sum(),)
        velocity = step.velocity
        q = q + DT * velocity
    assert nearest > clearance - 0.002
    assert nearest < clearance + 0.005  # it does come as near as it may
    assert np.linalg.norm(step.error) > 0.1  # and reports what it could not do


def test_rows_that_contradict_the_limits_give_way_and_are_reported():
    matrix = np.eye(7)[:1]
    step = solve_ik_step(SAWYER, SAWYER.home, np.zeros(6), rows=(matrix, [10.0]))
    assert step.velocity[0] == pytest.approx(SAWYER.max_velocity[0])
    assert step.slack[0] == pytest.approx(10.0 - SAWYER.max_velocity[0])
    assert step.limited[0]


def test_rows_that_hold_anyway_change_nothing():
    twist = [0.1, 0.05, 0, 0, 0, 0.1]
    free = solve_ik(SAWYER, SAWYER.home, twist)
    rows = (np.random.default_rng(0).normal(size=(5, 7)), np.full(5, -100.0))
    assert np.allclose(solve_ik(SAWYER, SAWYER.home, twist, rows=rows), free, atol=1e-9)
    none = (np.zeros((0, 7)), np.zeros(0))
    assert np.allclose(solve_ik(SAWYER, SAWYER.home, twist, rows=none), free, atol=1e-9)


def test_the_step_reports_what_is_missing():
    twist = np.array([0.1, 0, 0, 0, 0, 0.2])
    step = solve_ik_step(SAWYER, SAWYER.home, twist)
    assert np.array_equal(step.velocity, solve_ik(SAWYER, SAWYER.home, twist))
    assert np.allclose(SAWYER.tool_jacobian(SAWYER.home) @ step.velocity + step.error, twist, atol=1e-12)
    assert np.linalg.norm(step.error) < 1e-3
    assert not step.limited.any() and step.slack.shape == (0,)


def test_both_entries_have_the_same_options():
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(solve_ik).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }
    assert defaults == ik._DEFAULTS


def test_the_twist_is_clamped_as_a_whole():
    fast = solve_ik_step(SAWYER, SAWYER.home, [3.0, 0, 4.0, 0, 0, 0], max_speed=0.1)
    moved = SAWYER.tool_jacobian(SAWYER.home) @ fast.velocity
    assert np.allclose(moved[:3], [0.06, 0, 0.08], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"method": "newton"}, UnknownNameError, "unknown IK method 'newton'; known: dls, qp, svd"),
        ({"frame": "elbow"}, UnknownNameError, "known: flange, tool"),
        ({"small_angle": "yes"}, UnknownNameError, "small_angle"),
        ({"dt": 0.0}, InputError, "dt must be a positive"),
        ({"dt": float("nan")}, InputError, "dt must be a positive"),
        ({"twist": [0, 0, 0]}, InputError, "twist must be 6 finite"),
        ({"twist": [0, 0, np.nan, 0, 0, 0]}, InputError, "twist must be 6 finite"),
        ({"q": np.zeros(3)}, InputError, "must be 7 numbers"),
        ({"velocity": np.zeros(3)}, InputError, "velocity must be 7"),
        ({"q_ref": [np.inf] * 7}, InputError, "q_ref must be 7"),
        ({"rows": (np.zeros((2, 6)), np.zeros(2))}, InputError, r"rows need shapes \(m, 7\)"),
        ({"rows": (np.full((1, 7), np.nan), np.zeros(1))}, InputError, "rows must be finite"),
        ({"rows": (np.zeros((1, 7)), np.zeros(1)), "method": "dls"}, InputError, "use method='qp'"),
    ],
)
def test_what_can_not_be_used_is_refused(change, error, said):
    options = {"q": SAWYER.home, "twist": np.zeros(6), **change}
    q, twist = options.pop("q"), options.pop("twist")
    with pytest.raises(error, match=said):
        solve_ik(SAWYER, q, twist, **options)
    with pytest.raises(error, match=said):
        solve_ik_step(SAWYER, q, twist, **options)


def test_an_unknown_option_of_the_step_is_named():
    with pytest.raises(UnknownNameError, match="speed"):
        solve_ik_step(SAWYER, SAWYER.home, np.zeros(6), speed=1.0)
