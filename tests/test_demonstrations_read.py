from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from demonstration_samples import motion, path
from imitarm.demonstrations import READERS, RawDemonstration, Reader, align, files_of, lint, read, read_raw
from imitarm.errors import FileFormatError, InputError, UnknownNameError


def rows(n=6):
    return np.column_stack([np.linspace(0.0, 1.0, n), path(np.linspace(0.0, 1.0, n))])


def write(file, table, header="t,x,y,z"):
    np.savetxt(file, table, delimiter=",", header=header, comments="")
    return file


def test_every_reader_knows_its_suffixes():
    assert all(issubclass(reader, Reader) and reader.suffixes for reader in READERS.values())
    assert len(READERS) == 3


def test_a_file_a_list_and_a_folder(tmp_path):
    for number in (10, 2, 1):
        write(tmp_path / f"demo_{number}.csv", rows())
    np.save(tmp_path / "stack.npy", np.zeros((2, 5, 4)) + np.arange(5)[:, None])
    (tmp_path / "notes.md").write_text("not a demonstration")
    (tmp_path / ".demo.csv").write_text("hidden")
    (tmp_path / "inner.csv").mkdir()
    assert [Path(f).name for f in files_of(tmp_path)] == [
        "demo_1.csv",
        "demo_2.csv",
        "demo_10.csv",
        "stack.npy",
    ]
    assert len(read(tmp_path / "demo_1.csv")) == 1
    assert len(read([tmp_path / "demo_1.csv", str(tmp_path / "demo_2.csv")])) == 2
    everything = read(tmp_path, task="reach")
    assert [Path(one.source).name for one in everything][2:] == ["demo_10.csv", "stack.npy[0]", "stack.npy[1]"]
    assert {one.task for one in everything} == {"reach"}


def test_nothing_to_read(tmp_path):
    (tmp_path / "notes.md").write_text("")
    with pytest.raises(InputError, match=r"holds no demonstrations; known endings: \.csv, \.dat"):
        read(tmp_path)
    with pytest.raises(InputError, match="name at least one"):
        read([])
    with pytest.raises(InputError, match="can't be read"):
        read(tmp_path / "missing.csv")


def test_the_content_decides_and_a_name_must_not_lie(tmp_path):
    np.save(tmp_path / "a.npy", rows())
    (tmp_path / "a.npy").rename(tmp_path / "array.csv")
    with pytest.raises(
        FileFormatError, match=r"array\.csv: named \.csv \(imitarm CSV\), but its content is a NumPy array"
    ):
        read(tmp_path / "array.csv")
    write(tmp_path / "text.npy", rows())
    with pytest.raises(FileFormatError, match=r"text\.npy: named \.npy \(NumPy arrays\), but its content is text"):
        read(tmp_path / "text.npy")
    write(tmp_path / "recording", rows())  # no ending at all
    assert len(read(tmp_path / "recording")) == 1
    (tmp_path / "bag.bag").write_bytes(b"#ROSBAG V2.0\n\x00\x00")
    with pytest.raises(
        FileFormatError,
        match=r"this is a ROS 1 bag; known formats: imitarm CSV \(\.csv\), NumPy arrays \(\.npy \.npz\)",
    ):
        read(tmp_path / "bag.bag")
    (tmp_path / "model.npy").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(FileFormatError, match="Python pickle, which is never opened"):
        read(tmp_path / "model.npy")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"units": "yd"}, UnknownNameError, "unknown unit of length 'yd'.*; known: cm, ft, in, m, mm"),
        ({"time_units": "days"}, UnknownNameError, "unknown unit of time"),
        ({"quaternion_order": "zyxw"}, UnknownNameError, "unknown quaternion order"),
        ({"duration": 0.0}, InputError, "duration must be a finite number above 0"),
        ({"rate": float("nan")}, InputError, "rate must be a finite number above 0"),
        ({"duration": 1.0, "rate": 2.0}, InputError, "not both"),
        ({"duration": 1.0}, InputError, "its own time stamps"),
    ],
)
def test_options_that_can_not_be(tmp_path, options, error, message):
    file = write(tmp_path / "a.csv", rows())
    with pytest.raises(error, match=message):
        read(file, **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t[[0, 1, 3, 2, 4, 5]], r"line 5: the time is not later than in the previous row; fix .*repair=True"),
        (
            lambda t: np.where(np.arange(6)[:, None] == 2, np.nan, t),
            "line 4: the row holds a number that is not finite",
        ),
        (lambda t: t * [1, np.inf, 1, 1], "line 2: the row holds a number that is not finite"),
        (lambda t: t * [1, 1e9, 1, 1], r"line 2: no robot reaches the position"),
        (lambda t: t[:1], "1 rows|of 1 rows"),
    ],
)
def test_rows_that_can_not_be_used(tmp_path, change, message):
    file = write(tmp_path / "a.csv", change(rows()))
    with pytest.raises(FileFormatError, match=message) as caught:
        read(file)
    assert str(file) in str(caught.value)


def test_repair_drops_a_few_rows_and_says_so(tmp_path):
    table = rows(50)
    table[7, 2] = np.nan
    table[20, 0] = table[19, 0]
    file = write(tmp_path / "a.csv", table)
    (one,) = read(file, repair=True)
    assert len(one) == 48
    assert one.source == f"{file} (2 of 50 rows dropped)"
    assert np.allclose(one.trajectory.positions, np.delete(table, [7, 20], axis=0)[:, 1:])
    table[::3, 1] = np.nan
    with pytest.raises(FileFormatError, match="rows are invalid; record it again"):
        read(write(file, table), repair=True)


def test_raw_reading_judges_nothing(tmp_path):
    (raw,) = read_raw(write(tmp_path / "a.csv", rows()[::-1]))
    assert raw.late().tolist() == [False] + 5 * [True]
    assert raw.line(0) == 2


def test_a_round_trip_through_our_own_format(tmp_path):
    original = motion(rotations=True, joints=True)
    original.save(tmp_path / "a.csv")
    (one,) = read(tmp_path / "a.csv")
    assert np.array_equal(one.trajectory.positions, original.trajectory.positions)
    assert np.allclose(one.trajectory.quaternions, original.trajectory.quaternions, rtol=0, atol=1e-15)
    assert np.array_equal(one.joints, original.joints)
    assert (one.task, one.joint_names) == ("reach", ("joint_1", "joint_2"))


@pytest.mark.parametrize(
    ("name", "n", "columns"),
    [("bottle2shelf", 9, 7), ("pouring", 9, 7), *((f"letter_{c}", 8, 2) for c in "ehlo")],
)
def test_real_recordings_of_a_guided_panda(real_data, name, n, columns):
    file = real_data / "panda_kinesthetic" / f"{name}.npy"
    demonstrations = read(file, units="cm", duration=10.0, task=name)
    content = np.load(file)
    assert len(demonstrations) == n
    for one, table in zip(demonstrations, content, strict=True):
        assert len(one) == 1000
        assert one.trajectory.duration == 10.0
        assert np.allclose(one.trajectory.positions[:, : min(columns, 3)], table[:, :3] / 100.0)
        if columns == 2:
            assert one.trajectory.quaternions is None
            assert np.all(one.trajectory.positions[:, 2] == 0.0)
        else:
            same = np.abs(np.sum(one.trajectory.quaternions * table[:, 3:], axis=1))
            assert np.allclose(same, 1.0)
    with pytest.raises(FileFormatError, match=r"no time stamps; give the duration of the motion, duration=10\.0"):
        read(file, units="cm")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("kinect_gestures/Ges01_wavehand.csv", "101 columns without names; a table without column names must have 2"),
        ("mocap_arm/recording.tsv", "recording.tsv, line "),
        ("mocap_trolley/mid.csv", "mid.csv, line 2: 8 values where 7 are expected"),
    ],
)
def test_real_recordings_of_other_things_are_refused(real_data, name, message):
    with pytest.raises(FileFormatError, match=message):
        read(real_data / name, duration=10.0)


@settings(max_examples=150)
@given(
    kind=st.sampled_from(["own.csv", "plain.txt", "a.npy", "a.npz", "b.npz"]),
    changes=st.lists(st.tuples(st.floats(0.0, 1.0), st.binary(min_size=0, max_size=4)), max_size=4),
    keep=st.one_of(st.just(1.0), st.floats(0.0, 1.0)),
)
def test_whatever_is_done_to_a_file_it_is_read_or_refused(tmp_path_factory, kind, changes, keep):
    """Bytes changed and the end cut off: either demonstrations come back or an error that names the file."""
    file = tmp_path_factory.mktemp("fuzz") / kind
    one = motion(n=20, rotations=True, joints=True)
    poses = np.column_stack([one.trajectory.positions, one.trajectory.quaternions])
    if kind == "own.csv":
        one.save(file)
    elif kind == "plain.txt":
        np.savetxt(file, poses)
    elif kind == "a.npy":
        np.save(file, poses)
    else:
        (np.savez if kind == "a.npz" else np.savez_compressed)(file, one=poses, two=poses[None])
    content = bytearray(file.read_bytes())
    for where, new in changes:
        start = int(where * len(content))
        content[start : start + len(new)] = new
    file.write_bytes(content[: int(keep * len(content))])
    options = {} if kind == "own.csv" else {"duration": 2.0}
    try:
        for demonstration in read(file, **options):
            assert np.isfinite(demonstration.trajectory.positions).all()
        lint(read_raw(file, **options))
    except FileFormatError as error:
        assert kind in str(error)


@pytest.mark.parametrize(
    "call",
    [
        lambda: read(5),
        lambda: read([3.0]),
        lambda: read("x.csv", repair="yes"),
        lambda: read("x.csv", thin=1),
        lambda: read("x.csv", units=["m"]),
        lambda: read("x.csv", duration="ten"),
        lambda: read("x.csv", rate=True),
        lambda: read("x.csv", duration=np.ones(2)),
        lambda: read("x.csv", task=3),
        lambda: lint(None),
        lambda: lint(motion()),
        lambda: lint([1]),
        lambda: lint([motion()], arm="sawyer"),
        lambda: align([motion()], n=20.5),
        lambda: align([motion()], n=float("nan")),
        lambda: align([motion()], n=10**9),
        lambda: align([motion()], method=2),
        lambda: align([RawDemonstration.of(motion())]),
        lambda: RawDemonstration("a", np.arange(4.0), np.ones((5, 3))),
        lambda: RawDemonstration("a", np.arange(4.0), np.ones((4, 2))),
        lambda: RawDemonstration("a", np.arange(4.0), None, np.ones((4, 3))),
        lambda: RawDemonstration("a", np.arange(4.0), joints=np.ones((4, 2)), joint_names=("a",)),
        lambda: RawDemonstration("a", ["x", "y"]),
        lambda: RawDemonstration("a", []),
        lambda: RawDemonstration(3, np.arange(4.0)),
    ],
)
def test_arguments_of_the_wrong_kind_are_refused(call):
    with pytest.raises(InputError):
        call()
