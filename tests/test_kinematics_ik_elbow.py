"""The elbow's angle, and the limits that keep an arm away from its singularities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics import ik
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import METHODS, IKSolver, solve_ik
from imitarm.kinematics.limits import ElbowSingularityLimit, JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.sew import sew_angle, sew_derivatives
from imitarm.kinematics.tasks import ElbowTask, PostureTask, TwistTask

ARMS = {name: ArmModel.load(name, tool="brush") for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
WEIGHTS = np.array([[1], [1], [1], [0.3], [0.3], [0.3]])
DT = 0.01
either = pytest.mark.parametrize("name", list(ARMS))
seeds = st.integers(0, 2**32 - 1)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def least_singular_value(arm, q):
    return np.linalg.svd(WEIGHTS * arm.jacobian(q), compute_uv=False)[-1]


@either
@pytest.mark.parametrize("change", [-0.5, 0.4])
@pytest.mark.parametrize("convention", ["stereographic", "conventional"])
def test_the_elbow_swings_to_its_angle_while_the_tool_stands_still(name, change, convention):
    arm = ARMS[name]
    q, velocity, start = arm.home.copy(), np.zeros(7), arm.tool_pose(arm.home)
    wanted = wrapped(sew_angle(*arm.sew_points(q), convention=convention) + change)
    solver = IKSolver(arm, dt=DT)
    for _ in range(400):
        task = ElbowTask(wanted, convention=convention)
        twist = 10.0 * arm.tool_pose(q).error_to(start)
        velocity = solver.solve(q, [TwistTask(twist), task], velocity=velocity)
        q = q + DT * velocity
        assert np.linalg.norm(arm.tool_pose(q).error_to(start)) < 0.01
    assert abs(wrapped(sew_angle(*arm.sew_points(q), convention=convention) - wanted)) < 1e-3
    assert np.linalg.norm(arm.tool_pose(q).error_to(start)) < 1e-4


def gradient_of_the_angle(arm, q):
    """The angle, the squares of sine and reference on which its task fades, and its gradient by the joints."""
    state = sew_derivatives(*arm.sew_points(q))
    gradient = np.concatenate((state.shoulder, state.elbow, state.wrist)) @ arm.sew_jacobians(q).reshape(9, 7)
    s, e, w = arm.sew_points(q)
    sine = np.linalg.norm(np.cross(e - s, w - e)) / (np.linalg.norm(e - s) * np.linalg.norm(w - e))
    return state.angle, sine**2, state.reference, gradient


@settings(deadline=None, max_examples=60)
@given(seeds, st.sampled_from(list(ARMS)), st.booleans())
def test_the_elbow_has_the_documented_cost(seed, name, moving):
    """An independent solver finds no better point in the box; n, J+ and the limit of change by the pseudo-inverse."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper)
    jacobian = WEIGHTS * arm.tool_jacobian(q)
    assume(np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.05)  # else the damping of the solver's J+ is felt
    before = 0.3 * rng.normal(size=7) if moving else None
    twist = 0.3 * rng.normal(size=6)
    elbow = ElbowTask(rng.uniform(-3, 3), weight=rng.uniform(0.01, 1.0), confidence=rng.random())
    task = TwistTask(twist, max_speed=1e9)
    ours = solve_ik(arm, q, [task, elbow], velocity=before)
    box = IKSolver(arm).problem(q, task, before).box
    angle, sine_squared, reference, gradient = gradient_of_the_angle(arm, q)
    inverse, wanted = np.linalg.pinv(jacobian), WEIGHTS[:, 0] * twist
    spare = gradient - inverse @ (jacobian @ gradient)
    turns = np.linalg.norm(spare)
    assume(turns > 0.05 and np.linalg.norm(gradient) < 5.0)
    direction = spare / turns
    rate = np.clip(5.0 * wrapped(elbow.angle - angle), -1.0, 1.0)
    share = elbow.confidence * min(1.0, sine_squared / 0.1) * min(1.0, reference / 0.04)
    speed = share * (rate - gradient @ inverse @ wanted) / turns
    if moving:  # by no more than half of what the joints can change in a step
        change = 0.5 * np.min(0.5 * (box.upper - box.lower) / np.abs(direction))
        speed = np.clip(speed, direction @ before - change, direction @ before + change)

    def cost(v):
        miss = jacobian @ v - wanted
        changed = 0.0 if before is None else np.sum((v - before) ** 2)
        small = ik._EFFORT * v @ v + ik._CHANGE * changed
        return 0.5 * (miss @ miss + elbow.weight * (direction @ v - speed) ** 2 + small)

    other = minimize(cost, ours, bounds=list(zip(*box, strict=True)), method="L-BFGS-B")
    assert cost(ours) <= (1.0 + 1e-6) * other.fun + 1e-6


@settings(deadline=None, max_examples=60)
@given(seeds, st.sampled_from(list(ARMS)), st.sampled_from([1e-4, 0.1, 1.0, 100.0]))
def test_while_no_limit_is_near_the_elbow_takes_nothing_from_the_tool(seed, name, weight):
    arm, rng = ARMS[name], np.random.default_rng(seed)
    middle, half = 0.5 * (arm.upper + arm.lower), 0.5 * (arm.upper - arm.lower)
    q = middle + 0.8 * half * rng.uniform(-1.0, 1.0, size=7)
    assume(least_singular_value(arm, q) > 0.03)
    twist, solver = 0.05 * rng.normal(size=6), IKSolver(arm)
    free = solver.step(q, TwistTask(twist))
    led = solver.step(q, [TwistTask(twist), ElbowTask(rng.uniform(-3, 3), weight, rng.random(), max_rate=0.2)])
    assume(not free.limited.any() and not led.limited.any())
    np.testing.assert_allclose(arm.tool_jacobian(q) @ led.velocity, arm.tool_jacobian(q) @ free.velocity, atol=1e-5)


@either
def test_without_confidence_the_self_motion_stands_still_and_without_weight_it_is_free(name):
    """The posture pulls at the self-motion: free it follows, held it does not."""
    arm = ARMS[name]
    q, twist = arm.home, TwistTask([0.1, 0.05, 0, 0, 0, 0.1])
    jacobian = WEIGHTS * arm.tool_jacobian(q)
    spare = np.linalg.svd(jacobian)[2][-1]
    posture = PostureTask(q + 0.5 * spare)
    free = solve_ik(arm, q, [twist, posture])
    assert abs(spare @ free) > 0.1
    weightless = solve_ik(arm, q, [twist, posture, ElbowTask(2.0, weight=0.0)])
    np.testing.assert_allclose(weightless, free, atol=1e-9)
    held = solve_ik(arm, q, [twist, posture, ElbowTask(2.0, confidence=0.0)])
    assert abs(spare @ held) < 0.01 * abs(spare @ free)
    led = solve_ik(arm, q, [twist, posture, ElbowTask(sew_angle(*arm.sew_points(q)) + 0.5)])
    assert abs(spare @ led) > 0.1


def test_a_lost_angle_does_no_harm():
    """A straight arm: its elbow is on the line from shoulder to wrist, and has no angle."""
    panda, twist = ARMS["panda"], TwistTask([0.1, 0.05, 0, 0, 0, 0.1])
    straight = np.array([0.2, 0.3, 0, panda.landmarks.elbow_straight, 0, 1.5, 0])
    led = solve_ik(panda, straight, [twist, ElbowTask(2.0)])
    assert np.isfinite(led).all()
    moved, free = (panda.tool_jacobian(straight) @ v for v in (led, solve_ik(panda, straight, twist)))
    np.testing.assert_allclose(moved, free, atol=1e-3)


@settings(deadline=None, max_examples=25)
@given(seeds, st.sampled_from(list(ARMS)), st.sampled_from([0.002, 0.01, 0.03]))
def test_no_limit_is_ever_broken_with_everything_on(seed, name, dt):
    """Wild targets for tool and elbow; position, velocity, acceleration and the elbow's bound all hold."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    elbow, straight = arm.landmarks.elbow, arm.landmarks.elbow_straight
    q, velocity = arm.home.copy(), np.zeros(7)
    side = np.sign(q[elbow] - straight)
    solver = IKSolver(arm, [JointLimits(arm), *singularity_limits(arm)], dt=dt)
    for step in range(200):
        if step % 20 == 0:
            twist = rng.normal(size=6) * 10.0 ** rng.uniform(-2, 1)
            angle = rng.uniform(-np.pi, np.pi)
            posture = [PostureTask(rng.uniform(arm.lower, arm.upper))] if rng.random() < 0.5 else []
        tasks = [TwistTask(twist), ElbowTask(angle, weight=rng.random()), *posture]
        new = solver.solve(q, tasks, velocity=velocity)
        assert np.all(np.abs(new) <= arm.max_velocity * (1 + 1e-12))
        assert np.all(np.abs(new - velocity) <= arm.max_acceleration * dt + 1e-9)
        velocity, q = new, q + dt * new
        assert np.all(q <= arm.upper + 1e-9) and np.all(q >= arm.lower - 1e-9)
        assert side * (q[elbow] - straight) >= 0.15 - 1e-9


@either
@pytest.mark.parametrize("method", list(METHODS))
def test_every_method_keeps_the_elbow_bent_beyond_the_reach(name, method):
    arm = ARMS[name]
    elbow, straight = arm.landmarks.elbow, arm.landmarks.elbow_straight
    target = Pose(arm.tool_pose(arm.home).position + [0.7, 0, 0], arm.tool_pose(arm.home).quaternion)

    def most_stretched(limits):
        solver = IKSolver(arm, limits, dt=DT, method=method)
        q, least, smallest = arm.home.copy(), np.inf, np.inf
        for _ in range(300):
            twist = 5.0 * arm.tool_pose(q).error_to(target)
            q = q + DT * solver.solve(q, TwistTask(twist))
            least = min(least, abs(q[elbow] - straight))
            smallest = min(smallest, least_singular_value(arm, q))
        return least, smallest

    joints, elbow_limit = JointLimits(arm), ElbowSingularityLimit(arm)
    (free, free_value), (kept, kept_value) = most_stretched([joints]), most_stretched([joints, elbow_limit])
    assert kept >= 0.15 - 1e-9
    if method == "qp":
        assert free < 0.05 and kept_value > free_value


@either
def test_the_wrist_keeps_off_its_singular_position_where_the_task_can_spare_it(name):
    """The elbow is free: the arm has a choice, and takes the one without the singularity."""
    arm = ARMS[name]
    wrist = arm.landmarks.wrist
    start = arm.home.copy()
    start[wrist] = 0.3
    axis = arm.tool_jacobian(start)[:, wrist]

    def led(limits):
        solver = IKSolver(arm, limits, dt=DT)
        q, velocity, least = start.copy(), np.zeros(7), np.inf
        reached = arm.tool_pose(start)
        for _ in range(60):  # first turns the wrist's joint towards its singular position, if nothing holds it back
            velocity = solver.solve(q, TwistTask(-0.5 * axis), velocity=velocity)
            q = q + DT * velocity
            least = min(least, abs(q[wrist]))
        return least, reached

    assert led([JointLimits(arm), *singularity_limits(arm)])[0] > led([JointLimits(arm)])[0]


def test_the_wrist_bound_gives_way_to_a_task_that_needs_to_pass():
    """Soft: a hand that has to turn through the singular position does, so nobody is locked in."""
    start, end = SAWYER.home.copy(), SAWYER.home.copy()
    start[5], end[5] = 0.4, -0.4
    target = SAWYER.tool_pose(end)
    q, velocity = start.copy(), np.zeros(7)
    solver = IKSolver(SAWYER, [JointLimits(SAWYER), *singularity_limits(SAWYER)], dt=DT)
    for _ in range(800):
        twist = 4.0 * SAWYER.tool_pose(q).error_to(target)
        velocity = solver.solve(q, TwistTask(twist), velocity=velocity)
        q = q + DT * velocity
    assert np.linalg.norm(SAWYER.tool_pose(q).error_to(target)) < 0.02


def test_joints_offset_from_zero_barely_help_on_the_sawyer():
    """Thesis, after Eq 3.9: what the thesis's offset of all joints can and can't do; orders of magnitude."""
    table = {0.0: 0.0, 0.01: 2.0e-4, 0.05: 9.9e-4, 0.1: 2.0e-3, 0.2: 4.4e-3}
    flange = ArmModel.load("sawyer")
    for offset, expected in table.items():
        assert least_singular_value(flange, np.full(7, offset)) == pytest.approx(expected, rel=0.6, abs=1e-9)
    rng = np.random.default_rng(0)
    random = [least_singular_value(flange, rng.uniform(flange.lower, flange.upper)) for _ in range(300)]
    assert np.median(random) > 15 * table[0.2]


def test_only_elbow_and_wrist_of_the_sawyer_matter():
    """Thesis, after Eq 3.9: with one joint at zero and the others anywhere, only 3 and 5 cost a direction."""
    flange, rng = ArmModel.load("sawyer"), np.random.default_rng(1)
    postures = rng.uniform(flange.lower, flange.upper, (250, 7))
    medians = []
    for joint in range(7):
        postures_there = postures.copy()
        postures_there[:, joint] = 0.0
        medians.append(np.median([least_singular_value(flange, q) for q in postures_there]))
    anywhere = np.median([least_singular_value(flange, q) for q in postures])
    assert max(medians[3], medians[5]) < 0.7 * anywhere
    assert min(np.delete(medians, [3, 5])) > 0.85 * anywhere


def test_the_panda_is_stretched_inside_its_range_not_at_zero():
    """Its elbow's axis stands beside both links, so the arm is longest, and singular, at -0.467 rad."""
    arm = ArmModel.load("panda")
    straight = arm.landmarks.elbow_straight
    angles = straight + np.linspace(-0.3, 0.3, 61)
    lengths = []
    for angle in angles:
        s, _, w = arm.sew_points([0.3, 0.4, 0.1, angle, 0.5, 1.2, 0.3])
        lengths.append(np.linalg.norm(w - s))
    assert angles[np.argmax(lengths)] == pytest.approx(straight, abs=1e-6)
    assert least_singular_value(arm, np.array([0.3, 0.4, 0.1, straight, 0.5, 1.2, 0.3])) < 0.02
    assert arm.lower[3] < straight < arm.upper[3]


def test_a_solver_kept_is_the_function_called():
    rng = np.random.default_rng(0)
    for method in METHODS:
        solver = IKSolver(SAWYER, dt=0.02, method=method)
        for _ in range(20):
            q = rng.uniform(SAWYER.lower, SAWYER.upper)
            task = TwistTask(rng.normal(size=6), "flange", max_speed=0.3)
            called = solve_ik(SAWYER, q, task, method=method, dt=0.02)
            assert np.array_equal(solver.solve(q, task), called)
            assert np.array_equal(solver.step(q, task).velocity, called)


@pytest.mark.parametrize(
    ("elbow", "error", "said"),
    [
        (ElbowTask(np.nan), InputError, "finite angle"),
        (ElbowTask(0.1, weight=-1.0), InputError, "not negative"),
        (ElbowTask(0.1, convention="polar"), UnknownNameError, "conventional, stereographic"),
    ],
)
def test_what_can_not_be_used_is_refused(elbow, error, said):
    with pytest.raises(error, match=said):
        solve_ik(SAWYER, SAWYER.home, [TwistTask(np.zeros(6)), elbow])
