"""Camera, detector and tracker as `observe`: obstacles are tracked, the arm is not, and a frozen camera shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm.control_loop import CameraObserver
from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import DepthNoise, Intrinsics, ObstacleDetector, ObstacleTracker
from imitarm.robots import SimulatedRobot
from imitarm.robots.depth_camera import DepthCamera
from imitarm.scene import Box, Scene, Sphere, standard_fixtures
from seen_scenes import looking

CAMERA = Intrinsics.from_field_of_view(160, 120, 1.0)
KINECT = {"nearest": 0.5, "farthest": 5.0, "noise": DepthNoise()}
EYE = looking([2.2, 0.8, 0.9], [0.2, 0.0, 0.3])


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("sawyer", tool="gripper")


def observer_of(robot, camera, *, surfaces=None, **options):
    surfaces = robot.scene.fixtures if surfaces is None else surfaces
    detector = ObstacleDetector(robot.arm, surfaces=surfaces)
    return CameraObserver(camera, detector, ObstacleTracker(), joints=lambda: robot.state().q, **options)


def swing(robot, t, dt, rng_phase):
    """One step of a motion of all joints around home, at up to 0.9 of the joints' speeds."""
    speed = 2.0 * np.pi * np.linspace(0.2, 0.4, robot.arm.n_joints)
    wanted = robot.arm.home + 0.35 * np.sin(speed * t + rng_phase) * min(1.0, t / 2.0)
    most = 0.9 * robot.arm.max_velocity
    robot.move(np.clip(0.3 * (wanted - robot.set_point) / dt, -most, most), dt)


@pytest.mark.slow
@pytest.mark.parametrize(("duration", "late"), [(60.0, 0.033), (15.0, -0.033)])
def test_no_track_appears_on_the_arm_in_a_minute_of_motion(arm, duration, late):
    """Joint stamps off by 33 ms, calibration off by 1 cm, a fixed camera with the noise of a Kinect."""
    robot = SimulatedRobot(arm)
    exact = DepthCamera(robot, CAMERA, EYE, **KINECT)
    off = np.array([0.6, -0.5, 0.62])

    def camera():
        frame = exact.frame()
        wrong = Pose(frame.camera_to_base.position + 0.01 * off / np.linalg.norm(off), frame.camera_to_base.quaternion)
        return replace(frame, stamp=frame.stamp + late, camera_to_base=wrong)

    observe = observer_of(robot, camera, rate=15.0)
    unfiltered = ObstacleDetector(None, surfaces=robot.scene.fixtures)
    dt, phase, in_view = 0.02, np.arange(7.0), 0
    for k in range(round(duration / dt)):
        swing(robot, k * dt, dt, phase)
        assert observe(k * dt).obstacles == ()
        if k % 500 == 0:
            in_view += len(unfiltered.detect(camera())) > 0
    assert observe.n_frames == 15 * duration
    assert in_view == np.ceil(duration / 10.0)


def test_a_camera_on_the_wrist_does_not_see_the_gripper_as_an_obstacle_but_a_ball(arm):
    mount = Pose([0.07, 0.0, -0.06], [1.0, 0.0, 0.0, 0.0])
    for scene, expected in ((Scene(), 0), (Scene(None, [Sphere([0.75, 0.1, -0.3], 0.08)]), 1)):
        robot = SimulatedRobot(arm, scene=scene)
        camera = DepthCamera(robot, CAMERA, mount, on_tool=True, nearest=0.1, farthest=3.0)
        detector = ObstacleDetector(arm, surfaces=robot.scene.fixtures, depth_range=(0.1, 3.0), noise=DepthNoise.none())
        observe = CameraObserver(camera.frame, detector, ObstacleTracker(), joints=lambda r=robot: r.state().q)
        for k in range(40):
            swing(robot, 0.02 * k, 0.02, np.zeros(7))
            found = observe(0.02 * k)
        assert len(found.obstacles) == expected
        if expected:
            assert np.linalg.norm(found.packed.positions[0] - scene.obstacles[0].center) < 0.02


def test_a_moving_ball_is_tracked_and_predicted_to_now(arm):
    ball = Sphere([0.7, -0.85, 0.4], 0.1, velocity=[0.0, 0.3, 0.0])
    robot = SimulatedRobot(arm, scene=Scene(None, [ball], stamp=100.0))
    camera = DepthCamera(robot, CAMERA, EYE, **KINECT)
    observe = observer_of(robot, camera.frame, clock=100.0, latency=0.05)
    for k in range(100):
        found = observe(0.02 * k)
        truth = robot.scene
        robot.move(np.zeros(7), 0.02)
    assert found.stamp == pytest.approx(1.98)
    (seen,) = found.obstacles
    assert np.linalg.norm(found.packed.positions[0] - truth.packed.positions[0]) < 0.025
    assert np.linalg.norm(seen.velocity - ball.velocity) < 0.08
    assert np.linalg.eigvalsh(seen.covariance)[0] > 0.0


def test_replacing_what_the_camera_sees_changes_the_scene_while_the_truth_stays(arm):
    robot = SimulatedRobot(arm, scene=Scene(None, [Sphere([0.7, -0.5, 0.4], 0.1)]))
    other = SimulatedRobot(arm, scene=Scene(None, [Sphere([0.7, 0.5, 0.5], 0.1)]))
    places = []
    for seen in (robot, other):
        camera = DepthCamera(seen, CAMERA, EYE)
        observe = observer_of(robot, lambda c=camera: replace(c.frame(), stamp=robot.time))
        robot.reset()
        for k in range(10):
            scene = observe(0.04 * k)
            robot.move(np.zeros(7), 0.04)
        places.append(scene.packed.positions[0])
    np.testing.assert_allclose(places, [[0.7, -0.5, 0.4], [0.7, 0.5, 0.5]], atol=0.01)


def test_a_frozen_camera_keeps_the_old_stamp(arm):
    robot = SimulatedRobot(arm, scene=Scene(None, [Sphere([0.7, -0.5, 0.4], 0.1)]))
    camera = DepthCamera(robot, CAMERA, EYE)
    frames = {"frozen": None}
    observe = observer_of(robot, lambda: frames["frozen"] or camera.frame(), latency=0.0)
    stamps = []
    for k in range(50):
        if k == 20:
            frames["frozen"] = camera.frame()
        stamps.append(observe(0.04 * k).stamp)
        robot.move(np.zeros(7), 0.04)
    np.testing.assert_allclose(stamps[:25], 0.04 * np.arange(25))
    np.testing.assert_allclose(stamps[28:], 0.8)
    assert observe.stamp == pytest.approx(0.8)
    assert len(observe(3.0).obstacles) == 1  # what was seen last is still there
    assert observe.n_frames == 21


@pytest.mark.parametrize(
    "change",
    [Pose([0, 0, 0.06], [1, 0, 0, 0]), Pose([0, 0, -0.3], [1, 0, 0, 0]), Pose([0, 0, 0], quaternion_exp([0, 0.1, 0]))],
    ids=["6 cm up", "30 cm down", "6 degrees"],
)
def test_a_camera_that_was_moved_stops_the_loop(arm, change):
    table = Box(Pose([0.8, 0.0, -0.2], [1.0, 0.0, 0.0, 0.0]), [0.8, 1.4, 0.1], name="table")
    robot = SimulatedRobot(
        arm, scene=Scene(None, [Sphere([0.7, -0.5, 0.1], 0.1)], fixtures=[*standard_fixtures(), table])
    )
    exact = DepthCamera(robot, CAMERA, EYE, **KINECT)
    wrong = {"pose": EYE}
    observe = observer_of(robot, lambda: replace(exact.frame(), camera_to_base=wrong["pose"]), rate=10.0)
    with pytest.raises(TaskFailedError, match=r"camera 1: .*was moved"):
        for k in range(60):
            if k == 25:
                wrong["pose"] = Pose(EYE.position + change.position, (change @ EYE).quaternion)
            observe(0.1 * k)
            robot.move(np.zeros(7), 0.1)
    assert k > 30  # not in one image only


def test_two_cameras_are_used_and_one_may_have_no_image(arm):
    robot = SimulatedRobot(arm, scene=Scene(None, [Sphere([0.7, -0.5, 0.4], 0.1), Sphere([-0.5, 0.6, 0.4], 0.1)]))
    front = DepthCamera(robot, CAMERA, EYE)
    side = DepthCamera(robot, CAMERA, looking([-0.6, 2.4, 0.8], [-0.5, 0.6, 0.4]))
    observe = observer_of(robot, [front.frame, side.frame, lambda: None], latency=0.0)
    for k in range(5):
        found = observe(0.04 * k)
        robot.move(np.zeros(7), 0.04)
    assert len(found.obstacles) == 2
    assert observe.n_frames == 10


def test_bad_arguments_are_refused(arm):
    robot = SimulatedRobot(arm)
    camera = DepthCamera(robot, CAMERA, EYE)
    detector, tracker = ObstacleDetector(arm), ObstacleTracker()
    good = {"cameras": camera.frame, "detector": detector, "tracker": tracker, "joints": lambda: arm.home}
    for changes, message in (
        ({"cameras": []}, "at least one camera"),
        ({"cameras": camera}, "must be a function"),
        ({"joints": None}, "joints is required"),
        ({"rate": 0.0}, "rate"),
        ({"latency": -1.0}, "latency"),
        ({"max_age": 0.01}, "max_age"),
    ):
        with pytest.raises(InputError, match=message):
            CameraObserver(**{**good, **changes})
    observe = CameraObserver(**good)
    observe(1.0)
    with pytest.raises(InputError, match="earlier than in the last call"):
        observe(0.5)
    observe.reset()
    assert observe.stamp is None
    assert observe(0.5).obstacles == ()
