"""The commands demo and reproduce, as a user calls them: exit status, files, messages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from imitarm.cli import main
from imitarm.cli.demo import packaged_demonstrations
from imitarm.demonstrations import align, read
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration

SCENES = Path(__file__).parent.parent / "examples" / "real_data"


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    path = tmp_path_factory.mktemp("skills") / "sweep.json"
    Skill(10).fit(align(packaged_demonstrations())).save(path)
    return path


@pytest.mark.slow
def test_the_demo_does_the_main_job(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "no contact in 6 of 6 scenes with obstacles" in out
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["passed"] and len(results["scenes"]) == 7
    *standing, one, two = results["scenes"][1:]
    for scene, name in ((one, "pushed_box"), (two, "pushed_box_and_bottle")):
        assert scene["name"] == name and scene["success"] and scene["min_clearance_m"] > 0.015
    for scene in standing:
        assert scene["success"] and scene["min_clearance_m"] > 0.015 and scene["certified_clearance_m"] >= 0.02
        assert scene["n_moved_components"] < scene["n_components"]
        assert scene["details"]["dirt in the pan"] == "100 %"
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'src="http' not in page and 'href="http' not in page
    assert Skill.load(tmp_path / "out" / "skill.json").n_demonstrations_ == 8
    assert str(tmp_path) not in (tmp_path / "out" / "skill.json").read_text()


def test_a_demo_that_fails_says_so_by_its_status(tmp_path, monkeypatch, capsys):
    """Where no path is found, the exit status tells."""
    monkeypatch.setattr("imitarm.cli.demo.write_report", lambda report, path: path)
    monkeypatch.setattr("imitarm.policies.arm_planner.ArmPlanner.plan", lambda *_: None)  # no path is found
    assert main(["demo", "--out", str(tmp_path), "--scenes", "T1", "two_boxes"]) == 1  # one scene, by both its names
    out = " ".join(capsys.readouterr().out.split())
    assert "can't move its tool along the path" in out and "of 1 scenes" in out


def test_a_demo_folder_that_cannot_be_made_is_bad_input(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["demo", "--out", str(tmp_path / "file" / "sub")]) == 2
    assert "name another folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["skill.json", "report.html", "results.json"])
def test_the_demo_replaces_no_file_unasked(tmp_path, monkeypatch, capsys, name):
    (tmp_path / name).write_text("mine")
    with monkeypatch.context() as patch:
        patch.setattr("imitarm.cli.demo.SweepTask", lambda **_: pytest.fail("it has begun to work"))
        assert main(["demo", "--out", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert f"{name}: already exists" in message and "--force" in message
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "mine"
    monkeypatch.setattr("imitarm.cli.demo.DEMO_SCENES", ())
    assert main(["demo", "--out", str(tmp_path), "--force"]) in {0, 1}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "results.json", "skill.json"]
    assert (tmp_path / name).read_text() != "mine"


def test_make_demo_can_be_said_again():
    makefile = (SCENES.parents[1] / "Makefile").read_text()
    assert "imitarm demo --force\n" in makefile


@pytest.mark.slow
@pytest.mark.parametrize(("recording", "scene"), [("pouring", "pouring_scene"), ("bottle2shelf", "shelf_scene")])
def test_real_recordings_on_the_panda_around_three_obstacles(real_data, tmp_path, capsys, recording, scene):
    """Hand-guided on a real Panda; learnt with orientation, reproduced without contact, as docs/real_data.md says."""
    shown = read(real_data / "panda_kinesthetic" / f"{recording}.npy", units="cm", duration=10.0, task=recording)
    skill = Skill().fit(align(shown))
    assert skill.gmr_.has_orientation_
    skill.save(tmp_path / "skill.json")
    command = ["reproduce", str(tmp_path / "skill.json"), "--robot", "panda", "--tool", "gripper"]
    status = main([*command, "--scene", str(SCENES / f"{scene}.yaml"), "--out", str(tmp_path / "done.csv")])
    out = capsys.readouterr().out
    assert status == 0, out
    assert "no contact in 1 of 1 scenes with obstacles" in out
    done = Demonstration.load(tmp_path / "done.csv")
    assert done.joints is not None and done.joints.shape[1] == 7


def test_reproduce_without_obstacles(sweep, capsys):
    assert main(["reproduce", str(sweep), "--robot", "sawyer", "--tool", "brush", "--keep-height"]) == 0
    assert "1 of 1 scenes completed" in capsys.readouterr().out


def test_a_refusal_is_a_failed_task_with_the_obstacle_and_the_reason(sweep, tmp_path, capsys):
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "format: imitarm-scene\nversion: 1\nunits: cm\n"
        "obstacles: [{type: box, name: crate, position: [58, -48, 5], size: [10, 10, 10]}]\n"
    )
    command = ["reproduce", str(sweep), "--robot", "sawyer", "--tool", "brush", "--scene", str(scene)]
    assert main(command) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "crate" in out and "start" in out


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["nosuch.json", "--robot", "sawyer"], 2, "nosuch.json"),
        (["{sweep}", "--robot", "atlas"], 2, "known: panda, sawyer"),
        (["{sweep}", "--robot", "sawyer", "--tool", "hammer"], 2, "hammer"),
        (["{sweep}", "--robot", "sawyer", "--scene", "nosuch.yaml"], 2, "nosuch.yaml"),
        (["{sweep}", "--robot", "sawyer", "--report", "nowhere/page.html"], 2, "there is no folder"),
        (["{sweep}", "--robot", "sawyer", "--report", "{sweep}"], 2, "is also the file of SKILL"),
        (["{sweep}", "--robot", "sawyer", "--out", "{sweep}", "--force"], 2, "is also the file of SKILL"),
        (["{sweep}", "--robot", "sawyer", "--out", "new.csv", "--report", "new.csv"], 2, "is also the file of --out"),
        (["{sweep}", "--robot", "sawyer", "--out", ".", "--force"], 2, "is a folder"),
        (["{sweep}", "--robot", "sawyer", "--start", "300", "0", "0"], 2, "can't bring its tool"),
        (["{sweep}", "--robot", "sawyer", "--goal", "300", "0", "0"], 2, "can't bring its tool"),
        (["{sweep}", "--robot", "sawyer", "--clearance", "-5"], 2, "clearance"),
    ],
)
def test_bad_input_is_one_clear_message(sweep, capsys, words, status, message):
    assert main(["reproduce", *(word.format(sweep=sweep) for word in words)]) == status
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and error.count("imitarm: error:") == 1


def test_a_damaged_skill_is_refused(sweep, tmp_path, capsys):
    damaged = tmp_path / "skill.json"
    damaged.write_text(sweep.read_text().replace("0.5", "0.6", 1))
    assert main(["reproduce", str(damaged), "--robot", "sawyer"]) == 2
    assert "skill.json" in capsys.readouterr().err


def test_a_certificate_that_needs_a_schedule_is_void_when_the_motion_stops(sweep, tmp_path, capsys):
    """A ball drives into the shoulder: after the stop, nothing holds that was certified for the plan."""
    scene, report = tmp_path / "scene.yaml", tmp_path / "report.html"
    scene.write_text(
        "format: imitarm-scene\nversion: 1\nobstacles:\n"
        "- {type: sphere, name: ball, center: [0.9, 0, 0.35], radius: 0.1, velocity: [-0.15, 0, 0]}\n"
    )
    arguments = ["--tool", "brush", "--scene", str(scene), "--report", str(report)]
    assert main(["reproduce", str(sweep), *arguments]) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "void" in text and "on schedule; the motion did not finish" in text, text
    assert "on schedule; the motion did not finish" in report.read_text()


def test_tilts_concern_the_plan_of_the_whole_arm(sweep, capsys):
    for option in ("--max-tilt", "--goal-tilt"):
        assert main(["reproduce", str(sweep), "--tool", "brush", "--tool-only", option, "10"]) == 2
        assert f"{option} applies only to a plan of the whole arm" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--policy rcamo --max-tilt 10", "--max-tilt: the policy rcamo has no such option"),
        ("--policy rcamo --goal-tilt 10", "--goal-tilt: the policy rcamo has no such option"),
        ("--clearance -5", "--clearance must be a finite number of at least 0 [mm], got -5.0"),
        ("--tool-radius nan", "--tool-radius must be a finite number of at least 0 [mm]"),
        ("--goal nan 0 0", "--goal must be finite [cm]"),
        ("--start 0 inf 0", "--start must be finite [cm]"),
    ],
)
def test_options_without_effect_or_meaning_are_named(sweep, options, said, capsys):
    assert main(["reproduce", str(sweep), *options.split()]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_scene_begins_at_its_stamp(sweep, tmp_path, capsys):
    """A ball that was on the path ten seconds before the stamp of the file is out of the way now."""
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "format: imitarm-scene\nversion: 1\nstamp: 10\nobstacles:\n"
        "- {type: sphere, name: ball, center: [0.6, 0.3, 2.0], radius: 0.1, velocity: [0, 0, 0.2]}\n"
    )
    assert main(["reproduce", str(sweep), "--tool", "brush", "--keep-height", "--scene", str(scene)]) == 0
    assert "no contact in 1 of 1 scenes" in capsys.readouterr().out


def test_an_obstacle_follows_the_track_of_the_scene_file(sweep, tmp_path, capsys):
    """The box leaves the path after the plan was made; without its track, the goal would be blocked."""
    scene, report = tmp_path / "scene.yaml", tmp_path / "report.html"
    head = "format: imitarm-scene\nversion: 1\nstamp: 5\nobstacles:\n"
    box = "- {type: box, name: crate, position: [0.9, 0.4, 0.1], size: [0.1, 0.1, 0.2], track: %s}\n"
    scene.write_text(head + box % "[[5, 0.9, -0.6, 0.1], [6, 0.95, -0.6, 0.1], [8, 0.95, -0.8, 0.1]]")
    command = ["reproduce", str(sweep), "--tool", "brush", "--keep-height", "--scene", str(scene)]
    assert main([*command, "--report", str(report)]) == 0
    assert "no contact in 1 of 1 scenes" in capsys.readouterr().out
    scene.write_text(head + box % "[[5, 0.9, -0.6, 0.1], [4, 0.95, -0.6, 0.1]]")
    assert main(command) == 2
    assert "track: times" in " ".join(capsys.readouterr().err.split())


PUSHED = """\
format: imitarm-scene
version: 1
units: m
obstacles:
- type: box
  name: parcel
  position: [0.95, -0.28, 0.06]
  size: [0.1, 0.1, 0.12]
  track:
  - [1.5, 0.95, -0.28, 0.06]
  - [3.0, 0.65, -0.28, 0.06]
  - [5.5, 0.65, -0.28, 0.06]
  - [7.0, 0.95, -0.28, 0.06]
"""


def test_a_camera_sees_what_the_policy_evades(sweep, tmp_path, capsys):
    scene = tmp_path / "pushed.yaml"
    scene.write_text(PUSHED)
    command = ["reproduce", str(sweep), "--tool", "brush", "--keep-height", "--policy", "rcamo", "--scene", str(scene)]
    assert main([*command, "--camera", "155", "0", "95"]) == 0
    assert "no contact in 1 of 1 scenes with obstacles" in capsys.readouterr().out
    assert main([*command, "--camera", "70", "0", "30"]) == 2
    assert "--camera: 3" in capsys.readouterr().err
    assert main([*command, "--camera", "1e9", "0", "95"]) == 2
    assert "m from the learned path is too far" in capsys.readouterr().err


def test_a_camera_that_looks_away_from_the_obstacle_does_not_save_the_arm(sweep, tmp_path, monkeypatch, capsys):
    scene = tmp_path / "pushed.yaml"
    scene.write_text(PUSHED)
    monkeypatch.setattr("imitarm.tasks.watching.DepthCamera.frame", lambda self: None)  # it has no images
    command = ["reproduce", str(sweep), "--tool", "brush", "--keep-height", "--policy", "rcamo", "--scene", str(scene)]
    assert main([*command, "--tool-only", "--camera", "155", "0", "95"]) == 1
    assert "parcel" in " ".join(capsys.readouterr().out.split())
