from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import imitarm
from demonstration_samples import motion, motions
from imitarm import cli
from imitarm.cli import COMMANDS, main
from imitarm.errors import InputError, UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Trajectory


@pytest.fixture
def shown(tmp_path):
    """A folder of five demonstrations."""
    folder = tmp_path / "shown"
    folder.mkdir()
    for i, one in enumerate(motions(5, rotations=True)):
        one.save(folder / f"demo_{i}.csv")
    return folder


def failing(monkeypatch, error):
    """Let a command fail with ``error``."""

    def run(arguments):
        raise error

    command = SimpleNamespace(EPILOG="", add_arguments=lambda parser: None, run=run)
    monkeypatch.setattr(cli.importlib, "import_module", lambda name: command)
    return main(["lint"])


# --- the frame


def test_help_and_version(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    assert "examples:" in text
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"imitarm {imitarm.__version__}\n"


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_has_help_with_examples(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert "examples:\n  imitarm " + command in text


@pytest.mark.parametrize(
    "words", [[], ["fly"], ["lint"], ["lint", "a.csv", "--units", "inch"], ["learn", "--nonsense"]]
)
def test_words_that_are_no_command(words, capsys):
    assert main(words) == 2
    assert "imitarm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (InputError("wrong"), 2, "imitarm: error: wrong\n"),
        (UnreachableError("too far"), 2, "imitarm: error: too far\n"),
        (
            PermissionError(13, "Permission denied", "x.csv"),
            2,
            "imitarm: error: [Errno 13] Permission denied: 'x.csv'\n",
        ),
        (KeyboardInterrupt(), 130, "imitarm: error: interrupted\n"),
    ],
)
def test_failures_are_one_message_and_an_exit_status(monkeypatch, capsys, error, status, message):
    assert failing(monkeypatch, error) == status
    assert capsys.readouterr().err == message


def test_a_bug_is_owned_up_to_without_a_traceback(monkeypatch, capsys):
    monkeypatch.delenv("IMITARM_DEBUG", raising=False)
    assert failing(monkeypatch, ZeroDivisionError("division by zero")) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "bug in imitarm, please report it (ZeroDivisionError: division by zero); IMITARM_DEBUG=1" in message
    monkeypatch.setenv("IMITARM_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        failing(monkeypatch, ZeroDivisionError())


def test_help_imports_nothing_heavy():
    script = (
        "import sys; from imitarm.cli import main; main(['--help']); "
        "heavy = {'numpy', 'scipy', 'mujoco', 'rich', 'viser', 'matplotlib'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_reader_that_goes_away_is_no_error(shown):
    """As in ``imitarm lint folder | true``."""
    script = "import sys; from imitarm.cli import main; sys.exit(main(sys.argv[1:]))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", script, "lint", str(shown)],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writer)
    assert "Traceback" not in done.stderr
    assert "error" not in done.stderr


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Tables as wide as in a file: the tests read words, not how they are broken into lines."""
    monkeypatch.setenv("COLUMNS", "200")


# --- lint


def test_lint_of_clean_demonstrations(shown, capsys):
    assert main(["lint", str(shown)]) == 0
    assert capsys.readouterr().out == "5 demonstrations, 0 errors, 0 warnings, 0 notes\n"


def test_lint_names_every_bad_file_and_goes_on(shown, capsys):
    (shown / "demo_5.csv").write_text("t,x,y,z\n0,0,0,0\n1,oops,0,0\n")
    (shown / "demo_6.csv").write_bytes(b"")
    assert main(["lint", str(shown), str(shown / "missing[1].csv")]) == 2
    text = capsys.readouterr().out
    assert "line 3, column 2: 'oops' is not a number" in text
    assert "the file is empty" in text
    assert "missing[1].csv" in text
    assert "check the path" in text
    assert "5 demonstrations, 3 errors, 0 warnings, 0 notes" in text


def test_lint_shows_place_and_remedy(shown, capsys):
    lines = (shown / "demo_1.csv").read_text().splitlines()
    lines[100] = lines[99]
    (shown / "demo_1.csv").write_text("\n".join(lines) + "\n")
    assert main(["lint", str(shown)]) == 2
    text = capsys.readouterr().out
    assert "non-monotonic-stamps" in text
    assert "line 101" in text
    assert "--repair" in text


def test_lint_against_an_arm(shown, tmp_path, capsys):
    far = motion(offset=(2.0, 0.0, 0.0), rotations=True)
    far.save(tmp_path / "far.csv")
    assert main(["lint", str(tmp_path / "far.csv"), "--robot", "panda", "--tool", "gripper"]) == 2
    assert "out of reach" in capsys.readouterr().out
    assert main(["lint", str(shown), "--tool", "gripper"]) == 2
    assert "--tool needs --robot" in capsys.readouterr().err
    assert main(["lint", str(shown), "--robot", "puma"]) == 2
    assert "unknown robot 'puma'; known: panda, sawyer" in capsys.readouterr().err


# --- learn


def test_learn_writes_a_skill(shown, tmp_path, capsys):
    out = tmp_path / "reach.json"
    assert main(["learn", str(shown), "--task", "reaching", "--components", "6", "--out", str(out)]) == 0
    skill = Skill.load(out)
    assert skill.gmr_.n_components_ == 6
    assert skill.gmr_.has_orientation_
    assert skill.task_ == "reach"  # what the files say comes first
    assert len(skill.provenance_["sources"]) == 5
    assert "largest time shift" in skill.provenance_["notes"][0]
    text = capsys.readouterr().out
    assert "0 errors" in text
    assert f"wrote {out}" in text
    peak = skill.generate().positions[:, 2].max() - skill.start_.position[2]
    assert peak > 0.085


def test_learn_real_demonstrations_and_choose_the_components(real_data, tmp_path, capsys):
    out = tmp_path / "pour.json"
    file = real_data / "panda_kinesthetic" / "pouring.npy"
    words = ["--task", "pour", "--units", "cm", "--duration", "10", "--out", str(out), "--robot", "panda"]
    assert main(["learn", str(file), *words]) == 0
    skill = Skill.load(out)
    assert (skill.task_, skill.n_demonstrations_) == ("pour", 9)
    assert skill.duration_ == pytest.approx(10.0, abs=0.5)
    text = capsys.readouterr().out
    assert "held-out error [mm]" in text
    assert text.count("chosen") == 1
    assert any("idle-tail" in note for note in skill.provenance_["notes"])


def test_learn_refuses_what_lint_calls_an_error(shown, tmp_path, capsys):
    out = tmp_path / "reach.json"
    lines = (shown / "demo_1.csv").read_text().splitlines()
    lines[100] = lines[99]
    (shown / "demo_1.csv").write_text("\n".join(lines) + "\n")
    words = ["learn", str(shown), "--components", "5", "--out", str(out)]
    assert main(words) == 2
    captured = capsys.readouterr()
    assert "non-monotonic-stamps" in captured.out
    assert "not learned: fix the errors above" in captured.err
    assert not out.exists()
    assert main([*words, "--repair"]) == 0
    assert "(1 of 300 rows dropped)" in Skill.load(out).provenance_["sources"][1]


def test_learn_in_spite_of_an_error(shown, tmp_path, capsys):
    out = tmp_path / "reach.json"
    (shown / "demo_9.csv").write_text("t,x,y,z\n0,1\n")
    words = ["learn", str(shown), "--components", "4", "--out", str(out)]
    assert main(words) == 2
    assert main([*words, "--allow-errors"]) == 0
    assert Skill.load(out).n_demonstrations_ == 5
    assert capsys.readouterr().out.count("unreadable") == 2


def test_learn_tells_what_the_learner_warns_of(tmp_path, capsys):
    motion().save(tmp_path / "one.csv")
    assert main(["learn", str(tmp_path / "one.csv"), "--components", "6", "--out", str(tmp_path / "s.json")]) == 0
    assert "warning: only one demonstration" in capsys.readouterr().err


def test_learn_does_not_overwrite_unasked(shown, tmp_path, capsys):
    out = tmp_path / "s.json"
    out.write_text("precious")
    words = ["learn", str(shown), "--components", "6", "--out"]
    assert main([*words, str(out)]) == 2
    assert "replace it with --force" in capsys.readouterr().err
    assert out.read_text() == "precious"
    assert main([*words, str(tmp_path / "no" / "s.json")]) == 2
    assert "there is no folder" in capsys.readouterr().err
    assert main([*words, str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    one = next(path for path in shown.iterdir())
    before = one.read_bytes()
    assert main([*words, str(one), "--force"]) == 2
    assert "is also the file of FILE" in capsys.readouterr().err and one.read_bytes() == before
    assert main([*words, str(out), "--force"]) == 0
    assert Skill.load(out).n_demonstrations_ == 5


def test_learn_reports_the_distance_to_each_demonstration(shown, tmp_path, capsys):
    assert main(["learn", str(shown), "--components", "6", "--out", str(tmp_path / "s.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    quality = Skill.load(tmp_path / "s.json").fit_quality_
    for d in quality.distances:
        (row,) = [line for line in lines if d.source in line and "mm" not in line and "│" in line]
        cells = [cell.strip() for cell in row.strip("│").split("│")]
        assert cells == [d.source, *(f"{1e3 * x:.1f}" for x in (d.rms, d.largest, d.start, d.goal))]
    assert any("distance to the mean demonstration (bias)" in line for line in lines)


def test_learn_does_not_report_a_poor_fit_as_success(tmp_path, capsys):
    t = np.linspace(0.0, 40.0, 400)
    for i in range(3):
        angle = 2.0 * np.pi * 12.0 * t / 40.0
        x = np.column_stack([0.4 + 0.05 * np.cos(angle), 0.05 * np.sin(angle) + 0.001 * i, 0.2 + 0.0 * t])
        Demonstration(Trajectory(t, x), task="stir").save(tmp_path / f"{i}.csv")
    out = tmp_path / "s.json"
    words = ["learn", *(str(tmp_path / f"{i}.csv") for i in range(3)), "--out", str(out)]
    assert main([*words, "--components", "10"]) == 1
    error = capsys.readouterr().err
    assert "does not reproduce the motion" in error
    assert "use more than 10 components" in error
    assert "the motion repeats every 3.3" in error
    assert not out.exists()
    assert main([*words, "--components", "10", "--allow-errors"]) == 0
    assert not Skill.load(out).fit_quality_.faithful
    assert main([*words, "--force"]) == 0
    assert Skill.load(out).fit_quality_.faithful
    assert "note: the motion repeats every 3.3" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["0", "-1", "many", "2.5"])
def test_learn_with_an_impossible_number_of_components(shown, number, capsys):
    assert main(["learn", str(shown), f"--components={number}"]) == 2
    assert "neither 'auto' nor a number above 0" in capsys.readouterr().err


# --- robots


def test_robots_lists_arms_and_tools(capsys):
    assert main(["robots"]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("panda", "sawyer", "tools: brush, gripper", "0.86"))


def test_robots_shows_one_arm(capsys):
    assert main(["robots", "sawyer", "--tool", "brush"]) == 0
    text = capsys.readouterr().out
    arm = ArmModel.load("sawyer", tool="brush")
    assert all(name in text for name in arm.joint_names)
    assert f"{np.degrees(arm.upper[0]):.4g}" in text
    assert "the tool reaches" in text
    assert "the tool's tip is at" in text


def test_robots_inspects_any_file(tmp_path, capsys):
    file = tmp_path / "two_links.xml"
    file.write_text(
        "<mujoco><worldbody><body><joint name='a' axis='0 0 1'/><geom size='.05' mass='1'/>"
        "<body pos='.5 0 0'><joint name='b' axis='0 1 0' range='-90 90' limited='true'/><geom size='.05' mass='1'/>"
        "<body name='tip' pos='.4 0 0'/></body></body></worldbody></mujoco>"
    )
    assert main(["robots", str(file), "--flange", "tip"]) == 0
    text = capsys.readouterr().out
    assert "two_links" in text
    assert "-90" in text
    file.write_text("<mujoco><worldbody>")
    assert main(["robots", str(file)]) == 2
    assert "not an XML file" in capsys.readouterr().err
    assert main(["robots", "puma"]) == 2
    assert "known: panda, sawyer" in capsys.readouterr().err
