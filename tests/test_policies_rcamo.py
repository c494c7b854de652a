"""RCAMO: the tool alone, moved exactly as commanded; distances are measured here, not by the policy."""

import dataclasses

import numpy as np
import pytest

from imitarm import SimulatedRobot, find_posture, reproduce
from imitarm.command import Status
from imitarm.demonstrations import align, read
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.perception import CoverageMargin
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN, POLICIES, RCAMO, DistanceCost, Observation
from imitarm.policies.least_cost import Response
from imitarm.scene import Box, HalfSpace, MovingScene, Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks import DEMONSTRATIONS, SweepTask
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import shown

REST = np.zeros(7)
TOOL = 0.03  # [m]


@pytest.fixture(scope="module")
def skill():
    return Skill(5).fit(shown(turn=None))


def observation(time, position, scene, quaternion=(1.0, 0.0, 0.0, 0.0)):
    pose = Pose(np.array(position), np.array(quaternion))
    return Observation(time, ArmState(REST.copy(), REST.copy(), REST.copy(), float(time)), pose, scene)


def follow(policy, observe, start, dt=0.01, longest=8.0):
    """Move the tool exactly as commanded; return the path, the statuses and whether the motion has finished."""
    x = np.array(start, dtype=float)
    policy.reset(observation(0.0, x, observe(0.0)))
    path, commands = [x], []
    for k in range(round(longest / dt)):
        now = observation(k * dt, x, observe(k * dt))
        if policy.finished(now):
            return np.array(path), commands, True
        commands.append(policy.step(now, dt))
        x = x + dt * commands[-1].twist[:3]
        path.append(x)
    return np.array(path), commands, False


def meeting(skill, rng, family):
    """A sphere that meets the tool in the middle part of the motion."""
    T = skill.duration_
    times = T * (rng.uniform(0.3, 0.7) + np.array([-0.01, 0.0, 0.01]))
    before, here, after = skill.nominal(times).positions
    along = (after - before) / np.linalg.norm(after - before)
    side = rng.standard_normal(3)
    side -= side @ along * along
    side /= np.linalg.norm(side)
    direction = {"static": 0.0 * along, "crossing": side, "oncoming": -along, "chasing": 1.5 * along}[family]
    velocity = rng.uniform(0.2, 0.5) * direction
    return Sphere(here - times[1] * velocity, rng.uniform(0.025, 0.045), velocity=velocity)


def gap(path, ball, dt=0.01):
    centers = ball.center + dt * np.arange(len(path))[:, None] * ball.velocity
    return np.linalg.norm(path - centers, axis=1) - ball.radius - TOOL


@pytest.mark.parametrize("family", ["static", "crossing", "oncoming", "chasing"])
def test_the_tool_evades_an_obstacle_that_would_meet_it_and_arrives(skill, family):
    for seed in range(3):
        ball = meeting(skill, np.random.default_rng([seed, 5]), family)
        scene = Scene(obstacles=[ball])
        policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]])
        path, commands, finished = follow(policy, lambda t, scene=scene: scene, skill.start_.position)
        nominal = skill.nominal(np.linspace(0.0, skill.duration_, 201)).positions
        assert gap(nominal, ball, skill.duration_ / 200).min() < 0.0
        assert finished and gap(path, ball).min() > 0.01
        assert np.linalg.norm(path[-1] - skill.goal_.position) < 0.003
        assert any(command.status is Status.AVOIDING and "sphere 1" in command.reason for command in commands)


def test_without_obstacles_it_follows_the_primitive(skill):
    path, commands, finished = follow(RCAMO(skill), lambda t: Scene(), skill.start_.position)
    nominal = skill.generate(dt=0.01).positions
    assert finished and np.abs(path[: len(nominal)] - nominal[: len(path)]).max() < 1e-4
    assert {command.status for command in commands} == {Status.NOMINAL}


def test_it_is_registered_and_resumes_from_any_state(skill):
    policy = POLICIES["rcamo"].build(skill, tool_spheres=None, clearance=0.02, forbidden=(), arm=None)
    away = skill.nominal([0.5 * skill.duration_, 0.6 * skill.duration_]).positions[0] + [0.0, 0.05, 0.0]
    policy.resume(observation(3.0, away, Scene()), 0.5)
    assert policy.phase == 0.5
    x, time = away, 3.0
    for _ in range(300):
        now = observation(time, x, Scene())
        if policy.finished(now):
            break
        x, time = x + 0.01 * policy.step(now, 0.01).twist[:3], time + 0.01
    assert policy.finished(observation(time, x, Scene()))


# ----- properties of the tool alone


@pytest.fixture(scope="module")
def symmetric():
    """A skill whose motion and tolerance are symmetric about the plane y = 0."""
    t = np.linspace(0.0, 2.0, 120)
    p = (t / 2.0) ** 3 * (10.0 + t / 2.0 * (3.0 * t - 15.0))
    bump = np.sin(np.pi * p)
    shown = [
        Demonstration(Trajectory(t, np.column_stack([0.3 + 0.4 * p, y * bump, 0.3 + z * bump])))
        for y in (-0.01, 0.01)
        for z in (0.05, 0.07)
    ]
    return Skill(4).fit(shown)


def test_a_mirrored_obstacle_gives_the_mirrored_motion(symmetric):
    mirror, sideways = np.array([1.0, -1.0, 1.0]), []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        here = symmetric.nominal([1.0, 1.1]).positions[0] + rng.uniform(-0.04, 0.04, 3)
        velocity = rng.uniform(-0.3, 0.3, 3) if seed else np.zeros(3)
        paths = []
        for sign in (np.ones(3), mirror):
            scene = Scene(obstacles=[Sphere(sign * (here - velocity), 0.04, velocity=sign * velocity)])
            policy = RCAMO(symmetric, tool_spheres=[[0.0, 0.0, 0.0, TOOL], [0.0, 0.0, -0.05, TOOL]])
            paths.append(follow(policy, lambda t, scene=scene: scene, symmetric.start_.position)[0])
        there, mirrored = paths
        assert there.shape == mirrored.shape
        np.testing.assert_allclose(there * mirror, mirrored, atol=1e-9)
        sideways.append(np.abs(there[:, 1]).max())
    assert max(sideways) > 0.01


def test_without_velocity_covariance_and_margin_the_answer_is_the_static_one_bit_for_bit(skill):
    here = skill.nominal([1.0, 1.1]).positions[0]
    plain, known = Sphere(here, 0.04), Sphere(here, 0.04, velocity=np.zeros(3), covariance=np.zeros((3, 3)))
    paths = [
        follow(
            RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]], margin=margin),
            lambda t, o=obstacle: Scene(obstacles=[o], stamp=-0.05),
            skill.start_.position,
        )[0]
        for obstacle, margin in ((plain, None), (known, None), (plain, CoverageMargin.none()))
    ]
    assert np.array_equal(paths[0], paths[1]) and np.array_equal(paths[0], paths[2])
    grown = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]], margin=CoverageMargin(0.01, 0.01))
    farther = follow(grown, lambda t: Scene(obstacles=[plain]), skill.start_.position)[0]
    assert gap(farther, plain).min() > gap(paths[0], plain).min() + 0.003
    unsure = Sphere(here, 0.04, covariance=0.01**2 * np.eye(3))
    wide = follow(
        RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]]), lambda t: Scene(obstacles=[unsure]), skill.start_.position
    )[0]
    assert gap(wide, plain).min() > gap(paths[0], plain).min() + 0.003


def test_an_obstacle_far_away_changes_nothing_bit_for_bit(skill):
    here = skill.nominal([1.0, 1.1]).positions[0]
    ball = Sphere(here - [0.0, 0.3, 0.0], 0.04, velocity=[0.0, 0.3, 0.0])
    far = [
        Box(Pose([50.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), [0.1, 0.1, 0.1], velocity=[0.3, 0.2, 0.0]),
        HalfSpace([0.0, 0.0, -50.0], [0.0, 0.0, 1.0]),
    ]
    for near in ([], [ball]):
        for cost in ("distance", "gaussian"):
            others = far if cost == "distance" else far[:1]
            paths = [
                follow(RCAMO(skill, cost=cost), lambda t, o=o: Scene(obstacles=o), skill.start_.position)[0]
                for o in (near, [*others, *near])
            ]
            assert np.array_equal(*paths)


def test_it_believes_the_observed_obstacle_and_not_the_true_one(skill):
    """The observed obstacle is beside the true one: the tool evades it, and meets the true one."""
    here = skill.nominal([1.0, 1.1]).positions[0]
    true, seen = Sphere(here, 0.03), Sphere(here + [0.0, 0.5, 0.0], 0.03)
    observed = follow(RCAMO(skill), lambda t: Scene(obstacles=[true]), skill.start_.position)[0]
    mistaken = follow(RCAMO(skill), lambda t: Scene(obstacles=[seen]), skill.start_.position)[0]
    assert gap(observed, true).min() + TOOL > 0.01 and gap(mistaken, true).min() + TOOL < 0.0


def test_a_policy_that_aims_at_the_obstacle_meets_it(skill):
    """A control: with the opposite sign of the cost, the same code meets every obstacle."""

    class Attracted(DistanceCost):
        def values(self, *arguments):
            return -np.minimum(super().values(*arguments), 5.0)

    for seed in range(3):
        ball = meeting(skill, np.random.default_rng([seed, 5]), "static")
        policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]])
        cost = policy.least_cost.obstacle_cost
        policy.least_cost = dataclasses.replace(policy.least_cost, obstacle_cost=Attracted(cost.clearance, cost.radii))
        path = follow(policy, lambda t, ball=ball: Scene(obstacles=[ball]), skill.start_.position)[0]
        assert gap(path, ball).min() < 0.0


def test_forbidden_directions_are_kept(skill):
    ball = meeting(skill, np.random.default_rng(1), "static")
    scene = Scene(obstacles=[ball])
    for forbidden, kept in ((HORIZONTAL_ONLY, np.abs), (NOT_DOWN, np.negative)):
        policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]], forbidden=forbidden)
        path, commands, finished = follow(policy, lambda t: scene, skill.start_.position)
        learned = np.array([policy._path.position(command.progress) for command in commands])
        assert finished and gap(path, ball).min() > 0.0
        assert kept(path[1:, 2] - learned[:, 2]).max() < 1e-3


# ----- waiting, the goal, the tool


def test_it_waits_for_an_obstacle_that_it_cannot_pass_and_goes_on_when_it_leaves(skill):
    middle = skill.nominal([1.0, 1.1]).positions[0]
    wall = Box(Pose(middle, [1.0, 0.0, 0.0, 0.0]), [0.05, 3.0, 3.0], name="gate")
    away = dataclasses.replace(wall, pose=Pose(middle + [0.0, 5.0, 0.0], [1.0, 0.0, 0.0, 0.0]))
    policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]])
    path, commands, finished = follow(
        policy, lambda t: Scene(obstacles=[wall if t < 5.0 else away]), skill.start_.position, longest=12.0
    )
    assert finished and wall.signed_distance(path[:500]).min() - TOOL > 0.0
    waiting = [c for c in commands[:500] if c.status is Status.WAITING]
    assert len(waiting) > 100 and 'box "gate"' in waiting[-1].reason


def test_an_obstacle_on_the_goal_keeps_it_from_finishing_and_one_beside_the_goal_does_not(skill):
    goal = skill.goal_.position
    on, beside = Sphere(goal, 0.03), Sphere(goal + [0.0, 0.0, 0.03 + 0.02 + TOOL + 1e-3], 0.03)
    for ball, arrives in ((on, False), (beside, True)):
        policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]])
        path, commands, finished = follow(policy, lambda t, o=ball: Scene(obstacles=[o]), skill.start_.position)
        assert finished is arrives and gap(path, ball).min() > 0.0
        if not arrives:
            assert commands[-1].status is Status.WAITING and "goal" in commands[-1].reason


def test_it_follows_a_moving_goal_without_a_jump(skill):
    first = skill.goal_.position

    def observe(t):
        return Scene(Pose(first + [0.0, 0.05 * min(t, 3.0), 0.0], [1.0, 0.0, 0.0, 0.0]))

    path, _, finished = follow(RCAMO(skill), observe, skill.start_.position, longest=8.0)
    assert finished and np.linalg.norm(path[-1] - observe(8.0).goal.position) < 0.003
    assert np.linalg.norm(np.diff(path, 2, axis=0), axis=1).max() / 0.01**2 < 5.0
    jump = [Pose(first + [0.0, y, 0.0], [1.0, 0.0, 0.0, 0.0]) for y in (0.0, 0.1)]
    path, _, finished = follow(RCAMO(skill), lambda t: Scene(jump[t > 1.9]), skill.start_.position)
    assert finished and np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.01


def test_the_whole_tool_evades_and_its_rotation_follows_the_learned_one():
    skill = Skill(5).fit(shown(turn=np.deg2rad(90.0)))
    spheres = np.array([[0.0, 0.0, 0.0, 0.02], [0.0, 0.12, 0.0, 0.03]])
    poses = skill.nominal(np.array([1.0, 1.1]))
    ball = Sphere(Pose(poses.positions[0], poses.quaternions[0]).apply(spheres[1, :3]), 0.03)
    scene = Scene(obstacles=[ball])
    for given, clear in ((spheres, True), (spheres[:1], False)):
        policy, x, q = RCAMO(skill, tool_spheres=given), skill.start_.position, skill.start_.quaternion
        policy.reset(observation(0.0, x, scene, q))
        least, turned = np.inf, 0.0
        for k in range(400):
            now = observation(0.01 * k, x, scene, q)
            if policy.finished(now):
                break
            centers = now.tool_to_base.apply(spheres[:, :3])
            least = min(least, float((ball.signed_distance(centers) - spheres[:, 3]).min()))
            learned = policy._path.quaternion(policy.phase)
            turned = max(turned, np.linalg.norm(now.tool_to_base.error_to(Pose(x, learned))[3:]))
            twist = policy.step(now, 0.01).twist
            x, q = x + 0.01 * twist[:3], quaternion_multiply(quaternion_exp(0.01 * twist[3:]), q)
        assert (least > 0.01) is clear and turned < np.deg2rad(1.0)


def test_invalid_options_are_refused(skill):
    for options in ({"cost": "square"}, {"gains": "soft"}, {"margin": 0.01}, {"beta": -1.0}, {"horizon": 0}):
        with pytest.raises(InputError):
            RCAMO(skill, **options)
    with pytest.raises(InputError, match="reset"):
        RCAMO(skill).step(observation(0.0, np.zeros(3), Scene()), 0.01)
    with pytest.raises(InputError, match="phase"):
        RCAMO(skill).resume(observation(0.0, np.zeros(3), Scene()), 1.5)
    with pytest.raises(InputError, match="half-space"):
        policy = RCAMO(skill, cost="gaussian")
        follow(policy, lambda t: Scene(obstacles=[HalfSpace([0, 0, 0], [0, 0, 1])]), skill.start_.position)


def test_a_simulated_arm_evades_an_obstacle_on_its_path():
    skill = Skill(12).fit(align(read(DEMONSTRATIONS)))
    task = SweepTask()
    arm = task.arm()
    here = skill.nominal([0.6 * skill.duration_, skill.duration_]).positions[0]
    scene = Scene(None, [Sphere(here + [0.0, 0.0, 0.02], 0.025, name="ball")])
    robot = SimulatedRobot(arm, scene=scene, world=task.world(arm), q=find_posture(arm, task.start))
    policy = RCAMO(skill, tool_spheres=arm.tool_spheres, forbidden=HORIZONTAL_ONLY, arm=arm)
    done = reproduce(policy, robot, MovingScene(scene).at, timeout=2.0 * skill.duration_)
    assert done.success, done.reason
    assert done.min_clearance > 0.02 and done.details["statuses"]["avoiding"] > 50


@pytest.mark.parametrize(("time_constant", "largest"), [(2.0, 1.15), (1.0, 0.29)])
def test_the_largest_deviation_is_that_of_the_documentation(skill, time_constant, largest):
    policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, 0.03]], time_constant=time_constant)
    held = Response.of(policy.gains, time_constant, np.array([50.0])).G[0] * policy.least_cost.max_push
    assert held == pytest.approx(largest, abs=0.005)
