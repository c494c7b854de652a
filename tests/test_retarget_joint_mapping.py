import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.errors import InputError
from imitarm.retarget.arm_estimator import ArmEstimator
from imitarm.retarget.baselines.joint_mapping import Approach, JointMapping, continued
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.human_arm import human_arm_pose
from imitarm.retarget.limbs import LimbLengths
from imitarm.tasks.stacking_operator import SimulatedOperator
from shown_arm import EASY, LENGTHS, skeleton

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}


def mapped(arm, path, *, relative, orientation="hand", q=None):
    """Joints for a path of the person's angles (n, 7)."""
    correspondence = Correspondence(lengths=LENGTHS, orientation=orientation)
    estimator = ArmEstimator(correspondence, smoothing=False)
    mapping, clutch, out = JointMapping(arm, relative=relative), None, []
    mapping.start(arm.home if q is None else q)
    for k, angles in enumerate(path):
        estimate = estimator.update(skeleton(k / 30, angles))
        clutch = clutch or correspondence.engage(estimate.wrist, estimate.hand, arm.tool_pose(arm.home))
        out.append(mapping.joints(estimate, clutch))
    return np.array(out), clutch, estimate


def path(end, n=40):
    share = np.linspace(0.0, 1.0, n)[:, None]
    return EASY + share * (np.asarray(end) - EASY)


def test_sawyer_has_the_axes_of_a_person_at_zero_and_the_panda_with_its_second_joint_at_a_right_angle():
    sawyer, panda = (JointMapping(arm, relative=True) for arm in ARMS.values())
    np.testing.assert_array_equal(sawyer.zero, np.zeros(7))
    np.testing.assert_array_equal(sawyer.sense, np.ones(7))
    np.testing.assert_allclose(panda.zero, [0, np.pi / 2, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(panda.sense, [1, 1, 1, -1, 1, -1, -1])


def test_a_sawyer_takes_over_the_persons_angles_as_they_are():
    wanted = path(EASY + [0.4, -0.5, -0.3, 0.4, 0.5, 0.2, -0.6])
    q, _, _ = mapped(ARMS["sawyer"], wanted, relative=False, q=EASY)
    np.testing.assert_allclose(q, wanted, atol=1e-6)


@given(st.lists(st.floats(-0.6, 0.6), min_size=7, max_size=7))
def test_absolute_links_and_tool_have_the_directions_of_the_persons(by):
    """Whatever the arm: upper arm, forearm and tool are turned as shoulder, elbow and hand of the person are."""
    wanted = path(EASY + np.array(by) * [1, 1, 1, 1, 1, 0.5, 1], 12)
    _, _, hand = human_arm_pose(wanted[-1], LENGTHS)
    for arm in ARMS.values():
        q, _, _ = mapped(arm, wanted, relative=False)
        zero = arm.tool_pose(JointMapping(arm, relative=False).zero).rotation
        np.testing.assert_allclose(arm.tool_pose(q[-1]).rotation @ zero.T, hand, atol=1e-4)
        sense, axes = JointMapping(arm, relative=False).sense, arm.jacobian(q[-1])[3:]
        upper, fore, _ = rotations(wanted[-1])
        np.testing.assert_allclose(sense[2] * axes[:, 2], upper[:, 0], atol=1e-4)  # rolls about the upper arm
        np.testing.assert_allclose(sense[4] * axes[:, 4], fore[:, 0], atol=1e-4)  # rolls about the forearm


def rotations(angles):
    """Rotations of upper arm, forearm and hand."""
    upper = human_arm_pose(np.concatenate([angles[:3], np.zeros(4)]), LENGTHS)[2]
    fore = human_arm_pose(np.concatenate([angles[:5], np.zeros(2)]), LENGTHS)[2]
    return upper, fore, human_arm_pose(angles, LENGTHS)[2]


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("orientation", ["hand", "fixed", "upright"])
def test_relative_it_begins_where_the_robot_is_and_the_tool_turns_as_the_correspondence_says(arm, orientation):
    by = np.array([0.3, -0.2, 0.2, 0.2, 0.1, 0.2, 0.3])
    q, clutch, estimate = mapped(arm, path(EASY + by), relative=True, orientation=orientation)
    np.testing.assert_allclose(q[0], arm.home, atol=2e-5)
    sense = JointMapping(arm, relative=True).sense[:4]
    np.testing.assert_allclose(q[-1, :4] - arm.home[:4], sense * by[:4], atol=1e-6)
    wanted = clutch.target(estimate.wrist, estimate.hand).rotation
    np.testing.assert_allclose(arm.tool_pose(q[-1]).rotation, wanted, atol=2e-5)


@pytest.mark.parametrize("relative", [True, False])
def test_angles_go_on_through_half_a_turn(relative):
    """Elbow below the shoulder: the upper arm's roll passes pi as the elbow swings inwards."""
    wanted = path(EASY + [0.0, 0.0, 1.3, 0.0, 0.0, 0.0, 0.0], 60)
    assert wanted[-1, 2] > np.pi
    q, _, _ = mapped(ARMS["sawyer"], wanted, relative=relative, orientation="fixed", q=None if relative else EASY)
    assert np.abs(np.diff(q[:, :4], axis=0)).max() < 0.05
    assert q[-1, 2] - q[0, 2] == pytest.approx(1.3, abs=1e-6)


def test_what_can_not_be_seen_is_held():
    """A straight arm does not tell its roll: it stays as it was, and the tool is turned right all the same."""
    straight = EASY.copy()
    straight[3] = 0.0
    q, _, _ = mapped(ARMS["sawyer"], path(straight, 60), relative=False, q=EASY)
    assert abs(q[-1, 2] - EASY[2]) < 1e-6
    assert np.abs(np.diff(q, axis=0)).max() < 0.15


def test_a_part_mapped_anew_is_the_same():
    arm, correspondence = ARMS["sawyer"], Correspondence(lengths=LENGTHS, orientation="fixed")
    estimator, mapping = ArmEstimator(correspondence, smoothing=False), JointMapping(arm, relative=True)
    estimates = [estimator.update(skeleton(k / 30, a)) for k, a in enumerate(path(EASY + 0.3))]
    clutch = correspondence.engage(estimates[0].wrist, estimates[0].hand, arm.tool_pose(arm.home))
    once = [mapping.joints(e, clutch) for e in estimates]
    mapping.resume(once[19])
    np.testing.assert_allclose([mapping.joints(e, clutch) for e in estimates[20:]], once[20:], atol=1e-9)


def test_absolute_a_person_who_stacks_cubes_would_put_the_sawyers_elbow_into_the_table():
    """Why the default is relative: a person's elbow hangs, and the table is 0.32 m below the Sawyer's shoulder."""
    arm = ARMS["sawyer"]
    for seed in range(10):
        operator = SimulatedOperator(seed)
        lengths = LimbLengths(operator.person.upper_arm, operator.person.forearm)
        correspondence = Correspondence(lengths=lengths, orientation="fixed")
        estimate = ArmEstimator(correspondence, smoothing=False).update(operator.act(0.0))
        clutch = correspondence.engage(estimate.wrist, estimate.hand, arm.tool_pose(arm.home))
        absolute, relative = (JointMapping(arm, relative=kind).joints(estimate, clutch) for kind in (False, True))
        for q, free in ((absolute, False), (relative, True)):
            centers, radii = arm.collision_spheres(q)
            low = (centers[:, 2] - radii)[centers[:, 0] > 0.3].min()  # where the table is
            assert bool(low > 0.0) is free


def test_an_approach_is_slow_then_gone():
    arm = ARMS["sawyer"]
    approach, q, steps = Approach(arm, 0.01, 0.5), arm.home, 0
    while approach.active:
        before, q = q, approach.towards(q, EASY)
        assert (np.abs(q - before) <= 0.5 * 0.01 * arm.max_velocity + 1e-12).all()
        steps += 1
    np.testing.assert_array_equal(q, EASY)
    assert steps > 300
    np.testing.assert_array_equal(approach.towards(q, q + 1.0), q + 1.0)  # then it goes along


@given(st.floats(-20.0, 20.0), st.floats(-3.0, 3.0))
def test_continued_is_the_nearest_of_all_whole_turns(angle, before):
    (near,) = continued(np.array([angle]), np.array([before]))
    assert abs(near - before) <= np.pi + 1e-9
    assert abs(np.sin(near - angle)) < 1e-6
    assert np.cos(near - angle) > 0.0


def test_an_arm_without_a_persons_axes_is_refused_by_name(tmp_path):
    links = '<body pos="0 0 0.1"><joint name="j{}" type="hinge" axis="0 1 0" range="-2 2"/><geom size="0.03" mass="1"/>'
    chain = "".join(links.format(i) for i in range(7)) + "</body>" * 7
    file = tmp_path / "snake.xml"
    file.write_text(f'<mujoco model="snake"><compiler angle="radian"/><worldbody>{chain}</worldbody></mujoco>')
    with pytest.raises(InputError, match="modern, thesis, m3"):
        JointMapping(ArmModel.load(file), relative=True)
