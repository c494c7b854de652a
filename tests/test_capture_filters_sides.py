from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.filters import MEMORY, SideFilter, SideMemory, unswapped
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.recording import read_recording
from imitarm.capture.skeleton import JOINT, Skeleton, Tracking
from imitarm.capture.synthetic import SyntheticSource
from recording_samples import Listed, changed, exchanged, same, skeletons

HANDS = ("wrist", "hand", "hand_tip", "thumb")


@pytest.mark.parametrize("parts", [None, HANDS, ("elbow", *HANDS)], ids=["body", "hands", "arms"])
@pytest.mark.parametrize("rate", [30.0, 15.0])
def test_sides_that_are_exchanged_are_exchanged_back(parts, rate):
    before, after = skeletons(2, rate=rate)
    wrong = exchanged(after, parts)
    assert not same(wrong, after)
    assert same(unswapped(wrong, before), after)
    assert unswapped(after, before) is after


def test_the_body_exchanged_but_not_the_arms():
    before, after = skeletons(2)
    wrong = exchanged(after, ("shoulder", "hip", "knee", "ankle", "foot"))
    assert same(unswapped(wrong, before), after)


def test_a_run_of_exchanged_frames_never_reaches_the_robot():
    frames = skeletons(90)
    wrong = [exchanged(s) if 20 <= i < 35 or i == 60 else s for i, s in enumerate(frames)]
    wrong = [exchanged(s, HANDS) if 70 <= i < 72 else s for i, s in enumerate(wrong)]
    guard = SideFilter(Listed(wrong))
    assert all(map(same, guard, frames)) and guard.swaps == 15 + 1 + 2


def test_a_hand_that_is_put_where_the_other_was_is_the_other():
    """When one hand is lost a camera may show the other one in its place."""
    memory = SideMemory()
    before, after = skeletons(2)
    memory.update(before)
    positions, tracking = np.array(after.positions), np.array(after.tracking)
    for part in HANDS:
        left, right = JOINT[f"{part}_left"], JOINT[f"{part}_right"]
        positions[right], tracking[left] = positions[left], Tracking.LOST
    right = memory.update(Skeleton(after.time, positions, tracking))
    assert memory.swaps == 1 and not right.arm("right").seen
    np.testing.assert_array_equal(right.joint("wrist_left"), after.joint("wrist_left"))


def test_a_joint_that_was_lost_for_a_moment_is_remembered():
    frames = skeletons(6)
    tracking = np.array(frames[0].tracking)
    tracking[[JOINT["wrist_right"], JOINT["elbow_right"]]] = Tracking.LOST
    hidden = [changed(s, tracking=tracking) if 1 <= i < 5 else s for i, s in enumerate(frames)]
    guard = SideFilter(Listed([*hidden[:5], exchanged(frames[5], HANDS)]))
    assert same(list(guard)[-1], frames[5])


def test_after_a_long_gap_the_camera_is_believed():
    before, after = skeletons(2)
    late = changed(exchanged(after), time=before.time + MEMORY + 0.1)
    assert same(list(SideFilter(Listed([before, late])))[-1], late)


def test_every_person_has_sides_of_their_own():
    a, b = skeletons(10, person=1), skeletons(10, person=2, away=0.35)
    mixed = [s for pair in zip(a, b, strict=True) for s in pair]
    guard = SideFilter(Listed(mixed))
    assert all(map(same, guard, mixed)) and guard.swaps == 0


def test_hands_that_meet_and_cross_are_left_alone():
    """Both wrists go through each other's place at 1 m/s."""
    frames = skeletons(60)
    for i, s in enumerate(frames):
        positions = np.array(s.positions)
        away = (i - 30) / 30
        positions[JOINT["wrist_left"]] = positions[JOINT["spine_mid"]] + [away, 0.0, -0.4]
        positions[JOINT["wrist_right"]] = positions[JOINT["spine_mid"]] + [-away, 0.0, -0.45]
        frames[i] = changed(s, positions=positions)
    guard = SideFilter(Listed(frames))
    assert all(map(same, guard, frames)) and guard.swaps == 0


def test_a_person_who_turns_round_keeps_both_arms():
    """At the back a camera changes its mind about left and right; the arms are still where they were."""
    frames = skeletons(120)
    turned = []
    for i, s in enumerate(frames):
        angle = np.pi * i / 119
        middle = s.joint("spine_base")
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        turned.append(changed(s, positions=(s.positions - middle) @ turn.T + middle))
    shown = [exchanged(s) if i > 60 else s for i, s in enumerate(turned)]
    assert all(map(same, SideFilter(Listed(shown)), turned))


def test_nothing_is_touched_in_real_recordings(real_data):
    for path in sorted((real_data / "kinect_gestures").glob("*.csv")):
        recording = read_recording(path)
        guard = SideFilter(recording)
        assert all(a is b for a, b in zip(guard, recording.skeletons, strict=True)) and guard.swaps == 0


def test_noise_and_dropouts_are_no_swaps_and_swaps_in_noise_are_found():
    for seed in range(4):
        truth = reaching(Person.from_seed(seed), seed, kind="edge")
        frames = list(SyntheticSource(truth, SkeletonCamera(seed, dropout=0.5), 12.0))
        assert all(a is b for a, b in zip(SideFilter(Listed(frames)), frames, strict=True))
        wrong = [exchanged(s) if i % 50 > 40 else s for i, s in enumerate(frames)]
        guard = SideFilter(Listed(wrong))
        assert all(map(same, guard, frames))


def test_closing_reaches_the_source():
    source = Listed([None])
    guard = SideFilter(source)
    assert guard.read() is None and guard.over
    guard.close()
    assert source.closed
