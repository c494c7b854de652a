"""The options that name a robot are the same in every command, and ``imitarm robots`` shows what a file holds."""

from __future__ import annotations

import argparse

import pytest

from imitarm import cli
from imitarm.cli import main
from imitarm.cli.robot_options import add_robot_options, load_optional_robot, load_robot
from imitarm.errors import InputError

TAKES_A_ROBOT = {
    "lint": [], "learn": [], "retarget": [], "teleoperate": [], "reproduce": [], "serve": [], "robots": [],
    "calibrate": ["clutch"],
}  # fmt: skip
OPTIONAL = {"lint", "learn", "robots"}  # a recording may be of any robot; without a name all robots are listed
OPTIONS = ("--robot", "--tool", "--flange", "--package-path", "--discard-meshes")

LINK = (
    "<link name='{0}'><inertial><mass value='1'/><inertia ixx='.01' iyy='.01' izz='.01' ixy='0' ixz='0' iyz='0'/>"
    "</inertial></link><joint name='{0}_axis' type='revolute'><parent link='{1}'/><child link='{0}'/>"
    "<origin xyz='0 0 .3'/><axis xyz='{2}'/><limit lower='-2' upper='2' effort='9' velocity='0'/></joint>"
)


@pytest.fixture
def file(tmp_path):
    """A URDF file with two arms."""
    text = "<robot name='r'><link name='base'/>"
    for side in ("left", "right"):
        text += LINK.format(f"{side}1", "base", "0 0 1") + LINK.format(f"{side}2", f"{side}1", "0 1 0")
        text += LINK.format(f"{side}3", f"{side}2", "0 1 0")
    path = tmp_path / "two.urdf"
    path.write_text(text + "</robot>")
    return path


def options_of(command, words=()):
    """Return the robot options of a command as argparse holds them."""
    found: dict[str, argparse.Action] = {}
    parsers = [cli._parser([command])]
    while parsers:
        for action in parsers.pop()._actions:
            if isinstance(action, argparse._SubParsersAction):
                chosen = action.choices.get(words[0] if words and words[0] in action.choices else command)
                parsers += [chosen] if chosen is not None else []
            found.update({name: action for name in action.option_strings if name in OPTIONS})
    return found


@pytest.mark.parametrize(("command", "words"), TAKES_A_ROBOT.items(), ids=TAKES_A_ROBOT)
def test_every_command_that_takes_a_robot_has_the_same_options(command, words):
    found = options_of(command, words)
    parser = argparse.ArgumentParser()
    add_robot_options(parser, default=None if command in OPTIONAL else "sawyer")
    for action in parser._actions:
        for name in set(action.option_strings) & set(OPTIONS):
            mine = found[name]
            assert (mine.default, mine.help, mine.metavar, mine.nargs) == (
                action.default, action.help, action.metavar, action.nargs,
            )  # fmt: skip
    assert set(found) == set(OPTIONS)


def test_no_other_command_takes_a_robot():
    for command in set(cli.COMMANDS) - set(TAKES_A_ROBOT):
        assert "--robot" not in options_of(command)


def parsed(*words, default="sawyer"):
    parser = argparse.ArgumentParser()
    add_robot_options(parser, default=default)
    return parser.parse_args(list(words))


def test_the_options_reach_the_arm(file, tmp_path, capsys):
    arm = load_robot(parsed("--robot", str(file), "--flange", "left3", "--tool", "brush", "--discard-meshes"))
    assert arm.joint_names == ("left1_axis", "left2_axis", "left3_axis") and arm.has_tool
    assert "no velocity limit in the file for any joint" in capsys.readouterr().err
    with pytest.raises(InputError, match="is not a folder"):
        load_robot(parsed("--robot", str(file), "--flange", "left3", "--package-path", str(tmp_path / "nothing")))
    assert load_robot(parsed()).name == "sawyer"


@pytest.mark.parametrize(
    "words", [["--tool", "brush"], ["--flange", "x"], ["--package-path", "."], ["--discard-meshes"]]
)
def test_without_a_robot_the_other_options_are_refused(words):
    assert load_optional_robot(parsed(default=None)) is None
    with pytest.raises(InputError, match=f"{words[0]} needs --robot"):
        load_optional_robot(parsed(*words, default=None))
    with pytest.raises(InputError):
        load_robot(parsed(default=None))


def test_robots_lists_the_candidates_and_shows_the_chosen_one(file, capsys):
    assert main(["robots", str(file)]) == 2
    shown = capsys.readouterr()
    assert "'left3' (3 joints" in shown.err and "'right3' (3 joints" in shown.err and not shown.out
    assert main(["robots", "--robot", str(file), "--flange", "right3"]) == 0
    shown = capsys.readouterr()
    assert "right3_axis" in shown.out and "left3_axis" not in shown.out
    assert "2 rad/s assumed" in shown.err


def test_two_robots_at_once_are_refused(capsys):
    assert main(["robots", "sawyer", "--robot", "panda"]) == 2
    assert "name one robot" in capsys.readouterr().err
    assert main(["robots", "panda", "--robot", "panda"]) == 0
