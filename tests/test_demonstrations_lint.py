"""Every check fires on its fault, and on nothing else: neither on other faults' samples nor on clean motions."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from demonstration_samples import motion, motions, path, turn, with_idle
from imitarm.demonstrations import Finding, RawDemonstration, lint, read_raw
from imitarm.demonstrations.plausibility import reach
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import quaternion_exp, quaternion_multiply
from imitarm.trajectory import Demonstration, Trajectory

SIX = motions(6)
TIMES = np.linspace(0.0, 5.0, 300)


@pytest.fixture(scope="module")
def panda():
    return ArmModel.load("panda")


def raw(**changes):
    return replace(RawDemonstration.of(motion(rotations=True, source="one")), **changes)


def among(faulty, rotations=True):
    """The faulty one in company, so that only its own fault is found."""
    return [*motions(4, seed=1, rotations=rotations), faulty]


def find(code, findings) -> Finding:
    found = [finding for finding in findings if finding.code == code]
    assert len(found) == 1, [str(finding) for finding in findings]
    return found[0]


def only(code, findings) -> Finding:
    assert [finding.code for finding in findings] == [code], [str(finding) for finding in findings]
    return findings[0]


@pytest.mark.parametrize(
    "clean",
    [
        SIX,
        motions(6, noise=1e-3, spread=0.01, seed=5),
        motions(6, noise=1e-3, spread=0.01, seed=6, n=100),
        motions(6, rotations=True, n=1000, seed=7),
        motions(4, bend=0.25, seed=8),
        motions(3, seed=9),
    ],
    ids=["clean", "noisy", "coarse", "rotations", "other paces", "three"],
)
def test_no_false_alarm_on_clean_motions(clean):
    assert lint(clean) == []


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("bottle2shelf", {"reader"}),  # the assumed order of the quaternions
        ("pouring", {"idle-tail", "reader"}),
        *((f"letter_{c}", {"planar", "idle-tail"}) for c in "ehl"),
        ("letter_o", {"planar"}),
    ],
)
def test_no_false_alarm_on_real_recordings(real_data, panda, name, expected):
    findings = lint(read_raw(real_data / "panda_kinesthetic" / f"{name}.npy", units="cm", duration=10.0), arm=panda)
    assert {finding.code for finding in findings} == expected
    assert {finding.severity for finding in findings} <= {"note"}


def test_real_recordings_in_the_wrong_unit(real_data):
    findings = lint(read_raw(real_data / "panda_kinesthetic" / "pouring.npy", duration=10.0))
    units = [finding for finding in findings if finding.code == "units"]
    assert len(units) == 9
    assert {f.severity for f in units} == {"error"}
    assert all('units="cm" (the motion then extends over 0.' in f.remedy for f in units)


def test_real_recordings_with_a_stranger_among_them(real_data):
    folder = real_data / "panda_kinesthetic"
    shown = read_raw(folder / "bottle2shelf.npy", units="cm", duration=10.0)
    stranger = read_raw(folder / "pouring.npy", units="cm", duration=10.0)[:1]
    outlier = find("outlier", lint(shown + stranger))
    assert outlier.source.endswith("pouring.npy[0]")
    assert "mm from the most typical demonstration" in outlier.message


def test_findings_name_place_and_remedy_and_errors_come_first():
    spoilt = raw(lines=np.arange(10, 310), times=np.where(np.arange(300) == 40, 0.0, raw().times))
    findings = lint([spoilt])
    assert [finding.severity for finding in findings] == sorted(
        [finding.severity for finding in findings], key=["error", "warning", "note"].index
    )
    late = find("non-monotonic-stamps", findings)
    assert (late.row, late.line, late.place) == (40, 50, "line 50")
    assert str(late).startswith("error non-monotonic-stamps: one, line 50: 1 time stamps are not later")
    assert all(finding.remedy for finding in findings)


def test_nothing_to_look_at():
    with pytest.raises(InputError, match="no demonstrations"):
        lint([])


# --- what a file says


def test_numbers_that_are_not_finite():
    positions = path(np.linspace(0, 1, 300))
    positions[17, 1] = np.nan
    finding = only("not-finite", lint(among(raw(positions=positions))))
    assert (finding.severity, finding.row) == ("error", 17)
    assert "1 of 300 rows" in finding.message


def test_few_samples_and_too_few():
    assert only("few-samples", lint(among(motion(n=12, rotations=True)))).severity == "warning"
    short = raw(times=np.arange(4.0), positions=np.zeros((4, 3)), quaternions=None)
    assert find("too-short", lint([short])).severity == "error"


def test_stamps_that_go_back():
    times = raw().times.copy()
    times[100:] -= 0.5
    finding = find("non-monotonic-stamps", lint(among(raw(times=times))))
    assert (finding.severity, finding.row) == ("error", 100)


def test_stamps_that_are_dates():
    finding = only("epoch-stamps", lint(among(raw(times=1.7e9 + raw().times))))
    assert (finding.severity, finding.row) == ("note", 0)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_stamps_that_are_no_seconds(unit, factor):
    finding = find("time-units", lint(among(raw(times=factor * raw().times))))
    assert finding.severity == "error"
    assert f'time_units="{unit}"' in finding.remedy


def test_quaternions_that_are_none():
    q = raw().quaternions.copy()
    q[30:33] = 0.0
    finding = find("no-rotation", lint(among(raw(quaternions=q))))
    assert (finding.severity, finding.row) == ("error", 30)
    assert finding.message.startswith("3 quaternions")


def test_quaternions_of_few_digits():
    assert only("quaternion-length", lint(among(raw(quaternions=np.round(raw().quaternions, 2))))).severity == "warning"
    assert lint(among(raw(quaternions=np.round(raw().quaternions, 4)))) == []


def test_quaternions_that_flip():
    q = raw().quaternions * np.where(np.arange(300) > 150, -1.0, 1.0)[:, None]
    finding = only("quaternion-flips", lint(among(raw(quaternions=q))))
    assert (finding.severity, finding.row) == ("note", 151)


def test_what_the_reader_left_out():
    assert only("reader", lint(among(raw(notes=("columns not used: force",))))).message == "columns not used: force"


# --- held values


def sampled_and_held(rows, *, n=300, irregular=False, seed=0):
    """The sample motion, whose sensor gives a new value only after so many rows."""
    trajectory = motion(n=n, rotations=True).trajectory
    new = np.arange(n) % rows == 0
    if irregular:
        new = np.random.default_rng(seed).random(n) < 1.0 / rows
        new[0] = True
    last = np.maximum.accumulate(np.where(new, np.arange(n), 0))
    return raw(positions=trajectory.positions[last], quaternions=trajectory.quaternions[last]), new


@pytest.mark.parametrize(("rows", "irregular"), [(2, False), (5, False), (10, False), (3, True), (8, True)])
def test_values_that_are_sampled_and_held(rows, irregular):
    held, new = sampled_and_held(rows, irregular=irregular)
    finding = find("held-values", lint([held]))
    assert finding.severity == "warning" and "thin=True" in finding.remedy
    assert "jump" not in {f.code for f in lint([held])}
    thin = held.thinned()
    moving = new & (np.linalg.norm(held.positions - held.positions[0], axis=1) > 1e-6)
    assert np.isin(held.times[moving], thin.times).all() and len(thin) <= new.sum()
    assert {f.code for f in lint([thin])} <= {"single", "reader", "few-samples", "gap", "idle-head", "idle-tail"}


def test_one_channel_that_is_held_is_enough():
    held, new = sampled_and_held(4)
    mixed = replace(held, quaternions=raw().quaternions)
    assert find("held-values", lint([mixed])).severity == "warning"
    assert len(mixed.thinned()) <= new.sum() + 1


@pytest.mark.parametrize(
    "fine",
    [
        motion(),
        motion(noise=1e-3),
        with_idle(motion(), 3.0, 3.0)[0],
        motion(rotations=True).with_trajectory(Trajectory(TIMES, np.round(path(TIMES / 5.0), 3)), None),
    ],
    ids=["clean", "noisy", "standing at both ends", "rounded to 1 mm"],
)
def test_standing_and_rounding_are_not_holding(fine):
    assert "held-values" not in {f.code for f in lint([fine])}


def test_a_pause_on_the_way_is_not_holding():
    rows = np.concatenate([np.arange(150), np.full(200, 150), np.arange(150, 300)])
    positions = motion().trajectory.positions[rows]
    paused = raw(times=np.arange(500) / 60.0, positions=positions, quaternions=None)
    assert not paused.held().any()


# --- one motion


@pytest.mark.parametrize("rate", [30, 100, 1000])
def test_gaps(rate):
    n = 4 * rate
    times = np.arange(n) / rate + 0.2 / rate * np.random.default_rng(0).random(n)
    whole = Trajectory(times, path(np.arange(n) / n))
    keep = np.delete(np.arange(n), np.arange(n // 2, n // 2 + rate // 4))
    codes = [f.code for f in lint([Demonstration(whole), motion()])]
    assert "gap" not in codes
    cut = Demonstration(Trajectory(whole.times[keep], whole.positions[keep]))
    finding = find("gap", lint([cut, motion()]))
    assert finding.row == n // 2
    assert "1 gap of 0.2" in finding.message
    assert "the tool moved" in finding.message


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_idle_ends(noise):
    head, (first, _) = with_idle(motion(source="h"), 1.0, 0.0, noise=noise)
    finding = only("idle-head", lint([head, *SIX]))
    assert (finding.severity, finding.source, finding.row) == ("note", "h", 0)
    assert f"rows 0 to {first}"[:9] in finding.message
    tail, (_, last) = with_idle(motion(source="t"), 0.0, 1.0, noise=noise)
    finding = only("idle-tail", lint([tail, *SIX]))
    assert abs(finding.row - last) < 25


def test_a_motion_that_does_not_move():
    still = Demonstration(Trajectory(np.linspace(0, 5, 300), np.ones((300, 3))), source="s")
    assert find("still", lint([still, *SIX])).severity == "error"


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("kind", ["teleport", "glitch", "two bad samples"])
@pytest.mark.parametrize("row", [40, 150, 260])
def test_jumps(noise, kind, row):
    clean = motion(noise=noise, n=400, source="one").trajectory
    bad = {"teleport": slice(row, None), "glitch": slice(row, row + 1), "two bad samples": slice(row, row + 2)}[kind]
    positions = clean.positions.copy()
    positions[bad] += [0.0, 0.04, 0.0]
    finding = find("jump", lint([Demonstration(Trajectory(clean.times, positions), source="one"), *SIX]))
    assert (finding.severity, finding.row) == ("error", row)
    assert "40 mm" in finding.message or "41 mm" in finding.message or "39 mm" in finding.message or noise > 0


@pytest.mark.parametrize("n", [60, 200, 1000])
def test_corners_stops_and_quick_starts_are_no_jumps(n):
    """A polyline at constant speed that stands in between: velocity jumps, position does not."""
    t = np.linspace(0.0, 6.0, n)
    positions = np.column_stack(
        [
            np.interp(t, [0, 1, 1.2, 3, 4, 6], [0, 0, 0.1, 0.1, 0.5, 0.5]),
            np.interp(t, [0, 1.2, 2, 5, 5.3, 6], [0, 0, 0.2, 0.2, 0, 0]),
            0.2 * np.sin(t),
        ]
    )
    assert "jump" not in [finding.code for finding in lint([Demonstration(Trajectory(t, positions))])]


def test_samples_that_come_in_bunches_are_no_jumps():
    """A network delivers late samples at once: stamps bunch, the arm does not jump."""
    times = motion(n=400).trajectory.times.copy()
    times[100:104] = times[103] + np.array([0.0, 1e-5, 2e-5, 3e-5])
    assert "jump" not in [f.code for f in lint([Demonstration(Trajectory(times, motion(n=400).trajectory.positions))])]


def test_rotations_that_jump():
    q = raw().quaternions.copy()
    q[200:] = quaternion_multiply(quaternion_exp([0.5, 0, 0]), q[200:])
    finding = find("rotation-jump", lint(among(raw(quaternions=q))))
    assert (finding.severity, finding.row) == ("error", 200)
    assert "29 degrees" in finding.message


@pytest.mark.parametrize(("unit", "factor"), [("cm", 100.0), ("mm", 1000.0)])
def test_lengths_that_are_no_metres(unit, factor):
    large = motion(source="large")
    large = large.with_trajectory(Trajectory(large.trajectory.times, factor * large.trajectory.positions), None)
    finding = find("units", lint([large, *SIX]))
    assert finding.severity == "error" and f'units="{unit}"' in finding.remedy


def test_lengths_that_were_metres_already():
    small = motion()
    small = small.with_trajectory(Trajectory(small.trajectory.times, 0.001 * small.trajectory.positions), None)
    assert find("units", lint([small, *SIX])).severity == "warning"


@pytest.mark.parametrize(
    ("factor", "fits", "unfit"),
    [
        (100.0, ["cm", "mm", "in"], ["ft"]),
        (1000.0, ["mm"], ["cm", "in", "ft"]),
        (250.0, ["cm", "mm"], ["in", "ft"]),
        (1e6, [], ["cm", "mm", "in", "ft"]),
    ],
)
def test_every_unit_that_fits_is_offered(factor, fits, unfit):
    """A motion of 0.3 m, up to 0.7 m away, whose numbers are so many times too large."""
    large = motion(source="large")
    large = large.with_trajectory(Trajectory(large.trajectory.times, factor * large.trajectory.positions), None)
    remedy = find("units", lint([large])).remedy
    assert all(f'units="{unit}"' in remedy for unit in fits)
    assert not any(f'units="{unit}"' in remedy for unit in unfit)


@pytest.mark.parametrize(
    ("options", "named", "remedy"),
    [
        ({"units": "cm"}, False, 'units="mm" (the motion then extends'),
        ({"units": "ft"}, False, 'units="mm" (the motion then extends'),
        ({}, True, "the file states the unit cm; correct the unit in the file to mm (the motion then extends"),
    ],
)
def test_the_remedy_counts_from_the_unit_that_was_used(tmp_path, options, named, remedy):
    """Millimetres that were read as centimetres or feet: the remedy must not multiply both units."""
    one = motion().trajectory
    names = "t,x [cm],y [cm],z [cm]" if named else "t,x,y,z"
    rows = np.column_stack([one.times, 1e3 * one.positions])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=names, comments="", fmt="%.9g")
    finding = find("units", lint(read_raw(tmp_path / "a.csv", **options)))
    assert remedy in finding.remedy and 'units="cm"' not in finding.remedy and " in (" not in finding.remedy
    assert "not the cm" in finding.message or "not the ft" in finding.message


@pytest.mark.parametrize(
    ("factor", "options", "wanted"),
    [(1e3, {"time_units": "us"}, "ms"), (1.0, {"time_units": "ns"}, "s"), (1.0 / 60.0, {"time_units": "us"}, "min")],
)
def test_stamps_that_are_too_close_are_in_another_unit(tmp_path, factor, options, wanted):
    one = motion().trajectory
    rows = np.column_stack([factor * (one.times - one.times[0]), one.positions])
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header="t,x,y,z", comments="", fmt="%.12g")
    finding = find("time-units", lint(read_raw(tmp_path / "a.csv", **options)))
    assert finding.severity == "error" and f'time_units="{wanted}"' in finding.remedy
    assert f"are the times in {options['time_units']}?" in finding.message


def test_motions_too_fast_for_a_hand():
    fast = motion(duration=0.1, source="fast")
    assert find("speed", lint([fast, *SIX])).severity == "warning"
    assert "speed" not in [finding.code for finding in lint([motion(duration=1.0), *SIX])]


# --- against the arm


def joint_motion(arm, joints, source="one"):
    times = np.linspace(0.0, 4.0, len(joints))
    return Demonstration(Trajectory(times, *arm.tool_path(joints)), joints, source=source, joint_names=arm.joint_names)


def swing(arm, size=0.3, n=200):
    phase = np.linspace(0.0, 1.0, n)
    return arm.home + size * (phase**2 * (3 - 2 * phase))[:, None] * np.array([1, 1, -1, 1, -1, 1, 1])


def codes(findings):
    return {finding.code for finding in findings} - {"single", "planar"}


def test_joints_within_limits_are_fine(panda):
    assert codes(lint([joint_motion(panda, swing(panda))], arm=panda)) == set()


def test_joints_beyond_limits(panda):
    q = swing(panda)
    q[:, 3] += np.linspace(0.0, panda.upper[3] + 0.2 - q[-1, 3], 200)
    finding = find("joint-limit", lint([joint_motion(panda, q)], arm=panda))
    assert (finding.severity, finding.row) == ("error", 199)
    assert "panda_joint4 is at" in finding.message
    assert "0.200 beyond its limit" in finding.message
    q[:, 3] += panda.upper[3] - 0.01 - q[-1, 3]
    assert codes(lint([joint_motion(panda, q)], arm=panda)) == set()


def test_joints_that_are_too_fast(panda):
    times = np.linspace(0.0, 0.4, 200)
    q = swing(panda, 0.7)
    fast = Demonstration(Trajectory(times, *panda.tool_path(q)), q, joint_names=panda.joint_names)
    finding = find("joint-speed", lint([fast], arm=panda))
    assert finding.severity == "warning"
    assert abs(finding.row - 100) < 60


def test_joints_in_degrees_and_of_another_arm(panda):
    one = joint_motion(panda, swing(panda))
    degrees = replace(one, joints=np.degrees(one.joints))
    assert find("joint-units", lint([degrees], arm=panda)).severity == "error"
    other = replace(one, joint_names=tuple(f"right_j{i}" for i in range(6)), joints=one.joints[:, :6])
    assert find("other-arm", lint([other], arm=panda)).severity == "error"


def test_joints_in_another_order_are_sorted_by_name_or_number(panda):
    one = RawDemonstration.of(joint_motion(panda, swing(panda)))
    order = [3, 0, 6, 1, 5, 2, 4]
    by_name = replace(one, joints=one.joints[:, order], joint_names=tuple(panda.joint_names[i] for i in order))
    assert np.array_equal(by_name.joints_of(panda), one.joints)
    for first, style in ((1, "joint_{}"), (0, "j{}"), (1, "q{}"), (8, "Joint{}")):
        names = tuple(style.format(i + first) for i in order)
        numbered = replace(one, positions=None, quaternions=None, joints=one.joints[:, order], joint_names=names)
        assert np.array_equal(numbered.joints_of(panda), one.joints)
        assert np.allclose(numbered.demonstration(panda).trajectory.positions, one.positions)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("joint_1 joint_2 joint_3 joint_4 joint_5 joint_6 joint_8", "do not follow one another"),
        ("j1 j2 j3 j4 j5 j6 joint_6", "do not follow one another"),
        ("right_j0 right_j1 right_j2 right_j3 right_j4 right_j5 right_j6", "are not those of panda"),
        ("a_j1 b_j1 c_j1 a_j2 b_j2 c_j2 a_j3", "are not those of panda"),
    ],
)
def test_joints_whose_order_is_not_known_are_refused(panda, names, message):
    one = replace(RawDemonstration.of(joint_motion(panda, swing(panda))), joint_names=tuple(names.split()))
    with pytest.raises(InputError, match=message):
        one.joints_of(panda)
    assert find("other-arm", lint([one], arm=panda)).severity == "error"


def test_positions_out_of_reach(panda):
    centre, radius = reach(panda)
    direction = np.array([0.6, 0.0, 0.8])
    out = np.linspace(0.3, radius + 0.05, 300)
    positions = centre + np.outer(out, direction)
    far = Demonstration(Trajectory(np.linspace(0, 4, 300), positions), source="far")
    finding = find("reach", lint([far, *SIX], arm=panda))
    assert (finding.severity, finding.row) == ("error", 299)
    near = far.with_trajectory(Trajectory(far.trajectory.times, centre + np.outer(out - 0.05, direction)), None)
    assert "reach" not in codes(lint([near], arm=panda))


@pytest.mark.parametrize(("name", "height"), [("panda", 0.333), ("sawyer", 0.317)])
def test_the_reach_is_about_the_shoulder_and_no_posture_gets_further(name, height):
    arm = ArmModel.load(name)
    centre, radius = reach(arm)
    assert np.allclose(centre, [0.0, 0.0, height], atol=1e-6)
    q = np.random.default_rng(1).uniform(arm.lower, arm.upper, (2000, arm.n_joints))
    distance = np.linalg.norm(arm.tool_path(q)[0] - centre, axis=1)
    assert 0.8 * radius < distance.max() <= radius


# --- between demonstrations


def test_one_alone():
    assert only("single", lint([motion()])).severity == "warning"


def test_rotations_or_joints_in_some_only():
    some = [*motions(3, rotations=True), motion(source="bare")]
    finding = find("mixed-rotations", lint(some))
    assert (finding.severity, finding.source) == ("error", "bare")
    some = [*motions(3, joints=True), motion(source="bare")]
    assert only("mixed-joints", lint(some)).severity == "note"


def test_planar_ones_among_others():
    flat = motion(source="flat")
    flat = flat.with_trajectory(Trajectory(flat.trajectory.times, flat.trajectory.positions * [1, 1, 0]), None)
    finding = find("mixed-dimensions", lint([flat, *motions(3)]))
    assert (finding.severity, finding.source) == ("warning", "flat")


def test_durations_that_differ_much():
    finding = only("durations", lint([motion(duration=12.0, source="slow"), *motions(3)]))
    assert (finding.severity, finding.source) == ("warning", "slow")


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 2, 2)])
def test_motions_in_a_plane(normal):
    n = np.asarray(normal) / np.linalg.norm(normal)
    flattened = []
    for one in motions(4):
        positions = one.trajectory.positions - np.outer(one.trajectory.positions @ n, n)
        flattened.append(one.with_trajectory(Trajectory(one.trajectory.times, positions), None))
    finding = only("planar", lint(flattened))
    assert finding.severity == "note"
    assert f"normal ({n[0]:.2f} {n[1]:.2f} {n[2]:.2f})" in finding.message


def test_motions_on_a_line():
    line = [
        one.with_trajectory(Trajectory(one.trajectory.times, one.trajectory.positions * [1, 0, 0]), None)
        for one in motions(4)
    ]
    assert "of a straight line" in find("planar", lint(line)).message


def test_an_outlier_in_position():
    other = motion(source="odd")
    positions = other.trajectory.positions + np.outer(np.sin(np.linspace(0, np.pi, 300)), [0.0, 0.16, 0.0])
    other = other.with_trajectory(Trajectory(other.trajectory.times, positions), None)
    family = motions(6, noise=1e-3, spread=0.01)
    finding = only("outlier", lint([*family, other]))
    assert (finding.severity, finding.source) == ("warning", "odd")
    assert lint(family) == []


def test_an_outlier_in_rotation_such_as_another_quaternion_order():
    family = motions(6, rotations=True)
    odd = family[2]
    swapped = Trajectory(odd.trajectory.times, odd.trajectory.positions, turn(np.linspace(0, 1, 300))[:, [3, 0, 1, 2]])
    family[2] = replace(odd, trajectory=swapped, source="odd")
    finding = find("rotation-outlier", lint(family))
    assert finding.source == "odd"
    assert "wxyz or xyzw" in finding.remedy


def test_every_code_is_in_the_documentation():
    root = Path(__file__).resolve().parents[1]
    files = ("plausibility.py", "raw.py", "lint.py")
    text = " ".join((root / "src/imitarm/demonstrations" / file).read_text() for file in files)
    used = set(re.findall(r'finding\(\s*"(?:error|warning|note)",\s+"([a-z-]+)",', text))
    used |= set(re.findall(r'"((?:mixed|two)-[a-z]+)"', text)) | {"ends", "direction", "incomplete"}
    documented = set(re.findall(r"`([a-z-]+)`", (root / "docs/demonstrations.md").read_text()))
    assert len(used) > 25
    assert used <= documented
