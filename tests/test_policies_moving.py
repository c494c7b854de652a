"""adapt() among moving obstacles: the same certificate, exact while the motion is on time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import random_obstacle, sparse_clutter
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, adapt
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, HalfSpace, Scene, Sphere

RADIUS, CLEARANCE = 0.03, 0.02


@pytest.fixture(scope="module", params=[True, False], ids=["2-D", "3-D"])
def learned(request):
    return request.param, *learn(planar=request.param)


def crossing(rng, path, duration, planar):
    """An obstacle that meets the tool somewhere on its path, from any side, at 0.1 to 0.6 m/s."""
    at = int(rng.uniform(0.2, 0.8) * (len(path) - 1))
    velocity = rng.normal(size=3) * ([1, 1, 0] if planar else [1, 1, 1])
    velocity *= rng.uniform(0.1, 0.6) / np.linalg.norm(velocity)
    start = path[at] - at / (len(path) - 1) * duration * velocity
    return replace(random_obstacle(rng, start, planar=planar), velocity=velocity)


def clearance_in_time(scene, trajectory, radius):
    """Smallest distance when each obstacle is where it is at that time, at 2000 times."""
    times = np.linspace(0.0, trajectory.times[-1], 2000)
    points, _ = trajectory.at(times)
    # the obstacle at time t and the point p are as far apart as the obstacle at time 0 and p - v t
    return min(o.signed_distance(points - times[:, None] * o.velocity).min() for o in scene.obstacles) - radius


def test_a_crossing_obstacle_is_avoided_at_the_time_when_it_is_there(learned):
    planar, skill, path = learned
    forbidden = HORIZONTAL_ONLY if planar else ()
    accepted = touched = 0
    for seed in range(30):
        rng = np.random.default_rng([41, planar, seed])
        scene = Scene(None, [crossing(rng, path, skill.duration_, planar) for _ in range(1 + seed % 3)])
        adaptation = adapt(skill, scene, tool_radius=RADIUS, clearance=CLEARANCE, forbidden=forbidden)
        touched += clearance_in_time(scene, adaptation.nominal, RADIUS) < 0.0
        assert adaptation.only_on_schedule
        if adaptation.feasible:
            accepted += 1
            measured = clearance_in_time(scene, adaptation.trajectory, RADIUS)
            assert measured >= CLEARANCE - 1e-9
            assert adaptation.certified_clearance <= measured + 1e-9
        else:  # it passes over the start or the goal
            assert "start" in adaptation.reason or "goal" in adaptation.reason
    assert touched >= 28 and accepted >= 25


def test_what_the_proof_assumes_is_said(learned):
    _, skill, path = learned
    ball = Sphere(path[200] - [0.0, 0.4, 0.0], 0.03, velocity=[0.0, 0.2, 0.0], name="ball")
    moving = adapt(skill, Scene(None, [ball]), tool_radius=0.0)
    assert moving.only_on_schedule
    assert 'sphere "ball" keeps the given velocity' in moving.validity and "on time" in moving.validity
    assert f"0 to {skill.duration_:.2f} s" in moving.validity
    standing = adapt(skill, Scene(None, [replace(ball, velocity=0)]), tool_radius=0.0)
    assert not standing.only_on_schedule and "stand still" in standing.validity


def test_zero_velocity_is_bit_identical_to_standing_still(learned):
    planar, skill, path = learned
    forbidden = HORIZONTAL_ONLY if planar else ()
    for seed in range(6):
        scene = sparse_clutter(seed, path, n_obstacles=2, planar=planar).scene
        still = adapt(skill, scene, tool_radius=RADIUS, forbidden=forbidden)
        zero = Scene(None, [replace(o, velocity=np.zeros(3)) for o in scene.obstacles])
        other = adapt(skill, zero, tool_radius=RADIUS, forbidden=forbidden)
        np.testing.assert_array_equal(still.trajectory.positions, other.trajectory.positions)
        assert still.certified_clearance == other.certified_clearance


def test_mirrored_scenes_get_mirrored_clearances():
    """A skill that is symmetric about y = 0: an obstacle from the left is as hard as one from the right."""
    skill, path = learn(planar=True)
    middle = path[200]
    for speed in (0.1, 0.3, 0.6):
        clearances = []
        for side in (1.0, -1.0):
            velocity = np.array([0.0, side * speed, 0.0])
            ball = Sphere(middle - velocity * skill.duration_ / 2, 0.03, velocity=velocity)
            adaptation = adapt(skill, Scene(None, [ball]), tool_radius=RADIUS, forbidden=HORIZONTAL_ONLY)
            assert adaptation.feasible
            clearances.append(clearance_in_time(Scene(None, [ball]), adaptation.trajectory, RADIUS))
        assert min(clearances) >= CLEARANCE - 1e-9


def test_an_obstacle_that_leaves_in_time_bends_nothing(learned):
    _, skill, path = learned
    gone = Sphere(path[-80] - [0.0, 0.0, 0.0], 0.03, velocity=[0.0, 0.0, 1.0])
    adaptation = adapt(skill, Scene(None, [gone]), tool_radius=RADIUS)
    assert adaptation.feasible and not adaptation.moved.any()
    assert adapt(skill, Scene(None, [replace(gone, velocity=0)]), tool_radius=RADIUS).nominal is not None


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "hull"])
def test_an_obstacle_that_rotates_is_avoided_however_it_stands(kind):
    skill, path = learn(planar=False)
    rng = np.random.default_rng(5)
    centre = path[200] + [0.0, 0.0, 0.01]
    pose, spin = Pose(centre, [1, 0, 0, 0]), [0.4, 0.0, 1.5]
    obstacle = {
        "box": Box(pose, [0.16, 0.02, 0.02], angular_velocity=spin),
        "cylinder": Cylinder(pose, 0.01, 0.16, angular_velocity=spin),
        "capsule": Capsule(centre - [0.08, 0, 0], centre + [0.08, 0, 0], 0.01, angular_velocity=spin),
        "hull": ConvexHull(centre + rng.normal(size=(9, 3)) * [0.05, 0.01, 0.01], angular_velocity=spin),
    }[kind]
    adaptation = adapt(skill, Scene(None, [obstacle]), tool_radius=0.01, clearance=0.005)
    assert adaptation.feasible and adaptation.moved.any()
    assert "may rotate in any way" in adaptation.validity
    times = np.linspace(0.0, skill.duration_, 800)
    points, _ = adaptation.trajectory.at(times)
    measured = min(float(obstacle.after(t).signed_distance(p)) for t, p in zip(times, points, strict=True)) - 0.01
    assert measured >= 0.005 - 1e-9
    assert adaptation.certified_clearance <= measured + 1e-9


def test_a_floor_is_an_obstacle_like_others():
    skill, path = learn(planar=False)
    low = float(path[:, 2].min())
    spheres = [Sphere(path[150], 0.04), Sphere(path[250], 0.04)]
    above = adapt(skill, Scene(None, [HalfSpace([0, 0, low - 0.03]), *spheres]), tool_radius=0.02, clearance=0.005)
    assert above.feasible and above.trajectory.positions[:, 2].min() >= low - 0.03 + 0.025 - 1e-9
    bump = HalfSpace([0.0, path[100, 1] - 0.004, 0.0], [0.0, -1.0, 0.0])  # a wall that the path would touch
    beside = adapt(skill, Scene(None, [bump]), tool_radius=0.0, clearance=0.001)
    assert beside.feasible and beside.moved.any()
    assert (bump.signed_distance(beside.trajectory.positions) >= 0.001).all()
    with pytest.raises(InputError, match="rotates"):
        adapt(skill, Scene(None, [HalfSpace([0, 0, -1.0], angular_velocity=[1, 0, 0])]), tool_radius=0.0)
