from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.viewer import Camera
from imitarm.viewer.stage import body_parts, floor_height, points_to_see
from viewer_samples import make_path, make_recording


def in_picture(camera: Camera, points: np.ndarray, aspect: float) -> np.ndarray:
    """How far out each point is seen, 1 at the picture's edge."""
    position, look_at = np.array(camera.position), np.array(camera.look_at)
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    depth, tangent = (points - position) @ ahead, np.tan(0.5 * camera.field_of_view)
    assert depth.min() > 0.0
    across = np.abs((points - position) @ right) / (depth * tangent * aspect)
    return np.maximum(across, np.abs((points - position) @ up) / (depth * tangent))


@given(seed=st.integers(0, 10_000), aspect=st.floats(0.5, 2.5))
@settings(max_examples=40, deadline=None)
def test_a_camera_sees_all_points_and_is_near(seed: int, aspect: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 1.0, (30, 3)) * rng.uniform(0.1, 2.0, 3) + rng.normal(0.0, 1.0, 3)
    direction = [np.cos(seed), np.sin(seed), rng.uniform(-0.5, 1.0)]
    out = in_picture(Camera.around(points, direction=direction, aspect=aspect), points, aspect)
    assert 0.7 < out.max() <= 1.0


def test_the_view_follows_the_action_not_the_furniture() -> None:
    recording = make_recording(seconds=1.0)
    parts = body_parts(recording.model)
    seen = points_to_see(recording, parts, [make_path().positions])
    assert seen[:, 2].min() > -0.3  # neither the floor nor the pedestal's foot
    assert seen[:, 2].max() > 0.4  # the arm
    assert floor_height(recording, parts) == pytest.approx(-0.75)


def test_what_stands_still_is_seen_when_nothing_moves() -> None:
    recording = make_recording(seconds=0.0)
    seen = points_to_see(recording, body_parts(recording.model), [])
    assert np.ptp(seen, axis=0).min() > 0.5


def test_geoms_of_one_colour_of_a_body_become_one_part() -> None:
    recording = make_recording(seconds=0.0)
    parts = body_parts(recording.model)
    assert len(parts[recording.model.body("brush").id]) == 1
    assert {part.rgba for part in parts[recording.model.body("link/0").id]} == {
        (0.66, 0.13, 0.16, 1.0),
        (0.2, 0.21, 0.23, 1.0),
    }
