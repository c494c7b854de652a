from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills import RhythmicDMP
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
WXYZ = np.array([1.0, 0.0, 0.0, 0.0])


def wiping(t: Array) -> Array:
    """Period 2 s, centre (0.3, 0, 0.2)."""
    return np.column_stack(
        [0.3 + 0.1 * np.sin(np.pi * t) + 0.03 * np.cos(3 * np.pi * t), 0.05 * np.cos(np.pi * t), 0.2 + 0.0 * t]
    )


@pytest.fixture(scope="module")
def dmp() -> RhythmicDMP:
    t = np.linspace(0.0, 2.0, 201)
    return RhythmicDMP().fit(Trajectory(t + 1.7e9, wiping(t)))


def test_it_repeats_what_was_shown(dmp: RhythmicDMP) -> None:
    done = dmp.generate(10.0, dt=0.02)
    assert len(done) == 501
    np.testing.assert_allclose(done.positions, wiping(done.times), atol=2e-4)
    np.testing.assert_allclose(done.positions[:101], done.positions[400:], atol=1e-6)


def test_one_period_by_default_and_center_learnt(dmp: RhythmicDMP) -> None:
    assert dmp.generate().duration == pytest.approx(2.0)
    np.testing.assert_allclose(dmp.center_, [0.3, 0.0, 0.2], atol=1e-5)


def test_several_noisy_periods_make_one() -> None:
    t = np.linspace(0.0, 6.3, 631)
    x = wiping(t) + 1e-3 * np.random.default_rng(0).standard_normal((631, 3))
    dmp = RhythmicDMP().fit(Trajectory(t, x), period=2.0)
    done = dmp.generate(4.0)
    assert np.abs(done.positions - wiping(done.times)).max() < 1e-3
    np.testing.assert_allclose(dmp.center_, [0.3, 0.0, 0.2], atol=2e-4)


def test_amplitude_center_and_period_can_be_changed(dmp: RhythmicDMP) -> None:
    plain = dmp.generate(dt=0.01)
    other = dmp.generate(4.0, dt=0.02, center=[1.0, 2.0, 3.0], amplitude=2.0, period=4.0)
    np.testing.assert_allclose(other.positions - [1.0, 2.0, 3.0], 2.0 * (plain.positions - dmp.center_), atol=1e-9)


def test_from_rest_elsewhere_it_swings_in(dmp: RhythmicDMP) -> None:
    done = dmp.generate(10.0, start=Pose(np.array([0.0, 0.3, 0.2]), WXYZ))
    np.testing.assert_allclose(done.positions[0], [0.0, 0.3, 0.2])
    np.testing.assert_allclose(done.positions[-200:], wiping(done.times)[-200:], atol=2e-4)


def test_steps_equal_the_whole_motion_and_coupling_pushes(dmp: RhythmicDMP) -> None:
    done = dmp.generate(3.0)
    state = dmp.begin()
    for k in range(300):
        np.testing.assert_allclose(state.position, done.positions[k], atol=1e-10)
        state = dmp.step(state, 0.01)
    held = dmp.begin()
    for _ in range(300):
        held = dmp.step(held, 0.01, coupling=lambda x, v: [0.0, 0.0, 1.0])
    np.testing.assert_allclose(held.position - state.position, [0.0, 0.0, 4.0 / dmp.gains_.stiffness], atol=1e-6)
    assert dmp.quaternion(state) is None


def test_velocity_is_the_derivative_of_position(dmp: RhythmicDMP) -> None:
    state = dmp.step(dmp.begin(), 0.3)
    later = dmp.step(state, 1e-5)
    np.testing.assert_allclose((later.position - state.position) / 1e-5, state.velocity, atol=1e-3)


def test_rotation_goes_round_with_the_position() -> None:
    t = np.linspace(0.0, 2.0, 201)
    q = quaternion_exp(0.5 * np.sin(np.pi * t)[:, None] * np.array([0.0, 0.6, 0.8]))
    dmp = RhythmicDMP().fit(Trajectory(t, wiping(t), q))
    done = dmp.generate()
    assert done.quaternions is not None
    away = quaternion_log(quaternion_multiply(done.quaternions, quaternion_conjugate(q)))
    assert np.abs(away).max() < 1e-3
    start = Pose(np.array([0.3, 0.0, 0.2]), quaternion_exp([0.0, 0.0, 0.4]))
    swung = dmp.generate(8.0, start=start)
    assert swung.quaternions is not None
    assert abs(swung.quaternions[0] @ start.quaternion) == pytest.approx(1.0)
    state = dmp.step(dmp.begin(start), 0.01)
    np.testing.assert_allclose(np.abs(dmp.quaternion(state) @ swung.quaternions[1]), 1.0, atol=1e-12)


def test_bad_input_is_named(dmp: RhythmicDMP) -> None:
    t = np.linspace(0.0, 2.0, 201)
    with pytest.raises(InputError, match=r"positions one period of 1\.3 s apart differ by"):
        RhythmicDMP().fit(Trajectory(t, wiping(t)), period=1.3)
    with pytest.raises(InputError, match="period must be a finite number above 0"):
        RhythmicDMP().fit(Trajectory(t, wiping(t)), period=5.0)
    with pytest.raises(InputError, match="120 degrees"):
        q = quaternion_exp(np.deg2rad(170.0) * np.sin(np.pi * t)[:, None] * np.array([0.0, 0.0, 1.0]))
        RhythmicDMP().fit(Trajectory(t, wiping(t), q))
    for bad in ({"dt": 0.0}, {"duration": -1.0}, {"period": 0.0}, {"amplitude": np.nan}, {"center": [1.0]}):
        with pytest.raises(InputError):
            dmp.generate(**bad)
    for options in ({"n_basis": 2}, {"regularisation": 0.0}):
        with pytest.raises(InputError):
            RhythmicDMP(**options)
    with pytest.raises(InputError, match="not fitted"):
        RhythmicDMP().generate()
