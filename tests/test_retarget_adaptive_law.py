import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.errors import InputError
from imitarm.retarget.baselines.adaptive_control import START_STIFFNESS, AdaptiveLaw, JointPlant

SAWYER, PANDA = ArmModel.load("sawyer", tool="gripper"), ArmModel.load("panda", tool="gripper")
T = 0.01


def tracked(arm, reference, steps, *, closure=0.0, q=None):
    """Joints, torques, law and plant of a controlled arm."""
    law, plant = AdaptiveLaw(arm, T), JointPlant(arm, T)
    plant.start(arm.home if q is None else q)
    joints, torques = [], []
    for k in range(steps):
        found = law.torques(plant.q, plant.velocity, reference(k * T), closure)
        plant.step(found.applied)
        joints.append(plant.q)
        torques.append(found.applied)
    return np.array(joints), np.array(torques), law, plant


@pytest.mark.parametrize("arm", [SAWYER, PANDA], ids=["sawyer", "panda"])
def test_a_slow_motion_is_tracked(arm):
    way = 0.3 * np.array([1, -1, 1, 1, -1, 1, 1]) * (arm.home != arm.upper)

    def reference(t):
        return arm.home + way * (0.5 - 0.5 * np.cos(np.pi * min(t / 3.0, 1.0)))

    joints, torques, _, _ = tracked(arm, reference, 400)
    wanted = np.array([reference(k * T) for k in range(400)])
    assert np.abs(joints - wanted).max() < 0.05
    assert np.abs(joints[-1] - wanted[-1]).max() < 0.02  # dry friction holds it a little off
    assert (np.abs(torques) <= arm.max_torque).all()


def test_standing_it_gives_the_torque_of_gravity():
    law = AdaptiveLaw(SAWYER, T)
    found = law.torques(SAWYER.home, np.zeros(7), SAWYER.home, 0.0)
    np.testing.assert_allclose(found.wanted, SAWYER.gravity_torque(SAWYER.home), atol=1e-9)


@settings(max_examples=15)
@given(st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7), st.booleans())
def test_after_any_jump_of_the_reference_it_is_bounded_and_comes_to_rest(jump, closed):
    """Whatever step it is given: torques within the rated ones, and no energy is left moving in the end."""
    goal = np.clip(SAWYER.home + np.array(jump), SAWYER.lower + 0.1, SAWYER.upper - 0.1)
    joints, torques, law, plant = tracked(SAWYER, lambda _: goal, 500, closure=float(closed))
    assert (np.abs(torques) <= SAWYER.max_torque).all()
    assert (np.abs(np.diff(joints, axis=0)) < 0.2).all()
    assert np.abs(plant.velocity).max() < 0.05
    assert np.abs(joints[-1] - goal).max() < 0.06
    assert (law.stiffness <= 2.0 * np.array(START_STIFFNESS) + 1e-9).all()
    assert (law.damping >= 0.0).all()


def test_a_closed_hand_makes_it_stiffer():
    goal = SAWYER.home + 0.1
    _, _, limp, _ = tracked(SAWYER, lambda _: goal, 50, closure=0.0)
    _, _, stiff, _ = tracked(SAWYER, lambda _: goal, 50, closure=1.0)
    np.testing.assert_allclose(stiff.stiffness, 2.0 * limp.stiffness, rtol=0.2)


def test_the_coriolis_matrix_is_that_of_christoffel():
    """C(q, v) v is the velocity torque; C(q, a) b = C(q, b) a; and dM/dt - 2 C takes no power."""
    rng, law = np.random.default_rng(0), AdaptiveLaw(SAWYER, T)
    for _ in range(20):
        q, v, w = SAWYER.home + 0.5 * rng.normal(size=7), rng.normal(size=7), rng.normal(size=7)
        q = np.clip(q, SAWYER.lower, SAWYER.upper)
        velocity_torque = SAWYER.inverse_dynamics(q, v, np.zeros(7)) - SAWYER.gravity_torque(q)
        np.testing.assert_allclose(law._coriolis(q, v, v), velocity_torque, atol=1e-9)
        np.testing.assert_allclose(law._coriolis(q, v, w), law._coriolis(q, w, v), atol=1e-9)
        h = 1e-5
        rate = (SAWYER.mass_matrix(q + h * v) - SAWYER.mass_matrix(q - h * v)) / (2.0 * h)
        assert w @ rate @ w - 2.0 * w @ law._coriolis(q, v, w) == pytest.approx(0.0, abs=1e-5)


def test_it_learns_a_load_that_the_model_does_not_know():
    """A constant torque on a joint: F takes over a part, so the joint hangs less than K alone lets it."""
    law, plant, load = AdaptiveLaw(SAWYER, T), JointPlant(SAWYER, T), np.array([0, 8.0, 0, 0, 0, 0, 0])
    for _ in range(400):
        plant.step(law.torques(plant.q, plant.velocity, SAWYER.home, 0.0).applied - load)
    sag = abs(plant.q[1] - SAWYER.home[1])
    assert law.force[1] < -0.5
    assert sag < 8.0 / law.stiffness[1]


def test_an_arm_of_six_joints_has_no_gains(tmp_path):
    links = '<body pos="0 0 0.1"><joint name="j{}" type="hinge" axis="0 1 0" range="-2 2"/><geom size="0.03" mass="1"/>'
    chain = "".join(links.format(i) for i in range(6)) + "</body>" * 6
    file = tmp_path / "six.xml"
    file.write_text(f'<mujoco model="six"><compiler angle="radian"/><worldbody>{chain}</worldbody></mujoco>')
    with pytest.raises(InputError, match="6 joints"):
        AdaptiveLaw(ArmModel.load(file), T)
