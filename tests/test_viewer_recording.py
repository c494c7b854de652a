from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, Scene, Sphere
from imitarm.viewer import FrameRecorder, Recording
from imitarm.viewer.recording import AHEAD
from viewer_samples import make_recording, world_xml


def test_frames_come_at_the_asked_rate_and_hold_the_poses() -> None:
    recording = make_recording(seconds=2.0, rate=25.0)
    assert len(recording) == 51
    np.testing.assert_allclose(np.diff(recording.times), 0.04, atol=1e-9)
    assert recording.duration == pytest.approx(2.0)
    crumb = recording.model.body("crumb0").id
    np.testing.assert_allclose(np.diff(recording.positions[:, crumb, 1]), 0.05 * 0.04, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(recording.quaternions, axis=2), 1.0)


def test_frames_are_copies_not_views_of_the_simulation() -> None:
    model = mujoco.MjModel.from_xml_string(world_xml())
    data = mujoco.MjData(model)
    recorder = FrameRecorder(model)
    mujoco.mj_kinematics(model, data)
    recorder.note(data)
    before = recorder.recording().positions.copy()
    data.qpos[0] = 1.0
    mujoco.mj_kinematics(model, data)
    np.testing.assert_array_equal(recorder.recording().positions, before)


def test_bad_input_is_named() -> None:
    model = mujoco.MjModel.from_xml_string(world_xml())
    with pytest.raises(InputError, match="rate must be positive"):
        FrameRecorder(model, rate=0.0)
    with pytest.raises(InputError, match=r"call note\(data\)"):
        FrameRecorder(model).recording()
    good = make_recording(seconds=0.2)
    with pytest.raises(InputError, match="later than the previous one"):
        Recording(good.model, good.times[::-1], good.positions, good.quaternions)
    with pytest.raises(InputError, match="Recording positions"):
        Recording(good.model, good.times, good.positions[:, 1:], good.quaternions)
    with pytest.raises(InputError, match="Recording quaternions: needs finite"):
        Recording(good.model, good.times, good.positions, good.quaternions * np.nan)


def test_predictions_of_tracked_obstacles_are_recorded_frame_by_frame() -> None:
    model = mujoco.MjModel.from_xml_string(world_xml())
    data, recorder = mujoco.MjData(model), FrameRecorder(model, rate=10.0)
    mujoco.mj_kinematics(model, data)
    known = Box(Pose.identity(), [0.2, 0.1, 0.3], name="known without a tracker")
    recorder.note(data, 0.0)
    for k in range(1, 4):
        ball = Sphere([0.1 * k, 0, 0.5], 0.1, velocity=[1, 0, 0], covariance=1e-4 * k * np.eye(3), track_id=7)
        recorder.note(data, 0.1 * k, scene=Scene(None, [known, ball] if k < 3 else [known], stamp=0.1 * k))
    (prediction,) = recorder.recording().predictions
    assert prediction.name == "sphere 1"
    assert np.isnan(prediction.positions[[0, 3]]).all()
    np.testing.assert_allclose(prediction.positions[[1, 2], 0], np.array([0.1, 0.2]) + AHEAD)
    np.testing.assert_allclose(prediction.covariances[2], 2e-4 * np.eye(3))
    np.testing.assert_allclose(prediction.extent, 0.1)
    whole = recorder.recording()
    with pytest.raises(InputError, match="sphere 1 has 4 positions, but needs 3"):
        Recording(model, whole.times[1:], whole.positions[1:], whole.quaternions[1:], whole.predictions)
