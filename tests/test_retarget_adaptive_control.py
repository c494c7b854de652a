import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.retarget import Correspondence
from imitarm.retarget.baselines.adaptive_control import CUT_OFF, START_STIFFNESS, AdaptiveControl
from shown_arm import EASY, LENGTHS, shown, swing

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
HAND = Correspondence(lengths=LENGTHS, orientation="fixed")
T = 0.01


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("joint", range(4))
def test_a_slow_motion_of_the_persons_joint_is_the_robots(arm, joint):
    by = 0.4
    run = AdaptiveControl(arm, HAND).run(shown(swing(joint, by), 7.0))
    sense = {3: -1.0}.get(joint, 1.0) if arm.name == "panda" else 1.0
    moved = run.joints[-1, :4] - arm.home[:4]
    np.testing.assert_allclose(moved, sense * by * np.eye(4)[joint], atol=0.02)
    assert run.notes["velocity_excess"] == 0.0


def test_its_reference_is_a_low_pass_of_first_order():
    """A jump of the person's joint reaches 1 - 1/e of itself after 1/(2 pi 3 Hz) = 53 ms."""
    method = AdaptiveControl(ARMS["sawyer"], HAND)
    method.start(ARMS["sawyer"].home)
    method._approach.active = False
    method._driven, method._joint_goal, method._held_goal = True, ARMS["sawyer"].home + 0.1, ARMS["sawyer"].home + 0.1
    shares = []
    for _ in range(20):
        method._driven_on()
        shares.append((method._reference - ARMS["sawyer"].home)[0] / 0.1)
    wanted = 1.0 - np.exp(-2.0 * np.pi * CUT_OFF * T * np.arange(1, 21))
    np.testing.assert_allclose(shares, wanted, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_torques_stay_within_the_rated_ones_and_are_counted(arm):
    frames, method = shown(swing(1, -0.9, over=0.5), 4.0), AdaptiveControl(arm, HAND)
    q, torques = arm.home, []
    for k in range(400):
        q = method.step(frames[k * 3 // 10] if k % 3 == 0 and k * 3 // 10 < len(frames) else None, q)
        torques.append(method.torque)
    torques = np.array(torques)
    assert (np.abs(torques) <= arm.max_torque).all()
    assert method.notes["saturated"] > 0.0
    assert method.notes["peak_torque"] > 1.0
    assert 1.0 < method.notes["rms_torque"] < arm.max_torque.max()


def test_a_fist_makes_the_joints_stiff():
    stiffness = {}
    for closed in (False, True):
        method = AdaptiveControl(ARMS["sawyer"], HAND)
        method.run(shown(swing(0, 0.2), 4.0, closed=closed))
        stiffness[closed] = method._law.stiffness
    np.testing.assert_allclose(stiffness[True], 2.0 * stiffness[False], rtol=0.1)
    assert (stiffness[False] <= np.array(START_STIFFNESS) + 1e-9).all()


def test_the_tool_is_not_where_the_hand_is():
    """It controls joints: the links have other lengths, and the elbow is above instead of below."""
    arm = ARMS["sawyer"]
    run = AdaptiveControl(arm, HAND).run(shown(swing(3, 0.4), 7.0))
    tool, _ = arm.tool_path(run.joints)
    assert np.linalg.norm(tool[-1] - run.targets[0][-1]) > 0.05


def test_absolute_it_goes_to_the_persons_own_angles_at_limited_speed():
    arm = ARMS["sawyer"]
    correspondence = Correspondence(lengths=LENGTHS)
    run = AdaptiveControl(arm, correspondence, relative=False).run(shown(lambda _: EASY, 8.0))
    np.testing.assert_allclose(run.joints[-1, :4], EASY[:4], atol=0.03)
    angle = arm.tool_pose(run.joints[-1]).error_to(arm.tool_pose(EASY))[3:]  # the wrist has two ways to be turned so
    assert np.linalg.norm(angle) < 0.05
    assert (np.abs(run.velocities) <= arm.max_velocity).all()
