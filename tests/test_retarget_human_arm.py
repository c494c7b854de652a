import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imitarm import ArmModel
from imitarm.retarget.human_arm import (
    AXES,
    carried,
    dh_transform,
    hand_rotation,
    human_arm_angles,
    human_arm_frames,
    human_arm_jacobian,
    human_arm_pose,
)
from imitarm.retarget.limbs import LimbLengths

LENGTHS = LimbLengths(0.30, 0.26)


def test_closed_form_inverts_the_chain_on_2000_random_postures():
    rng = np.random.default_rng(0)
    worst, n = 0.0, 0
    while n < 2000:
        q = rng.uniform(-np.pi, np.pi, 7)
        elbow, wrist, hand = human_arm_pose(q, LENGTHS)
        if min(np.hypot(*elbow[:2]) / 0.30, abs(np.sin(q[3])), abs(np.sin(q[5]))) < 0.06:
            continue  # an angle would be held there
        n += 1
        found = human_arm_angles(elbow / 0.30, (wrist - elbow) / 0.26, hand)
        again = human_arm_pose(found, LENGTHS)
        worst = max(worst, *(float(np.abs(a - b).max()) for a, b in zip(again, (elbow, wrist, hand), strict=True)))
    assert worst < 1e-9


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_jacobian_equals_finite_differences(seed):
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, 7)
    jacobian, h = human_arm_jacobian(q, LENGTHS), 1e-6
    for i in range(7):
        step = np.zeros(7)
        step[i] = h
        _, wrist_up, hand_up = human_arm_pose(q + step, LENGTHS)
        _, wrist_down, hand_down = human_arm_pose(q - step, LENGTHS)
        turn = Rotation.from_matrix(hand_up @ hand_down.T).as_rotvec()
        np.testing.assert_allclose(jacobian[:3, i], (wrist_up - wrist_down) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(jacobian[3:, i], turn / (2 * h), atol=1e-8)


def test_the_chain_has_the_axes_of_sawyer():
    arm = ArmModel.load("sawyer")
    axes = arm.jacobian(np.zeros(7))[3:].T
    expected = np.eye(3)[["xyz".index(axis) for axis in AXES]]
    np.testing.assert_allclose(axes, expected, atol=1e-4)  # the manufacturer's file rounds its angles


def test_angles_are_held_where_they_can_not_be_seen():
    before = np.array([0.3, 0.2, 0.7, 0.5, 0.4, 0.6, 0.1])
    straight = human_arm_angles([1.0, 0.0, 0.0], [1.0, 0.0, 0.0], np.eye(3), before)
    assert straight[2] == before[2]
    assert straight[4] == before[4]
    up = human_arm_angles([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], np.eye(3), before)
    assert up[0] == before[0]


def test_angles_follow_a_motion_without_a_jump():
    rng = np.random.default_rng(3)
    start, end = rng.uniform(-0.8, 0.8, (2, 7))
    start[[3, 5]] = end[[3, 5]] = 0.9  # off the singularities, the bends' positive branch
    q = None
    path = []
    for s in np.linspace(0.0, 1.0, 200):
        elbow, wrist, hand = human_arm_pose(start + s * (end - start), LENGTHS)
        q = human_arm_angles(elbow / 0.30, (wrist - elbow) / 0.26, hand, start if q is None else q)
        path.append(q)
    assert np.abs(np.diff(path, axis=0)).max() < 0.05


def test_the_second_row_of_equation_3_5_as_printed_is_no_rotation():
    theta = np.linspace(-3.0, 3.0, 61)
    right = dh_transform(theta, 0.1, 0.2, 0.7)[..., :3, :3]
    printed = dh_transform(theta, 0.1, 0.2, 0.7, as_printed=True)[..., :3, :3]
    np.testing.assert_allclose(np.linalg.det(right), 1.0)
    np.testing.assert_allclose(right @ np.swapaxes(right, -1, -2), np.broadcast_to(np.eye(3), right.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(printed), np.sin(theta) * (np.cos(theta) + np.sin(theta)), atol=1e-12)
    assert np.linalg.matrix_rank(dh_transform(0.0, 0.1, 0.2, 0.7, as_printed=True)[:3, :3]) < 3


def test_denavit_hartenberg_gives_the_same_arm_as_the_chain():
    """Each turn about an axis is one D-H step, with fixed turns between: the chain of the module is Eq 3.5's."""
    q = np.random.default_rng(1).uniform(-2.0, 2.0, 7)
    toward = {"z": np.eye(3), "y": Rotation.from_euler("x", -90, degrees=True).as_matrix()}
    toward["x"] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    transform = np.eye(4)
    for i, (axis, angle) in enumerate(zip(AXES, q, strict=True)):
        into = np.eye(4)
        into[:3, :3] = toward[axis]
        transform = transform @ into @ dh_transform(angle, 0.0, 0.0, 0.0) @ np.linalg.inv(into)
        transform = transform @ dh_transform(0.0, 0.0, {2: 0.30, 4: 0.26}.get(i, 0.0), 0.0)
    _, wrist, hand = human_arm_pose(q, LENGTHS)
    np.testing.assert_allclose(transform[:3, 3], wrist, atol=1e-12)
    np.testing.assert_allclose(transform[:3, :3], hand, atol=1e-12)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_hand_rotation_is_a_rotation_along_the_hand(seed):
    rng = np.random.default_rng(seed)
    wrist, tip, thumb = rng.normal(size=(3, 3))
    rotation = hand_rotation(wrist, tip, thumb)
    if rotation is None:
        x, y = tip - wrist, thumb - wrist
        assert np.linalg.norm(np.cross(x, y)) < 0.21 * np.linalg.norm(x) * np.linalg.norm(y) or np.linalg.norm(y) < 0.02
        return
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0.0
    np.testing.assert_allclose(rotation[:, 0], (tip - wrist) / np.linalg.norm(tip - wrist))
    assert rotation[:, 1] @ (thumb - wrist) > 0.0


@pytest.mark.parametrize("thumb", [[0.1, 0.001, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]])
def test_a_thumb_in_line_or_lost_tells_no_rotation(thumb):
    assert hand_rotation(np.zeros(3), np.array([0.17, 0.0, 0.0]), np.array(thumb)) is None


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_carried_rotation_turns_with_the_forearm_and_no_more(seed):
    rng = np.random.default_rng(seed)
    before, after = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    rotation = Rotation.random(random_state=seed % 1000).as_matrix()
    turned = carried(rotation, before, after)
    np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-9)
    if before @ after > -0.999:
        np.testing.assert_allclose(turned @ rotation.T @ before, after, atol=1e-9)
        angle = np.linalg.norm(Rotation.from_matrix(turned @ rotation.T).as_rotvec())
        assert angle <= np.arccos(np.clip(before @ after, -1, 1)) + 1e-6
    fresh = carried(None, None, after)
    np.testing.assert_allclose(fresh[:, 0], after)
    assert np.linalg.det(fresh) > 0.999


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_denavit_hartenberg_table_has_the_chain_of_the_module(seed):
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, 7)
    frames = human_arm_frames(q, LENGTHS)
    elbow, wrist, hand = human_arm_pose(q, LENGTHS)
    np.testing.assert_allclose(frames[3, :3, 3], elbow, atol=1e-12)
    np.testing.assert_allclose(frames[5, :3, 3], wrist, atol=1e-12)
    np.testing.assert_allclose(frames[7, :3, :3], hand, atol=1e-12)
    printed = human_arm_frames(q, LENGTHS, as_printed=True)
    assert np.abs(printed[7, :3, :3] @ printed[7, :3, :3].T - np.eye(3)).max() > 1e-3
