"""Which column of a text table holds what: by names in a row or a remark, else by their number; never by a guess."""

from __future__ import annotations

import numpy as np
import pytest

from demonstration_samples import path, turn
from imitarm.demonstrations import ReadOptions, lint, read, read_raw
from imitarm.demonstrations.columns import Column, column_of, named_columns, unnamed_columns
from imitarm.demonstrations.reading import SaidUnits
from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_to_matrix

TABLE = np.arange(1.0, 25.0).reshape(3, 8)
PHASE = np.linspace(0.0, 1.0, 30)
POSES = np.column_stack([path(PHASE), turn(PHASE)])
TILTED = quaternion_exp(np.outer(np.linspace(0.2, 1.5, 30), [0.6, -0.5, 0.4]))
"""Rotations whose four numbers all differ: another order of them is another rotation."""


def write(file, table, *, first="", separator=" "):
    """Write a table below the text ``first``."""
    rows = [separator.join(map(repr, row)) for row in np.asarray(table, dtype=float).tolist()]
    file.write_text("\n".join([*([first] if first else []), *rows]) + "\n", encoding="utf-8")
    return file


# --- names


@pytest.mark.parametrize(
    ("name", "what", "unit"),
    [
        ("t", "t", None),
        ("Time", "t", None),
        ("timestamp_ns", "t", "ns"),
        ("time [ms]", "t", "ms"),
        ("header.stamp.nanosec", "t", "nanosec"),
        ("x", "x", None),
        ("Pose.Position.Y", "y", None),
        ("/pose/position/y", "y", None),
        ("pos_z", "z", None),
        ("x [mm]", "x", "mm"),
        ("z(cm)", "z", "cm"),
        ("z in cm", "z", "cm"),
        ("x_mm", "x", "mm"),
        ("x/mm", "x", "mm"),
        ("y mm", "y", "mm"),
        ("qw", "qw", None),
        ("orientation.x", "qx", None),
        ("right_gripper", "", None),
        ("force_x", "", None),
        ("x_min", "", None),
        ("vel_x", "", None),
        ("velocity", "", None),
    ],
)
def test_what_a_name_means(name, what, unit):
    assert column_of(name) == Column(what, unit)


@pytest.mark.parametrize(
    ("name", "joint", "unit"),
    [
        ("right_j0", "right_j0", None),
        ("panda_joint7", "panda_joint7", None),
        ("joint_1 [deg]", "joint_1", "deg"),
        ("joint_2_deg", "joint_2", "deg"),
        ("joint_3 (°)", "joint_3", "°"),
        ("position.right_j0", "right_j0", None),
        ("joint_states.position.right_j0", "right_j0", None),
        ("actual_panda_joint2", "panda_joint2", None),
        ("joint_angle_3", "joint_3", None),
    ],
)
def test_the_names_of_joint_angles(name, joint, unit):
    assert column_of(name) == Column("joint", unit, joint)


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("velocity.right_j0", "velocities"),
        ("right_j0_vel", "velocities"),
        ("joint_speed_j1", "velocities"),
        ("joint_1_dot", "velocities"),
        ("effort.panda_joint1", "efforts"),
        ("tau_j3", "efforts"),
        ("torque joint 4", "efforts"),
        ("cmd_joint_2", "commands"),
        ("desired.right_j1", "commands"),
        ("joint_3_target", "commands"),
        ("current_joint1", "currents"),
        ("joint_acc_j1", "accelerations"),
        ("error_right_j6", "errors"),
        ("joint_2_temperature", "other quantities"),
    ],
)
def test_joint_columns_that_hold_no_angles(name, quantity):
    column = column_of(name)
    assert (column.what, column.not_angle) == ("", quantity)
    names = ["t", *(name.replace(next(d for d in name if d.isdigit()), str(i)) for i in range(7))]
    with pytest.raises(FileFormatError, match=rf"holds joint {quantity} \(.*not joint angles; record joint angles"):
        named_columns("f", names, TABLE, ReadOptions())


def test_named_columns_in_any_order_and_with_units():
    names = ["z [mm]", "force", "time_ms", "x [mm]", "y [mm]", "j2 [deg]", "right_j0 [deg]", "right_j1 [deg]"]
    raw = named_columns("f", names, TABLE, ReadOptions())
    assert np.allclose(raw.positions, TABLE[:, [3, 4, 0]] / 1000.0)
    assert np.allclose(raw.times, TABLE[:, 2] / 1000.0)
    assert np.allclose(raw.joints, np.radians(TABLE[:, 5:]))
    assert raw.joint_names == ("j2", "right_j0", "right_j1")
    assert raw.notes == ("columns not used: force",)


def test_named_quaternions_need_no_order():
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "t"]
    raw = named_columns("f", names, TABLE, ReadOptions(quaternion_order="xyzw"))
    assert np.array_equal(raw.quaternions, TABLE[:, [6, 3, 4, 5]])


def test_angles_are_read_beside_velocities_and_efforts():
    names = ["t", "position.j1", "position.j2", "velocity.j1", "velocity.j2", "effort.j1", "effort.j2", "z"]
    raw = named_columns("f", names[:7], TABLE[:, :7], ReadOptions())
    assert np.array_equal(raw.joints, TABLE[:, 1:3]) and raw.joint_names == ("j1", "j2")
    assert "velocity.j1" in raw.notes[0] and "effort.j2" in raw.notes[0]


@pytest.mark.parametrize(
    ("names", "options", "error", "message"),
    [
        ("x y x t a b c d", {}, FileFormatError, "columns 'x' and 'x' both hold x"),
        ("x pos_x y t a b c d", {}, FileFormatError, "columns 'x' and 'pos_x' both hold x"),
        ("x z t a b c d e", {}, FileFormatError, "xyz columns lack y"),
        ("t x y z qw qx qy a", {}, FileFormatError, "quaternion columns lack qz"),
        ("t a b c d e f g", {}, FileFormatError, "no columns are named x, y, z or like joints .* found t, a, b"),
        ("x y z a b c d e", {}, FileFormatError, "no time stamps"),
        ("t x_mm y_cm z_mm a b c d", {}, FileFormatError, "different units of length: cm and mm"),
        ("t x_mm y_mm z a b c d", {}, FileFormatError, "column 'x_mm' has a unit, but column 'z' has none"),
        ("t j0 j1_deg j2 a b c d", {}, FileFormatError, "column 'j1_deg' has a unit, but column 'j0' has none"),
        (
            "t x_mm y_mm z_mm a b c d",
            {"units": "cm"},
            InputError,
            "states the unit mm, but this contradicts units='cm'",
        ),
        (
            "t_ms x y z a b c d",
            {"time_units": "s"},
            InputError,
            "states the unit ms, but this contradicts time_units='s'",
        ),
        ("t j0 j1 J0 b c d e", {}, FileFormatError, "columns 'j0' and 'J0' both hold joint j0"),
        ("t j0 j1 position.j0 b c d e", {}, FileFormatError, "both hold joint j0; remove one"),
        ("t right_j0 right_j1 right_j0 b c d e", {}, FileFormatError, "both hold joint right_j0"),
    ],
)
def test_names_that_do_not_fit(names, options, error, message):
    with pytest.raises(error, match=message):
        named_columns("f", names.split(), TABLE, ReadOptions(**options))


# --- units


@pytest.mark.parametrize(
    ("names", "column", "factor"),
    [
        (["t", "x [ft]", "y [ft]", "z [ft]"], 1, 0.3048),
        (["t", "x (inch)", "y (inch)", "z (inch)"], 1, 0.0254),
        (["t", "x [Millimeters]", "y [mm]", "z [mm]"], 1, 0.001),
        (["time [min]", "x", "y", "z"], 0, 60.0),
        (["time_h", "x", "y", "z"], 0, 3600.0),
        (["t [\u00b5s]", "x", "y", "z"], 0, 1e-6),
    ],
)
def test_units_in_names_are_converted(names, column, factor):
    raw = named_columns("f", names, TABLE[:, :4], ReadOptions())
    value = raw.times if column == 0 else raw.positions[:, 0]
    assert np.allclose(value, factor * TABLE[:, column])


@pytest.mark.parametrize(
    ("name", "unit", "kind"),
    [
        ("x [dm]", "dm", "length"),
        ("x [yd]", "yd", "length"),
        ("x [s]", "s", "length"),
        ("x (tool)", "tool", "length"),
        ("x []", "", "length"),
        ("t [ds]", "ds", "time"),
        ("t [frames]", "frames", "time"),
        ("t [mm]", "mm", "time"),
        ("j1 [rev]", "rev", "angle"),
        ("j1 [rad/s]", "rad/s", "angle"),
        ("j1 [Nm]", "nm", "angle"),
        ("qw [deg]", "deg", "rotation"),
    ],
)
def test_an_unknown_unit_is_refused(name, unit, kind):
    names = [name, *(other for other in ("t", "x", "y", "z", "qw", "qx", "qy", "qz") if other != name[: len(other)])]
    table = np.ones((3, len(names)))
    with pytest.raises(FileFormatError, match=rf"column '.*': '{unit}' is not a known unit of {kind} \(.*convert"):
        named_columns("f", names, table, ReadOptions())


def test_units_that_the_file_states_elsewhere(tmp_path):
    raw = named_columns("f", list("txyzabcd"), TABLE, ReadOptions(), SaidUnits(length="cm"))
    assert np.allclose(raw.positions, TABLE[:, 1:4] / 100.0)
    with pytest.raises(FileFormatError, match="a remark states the unit cm, but a column name states mm"):
        named_columns("f", ["t", "x_mm", "y_mm", "z_mm"], TABLE[:, :4], ReadOptions(), SaidUnits(length="cm"))
    file = write(tmp_path / "a.csv", TABLE[:, :4], first="# units: mm, ms\nt,x,y,z", separator=",")
    (raw,) = read_raw(file)
    assert np.allclose(raw.positions, TABLE[:, 1:4] / 1000.0) and np.allclose(raw.times, TABLE[:, 0] / 1000.0)
    file = write(tmp_path / "a.csv", np.column_stack([TABLE[:, 0], TABLE[:, :2]]), first="# unit: deg\nt j1 j2")
    assert np.allclose(read_raw(file)[0].joints, np.radians(TABLE[:, :2]))


@pytest.mark.parametrize(
    "remark",
    ["all positions in mm", "x y z in mm", "each row holds x y z in mm", "x [mm] y [mm] z [mm]", "x, y, z, all in mm"],
)
def test_a_unit_in_a_sentence_is_used(tmp_path, remark):
    (raw,) = read_raw(write(tmp_path / "a.txt", TABLE[:, :3], first=f"# {remark}"), rate=10.0)
    assert np.allclose(raw.positions, TABLE[:, :3] / 1000.0)


@pytest.mark.parametrize("remark", ["x, y, z (mm)", "x y z, mm", "positions in mm, no: in cm"])
def test_a_unit_in_a_sentence_that_is_not_clear_is_refused(tmp_path, remark):
    with pytest.raises(FileFormatError, match=r"has a unit, but column|looks like column names|two units"):
        read_raw(write(tmp_path / "a.txt", TABLE[:, :3], first=f"# {remark}"), rate=10.0)


@pytest.mark.parametrize(
    "remark", ["units: yards", "unit: furlong", "length units: x", "units: mm, cm", "time unit: ds"]
)
def test_a_unit_in_a_remark_that_is_not_known_is_refused(tmp_path, remark):
    file = write(tmp_path / "a.csv", TABLE[:, :4], first=f"# {remark}")
    with pytest.raises(FileFormatError, match=r"states? (the unknown unit|two units of length).*; known: m, cm"):
        read_raw(file)


def test_remarks_give_unit_and_task(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("# units: cm\n# task: pour\nt,x,y,z\n0,10,20,30\n1,20,20,30\n2,30,20,30\n")
    (one,) = read(file, task="something else")
    assert np.allclose(one.trajectory.positions[0], [0.1, 0.2, 0.3])
    assert one.task == "pour"


# --- time stamps in two columns


@pytest.mark.parametrize(
    ("whole", "fine", "factor"),
    [
        ("sec", "nanosec", 1e9),
        ("secs", "nsecs", 1e9),
        ("stamp.sec", "stamp.nanosec", 1e9),
        ("header_stamp_sec", "header_stamp_nsec", 1e9),
        ("time [s]", "usec", 1e6),
        ("t", "millisecond", 1e3),
        ("tv_sec", "tv_usec", 1e6),
    ],
)
def test_seconds_and_the_rest_of_the_second_are_added(whole, fine, factor):
    times = 17.0 + 0.25 * np.arange(9)
    table = np.column_stack([times // 1, np.round(times % 1 * factor), np.ones((9, 3))])
    for names in ([whole, fine, "x", "y", "z"], [whole, fine, "x", "y", "z"][::-1]):
        ordered = table if names[0] == whole else table[:, ::-1]
        assert np.allclose(named_columns("f", names, ordered, ReadOptions()).times, times)


@pytest.mark.parametrize("bad", [{"sec": 0.5}, {"nanosec": 2e9}, {"nanosec": -1.0}])
def test_two_time_columns_that_do_not_fit_are_refused(bad):
    names = ["sec", "nanosec", "x", "y", "z"]
    table = np.ones((4, 5))
    for name, value in bad.items():
        table[2, names.index(name)] = value
    with pytest.raises(FileFormatError, match="'sec' and 'nanosec' both hold times, but are not whole seconds"):
        named_columns("f", names, table, ReadOptions())
    with pytest.raises(FileFormatError, match="both hold times"):
        named_columns("f", ["time", "stamp", "x", "y", "z"], np.ones((4, 5)), ReadOptions())


# --- without names


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
    with pytest.raises(
        FileFormatError,
        match=r"f: 5 columns without names; a table without column names must have 2 .* Write the column names",
    ):
        unnamed_columns("f", TABLE[:, :5], ReadOptions())


# --- names in remarks


@pytest.mark.parametrize(
    "first",
    [
        "# t x y z qx qy qz qw",
        "# t x y z qx qy qz qw\n# made at the bench near the door by night",
        "# columns: t x y z qx qy qz qw",
        "# Columns = t, x, y, z, qx, qy, qz, qw",
        "# t (s) x (m) y (m) z (m) qx qy qz qw",
        "% time [s], x [m], y [m], z [m], qx, qy, qz, qw",
        "# fields: [t, x, y, z, qx, qy, qz, qw]",
        "# pose (t x y z qx qy qz qw)",
        "# stamp position.x position.y position.z orientation.x orientation.y orientation.z orientation.w",
        "# each row holds t x y z qx qy qz qw in the base frame",
        "#t;x;y;z;qx;qy;qz;qw\n# units: m",
        "# 1: t [s]\n# 2: x\n# 3: y\n# 4: z\n# 5: qx\n# 6: qy\n# 7: qz\n# 8: qw",
        "# column 0: t time\n# column 1: x\n# column 2: y\n# column 3: z\n# column 4: qx\n"
        "# column 5: qy\n# column 6: qz\n# column 7: qw",
        "# t\n# x\n# y\n# z\n# qx\n# qy\n# qz\n# qw",
        "# quaternions are xyzw",
        "# order: XYZW",
        "# quaternions: scalar last",
        "# the real part comes last",
        "# format: timestamp(s) tx ty tz qx qy qz qw",
        "# time, pos x, pos y, pos z, ori x, ori y, ori z, ori w",
        "t (s) x (m) y (m) z (m) qx qy qz qw",
        '"t" "x" "y" "z" "qx" "qy" "qz" "qw"',
        "t,x,y,z,qx,qy,qz,qw",
    ],
)
def test_names_in_a_row_or_a_remark_are_used(tmp_path, first):
    table = np.column_stack([0.1 * np.arange(30), POSES[:, :3], TILTED[:, [1, 2, 3, 0]]])
    (one,) = read(write(tmp_path / "a.txt", table, first=first))
    assert np.allclose(one.trajectory.positions, POSES[:, :3])
    assert np.allclose(np.abs(np.sum(one.trajectory.quaternions * TILTED, axis=1)), 1.0)


@pytest.mark.parametrize("remark", ["t x y z qx qy qz qw", "rotations xyzw", "format: t x y z qx qy qz qw"])
@pytest.mark.parametrize("row", [15, 30])
def test_remarks_between_and_below_the_numbers_count_too(tmp_path, remark, row):
    table = np.column_stack([0.1 * np.arange(30), 1e3 * POSES[:, :3], TILTED[:, [1, 2, 3, 0]]])
    lines = write(tmp_path / "a.txt", table).read_text(encoding="utf-8").splitlines()
    lines[row:row] = [f"# {remark}", "# units: mm"]
    (tmp_path / "a.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (one,) = read(tmp_path / "a.txt")
    assert np.allclose(one.trajectory.positions, POSES[:, :3])
    assert np.allclose(np.abs(np.sum(one.trajectory.quaternions * TILTED, axis=1)), 1.0)


@pytest.mark.parametrize(
    ("options", "first", "noted"),
    [
        ({}, "", True),
        ({"quaternion_order": "wxyz"}, "", False),
        ({}, "# wxyz", False),
        ({}, "t x y z qw qx qy qz", False),
    ],
)
def test_an_assumed_order_of_quaternions_is_noted(tmp_path, options, first, noted):
    table = np.column_stack([0.1 * np.arange(30), POSES])
    (raw,) = read_raw(write(tmp_path / "a.txt", table, first=first), **options)
    assert any("order w x y z was assumed" in note for note in raw.notes) is noted
    if not first:
        np.save(tmp_path / "a.npy", table)
        (raw,) = read_raw(tmp_path / "a.npy", **options)
        assert any("order w x y z was assumed" in note for note in raw.notes) is noted


@pytest.mark.parametrize(
    ("remark", "message"),
    [
        ("velocities", "the remark 'velocities' says that the columns hold velocities, not joint angles"),
        ("measured torques of each joint", "says that the columns hold torques"),
        ("joint velocities in rad/s", "states the unit 'rad/s', which is neither a length nor an angle"),
        ("values in rad per second", "states the unit 'rad per second'"),
    ],
)
def test_a_remark_that_says_that_joint_columns_hold_no_angles_is_believed(tmp_path, remark, message):
    names = "time " + " ".join(f"right_j{i}" for i in range(7))
    with pytest.raises(FileFormatError, match=message):
        read_raw(write(tmp_path / "a.txt", TABLE, first=f"# {remark}\n{names}"))
    (raw,) = read_raw(write(tmp_path / "a.txt", TABLE, first=f"# joint angles, without velocities\n{names}"))
    assert np.allclose(raw.joints, TABLE[:, 1:])


@pytest.mark.parametrize(
    "first",
    [
        "# t x y z qx qy qz",
        "# t x y z quaternion (qx qy qz qw) force",
        "# columns: x y z a b c d e f g",
        "# time, position (x y z), orientation (x y z w)",
        "# zeit links oben hinten eins zwei drei vier",
        "# velocity.j0 velocity.j1 velocity.j2",
        "# qx qy qz qw come last",
        "# 1: t\n# 2: x\n# 3: y",
    ],
)
def test_a_remark_that_looks_like_names_and_does_not_fit_is_refused(tmp_path, first):
    table = np.column_stack([0.1 * np.arange(30), POSES[:, :3], TILTED[:, [1, 2, 3, 0]]])
    with pytest.raises(FileFormatError, match=r"line \d: the remark '.*' looks like column names, .*name each column"):
        read(write(tmp_path / "a.txt", table, first=first))


def test_names_in_remarks_of_other_quantities_are_refused_too(tmp_path):
    file = write(tmp_path / "a.txt", TABLE, first="# t " + " ".join(f"velocity.right_j{i}" for i in range(7)))
    with pytest.raises(FileFormatError, match="holds joint velocities"):
        read(file)
    file = write(tmp_path / "a.txt", np.column_stack([np.arange(30.0), TILTED]), first="# t qw qx qy qz")
    with pytest.raises(FileFormatError, match="no columns are named x, y, z"):
        read(file)


@pytest.mark.parametrize(
    "first", ["# recorded by Ann on Monday", "# task: from x to y", "# robot: panda\n# date: 2024-05-01", "# v 2.1"]
)
def test_other_remarks_are_no_names(tmp_path, first):
    table = np.column_stack([0.1 * np.arange(30), POSES])
    (one,) = read(write(tmp_path / "a.txt", table, first=first))
    assert np.allclose(one.trajectory.quaternions, POSES[:, 3:])


def test_the_order_of_quaternions_that_a_remark_states_is_not_to_be_contradicted(tmp_path):
    file = write(tmp_path / "a.txt", np.column_stack([0.1 * np.arange(30), POSES]), first="# rotations wxyz")
    assert np.allclose(read(file)[0].trajectory.quaternions, POSES[:, 3:])
    with pytest.raises(InputError, match="the quaternion order wxyz, but this contradicts quaternion_order='xyzw'"):
        read(file, quaternion_order="xyzw")


# --- files


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("heading", ["", "x y z qw qx qy qz"])
def test_positions_and_quaternions_with_each_separator(tmp_path, separator, heading):
    file = write(tmp_path / "a.txt", POSES, first=heading.replace(" ", separator), separator=separator)
    (one,) = read(file, duration=3.0)
    assert np.allclose(one.trajectory.positions, POSES[:, :3], rtol=0, atol=1e-15)
    assert np.allclose(one.trajectory.quaternions, POSES[:, 3:])
    assert one.trajectory.duration == 3.0


def test_quaternions_of_few_digits_are_scaled_and_others_refused(tmp_path):
    (one,) = read(write(tmp_path / "a.csv", np.round(POSES, 2)), rate=10.0)
    assert np.allclose(np.linalg.norm(one.trajectory.quaternions, axis=1), 1.0)
    invalid = POSES.copy()
    invalid[12, 3:] = 0.0
    with pytest.raises(FileFormatError, match=r"a\.csv, line 13: the quaternion has length 0, must be 1"):
        read(write(tmp_path / "a.csv", invalid), rate=10.0)


# --- rotations in other forms

ROTATIONS_NOT_READ = [
    "roll pitch yaw",
    "tcp_roll tcp_pitch tcp_yaw",
    "rx ry rz",
    "RX [rad],RY [rad],RZ [rad]",
    "rotvec_x rotvec_y rotvec_z",
    "q1 q2 q3 q4",
    "q0 q1 q2 q3",
    "A B C",
    "W P R",
    "euler_x euler_y euler_z",
    "rx_deg ry_deg rz_deg",
    "r11 r12 r13 r21 r22 r23",
    "theta",
]


def names_in(text):
    return text.split("," if "," in text else None)


@pytest.mark.parametrize("text", ROTATIONS_NOT_READ)
def test_a_rotation_that_is_not_read_is_a_warning_that_names_its_columns(text):
    extra = names_in(text)
    table = np.column_stack([PHASE, path(PHASE), np.zeros((30, len(extra)))])
    raw = named_columns("a.csv", ["t", "x", "y", "z", *extra], table, ReadOptions())
    assert raw.quaternions is None and raw.unread_rotation == tuple(extra)
    (found,) = [f for f in lint([raw]) if f.code == "rotation-not-read"]
    assert found.severity == "warning" and ", ".join(extra) in found.message
    assert "qw qx qy qz" in found.remedy and "r11" in found.remedy


@pytest.mark.parametrize(
    "text", ["force_x force_y", "a b", "q1 q2 q3 q4 q5 q6", "roll_rate", "vel_rx vel_ry", "wx wy wz", "gripper"]
)
def test_other_columns_are_no_rotation(text):
    extra = text.split()
    table = np.column_stack([PHASE, path(PHASE), np.zeros((30, len(extra)))])
    assert named_columns("a.csv", ["t", "x", "y", "z", *extra], table, ReadOptions()).unread_rotation == ()


def test_reading_warns_of_a_rotation_that_is_not_read(tmp_path):
    table = np.column_stack([PHASE, path(PHASE), np.zeros((30, 3))])
    file = write(tmp_path / "a.csv", table, first="t,x,y,z,roll,pitch,yaw", separator=",")
    with pytest.warns(UserWarning, match="roll, pitch, yaw can't be read"):
        read(file)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("pattern", ["r{}{}", "R_{}_{}", "rot{}{}"])
def test_rotation_matrices_are_read(first, pattern):
    names = [pattern.format(i + first, j + first) for i in range(3) for j in range(3)]
    order = np.random.default_rng(1).permutation(9)
    table = np.column_stack([PHASE, path(PHASE), quaternion_to_matrix(TILTED).reshape(30, 9)[:, order]])
    raw = named_columns("a.csv", ["t", "x", "y", "z", *(names[i] for i in order)], table, ReadOptions())
    assert raw.quaternions is not None and raw.notes == () and raw.unread_rotation == ()
    np.testing.assert_allclose(np.abs(np.sum(raw.quaternions * TILTED, axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("spoil", [lambda m: 2.0 * m, lambda m: -m])
def test_matrices_that_are_no_rotations_are_refused(spoil):
    names = [f"r{i}{j}" for i in "123" for j in "123"]
    table = np.column_stack([PHASE, path(PHASE), spoil(quaternion_to_matrix(TILTED).reshape(30, 9))])
    with pytest.raises(FileFormatError, match="do not hold a rotation matrix; check"):
        named_columns("a.csv", ["t", "x", "y", "z", *names], table, ReadOptions())


# --- usual names of other recorders


@pytest.mark.parametrize("first", ["# timestamp tx ty tz qx qy qz qw", "timestamp tx ty tz qx qy qz qw"])
def test_tum_names(tmp_path, first):
    table = np.column_stack([PHASE, path(PHASE), np.roll(TILTED, -1, axis=1)])
    (raw,) = read_raw(write(tmp_path / "tum.txt", table, first=first))
    np.testing.assert_array_equal(raw.positions, path(PHASE))
    np.testing.assert_array_equal(raw.quaternions, TILTED)


@pytest.mark.parametrize("names", ["t fx fy fz tx ty tz", "t tx ty tz", "t fx fy fz tx ty tz qw qx qy qz"])
def test_torques_are_no_positions(names):
    columns = names.split()
    with pytest.raises(FileFormatError, match="no columns are named x, y, z"):
        named_columns("a.csv", columns, np.ones((30, len(columns))), ReadOptions())


def test_euroc_names(tmp_path):
    units = ["[m]"] * 3 + ["[]"] * 4 + ["[m s^-1]"]
    names = [f"p_RS_R_{a}" for a in "xyz"] + [f"q_RS_{a}" for a in "wxyz"] + ["v_RS_R_x"]
    first = "#timestamp [ns], " + ", ".join(f"{name} {unit}" for name, unit in zip(names, units, strict=True))
    table = np.column_stack([1e9 * PHASE, path(PHASE), TILTED, PHASE])
    (raw,) = read_raw(write(tmp_path / "data.csv", table, first=first, separator=","))
    np.testing.assert_array_equal(raw.positions, path(PHASE))
    np.testing.assert_array_equal(raw.quaternions, TILTED)
    np.testing.assert_allclose(raw.times, PHASE)


@pytest.mark.parametrize("names", ["t x_dm y_dm z_dm", "t x y z_dm", "t x_km y_km z_km", "time_ds x y z"])
def test_a_suffix_that_is_an_unknown_unit_is_named(names):
    unit = names.rpartition("_")[2][:2]
    with pytest.raises(FileFormatError, match=f"'{unit}' is not a known unit of .*; convert the column"):
        named_columns("a.csv", names.split(), np.ones((30, 4)), ReadOptions())


# --- decimal commas, and a row of units


def comma_file(file, separator=";", places=6, heading="t;x;y;z"):
    table = np.column_stack([PHASE, path(PHASE)])
    rows = [separator.join(f"{value:.{places}f}".replace(".", ",") for value in row) for row in table]
    file.write_text("\n".join([heading.replace(";", separator), *rows]) + "\n", encoding="utf-8")
    return file


@pytest.mark.parametrize("separator", [";", "\t", "; "])
def test_decimal_commas_between_semicolons_or_tabs_are_read(tmp_path, separator):
    (raw,) = read_raw(comma_file(tmp_path / "a.csv", separator))
    np.testing.assert_allclose(raw.positions, path(PHASE), atol=1e-6)
    np.testing.assert_allclose(raw.times, PHASE, atol=1e-6)


def test_decimal_commas_without_names_are_numbers_and_not_names(tmp_path):
    (raw,) = read_raw(comma_file(tmp_path / "a.csv", heading="# recorded"))
    np.testing.assert_allclose(raw.positions, path(PHASE), atol=1e-6)


@pytest.mark.parametrize("separator", [" ", ","])
def test_other_decimal_commas_are_refused_with_the_remedy(tmp_path, separator):
    with pytest.raises(FileFormatError, match=r"line 2.*(decimal point|values where 4)"):
        read_raw(comma_file(tmp_path / "a.csv", separator))


@pytest.mark.parametrize("row", ["1,234;2,500;3,125;4,000", "0,1;2.5;3,1;4", "1.234,5;1;2;3"])
def test_commas_that_may_separate_thousands_are_refused(tmp_path, row):
    file = tmp_path / "a.csv"
    file.write_text(f"t;x;y;z\n{row}\n{row}\n", encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"line [23].*decimal point"):
        read_raw(file)


@pytest.mark.parametrize("units", ["ms,mm,mm,mm", "[ms],[mm],[mm],[mm]", "(ms),(mm),(mm),(mm)"])
def test_a_row_of_units_below_the_names_is_used(tmp_path, units):
    table = np.column_stack([PHASE, path(PHASE)]) * 1e3
    (raw,) = read_raw(write(tmp_path / "a.csv", table, first=f"t,x,y,z\n{units}", separator=","))
    np.testing.assert_allclose(raw.positions, path(PHASE))
    np.testing.assert_allclose(raw.times, PHASE)
    assert raw.lines is not None and raw.lines[0] == 3


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ("s,dm,dm,dm", "'dm' is not a known unit of length"),
        ("float,float,float,float", "'float' is not a known unit of time"),
        ("s,m,m,-", "column 'x .m.' has a unit, but column 'z' has none"),
        ("s,m,m", "line 2: 3 values where 4"),
    ],
)
def test_a_row_of_units_that_is_not_understood_is_refused(tmp_path, units, message):
    table = np.column_stack([PHASE, path(PHASE)])
    with pytest.raises(FileFormatError, match=message):
        read_raw(write(tmp_path / "a.csv", table, first=f"t,x,y,z\n{units}", separator=","))
