from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from demonstration_samples import path, turn
from imitarm.demonstrations import read, read_raw
from imitarm.errors import FileFormatError, InputError

PHASE = np.linspace(0.0, 1.0, 40)
POSES = np.column_stack([path(PHASE), turn(PHASE)])
TIMES = 3.0 * PHASE


@pytest.mark.parametrize("dtype", [np.float64, np.float32, ">f8"])
def test_one_array_is_one_motion(tmp_path, dtype):
    np.save(tmp_path / "a.npy", POSES.astype(dtype))
    (one,) = read(tmp_path / "a.npy", duration=3.0)
    assert np.allclose(one.trajectory.positions, POSES[:, :3], atol=1e-6)
    assert one.source == str(tmp_path / "a.npy")


def test_a_stack_is_several_motions(tmp_path):
    stack = np.stack([POSES[:, :2], 2.0 * POSES[:, :2], 3.0 * POSES[:, :2]])
    np.save(tmp_path / "a.npy", 100.0 * stack)
    demonstrations = read(tmp_path / "a.npy", duration=3.0, units="cm")
    assert [one.source for one in demonstrations] == [f"{tmp_path / 'a.npy'}[{i}]" for i in range(3)]
    assert np.allclose(demonstrations[2].trajectory.positions[:, :2], stack[2])
    assert np.all(demonstrations[2].trajectory.positions[:, 2] == 0.0)


def test_quaternions_in_the_other_order(tmp_path):
    np.save(tmp_path / "a.npy", POSES[:, [0, 1, 2, 4, 5, 6, 3]])
    (one,) = read(tmp_path / "a.npy", duration=3.0, quaternion_order="xyzw")
    assert np.allclose(one.trajectory.quaternions, POSES[:, 3:])


def test_an_archive_of_fields(tmp_path):
    fields = {"positions": POSES[:, :3], "quaternions": POSES[:, 3:], "joints": np.zeros((40, 6)), "times": TIMES}
    np.savez(tmp_path / "a.npz", **fields, force=np.zeros(3))
    (raw,) = read_raw(tmp_path / "a.npz")
    assert raw.notes[0] == "arrays not used: force" and "order w x y z was assumed" in raw.notes[1]
    (one,) = read(tmp_path / "a.npz")
    assert np.array_equal(one.trajectory.times, TIMES)
    assert np.array_equal(one.trajectory.positions, POSES[:, :3])
    assert np.allclose(one.trajectory.quaternions, POSES[:, 3:])
    assert one.joints.shape == (40, 6)
    del fields["times"]
    np.savez(tmp_path / "a.npz", **fields)
    assert read(tmp_path / "a.npz", rate=10.0)[0].trajectory.duration == pytest.approx(3.9)
    with pytest.raises(FileFormatError, match="no time stamps"):
        read(tmp_path / "a.npz")


@pytest.mark.parametrize("times", [TIMES, np.stack([TIMES, 2.0 * TIMES])])
def test_an_archive_of_stacked_fields(tmp_path, times):
    positions = np.stack([POSES[:, :3], 0.5 * POSES[:, :3]])
    np.savez_compressed(tmp_path / "a.npz", positions=positions, times=times, quaternions=np.stack([POSES[:, 3:]] * 2))
    first, second = read(tmp_path / "a.npz")
    assert np.allclose(second.trajectory.positions, positions[1])
    assert first.trajectory.duration == 3.0
    assert second.trajectory.duration == times[-1].max() if times.ndim == 1 else 6.0


def test_an_archive_of_motions(tmp_path):
    np.savez(tmp_path / "a.npz", slow=POSES, fast=np.stack([POSES, POSES]))
    names = [one.source.removeprefix(str(tmp_path / "a.npz")) for one in read(tmp_path / "a.npz", duration=3.0)]
    assert names == [":slow", ":fast[0]", ":fast[1]"]


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(5), r"shape \(5,\), must be \(n, columns\)"),
        (np.zeros((5, 5)), r"shape \(5, 5\)"),
        (np.zeros((2, 2, 5, 3)), r"shape \(2, 2, 5, 3\)"),
        (np.zeros((0, 3)), "array is empty"),
        (np.array([["a", "b"]]), "holds <U1, not real numbers"),
        (np.zeros((5, 3), complex), "holds complex128, not real numbers"),
        (np.zeros((5, 3), bool), "holds bool, not real numbers"),
        (np.zeros(5, dtype=[("x", float), ("y", float)]), "not real numbers"),
        (np.array([{"x": 1}], dtype=object), "Python objects .* never opened"),
    ],
)
def test_arrays_that_are_no_motion(tmp_path, array, message):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(FileFormatError, match=message):
        read(tmp_path / "a.npy", duration=1.0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"positions": np.zeros((5, 4))}, r"positions: shape \(5, 4\)"),
        ({"positions": POSES[:, :3], "times": TIMES[:-1]}, r"times: shape \(39,\), must be \(40,\)"),
        ({"positions": POSES[:, :3], "quaternions": POSES[:, :3]}, r"quaternions: shape \(40, 3\), must be \(40, 4\)"),
        ({"positions": POSES[:, :3], "joints": np.zeros((39, 7))}, r"joints: shape \(39, 7\), must be \(40, 7\)"),
        ({"positions": POSES[:, :3], "joints": np.array([{}], dtype=object)}, "never opened"),
    ],
)
def test_fields_that_do_not_fit(tmp_path, fields, message):
    np.savez(tmp_path / "a.npz", **fields)
    with pytest.raises(FileFormatError, match=message):
        read(tmp_path / "a.npz", duration=1.0)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
@pytest.mark.parametrize("keep", [0.02, 0.3, 0.7, 0.99])
def test_cut_files(tmp_path, name, keep):
    if name == "a.npy":
        np.save(tmp_path / name, POSES)
    else:
        np.savez_compressed(tmp_path / name, slow=POSES, fast=POSES)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(keep * len(content))])
    with pytest.raises(FileFormatError, match=r"a\.np.: damaged or cut off"):
        read(tmp_path / name, duration=1.0)


def test_a_damaged_archive(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", slow=POSES)
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "a.npz").write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match="damaged"):
        read(tmp_path / "a.npz", duration=1.0)


def test_a_header_that_promises_more_than_the_file_holds(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 7)})
    (tmp_path / "a.npy").write_bytes(header.getvalue() + bytes(64))
    with pytest.raises(FileFormatError, match="but the file is too short for this shape"):
        read(tmp_path / "a.npy", duration=1.0)


def test_an_archive_of_other_things(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FileFormatError):
        read(tmp_path / "a.npz", duration=1.0)
    with zipfile.ZipFile(tmp_path / "b.npz", "w"):
        pass
    with pytest.raises((FileFormatError, InputError)):
        read(tmp_path / "b.npz", duration=1.0)


@pytest.mark.parametrize("shape", [(40, 4, 4), (40, 3, 3), (40, 3, 4), (3, 40, 4, 4), (40, 16), (40, 12), (40, 9)])
def test_stacks_of_matrices_are_refused_once_with_their_shape(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.ones(shape))
    with pytest.raises(FileFormatError, match=r"shape \(.*\) looks like a stack of matrices .*x y z qw qx qy qz"):
        read(tmp_path / "a.npy", duration=3.0)


@pytest.mark.parametrize("shape", [(500, 5, 7), (200, 9, 3), (30, 12, 8)])
def test_stacks_whose_axes_are_swapped_are_refused_once(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.ones(shape))
    with pytest.raises(FileFormatError, match=rf"would be {shape[0]} demonstrations of {shape[1]} rows.*swap"):
        read(tmp_path / "a.npy", duration=3.0)
