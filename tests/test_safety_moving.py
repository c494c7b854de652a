"""Moving obstacles: an arm that stands yields to them; where it can't, it does not move towards them."""

from __future__ import annotations

import numpy as np
import pytest

from approaching import appearing, approach, stand, yielded
from imitarm.command import Command
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.limits import JointLimits
from imitarm.kinematics.pose import Pose
from imitarm.perception import CoverageMargin
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, Scene, Sphere
from imitarm.scene.braking import APPROACH_RATE, shrink_rates

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
either = pytest.mark.parametrize("name", list(ARMS))


@either
@pytest.mark.parametrize("latency", [0.0, 0.033])
def test_an_obstacle_that_moves_at_a_standing_arm_never_comes_nearer_than_required(name, latency):
    """0.1 to 0.6 m/s; the simulator's own geometry judges. 12 seeds, none of them chosen."""
    for seed in range(12):
        least = min(moment.clearance for moment in stand(ARMS[name], approach(ARMS[name], seed), latency=latency))
        assert least > 0.019, seed


@either
def test_an_arm_that_can_not_get_away_does_not_move_towards_what_hits_it(name):
    """An obstacle at 1 to 2 m/s appears at 10 cm while the arm stands, or moves towards it."""
    arm, hits = ARMS[name], 0
    for seed in range(8):
        case = appearing(arm, seed)
        centers, radii = arm.collision_spheres(case.q)
        distance, normal = case.scene.distances_and_gradients(centers)
        nearest = int(np.argmin(distance[0] - radii))
        gradient = normal[0, nearest] @ arm.sphere_jacobians(case.q)[nearest]
        towards = -gradient * 0.3 / (gradient @ gradient)
        towards *= min(1.0, 0.9 / np.max(np.abs(towards) / arm.max_velocity))
        for velocity in (None, towards):
            moments = stand(arm, case, velocity=velocity)
            if moments[-1].clearance <= 0.0:
                hits += 1
                assert not moments[-1].safe
                assert yielded(moments), seed
    assert hits > 5  # else nothing was tested


@either
def test_where_no_motion_is_safe_nothing_is_approached_faster_than_under_full_braking(name):
    arm, rng, unsafe = ARMS[name], np.random.default_rng(3), 0
    keeper, limits = SafetyFilter(arm, clearance=0.02), JointLimits(arm)
    for _ in range(40):
        q = np.clip(arm.home + 0.2 * rng.normal(size=7), arm.lower + 0.1, arm.upper - 0.1)
        velocity = 0.4 * rng.uniform(-1.0, 1.0, size=7) * arm.max_velocity
        centers, radii = arm.collision_spheres(q)
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        place = centers[rng.integers(len(centers))] + 0.2 * way
        scene = Scene(None, [Sphere(place, 0.05, velocity=-rng.uniform(0.5, 2.0) * way)])
        kept = keeper.step(Command(0.3 * rng.normal(size=6)), q, velocity, scene)
        box = limits.box(q, 0.01, velocity)
        assert np.all(kept.velocity >= box.lower - 1e-9) and np.all(kept.velocity <= box.upper + 1e-9)
        if kept.safe:
            continue
        unsafe += 1
        share = 1.0 - 0.01 / np.max(np.abs(velocity) / arm.max_acceleration)
        normal = scene.distances_and_gradients(centers)[1][0]
        rates = np.einsum("md,mdj->mj", normal, arm.sphere_jacobians(q))
        near = keeper._obstacles.near(q, scene, velocity)
        lower = np.full(len(radii), -np.inf)
        lower[near.sphere] = near.rows.lower
        assert np.all(rates @ kept.velocity >= np.minimum(lower, share * (rates @ velocity)) - 1e-6)
    assert unsafe > 10


@either
def test_the_faster_the_obstacle_and_the_slower_the_link_the_earlier_the_arm_yields(name):
    arm = ARMS[name]
    gradients = np.array([[0.5] * 7, [0.1] * 7])
    rates = np.array([shrink_rates(arm, gradients, np.full(2, speed)) * np.ones(2) for speed in (0.0, 0.1, 0.3, 0.6)])
    assert np.all(np.diff(rates, axis=0) <= 0.0) and np.all(rates[1:, 1] <= rates[1:, 0])
    np.testing.assert_array_equal(rates[0], APPROACH_RATE)
    assert shrink_rates(arm, gradients, None) == APPROACH_RATE
    assert shrink_rates(arm, gradients, None, 4.0 * arm.max_velocity) < APPROACH_RATE


def test_an_intervention_names_the_link_and_the_obstacle():
    arm = ARMS["panda"]
    tool = arm.tool_pose(arm.home).position
    wall = Box(Pose(tool + [0.14, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), size=[0.1, 0.6, 0.6], name="wall")
    keeper = SafetyFilter(arm, clearance=0.02)
    free = keeper.step(Command(np.zeros(6)), arm.home, np.zeros(7), Scene(None, [wall]))
    assert free.cause is None and not free.intervened
    kept = keeper.step(Command([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), arm.home, None, Scene(None, [wall]))
    assert kept.intervened and kept.cause.other == 'box "wall"' and kept.cause.link in arm.cover.bodies
    assert 0.0 < kept.cause.room < 0.1


def test_an_intervention_between_links_names_both():
    arm = ARMS["sawyer"]
    keeper, q = SafetyFilter(arm), arm.home.copy()
    fold, velocity, names = np.array([0, -1.0, 0, 2.9, 0, 1.4, 0]), np.zeros(7), set()
    for _ in range(400):
        kept = keeper.step(Command(np.zeros(6), joint_velocity=2.0 * (fold - q)), q, velocity, Scene())
        velocity, q = kept.velocity, q + 0.01 * kept.velocity
        if kept.cause is not None:
            names |= {kept.cause.link, kept.cause.other}
    assert names and names <= {*arm.cover.bodies, "base"}


def test_margin_and_latency_keep_an_aged_obstacle_farther_away():
    """The margin is evaluated at the age of the obstacle plus the latency; the margin zero changes nothing."""
    arm = ARMS["panda"]
    tool = arm.tool_pose(arm.home).position
    old = Scene(None, [Sphere(tool + [0.0, 0.3, 0.0], 0.05, velocity=[0.0, -0.1, 0.0])], stamp=0.0)
    scene, nothing = old.at(0.5), CoverageMargin.none()
    plain = SafetyFilter(arm, clearance=0.02)._near(arm.home, None, scene)[0]
    same = SafetyFilter(arm, clearance=0.02, margin=nothing)._near(arm.home, None, scene)[0]
    np.testing.assert_array_equal(plain.rows.lower, same.rows.lower)
    keeper = SafetyFilter(arm, clearance=0.02, margin=CoverageMargin(0.01, 0.1), latency=0.1)
    wide = keeper._near(arm.home, None, scene)[0]
    rooms = dict(zip(plain.sphere.tolist(), plain.room, strict=True))
    assert len(wide.room) >= len(plain.room)
    shared = [(rooms[s], room) for s, room in zip(wide.sphere.tolist(), wide.room, strict=True) if s in rooms]
    np.testing.assert_allclose([a - b for a, b in shared], 0.01 + 0.1 * 0.6)
