from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from imitarm.errors import InputError
from imitarm.kinematics import pose as p

finite = st.floats(-10.0, 10.0, allow_nan=False, width=64)
vectors = arrays(float, 3, elements=finite)
quaternions = (
    arrays(float, 4, elements=st.floats(-1.0, 1.0))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
poses = st.builds(p.Pose, vectors, quaternions)
quick = settings(deadline=None, max_examples=100)


def scipy_rotation(q):
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def same_rotation(a, b, tolerance=1e-12):
    return np.all(1.0 - np.abs(np.sum(np.asarray(a) * b, axis=-1)) < tolerance)


@quick
@given(quaternions, quaternions, vectors)
def test_product_matrix_and_rotation_agree_with_scipy(a, b, v):
    assert same_rotation(
        p.quaternion_multiply(a, b), (scipy_rotation(a) * scipy_rotation(b)).as_quat(scalar_first=True)
    )
    assert np.allclose(p.quaternion_to_matrix(a), scipy_rotation(a).as_matrix(), atol=1e-12)
    assert np.allclose(p.rotate(a, v), scipy_rotation(a).apply(v), atol=1e-11)


@quick
@given(quaternions)
def test_matrix_and_back(q):
    back = p.matrix_to_quaternion(p.quaternion_to_matrix(q))
    assert same_rotation(back, q) and back[0] >= 0.0


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, -0.8, 0.0], [-1, 2, 2]])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
def test_matrix_to_quaternion_keeps_its_digits_near_180_degrees(axis, angle):
    axis = np.array(axis, dtype=float) / np.linalg.norm(axis)
    q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    assert same_rotation(p.matrix_to_quaternion(p.quaternion_to_matrix(q)), q, 1e-14)


@quick
@given(arrays(float, 3, elements=st.floats(-1.8, 1.8)))
def test_exp_and_log_are_inverse_below_180_degrees(rotation_vector):
    assert np.linalg.norm(rotation_vector) < np.pi
    assert np.allclose(p.quaternion_log(p.quaternion_exp(rotation_vector)), rotation_vector, atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-15, 1e-9, 1e-7, 1e-6, 3.1415926])
def test_exp_and_log_of_tiny_and_large_turns(length):
    v = length * np.array([0.48, -0.6, 0.64])
    assert np.allclose(p.quaternion_log(p.quaternion_exp(v)), v, rtol=1e-7, atol=1e-16)


@quick
@given(quaternions)
def test_log_takes_the_short_way_and_ignores_the_sign(q):
    v = p.quaternion_log(q)
    assert np.linalg.norm(v) <= np.pi + 1e-12
    assert same_rotation(p.quaternion_exp(v), q)
    if abs(q[0]) > 1e-9:  # at exactly half a turn both ways are equally short
        assert np.allclose(v, p.quaternion_log(-q), atol=1e-12)


@quick
@given(poses, poses, vectors)
def test_poses_chain_like_their_matrices(a, b, point):
    assert np.allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-10)
    assert np.allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-10)
    assert np.allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-12)
    assert np.allclose(p.Pose.from_matrix(a.matrix).matrix, a.matrix, atol=1e-12)


@quick
@given(poses, poses)
def test_error_to_is_the_twist_that_leads_to_the_target(start, target):
    error = start.error_to(target)
    turned = p.quaternion_multiply(p.quaternion_exp(error[3:]), start.quaternion)
    assert np.allclose(start.position + error[:3], target.position, atol=1e-12)
    assert same_rotation(turned, target.quaternion)


def test_a_pose_never_changes():
    pose = p.Pose([1, 2, 3], [1, 0, 0, 0])
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 5.0
    with pytest.raises(AttributeError):
        pose.position = np.zeros(3)


@quick
@given(poses)
def test_a_trusted_pose_is_the_same_pose_and_never_changes_either(pose):
    position, quaternion = pose.position.copy(), pose.quaternion.copy()
    trusted = p.Pose.trusted(position, quaternion)
    assert isinstance(trusted, p.Pose)
    assert trusted.position is position  # nothing is copied
    assert trusted.quaternion is quaternion
    assert np.array_equal(trusted.matrix, pose.matrix)
    assert np.array_equal(trusted.error_to(pose), pose.error_to(pose))
    for array in (trusted.position, trusted.quaternion):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 5.0


@pytest.mark.parametrize(
    ("position", "quaternion", "said"),
    [
        ([0, 0], [1, 0, 0, 0], "position must be 3"),
        ([0, 0, np.nan], [1, 0, 0, 0], r"position must be finite \[m\], but position\[2\] is nan"),
        ([0, 0, 0], [1, 0, 0], "4 numbers"),
        ([0, 0, 0], [[1, 0, 0, 0]], "4 numbers"),
        ([0, 0, 0], [0.5, 0.5, 0, 0], "length 0.7071, not 1"),
        ([0, 0, 0], [np.nan, 0, 0, 0], "quaternion must be finite"),
    ],
)
def test_what_is_no_pose_is_refused(position, quaternion, said):
    with pytest.raises(InputError, match=said):
        p.Pose(position, quaternion)


def test_continuous_signs_leave_no_jump():
    rng = np.random.default_rng(0)
    smooth = p.quaternion_exp(np.linspace([0, 0, 0], [2.5, -1.5, 1.0], 60))
    flipped = smooth * rng.choice([-1.0, 1.0], size=(60, 1))
    steady = p.continuous_signs(flipped)
    assert np.all(np.sum(steady[1:] * steady[:-1], axis=1) > 0.0)
    assert same_rotation(steady, smooth)
    assert np.array_equal(steady[0], flipped[0])


def test_slerp_agrees_with_scipy_and_holds_the_ends():
    rng = np.random.default_rng(1)
    keys = np.array([0.0, 0.4, 1.0, 1.7])
    rotations = Rotation.random(4, rng=rng)
    times = np.linspace(0.0, 1.7, 50)
    ours = p.slerp(times, keys, rotations.as_quat(scalar_first=True))
    assert same_rotation(ours, Slerp(keys, rotations)(times).as_quat(scalar_first=True))
    held = p.slerp([-1.0, 5.0], keys, rotations.as_quat(scalar_first=True))
    assert same_rotation(held, rotations[[0, 3]].as_quat(scalar_first=True))
    assert same_rotation(p.slerp([0.0, 9.0], [1.0], [[0, 1, 0, 0]]), np.array([0.0, 1, 0, 0]))


def test_the_mean_rotation_ignores_signs():
    rng = np.random.default_rng(2)
    center = p.quaternion_exp([0.3, -1.2, 0.7])
    spread = p.quaternion_exp(0.2 * rng.normal(size=(400, 3)))
    samples = p.quaternion_multiply(spread, center) * rng.choice([-1.0, 1.0], size=(400, 1))
    turn = p.quaternion_log(p.quaternion_multiply(p.mean_quaternion(samples), p.quaternion_conjugate(center)))
    assert np.linalg.norm(turn) < 0.03


def test_functions_work_on_any_leading_shape():
    rng = np.random.default_rng(3)
    q = p.quaternion_exp(rng.normal(size=(4, 5, 3)))
    v = rng.normal(size=(4, 5, 3))
    assert p.rotate(q, v).shape == (4, 5, 3)
    assert p.quaternion_to_matrix(q).shape == (4, 5, 3, 3)
    assert p.matrix_to_quaternion(p.quaternion_to_matrix(q)).shape == (4, 5, 4)
    assert np.allclose(p.rotate(q, v)[2, 3], p.rotate(q[2, 3], v[2, 3]))


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-9, 1e-3, 1.0, 3.1]))
def test_one_rotation_is_computed_as_many_are(seed, size):
    rng = np.random.default_rng(seed)
    v, other = size * rng.normal(size=3), p.quaternion_exp(rng.normal(size=(1, 3)))[0]
    q = p.quaternion_exp(v)
    np.testing.assert_allclose(q, p.quaternion_exp(v[None])[0], atol=1e-15)
    np.testing.assert_allclose(p.quaternion_log(q), p.quaternion_log(q[None])[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(p.quaternion_log(-q), p.quaternion_log(-q[None])[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        p.quaternion_multiply(other, q), p.quaternion_multiply(other[None], q[None])[0], atol=1e-15
    )
    m = p.quaternion_to_matrix(q)
    np.testing.assert_allclose(p.matrix_to_quaternion(m), p.matrix_to_quaternion(m[None])[0], atol=1e-15)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (np.diag([1.1, 1.1, 1.1, 1.0]), "not a rotation"),
        (np.eye(4) + 0.1 * np.eye(4, k=1), "not a rotation"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.eye(3), r"shape \(4, 4\)"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_a_matrix_that_is_no_pose_is_refused(matrix, said):
    with pytest.raises(InputError, match=said):
        p.Pose.from_matrix(matrix)


NOT_POINTS = [None, "x", [1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]], [np.nan, 0, 0], [np.inf, 0, 0], [None] * 3, {}, 1j, 3.0]


@pytest.mark.parametrize("bad", NOT_POINTS, ids=repr)
def test_every_method_refuses_what_it_can_not_use(bad):
    pose = p.Pose.identity()
    for call in (
        lambda: pose.apply(bad),
        lambda: pose @ bad,
        lambda: pose.error_to(bad),
        lambda: p.Pose(bad, [1, 0, 0, 0]),
        lambda: p.Pose([0, 0, 0], bad),
        lambda: p.Pose.from_matrix(bad),
    ):
        with pytest.raises(InputError):
            call()


def test_one_point_is_moved_as_many_are():
    rng = np.random.default_rng(5)
    q = p.quaternion_exp(rng.normal(size=(50, 3)))
    v = rng.normal(size=(50, 3))
    together = p.rotate(q, v), p.quaternion_to_matrix(q)
    alone = [p.rotate(a, b) for a, b in zip(q, v, strict=True)], [p.quaternion_to_matrix(a) for a in q]
    for many, single in zip(together, alone, strict=True):
        np.testing.assert_allclose(many, single, atol=1e-15)
    pose = p.Pose(v[0], q[0])
    np.testing.assert_allclose(pose.apply(v), [pose.apply(point) for point in v], atol=1e-14)
