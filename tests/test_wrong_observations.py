"""Wrong arguments and measurements of perception and of the control loop are refused with a message that names them."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm import (
    ArmModel,
    ArmState,
    Command,
    Demonstration,
    InputError,
    Observation,
    Pose,
    SafetyFilter,
    Scene,
    SimulatedRobot,
    Skill,
    Sphere,
    Trajectory,
    reproduce,
)
from imitarm.control_loop import CameraObserver, CombinedObserver, ContactDetector, PersonObserver, Watchdog
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.perception import (
    CoverageMargin,
    DepthFrame,
    Detection,
    Intrinsics,
    ObstacleDetector,
    ObstacleTracker,
    PersonCapsules,
    PointCloud,
)
from imitarm.policies import RCAMO, CertifiedRCAMO

NAN = float("nan")
POSE = Pose([0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0])
PINHOLE = Intrinsics.from_field_of_view(16, 12, 1.0)
BALL = Sphere([0.5, 0.0, 0.4], 0.05)
STILL = Command(np.zeros(6))


def frame(stamp=0.0, **changes):
    return DepthFrame(
        **{"stamp": stamp, "depth": np.ones((12, 16)), "intrinsics": PINHOLE, "camera_to_base": POSE} | changes
    )


def camera_observer(camera=frame, **changes):
    arguments = {"detector": ObstacleDetector(), "tracker": ObstacleTracker()} | changes
    return CameraObserver(camera, **arguments)


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("panda", tool="gripper")


@pytest.fixture(scope="module")
def skill():
    u = np.linspace(0.0, 1.0, 60)
    paths = [
        np.column_stack([0.4 + 0.2 * u, 0.02 * i * np.sin(np.pi * u), 0.4 + 0.03 * np.sin(3.0 * u)]) for i in range(3)
    ]
    return Skill(3).fit([Demonstration(Trajectory(2.0 * u, path)) for path in paths])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: frame(depth=np.full((12, 16), 1500)), "in m, not in mm"),
        (lambda: frame(color=np.full((12, 16, 3), 200)), "must be from 0 to 1, got 200; divide"),
        (lambda: frame(color=np.full((12, 16, 3), -0.1)), "must be from 0 to 1"),
        (lambda: frame(1.7e18), "give it in seconds"),
        (lambda: PointCloud(0.0, np.full((9, 3), 1500.0), POSE), "in m, not in mm"),
        (lambda: PointCloud(0.0, np.ones((9, 3)), POSE, colors=np.full((9, 3), 200)), "divide colours of 8 bits"),
        (lambda: Detection(BALL, 1e300 * np.eye(3)), "give it in m\\^2"),
        (lambda: ObstacleTracker().update(1.7e18, []), "give it in seconds"),
        (lambda: ObstacleTracker().scene(-1e300), "give it in seconds"),
        (lambda: ObstacleTracker().scene(0.0, fixtures=5), "fixtures must be a sequence of Obstacle"),
        (lambda: ObstacleDetector(surfaces=BALL), "surfaces must be a sequence"),
        (lambda: ObstacleDetector(shapes=5), "shapes must be a sequence"),
        (lambda: ObstacleDetector(padding=NAN), "padding must be a finite number"),
        (lambda: ObstacleDetector(stamp_uncertainty="x"), "stamp_uncertainty must be a finite number"),
        (lambda: ObstacleDetector().detect(frame(), np.zeros(7)), "the detector has no arm"),
        (lambda: ObstacleDetector().obstacle_points(np.ones((12, 16))), "obstacle_points: frame must be"),
        (lambda: ObstacleDetector().camera_error(None), "camera_error: frame must be"),
        (lambda: CoverageMargin.calibrate(np.ones((99, 1)), times=[0.0], shape=5), "shape must be 2 numbers"),
        (lambda: CoverageMargin.calibrate(np.ones((99, 1)), times=[0.0], shape=(1.0,)), "shape must be 2 numbers"),
        (lambda: SensorModel(rate=1e9), "rate must be a finite number above 0 and of at most 10000"),
        (lambda: SensorModel().frame(Scene(), 1.5), "k must be a whole number"),
        (lambda: SensorModel().frame("scene", 1), "truth must be a Scene"),
        (lambda: TrackedScene(Scene(), SensorModel(), None), "tracker must be an ObstacleTracker"),
        (lambda: TrackedScene(Scene(), SensorModel(), ObstacleTracker(), goal="x"), "goal must be a Pose"),
        (lambda: TrackedScene(Scene(), SensorModel(), ObstacleTracker(), fixtures=BALL), "fixtures must be a sequence"),
        (lambda: camera_observer(tracker="x"), "tracker must be an ObstacleTracker"),
        (lambda: camera_observer(fixtures=5), "fixtures must be a sequence"),
        (lambda: camera_observer(lambda: np.ones((12, 16)))(0.0), "camera 1 must return a DepthFrame"),
        (lambda: PersonObserver([1], PersonCapsules(POSE))(0.0), "skeletons must be a Skeleton"),
        (lambda: PersonObserver([], PersonCapsules(POSE), 5), "tracker must be an ObstacleTracker"),
        (lambda: CombinedObserver(lambda t: None)(0.0), "must be a Scene"),
        (lambda: CombinedObserver(lambda t: Scene())(NAN), "time must be a finite number"),
        (lambda: Watchdog().guard(None, 0.0, 0.0), "command must be a Command"),
        (lambda: Watchdog().guard(STILL, NAN, 0.0), "stamp must be a finite number"),
        (lambda: Watchdog().guard(STILL, 0.0, "x"), "time must be a finite number"),
    ],
)
def test_it_is_refused(call, said):
    with pytest.raises(InputError, match=said):
        call()


def test_colours_may_be_unknown_and_a_few_depths_far():
    depth = np.ones((12, 16))
    depth[0] = 500.0
    assert np.isnan(frame(color=np.full((12, 16, 3), NAN)).color).all() and frame(depth=depth).depth.max() == 500.0


def test_the_arms_points_need_the_posture(arm):
    with pytest.raises(InputError, match="obstacle_points: the joint positions of the arm are unknown"):
        ObstacleDetector(arm).obstacle_points(frame())


def test_a_camera_that_never_sends_an_image_keeps_the_stamp_of_the_first_call():
    observer, watch = camera_observer(lambda: None), Watchdog(from_start=True)
    fast = Command(np.ones(6))
    commands = [watch.guard(fast, observer(3.0 + 0.02 * k).stamp, 3.0 + 0.02 * k) for k in range(50)]
    assert observer(4.0).stamp == 3.0 and commands[0] is fast and not commands[-1].twist.any()


@pytest.mark.parametrize(("ahead", "said"), [(100.0, "100 s after the time"), (-100.0, "100 s before the time")])
def test_images_of_another_clock_are_refused(ahead, said):
    observer = camera_observer(lambda: frame(5.0 + ahead))
    with pytest.raises(InputError, match=said):
        observer(5.0)
    right = camera_observer(lambda: frame(5.0 + ahead), clock=ahead)
    assert right(5.0).stamp == 5.0


def test_one_image_from_the_future_does_not_hide_that_the_camera_is_frozen():
    now = [0.0]
    observer = camera_observer(lambda: frame(now[0] + (1e6 if now[0] > 0.2 else 0.0)))
    with pytest.raises(InputError, match="an image of camera 1 has the stamp 1000000"):
        for now[0] in np.arange(0.0, 1.0, 0.02):
            observer(now[0])
    assert observer.stamp is not None and observer.stamp < 0.21


def test_time_goes_only_forward():
    observer = PersonObserver([], PersonCapsules(POSE))
    observer(5.0)
    with pytest.raises(InputError, match="times must not decrease"):
        observer(4.9)
    watch = Watchdog()
    watch.guard(STILL, 0.0, 5.0)
    with pytest.raises(InputError, match="earlier than in the last call"):
        watch.guard(STILL, 0.0, 4.9)
    watch.reset()
    assert watch.guard(STILL, 0.0, 0.0) is STILL


@pytest.mark.parametrize("threshold", ["x", 1j, -1.0, 0.0, np.ones(6), [], [None] * 7, NAN])
def test_thresholds_of_contact_are_positive_numbers(arm, threshold):
    with pytest.raises(InputError, match="ContactDetector: threshold"):
        ContactDetector(arm, threshold=threshold)


def test_one_threshold_counts_for_all_joints_and_the_state_fits_the_arm(arm):
    detector = ContactDetector(arm, threshold=3.0)
    assert (detector.threshold == 3.0).all()
    for state, said in ((None, "must be a ArmState"), (ArmState(*[np.zeros(6)] * 3, 0.0), "7 numbers")):
        with pytest.raises(InputError, match=said):
            detector.update(state)


@pytest.mark.parametrize(
    "changes",
    [
        {"policy": None},
        {"robot": "panda"},
        {"observe": Scene()},
        {"safety": "x"},
        {"on_step": 5},
        {"safety": SafetyFilter(ArmModel.load("sawyer"))},
        {"contact": ContactDetector(ArmModel.load("sawyer"))},
    ],
)
def test_the_loop_refuses_what_it_can_not_use_before_the_robot_moves(arm, skill, changes):
    robot = SimulatedRobot(arm)
    with pytest.raises(InputError, match="reproduce: "):
        reproduce(**{"policy": RCAMO(skill), "robot": robot, "observe": lambda t: Scene(), "timeout": 0.05} | changes)
    assert robot.state().time == 0.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"forbidden": "x"}, "forbidden"),
        ({"forbidden": [1.0, 2.0]}, "forbidden"),
        ({"forbidden": [[0.0, 0.0, 0.0]]}, "length 0"),
        ({"tool_spheres": [[0.0, 0.0, 0.0, -1.0]]}, "negative radius"),
        ({"skill": Skill(3)}, "fit"),
    ],
)
@pytest.mark.parametrize("policy", [RCAMO, CertifiedRCAMO])
def test_policies_refuse_options_without_meaning(arm, skill, policy, options, said):
    with pytest.raises(InputError, match=said):
        policy(**{"skill": skill, "arm": arm} | options)


@pytest.mark.parametrize("policy", [RCAMO, CertifiedRCAMO])
def test_a_step_needs_an_observation_and_a_positive_period(arm, skill, policy):
    decides = policy(skill, arm=arm)
    q = arm.home
    now = Observation(0.0, ArmState(q, np.zeros(7), np.zeros(7), 0.0), arm.tool_pose(q), Scene())
    with pytest.raises(InputError, match="observation must be a Observation"):
        decides.reset(None)
    decides.reset(now)
    first = decides.step(now, 0.01).twist
    for dt in (0.0, -0.01, NAN, float("inf"), "x", None):
        with pytest.raises(InputError, match="step: dt"):
            decides.step(now, dt)
    with pytest.raises(InputError, match="observation must be a Observation"):
        decides.step("x", 0.01)
    assert np.isfinite(first).all() and np.isfinite(decides.step(now, 0.01).twist).all()
