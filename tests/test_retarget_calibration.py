from __future__ import annotations

import json

import numpy as np
import pytest

from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.retarget.calibration import Calibration, robot_reach, suggested_scale
from imitarm.retarget.correspondence import FACING, Correspondence
from imitarm.retarget.limbs import LimbLengths

LIMBS = LimbLengths(0.301234567890123, 0.26, (0.006, 0.007), 71)
WHOLE = Calibration("left", LIMBS, Pose([2.1, 0.3, 0.9], quaternion_exp([0.3, 1.1, -0.4])), 0.011, 1.43, "upright")


def test_a_calibration_comes_back_to_the_last_bit(tmp_path):
    WHOLE.save(tmp_path / "c.json")
    back = Calibration.load(tmp_path / "c.json")
    assert (back.side, back.lengths, back.sensor_rms, back.scale, back.orientation) == (
        "left",
        LIMBS,
        0.011,
        1.43,
        "upright",
    )
    np.testing.assert_array_equal(back.sensor_to_base.position, WHOLE.sensor_to_base.position)
    np.testing.assert_allclose(back.sensor_to_base.quaternion, WHOLE.sensor_to_base.quaternion, rtol=0, atol=1e-16)
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_what_was_not_measured_is_the_usual(tmp_path):
    Calibration().save(tmp_path / "c.json")
    found, usual = Calibration.load(tmp_path / "c.json").correspondence(), Correspondence()
    assert found.sensor_to_base is FACING and found.lengths is None
    assert (found.side, found.scale, found.orientation) == (usual.side, usual.scale, usual.orientation)


def test_a_correspondence_holds_all_that_was_measured():
    found = WHOLE.correspondence()
    assert found.sensor_to_base is WHOLE.sensor_to_base and found.lengths is LIMBS
    assert (found.side, found.scale, found.orientation) == ("left", 1.43, "upright")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "not a calibration"),
        ({"version": 2}, "has version 2, but this imitarm reads version 1; update imitarm"),
        ({"version": True}, "has version True"),
        ({"side": "both"}, "unknown side 'both'; known: left, right"),
        ({"side": 3}, "'side' must be text"),
        ({"scale": "1"}, "'scale' must contain numbers"),
        ({"scale": 99.0}, "scale must be a finite number"),
        ({"scale": 10**400}, "'scale' must be a finite number"),
        ({"orientation": "sideways"}, "unknown orientation 'sideways'"),
        ({"orientation": 1}, "'orientation' must be text"),
        ({"scala": 1.0}, "unknown field 'scala'; known: .*scale"),
        ({"limbs": [1, 2]}, "limbs: must be a group of named fields, but is list"),
        ({"limbs": {"upper_arm": 0.3}}, "limbs: field 'spread' is missing"),
        ({"limbs": {"upper_arm": 30.0, "forearm": 26.0, "spread": [0, 0], "n_frames": 9}}, "is the unit metres"),
        ({"limbs": {"upper_arm": 0.3, "forearm": 0.3, "spread": [0, 0], "n_frames": 1.5}}, "n_frames must be a whole"),
        ({"sensor_to_base": {"position": [0, 0], "quaternion": [1, 0, 0, 0]}}, "'position' must be 3 finite"),
        ({"sensor_to_base": {"position": [0, 0, 0], "quaternion": [2, 0, 0, 0]}}, "quaternion"),
        ({"sensor_to_base": {"position": [0, 0, 0], "quaternion": [1, 0, 0, 0], "rms": -1}}, "sensor_rms"),
    ],
)
def test_a_file_that_was_altered_is_refused_with_its_name_and_the_field(tmp_path, change, message):
    path = tmp_path / "c.json"
    WHOLE.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(FileFormatError, match=rf"c\.json: .*{message}"):
        Calibration.load(path)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff\xfe", b"NaN", b"[" * 100000])
def test_a_file_that_is_no_calibration_is_refused(tmp_path, content):
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"c\.json: (not readable as JSON|not a calibration)"):
        Calibration.load(path)


def test_a_missing_file_says_how_to_make_one_and_a_failed_write_loses_nothing(tmp_path):
    with pytest.raises(InputError, match="create a calibration with 'imitarm calibrate'"):
        Calibration.load(tmp_path / "c.json")
    with pytest.raises(InputError, match="can't be written"):
        WHOLE.save(tmp_path / "no" / "c.json")
    WHOLE.save(tmp_path / "c.json")
    before = (tmp_path / "c.json").read_bytes()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="can't be written"):
        WHOLE.save(tmp_path / "folder")
    assert (tmp_path / "c.json").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.json", "folder"]


@pytest.mark.parametrize("name", ["sawyer", "panda"])
def test_the_reach_is_that_of_the_stretched_arm(name):
    arm = ArmModel.load(name)
    reach = robot_reach(arm)
    rng = np.random.default_rng(0)
    lower, upper = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    found = []
    for _ in range(3000):
        shoulder, _, wrist = arm.sew_points(rng.uniform(lower, upper))
        found.append(np.linalg.norm(wrist - shoulder))
    assert max(found) <= reach * 1.001 and reach < 1.02 * max(found)


def test_the_scale_maps_the_person_s_reach_on_the_robot_s():
    arm = ArmModel.load("sawyer")
    assert suggested_scale(arm, LIMBS) * LIMBS.reach == pytest.approx(robot_reach(arm))
    assert suggested_scale(arm, LIMBS, "object") == 1.0
