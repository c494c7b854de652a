from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.viewer import FrameRecorder, Recording
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
