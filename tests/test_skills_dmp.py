from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills import DMP, DMPState, Gains
from imitarm.skills.dynamical_systems import MovingTarget
from imitarm.skills.rotations import RotationState
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
NET = np.array([0.3, 0.2, -0.1])
WXYZ = np.array([1.0, 0.0, 0.0, 0.0])


def minimum_jerk(duration: float = 2.0, n: int = 201, net: Array = NET, offset: float = 0.0) -> Trajectory:
    t = np.linspace(0.0, duration, n)
    u = t / duration
    return Trajectory(t + offset, (u**3 * (10.0 + u * (6.0 * u - 15.0)))[:, None] * net)


def wave() -> Trajectory:
    t = np.linspace(0.0, 3.0, 301)
    u = t / 3.0
    p = u**3 * (10.0 + u * (6.0 * u - 15.0))
    return Trajectory(t, np.column_stack([0.4 * p, 0.1 * np.sin(3 * np.pi * p), 0.05 * np.sin(2 * np.pi * p) + 0.2]))


@pytest.fixture(scope="module")
def dmp() -> DMP:
    return DMP().fit(wave())


@pytest.mark.parametrize("gains", ["critical", "thesis"])
def test_a_rollout_does_not_lead_its_demonstration(gains: str) -> None:
    shown = minimum_jerk()
    done = DMP(gains).fit(shown).generate()
    same_index = np.abs(done.positions - shown.positions).max()
    shifted = np.abs(done.positions[:-1] - shown.positions[1:]).max()
    assert same_index < 2e-5
    assert same_index < 0.01 * shifted


@pytest.mark.parametrize("offset", [1.0, -20.0, 1.7e9])
def test_time_stamps_may_start_anywhere(offset: float) -> None:
    plain = DMP().fit(minimum_jerk()).generate()
    other = DMP().fit(minimum_jerk(offset=offset)).generate()
    np.testing.assert_allclose(other.times, plain.times, atol=1e-6)
    np.testing.assert_allclose(other.positions, plain.positions, atol=1e-6)


def test_sample_count_is_round_of_duration_over_dt_plus_one() -> None:
    dmp = DMP(n_basis=5).fit(minimum_jerk(n=50))
    rng = np.random.default_rng(0)
    for _ in range(500):
        duration, dt = round(rng.uniform(0.1, 3.0), 2), float(rng.choice([0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1]))
        done = dmp.generate(duration=duration, dt=dt)
        assert len(done) == round(duration / dt) + 1
        assert done.times[-1] == pytest.approx(duration, abs=1e-12)


def test_a_step_may_be_as_long_as_the_motion_but_not_longer() -> None:
    dmp = DMP(n_basis=5).fit(minimum_jerk(n=50))
    assert len(dmp.generate(duration=0.3, dt=3 * 0.1)) == 2  # 3 * 0.1 exceeds 0.3 by a rounding error
    with pytest.raises(InputError, match=r"dt must be at most the duration 0\.3 s"):
        dmp.generate(duration=0.3, dt=0.31)


@pytest.mark.parametrize("adjustment", ["progress", "rotodilatation"])
def test_half_the_distance_never_goes_backwards(adjustment: str) -> None:
    shown = minimum_jerk()
    done = DMP().fit(shown).generate(goal=0.5 * NET, adjustment=adjustment)
    along = done.positions @ NET / (NET @ NET)
    assert along.min() > -1e-5
    assert np.diff(along).min() > -1e-4
    assert along.max() < 0.5 + 1e-4
    np.testing.assert_allclose(along, 0.5 * (shown.positions @ NET) / (NET @ NET), atol=1e-3)


def test_half_the_distance_of_a_demonstration_that_waits_first_never_goes_backwards() -> None:
    t = np.linspace(0.0, 3.0, 301)
    u = np.clip((t - 1.0) / 1.5, 0.0, 1.0)
    shown = Trajectory(t, (u**3 * (10.0 + u * (6.0 * u - 15.0)))[:, None] * NET)
    along = DMP().fit(shown).generate(goal=0.5 * NET).positions @ NET / (NET @ NET)
    assert along.min() > -1e-3


@pytest.mark.parametrize("adjustment", ["progress", "hoffmann", "rotodilatation"])
def test_a_still_axis_makes_no_excursion(adjustment: str) -> None:
    """1 mm net motion on one axis, goal moved by 50 mm on it: a form scaled by goal - start goes 4.9 m away."""
    x = wave().positions.copy()
    x[:, 2] = 0.2 + 1e-3 * np.linspace(0.0, 1.0, len(x)) + 0.02 * np.sin(np.linspace(0.0, np.pi, len(x)))
    shown = Trajectory(wave().times, x)
    goal = x[-1] + [0.0, 0.0, 0.05]
    done = DMP().fit(shown).generate(goal=goal, adjustment=adjustment)
    assert np.abs(done.positions[:, 2] - 0.2).max() < 0.11
    np.testing.assert_allclose(done.positions[-1], goal, atol=3e-3 if adjustment == "hoffmann" else 1e-6)


def test_a_motion_with_next_to_no_net_motion_can_be_given_another_goal() -> None:
    t = np.linspace(0.0, 2.0, 201)
    loop = np.column_stack([0.1 * np.sin(np.pi * t), 0.1 - 0.1 * np.cos(np.pi * t), 0.0005 * t])
    for adjustment in ("progress", "hoffmann", "rotodilatation"):
        done = DMP().fit(Trajectory(t, loop)).generate(goal=[0.05, 0.0, 0.0], adjustment=adjustment)
        assert np.abs(done.positions).max() < 0.3


@settings(max_examples=30, deadline=None)
@given(
    start=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    goal=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    duration=st.floats(0.5, 20.0),
)
def test_it_starts_and_ends_where_asked(dmp: DMP, start: tuple, goal: tuple, duration: float) -> None:
    done = dmp.generate(start, goal, duration, duration / 150)
    np.testing.assert_allclose(done.positions[0], start, atol=1e-12)
    np.testing.assert_allclose(done.positions[-1], goal, atol=2e-5)


def test_moving_both_ends_moves_the_motion(dmp: DMP) -> None:
    shift = np.array([0.5, -0.3, 0.1])
    moved = dmp.generate(dmp.start_ + shift, dmp.goal_ + shift)
    np.testing.assert_allclose(moved.positions, dmp.generate().positions + shift, atol=1e-9)


def test_rotodilatation_turns_and_stretches_the_shape(dmp: DMP) -> None:
    net = dmp.goal_ - dmp.start_
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shown = dmp.generate()
    done = dmp.generate(goal=dmp.start_ + 2.0 * R @ net, adjustment="rotodilatation")
    turn_and_stretch = done.positions - dmp.start_
    np.testing.assert_allclose(
        np.linalg.norm(turn_and_stretch, axis=1), 2.0 * np.linalg.norm(shown.positions - dmp.start_, axis=1), atol=1e-6
    )


def test_duration_changes_the_time_and_not_the_path(dmp: DMP) -> None:
    slow, quick = dmp.generate(duration=9.0, dt=0.09), dmp.generate(duration=1.0, dt=0.01)
    np.testing.assert_allclose(slow.positions, quick.positions, atol=1e-12)


def test_the_step_hardly_changes_the_motion(dmp: DMP) -> None:
    fine = dmp.generate(dt=0.001)
    for dt, atol in ((0.1, 1e-3), (0.03, 2e-5), (0.01, 1e-6)):
        coarse = dmp.generate(dt=dt)
        np.testing.assert_allclose(coarse.positions, fine.at(coarse.times)[0], atol=atol)


@pytest.mark.parametrize("dt", [0.01, 0.037])
def test_steps_equal_the_whole_motion(dmp: DMP, dt: float) -> None:
    done = dmp.generate(goal=[0.2, 0.3, 0.4], dt=dt)
    n = len(done) - 1
    state = dmp.begin(goal=[0.2, 0.3, 0.4])
    for k in range(n):
        np.testing.assert_allclose(state.position, done.positions[k], atol=1e-10)
        state = dmp.step(state, dmp.duration_ / n)
    assert state.time == pytest.approx(dmp.duration_)
    assert state.phase == pytest.approx(0.01)
    with_coupling = dmp.generate(goal=[0.2, 0.3, 0.4], dt=dt, coupling=lambda x, v: np.zeros(3))
    np.testing.assert_allclose(with_coupling.positions, done.positions, atol=1e-10)


def test_steps_of_changing_length_stay_on_the_motion(dmp: DMP) -> None:
    rng = np.random.default_rng(0)
    fine = dmp.generate(dt=0.001)
    state = dmp.begin()
    while state.time < 2.9:
        state = dmp.step(state, float(rng.uniform(0.002, 0.02)))
        np.testing.assert_allclose(state.position, fine.at([state.time])[0][0], atol=2e-5)


def test_it_rests_at_the_goal_afterwards(dmp: DMP) -> None:
    state = dmp.begin(goal=[0.5, 0.1, 0.2])
    for _ in range(1000):
        state = dmp.step(state, 0.01)
    np.testing.assert_allclose(state.position, [0.5, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(state.velocity, 0.0, atol=1e-5)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_it_does_not_wander_off_after_the_end(noise: float) -> None:
    shown = minimum_jerk()
    x = shown.positions + noise * np.random.default_rng(1).standard_normal(shown.positions.shape)
    dmp = DMP().fit(Trajectory(shown.times, x))
    state = dmp.begin()
    for k in range(800):
        state = dmp.step(state, 0.01)
        if k >= 199:
            assert np.linalg.norm(state.position - dmp.goal_) < 1e-4 + 5.0 * noise


def test_velocity_is_the_derivative_of_position(dmp: DMP) -> None:
    state = dmp.begin(duration=5.0)
    for _ in range(200):
        state = dmp.step(state, 0.01)
    before, after = dmp.step(state, -1e-4 + 1e-4 + 1e-5), dmp.step(state, 3e-5)
    np.testing.assert_allclose((after.position - before.position) / 2e-5, state.velocity, atol=1e-4)


def test_start_velocity_is_learnt_and_can_be_given() -> None:
    t = np.linspace(0.0, 2.0, 201)
    dmp = DMP().fit(Trajectory(t, np.column_stack([0.3 * np.sin(2.0 * t), 0.2 * np.cos(t), 0.1 * t])))
    np.testing.assert_allclose(dmp.start_velocity_, [0.6, 0.0, 0.1], atol=0.01)
    np.testing.assert_allclose(dmp.begin(duration=4.0).velocity, dmp.start_velocity_ / 2.0)
    resting = dmp.generate(start_velocity=np.zeros(3), dt=0.001)
    np.testing.assert_allclose(resting.positions[1], dmp.start_, atol=5e-5)
    np.testing.assert_allclose(resting.positions[-1], dmp.goal_, atol=1e-3)


def test_coupling_pushes_and_lets_go(dmp: DMP) -> None:
    push = np.array([0.0, 0.0, 2.0])  # [m/s^2]
    plain = dmp.generate()
    pushed = dmp.generate(coupling=lambda x, v: push if 0.1 < x[0] < 0.2 else np.zeros(3))
    assert (pushed.positions - plain.positions)[:, 2].max() > 0.005
    np.testing.assert_allclose(pushed.positions[-1], dmp.goal_, atol=3e-3)


def test_a_constant_coupling_settles_where_the_spring_balances_it(dmp: DMP) -> None:
    state = dmp.begin()
    for _ in range(1500):
        state = dmp.step(state, 0.01, coupling=lambda x, v: [1.0, 0.0, 0.0])
    expected = dmp.goal_[0] + dmp.duration_**2 / dmp.gains_.stiffness
    assert state.position[0] == pytest.approx(expected, rel=1e-6)


def test_it_waits_for_a_robot_that_lags(dmp: DMP) -> None:
    state = dmp.begin()
    for _ in range(100):
        state = dmp.step(state, 0.01)
    held = state.position
    waiting = state
    for _ in range(300):
        waiting = dmp.step(waiting, 0.01, measured=held)
    assert waiting.time < state.time + 1.5  # three seconds later
    done = dmp.generate(dt=0.001)
    np.testing.assert_allclose(waiting.position, done.at([waiting.time])[0][0], atol=2e-5)  # on the same path
    on_time = dmp.step(state, 0.01, measured=state.position)
    assert on_time.time == pytest.approx(state.time + 0.01)


def test_a_goal_that_moves_is_followed(dmp: DMP) -> None:
    state = dmp.begin()
    up = np.array([0.0, 0.0, 0.1])
    for k in range(300):
        state = dmp.step(state, 0.01, goal=dmp.goal_ + min(k / 150, 1.0) * up)
    np.testing.assert_allclose(state.position, dmp.goal_ + up, atol=2e-3)
    for _ in range(200):
        state = dmp.step(state, 0.01)
    np.testing.assert_allclose(state.position, dmp.goal_ + up, atol=1e-5)


def test_samples_may_be_unevenly_spaced() -> None:
    rng = np.random.default_rng(0)
    keep = np.sort(np.concatenate([[0, 2000], rng.choice(np.arange(1, 2000), 150, replace=False)]))
    fine = minimum_jerk(n=2001)
    dmp = DMP().fit(Trajectory(fine.times[keep], fine.positions[keep]))
    np.testing.assert_allclose(dmp.generate(dt=0.001).positions, fine.positions, atol=1e-3)


def test_few_samples_are_enough() -> None:
    done = DMP().fit(minimum_jerk(n=3)).generate()
    np.testing.assert_allclose(done.positions[[0, -1]], [[0.0, 0.0, 0.0], NET], atol=1e-6)
    assert np.abs(done.positions).max() < 0.5


def test_rotation_is_learnt_with_the_position() -> None:
    t = np.linspace(0.0, 2.0, 201)
    turn = np.deg2rad(270.0) * (t / 2.0) ** 2 * (3.0 - t)
    q = quaternion_exp(turn[:, None] * np.array([0.0, 0.6, 0.8]))
    dmp = DMP().fit(Trajectory(t, minimum_jerk().positions, q))
    done = dmp.generate()
    assert done.quaternions is not None
    apart = quaternion_log(quaternion_multiply(done.quaternions, quaternion_conjugate(q)))
    assert np.linalg.norm(apart, axis=1).max() < 1e-3
    goal = Pose(NET, quaternion_multiply(quaternion_exp([0.3, 0.0, 0.0]), q[-1]))
    other = dmp.generate(goal=goal)
    assert other.quaternions is not None
    apart = quaternion_log(quaternion_multiply(other.quaternions[-1], quaternion_conjugate(goal.quaternion)))
    assert np.linalg.norm(apart) < 1e-9
    stepped = dmp.generate(goal=goal, coupling=lambda x, v: np.zeros(6))
    assert stepped.quaternions is not None
    np.testing.assert_allclose(np.abs(np.sum(stepped.quaternions * other.quaternions, axis=1)), 1.0, atol=1e-9)


def test_a_quaternion_must_come_in_a_pose() -> None:
    dmp = DMP().fit(minimum_jerk())
    with pytest.raises(InputError, match=r"goal .a Pose or a position. must be 3 numbers"):
        dmp.generate(goal=[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(dmp.generate(goal=Pose(NET, WXYZ)).positions[-1], NET, atol=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        {"dt": 0.0},
        {"dt": -0.01},
        {"dt": 1e9},
        {"dt": float("nan")},
        {"duration": 0.0},
        {"duration": float("inf")},
        {"start": [1.0, 2.0]},
        {"goal": [0.0, np.nan, 0.0]},
        {"start_velocity": [1.0]},
    ],
)
def test_bad_arguments_are_named(arguments: dict) -> None:
    with pytest.raises(InputError, match=next(iter(arguments))):
        DMP().fit(minimum_jerk(n=20)).generate(**arguments)


def test_bad_options_are_refused_when_given() -> None:
    for options in ({"n_basis": 1}, {"n_basis": 2.5}, {"regularisation": 0.0}, {"gains": Gains(0.0, 1.0)}):
        with pytest.raises(InputError):
            DMP(**options)
    with pytest.raises(UnknownNameError, match="hoffmann"):
        DMP().fit(minimum_jerk(n=20)).begin(adjustment="ijspeert")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="not fitted"):
        DMP().generate()
    with pytest.raises(InputError, match="at least 3 samples"):
        DMP().fit(minimum_jerk(n=2))


def test_from_weights_gives_the_same_motion_and_refuses_nonsense(dmp: DMP) -> None:
    arguments = {
        "gains": dmp.gains_,
        "start": dmp.start_,
        "goal": dmp.goal_,
        "start_velocity": dmp.start_velocity_,
        "duration": dmp.duration_,
        "path_length": dmp.path_length_,
    }
    again = DMP.from_weights(dmp.weights_, dmp.progress_weights_, **arguments)
    np.testing.assert_array_equal(again.generate(goal=[0, 0, 0]).positions, dmp.generate(goal=[0, 0, 0]).positions)
    with pytest.raises(InputError, match=r"weights must be an array of shape \(n, 3\)"):
        DMP.from_weights(dmp.weights_[:, :2], dmp.progress_weights_, **arguments)
    with pytest.raises(InputError, match="duration"):
        DMP.from_weights(dmp.weights_, dmp.progress_weights_, **{**arguments, "duration": -1.0})


TARGET = MovingTarget(np.zeros(3), np.ones(3), 4.0, "progress", np.zeros((5, 3)))
MOTION = np.array([[1.0, 2.0, 3.0], [4.0, 0.0, -4.0]])


def test_it_answers_in_metres_and_seconds() -> None:
    state = DMPState(MOTION, 0.5, TARGET)
    np.testing.assert_array_equal(state.position, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(state.velocity, [1.0, 0.0, -1.0])
    assert state.time == 2.0
    assert state.phase == pytest.approx(0.1)
    assert state.quaternion is None


def test_the_phase_falls_from_one_to_a_hundredth() -> None:
    assert DMPState(MOTION, 0.0, TARGET).phase == 1.0
    assert DMPState(MOTION, 1.0, TARGET).phase == pytest.approx(0.01)


def test_the_rotation_is_that_of_its_state() -> None:
    q = np.array([1.0, 0.0, 0.0, 0.0])
    rotation = RotationState(q, np.zeros((2, 3)), 0.5, np.zeros(3), np.zeros(3))
    assert DMPState(MOTION, 0.5, TARGET, rotation).quaternion is q
