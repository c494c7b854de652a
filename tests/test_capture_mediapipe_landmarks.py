from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.capture.mediapipe import (
    DEPTH_MEMORY,
    INFERRED,
    TRACKED,
    LandmarkConverter,
    PoseLandmarks,
)
from imitarm.capture.skeleton import JOINT, JOINTS, HandState, Tracking
from imitarm.errors import InputError
from mediapipe_samples import SIZE, seen, standing

PLACE = np.array([0.2, 0.1, 2.5])
# joints that are one landmark, by MediaPipe's own list of names
SAME = {
    "shoulder_left": 11,
    "elbow_right": 14,
    "wrist_left": 15,
    "wrist_right": 16,
    "thumb_right": 22,
    "thumb_left": 21,
}
SAME |= {"hip_right": 24, "knee_left": 25, "ankle_right": 28, "foot_left": 31}


def converted(landmarks, **options):
    return LandmarkConverter(SIZE, **options).skeleton(landmarks)


def test_a_person_who_faces_the_camera_has_the_right_hand_at_larger_x_stands_up_and_reaches_nearer():
    skeleton = converted(seen(standing(), PLACE))
    landmarks = seen(standing(), PLACE)
    assert landmarks.image[16, 0] < landmarks.image[15, 0]  # the right hand is on the left of the picture
    assert skeleton.joint("wrist_right")[0] > skeleton.joint("wrist_left")[0]
    assert skeleton.joint("head")[1] > skeleton.joint("spine_base")[1] > skeleton.joint("foot_left")[1]
    assert skeleton.joint("hand_tip_right")[2] < skeleton.joint("shoulder_right")[2]
    for side in ("left", "right"):
        arm = skeleton.arm(side)
        wrist, hand, tip = arm.points[2], arm.points[3], arm.points[4]
        assert 0.05 < np.linalg.norm(hand - wrist) < np.linalg.norm(tip - wrist) < 0.25
        assert np.allclose(np.cross(hand - wrist, tip - wrist), 0.0, atol=1e-9)  # one line: the direction is the same
    assert skeleton.hand_states == (HandState.UNKNOWN, HandState.UNKNOWN)


@given(
    x=st.floats(-1.0, 1.0),
    y=st.floats(-0.6, 0.6),
    z=st.floats(1.2, 6.0),
    turn=st.floats(-np.pi, np.pi),
    angle=st.floats(40.0, 80.0),
)
def test_a_person_is_found_where_the_picture_shows_one(x, y, z, turn, angle):
    c, s = np.cos(turn), np.sin(turn)
    points = standing() @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T
    place = np.array([x, y, z])
    skeleton = converted(seen(points, place, field_of_view=angle), field_of_view=angle)
    for name, landmark in SAME.items():
        assert np.allclose(skeleton.joint(name), (points[landmark] + place) * (-1.0, -1.0, 1.0), atol=2e-3), name


def test_every_joint_is_made_of_landmarks_of_its_side():
    for name in JOINTS:
        points = standing()
        moved = points.copy()
        other = {"left": slice(12, None, 2), "right": slice(11, None, 2)}.get(name.rpartition("_")[2])
        if other is None:
            continue
        moved[other] += (0.0, 0.0, 0.3)
        before, after = (LandmarkConverter(SIZE).skeleton(seen(p, PLACE)).positions for p in (points, moved))
        middle = before[JOINT[name]] - after[JOINT[name]]
        assert np.linalg.norm(middle) < 0.12, name  # the fitted place may move, by less than the landmarks did


def test_a_hip_that_moves_does_not_move_a_hand_that_rests():
    converter = LandmarkConverter(SIZE)
    hands = []
    for i in range(60):
        points = standing()
        sway = np.array([0.15 * np.sin(0.2 * i), 0.0, 0.0])
        points[[15, 16, 17, 18, 19, 20, 21, 22]] -= sway  # about the hips, the hands move the other way
        hands.append(converter.skeleton(seen(points, PLACE + sway, time=i / 30)).joint("wrist_right"))
    assert np.ptp(hands, axis=0).max() < 0.005


def test_a_wrong_field_of_view_changes_the_distance_and_not_what_one_joint_is_seen_from_another():
    landmarks = seen(standing(), np.array([0.0, 0.0, 2.5]))
    right, wrong = converted(landmarks), converted(landmarks, field_of_view=70.0)
    assert wrong.joint("spine_base")[2] < 0.85 * right.joint("spine_base")[2]
    assert np.allclose(
        right.joint("wrist_right") - right.joint("shoulder_right"),
        wrong.joint("wrist_right") - wrong.joint("shoulder_right"),
        atol=2e-3,
    )


def test_the_distance_is_averaged_and_begins_anew_after_a_gap():
    rng, converter = np.random.default_rng(0), LandmarkConverter(SIZE)
    depths = []
    for i in range(200):
        scale = 1.0 + 0.03 * rng.normal()  # MediaPipe's metres tremble
        landmarks = seen(standing(), PLACE, time=i / 30)
        shaken = PoseLandmarks(landmarks.time, landmarks.world * scale, landmarks.image, landmarks.visibility)
        depths.append(converter.skeleton(shaken).joint("spine_base")[2])
    alone = 0.03 * PLACE[2]
    expected = alone * np.sqrt(np.tanh(0.5 / 30 / DEPTH_MEMORY))  # of an exponential average of white noise
    assert np.std(depths[20:]) == pytest.approx(expected, rel=0.3)
    later = converter.skeleton(seen(standing(), PLACE + [0.0, 0.0, 2.0], time=200 / 30 + 1.0))
    assert later.joint("spine_base")[2] == pytest.approx(PLACE[2] + 2.0, abs=0.01)


def test_what_is_hidden_is_inferred_or_lost_and_what_is_outside_is_never_tracked():
    whole = seen(standing(), PLACE)
    for visibility, state in ((TRACKED, 2), (0.9 * TRACKED, 1), (INFERRED, 1), (0.9 * INFERRED, 0)):
        changed = whole.visibility.copy()
        changed[16] = visibility
        skeleton = converted(PoseLandmarks(0.0, whole.world, whole.image, changed))
        assert skeleton.tracking[JOINT["wrist_right"]] == state
        assert skeleton.tracking[JOINT["hand_right"]] == state  # is made of it
        assert skeleton.tracking[JOINT["elbow_right"]] == Tracking.TRACKED
        assert np.isnan(skeleton.joint("wrist_right")).all() == (state == 0)
    near = converted(seen(standing(), np.array([0.0, 0.0, 1.0])))  # feet below the picture
    assert near.tracking[JOINT["foot_left"]] == Tracking.INFERRED
    assert near.tracking[JOINT["wrist_left"]] == Tracking.TRACKED


def test_nobody_who_can_be_placed_is_nobody():
    assert converted(seen(standing(), PLACE, visibility=0.05)) is None
    behind = seen(standing(), PLACE)
    assert converted(PoseLandmarks(0.0, behind.world, 1.0 - behind.image, behind.visibility)) is None  # upside down


def test_landmarks_that_are_none_are_refused():
    good = seen(standing(), PLACE)
    with pytest.raises(InputError, match="33 landmarks"):
        PoseLandmarks(0.0, good.world[:32], good.image, good.visibility)
    with pytest.raises(InputError, match="finite"):
        PoseLandmarks(0.0, good.world * np.inf, good.image, good.visibility)
    with pytest.raises(InputError, match="10 to 150"):
        LandmarkConverter(SIZE, 5.0)
    with pytest.raises(InputError, match="needs an image size"):
        LandmarkConverter((0, 720))
