import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imitarm.kinematics.pose import matrix_to_quaternion, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.baselines.thesis import HumanArmTracker, roll_pitch_yaw
from imitarm.retarget.human_arm import human_arm_pose
from imitarm.retarget.limbs import LimbLengths

LENGTHS = LimbLengths(0.30, 0.26)
SHOULDER = np.array([0.1, -0.2, 0.4])
TIMES = np.arange(0.0, 4.0, 1.0 / 30.0)


def posture(t: float) -> np.ndarray:
    """A person's angles, well off the singularities."""
    wave = np.sin(np.array([1.0, 1.3, 0.8, 1.1, 0.9, 1.2, 1.4]) * t + np.arange(7))
    return np.array([0.2, -0.3, 0.1, 1.2, 0.0, 0.9, 0.0]) + 0.35 * wave


def estimate(t: float, q: np.ndarray) -> ArmEstimate:
    elbow, wrist, hand = human_arm_pose(q, LENGTHS)
    return ArmEstimate(
        t,
        SHOULDER,
        SHOULDER + elbow,
        SHOULDER + wrist,
        np.zeros(3),
        matrix_to_quaternion(hand),
        np.zeros(3),
        (1.0, 1.0, 1.0),
        None,
    )


def follow(**options) -> tuple[np.ndarray, np.ndarray]:
    """Follow the motion; return the errors of the wrist [m] and of the hand [rad]."""
    tracker = HumanArmTracker(**options)
    errors = []
    for t in TIMES:
        wanted = estimate(t, posture(t))
        wrist, hand = tracker.follow(wanted, LENGTHS)
        turn = quaternion_log(quaternion_multiply(wanted.hand, quaternion_conjugate(hand)))
        errors.append((np.linalg.norm(wanted.wrist - wrist), np.linalg.norm(turn)))
    return tuple(np.array(errors).T)


def test_three_increments_a_frame_follow_exactly_and_one_nearly():
    wrist, hand = follow()
    assert wrist.max() < 1e-5
    assert hand.max() < 1e-5
    wrist, hand = follow(iterations=1)
    assert 1e-6 < wrist.max() < 2e-3  # one step of first order: an error of second order stays
    assert hand.max() < 2e-2


def test_the_print_of_one_step_is_that():
    np.testing.assert_array_equal(follow(faults=("step",))[0], follow(iterations=1)[0])


def test_with_the_printed_sign_the_angles_run_away():
    wrist, _ = follow(faults=("error",))
    assert np.median(wrist[len(wrist) // 2 :]) > 0.1


def test_reflected_limbs_put_the_arm_elsewhere():
    assert np.median(follow(faults=("limbs",))[0]) > 0.1


def test_a_forward_kinematics_that_is_no_rotation_is_not_followed():
    wrist, hand = follow(faults=("dh",))
    assert np.median(wrist) > 0.02 or np.median(hand) > 0.2
    assert np.isfinite(wrist).all()


def test_differences_of_roll_pitch_and_yaw_are_no_rotation_vector():
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(200):
        a, turn = Rotation.random(random_state=rng), Rotation.from_rotvec(rng.normal(0.0, 0.05, 3))
        b = turn * a
        worst = max(
            worst, np.abs(roll_pitch_yaw(b.as_matrix()) - roll_pitch_yaw(a.as_matrix()) - turn.as_rotvec()).max()
        )
    assert worst > 3.0  # a small turn, and the difference is half a turn or more
    some = Rotation.from_euler("ZYX", [0.3, -0.2, 0.9])
    np.testing.assert_allclose(roll_pitch_yaw(some.as_matrix()), [0.9, -0.2, 0.3])
    exact, printed = follow(iterations=1), follow(iterations=1, faults=("rpy",))
    assert np.sqrt(np.mean(printed[1] ** 2)) > 2.0 * np.sqrt(np.mean(exact[1] ** 2))


def test_a_stretched_arm_is_followed_without_a_jump():
    tracker, before = HumanArmTracker(), None
    for t in TIMES:
        q = posture(0.0)
        q[3] = 0.6 * abs(np.cos(t))  # to the stretch and back, twice
        wanted = estimate(t, q)
        wrist, _ = tracker.follow(wanted, LENGTHS)
        assert np.linalg.norm(wrist - wanted.wrist) < 0.01
        assert before is None or np.linalg.norm(wrist - before) < 0.03
        before = wrist


def test_after_a_gap_it_begins_anew():
    tracker = HumanArmTracker(iterations=1)
    tracker.follow(estimate(0.0, posture(0.0)), LENGTHS)
    far = estimate(1.0, posture(3.0))
    wrist, _ = tracker.follow(far, LENGTHS)
    np.testing.assert_allclose(wrist, far.wrist, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_the_angles_stay_numbers(seed):
    rng = np.random.default_rng(seed)
    for faults in ((), ("limbs", "dh", "error", "rpy", "step")):
        tracker = HumanArmTracker(faults=faults)
        for k in range(60):
            wild = estimate(k / 30.0, rng.uniform(-3.0, 3.0, 7))
            wrist, hand = tracker.follow(wild, LENGTHS)
            assert np.isfinite(wrist).all()
            assert np.linalg.norm(hand) == pytest.approx(1.0)
            assert np.abs(tracker.angles).max() <= np.pi
