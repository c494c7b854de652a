"""Many postures at once: the same as one posture after the other."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.kinematics.arm_path import REACHED, ArmPath, right_inverses, self_motions, track

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
LIFT = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>
<geom type="box" size=".05 .05 .05" mass="1" group="3"/><body pos="0 0 1"><joint name="turn" axis="0 0 1" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass="1" group="3"/><body pos=".4 0 0">
<joint name="bend" axis="0 1 0" range="-2 2"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1" group="3"/>
<site name="flange" pos=".3 0 0"/></body></body></body></worldbody></mujoco>"""
each_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)


@pytest.fixture(scope="module")
def lift(tmp_path_factory):
    path = tmp_path_factory.mktemp("arms") / "lift.xml"
    path.write_text(LIFT)
    return ArmModel.load(path)


def postures(arm, n=12, seed=0):
    low, high = np.maximum(arm.lower, -2.5), np.minimum(arm.upper, 2.5)
    return np.random.default_rng(seed).uniform(low, high, (n, arm.n_joints))


@pytest.mark.parametrize("name", [*ARMS, "lift"])
def test_each_posture_is_as_alone(name, lift):
    arm = ARMS.get(name, lift)
    joints = postures(arm)
    path = ArmPath.of(arm, joints)
    for i, q in enumerate(joints):
        pose = arm.tool_pose(q)
        np.testing.assert_allclose(path.positions[i], pose.position, atol=1e-12)
        assert abs(path.quaternions[i] @ pose.quaternion) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(path.centers[i], arm.collision_spheres(q)[0], atol=1e-12)
    jacobians = path.tool_jacobians()
    np.testing.assert_allclose(jacobians, [arm.tool_jacobian(q) for q in joints], atol=1e-12)
    assert len(path) == len(joints)
    assert arm.tool_pose(joints[3]).position == pytest.approx(path.positions[3])  # the arm's memory is not confused


@pytest.mark.parametrize("name", [*ARMS, "lift"])
def test_speeds_of_spheres_equal_finite_differences(name, lift):
    arm = ARMS.get(name, lift)
    q, step = postures(arm, 1)[0], 1e-6
    path, rng = ArmPath.of(arm, q[None]), np.random.default_rng(1)
    m = path.centers.shape[1]
    directions = rng.normal(size=(m, 3))
    speeds = path.sphere_speeds(np.zeros(m, dtype=int), np.arange(m), directions)
    for j in range(arm.n_joints):
        change = step * np.eye(arm.n_joints)[j]
        ends = ArmPath.of(arm, np.stack([q + change, q - change])).centers
        differences = np.einsum("mi,mi->m", (ends[0] - ends[1]) / (2.0 * step), directions)
        np.testing.assert_allclose(speeds[:, j], differences, atol=1e-7)


@each_arm
def test_radii_are_the_largest_speeds(arm):
    path = ArmPath.of(arm, postures(arm, 1))
    m = path.centers.shape[1]
    index = np.zeros(m, dtype=int), np.arange(m)
    fastest = np.zeros((m, arm.n_joints))
    for direction in np.random.default_rng(0).normal(size=(200, 3)):
        unit = np.tile(direction / np.linalg.norm(direction), (m, 1))
        fastest = np.maximum(fastest, np.abs(path.sphere_speeds(*index, unit)))
    radii = path.sphere_radii(*index)
    assert (fastest <= radii + 1e-12).all()
    np.testing.assert_allclose(fastest, radii, rtol=0.1, atol=1e-12)


def test_a_slide_has_radius_one(lift):
    path = ArmPath.of(lift, postures(lift, 1))
    last = path.centers.shape[1] - 1
    assert path.sphere_radii(np.array([0]), np.array([last]))[0, 0] == 1.0


@each_arm
def test_self_motions_do_not_move_the_tool_and_change_smoothly(arm):
    joints = np.linspace(arm.home, arm.home + 0.4, 60)
    jacobians = ArmPath.of(arm, joints).tool_jacobians()
    null = self_motions(jacobians)
    assert null.shape == (60, 7, 1)
    np.testing.assert_allclose(np.einsum("nij,nje->nie", jacobians, null), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(null, axis=1), 1.0)
    assert (np.einsum("nje,nje->n", null[1:], null[:-1]) > 0.9).all()


def test_two_self_motions_are_orthonormal_and_change_smoothly():
    base = np.random.default_rng(2).normal(size=(6, 8))
    other = np.random.default_rng(3).normal(size=(6, 8))
    jacobians = np.stack([base + s * other for s in np.linspace(0.0, 0.2, 30)])
    null = self_motions(jacobians)
    np.testing.assert_allclose(np.einsum("nij,nje->nie", jacobians, null), 0.0, atol=1e-10)
    np.testing.assert_allclose(np.einsum("nje,njf->nef", null, null), np.tile(np.eye(2), (30, 1, 1)), atol=1e-10)
    assert np.abs(np.diff(null, axis=0)).max() < 0.2
    assert self_motions(jacobians[:, :, :6]).shape == (30, 6, 0)


@each_arm
def test_right_inverses_move_the_tool_as_asked(arm):
    jacobians = ArmPath.of(arm, np.linspace(arm.home, arm.home + 0.3, 5)).tool_jacobians()
    np.testing.assert_allclose(jacobians @ right_inverses(jacobians), np.tile(np.eye(6), (5, 1, 1)), atol=1e-3)


@each_arm
def test_the_tool_is_brought_to_its_poses_in_all_postures_at_once(arm):
    before = ArmPath.of(arm, np.linspace(arm.home, arm.home + 0.3, 20))
    positions = before.positions + [0.02, -0.01, 0.015]
    after, error = before.moved_to(positions, before.quaternions)
    assert error < REACHED
    np.testing.assert_allclose(after.positions, positions, atol=2e-6)
    assert np.abs(after.joints - before.joints).max() < 0.3
    _, error = before.moved_to(before.positions + [3.0, 0.0, 0.0], before.quaternions)
    assert error > 0.1  # out of reach is told


@each_arm
def test_tracking_follows_and_a_drift_changes_only_the_self_motion(arm):
    shown = ArmPath.of(arm, np.linspace(arm.home, arm.home + 0.2, 40))
    joints = track(arm, arm.home, shown.positions, shown.quaternions)
    np.testing.assert_allclose(ArmPath.of(arm, joints).positions, shown.positions, atol=1e-4)
    np.testing.assert_allclose(joints[0], arm.home, atol=1e-9)
    null = self_motions(arm.tool_jacobian(joints[-1])[None])[0, :, 0]
    drifted = track(arm, arm.home, shown.positions, shown.quaternions, joints[-1] + 0.5 * null)
    np.testing.assert_allclose(ArmPath.of(arm, drifted).positions, shown.positions, atol=1e-4)
    assert (drifted[-1] - joints[-1]) @ null > 0.3


@pytest.mark.parametrize("name", [*ARMS, "lift"])
def test_torques_of_many_postures_are_those_of_each_alone(name, lift):
    arm, rng = ARMS.get(name, lift), np.random.default_rng(4)
    joints = postures(arm)
    velocity, acceleration = rng.normal(size=(2, *joints.shape))
    placed = arm.chain.placed(joints)
    both = arm.chain.torques(placed, np.stack([velocity, 0.0 * velocity]), np.stack([acceleration, 0.0 * velocity]))
    motions = zip(joints, velocity, acceleration, strict=True)
    np.testing.assert_allclose(both[0], [arm.inverse_dynamics(*motion) for motion in motions], atol=1e-10)
    np.testing.assert_allclose(both[1], [arm.gravity_torque(q) for q in joints], atol=1e-10)


@pytest.mark.parametrize("name", [*ARMS, "lift"])
def test_no_sphere_moves_farther_or_faster_than_the_bounds_of_its_link(name, lift):
    arm = ARMS.get(name, lift)
    ends = postures(arm, 6, seed=5)
    links = arm.cover.links
    for start, end in pairwise(ends):
        path = ArmPath.of(arm, np.stack([start, end]))
        dense = ArmPath.of(arm, np.linspace(start, end, 100))
        for first in range(arm.n_joints):  # as seen from the link that the first joints move
            turned = np.swapaxes(dense.placed.rotations[:, first], 1, 2)
            seen = np.einsum("nij,nmj->nmi", turned, dense.centers - dense.placed.shifts[:, first, None])
            way = np.linalg.norm(np.diff(seen, axis=0), axis=2).sum(axis=0)
            behind = links > first
            assert (way[behind] <= path.travel[0, links[behind] - 1, first] + 1e-9).all()
        speeds = path.speeds(np.tile(end - start, (2, 1)))
        moving = ArmPath.of(arm, np.stack([start, start + 1e-6 * (end - start)])).centers
        fast = np.linalg.norm(moving[1] - moving[0], axis=1) / 1e-6
        assert (fast <= speeds[0, links - 1, 0] + 1e-4).all()
