"""The whole-arm barrier: its rows are the derivative of the clearance, and following them keeps it."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import solve_ik
from imitarm.scene import Scene, Sphere
from imitarm.scene.barrier import clearance_rows


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("panda", tool="gripper")


def rooms(arm, q, scene):
    centers, radii = arm.collision_spheres(q)
    return np.array([o.signed_distance(centers) - radii for o in scene.obstacles])


def test_no_obstacle_or_only_far_ones_give_no_rows(arm):
    assert clearance_rows(arm, arm.home, Scene(), 0.02) is None
    assert clearance_rows(arm, arm.home, Scene(None, [Sphere([50.0, 0, 0], 0.1)]), 0.02) is None


def test_rows_equal_the_finite_difference_of_the_clearance(arm):
    rng = np.random.default_rng(0)
    step = 1e-6
    for _ in range(20):
        q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
        position = arm.tool_pose(q).position + 0.12 * rng.normal(size=3)
        scene = Scene(None, [Sphere(position, 0.05, velocity=0.2 * rng.normal(size=3))])
        answer = clearance_rows(arm, q, scene, 0.02, rate=0.0)
        if answer is None:
            continue
        rows, lower = answer
        qd = rng.normal(size=arm.n_joints)
        before = rooms(arm, q - step * qd, scene.after(-step))[0]
        after = rooms(arm, q + step * qd, scene.after(step))[0]
        near = np.flatnonzero(rooms(arm, q, scene)[0] - 0.02 < 0.15)
        rate_of_change = ((after - before) / (2 * step))[near]
        np.testing.assert_allclose(rows @ qd - lower, rate_of_change, atol=1e-5)


def test_an_arm_that_is_pulled_into_an_obstacle_stays_clear(arm):
    """The tool is drawn straight at a sphere; without the rows it goes in, with them no link does."""
    ahead = arm.tool_pose(arm.home).position + [0.25, 0.0, 0.0]
    scene = Scene(None, [Sphere(ahead, 0.06)])
    least = {}
    for guarded in (False, True):
        q = arm.home.copy()
        least[guarded] = np.inf
        for _ in range(300):
            rows = clearance_rows(arm, q, scene, 0.02) if guarded else None
            q = q + 0.01 * solve_ik(arm, q, [0.2, 0, 0, 0, 0, 0], dt=0.01, rows=rows)
            least[guarded] = min(least[guarded], float(rooms(arm, q, scene).min()))
    assert least[False] < 0.0
    assert least[True] > 0.018


def test_an_arm_gives_way_to_what_comes_at_it(arm):
    """A sphere moves at the hand while the tool has nothing to do."""
    hand = arm.tool_pose(arm.home).apply([0.0, 0.0, -0.1])
    start = Scene(None, [Sphere(hand + [0.0, 0.28, 0.0], 0.06, velocity=[0.0, -0.1, 0.0])])
    q, least = arm.home.copy(), np.inf
    for k in range(250):
        scene = start.after(0.01 * k)
        rows = clearance_rows(arm, q, scene, 0.02)
        q = q + 0.01 * solve_ik(arm, q, np.zeros(6), dt=0.01, rows=rows)
        least = min(least, float(rooms(arm, q, start.after(0.01 * (k + 1))).min()))
    assert rooms(arm, arm.home, start.after(2.5)).min() < 0.0  # it would have been hit
    assert least > 0.015
