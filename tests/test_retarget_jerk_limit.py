import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import ArmModel, InputError
from imitarm.retarget.modern import JerkLimiter

DT = 0.01


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("sawyer")


def broken(arm, joints, dt=DT):
    """Return how far position, velocity and acceleration limits are exceeded, from the joint positions alone."""
    velocity = np.diff(joints, axis=0) / dt
    acceleration = np.diff(velocity, axis=0) / dt
    return (
        max(float((joints - arm.upper).max()), float((arm.lower - joints).max())),
        float((np.abs(velocity) / arm.max_velocity).max()) - 1.0,
        float((np.abs(acceleration) / arm.max_acceleration).max()) - 1.0,
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 3.0]))
def test_no_reference_makes_it_break_a_limit(seed, jump):
    arm = ArmModel.load("sawyer")
    rng = np.random.default_rng(seed)
    limiter = JerkLimiter(arm, DT)
    limiter.start(arm.home)
    q, joints = arm.home.copy(), [arm.home]
    for k in range(400):
        if k % 40 == 0:
            q = q + jump * rng.normal(size=7)
        q = q + 0.03 * rng.normal(size=7)
        joints.append(limiter.follow(q, 3.0 * arm.max_velocity * rng.normal(size=7)))
    position, velocity, acceleration = broken(arm, np.array(joints))
    assert position <= 1e-9
    assert velocity <= 1e-9
    assert acceleration <= 1e-6


def test_it_stops_before_a_limit_at_full_speed(arm):
    limiter = JerkLimiter(arm, DT)
    limiter.start(arm.home)
    joints = [arm.home]
    for _ in range(500):
        joints.append(limiter.follow(arm.upper + 10.0, arm.max_velocity))
    assert broken(arm, np.array(joints))[0] <= 1e-9
    np.testing.assert_allclose(joints[-1], arm.upper, atol=0.02)


def test_jerk_is_limited_away_from_the_limits(arm):
    limiter = JerkLimiter(arm, DT)
    limiter.start(arm.home)
    t = np.arange(0.0, 4.0, DT)[:, None]
    q = arm.home + 0.15 * np.sin(2.0 * t + np.arange(7))
    v = 0.3 * np.cos(2.0 * t + np.arange(7))
    accelerations = []
    for a, b in zip(q, v, strict=True):
        limiter.follow(a, b)
        accelerations.append(limiter.acceleration)
    jerk = np.abs(np.diff(accelerations, axis=0)) / DT
    assert (jerk <= limiter.max_jerk * (1.0 + 1e-9)).all()


def test_a_smooth_reference_is_followed_without_lag(arm):
    limiter = JerkLimiter(arm, DT)
    limiter.start(arm.home)
    t = np.arange(0.0, 6.0, DT)[:, None]
    q = arm.home + 0.2 * (1.0 - np.cos(1.5 * t))
    v = 0.3 * np.sin(1.5 * t) * np.ones(7)
    reached = np.array([limiter.follow(a, b) for a, b in zip(q, v, strict=True)])
    assert np.abs(reached - q)[100:].max() < 0.002


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.06, 0.2]), st.booleans())
def test_a_command_does_not_run_away_from_joints_that_are_held(seed, max_lead, to_and_fro):
    """Held from rest on; one that swings through where they are may need its braking way."""
    arm = ArmModel.load("sawyer")
    rng = np.random.default_rng(seed)
    limiter = JerkLimiter(arm, DT, max_lead=max_lead)
    limiter.start(arm.home)
    q, joints, fastest = arm.home.copy(), [arm.home], np.zeros(7)
    ahead = arm.max_velocity * rng.choice([-1.0, 1.0], size=7)
    for k in range(300):
        if to_and_fro and k % 60 == 0:
            ahead = arm.max_velocity * rng.choice([-1.0, 1.0], size=7)
        q = q + DT * ahead
        joints.append(limiter.follow(q, ahead, arm.home))
        fastest = np.maximum(fastest, np.abs(limiter.velocity))
    lead = np.abs(np.array(joints) - arm.home)
    braking = fastest * (fastest / (2.0 * arm.max_acceleration) + 2.0 * DT)
    assert (lead <= max_lead + (braking if to_and_fro else 2.0 * DT * fastest)).all()
    assert lead[60].max() <= max_lead + 1e-3  # and there it stays
    assert max(broken(arm, np.array(joints))) <= 1e-6


def test_joints_that_are_stopped_in_motion_are_left_by_the_braking_way_and_no_more(arm):
    limiter = JerkLimiter(arm, DT, max_lead=0.06)
    middle = 0.5 * (arm.upper + arm.lower)
    limiter.start(middle)
    ahead = 0.4 * arm.max_velocity
    q, joints, stopped = middle.copy(), [middle], None
    for k in range(200):
        q = q + DT * ahead
        measured = joints[-1] if k < 50 else stopped
        joints.append(limiter.follow(q, ahead, measured))
        if k == 49:
            stopped = joints[-1]
            np.testing.assert_allclose(limiter.velocity, ahead, rtol=0.05)
    braking = np.max(ahead * (ahead / (2.0 * arm.max_acceleration) + 2.0 * DT))
    lead = np.abs(np.array(joints[50:]) - stopped)
    assert lead.max() <= 0.06 + braking
    assert lead[-1].max() <= 0.06 + 1e-6  # where it was farther it has come back
    assert max(broken(arm, np.array(joints))) <= 1e-6


def test_joints_that_follow_do_not_feel_the_lead(arm):
    """A robot that is three periods late is led as if nothing were measured."""
    t = np.arange(0.0, 4.0, DT)[:, None]
    q, v = arm.home + 0.15 * (1.0 - np.cos(1.5 * t)), 0.225 * np.sin(1.5 * t)
    reached = {}
    for max_lead in (0.06, np.inf):
        limiter = JerkLimiter(arm, DT, max_lead=max_lead)
        limiter.start(arm.home)
        joints = [arm.home] * 3
        for a, b in zip(q, v, strict=True):
            joints.append(limiter.follow(a, np.broadcast_to(b, 7), joints[-3]))
        reached[max_lead] = np.array(joints)
    np.testing.assert_array_equal(reached[0.06], reached[np.inf])


def test_a_joint_near_its_end_does_not_slow_the_others(arm):
    """A robot that does at once what it is told: with one joint near its end the others go at full speed."""
    start = 0.5 * (arm.upper + arm.lower)
    start[1] = arm.upper[1] - 0.05
    ahead = 0.8 * arm.max_velocity
    ahead[1] = 0.0
    reached = {}
    for max_lead in (0.06, np.inf):
        limiter = JerkLimiter(arm, DT, max_lead=max_lead)
        limiter.start(start)
        q, joints = start.copy(), [start]
        for _ in range(60):
            q = q + DT * ahead
            joints.append(limiter.follow(q, ahead, joints[-1]))
        reached[max_lead] = np.array(joints)
    np.testing.assert_array_equal(reached[0.06], reached[np.inf])


@pytest.mark.parametrize(
    "options", [{"frequency": 0.0}, {"frequency": 200.0}, {"rise_time": 0.001}, {"max_lead": 0.0}, {"max_lead": np.nan}]
)
def test_settings_that_can_not_work_are_refused(arm, options):
    with pytest.raises(InputError, match="JerkLimiter"):
        JerkLimiter(arm, DT, **options)
