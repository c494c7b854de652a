from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.errors import InputError
from imitarm.kinematics.pose import rotate
from imitarm.retarget import FACING
from imitarm.viewer import PersonMark, palette, playback_html
from imitarm.viewer.person import _BALLS, _BONES, _balls, _bones, _turns_from_z
from test_viewer_scene3d import messages
from viewer_samples import make_recording

FLOOR = -0.75


def frames(times):
    person = Person.from_seed(3)
    shoulder = person.shoulder("right", 0.0)
    return [person.skeleton(t, shoulder + [0.1, -0.2 + 0.1 * t, -0.35]) for t in times]


def mark(skeletons, times, **options):
    return PersonMark.beside(skeletons, times, FACING, floor=FLOOR, **options)


def test_the_person_stands_upright_on_the_floor_where_asked_and_faces_as_the_robot_does() -> None:
    times = np.arange(0.0, 2.0, 0.04)
    person = mark(frames(times), times, place=(0.1, 1.4))
    middle = person.positions.mean(axis=0)
    np.testing.assert_allclose(middle[JOINT["spine_base"], :2], [0.1, 1.4], atol=0.02)
    assert FLOOR < middle[JOINT["foot_left"], 2] < FLOOR + 0.06
    assert 1.2 < middle[JOINT["head"], 2] - FLOOR < 1.95
    assert middle[JOINT["shoulder_left"], 1] > middle[JOINT["shoulder_right"], 1] + 0.2  # the robot's y is its left
    assert middle[JOINT["foot_left"], 0] > middle[JOINT["ankle_left"], 0]  # toes forward: the robot's x
    assert person.positions[-1, JOINT["wrist_right"], 2] > person.positions[0, JOINT["wrist_right"], 2] + 0.1


def test_gaps_are_gaps_and_the_last_sight_stays() -> None:
    seen = np.concatenate([np.arange(0.0, 1.0, 0.1), np.arange(2.0, 3.0, 0.1)])
    times = np.arange(0.0, 4.0, 0.05)
    person = mark(frames(seen), times)
    shown = (person.tracking > Tracking.LOST).all(axis=1)
    assert shown[times < 1.1].all() and shown[times > 2.01].all()
    assert not shown[(times > 1.2) & (times < 1.99)].any()


def test_without_feet_or_hips_the_person_is_still_above_the_floor() -> None:
    skeletons = []
    for skeleton in frames([0.0, 0.1]):
        tracking = np.array(skeleton.tracking)
        tracking[[JOINT[f"{part}_{side}"] for part in ("ankle", "foot", "knee") for side in ("left", "right")]] = 0
        skeletons.append(Skeleton(skeleton.time, skeleton.positions, tracking))
    person = mark(skeletons, [0.0, 0.1])
    assert person.positions[0, JOINT["spine_base"], 2] == pytest.approx(FLOOR + 0.9, abs=0.05)
    nobody = mark([Skeleton(0.0, np.full((25, 3), np.nan))], [0.0])
    assert not (nobody.tracking > Tracking.LOST).any()
    assert np.isfinite(np.concatenate([v.ravel() for v in (*_bones(nobody).values(), *_balls(nobody).values())])).all()


@given(arrays(float, (5, 3), elements=st.floats(-1.0, 1.0)))
def test_a_bone_lies_between_its_joints(directions: np.ndarray) -> None:
    lengths = np.linalg.norm(directions, axis=1)
    unit = directions[lengths > 1e-3] / lengths[lengths > 1e-3, None]
    np.testing.assert_allclose(rotate(_turns_from_z(unit), np.tile([0.0, 0.0, 1.0], (len(unit), 1))), unit, atol=1e-6)
    np.testing.assert_allclose(rotate(_turns_from_z(np.array([[0.0, 0.0, -1.0]])), [[0.0, 0.0, 1.0]]), [[0, 0, -1.0]])


def test_the_drawn_bones_end_at_the_joints() -> None:
    person = mark(frames([0.0, 0.5]), [0.0, 0.5])
    drawn = _bones(person)
    ends = 0.5 * drawn["batched_scales"][..., 2:] * rotate(drawn["batched_wxyzs"], [0.0, 0.0, 1.0])
    for k, joint in ((-1.0, 0), (1.0, 1)):
        at = drawn["batched_positions"] + k * ends
        np.testing.assert_allclose(at, person.positions[:, [JOINT[bone[joint]] for bone in _BONES]], atol=4e-3)


def test_what_is_inferred_is_paler_what_is_lost_is_hidden_and_the_followed_arm_stands_out() -> None:
    skeleton = frames([0.0])[0]
    tracking = np.array(skeleton.tracking)
    tracking[JOINT["elbow_right"]], tracking[JOINT["knee_left"]] = Tracking.INFERRED, Tracking.LOST
    person = mark([Skeleton(0.0, skeleton.positions, tracking)], [0.0], side="right")
    balls, names = _balls(person), list(_BALLS)
    colour, size = balls["batched_colors"][0].astype(int), balls["batched_scales"][0].max(axis=1)
    elbow, wrist, left = (names.index(name) for name in ("elbow_right", "wrist_right", "wrist_left"))
    assert (colour[elbow] > colour[wrist]).all()
    assert tuple(colour[wrist]) != tuple(colour[left])
    assert size[names.index("knee_left")] < 1e-4 and size[names.index("knee_right")] > 0.03
    other = _balls(mark([skeleton], [0.0], side="left"))["batched_colors"][0].astype(int)
    assert tuple(other[left]) == tuple(colour[wrist])  # the accent has changed sides
    assert palette.DEMONSTRATION.startswith("#cc79")


def test_person_and_robot_play_in_one_scene_at_the_same_times() -> None:
    recording = make_recording(seconds=1.0)
    person = mark(frames(np.arange(0.0, 1.0, 1 / 30)), recording.times)
    _, played = messages(playback_html(recording, persons=[person]))
    nodes = {m["name"]: m for t, m in played if "props" in m}
    assert {"/person/person bones", "/person/person balls"} <= set(nodes)
    moved = {t for t, m in played if t > 0.0 and m.get("name", "").startswith("/person/")}
    assert 10 < len(moved) <= len(recording) - 1
    assert moved <= {round(float(t), 9) for t in recording.times} | set(recording.times.tolist())
    with pytest.raises(InputError, match="has 2 frames, the recording"):
        playback_html(recording, persons=[mark(frames([0.0, 0.1]), [0.0, 0.1])])


def test_wrong_shapes_and_nobody_are_told() -> None:
    with pytest.raises(InputError, match="needs positions"):
        PersonMark("x", np.zeros((2, 3, 3)), np.zeros((2, len(JOINTS)), np.int8))
    with pytest.raises(InputError, match="no skeleton"):
        PersonMark.beside([], [0.0], FACING)
