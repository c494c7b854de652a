"""The approach to another start posture: clear, from rest to rest, and not longer than it has to be."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm import ArmModel, Sphere
from imitarm.policies.approach import find_approach
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.whole_arm import links_apart

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
each_arm = pytest.mark.parametrize("name", ARMS)


def swing(arm):
    """A posture on each side of home."""
    turn = np.zeros(arm.n_joints)
    turn[0] = 0.6
    return arm.home - turn, arm.home + turn


@each_arm
def test_without_obstacles_the_joints_move_on_a_straight_line(name):
    arm = ARMS[name]
    start, end = swing(arm)
    found = find_approach(ArmAmongObstacles(arm, [], 0.02, own=links_apart(arm)), start, end, 0.005)
    np.testing.assert_allclose(found.joints[[0, -1]], [start, end])
    np.testing.assert_allclose(found.joints[:, 1:] - arm.home[1:], 0.0, atol=1e-12)
    velocity = np.diff(found.joints, axis=0) / np.diff(found.times)[:, None]
    assert (np.abs(velocity) <= arm.max_velocity).all()


@each_arm
def test_around_an_obstacle_every_posture_is_clear(name):
    arm = ARMS[name]
    start, end = swing(arm)
    ball = Sphere(arm.tool_pose(arm.home).position, 0.08)
    around = ArmAmongObstacles(arm, [ball], 0.02, own=links_apart(arm))
    found = find_approach(around, start, end, 0.005)
    np.testing.assert_allclose(found.joints[[0, -1]], [start, end])
    assert (np.diff(found.times) > 0.0).all()
    for a, b in zip(found.joints[:-1], found.joints[1:], strict=True):
        for q in np.linspace(a, b, 3):
            centers, radii = arm.collision_spheres(q)
            assert (ball.signed_distance(centers) - radii).min() >= 0.02 - 1e-9


def test_there_is_none_to_a_posture_that_is_not_clear():
    arm = ARMS["panda"]
    start, end = swing(arm)
    around = ArmAmongObstacles(arm, [Sphere(arm.tool_pose(end).position, 0.05)], 0.02)
    assert find_approach(around, start, end, 0.005) is None
