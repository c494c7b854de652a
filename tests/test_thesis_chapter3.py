"""What docs/thesis_map.md says of Chapter 3's equations, figures and claims, computed from what is printed there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import spearmanr, t

from imitarm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH
from imitarm.retarget.human_arm import human_arm_pose
from imitarm.retarget.limbs import LimbLengths, correct_limbs

SAWYER = ArmModel.load("sawyer")
WEIGHTS = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])

# Table 3.1, experiments 1 to 10 in rows: path length ("cm.10"), mean torques of seven joints [N m], time [s]
TABLE_3_1 = np.array(
    [
        [7.03, 13.035, 13.58, 23.45, 18.42, 11.03, 20.45, 28.08, 22.23],
        [7.43, 22.52, 19.86, 22.33, 17.03, 10.23, 23.52, 41.8, 18.43],
        [9.04, 32.39, 13.87, 18.88, 19.09, 10.99, 26.08, 21.14, 17.72],
        [9.26, 16.985, 15.21, 16.35, 22.97, 12.57, 29.83, 33.44, 19.2],
        [8.72, 9.085, 14.33, 8.93, 24.31, 12.93, 26.56, 21.14, 15.82],
        [9.53, 12.28, 17.33, 20.93, 20.23, 13.39, 20.48, 20.35, 14.21],
        [6.4, 25.83, 18.22, 17.58, 20.23, 19.34, 14.16, 25.31, 13.03],
        [8.36, 16.99, 14.33, 18.43, 21.43, 18.23, 22.08, 30.94, 9.01],
        [9.32, 18.14, 15.8, 17.8, 22.12, 11.53, 13.44, 29.01, 9.31],
        [10.24, 27.44, 12.3, 24.6, 24.08, 14.43, 17.12, 30.1, 12.42],
    ]
)
PATH, TORQUES, TIMES = TABLE_3_1[:, 0], TABLE_3_1[:, 1:8], TABLE_3_1[:, 8]


def least_singular_value(q: np.ndarray) -> float:
    return float(np.linalg.svd(WEIGHTS[:, None] * SAWYER.jacobian(q), compute_uv=False)[-1])


def postures(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(SAWYER.lower, SAWYER.upper, (n, SAWYER.n_joints))


def test_equations_3_1_to_3_4_as_printed_mirror_the_upper_arm_and_break_the_chain() -> None:
    lengths = LimbLengths(0.30, 0.26)
    shoulder, elbow, wrist = np.zeros(3), np.array([0.32, 0.0, 0.0]), np.array([0.32, 0.24, 0.0])
    right_elbow, right_wrist = correct_limbs(shoulder, elbow, wrist, lengths)
    np.testing.assert_allclose([right_elbow, right_wrist], [[0.30, 0.0, 0.0], [0.30, 0.26, 0.0]])
    printed_elbow, printed_wrist = correct_limbs(shoulder, elbow, wrist, lengths, as_printed=True)
    np.testing.assert_allclose(printed_elbow, [-0.30, 0.0, 0.0])  # behind the shoulder
    assert np.linalg.norm(printed_wrist - printed_elbow) > 0.6  # of a forearm of 0.26
    np.testing.assert_allclose(printed_wrist, [0.32, -0.26, 0.0])  # from the raw elbow, the other way


def test_shoulder_elbow_and_wrist_do_not_tell_how_the_hand_is_turned() -> None:
    lengths = LimbLengths(0.30, 0.26)
    q = np.array([0.3, -0.2, 0.4, 1.1, 0.0, 0.0, 0.0])
    elbow, wrist, hand = human_arm_pose(q, lengths)
    other_elbow, other_wrist, other_hand = human_arm_pose(q + [0, 0, 0, 0, 1.2, 0.7, -0.5], lengths)
    np.testing.assert_allclose([elbow, wrist], [other_elbow, other_wrist])
    assert np.arccos((np.trace(hand.T @ other_hand) - 1.0) / 2.0) > 0.9


def test_the_printed_product_is_no_change_of_base() -> None:
    """P_R = P_HA R_HR moves the hand by a fixed amount in its own axes; a change of base multiplies on the left."""
    base = np.eye(4)
    base[:3, :3] = [[0, 0, -1], [-1, 0, 0], [0, 1, 0]]
    base[:3, 3] = [1.0, 0.2, 0.5]
    first, second = np.eye(4), np.eye(4)
    second[:3, 3] = [0.0, 0.1, 0.0]  # the hand rises by 10 cm in the sensor's frame
    np.testing.assert_allclose(((base @ second) - (base @ first))[:3, 3], [0.0, 0.0, 0.1])
    np.testing.assert_allclose(((second @ base) - (first @ base))[:3, 3], [0.0, 0.1, 0.0])  # sideways


@pytest.mark.parametrize(("branch", "broken"), [("right", False), ("middle everywhere", True)])
def test_equation_3_9_needs_the_lower_bound_of_its_middle_branch(branch: str, broken: bool) -> None:
    """As printed, the condition of the middle case is always true; used below d/2 it does not keep the speed."""
    d, worst = 1.0, 0.0
    values = np.linspace(1e-4, 2.0, 400)
    for least in values:
        middle = max(least * (d - least), 0.0)
        damping = 0.25 * d * d if branch == "right" and least < 0.5 * d else middle
        other = values[values >= least]
        worst = max(worst, float((other / (other**2 + damping)).max()) * d)
    assert (worst > 1.0 + 1e-9) is broken
    assert not broken or worst > 1.9


def test_equation_3_9_bounds_the_norm_and_not_each_joint() -> None:
    """With 3 rad/s as the largest norm, as a reader of the thesis may choose, single joints of Sawyer are too fast."""
    rng, most, broken = np.random.default_rng(1), 3.0, 0
    for q in postures(500):
        jacobian = WEIGHTS[:, None] * SAWYER.jacobian(q)
        error = rng.normal(size=6)
        error *= 0.6 / np.linalg.norm(error)
        least, d = np.linalg.svd(jacobian, compute_uv=False)[-1], 0.6 / most
        damping = 0.0 if least >= d else least * (d - least) if least >= d / 2 else d * d / 4
        velocity = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
        assert np.linalg.norm(velocity) <= most * (1.0 + 1e-9)
        broken += bool((np.abs(velocity) > SAWYER.max_velocity).any())
    assert broken > 0


def test_with_the_small_angle_the_speed_is_no_longer_bounded() -> None:
    """Half the least singular value off the threshold: up to 1.5 times the bound, at s = 2 d / 3."""
    d, s = 1.0, np.linspace(1e-3, 1.5, 3000)
    threshold = np.maximum(d - 0.5 * s, 0.0)
    damping = np.where(s >= threshold, 0.0, np.where(s >= threshold / 2, s * (threshold - s), threshold**2 / 4))
    speed = s / (s**2 + damping) * d
    assert speed.max() == pytest.approx(1.5, abs=0.01)
    assert s[speed.argmax()] == pytest.approx(2.0 / 3.0, abs=0.01)


def test_a_small_angle_on_every_joint_hardly_leaves_the_singularity() -> None:
    values = [least_singular_value(np.full(7, angle)) for angle in (0.0, 0.01, 0.05, 0.1, 0.2)]
    assert values[0] < 1e-12
    assert values == sorted(values)
    assert values[-1] < 0.005
    assert np.median([least_singular_value(q) for q in postures(400)]) > 0.07


def test_only_elbow_and_wrist_of_sawyer_are_singular_at_zero() -> None:
    at_zero = []
    for joint in range(7):
        bent = postures(300)
        bent[:, joint] = 0.0
        at_zero.append(np.median([least_singular_value(q) for q in bent]))
    usual = np.median([least_singular_value(q) for q in postures(300)])
    weak = [joint for joint in range(7) if at_zero[joint] < 0.6 * usual]
    assert weak == [3, 5]  # zeros of all other joints are harmless


def test_table_3_1_torques_are_more_than_the_wrist_can_give() -> None:
    np.testing.assert_array_equal(SAWYER.max_torque[4:], 9.0)
    assert (TORQUES[:, 4:] > SAWYER.max_torque[4:]).all()  # mean torques, in every experiment
    assert TORQUES[:, 6].max() / SAWYER.max_torque[6] > 4.6


def test_table_3_1_torques_are_not_those_that_hold_the_arm() -> None:
    """At home gravity loads the second joint most and the last hardly at all; in the table the last is loaded most."""
    held = np.abs(SAWYER.gravity_torque(SAWYER.home))
    assert held.argmax() == 1
    assert held[[0, 6]].max() < 0.1
    assert TORQUES.mean(axis=0).argmax() == 6
    assert TORQUES.mean(axis=0)[0] > TORQUES.mean(axis=0)[1]


def test_table_3_1_times_fall_with_the_number_of_the_experiment() -> None:
    assert TIMES.mean() == pytest.approx(15.14, abs=0.01)
    assert (TIMES[0], TIMES[-1]) == (22.23, 12.42)
    rank = spearmanr(np.arange(10), TIMES)
    assert rank.statistic < -0.85
    assert rank.pvalue < 0.005


def test_table_3_1_longer_paths_do_not_take_longer() -> None:
    """Path length and time of the same experiments have nothing to do with each other, or the reverse."""
    assert PATH.mean() == pytest.approx(8.53, abs=0.01)
    assert spearmanr(PATH, TIMES).statistic < 0.1


def test_four_cubes_are_not_stacked_along_ten_centimetres() -> None:
    """The unit "cm.10" must be ten centimetres: four cubes of 32 mm can't be gathered and stacked along 8.5 cm."""
    lifted = 0.032 * (1 + 2 + 3)  # the second to the fourth cube, onto one, two and three
    assert PATH.max() / 100.0 < lifted
    assert PATH.min() / 10.0 > lifted


def test_ten_persons_do_not_give_a_margin_of_a_tenth() -> None:
    """Half the width of a 95 % interval of a mean of ten is 0.72 standard deviations; 0.1 needs 387 persons."""
    assert t.ppf(0.975, 9) / np.sqrt(10) == pytest.approx(0.715, abs=0.001)
    n = np.arange(2, 1000)
    assert n[t.ppf(0.975, n - 1) / np.sqrt(n) <= 0.1][0] == 387


def test_a_difference_of_five_percent_is_within_the_spread_of_one_method() -> None:
    spread = PATH.std(ddof=1) / PATH.mean()
    assert spread > 2.0 * 0.05
    assert 0.05 * PATH.mean() < t.ppf(0.975, 9) * PATH.std(ddof=1) / np.sqrt(10)


def test_thirty_seconds_a_frame_would_be_longer_than_each_experiment() -> None:
    assert TIMES.max() < 30.0  # 30 frames a second are meant


def test_a_lag_of_400_ms_is_most_of_a_cube() -> None:
    speed = PATH.mean() * 0.10 / TIMES.mean()  # [m/s], with the unit read as 10 cm
    assert 0.5 * 0.032 < 0.4 * speed < 0.032


def test_sawyer_has_seven_joints_of_which_the_last_turns_540_degrees() -> None:
    assert SAWYER.n_joints == 7  # not eight: the head's is none of the arm
    turns = np.degrees(SAWYER.upper - SAWYER.lower)
    assert turns[6] == pytest.approx(540.0, abs=1.0)
    assert ((turns[:6] > 340.0) & (turns[:6] < 351.0)).all()
