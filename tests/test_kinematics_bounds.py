from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.bounds import clearance_rows, velocity_box

ARMS = {name: ArmModel.load(name) for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
DT = 0.01
seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None, max_examples=30)
@given(seeds, st.sampled_from([0.001, 0.01, 0.05]), st.sampled_from(list(ARMS)))
def test_the_box_is_never_empty_and_its_worst_corner_can_still_stop(seed, dt, name):
    """METHODS A.9: walk on the box's own corners; no limit of position, velocity or acceleration is ever passed."""
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


def test_a_moving_obstacle_pushes_its_rows():
    jacobians = np.zeros((1, 3, 7))
    still = clearance_rows(jacobians, np.array([[1.0, 0, 0]]), np.array([0.1]), clearance=0.02, gain=5.0)
    coming = clearance_rows(
        jacobians, np.array([[1.0, 0, 0]]), np.array([0.1]), clearance=0.02, gain=5.0, obstacle_velocity=[0.3, 0, 0]
    )
    assert still[1] == pytest.approx([-0.4])
    assert coming[1] == pytest.approx([-0.1])
