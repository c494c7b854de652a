"""Where any command writes is looked at before its work; what only one of them does is in the tests of that one."""

from __future__ import annotations

import argparse

import pytest

from imitarm import cli
from imitarm.cli import COMMANDS, main

WRITES = {
    "calibrate": (["limbs", "synthetic:1"], ["--out"]),
    "capture": (["synthetic:1"], ["--out"]),
    "learn": (["shown.csv"], ["--out"]),
    "reproduce": (["skill.json", "--robot", "panda"], ["--out", "--report"]),
    "retarget": (["synthetic:1"], ["--out", "--report"]),
    "serve": (["--robot", "sawyer", "--port", "0"], ["--trace"]),
    "teleoperate": (["synthetic:1"], ["--record", "--latency"]),
}
CASES = [(command, words, option) for command, (words, options) in WRITES.items() for option in options]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to be in, in which no command can begin its work."""
    monkeypatch.chdir(tmp_path)
    began = lambda *_, **__: pytest.fail("it has begun to work")  # noqa: E731 (it stands for several functions)
    monkeypatch.setattr("imitarm.cli.robot_options.ArmModel.load", began)
    for name in ("capture.open_source", "learn.read_and_lint", "reproduce.Skill.load"):
        monkeypatch.setattr(f"imitarm.cli.{name}", began)
    return tmp_path


@pytest.mark.parametrize(("command", "words", "option"), CASES)
@pytest.mark.parametrize(
    ("path", "told"), [("nowhere/there", "there is no folder nowhere; create it first"), (".", "is a folder")]
)
def test_a_place_that_can_not_be_written_to_is_told_before_the_work(place, capsys, command, words, option, path, told):
    assert main([command, *words, option, path]) == 2
    assert f"{option} {path}: {told}" in capsys.readouterr().err
    assert not list(place.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_writes_anywhere_else(command, monkeypatch):
    """Each option whose help says that it writes a file is among the cases above, or has tests of its own."""
    seen: dict[str, argparse.Action] = {}
    real = argparse._ActionsContainer.add_argument

    def noted(self, *names, **options):
        action = real(self, *names, **options)
        seen.update({name: action for name in names if name.startswith("--")})
        return action

    monkeypatch.setattr(argparse._ActionsContainer, "add_argument", noted)
    cli._parser([command])
    reads = {"--calibration", "--scene", "--points", "--config", "--data", "--tool", "--robot", "--package-path"}
    reads |= {"--skill", "--skills", "--saved"}
    files = {name for name, action in seen.items() if action.metavar in ("FILE", "FOLDER", "DIR")} - reads
    own = {
        "benchmark": {"--out", "--report", "--fill", "--json", "--markdown", "--save", "--figure"},
        "demo": {"--out"},
    }
    assert files == set(own.get(command, WRITES.get(command, ((), ()))[1]))
