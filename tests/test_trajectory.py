from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from demonstration_samples import motion
from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import quaternion_exp
from imitarm.trajectory import Demonstration, Rollout, Trajectory

LINE = Trajectory([0.0, 1.0, 3.0], [[0, 0, 0], [1, 0, 0], [1, 2, 0]])
coordinate = st.floats(-2.0, 2.0, allow_subnormal=False)


def test_figures_of_a_trajectory():
    assert len(LINE) == 3
    assert LINE.duration == 3.0
    assert LINE.path_length == pytest.approx(3.0)
    assert LINE.pose(1).position.tolist() == [1, 0, 0]
    assert LINE.pose(1).quaternion.tolist() == [1, 0, 0, 0]


def test_arrays_are_copies_and_read_only():
    times = np.array([0.0, 1.0])
    trajectory = Trajectory(times, np.zeros((2, 3)))
    times[0] = 9.0
    assert trajectory.times[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        trajectory.positions[0, 0] = 1.0


@pytest.mark.parametrize(
    ("times", "positions", "quaternions", "message"),
    [
        ([0, 1], np.zeros((2, 2)), None, r"positions must be an array of shape \(2, 3\)"),
        ([0, 1], np.zeros((3, 3)), None, "positions must be an array of shape"),
        ([0], np.zeros((1, 3)), None, "at least 2 samples"),
        ([0, 0], np.zeros((2, 3)), None, "row 1 .* not later"),
        ([0, 2, 1], np.zeros((3, 3)), None, "row 2 .* not later"),
        ([0, np.nan], np.zeros((2, 3)), None, r"times\[1\] is nan"),
        ([0, 1], [[0, 0, 0], [0, np.inf, 0]], None, r"positions\[1, 1\] is inf"),
        ([0, 1], np.zeros((2, 3)), [[1, 0, 0, 0], [0, 0, 0, 0]], "quaternion 1 has length 0"),
        ([0, 1], np.zeros((2, 3)), np.zeros((2, 3)), "quaternions must be an array of shape"),
        (["a", "b"], np.zeros((2, 3)), None, r"times must be numbers \[s\]"),
    ],
)
def test_what_is_wrong_is_said_at_construction(times, positions, quaternions, message):
    with pytest.raises(InputError, match=message):
        Trajectory(times, positions, quaternions)


def test_quaternion_signs_become_continuous():
    q = quaternion_exp(np.outer(np.linspace(0, 1, 5), [0, 0, 1.0]))
    flipped = q * np.array([1, -1, 1, 1, -1])[:, None]
    assert np.allclose(Trajectory(np.arange(5.0), np.zeros((5, 3)), flipped).quaternions, q)


def test_interpolation_holds_the_ends_and_resample_keeps_them():
    positions, quaternions = LINE.at([-1.0, 2.0, 9.0])
    assert positions.tolist() == [[0, 0, 0], [1, 1, 0], [1, 2, 0]]
    assert quaternions is None
    resampled = motion(rotations=True).trajectory.resample(57)
    original = motion(rotations=True).trajectory
    assert np.allclose(np.diff(resampled.times), original.duration / 56)
    assert np.allclose(resampled.positions[[0, -1]], original.positions[[0, -1]])
    assert np.allclose(resampled.quaternions[-1], original.quaternions[-1])
    with pytest.raises(InputError, match="at least 2"):
        LINE.resample(1)


def test_from_zero_changes_the_clock_only():
    shifted = Trajectory(LINE.times + 1.7e9, LINE.positions)
    assert np.allclose(shifted.from_zero().times, LINE.times)
    assert np.array_equal(shifted.from_zero().positions, LINE.positions)


def test_joints_have_a_row_for_each_sample_and_a_name_for_each_column():
    assert Demonstration(LINE, np.zeros((3, 2))).joint_names == ("joint_1", "joint_2")
    assert Demonstration(LINE, None, joint_names=("a",)).joint_names == ()
    with pytest.raises(InputError, match=r"joints of recorder must be .* shape \(3, n\) \[rad\], got shape \(4, 2\)"):
        Demonstration(LINE, np.zeros((4, 2)), source="recorder")
    for names in (("a",), ("a", "a")):
        with pytest.raises(InputError, match="2 columns need as many different joint_names"):
            Demonstration(LINE, np.zeros((3, 2)), joint_names=names)


def test_least_clearance_of_a_rollout():
    rollout = Rollout(LINE, np.zeros((3, 7)), np.zeros((3, 7)), np.zeros((3, 7)), np.array([0.2, 0.1, 0.3]), True)
    assert rollout.min_clearance == 0.1


@given(
    positions=arrays(float, (4, 3), elements=coordinate),
    turns=st.one_of(st.none(), arrays(float, (4, 3), elements=st.floats(-1.5, 1.5, allow_subnormal=False))),
    joints=st.one_of(st.none(), arrays(float, (4, 2), elements=coordinate)),
    start=st.sampled_from([0.0, 1.0, 1.7e9]),
)
def test_a_saved_demonstration_comes_back(tmp_path_factory, positions, turns, joints, start):
    file = tmp_path_factory.mktemp("saved") / "one.csv"
    quaternions = None if turns is None else quaternion_exp(turns)
    trajectory = Trajectory(start + np.array([0.0, 0.1, 0.25, 0.3]), positions, quaternions)
    names = () if joints is None else ("right_j0", "right_j1")
    Demonstration(trajectory, joints, "sweep: the table", "a recorder", names).save(file)
    loaded = Demonstration.load(file)
    assert np.array_equal(loaded.trajectory.times, trajectory.times)
    assert np.array_equal(loaded.trajectory.positions, trajectory.positions)
    assert (loaded.trajectory.quaternions is None) == (quaternions is None)
    if quaternions is not None:
        assert np.allclose(loaded.trajectory.quaternions, trajectory.quaternions, rtol=0, atol=1e-15)
    assert (loaded.joints is None) == (joints is None)
    if joints is not None:
        assert np.array_equal(loaded.joints, joints)
    assert loaded.joint_names == names
    assert loaded.task == "sweep: the table"
    assert loaded.source == str(file)


def test_the_file_says_units_and_frame(tmp_path):
    file = tmp_path / "one.csv"
    motion(rotations=True, joints=True, n=3, source="a person").save(file)
    assert file.read_text().splitlines()[:8] == [
        "# format: imitarm-demonstration",
        "# version: 1",
        "# units: m s rad",
        "# frame: tool_to_base",
        "# task: reach",
        "# source: a person",
        "# samples: 3",
        "t,x,y,z,qw,qx,qy,qz,joint_1,joint_2",
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# format: imitarm-demonstration\n", "", "no line '# format: imitarm-demonstration'"),
        ("version: 1", "version: 2", r"format version '2'; this imitarm reads versions up to 1; update"),
        ("version: 1", "version: one", "format version 'one'"),
        ("units: m s rad", "units: mm s rad", "units is 'mm s rad'"),
        ("frame: tool_to_base", "frame: camera", "frame is 'camera'"),
        ("samples: 300", "samples: 301", "announces 301 samples, but the file holds 300; the file is incomplete"),
        ("t,x,y,z", "t,x,z,y", "first columns must be t,x,y,z"),
        ("t,x,y,z\n", "", "first columns must be t,x,y,z, got no names"),
    ],
)
def test_a_changed_file_is_refused(tmp_path, old, new, message):
    file = tmp_path / "one.csv"
    motion().save(file)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(FileFormatError, match=message) as caught:
        Demonstration.load(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut_anywhere_is_refused(tmp_path, keep):
    file = tmp_path / "one.csv"
    motion(rotations=True).save(file)
    content = file.read_bytes()
    file.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(FileFormatError, match="cut off"):
        Demonstration.load(file)
    file.write_bytes(content[: content.rindex(b"\n", 0, int(keep * len(content))) + 1])  # between two rows
    with pytest.raises(FileFormatError, match="incomplete"):
        Demonstration.load(file)


def test_a_bad_row_is_named_with_its_line(tmp_path):
    file = tmp_path / "one.csv"
    motion(n=5).save(file)
    lines = file.read_text().splitlines()
    lines[-1] = "0.0," + lines[-1].split(",", 1)[1]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(FileFormatError, match=r"row 0 is line 9.*row 4 .* not later"):
        Demonstration.load(file)


@pytest.mark.parametrize("name", ["a,b", "x", "7", "nan", "", " a", "a\nb", "#a"])
def test_a_joint_that_could_not_be_a_column_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="can't be the name of a joint's column"):
        Demonstration(LINE, np.zeros((3, 1)), joint_names=(name,)).save(tmp_path / "one.csv")
    assert not list(tmp_path.iterdir())


ZEROS = np.zeros((3, 7))
ROLLOUT = Rollout(LINE, ZEROS, ZEROS, ZEROS, np.array([0.2, 0.1, np.inf]), True)


def test_the_clearance_of_a_rollout_may_be_unknown():
    unknown = replace(ROLLOUT, clearance=np.full(3, np.nan))
    assert np.isnan(unknown.min_clearance)
    assert repr(unknown) == "Rollout(succeeded, 3 samples, 3 s, smallest clearance not measured)"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trajectory": None}, "trajectory must be a Trajectory"),
        ({"joints": np.zeros((2, 7))}, r"joints must be an array of shape \(3, n\)"),
        ({"velocities": np.zeros((3, 6))}, r"velocities must be an array of shape \(3, 7\)"),
        ({"torques": np.full((3, 7), np.nan)}, r"torques\[0, 0\] is nan"),
        ({"clearance": [0.1, np.nan, 0.1]}, "NaN in row 1"),
        ({"success": "no"}, "success must be True or False"),
        ({"reason": None}, "reason must be text"),
        ({"details": [1]}, "details must be a Mapping"),
    ],
)
def test_a_rollout_is_checked(change, message):
    with pytest.raises(InputError, match=message):
        replace(ROLLOUT, **change)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Demonstration(None),
        lambda: Demonstration(LINE, task=3),
        lambda: Demonstration(LINE, source=None),
        lambda: Demonstration(LINE, np.zeros((3, 2)), joint_names="ab"),
        lambda: Demonstration(LINE, np.zeros((3, 2)), joint_names=(1, 2)),
        lambda: Demonstration(LINE).save(None),
        lambda: Demonstration(LINE).save("a\0b"),
        lambda: Demonstration.load(3),
        lambda: Demonstration.load(b"a"),
        lambda: LINE.at([0.0, np.nan]),
        lambda: LINE.at("now"),
        lambda: LINE.at([[0.0]]),
        lambda: LINE.at(None),
        lambda: LINE.pose(3),
        lambda: LINE.pose(-4),
        lambda: LINE.pose(1.0),
        lambda: LINE.resample(2.5),
        lambda: LINE.resample(np.nan),
        lambda: LINE.resample(10**12),
        lambda: Trajectory(None, None),
        lambda: Trajectory([0.0, np.inf], np.zeros((2, 3))),
        lambda: Trajectory([True, False], np.zeros((2, 3))),
    ],
)
def test_what_cannot_be_used_is_refused(call):
    with pytest.raises(InputError):
        call()


def test_short_reprs_name_the_figures():
    assert repr(LINE) == "Trajectory(3 samples, 3 s, path 3 m, without rotation)"
    one = Demonstration(LINE, np.zeros((3, 2)), task="sweep")
    assert repr(one) == "Demonstration('sweep', 3 samples, 3 s, path 3 m, without rotation, 2 joints)"
    assert repr(ROLLOUT) == "Rollout(succeeded, 3 samples, 3 s, smallest clearance 0.1 m)"


def test_a_notebook_shows_a_table():
    one = Demonstration(LINE, np.zeros((3, 2)), task="<sweep>", joint_names=("a", "b"))
    for thing, texts in (
        (LINE, ["Trajectory", "samples", "3", "3 s", "3 m", "(0, 0, 0), (1, 2, 0) m"]),
        (one, ["Demonstration", "<sweep>", "a, b"]),
        (ROLLOUT, ["Rollout", "yes", "0.1 m", "0 rad/s", "0 N m"]),
    ):
        shown = [element.text for element in ElementTree.fromstring(thing._repr_html_()).iter()]
        assert set(texts) <= set(shown)
