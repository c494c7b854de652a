from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.formats import MotionCapture, is_motion_capture
from imitarm.capture.recording import read_recording
from imitarm.capture.skeleton import JOINT, JOINTS, Tracking
from imitarm.capture.sources import open_source
from imitarm.errors import FileFormatError
from imitarm.retarget import FACING

MARKERS = ("right_shoulder", "right_elbow", "hand_left", "hand_right", "middle_middle", "thumb_middle")
ARM = ((0, 0, 0), (0, -50, -280), (240, -40, -280), (240, -60, -280), (310, -50, -280), (280, 0, -290))


def export(path, n=30, *, markers=MARKERS):
    """An export of an arm that is lifted; numbers in millimetres, x forward, y left, z up."""
    names = "\t".join(markers)
    rows = []
    for i in range(n):
        points = np.array(
            [[0, 0, 0], [0, -50, -280], [240, -40, -280], [240, -60, -280], [310, -50, -280], [280, 0, -290]]
        )
        points[1:, 2] += 4 * i
        cells = "\t".join(f"{value:.3f}" for point in points[: len(markers)] for value in point)
        rows.append(f"{i + 1}\t{0.01 * i:.5f}\t{cells}")
    head = f"NO_OF_FRAMES\t{n}\nFREQUENCY\t100\nMARKER_NAMES\t{names}\nFrame\tTime\tand so on\n"
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def test_the_content_tells_it_and_the_arm_is_the_captured_one(tmp_path):
    path = export(tmp_path / "arm.csv")  # the name tells nothing
    recording = open_source(path)
    assert len(recording) == 30 and recording.rate == pytest.approx(100.0)
    captured = MotionCapture.load(path)
    arms = [skeleton.arm("right") for skeleton in recording.skeletons]
    seen = np.array([FACING.apply(arm.points[[0, 1, 2, 4, 5]]) for arm in arms])
    apart = seen - captured.points
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0, 0], apart.shape), atol=1e-6)  # only moved as a whole
    assert all((arm.confidence == 1.0).all() for arm in arms)


def test_the_rest_of_the_body_is_given_as_inferred(tmp_path):
    recording = read_recording(export(tmp_path / "arm.tsv"))
    tracking = recording.skeletons[0].tracking
    assert (tracking == Tracking.TRACKED).sum() == 6
    assert (tracking == Tracking.INFERRED).sum() == len(JOINTS) - 6
    assert recording.skeletons[0].positions[JOINT["head"], 1] > recording.skeletons[0].positions[JOINT["foot_left"], 1]
    assert [finding.code for finding in recording.issues] == ["arm-only"]


def test_what_is_none_is_left_to_the_other_readers_and_damage_is_told(tmp_path):
    assert not is_motion_capture(b"# format: imitarm-skeletons\n")
    assert not is_motion_capture(b"1,2,3\nMARKER_NAMES\t")
    with pytest.raises(FileFormatError, match="marker 'thumb_middle' is missing"):
        read_recording(export(tmp_path / "few.tsv", markers=MARKERS[:-1]))
    whole = export(tmp_path / "whole.tsv").read_bytes()
    (tmp_path / "cut.tsv").write_bytes(whole[:-60])
    with pytest.raises(FileFormatError, match=r"cut\.tsv, line \d+"):
        read_recording(tmp_path / "cut.tsv")


def test_the_real_one(real_data):
    recording = read_recording(real_data / "mocap_arm" / "recording.tsv")
    assert len(recording) == 6000 and recording.duration == pytest.approx(59.99)
    assert all(skeleton.arm("right").seen for skeleton in recording.skeletons)
