"""DepthFrame and its camera: projection and points are each other's inverse, and nothing invalid gets in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import DepthFrame, Intrinsics

CAMERA = Intrinsics(32, 24, 40.0, 42.0, 15.0, 12.5)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_points_are_where_the_depth_says(seed):
    rng = np.random.default_rng(seed)
    pose = Pose(rng.normal(size=3), quaternion_exp(rng.normal(size=3)))
    depth = rng.uniform(0.3, 4.0, (24, 32))
    depth[rng.uniform(size=depth.shape) < 0.3] = np.nan
    frame = DepthFrame(1.5, depth, CAMERA, pose)
    points = frame.points()
    assert len(points) == np.count_nonzero(~np.isnan(depth))
    in_camera = pose.inverse().apply(points)
    rows, columns = np.nonzero(~np.isnan(depth))
    np.testing.assert_allclose(CAMERA.project(in_camera), np.stack([columns, rows], axis=1), atol=1e-9)
    np.testing.assert_allclose(in_camera[:, 2], depth[rows, columns], atol=1e-12)


def test_a_point_on_the_axis_is_seen_in_the_middle():
    camera = Intrinsics.from_field_of_view(64, 48, np.pi / 3)
    np.testing.assert_allclose(camera.project([0, 0, 2.0]), [31.5, 23.5])
    up = camera.project([0.0, -2.0 * np.tan(np.pi / 6), 2.0])  # y points down
    np.testing.assert_allclose(up, [31.5, -0.5])  # the upper edge of the first row
    assert np.isnan(camera.project([0, 0, -1.0])).all()


def test_what_was_not_measured_is_nan():
    depth = np.array([[0.0, np.inf], [1.0, np.nan]])
    frame = DepthFrame(0.0, depth, Intrinsics(2, 2, 1.0, 1.0, 0.5, 0.5), Pose.identity())
    np.testing.assert_array_equal(np.isnan(frame.depth), [[True, True], [False, True]])
    assert frame.points().shape == (1, 3)
    assert depth[0, 0] == 0.0  # the caller's array stays as it was
    assert repr(frame) == "DepthFrame(2 x 2, stamp 0 s, 25 % measured, from 1.00 to 1.00 m)"
    assert "2 x 2 pixels" in frame._repr_html_()
    with pytest.raises(ValueError, match="read-only"):
        frame.depth[0, 0] = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stamp": np.nan}, "stamp must be a finite number"),
        ({"stamp": "now"}, "stamp"),
        ({"depth": np.ones((32, 24))}, "depth must be an array of shape"),
        ({"depth": -np.ones((24, 32))}, r"depth\[0, 0\] is -1"),
        ({"depth": None}, "depth"),
        ({"intrinsics": (32, 24, 40, 40, 16, 12)}, "intrinsics must be"),
        ({"camera_to_base": np.eye(4)}, "camera_to_base must be"),
    ],
)
def test_invalid_frames_are_refused(changes, message):
    good = {"stamp": 0.0, "depth": np.ones((24, 32)), "intrinsics": CAMERA, "camera_to_base": Pose.identity()}
    with pytest.raises(InputError, match=message):
        DepthFrame(**{**good, **changes})


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0, -1, None, "wide"])
def test_invalid_cameras_are_refused(bad):
    good = {"width": 32, "height": 24, "fx": 40.0, "fy": 40.0, "cx": 15.5, "cy": 11.5}
    for key in ("width", "height", "fx", "fy"):
        with pytest.raises(InputError, match=key):
            Intrinsics(**{**good, key: bad})
    with pytest.raises(InputError, match="field of view"):
        Intrinsics.from_field_of_view(32, 24, bad)
    with pytest.raises(InputError, match="points"):
        CAMERA.project([bad, 0, 1.0] if not isinstance(bad, int) else [0.0, 1.0])
