from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.robots import ROBOTS, SimulatedRobot
from imitarm.scene import Box, HalfSpace, Scene, Sphere, Track

DT = 0.01
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
AMPLITUDE = np.array([0.5, 0.3, 0.4, 0.3, 0.5, 0.5, 0.8])  # [rad/s]


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("sawyer", tool="brush")


def wave(k):
    return AMPLITUDE * np.sin(np.pi * k * DT)


def wall_ahead(robot, gap=0.05):
    """A box that the tool runs into when it moves along x."""
    tip = robot.arm.tool_pose(robot.arm.home).position
    return Box(Pose(tip + np.array([gap + 0.15, 0.0, 0.0]), UPRIGHT), size=[0.2, 0.3, 0.4], name="wall")


@pytest.mark.parametrize("control", ["position", "torque"])
def test_it_follows_velocity_commands(arm, control):
    robot = SimulatedRobot(arm, control=control)
    lag, speed, tip = [], [], []
    for k in range(200):
        state = robot.move(wave(k), DT)
        lag.append(np.abs(state.q - robot.set_point))
        speed.append(np.abs(state.velocity - robot.velocity))
        away = arm.tool_pose(state.q).position - arm.tool_pose(robot.set_point).position
        tip.append(np.linalg.norm(away))
    assert np.max(lag) < 0.5e-3
    assert np.max(speed) < 0.03
    assert np.max(tip) < 0.5e-3
    assert robot.clamped == ()


@pytest.mark.parametrize("name, tool", [("sawyer", None), ("panda", "gripper")])
def test_a_standing_arm_carries_its_weight(name, tool):
    arm = ArmModel.load(name, tool=tool)
    robot = SimulatedRobot(arm)
    np.testing.assert_allclose(robot.state().torque, arm.gravity_torque(arm.home), atol=1e-3)
    for _ in range(100):
        state = robot.move(np.zeros(7), DT)
    np.testing.assert_allclose(state.q, arm.home, atol=1e-4)
    np.testing.assert_allclose(robot.tool_to_base.position, arm.tool_pose(state.q).position, atol=1e-6)
    assert state.time == pytest.approx(1.0)


def test_the_same_commands_give_the_same_motion_also_after_a_reset(arm):
    scene = Scene(None, (Sphere([0.5, -0.6, 0.2], 0.05),))
    first, second = SimulatedRobot(arm, scene=scene), SimulatedRobot(arm, scene=scene)

    def run(robot):
        return [(s.q, s.torque, robot.clearance()) for s in (robot.move(wave(k), DT) for k in range(40))]

    once, again = run(first), run(second)
    first.reset()
    for a, b, c in zip(once, again, run(first), strict=True):
        for x, y, z in zip(a, b, c, strict=True):
            np.testing.assert_array_equal(x, y)
            np.testing.assert_array_equal(x, z)


def test_no_drive_gives_more_than_its_rated_torque(arm):
    robot = SimulatedRobot(arm)
    tip = robot.tool_to_base.position
    blocked = SimulatedRobot(arm, scene=Scene(None, (wall_ahead(robot, gap=0.04),)))
    jacobian = arm.tool_jacobian(arm.home)
    peak = np.zeros(7)
    while not blocked.fault:
        state = blocked.move(np.linalg.pinv(jacobian) @ [0.2, 0, 0, 0, 0, 0], DT)
        peak = np.maximum(peak, np.abs(state.torque))
        assert state.time < 5.0
    assert np.all(peak <= arm.max_torque + 1e-9)
    assert np.any(peak > 0.9 * arm.max_torque)  # it did push
    assert tip[0] < blocked.tool_to_base.position[0]


def test_obstacles_are_solid_and_a_touch_is_noted_by_name(arm):
    free = SimulatedRobot(arm)
    robot = SimulatedRobot(arm, scene=Scene(None, (wall_ahead(free),)))
    before = robot.clearance()
    assert 0.0 < before < 0.05
    velocity = np.linalg.pinv(arm.tool_jacobian(arm.home)) @ [0.2, 0, 0, 0, 0, 0]
    for _ in range(60):
        robot.move(velocity, DT)
    assert robot.contact_steps > 0
    assert {obstacle for _, obstacle in robot.contacts} == {'box "wall"'}
    assert robot.nearest_pair() in robot.contacts
    assert -0.005 < robot.clearance() <= 0.001  # leans on it, is not inside
    assert robot.report()["contacts"] == robot.contacts
    robot.reset()
    assert not robot.contacts
    assert robot.fault == ""
    assert robot.clearance() == pytest.approx(before, abs=1e-9)


def test_clearance_is_the_distance_from_the_nearest_link(arm):
    tip = arm.tool_pose(arm.home).position
    ball = Sphere(tip - [0.0, 0.0, 0.15], 0.05)
    robot = SimulatedRobot(arm, scene=Scene(None, (ball, Sphere([0.0, 1.5, 0.0], 0.1))))
    assert robot.clearance() == pytest.approx(0.10, abs=0.03)  # below the bristles, which are not at the tip itself
    assert robot.nearest_pair()[1] == "sphere 1"
    assert SimulatedRobot(arm).clearance() == np.inf
    assert SimulatedRobot(arm).nearest_pair() is None


def test_obstacles_move_with_their_velocity(arm):
    ball = Sphere([0.8, 0.5, 0.1], 0.05, velocity=[0.0, 0.2, 0.1])
    robot = SimulatedRobot(arm, scene=Scene(None, (ball,)))
    start = robot.clearance()
    for _ in range(50):
        robot.move(np.zeros(7), DT)
    np.testing.assert_allclose(robot.scene.obstacles[0].center, [0.8, 0.6, 0.15], atol=1e-9)
    np.testing.assert_allclose(robot.data.body("obstacle/0").xpos, [0.8, 0.6, 0.15], atol=1e-3)
    assert robot.clearance() > start + 0.02


def test_an_obstacle_follows_any_function_of_time(arm):
    def circling(t):
        return np.array([0.9 + 0.1 * np.cos(2 * t), 0.5 + 0.1 * np.sin(2 * t), 0.3])

    def spinning(t):
        return Pose(np.array([0.0, 0.9, 0.4]), quaternion_exp([0.0, 0.0, 3.0 * t]))

    stick = Box(Pose.identity(), [0.3, 0.02, 0.02])
    scene = Scene(None, (Sphere([0, 0, 2.0], 0.05, name="ball"), stick, Sphere([0.5, 2, 0], 0.1, velocity=[0.1, 0, 0])))
    robot = SimulatedRobot(arm, scene=scene, motion={"ball": circling, 1: spinning})
    for _ in range(3):
        seen = robot.scene
        assert seen.stamp == pytest.approx(robot.time)
        np.testing.assert_allclose(seen.obstacles[0].center, circling(robot.time), atol=1e-9)
        np.testing.assert_allclose(seen.obstacles[0].velocity, 0.2 * tangent(2 * robot.time), atol=1e-6)
        np.testing.assert_allclose(seen.obstacles[1].pose.rotation, spinning(robot.time).rotation, atol=1e-9)
        np.testing.assert_allclose(seen.obstacles[1].angular_velocity, [0, 0, 3.0], atol=1e-6)
        np.testing.assert_allclose(seen.obstacles[2].center, [0.5 + 0.1 * robot.time, 2, 0], atol=1e-9)
        np.testing.assert_allclose(robot.data.body("obstacle/0").xpos, circling(robot.time), atol=2e-3)
        for _k in range(20):
            robot.move(np.zeros(7), DT)
    robot.reset()
    np.testing.assert_allclose(robot.data.body("obstacle/0").xpos, circling(0.0), atol=1e-9)


def test_a_second_robot_shows_the_state_of_the_first(arm):
    scene = Scene(None, (Sphere([0.9, 0.5, 0.3], 0.05, velocity=[0.0, -0.1, 0.0]), Sphere([0.9, 0, 0.9], 0.1)))
    one, other = (SimulatedRobot(arm, scene=scene, motion={1: lambda t: [0.9, 0.1 * t, 0.9]}) for _ in range(2))
    for _ in range(30):
        one.move(0.3 * np.ones(7), DT)
    shown = other.show(one.state().q, one.time)
    assert shown.time == one.time and not shown.velocity.any()
    np.testing.assert_array_equal(shown.q, one.state().q)
    np.testing.assert_allclose(other.data.geom_xpos, one.data.geom_xpos, atol=1e-9)
    np.testing.assert_array_equal(other.scene.packed.positions, one.scene.packed.positions)
    assert other.clearance() == pytest.approx(one.clearance(), abs=1e-9)
    other.move(np.zeros(7), DT)  # the shown state is also a start for a motion
    assert np.abs(other.state().velocity).max() < 0.05
    with pytest.raises(InputError, match="show: q"):
        other.show(np.zeros(3), 0.0)
    with pytest.raises(InputError, match="show: time"):
        other.show(arm.home, np.nan)


def tangent(angle):
    return np.array([-np.sin(angle), np.cos(angle), 0.0])


def test_an_obstacle_follows_a_recorded_track(arm):
    track = Track([0.0, 0.1, 0.3], [[0.9, 0.5, 0.3], [0.9, 0.6, 0.3], [0.9, 0.6, 0.5]])
    scene = Scene(None, (Sphere([0, 0, 2.0], 0.05),))
    robot = SimulatedRobot(arm, scene=scene, motion={0: track})
    for _ in range(20):
        robot.move(np.zeros(7), DT)
    np.testing.assert_allclose(robot.scene.obstacles[0].center, [0.9, 0.6, 0.4], atol=1e-9)
    np.testing.assert_allclose(robot.scene.obstacles[0].velocity, [0, 0, 1.0], atol=1e-9)
    for _ in range(20):
        robot.move(np.zeros(7), DT)
    np.testing.assert_allclose(robot.scene.obstacles[0].velocity, 0.0, atol=1e-9)


def test_a_wrong_motion_is_refused(arm):
    scene = Scene(None, (Sphere([0, 0, 2.0], 0.05, name="ball"),))
    for motion, message in (
        ({"bal": np.zeros}, "no obstacle 'bal'"),
        ({3: np.zeros}, "no obstacle 3"),
        ({"ball": [0, 0, 1]}, "must be a function of time"),
        ({"ball": lambda t: [t, np.nan, 0]}, "position of obstacle 0 at 0 s"),
        ({"ball": lambda t: "there"}, "position of obstacle 0"),
    ):
        with pytest.raises(InputError, match=message):
            SimulatedRobot(arm, scene=scene, motion=motion)
    for times, positions in (([0, 0], np.zeros((2, 3))), ([0, 1], np.zeros((3, 3))), ([0, np.nan], np.zeros((2, 3)))):
        with pytest.raises(InputError, match="Track"):
            Track(times, positions)


@pytest.mark.parametrize("name, tool", [("sawyer", "gripper"), ("panda", "gripper"), ("sawyer", "brush")])
def test_self_contact_is_a_contact(name, tool):
    arm = ArmModel.load(name, tool=tool)
    robot = SimulatedRobot(arm)
    assert robot.scene.obstacles == ()
    rng = np.random.default_rng(0)
    for _ in range(500):  # a posture in which two links overlap
        robot.reset(rng.uniform(arm.lower, arm.upper))
        if robot.clearance() < -0.02:
            break
    folded = robot.state().q
    robot.reset()
    assert robot.clearance() == np.inf
    assert not robot.contacts
    while not robot.contacts and not robot.fault and robot.time < 20.0:
        robot.move(np.clip(folded - robot.set_point, -0.5, 0.5), DT)
    assert robot.contacts
    first, second = next(iter(robot.contacts))
    assert first != second
    assert robot.report()["contact_steps"] > 0
    assert robot.clearance() < np.inf


def test_floor_and_pedestal_belong_to_the_scene_and_count_for_contact(arm):
    robot = SimulatedRobot(arm)
    assert [fixture.name for fixture in robot.scene.fixtures] == ["floor", "pedestal"]
    assert {"floor", "pedestal"} <= {robot.model.geom(i).name for i in range(robot.model.ngeom)}
    high = robot.tool_to_base.position[2] - 0.1
    table = HalfSpace([0, 0, high], name="table top")
    robot = SimulatedRobot(arm, scene=Scene(fixtures=[table]))
    assert robot.scene.fixtures == (table,)
    assert robot.clearance() == np.inf  # what is measured is the distance to obstacles
    velocity = np.linalg.pinv(arm.tool_jacobian(arm.home)) @ [0, 0, -0.2, 0, 0, 0]
    for _ in range(80):
        robot.move(velocity, DT)
    assert {second for _, second in robot.contacts} == {"table top"}


def test_left_alone_a_guided_arm_stays_and_a_pull_leads_it(arm):
    robot = SimulatedRobot(arm)
    start = robot.tool_to_base.position
    for _ in range(50):
        robot.guide(np.zeros(6), DT)
    np.testing.assert_allclose(robot.tool_to_base.position, start, atol=1e-3)
    for _ in range(50):
        robot.guide([0.0, 15.0, 0.0, 0.0, 0.0, 0.0], DT)
    assert robot.tool_to_base.position[1] - start[1] > 0.02
    np.testing.assert_array_equal(robot.set_point, robot.state().q)
    held = robot.move(np.zeros(7), DT).q  # and servos hold it again where it was led to
    for _ in range(50):
        robot.move(np.zeros(7), DT)
    np.testing.assert_allclose(robot.state().q, held, atol=0.02)


def test_an_arm_from_elsewhere_without_the_collision_group_has_clearance(tmp_path):
    path = tmp_path / "two.xml"
    path.write_text("""<mujoco model="two"><worldbody><body name="base"><geom size="0.05"/>
      <body name="upper" pos="0 0 0.1"><joint name="a" axis="0 1 0" range="-120 120" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03"/>
      <body name="fore" pos="0 0 0.3"><joint name="b" axis="0 1 0" range="-120 120" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03"/></body></body></body></worldbody></mujoco>""")
    arm = ArmModel.load(path)
    robot = SimulatedRobot(arm, scene=Scene(None, (Sphere([0.0, 0.0, 1.0], 0.1),)), q=[0.0, 0.0])
    assert robot.clearance() == pytest.approx(0.17, abs=1e-6)
    assert np.abs(robot.move([0.1, 0.0], DT).velocity[0]) > 0.05  # no rated torque: the drive is as strong as needed


@pytest.mark.parametrize(
    "options, error, message",
    [
        ({"control": "magic"}, UnknownNameError, "position, torque"),
        ({"timestep": 0.01}, InputError, "timestep must be a finite number above 0 and of at most 0.002"),
        ({"timestep": 0.0}, InputError, "timestep must be a finite number above 0 and of at most 0.002"),
        ({"q": np.zeros(6)}, InputError, "q must be 7 numbers"),
        ({"q": np.full(7, 9.0)}, InputError, "right_j0 at 9.0000 rad is outside"),
    ],
)
def test_bad_options_are_named(arm, options, error, message):
    with pytest.raises(error, match=message):
        SimulatedRobot(arm, **options)


def test_bad_commands_are_named(arm):
    robot = SimulatedRobot(arm)
    with pytest.raises(InputError, match=r"multiple of the timestep 0\.002"):
        robot.move(np.zeros(7), 0.005)
    with pytest.raises(InputError, match="wrench must be"):
        robot.guide([0.0, 0.0, np.nan, 0.0, 0.0, 0.0], DT)
    with pytest.raises(InputError, match="q must be finite"):
        robot.reset(np.full(7, np.nan))


def test_the_registry_knows_it():
    assert ROBOTS["simulated"] is SimulatedRobot


@pytest.mark.parametrize("control", ["position", "torque"])
def test_a_gripper_opens_and_closes_and_a_reset_forgets_it(control):
    robot = SimulatedRobot(ArmModel.load("sawyer", tool="gripper"), control=control)
    start = robot.opening
    robot.grasp(0.03)
    for _ in range(80):
        robot.move(np.zeros(7), DT)
    assert robot.opening == pytest.approx(0.03, abs=1e-3)
    with pytest.raises(InputError, match=r"between 0 and 0\.08 m, got 0\.2"):
        robot.grasp(0.2)
    robot.reset()
    for _ in range(20):
        robot.move(np.zeros(7), DT)
    assert robot.opening == pytest.approx(start, abs=1e-3)
    with pytest.raises(InputError, match="no gripper"):
        SimulatedRobot(ArmModel.load("sawyer")).grasp(0.03)
