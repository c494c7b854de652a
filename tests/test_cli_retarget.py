from __future__ import annotations

import argparse
import json
import threading
import time

import numpy as np
import pytest

from imitarm import ArmModel, Demonstration, Pose, Scene, Skill, Sphere, save_scene
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.capture.synthetic import SyntheticSource
from imitarm.cli import main, screen
from imitarm.cli.retarget import _output_files
from imitarm.cli.screen import watched
from imitarm.errors import InputError
from imitarm.retarget import RETARGETERS, LimbLengths
from imitarm.retarget.calibration import Calibration
from recording_samples import changed, exchanged, skeletons

ARM = ArmModel.load("sawyer", tool="gripper")


def reach(camera: int, duration: float = 5.0) -> list[Skeleton]:
    """The same reach of the same person, seen by different cameras."""
    truth = reaching(Person.from_seed(3), 3, duration=duration)
    return list(SyntheticSource(truth, SkeletonCamera(camera, sigma=0.004, dropout=0.0), duration))


def saved(path, frames):
    SkeletonRecording(frames).save(path)
    return str(path)


@pytest.fixture
def shown(tmp_path):
    return saved(tmp_path / "reach.csv", reach(0))


def run(*words) -> int:
    return main(["retarget", *map(str, words), "--tool", "gripper"])


def test_a_recording_becomes_a_demonstration_within_the_limits(shown, tmp_path, capsys):
    out = tmp_path / "demo.csv"
    assert run(shown, "--out", out, "--task", "reach") == 0
    printed = capsys.readouterr().out
    for words in (
        "following",
        "RMS distance of the tool to its own target [mm]",
        "a joint exceeds an acceleration limit",
        f"wrote {out}",
    ):
        assert words in printed
    demo = Demonstration.load(out)
    assert demo.task == "reach" and demo.joint_names == ARM.joint_names
    times, joints = demo.trajectory.times, demo.joints
    np.testing.assert_allclose(times, 0.01 * np.arange(len(times)), atol=1e-9)
    assert 3.0 < times[-1] < 4.6  # the half second before it took hold is cut off
    assert np.abs(np.diff(joints[:60], axis=0)).max() > 1e-4  # and it moves soon
    velocity = np.diff(joints, axis=0) / 0.01
    assert (np.abs(velocity) <= ARM.max_velocity * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(ARM.tool_pose(joints[-1]).position, demo.trajectory.positions[-1], atol=1e-9)


def test_the_waiting_can_be_kept(shown, tmp_path):
    files = [tmp_path / f"{name}.csv" for name in ("cut", "whole")]
    assert run(shown, "--out", files[0]) == 0
    assert run(shown, "--out", files[1], "--keep-waiting") == 0
    cut, whole = map(Demonstration.load, files)
    assert whole.trajectory.duration > cut.trajectory.duration + 0.4
    assert np.ptp(whole.joints[:40], axis=0).max() == 0.0
    np.testing.assert_array_equal(whole.joints[-len(cut) :], cut.joints)


@pytest.mark.slow
def test_several_of_them_are_learned(tmp_path, capsys):
    for camera in range(3):
        saved(tmp_path / f"seen_{camera}.csv", reach(camera))
        assert run(tmp_path / f"seen_{camera}.csv", "--out", tmp_path / f"demo_{camera}.csv", "--task", "reach") == 0
    files = [str(tmp_path / f"demo_{camera}.csv") for camera in range(3)]
    skill = tmp_path / "reach.json"
    assert (
        main(["learn", *files, "--robot", "sawyer", "--tool", "gripper", "--task", "reach", "--out", str(skill)]) == 0
    )
    assert "0 errors" in capsys.readouterr().out
    learned = Skill.load(skill)
    first = Demonstration.load(files[0]).trajectory
    assert np.linalg.norm(learned.start_.position - first.positions[0]) < 0.03
    assert np.linalg.norm(learned.goal_.position - first.positions[-1]) < 0.05


@pytest.mark.slow
def test_all_methods_side_by_side(shown, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # a narrower terminal breaks the words of a table
    out, page = tmp_path / "demo.csv", tmp_path / "page.html"
    assert run(shown, "--method", "all", "--out", out, "--report", page, "--drive") == 0
    shown_table = capsys.readouterr().out
    for name in RETARGETERS:
        assert len(Demonstration.load(tmp_path / f"demo_{name}.csv")) > 100
    row = next(line for line in shown_table.splitlines() if "simulated: RMS position error of the worst joint" in line)
    assert len(row.split("│")) == 2 + 1 + len(RETARGETERS)
    text = page.read_text(encoding="utf-8")
    assert text.count('id="tab-method-') == len(RETARGETERS)
    assert 'class="verdict good"' in text  # modern breaks nothing


def test_a_made_up_person_is_a_source_and_is_measured_against_the_truth(tmp_path, capsys):
    assert run("synthetic:1", "--seconds", 4, "--robot", "panda") == 0
    printed = capsys.readouterr()
    assert "RMS distance of the tool to the true hand" in printed.out and "on panda" in printed.out
    row = next(line for line in printed.out.splitlines() if "RMS distance of the tool to the true hand" in line)
    assert float(row.split("│")[2]) < 120.0


def test_a_calibration_says_side_scale_and_turning_and_options_say_it_better(shown, tmp_path, capsys):
    file, demos = tmp_path / "calibration.json", [tmp_path / f"{i}.csv" for i in range(3)]
    person = Person.from_seed(3)
    lengths = LimbLengths(person.upper_arm, person.forearm)
    Calibration(side="right", lengths=lengths, scale=0.5, orientation="fixed").save(file)
    assert run(shown, "--calibration", file, "--out", demos[0]) == 0
    assert run(shown, "--calibration", file, "--scale", 0.25, "--out", demos[1]) == 0
    assert run(shown, "--calibration", file, "--side", "left", "--out", demos[2]) == 0
    assert "the calibration is of the right arm" in capsys.readouterr().err
    half, quarter, left = (Demonstration.load(path).trajectory for path in demos)
    assert np.ptp(quarter.positions, axis=0).max() == pytest.approx(
        0.5 * np.ptp(half.positions, axis=0).max(), rel=0.15
    )
    assert np.abs(half.quaternions - half.quaternions[0]).max() < 0.05
    assert np.ptp(left.positions, axis=0).max() < 0.1  # that arm hangs


def test_with_fit_a_motion_that_is_too_large_is_made_smaller(shown, tmp_path, capsys):
    assert run(shown, "--scale", 6, "--fit", "--pace", 0.2, "--orientation", "fixed", "--out", tmp_path / "a.csv") == 0
    printed = capsys.readouterr()
    assert "instead of 6.00, so that the whole motion is within reach" in printed.err
    assert "slowed the recording to 20 % of its speed" in printed.err
    assert Demonstration.load(tmp_path / "a.csv").trajectory.duration > 20.0
    row = next(line for line in printed.out.splitlines() if "RMS distance of the tool to its own target" in line)
    assert float(row.split("│")[2]) < 40.0


def test_what_is_in_the_way_is_kept_clear_of(shown, tmp_path):
    free, round_it, scene = tmp_path / "free.csv", tmp_path / "round.csv", tmp_path / "ball.yaml"
    assert run(shown, "--out", free) == 0
    path = Demonstration.load(free)
    ball = Sphere(path.trajectory.positions[len(path) // 2] - np.array([0.0, 0.0, 0.05]), 0.04)
    save_scene(Scene(None, [ball]), scene)
    assert run(shown, "--scene", scene, "--out", round_it) == 0

    def nearest(file):
        joints = Demonstration.load(file).joints
        spheres = [ARM.collision_spheres(q) for q in joints[::5]]
        return min(float((ball.signed_distance(centres) - radii).min()) for centres, radii in spheres)

    assert nearest(free) < 0.0 < nearest(round_it)


def test_a_tool_that_does_not_follow_its_target_is_reported_first_and_is_not_green(shown, tmp_path, capsys):
    """Six times as large as the person's, the motion leaves the arm's reach; as large as that, it does not."""
    page, demo = tmp_path / "page.html", tmp_path / "demo.csv"
    assert run(shown, "--scale", 6, "--report", page, "--out", demo) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("modern: does not follow") and "no joint exceeds a limit" in printed.out
    assert "warning: the tool did not follow its target: try --orientation fixed" in printed.err
    text = page.read_text(encoding="utf-8")
    assert 'class="verdict bad"' in text and 'class="verdict good"' not in text
    assert (
        "modern: does not follow" in text
        and "the distance exceeds 5 cm for" in text
        and "try --orientation fixed" in text
    )
    assert len(Demonstration.load(demo)) > 100
    assert run(shown, "--report", page) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("modern: follows") and "warning: the tool" not in printed.err
    assert 'class="verdict good"' in page.read_text(encoding="utf-8")


def test_one_of_two_persons_and_repairs(tmp_path, capsys):
    frames = [exchanged(s) if i == 60 else s for i, s in enumerate(skeletons(90, person=1))]
    frames[50] = changed(frames[50], time=frames[49].time)
    both = sorted(frames + skeletons(60, person=2, away=0.8), key=lambda s: s.time)
    source = saved(tmp_path / "two.csv", both)
    assert run(source) == 0
    reported = capsys.readouterr().err
    for words in (
        "repaired: kept person 1",
        "repaired: dropped 1 frames",
        "swapped left and right back in 1 frames",
    ):
        assert words in reported
    assert run(source, "--person", 2) == 0
    assert "kept person" not in capsys.readouterr().err
    assert run(source, "--person", 5) == 2
    assert "person 5 is not in this recording, which contains: 1, 2" in capsys.readouterr().err


def test_a_stop_on_the_way_is_reported(tmp_path, capsys):
    frames = [s for s in reach(0) if not 2.0 < s.time < 2.8]
    assert run(saved(tmp_path / "gap.csv", frames)) == 0
    reported = capsys.readouterr().err
    assert "stopped or waited for" in reported and "warning gap" in reported


def lost(skeleton):
    tracking = np.array(skeleton.tracking)
    tracking[[JOINT["elbow_right"], JOINT["wrist_right"]]] = 0
    return Skeleton(skeleton.time, skeleton.positions, tracking)


@pytest.mark.parametrize("n", [0, 10])
def test_an_arm_that_is_never_seen_for_long_is_a_failure_and_nothing_is_written(tmp_path, capsys, n):
    """Never at all, or for a third of a second."""
    source = saved(tmp_path / "lost.csv", [s if i < n else lost(s) for i, s in enumerate(reach(0))])
    out, page = tmp_path / "demo.csv", tmp_path / "page.html"
    assert run(source, "--out", out, "--report", page) == 1
    reported = capsys.readouterr().err
    assert "right arm" in reported and "--side" in reported
    assert not out.exists() and not page.exists()


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--scale", "-1"], "scale must be a finite number"),
        (["--pace", "2"], "must be a finite number of at least 0.05 and of at most 1"),
        (["--seconds", "0"], "--seconds must be above 0"),
        (["--trim", "50", "60"], "no frame between"),
        (["--out", "nowhere/demo.csv"], "there is no folder nowhere"),
        (["--report", "nowhere/page.html"], "there is no folder nowhere"),
        (["--robot", "sawyr"], "sawyr"),
        (["--scene", "nothing.yaml"], "nothing.yaml"),
        (["--calibration", "nothing.json"], "nothing.json"),
        (["--method", "m9"], "invalid choice"),
        (["--orientation", "sideways"], "invalid choice"),
    ],
)
def test_wrong_options_are_reported_and_nothing_is_written(shown, tmp_path, monkeypatch, capsys, words, reported):
    monkeypatch.chdir(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    assert run(shown, *words) == 2
    message = capsys.readouterr().err
    assert reported in message and "Traceback" not in message
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["--report", "reach.csv"], "--report reach.csv: is also the file of SOURCE"),
        (["--report", "{}/reach.csv", "--force"], "is also the file of SOURCE"),
        (["--report", "link.csv", "--force"], "is also the file of SOURCE"),
        (["--out", "reach.csv", "--force"], "--out reach.csv: is also the file of SOURCE"),
        (["--out", "o.csv", "--report", "o.csv"], "--report o.csv: is also the file of --out"),
        (["--out", "o.csv", "--report", "folder/../o.csv", "--force"], "is also the file of --out"),
        (["--method", "all", "--out", "o.csv", "--report", "o_m1.csv"], "is also the file of --out"),
        (["--calibration", "mine.json", "--report", "mine.json"], "is also the file of --calibration"),
        (["--scene", "mine.json", "--out", "mine.json", "--force"], "is also the file of --scene"),
        (["--robot", "mine.json", "--out", "mine.json", "--force"], "is also the file of --robot"),
        (["--report", "mine.json"], "already exists and is not an HTML page; name another file"),
        (["--report", "folder"], "--report folder: is a folder; name a file in it"),
        (["--out", "folder"], "--out folder: is a folder; name a file in it"),
        (["--out", "folder", "--force"], "--out folder: is a folder; name a file in it"),
        (["--out", "folder", "--method", "all"], "--out folder: is a folder; name a file in it"),
        (["--out", ".", "--method", "all"], "--out .: is a folder; name a file in it"),
    ],
)
def test_no_file_is_lost_by_writing(shown, tmp_path, monkeypatch, capsys, words, reported):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("imitarm.cli.retarget.ArmModel.load", lambda *_, **__: pytest.fail("it has begun to work"))
    (tmp_path / "mine.json").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.csv").symlink_to(shown)
    before = {path.name: path.is_file() and path.read_bytes() for path in tmp_path.iterdir()}
    assert run(shown, *(word.format(tmp_path) for word in words)) == 2
    message = capsys.readouterr().err
    assert reported in message and message.startswith("imitarm: error: ")
    assert {path.name: path.is_file() and path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("content", "more", "replaced"),
    [
        ("<!DOCTYPE html>\n<p>older</p>", [], True),
        ("  <html><p>older</p></html>", [], True),
        ("", [], True),
        ("t,x\n0,1\n", [], False),
        ("a letter about <html>", [], False),
        ("a letter about <html>", ["--force"], True),
    ],
)
def test_a_report_replaces_a_page_and_nothing_else_unasked(tmp_path, content, more, replaced):
    page = tmp_path / "page.html"
    page.write_text(content)
    words = argparse.Namespace(source="synthetic:1", out=None, report=page, force=bool(more), pace=1.0, seconds=None)
    words.robot, words.tool, words.scene, words.calibration = "sawyer", None, None, None
    if replaced:
        assert _output_files(words, ["modern"]) == {}
    else:
        with pytest.raises(InputError, match="already exists and is not an HTML page"):
            _output_files(words, ["modern"])
    assert page.read_text() == content


def test_wrong_sources_are_reported(tmp_path, capsys):
    foreign = tmp_path / "foreign.csv"
    foreign.write_text("a,b\n1,2\n")
    assert run(foreign) == 2
    assert "foreign.csv" in capsys.readouterr().err
    assert run("nothing.csv") == 2
    assert run("udp:5005", "--pace", 0.5) == 2
    assert run("synthetic:x") == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_file_that_is_there_is_not_replaced_unasked(shown, tmp_path, capsys):
    out = tmp_path / "demo.csv"
    out.write_text("mine")
    assert run(shown, "--out", out) == 2
    assert "already exists" in capsys.readouterr().err and out.read_text() == "mine"
    assert run(shown, "--out", out, "--force") == 0
    assert len(Demonstration.load(out)) > 100


def test_a_sensor_that_was_calibrated_turns_the_motion(shown, tmp_path):
    """Turned by a quarter about the vertical, the same reach goes to another side."""
    file, demos = tmp_path / "calibration.json", [tmp_path / f"{i}.csv" for i in range(2)]
    facing = Calibration(scale=0.5, orientation="fixed").correspondence().sensor_to_base
    for path, angle in zip(demos, (0.0, 0.5 * np.pi), strict=True):
        turn = Pose(np.zeros(3), np.array([np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)]))
        Calibration(scale=0.5, orientation="fixed", sensor_to_base=turn @ facing).save(file)
        assert json.loads(file.read_text())["scale"] == 0.5
        assert run(shown, "--calibration", file, "--out", path) == 0
    ahead, turned = (Demonstration.load(path).trajectory.positions for path in demos)
    x, y = (ahead[150] - ahead[0])[:2]
    np.testing.assert_allclose((turned[150] - turned[0])[:2], [-y, x], atol=0.03)


def test_work_that_is_quick_shows_no_bar_and_errors_pass_through():
    asked = []
    with watched("x", lambda: asked.append(0) or 0.5):
        time.sleep(0.01)
    assert not asked
    with pytest.raises(ValueError, match="inside"), watched("x", lambda: 0.5):
        raise ValueError("inside")


def test_work_that_takes_long_shows_a_bar_with_its_share(monkeypatch):
    monkeypatch.setattr(screen, "_LONG", 0.0)
    asked = threading.Event()

    def share() -> float:
        asked.set()
        return 7.0  # more than all of it is no fault

    with watched("a long work", share):
        assert asked.wait(10.0)
    assert "a long work" not in {thread.name for thread in threading.enumerate()}  # whoever watched has gone
