from __future__ import annotations

import numpy as np
import pytest

from imitarm.demonstrations.columns import Meaning, meaning_of, named_columns, unnamed_columns
from imitarm.demonstrations.reader import ReadOptions
from imitarm.errors import FileFormatError, InputError

TABLE = np.arange(1.0, 25.0).reshape(3, 8)


@pytest.mark.parametrize(
    ("name", "what", "unit"),
    [
        ("t", "t", None),
        ("Time", "t", None),
        ("timestamp_ns", "t", "ns"),
        ("time [ms]", "t", "ms"),
        ("x", "x", None),
        ("Pose.Position.Y", "y", None),
        ("pos_z", "z", None),
        ("x [mm]", "x", "mm"),
        ("z(cm)", "z", "cm"),
        ("x_mm", "x", "mm"),
        ("qw", "qw", None),
        ("orientation.x", "qx", None),
        ("right_j0", "joint", None),
        ("panda_joint7", "joint", None),
        ("joint_1 [deg]", "joint", "deg"),
        ("right_gripper", "", None),
        ("force_x", "", None),
        ("velocity", "", None),
    ],
)
def test_what_a_name_means(name, what, unit):
    assert meaning_of(name) == Meaning(what, unit)


def test_named_columns_in_any_order_and_with_units():
    names = ["z [mm]", "force", "time_ms", "x [mm]", "y [mm]", "j2", "right_j0 [deg]", "right_j1"]
    raw = named_columns("f", names, TABLE, ReadOptions())
    assert np.allclose(raw.positions, TABLE[:, [3, 4, 0]] / 1000.0)
    assert np.allclose(raw.times, TABLE[:, 2] / 1000.0)
    assert np.allclose(raw.joints, np.column_stack([TABLE[:, 5], np.radians(TABLE[:, 6]), TABLE[:, 7]]))
    assert raw.joint_names == ("j2", "right_j0", "right_j1")
    assert raw.notes == ("columns not used: force",)


def test_named_quaternions_need_no_order():
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "t"]
    raw = named_columns("f", names, TABLE, ReadOptions(quaternion_order="xyzw"))
    assert np.array_equal(raw.quaternions, TABLE[:, [6, 3, 4, 5]])


@pytest.mark.parametrize(
    ("names", "options", "error", "message"),
    [
        ("x y x t a b c d", {}, FileFormatError, "columns 'x' and 'x' both hold x"),
        ("x pos_x y t a b c d", {}, FileFormatError, "columns 'x' and 'pos_x' both hold x"),
        ("x z t a b c d e", {}, FileFormatError, "xyz columns lack y"),
        ("t x y z qw qx qy a", {}, FileFormatError, "quaternion columns lack qz"),
        ("t a b c d e f g", {}, FileFormatError, "no column is named x y z or as a joint .* found t, a, b"),
        ("x y z a b c d e", {}, FileFormatError, "no time stamps"),
        ("t x_mm y_cm z a b c d", {}, FileFormatError, "different units of length, cm and mm"),
        ("t x_mm y_mm z_mm a b c d", {"units": "cm"}, InputError, "says its unit is mm, but units='cm'"),
        ("t_ms x y z a b c d", {"time_units": "s"}, InputError, "says its unit is ms, but time_units='s'"),
        ("t x y z j0[turns] b c d", {}, FileFormatError, "joints in turns; known: rad, deg"),
    ],
)
def test_names_that_do_not_fit(names, options, error, message):
    with pytest.raises(error, match=message):
        named_columns("f", names.split(), TABLE, ReadOptions(**options))


def test_a_unit_that_the_file_names_elsewhere():
    raw = named_columns("f", list("txyzabcd"), TABLE, ReadOptions(), units="cm")
    assert np.allclose(raw.positions, TABLE[:, 1:4] / 100.0)
    with pytest.raises(FileFormatError, match="says its unit is 'inch'; known: m, cm, mm"):
        unnamed_columns("f", TABLE, ReadOptions(), units="inch")


@pytest.mark.parametrize("n_columns", [2, 3, 4, 7, 8])
def test_without_names_the_number_of_columns_decides(n_columns):
    table = TABLE[:, :n_columns]
    start = int(n_columns in (4, 8))
    options = ReadOptions(units="cm", quaternion_order="xyzw", duration=None if start else 4.0)
    raw = unnamed_columns("f", table, options)
    assert np.allclose(raw.times, table[:, 0] if start else [0.0, 2.0, 4.0])
    expected = np.zeros((3, 3))
    n_axes = min(3, n_columns - start)
    expected[:, :n_axes] = table[:, start : start + n_axes] / 100.0
    assert np.allclose(raw.positions, expected)
    if n_columns >= 7:
        assert np.array_equal(raw.quaternions, table[:, [start + 6, start + 3, start + 4, start + 5]])
    else:
        assert raw.quaternions is None


def test_a_rate_gives_times():
    raw = unnamed_columns("f", TABLE[:, :3], ReadOptions(rate=50.0))
    assert np.allclose(raw.times, [0.0, 0.02, 0.04])


def test_other_numbers_of_columns_are_refused():
    with pytest.raises(FileFormatError, match=r"f: 5 columns without names; known are 2 .* Name them in a first line"):
        unnamed_columns("f", TABLE[:, :5], ReadOptions())
