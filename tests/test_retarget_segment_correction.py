import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.kinematics.sew import sew_angle
from imitarm.retarget.arm_estimator import ArmEstimator
from imitarm.retarget.baselines.demonstrated_motion import DemonstratedMotion, FeasibilityCheck, blend, segments
from imitarm.retarget.baselines.demonstration_modification import elbow_rotated, pull, pulled_in, repaired, slowed
from imitarm.retarget.baselines.joint_mapping import JointMapping
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.human_arm import human_arm_pose
from shown_arm import EASY, LENGTHS, shown, swing

SAWYER = ArmModel.load("sawyer", tool="gripper")
F = FeasibilityCheck(SAWYER, 0.01)
ANGLES = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7)


def motion_of(joints):
    """A motion with these joints (n, 7); the person's part of it stands."""
    n = len(joints)
    points = np.tile(arm_points(EASY), (n, 1, 1))
    return DemonstratedMotion(0.01 * np.arange(n), points, np.tile([1.0, 0, 0, 0], (n, 1)), points, (None,) * n, joints)


def arm_points(angles):
    elbow, wrist, _ = human_arm_pose(angles, LENGTHS)
    return np.array([np.zeros(3), elbow, wrist])


def bones(points):
    return np.linalg.norm(np.diff(points, axis=-2), axis=-1)


def quick(by=0.6, over=20):
    """The first joint turns within ``over`` samples, too fast, in the middle of 200."""
    u = np.clip((np.arange(200) - 90) / over, 0.0, 1.0)
    return SAWYER.home + np.outer(by * u * u * (3.0 - 2.0 * u), [1, 0, 0, 0, 0, 0, 0])


def test_slower_clears_a_motion_that_is_too_fast_and_keeps_its_path():
    motion = motion_of(quick())
    found = F.anywhere(motion.joints)
    ((first, past),) = segments(found, 0.01)
    factor = F.speeds(motion.joints).max() / 0.9
    assert factor > 1.5
    slow, end = slowed(motion, first, past, blend(found, first, past, 0.01), factor)
    assert F.clear(slow.joints)
    assert F.speeds(slow.joints).max() == pytest.approx(0.9, abs=0.06)
    assert len(slow) > len(motion)
    np.testing.assert_allclose(slow.joints[[0, -1]], motion.joints[[0, -1]], atol=1e-12)
    assert (np.diff(slow.joints[:, 0]) >= -1e-12).all()
    np.testing.assert_allclose(slow.joints[:first], motion.joints[:first], atol=1e-9)
    np.testing.assert_allclose(slow.joints[end:], motion.joints[-len(slow.joints[end:]) :], atol=0.01)
    assert (np.diff(slow.shown_times) > 0.0).all()
    assert np.diff(slow.shown_times).min() < 0.01 / 1.5


@given(ANGLES, st.floats(0.5, 1.0))
def test_pulled_in_the_wrist_is_nearer_and_the_bones_keep_their_lengths(by, kappa):
    points = arm_points(EASY + np.array(by))
    (near,) = pulled_in(points[None], np.array([kappa]))
    np.testing.assert_allclose(bones(near), bones(points), atol=1e-9)
    least = abs(LENGTHS.upper_arm - LENGTHS.forearm)
    wanted = np.clip(kappa * np.linalg.norm(points[2]), least, LENGTHS.reach)
    assert np.linalg.norm(near[2]) == pytest.approx(wanted, abs=1e-9)
    np.testing.assert_allclose(np.cross(near[2], points[2]), 0.0, atol=1e-9)  # on the line to the shoulder
    assert near[1] @ np.cross(points[2], points[1]) == pytest.approx(0.0, abs=1e-9)  # in the same plane


def test_a_straight_arm_that_is_pulled_in_bends_its_elbow_down():
    straight = np.array([[0.0, 0, 0], [LENGTHS.upper_arm, 0, 0], [LENGTHS.reach, 0, 0]])
    (near,) = pulled_in(straight[None], np.array([0.9]))
    assert near[1, 2] < -0.05
    np.testing.assert_allclose(bones(near), bones(straight), atol=1e-9)


def test_pulling_in_clears_a_stretched_arm():
    mapping, correspondence = JointMapping(SAWYER, relative=False), Correspondence(lengths=LENGTHS, orientation="fixed")
    mapping.start(EASY)
    estimator = ArmEstimator(correspondence, smoothing=False)
    frames = shown(swing(3, 0.1 - EASY[3], over=2.0), 3.2)
    estimates = [estimator.update(frame) for frame in frames]
    clutch = correspondence.engage(estimates[0].wrist, estimates[0].hand, SAWYER.tool_pose(SAWYER.home))
    motion = DemonstratedMotion.through(estimates, 0.01)
    joints = np.array([mapping.joints(e, clutch) for e in motion.estimates()])
    assert F.reasons(joints)["stretched"].any()
    kappa = pull(motion.points, joints)
    np.testing.assert_allclose(kappa[joints[:, 3] > 0.46], 1.0)
    reach = np.linalg.norm(motion.points[:, 2] - motion.points[:, 0], axis=1) / LENGTHS.reach
    np.testing.assert_allclose((kappa * reach)[joints[:, 3] < 0.44], 0.975, atol=2e-3)  # 0.78 of 0.80
    points = pulled_in(motion.points, kappa)
    mapping.resume(joints[0])
    changed = DemonstratedMotion(motion.shown_times, points, motion.hands, motion.shown, motion.closed, joints)
    pulled = np.array([mapping.joints(e, clutch) for e in changed.estimates()])
    assert not F.reasons(pulled)["stretched"].any()


@given(ANGLES, st.floats(-1.0, 1.0))
def test_a_turned_elbow_turns_by_that_angle_and_the_wrist_stays(by, angle):
    points = arm_points(EASY + np.array(by))
    (turned,) = elbow_rotated(points[None], np.array([angle]))
    np.testing.assert_array_equal(turned[[0, 2]], points[[0, 2]])
    np.testing.assert_allclose(bones(turned), bones(points), atol=1e-9)
    change = sew_angle(*turned) - sew_angle(*points)
    assert abs(np.angle(np.exp(1j * (change - angle)))) < 1e-6


def test_a_repair_leaves_no_posture_that_is_infeasible_at_its_key_frames():
    """A joint swings out beyond its limit: samples about it are not."""
    u = np.sin(np.pi * np.arange(900) / 899)
    joints = SAWYER.home + np.outer(u, [SAWYER.upper[0] + 0.1 - SAWYER.home[0], 0, 0, 0, 0, 0, 0])
    found = F.anywhere(joints)
    ((first, past),) = segments(found, 0.01)
    mended, missed = repaired(joints, first, past, F, np.random.default_rng(0))
    assert missed == 0
    keys = np.unique(np.linspace(first, past - 1, 7).round().astype(int))[1:-1]
    assert len(keys) == 5
    assert all(F.allows(mended[k]) for k in keys)
    np.testing.assert_array_equal(mended[:first], joints[:first])
    np.testing.assert_array_equal(mended[past:], joints[past:])
    steps = np.abs(np.diff(mended, axis=0)).max(axis=1)
    assert steps[[first - 1, past - 1]].max() < 0.02  # it goes in and out without a jump


def test_where_no_sample_will_do_the_key_frame_is_put_back_into_the_limits_and_counted():
    nowhere = FeasibilityCheck(SAWYER, 0.01, {"never": lambda p, r: np.zeros(len(p), dtype=bool)})
    joints = np.tile(SAWYER.upper + 0.5, (100, 1))
    mended, missed = repaired(joints, 0, 100, nowhere, np.random.default_rng(0))
    assert missed == 7  # five, and both ends, which may move as well
    assert (mended <= SAWYER.upper + 1e-9).all()


def test_the_same_seed_draws_the_same_repair():
    joints = np.tile(np.where(np.arange(7) == 0, SAWYER.upper + 0.05, SAWYER.home), (100, 1))
    first, second, other = (repaired(joints, 20, 80, F, np.random.default_rng(seed))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 1e-3
