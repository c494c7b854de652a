from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.mediapipe_environment import VARIABLE
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.sensor_quality import (
    agreement,
    arm_raised,
    bone,
    elbow_bent,
    guarded,
    main,
    tracked_fraction,
    wrist_difference,
)
from imitarm.capture.skeleton import JOINT, Tracking
from imitarm.kinematics.pose import quaternion_to_matrix
from mediapipe_samples import SIZE, line, player, seen, standing
from recording_samples import changed, exchanged, skeletons


def test_angles_are_the_same_from_everywhere_and_agree():
    frames = skeletons(60)
    turn = quaternion_to_matrix(np.array([0.8, 0.2, 0.4, -0.4]))
    turned = SkeletonRecording([changed(s, positions=s.positions @ turn.T + [0.3, 0.0, 1.0]) for s in frames])
    for signal in (arm_raised, elbow_bent):
        one, other = signal(SkeletonRecording(frames), "right"), signal(turned, "right")
        assert one.keys() == other.keys() and len(one) == 60
        assert list(one.values()) == pytest.approx(list(other.values()), abs=1e-9)
        assert agreement(one, other) == (pytest.approx(1.0), 60)


def test_what_two_views_differ_by_is_the_error_of_both():
    frames, rng = skeletons(90), np.random.default_rng(2)
    turn = quaternion_to_matrix(np.array([0.1, 0.7, -0.5, 0.5]))
    views = []
    for _ in range(2):
        noise = rng.normal(scale=0.02, size=(90, 25, 3))
        views.append([changed(s, positions=s.positions + e) for s, e in zip(frames, noise, strict=True)])
    views[1] = [changed(s, positions=s.positions @ turn.T + [0.0, 0.2, 3.0]) for s in views[1]]
    found = wrist_difference(*map(SkeletonRecording, views))
    assert found == pytest.approx(0.02 * np.sqrt(2 * 2 * 3), rel=0.1)  # two views, wrist and shoulder, three axes
    assert np.isnan(wrist_difference(*(SkeletonRecording(view[:5]) for view in views)))


def test_what_is_not_tracked_does_not_count():
    frames = skeletons(60)
    for i in range(50):
        tracking = np.array(frames[i].tracking)
        tracking[JOINT["wrist_right"]] = Tracking.INFERRED
        frames[i] = changed(frames[i], tracking=tracking)
    recording = SkeletonRecording(frames)
    assert tracked_fraction(recording, "right") == pytest.approx(1 / 6) and tracked_fraction(recording, "left") == 1.0
    assert len(arm_raised(recording, "right")) == 10
    alike, n = agreement(arm_raised(recording, "right"), arm_raised(recording, "left"))
    assert np.isnan(alike) and n == 10
    length, spread = bone(recording, "left", "forearm")
    assert 0.2 < length < 0.35 and spread < 1e-6


def test_sides_are_kept_apart():
    frames = skeletons(60)
    mixed = SkeletonRecording([exchanged(s) if 20 <= i < 40 else s for i, s in enumerate(frames)])
    assert agreement(arm_raised(guarded(mixed), "right"), arm_raised(SkeletonRecording(frames), "right"))[0] > 0.999


def test_the_command_prints_every_view_and_every_pair(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(1)
    lines = [f"imitarm-mediapipe 1 {SIZE[0]} {SIZE[1]}"]
    for i in range(40):
        points = standing()
        points[13:23] += 0.1 * np.sin(0.3 * i) + 0.002 * rng.normal(size=(10, 3))
        lines.append(line(seen(points, np.array([0.0, 0.0, 2.5]), time=i / 30)))
    program = "\n".join(f"print({text!r}, flush=True)" for text in [*lines, "end 40"])
    monkeypatch.setenv(VARIABLE, str(player(tmp_path, program)))
    films = [tmp_path / "a.mp4", tmp_path / "b.mp4"]
    assert main([str(film) for film in films]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("video:a.mp4: 40 images, 40 with a person") and "left arm tracked in 100 %" in shown[1]
    assert shown[-1].startswith("video:a.mp4 and video:b.mp4: left raised 1.00 (40)")
    assert main([]) == 2 and "give one or more" in capsys.readouterr().err
