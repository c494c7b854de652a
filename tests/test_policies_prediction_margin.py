"""Margins for the error of predicted obstacles: the distance grows with time; without a margin nothing changes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import ArmModel, InputError, Pose, Scene, Skill, Sphere, adapt, find_posture, replan
from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import random_obstacle
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.arm_path import ArmPath
from imitarm.perception import CoverageMargin
from imitarm.policies import HORIZONTAL_ONLY
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.prediction_margin import EstimatedMargin, PredictionMargin, margins_in
from imitarm.robots import SimulatedRobot
from imitarm.trajectory import Demonstration, Trajectory
from scene_shapes import coal_distances

RADIUS, CLEARANCE = 0.02, 0.02


@lru_cache
def learned(planar):
    return learn(planar=planar)


def crossing(rng, path, duration, planar):
    """An obstacle that meets the tool somewhere on its path, from any side, at 0.1 to 0.6 m/s."""
    at = int(rng.uniform(0.25, 0.75) * (len(path) - 1))
    velocity = rng.normal(size=3) * ([1, 1, 0] if planar else [1, 1, 1])
    velocity *= rng.uniform(0.1, 0.6) / np.linalg.norm(velocity)
    start = path[at] - at / (len(path) - 1) * duration * velocity
    return replace(random_obstacle(rng, start, planar=planar), velocity=velocity)


def lacking(scene, plan, margin, horizon, radius, n=1500):
    """The smallest distance minus the margin of that time, when each obstacle is where it is then."""
    times = np.linspace(0.0, plan.trajectory.times[-1], n)
    points, _ = plan.trajectory.at(times)
    kept = margin.at(np.minimum(times, np.inf if horizon is None else horizon))
    return min((o.signed_distance(points - times[:, None] * o.velocity) - kept).min() for o in scene.obstacles) - radius


@settings(max_examples=150)
@given(
    seed=st.integers(0, 10**6),
    planar=st.booleans(),
    offset=st.floats(0.0, 0.02),
    growth=st.floats(0.0, 0.03),
    horizon=st.none() | st.floats(0.0, 3.0),
)
def test_the_tool_keeps_clearance_and_margin_at_all_times(seed, planar, offset, growth, horizon):
    skill, path = learned(planar)
    rng = np.random.default_rng(seed)
    scene = Scene(None, [crossing(rng, path, skill.duration_, planar) for _ in range(1 + seed % 3)])
    margin = CoverageMargin(offset, growth)
    forbidden = HORIZONTAL_ONLY if planar else ()
    options = {"tool_radius": RADIUS, "clearance": CLEARANCE, "forbidden": forbidden}
    plan = adapt(skill, scene, margin=margin, margin_horizon=horizon, **options)
    measured = lacking(scene, plan, margin, horizon, RADIUS)
    assert plan.certified_clearance <= measured + 1e-9
    if plan.feasible:
        assert measured >= CLEARANCE - 1e-9
    if offset + growth > 0.0:
        assert plan.only_on_schedule
        assert "is wrong by at most" in plan.validity


def test_most_scenes_have_a_path_and_it_is_clear_by_another_library_too():
    skill, path = learned(planar=False)
    margin, accepted = CoverageMargin(0.005, 0.01), 0
    for seed in range(12):
        rng = np.random.default_rng([7, seed])
        scene = Scene(None, [crossing(rng, path, skill.duration_, False)])
        plan = adapt(skill, scene, tool_radius=RADIUS, clearance=CLEARANCE, margin=margin)
        if not plan.feasible:
            continue
        accepted += 1
        times = np.linspace(0.0, plan.trajectory.times[-1], 300)
        points, _ = plan.trajectory.at(times)
        obstacle = scene.obstacles[0]
        distances = coal_distances(replace(obstacle, velocity=0), points - times[:, None] * obstacle.velocity)
        assert (distances - RADIUS >= CLEARANCE + margin.at(times) - 1e-6).all()
    assert accepted >= 10


@pytest.mark.parametrize("spheres", [[[0.0, 0.0, 0.0, 0.02], [0.0, 0.0, -0.06, 0.02]]])
def test_a_tool_of_several_spheres_that_rotates_keeps_the_margin(spheres):
    skill, _, _ = carrying("sawyer")
    nominal = skill.generate()
    middle, _ = nominal.at([0.5 * nominal.duration])
    velocity = np.array([0.2, 0.0, 0.1])
    ball = Sphere(middle[0] - 0.5 * nominal.duration * velocity, 0.04, velocity=velocity)
    margin = CoverageMargin(0.004, 0.008)
    plan = adapt(skill, Scene(None, [ball]), tool_spheres=spheres, margin=margin)
    assert plan.feasible and plan.moved.any()
    for time in np.linspace(0.0, plan.trajectory.duration, 700):
        positions, quaternions = plan.trajectory.at([time])
        centres = Pose(positions[0], quaternions[0]).apply(np.array(spheres)[:, :3])
        away = ball.after(time).signed_distance(centres) - 0.02
        assert away.min() >= 0.02 + margin.at(time) - 1e-9


ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
OPTIONS = {"max_tilt": np.deg2rad(30.0)}


@lru_cache
def carrying(name):
    """A skill that carries the tool to the side, and the posture in which it starts."""
    arm, rng = ARMS[name], np.random.default_rng(0)
    home, u = arm.tool_pose(arm.home), np.linspace(0.0, 1.0, 100)
    rise = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    shown = []
    for _ in range(4):
        positions = home.position + np.outer(rise, np.array([0.02, 0.4, -0.05]) + 0.01 * rng.normal(size=3))
        rotations = np.tile(home.quaternion, (len(u), 1))
        shown.append(Demonstration(Trajectory(4.0 * u, positions, rotations), task="carry"))
    skill = Skill(8).fit(shown)
    return skill, arm, find_posture(arm, Pose(skill.start_.position, skill.start_.quaternion))


def at(arm, q, velocity=None):
    still = np.zeros(arm.n_joints)
    return ArmState(np.asarray(q), still if velocity is None else velocity, still, 0.0)


def crossing_the_arm(arm, rng, duration):
    """A small obstacle that crosses the learned path near the tool, at 0.1 to 0.4 m/s, and stays away from the base."""
    home = arm.tool_pose(arm.home).position
    while True:
        share = rng.uniform(0.3, 0.7)
        velocity = rng.normal(size=3)
        velocity *= rng.uniform(0.1, 0.4) / np.linalg.norm(velocity)
        place = home + share * np.array([0.02, 0.4, -0.05]) + 0.06 * rng.normal(size=3)
        start = place - share * duration * velocity
        if np.linalg.norm(start[:2] + np.linspace(0.0, duration, 20)[:, None] * velocity[:2], axis=1).min() > 0.3:
            return Sphere(start, rng.uniform(0.02, 0.04), velocity=velocity, track_id=0)


def simulator_distances(arm, scene, plan, n=150):
    """Distances of the arm to the moving obstacles by the simulator, at n times of a plan."""
    robot = SimulatedRobot(arm, scene=scene, q=plan.joints[0])
    times = np.linspace(0.0, plan.trajectory.times[-1], n)
    found = []
    for time in times:
        q = np.array([np.interp(time, plan.trajectory.times, column) for column in plan.joints.T])
        robot.data.qpos[:] = arm.posture(robot.model, q)
        positions, quaternions = scene.poses(scene.stamp + time)
        robot.data.mocap_pos[:], robot.data.mocap_quat[:] = positions, quaternions
        mujoco.mj_kinematics(robot.model, robot.data)
        found.append(robot.clearance())
    return times, np.array(found)


@pytest.mark.parametrize("name", ARMS)
def test_the_whole_arm_keeps_clearance_and_margin_by_the_simulators_geometry(name):
    skill, arm, start = carrying(name)
    margin, accepted, moved = CoverageMargin(0.005, 0.01), 0, 0
    for seed in range(10):
        rng = np.random.default_rng([3, seed])
        scene = Scene(None, [crossing_the_arm(arm, rng, skill.duration_) for _ in range(1 + seed % 2)])
        plan = adapt(skill, scene, arm=arm, state=at(arm, start), margin=margin, **OPTIONS)
        if not plan.feasible:
            continue
        accepted, moved = accepted + 1, moved + plan.moved.any()
        times, distances = simulator_distances(arm, scene, plan)
        assert (distances >= 0.02 + margin.at(times) - 1e-6).all(), seed
        assert plan.certified_clearance <= (distances - margin.at(times)).min() + 1e-6
    assert accepted >= 6 and moved >= 3


def test_planning_again_keeps_the_margin_from_now_on():
    skill, arm, start = carrying("sawyer")
    rng = np.random.default_rng(1)
    scene = Scene(None, [crossing_the_arm(arm, rng, skill.duration_)])
    margin = CoverageMargin(0.005, 0.01)
    plan = adapt(skill, scene, arm=arm, state=at(arm, start), margin=margin, **OPTIONS)
    assert plan.feasible, plan.reason
    for share in (0.2, 0.5):
        phase = share * plan.trajectory.duration

        def joints(time):
            return np.array([np.interp(time, plan.trajectory.times, column) for column in plan.joints.T])

        state = at(arm, joints(phase), (joints(phase + 1e-3) - joints(phase - 1e-3)) / 2e-3)
        seen = Scene(None, scene.at(phase).obstacles)
        again = replan(plan, seen, arm=arm, state=state, phase=phase, margin=margin, **OPTIONS)
        assert again.feasible, again.reason
        times, distances = simulator_distances(arm, seen, again)
        assert (distances >= 0.02 + margin.at(times) - 1e-6).all()


@pytest.mark.parametrize("name", ARMS)
def test_no_path_is_nearer_than_the_bound_with_margins(name):
    arm = ARMS[name]
    for seed in range(40):
        rng = np.random.default_rng(seed)
        start = arm.home + 0.5 * rng.normal(size=7)
        joints = np.linspace(start, start + rng.choice([0.1, 0.4, 1.0]) * rng.normal(size=7), 6)
        path, times = ArmPath.of(arm, joints), np.linspace(0.0, 1.0, 6)
        centre = path.centers[rng.integers(6), rng.integers(path.centers.shape[1])] + 0.3 * rng.normal(size=3)
        obstacle = replace(random_obstacle(rng, centre, planar=False), velocity=0.3 * rng.normal(size=3))
        margin = PredictionMargin(rng.uniform(0.0, 0.02), rng.uniform(0.0, 0.3), rng.choice([0.3, 0.5, np.inf]))
        bound = ArmAmongObstacles(arm, [obstacle], 0.01, margins=[margin]).clearance_of(path, times)
        lowest = np.inf
        for time in np.linspace(0.0, 1.0, 150):
            q = np.array([np.interp(time, times, column) for column in joints.T])
            centers, radii = arm.collision_spheres(q)
            away = (obstacle.after(time).signed_distance(centers) - radii).min()
            lowest = min(lowest, float(away - 0.01 - margin.at(np.array(time))))
        if bound.room >= 0.0:
            assert bound.room <= lowest + 1e-9, seed
        elif lowest > 2e-3:
            pytest.fail(f"{seed}: clear by {lowest:.4f} m, but not proven")


def test_without_a_margin_and_with_a_margin_of_zero_everything_is_the_same():
    skill, path = learned(planar=False)
    rng = np.random.default_rng(2)
    scene = Scene(None, [crossing(rng, path, skill.duration_, False) for _ in range(2)])
    one = adapt(skill, scene, tool_radius=RADIUS)
    two = adapt(skill, scene, tool_radius=RADIUS, margin=CoverageMargin(0.0, 0.0), margin_horizon=1.0)
    assert one.trajectory.positions.tobytes() == two.trajectory.positions.tobytes()
    assert one.certified_clearance == two.certified_clearance
    assert (one.validity, one.reason) == (two.validity, two.reason)
    carry, arm, start = carrying("panda")
    scene = Scene(None, [crossing_the_arm(arm, rng, carry.duration_)])
    one = adapt(carry, scene, arm=arm, state=at(arm, start), **OPTIONS)
    two = adapt(carry, scene, arm=arm, state=at(arm, start), margin=CoverageMargin(0.0, 0.0), **OPTIONS)
    assert one.joints.tobytes() == two.joints.tobytes()
    assert one.trajectory.times.tobytes() == two.trajectory.times.tobytes()


def test_only_obstacles_that_are_estimated_have_a_margin():
    known = Sphere([0.5, 0.0, 0.0], 0.03)
    scene = Scene(
        None,
        [
            known,
            replace(known, track_id=3),
            replace(known, covariance=1e-4 * np.eye(3)),
            replace(known, velocity=[0.1, 0.0, 0.0]),
        ],
        stamp=2.0,
    )
    around = margins_in(scene, CoverageMargin(0.01, 0.1), None)
    assert around[0] is None
    assert all(margin == PredictionMargin(0.01, 0.1) for margin in around[1:])
    assert margins_in(scene, None, None) == (None,) * 4


def test_the_margin_counts_from_when_the_obstacle_was_seen():
    ball = Sphere([0.5, 0.0, 0.0], 0.03, velocity=[0.1, 0.0, 0.0])
    later = Scene(None, [ball], stamp=1.0).at(1.25)
    (margin,) = margins_in(later, CoverageMargin(0.01, 0.1), 0.5)
    assert margin is not None
    np.testing.assert_allclose(margin.at(np.array([0.0, 0.1, 0.25, 2.0])), [0.035, 0.045, 0.06, 0.06])
    np.testing.assert_array_equal(margin.slopes_after(np.array([0.1, 0.25])), [0.1, 0.0])
    np.testing.assert_array_equal(margin.slopes_before(np.array([0.1, 0.25, 0.3])), [0.1, 0.1, 0.0])
    (long_ago,) = margins_in(later, CoverageMargin(0.01, 0.1), 0.2)
    assert long_ago is not None
    np.testing.assert_allclose(long_ago.at(np.array([0.0, 5.0])), [0.03, 0.03])


def test_a_refusal_says_that_the_margin_is_missing():
    skill, path = learned(planar=False)
    goal = Sphere(path[-1] + [0.0, 0.0, 0.08], 0.03, track_id=1, name="cup")
    scene = Scene(None, [goal])
    assert adapt(skill, scene, tool_radius=RADIUS, clearance=0.01).feasible
    plan = adapt(skill, scene, tool_radius=RADIUS, clearance=0.01, margin=CoverageMargin(0.01, 0.05))
    assert not plan.feasible
    assert "beyond the margin for its prediction" in plan.reason


def test_a_margin_that_is_none_is_rejected():
    skill, _ = learned(planar=False)
    far = Scene(None, [Sphere([9.0, 0.0, 0.0], 0.1, track_id=1)])
    with pytest.raises(InputError, match="margin"):
        adapt(skill, far, tool_radius=RADIUS, margin=0.1)
    with pytest.raises(InputError, match="margin_horizon"):
        adapt(skill, far, tool_radius=RADIUS, margin=CoverageMargin(0.01), margin_horizon=-1.0)


def test_the_margin_of_an_estimate_grows_with_the_speed_of_the_obstacle():
    margin, times = EstimatedMargin(2.0, 0.02, 0.5, 0.06), np.array([0.0, 0.1, 0.2, 2.0])
    covariance = np.diag([1e-6, 9e-6, 4e-6])
    known = Sphere([0.5, 0.0, 0.0], 0.03, velocity=[0.3, 0.4, 0.0])
    rests = Sphere([0.5, 0.0, 0.0], 0.03, covariance=covariance)
    moves = Sphere([0.5, 0.0, 0.0], 0.03, velocity=[0.3, 0.4, 0.0], covariance=covariance)
    turns = Sphere([0.5, 0.0, 0.0], 0.1, angular_velocity=[0.0, 0.0, 4.0], covariance=100.0 * covariance)
    found = margin.at(Scene(None, [known, rests, moves, turns]).packed, times)
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_allclose(found[1], 0.006)
    np.testing.assert_allclose(found[2], [0.006, 0.031, 0.056, 0.066])
    np.testing.assert_allclose(found[3], [0.02, 0.04, 0.06, 0.08])
    np.testing.assert_array_equal(margin.at(Scene(None, [known]).packed, times), np.zeros((1, 4)))
