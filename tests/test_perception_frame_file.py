"""Recorded frames come back as they were, play like a camera, and a damaged file gets a clear error."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import DepthFrame, FrameRecording, Intrinsics, PointCloud

CAMERA = Intrinsics(32, 24, 40.0, 42.0, 15.0, 12.5)


def frames(n=4):
    rng = np.random.default_rng(0)
    made = []
    for k in range(n):
        pose = Pose(rng.normal(size=3), quaternion_exp(rng.normal(size=3)))
        depth = rng.uniform(0.5, 4.0, (24, 32))
        depth[rng.random(depth.shape) < 0.2] = np.nan
        color = rng.uniform(0.0, 1.0, (24, 32, 3)) if k % 2 else None
        cloud = PointCloud(0.1 * k, rng.normal(size=(50, 3)), pose, spacing=0.01, colors=rng.uniform(size=(50, 3)))
        made.append(cloud if k == 2 else DepthFrame(0.1 * k, depth, CAMERA, pose, color))
    return made


def test_frames_come_back_as_they_were(tmp_path):
    saved = FrameRecording(tuple(frames()))
    saved.save(tmp_path / "frames.npz")
    loaded = FrameRecording.load(tmp_path / "frames.npz")
    assert len(loaded) == 4
    for before, after in zip(saved, loaded, strict=True):
        assert type(before) is type(after)
        assert before.stamp == after.stamp
        np.testing.assert_allclose(before.points(), after.points(), atol=1e-5)
        if isinstance(before, DepthFrame):
            assert before.intrinsics == after.intrinsics
            np.testing.assert_array_equal(np.isnan(before.depth), np.isnan(after.depth))
            assert (before.color is None) == (after.color is None)
            if before.color is not None:
                np.testing.assert_allclose(before.color, after.color, atol=0.5 / 255.0)
        else:
            assert before.spacing == after.spacing
            np.testing.assert_allclose(before.colors, after.colors, atol=0.5 / 255.0)


def test_a_recording_plays_like_a_camera():
    recording, now = FrameRecording(tuple(frames())), [0.0]
    camera = recording.camera(lambda: now[0])
    stamps = []
    for now[0] in (-0.1, 0.0, 0.15, 0.2, 9.0):
        frame = camera()
        stamps.append(None if frame is None else round(frame.stamp, 3))
    assert stamps == [None, 0.0, 0.1, 0.2, 0.3]


def test_damaged_files_are_refused_with_their_name(tmp_path):
    good = tmp_path / "good.npz"
    FrameRecording(tuple(frames())).save(good)
    content = good.read_bytes()
    with np.load(good) as arrays:
        parts = dict(arrays)
    cases = {
        "cut.npz": content[: len(content) // 2],
        "text.npz": b"depth, depth, depth",
        "empty.npz": b"",
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
    changed = {
        "version.npz": {"version": 99},
        "missing.npz": {"depth_0": None},
        "size.npz": {"depth_0": np.ones((3, 3))},
        "stamps.npz": {"stamps": [0.0, 0.0, 0.0, 0.0]},
        "object.npz": {"pose_0": np.array([{}], dtype=object)},
    }
    for name, changes in changed.items():
        kept = {key: value for key, value in {**parts, **changes}.items() if value is not None}
        np.savez(tmp_path / name, **kept)
    for name in [*cases, *changed, "absent.npz"]:
        with pytest.raises(FileFormatError, match=name):
            FrameRecording.load(tmp_path / name)


def test_bad_arguments_are_refused(tmp_path):
    with pytest.raises(InputError, match="at least one"):
        FrameRecording(())
    with pytest.raises(InputError, match="must increase"):
        FrameRecording(tuple(reversed(frames())))
    recording = FrameRecording(tuple(frames()))
    with pytest.raises(InputError, match=r"\.npz"):
        recording.save(tmp_path / "frames.txt")
    with pytest.raises(InputError, match="can't be written"):
        recording.save(tmp_path / "nowhere" / "frames.npz")
    with pytest.raises(InputError, match="time"):
        recording.at(np.nan)
    with pytest.raises(InputError, match="clock"):
        recording.camera(3.0)
