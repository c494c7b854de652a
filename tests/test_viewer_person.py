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
from imitarm.viewer import PersonMark, playback_html
from imitarm.viewer.person import _BONES, _pieces, _rotations_from_z
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


@given(arrays(float, (5, 3), elements=st.floats(-1.0, 1.0)))
def test_a_bone_lies_along_the_way_between_its_joints(directions: np.ndarray) -> None:
    lengths = np.linalg.norm(directions, axis=1)
    unit = directions[lengths > 1e-3] / lengths[lengths > 1e-3, None]
    np.testing.assert_allclose(
        rotate(_rotations_from_z(unit), np.tile([0.0, 0.0, 1.0], (len(unit), 1))), unit, atol=1e-6
    )
    np.testing.assert_allclose(
        rotate(_rotations_from_z(np.array([[0.0, 0.0, -1.0]])), [[0.0, 0.0, 1.0]]), [[0, 0, -1.0]]
    )


def test_the_pieces_reach_from_joint_to_joint() -> None:
    """Of a person whose bones keep their lengths."""
    person = mark(frames([0.0, 0.5]), [0.0, 0.5])
    pieces = {piece.name: piece for piece in _pieces(person)}
    assert {"head", "trunk", "elbow_right wrist_right"} <= set(pieces)
    for start, end, *radii in _BONES:
        piece, tip = pieces[f"{start} {end}"], max(radii[0], radii[2])
        np.testing.assert_array_equal(piece.position, person.positions[:, JOINT[start]])
        if not start.startswith(("elbow", "shoulder", "wrist")):
            continue  # a trunk is not quite rigid
        along = rotate(piece.wxyz, np.tile([0.0, 0.0, 1.0], (2, 1)))
        length = np.linalg.norm(person.positions[0, JOINT[end]] - person.positions[0, JOINT[start]])
        np.testing.assert_allclose(piece.position + length * along, person.positions[:, JOINT[end]], atol=5e-3)
        assert length - 1e-6 <= piece.mesh.vertices[:, 2].max() <= length + tip + 5e-3


def drawn(person: PersonMark, seconds: float = 1.0) -> tuple[dict, list]:
    """The nodes and the timed messages of a playback with this person."""
    _, played = messages(playback_html(make_recording(seconds=seconds), persons=[person]))
    return {m["name"]: m for t, m in played if "props" in m}, played


def test_what_is_inferred_is_paler_what_is_lost_is_not_drawn_and_the_followed_arm_stands_out() -> None:
    skeleton = frames([0.0])[0]
    tracking = np.array(skeleton.tracking)
    tracking[JOINT["elbow_right"]], tracking[JOINT["knee_left"]] = Tracking.INFERRED, Tracking.LOST
    nodes, _ = drawn(mark([Skeleton(0.0, skeleton.positions, tracking)], [0.0]), 0.0)

    def colour(piece: str, look: str) -> list[int]:
        return list(nodes[f"/person/person {piece}/{look}"]["props"]["color"])

    arm, other = colour("wrist_right hand_right", "seen"), colour("wrist_left hand_left", "seen")
    assert arm != other
    assert all(a > b for a, b in zip(colour("elbow_right wrist_right", "inferred"), arm, strict=True))
    assert not any("knee_left" in name for name in nodes)
    assert any("knee_right" in name for name in nodes)
    swapped, _ = drawn(mark([skeleton], [0.0], side="left"), 0.0)
    assert list(swapped["/person/person wrist_left hand_left/seen"]["props"]["color"]) == arm


def test_person_and_robot_play_in_one_scene_at_the_same_times() -> None:
    recording = make_recording(seconds=1.0)
    nodes, played = drawn(mark(frames(np.arange(0.0, 1.0, 1 / 30)), recording.times))
    assert any(name.startswith("/bodies/") for name in nodes) and "/person/person head" in nodes
    moved = {t for t, m in played if t > 0.0 and m.get("name", "").startswith("/person/")}
    assert 10 < len(moved) <= len(recording) - 1
    assert moved <= set(recording.times.tolist())
    with pytest.raises(InputError, match="has 2 frames, but the recording"):
        playback_html(recording, persons=[mark(frames([0.0, 0.1]), [0.0, 0.1])])


def test_a_person_who_leaves_is_gone_and_comes_back() -> None:
    times = make_recording(seconds=1.0).times
    seen = np.concatenate([np.arange(0.0, 0.2, 0.04), np.arange(0.8, 1.0, 0.04)])
    _, played = drawn(mark(frames(seen), times))
    shown = [
        (round(t, 2), m["visible"])
        for t, m in played
        if m["type"] == "SetSceneNodeVisibilityMessage" and m["name"] == "/person/person head/seen" and t > 0.0
    ]
    assert [visible for _, visible in shown] == [False, True]
    assert 0.4 <= shown[0][0] <= 0.48 and shown[1][0] == pytest.approx(0.8, abs=0.041)


def test_nobody_draws_nothing() -> None:
    nodes, _ = drawn(mark([Skeleton(0.0, np.full((25, 3), np.nan))], [0.0]), 0.0)
    assert not any(name.startswith("/person/") for name in nodes)


def test_wrong_shapes_and_nobody_are_told() -> None:
    with pytest.raises(InputError, match="needs positions"):
        PersonMark("x", np.zeros((2, 3, 3)), np.zeros((2, len(JOINTS)), np.int8))
    with pytest.raises(InputError, match="no skeleton"):
        PersonMark.beside([], [0.0], FACING)
