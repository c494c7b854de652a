"""A person's arms become capsules that contain them, and that a robot avoids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.formats import MotionCapture
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.capture.sources import open_source
from imitarm.command import Command
from imitarm.control_loop import CombinedObserver, PersonObserver
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import PersonCapsules
from imitarm.perception.person_capsules import upright_camera
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene, Sphere

CAMERA = upright_camera([0.5, -2.0, 0.3], 0.5 * np.pi)


def person_at(rng):
    skeleton = Person.from_seed(int(rng.integers(100))).skeleton(0.0, np.array([0.3, 0.2, 1.6]))
    return replace(skeleton, positions=skeleton.positions + rng.normal(0.0, 0.01, (len(JOINTS), 3)))


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_capsules_contain_the_joints(seed):
    rng = np.random.default_rng(seed)
    skeleton, capsules = person_at(rng), PersonCapsules(CAMERA)
    found = {one.label: one.obstacle for one in capsules.detections(skeleton)}
    assert len(found) == 4
    for side in ("left", "right"):
        points = CAMERA.apply(skeleton.arm(side).points)
        upper, lower = found[f"person 0 {side} upper arm"], found[f"person 0 {side} forearm"]
        assert upper.signed_distance(points[:2]).max() <= -upper.radius + 1e-9
        assert lower.signed_distance(points[1:]).max() <= -capsules.hand_radius + 1e-9
        assert lower.radius >= capsules.forearm_radius


def test_the_camera_is_upright_and_looks_where_it_says():
    np.testing.assert_allclose(CAMERA.apply([0.0, 0.0, 1.0]), [0.5, -1.0, 0.3], atol=1e-12)  # ahead: y of the base
    np.testing.assert_allclose(CAMERA.apply([0.0, 1.0, 0.0]), [0.5, -2.0, 1.3], atol=1e-12)
    np.testing.assert_allclose(CAMERA.apply([1.0, 0.0, 0.0]), [-0.5, -2.0, 0.3], atol=1e-12)  # its left
    with pytest.raises(InputError, match="yaw"):
        upright_camera([0, 0, 0], np.nan)


def test_lost_joints_leave_a_capsule_out_and_inferred_ones_are_less_certain():
    skeleton = person_at(np.random.default_rng(0))
    states = np.full(len(JOINTS), Tracking.TRACKED, np.int8)

    def seen(**changes):
        tracking = states.copy()
        for name, state in changes.items():
            tracking[JOINT[name]] = state
        return {
            one.label.partition(" right ")[2]: one
            for one in PersonCapsules(CAMERA, sides=["right"]).detections(replace(skeleton, tracking=tracking))
        }

    every = seen()
    assert set(every) == {"upper arm", "forearm"}
    assert set(seen(shoulder_right=0)) == {"forearm"}
    assert seen(elbow_right=0) == {}
    inferred = seen(elbow_right=1)
    assert inferred["forearm"].covariance[0, 0] > 3.0 * every["forearm"].covariance[0, 0]
    no_tip = seen(hand_tip_right=0)["forearm"].obstacle
    wrist_only = seen(hand_tip_right=0, hand_right=0, thumb_right=0)["forearm"].obstacle
    lengths = [np.linalg.norm(one.end - one.start) for one in (every["forearm"].obstacle, no_tip, wrist_only)]
    assert max(lengths) - min(lengths) < 0.12
    far = np.array(skeleton.positions)
    far[JOINT["elbow_right"]] += [2.0, 0.0, 0.0]  # a jump that no arm can make
    assert PersonCapsules(CAMERA, sides=["right"]).detections(replace(skeleton, positions=far)) == []


def test_every_arm_keeps_its_track_in_the_kinect_recordings(real_data):
    for path in sorted((real_data / "kinect_gestures").glob("*.csv")):
        skeletons = list(open_source(path))
        observe = PersonObserver(skeletons, PersonCapsules(CAMERA), start=None, latency=0.0)
        tracks, fastest = set(), 0.0
        for skeleton in skeletons:
            scene = observe(skeleton.time - skeletons[0].time)
            tracks |= {(obstacle.track_id, obstacle.name) for obstacle in scene.obstacles}
            fastest = max([fastest, *np.linalg.norm(scene.packed.velocities, axis=1)])
        assert len({number for number, _ in tracks}) == 4
        assert observe.n_skeletons == len(skeletons)
        assert 0.3 < fastest < 3.0  # gestures, not jumps


def crossing(real_data):
    """The motion of the captured arm, and where its hand is farthest from the person."""
    truth = MotionCapture.load(real_data / "mocap_arm" / "recording.tsv").truth(Person.from_seed(1))
    hands = np.array([truth(t).arm("right").points[4] for t in np.arange(0.0, 8.0, 0.1)])
    farthest = hands[hands[:, 2].argmin()]
    return truth, farthest


def test_a_robot_yields_to_the_captured_arm_of_a_person(real_data):
    arm = ArmModel.load("sawyer", tool="gripper")
    truth, farthest = crossing(real_data)
    tool = arm.tool_pose(arm.home).position
    camera = upright_camera([0.0, 0.0, 0.0])  # the person is before the robot and faces it
    camera = Pose(tool - camera.apply(farthest), camera.quaternion)
    exact = PersonCapsules(camera, sides=["right"])
    seen = SkeletonCamera(3, sigma=0.012)
    skeletons = [one for k in range(240) if (one := seen.see(truth(k / 30.0))) is not None]
    clearances = {}
    for observed in (True, False):
        robot = SimulatedRobot(arm)
        observe = PersonObserver(skeletons, PersonCapsules(camera, sides=["right"]), start=0.0)
        safety, velocity, dt = SafetyFilter(arm, clearance=0.05), np.zeros(7), 0.02
        nearest = np.inf
        for k in range(400):
            scene = observe(k * dt) if observed else Scene()
            command = Command(np.zeros(6))
            velocity = safety.step(command, robot.set_point, velocity, scene.now(k * dt)).velocity
            robot.move(velocity, dt)
            centers, radii = arm.collision_spheres(robot.set_point)
            capsules = Scene(None, [one.obstacle for one in exact.detections(truth(k * dt))])
            nearest = min(nearest, float((capsules.distances(centers) - radii).min()))
        clearances[observed] = nearest
    assert clearances[False] < -0.02
    assert clearances[True] > 0.0


def test_a_skeleton_arrives_late_and_a_frozen_camera_shows():
    person = Person.from_seed(1)
    skeletons = [person.skeleton(0.1 * k, np.array([0.3, 0.2, 1.6])) for k in range(10)]
    observe = PersonObserver(skeletons, PersonCapsules(CAMERA), latency=0.05)
    assert observe(0.04).obstacles == ()
    assert observe(0.16).stamp == 0.16
    assert observe.n_skeletons == 2
    assert len(observe(0.9).obstacles) == 4
    late = observe(2.0)
    assert late.stamp == pytest.approx(0.9)
    assert len(late.obstacles) == 4


def test_observers_are_combined_and_the_oldest_stamp_shows():
    ball = Sphere([1.0, 0.0, 0.0], 0.1, velocity=[1.0, 0.0, 0.0], track_id=3)
    both = CombinedObserver(
        lambda t: Scene(None, [ball], stamp=t),
        lambda t: Scene(None, [Sphere([0, 1, 0], 0.1, track_id=3)], stamp=t - 0.5),
    )
    scene = both(2.0)
    assert scene.stamp == 1.5
    assert [one.track_id for one in scene.obstacles] == [6, 7]
    np.testing.assert_allclose(scene.packed.positions, [[0.5, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(InputError, match="at least one"):
        CombinedObserver()


def test_bad_arguments_are_refused():
    with pytest.raises(InputError, match="sensor_to_base"):
        PersonCapsules(np.eye(4))
    with pytest.raises(UnknownNameError, match="side"):
        PersonCapsules(CAMERA, sides=["both"])
    for key in ("upper_arm_radius", "hand_length", "tracked_sigma", "inferred_sigma"):
        with pytest.raises(InputError, match=key):
            PersonCapsules(CAMERA, **{key: -0.1})
    with pytest.raises(InputError, match="skeleton"):
        PersonCapsules(CAMERA).detections(np.zeros((25, 3)))
    with pytest.raises(InputError, match="iterable"):
        PersonObserver(3, PersonCapsules(CAMERA))
    with pytest.raises(InputError, match="max_age"):
        PersonObserver([], PersonCapsules(CAMERA), max_age=0.0)
    assert PersonObserver([], PersonCapsules(CAMERA))(1.0).obstacles == ()
    assert isinstance(person_at(np.random.default_rng(1)), Skeleton)
