"""Real people lead simulated arms: what a Kinect, a motion capture system and a film recorded, led by ``modern``.

Limits are measured here, from the joint positions alone, in every control period.
"""

from __future__ import annotations

import os
from functools import cache

import numpy as np
import pytest

from imitarm import ArmModel, SimulatedRobot
from imitarm.capture.checks import repaired
from imitarm.capture.mediapipe_environment import find_python
from imitarm.capture.recording import read_recording, slowed
from imitarm.capture.sources import followed
from imitarm.errors import InputError
from imitarm.evaluation.tracking import seen_arm
from imitarm.retarget import Correspondence, ModernRetargeter
from imitarm.retarget.engagement import SEEN_FOR
from imitarm.retarget.fitting import fit_motion
from mediapipe_samples import VIDEOS, video_recording

DT = 0.01
ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
RECORDINGS = {
    "wave hand": ("kinect_gestures/Ges01_wavehand.csv", "right"),
    "balance hands": ("kinect_gestures/Ges02_balancinghands.csv", "right"),
    "balance hands, left": ("kinect_gestures/Ges02_balancinghands.csv", "left"),
    "draw lines": ("kinect_gestures/Ges03_drawlines.csv", "right"),
    "come here": ("kinect_gestures/Ges04_comehere.csv", "right"),
    "come here, left": ("kinect_gestures/Ges04_comehere.csv", "left"),
    "arm in motion capture": ("mocap_arm/recording.tsv", "right"),
}

each_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)


@cache
def person(real_data, name):
    path, side = RECORDINGS[name]
    recording, _ = repaired(read_recording(real_data / path))
    return tuple(recording.skeletons), side


def fitted(arm, skeletons, correspondence):
    """The run from where all of the motion is in reach."""
    times = np.arange(SEEN_FOR, skeletons[-1].time - skeletons[0].time, DT)
    wrist = seen_arm(skeletons, times, correspondence).wrist
    fit = fit_motion(arm, wrist, wrist[0], scale=correspondence.scale)
    follow = Correspondence(correspondence.side, scale=fit.scale, orientation=correspondence.orientation)
    return ModernRetargeter(arm, follow, dt=DT).run(skeletons, fit.q)


def assert_within_limits(arm, joints):
    velocity = np.diff(joints, axis=0) / DT
    acceleration = np.diff(velocity, axis=0, prepend=np.zeros((1, arm.n_joints))) / DT  # it begins at rest
    assert np.isfinite(joints).all()
    assert (joints <= arm.upper + 1e-9).all()
    assert (joints >= arm.lower - 1e-9).all()
    assert (np.abs(velocity) <= arm.max_velocity * (1.0 + 1e-9)).all()
    assert (np.abs(acceleration) <= arm.max_acceleration * (1.0 + 1e-6)).all()


@pytest.mark.slow
@each_arm
@pytest.mark.parametrize("name", RECORDINGS)
def test_no_joint_breaks_a_limit_in_any_frame(real_data, arm, name):
    """From the robot's home, where much of a gesture is out of reach, and from where it is in reach."""
    skeletons, side = person(real_data, name)
    for orientation in ("hand", "upright", "fixed"):
        correspondence = Correspondence(side, orientation=orientation)
        run = ModernRetargeter(arm, correspondence, dt=DT).run(skeletons)
        assert_within_limits(arm, run.joints)
        assert (run.states == "following").mean() > 0.8
        assert np.ptp(run.joints, axis=0).max() > 0.1  # it moves
    run = fitted(arm, skeletons, Correspondence(side, orientation="fixed"))
    assert_within_limits(arm, run.joints)
    assert (run.states == "following").mean() > 0.8


@pytest.mark.slow
@each_arm
@pytest.mark.parametrize("name", [name for name in RECORDINGS if name != "arm in motion capture"])
def test_gestures_no_quicker_than_the_tool_are_followed(real_data, arm, name):
    """A hand goes at 2 to 3 m/s, the tool at 1 m/s; slowed to 0.7 m/s, the tool gets where the hand was seen."""
    skeletons, side = person(real_data, name)
    correspondence = Correspondence(side, orientation="fixed")
    times = np.arange(0.0, skeletons[-1].time - skeletons[0].time, DT)
    wrist = seen_arm(skeletons, times, correspondence).wrist
    speed = float(np.linalg.norm(wrist[10:] - wrist[:-10], axis=1).max()) / (10 * DT)
    run = fitted(arm, slowed(skeletons, min(1.0, 0.7 / speed)), correspondence)
    assert_within_limits(arm, run.joints)
    tool, _ = arm.tool_path(run.joints)
    aimed = np.isfinite(run.targets[0]).all(axis=1)
    target = run.targets[0][aimed]
    apart = np.sqrt(np.mean(np.sum((tool[aimed] - target) ** 2, axis=1)))
    goes = np.sqrt(np.mean(np.sum((target - target.mean(axis=0)) ** 2, axis=1)))
    assert apart < 0.3 * goes


@pytest.mark.slow
@each_arm
@pytest.mark.parametrize(("name", "pace"), [("arm in motion capture", 1.0), ("wave hand", 0.5)])
def test_a_simulated_arm_with_its_drives_follows(real_data, arm, name, pace):
    """Inertias, gravity, friction and drives that give at most their rated torques: not kinematics alone."""
    skeletons, side = person(real_data, name)
    some = [skeleton for skeleton in slowed(skeletons, pace) if skeleton.time - skeletons[0].time < 12.0]
    run = fitted(arm, some, Correspondence(side, orientation="fixed"))
    robot = SimulatedRobot(arm, q=run.joints[0])
    behind, torques = [], []
    for before, wanted, velocity in zip(run.joints[:-1], run.joints[1:], run.velocities[1:], strict=True):
        state = robot.move(velocity + 5.0 * (before - robot.set_point), DT)
        behind.append(np.abs(state.q - wanted))
        torques.append(state.torque)
    assert not robot.fault
    assert np.max(behind) < 0.01  # [rad]
    assert np.sqrt(np.mean(np.square(behind))) < 0.002
    tool = arm.tool_pose(robot.state().q).position
    assert np.linalg.norm(tool - arm.tool_pose(run.joints[-1]).position) < 0.005
    assert (np.abs(torques) <= arm.max_torque + 1e-9).all()
    assert (np.mean(np.abs(torques), axis=0) < 0.6 * arm.max_torque).all()  # not at the rated torque all the time


def man_in_the_film(view):
    """The man of the pose2sim videos, as MediaPipe sees him from one side, left and right kept apart."""
    recording = video_recording(view)
    recording.rewind()
    with followed(recording) as one:
        return list(one)


@pytest.fixture
def film():
    """MediaPipe and the videos; where CI=true their absence is a failure, elsewhere the test is skipped."""
    try:
        find_python()
        missing = "" if (VIDEOS / "cam04.mp4").is_file() else f"there are no videos in {VIDEOS}; say 'make mediapipe'"
    except InputError as error:
        missing = str(error)
    if missing and os.environ.get("CI") == "true":
        pytest.fail(missing)
    if missing:
        pytest.skip(missing)
    return man_in_the_film


@pytest.mark.slow
@pytest.mark.xdist_group("video")
@each_arm
@pytest.mark.parametrize("view", [1, 2, 3, 4])
def test_a_man_in_a_film_breaks_no_limit_either(film, arm, view):
    """Filmed by one camera at 60 Hz for 1.65 s: he swings his arms, and depth is guessed."""
    skeletons = film(view)
    for side in ("left", "right"):
        for pace in (1.0, 0.5):
            run = fitted(arm, slowed(skeletons, pace), Correspondence(side, orientation="fixed"))
            assert_within_limits(arm, run.joints)
            assert (run.states == "following").mean() > 0.3
            assert np.ptp(run.joints, axis=0).max() > 0.1
