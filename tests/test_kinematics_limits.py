from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.limits import ELBOW_MARGIN, ElbowSingularityLimit, JointLimits
from imitarm.kinematics.tasks import TwistTask

ARMS = {name: ArmModel.load(name) for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
DT = 0.01
STILL = TwistTask(np.zeros(6))


def velocity_box(arm, q, dt, velocity=None):
    return JointLimits(arm).box(np.asarray(q, dtype=float), dt, velocity)


def bent_box(arm, q, dt, velocity=None):
    """The box with the elbow's margin in it."""
    return IKSolver(arm, [JointLimits(arm), ElbowSingularityLimit(arm)], dt=dt).problem(q, STILL, velocity).box


seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=30)
@given(seeds, st.sampled_from([0.001, 0.01, 0.05]), st.sampled_from(list(ARMS)))
def test_the_box_is_never_empty_and_its_worst_corner_can_still_stop(seed, dt, name):
    """Walk on the box's own corners; no limit of position, velocity or acceleration is ever passed."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    q, velocity = rng.uniform(arm.lower, arm.upper), np.zeros(7)
    for _ in range(200):
        lower, upper = velocity_box(arm, q, dt, velocity)
        assert np.all(lower <= upper)
        assert np.all(upper <= arm.max_velocity) and np.all(lower >= -arm.max_velocity)
        chosen = np.where(rng.random(7) < 0.9, np.where(rng.random() < 0.5, upper, lower), rng.uniform(lower, upper))
        assert np.all(np.abs(chosen - velocity) <= arm.max_acceleration * dt + 1e-12)
        velocity = chosen
        q = q + dt * velocity
        assert np.all(q <= arm.upper + 1e-9) and np.all(q >= arm.lower - 1e-9)


def test_the_box_leads_back_from_outside_the_limits():
    q = SAWYER.upper + 0.05
    lower, upper = velocity_box(SAWYER, q, DT)
    assert np.all(upper == 0.0) and np.all(lower < 0.0)
    velocity = SAWYER.max_velocity  # and running further out: then it brakes as hard as it may
    lower, upper = velocity_box(SAWYER, q, DT, velocity)
    assert np.allclose(upper, velocity - SAWYER.max_acceleration * DT)
    assert np.all(lower <= upper)


def test_joints_without_limits_have_only_the_velocity(tmp_path):
    file = tmp_path / "turntable.xml"
    file.write_text(
        "<mujoco><worldbody><body name='plate'><joint name='turn'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    arm = ArmModel.load(file)
    assert arm.lower[0] == -np.inf and arm.upper[0] == np.inf
    lower, upper = velocity_box(arm, [400.0], DT)
    assert upper[0] == arm.max_velocity[0] == -lower[0]


def documented_box(arm, q, dt, velocity):
    """The documented bounds joint by joint, an independent statement."""
    lower, upper = [], []
    for a, most, low, high, x, before in zip(
        arm.max_acceleration, arm.max_velocity, arm.lower, arm.upper, q, velocity, strict=True
    ):

        def bound(way, before, a=a, most=most):
            stopping = -a * dt + np.sqrt((a * dt) ** 2 + 2 * a * max(way, 0.0))
            return min(most, before + a * dt, max(stopping, before - a * dt))

        upper.append(bound(high - x, before))
        lower.append(-bound(x - low, -before))
    return np.array(lower), np.array(upper)


@settings(deadline=None, max_examples=200)
@given(seeds, st.sampled_from(list(ARMS)))
def test_the_box_is_the_formula_wherever_the_arm_is(seed, name):
    arm, rng = ARMS[name], np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper) * (0.3 if seed % 2 else 1.0)  # far from all limits, or anywhere
    q = np.clip(q, arm.lower, arm.upper)
    velocity = rng.uniform(-1, 1, 7) * arm.max_velocity
    assert np.allclose(velocity_box(arm, q, DT, velocity), documented_box(arm, q, DT, velocity), atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seeds, st.sampled_from([0.001, 0.01, 0.05]), st.sampled_from(list(ARMS)))
def test_the_elbow_keeps_its_side_and_its_margin(seed, dt, name):
    """The hard bound is one more limit of position, so the box stays never-empty with it."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    elbow, straight = arm.landmarks.elbow, arm.landmarks.elbow_straight
    q, velocity = rng.uniform(arm.lower, arm.upper), np.zeros(7)
    side = 1.0 if q[elbow] >= straight else -1.0
    away = side * (q[elbow] - straight)
    for _ in range(200):
        lower, upper = bent_box(arm, q, dt, velocity)
        assert np.all(lower <= upper)
        towards = np.where(rng.random() < 0.5, upper, lower)
        towards[elbow] = (lower if side > 0.0 else upper)[elbow]  # the elbow always tries to stretch
        chosen = np.where(rng.random(7) < 0.9, towards, rng.uniform(lower, upper))
        assert np.all(np.abs(chosen - velocity) <= arm.max_acceleration * dt + 1e-12)
        velocity, q = chosen, q + dt * chosen
        now = side * (q[elbow] - straight)
        assert now >= min(away, ELBOW_MARGIN) - 1e-9  # one that begins nearer comes no nearer
        away = now
        assert np.all(q <= arm.upper + 1e-9) and np.all(q >= arm.lower - 1e-9)


def test_an_elbow_that_begins_stretched_can_only_bend_on():
    lower, upper = bent_box(SAWYER, np.zeros(7), DT)
    assert lower[3] == 0.0 and upper[3] > 0.0
    bent = np.array([0, 0, 0, -0.01, 0, 0, 0.0])
    lower, upper = bent_box(SAWYER, bent, DT)
    assert upper[3] == 0.0 and lower[3] < 0.0
    free = velocity_box(SAWYER, bent, DT)
    assert np.array_equal(np.delete(lower, 3), np.delete(free[0], 3))


def test_an_arm_without_an_elbow_has_no_singularity_limit(tmp_path):
    file = tmp_path / "turntable.xml"
    file.write_text(
        "<mujoco><worldbody><body name='plate'><joint name='turn'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(InputError, match="add sites named"):
        ElbowSingularityLimit(ArmModel.load(file))


def pink_box(arm, q, dt, velocity):
    """The same limits as a known library states them : each is right alone, together they can be empty."""
    a, most = arm.max_acceleration, arm.max_velocity

    def step(way, before):
        stopping = dt * np.sqrt(2 * a * np.maximum(way, 0.0))
        return np.minimum.reduce([most * dt, 0.5 * way, a * dt * dt + before * dt, stopping])

    return -step(q - arm.lower, -velocity) / dt, step(arm.upper - q, velocity) / dt


def test_bounds_that_do_not_fit_together_leave_no_velocity_and_ours_always_do():
    """A joint led to its limit as fast as each box lets it."""
    stuck = dict.fromkeys(("pink", "ours"), 0)
    for which, box in (("pink", pink_box), ("ours", velocity_box)):
        q, velocity = np.array(SAWYER.home), np.zeros(7)
        for _ in range(400):
            lower, upper = box(SAWYER, q, DT, velocity)
            stuck[which] += bool(np.any(lower > upper + 1e-12))
            velocity = np.maximum(upper, lower)
            q = np.clip(q + DT * velocity, SAWYER.lower, SAWYER.upper)
    assert stuck["ours"] == 0
    assert stuck["pink"] > 0
