from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.robots.simulated import COMPUTED_FREQUENCY, FINGER_SPEED, Drives, add_drives


def drives_of(arm, timestep=0.002):
    spec = arm.spec()
    add_drives(spec, arm)
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data = mujoco.MjData(model)
    drives = Drives(model, data, arm)
    mujoco.mj_resetData(model, data)
    data.qpos[:] = arm.posture(model)
    mujoco.mj_forward(model, data)
    drives.hold()
    return model, data, drives


@pytest.fixture
def sawyer():
    arm = ArmModel.load("sawyer", tool="brush")
    return arm, *drives_of(arm)


def test_every_joint_has_one_drive_with_its_rated_torque():
    arm = ArmModel.load("sawyer")
    spec = arm.spec()
    spec.add_actuator(name="old", target=arm.joint_names[2], trntype=mujoco.mjtTrn.mjTRN_JOINT)
    add_drives(spec, arm)
    model = spec.compile()
    assert [model.actuator(i).name for i in range(model.nu)] == [f"drive/{name}" for name in arm.joint_names]
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], arm.max_torque)


def test_holding_takes_the_torque_of_gravity(sawyer):
    arm, _, _, drives = sawyer
    np.testing.assert_allclose(drives.torque, arm.gravity_torque(arm.home), atol=1e-6)
    np.testing.assert_allclose(drives.q, arm.home, atol=1e-12)


def test_servos_bring_an_arm_to_its_set_point(sawyer):
    arm, _, _, drives = sawyer
    target = arm.home + 0.02 * np.array([1, -1, 1, -1, 1, -1, 1])
    for _ in range(300):
        drives.servo(target, np.zeros(7), np.zeros(7))
    np.testing.assert_allclose(drives.q, target, atol=2e-4)


def test_computed_torque_decays_as_its_error_dynamics_say():
    """Without friction all joints follow e'' + 2 w e' + w^2 e = 0, whatever the inertias."""
    arm = ArmModel.load("sawyer")
    model, data, drives = drives_of(arm, timestep=0.0002)
    model.dof_frictionloss[:] = 0.0
    model.dof_damping[:] = 0.0
    offset = 0.005 * np.array([1, -1, 1, -1, 1, -1, 1])
    n = 250  # 0.05 s
    for _ in range(n):
        drives.computed_torque(arm.home + offset, np.zeros(7), np.zeros(7))
    wt = COMPUTED_FREQUENCY * n * model.opt.timestep
    left = (arm.home + offset - drives.q) / offset
    np.testing.assert_allclose(left, (1.0 + wt) * np.exp(-wt), atol=0.02)
    assert data.time == pytest.approx(0.05)


@pytest.mark.parametrize("kind", ["servo", "computed_torque"])
def test_both_follow_an_accelerated_motion(sawyer, kind):
    arm, model, _, drives = sawyer
    step, h = getattr(drives, kind), model.opt.timestep
    acceleration = np.array([0.5, -0.4, 0.5, 0.6, -1.0, 1.0, 1.0])
    for k in range(250):
        t = k * h
        step(arm.home + 0.5 * acceleration * t * t, acceleration * t, acceleration)
    t = 250 * h
    np.testing.assert_allclose(drives.q, arm.home + 0.5 * acceleration * t * t, atol=1e-3)
    np.testing.assert_allclose(drives.velocity, acceleration * t, atol=0.01)


@pytest.mark.parametrize("kind", ["servo", "computed_torque"])
def test_torque_is_cut_off_at_the_rated_one(sawyer, kind):
    arm, _, _, drives = sawyer
    getattr(drives, kind)(arm.home + 1.0, np.zeros(7), np.zeros(7))
    assert np.all(np.abs(drives.torque) <= arm.max_torque + 1e-9)
    assert np.sum(np.abs(drives.torque) > 0.99 * arm.max_torque) >= 3


def test_a_free_arm_stays_and_goes_where_it_is_pulled(sawyer):
    arm, _, data, drives = sawyer
    tool = data.site("tool").id
    for _ in range(250):
        drives.free(np.zeros(3), np.zeros(3), tool)
    start = data.site_xpos[tool].copy()
    np.testing.assert_allclose(drives.q, arm.home, atol=1e-3)
    for _ in range(250):
        drives.free(np.array([0.0, 0.0, 20.0]), np.zeros(3), tool)
    way = data.site_xpos[tool] - start
    assert way[2] > 0.02
    assert np.abs(way[:2]).max() < way[2]
    assert not data.qfrc_applied.any()


def test_a_gripper_keeps_its_opening():
    arm = ArmModel.load("panda", tool="gripper")
    _, data, drives = drives_of(arm)
    opening = data.actuator("tool/opening")
    before = float(opening.length[0])
    for _ in range(100):
        drives.servo(arm.home, np.zeros(7), np.zeros(7))
    assert opening.length[0] == pytest.approx(before, abs=1e-3)
    assert before > 0.01


def test_fingers_go_to_the_opening_that_is_asked_at_their_speed():
    arm = ArmModel.load("sawyer", tool="gripper")
    _, data, drives = drives_of(arm)
    drives.grasp(0.08)
    openings = []
    for _ in range(500):
        drives.servo(arm.home, np.zeros(7), np.zeros(7))
    drives.grasp(0.02)
    for _ in range(500):
        drives.servo(arm.home, np.zeros(7), np.zeros(7))
        openings.append(drives.opening)
    assert openings[-1] == pytest.approx(0.02, abs=1e-3)
    speed = -np.diff(openings) / 0.002
    assert speed.max() < 1.3 * FINGER_SPEED
    half = np.argmax(np.array(openings) < 0.05) * 0.002
    assert half == pytest.approx(0.03 / FINGER_SPEED, rel=0.15)
    assert np.abs(data.actuator("tool/opening").force[0]) <= 70.0


def test_a_hand_without_fingers_says_so(sawyer):
    _, _, _, drives = sawyer
    assert np.isnan(drives.opening)
    with pytest.raises(InputError, match="no gripper"):
        drives.grasp(0.02)
