"""Recordings of joint angles, such as Rethink's joint_recorder.py writes: the tool's poses follow from the arm."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.demonstrations import lint, read, read_raw
from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.arm import ArmModel

JOINTS = [f"right_j{i}" for i in range(7)]


@pytest.fixture(scope="module")
def sawyer():
    return ArmModel.load("sawyer")


def recording(file, arm, *, gripper=True, n=80):
    """What joint_recorder.py writes: with a gripper a column for it, without one a comma at the end of each line."""
    times = 0.01 * np.arange(n)
    swing = 0.3 * np.sin(np.linspace(0.0, 1.5, n))[:, None] * np.array([1, -1, 1, 1, -1, 1, 1])
    q = arm.home + swing
    head = "time," + ",".join(JOINTS) + "," + ("right_gripper" if gripper else "")
    end = "0.0402" if gripper else ""
    rows = [f"{t:.6f}," + ",".join(map(repr, row.tolist())) + "," + end for t, row in zip(times, q, strict=True)]
    file.write_text("\n".join([head, *rows]) + "\n")
    return times, q


@pytest.mark.parametrize("gripper", [True, False])
def test_positions_follow_from_the_arm(tmp_path, sawyer, gripper):
    times, q = recording(tmp_path / "a.csv", sawyer, gripper=gripper)
    (one,) = read(tmp_path / "a.csv", arm=sawyer)
    assert np.allclose(one.trajectory.times, times)
    assert np.array_equal(one.joints, q)
    assert one.joint_names == tuple(JOINTS)
    for row in (0, 40, 79):
        pose = sawyer.tool_pose(q[row])
        assert np.allclose(one.trajectory.positions[row], pose.position)
        assert abs(one.trajectory.quaternions[row] @ pose.quaternion) == pytest.approx(1.0)


def test_the_tool_counts(tmp_path):
    brush = ArmModel.load("sawyer", tool="brush")
    _, q = recording(tmp_path / "a.csv", brush)
    (one,) = read(tmp_path / "a.csv", arm=brush)
    assert np.allclose(one.trajectory.positions[0], brush.tool_pose(q[0]).position)
    assert np.linalg.norm(one.trajectory.positions[0] - brush.forward_kinematics(q[0]).position) > 0.05


def test_the_column_that_is_not_used_is_noted(tmp_path, sawyer):
    recording(tmp_path / "a.csv", sawyer)
    (raw,) = read_raw(tmp_path / "a.csv")
    assert raw.positions is None
    assert raw.notes == ("columns not used: right_gripper",)
    assert ("note", "reader") in [(finding.severity, finding.code) for finding in lint([raw], arm=sawyer)]


def test_columns_go_by_name_whatever_their_order(tmp_path, sawyer):
    _, q = recording(tmp_path / "a.csv", sawyer)
    table = [line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()]
    order = [0, 3, 1, 2, 7, 6, 5, 4, 8]
    (tmp_path / "b.csv").write_text("\n".join(",".join(row[i] for i in order) for row in table) + "\n")
    (one,) = read(tmp_path / "b.csv", arm=sawyer)
    assert np.array_equal(one.joints, q)


def test_the_arm_must_be_named_and_the_right_one(tmp_path, sawyer):
    recording(tmp_path / "a.csv", sawyer)
    with pytest.raises(InputError, match=r"joint angles only; give the arm that was recorded"):
        read(tmp_path / "a.csv")
    (finding, *_) = lint(read_raw(tmp_path / "a.csv"))
    assert (finding.severity, finding.code) == ("error", "no-positions")
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "b.csv").write_text(text.replace("right_j6", "right_j7"))
    with pytest.raises(InputError, match="right_j7 are not those of sawyer"):
        read(tmp_path / "b.csv", arm=sawyer)
    with pytest.raises(InputError, match="holds joint angles but no lengths"):
        read(tmp_path / "a.csv", units="cm", arm=sawyer)
    (tmp_path / "c.csv").write_text(text.replace("right_j6", "left_j0"))
    with pytest.raises(FileFormatError, match="joints of two arms"):
        read(tmp_path / "c.csv", arm=sawyer)


def test_a_row_that_is_broken_is_named(tmp_path, sawyer):
    recording(tmp_path / "a.csv", sawyer)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    lines[4] = lines[4].replace(lines[4].split(",")[2], "nan")
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(FileFormatError, match="line 5: the row holds a number that is not finite"):
        read(tmp_path / "a.csv", arm=sawyer)
    assert len(read(tmp_path / "a.csv", arm=sawyer, repair=True)[0]) == 79
