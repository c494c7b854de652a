"""Every example runs from an empty folder, with no display, and says what it says it says."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(FOLDER.glob("*.py"))

# What each must print: its claims, not its figures.
SAYS = {
    "01_learn_a_skill": [
        r"error jump: damaged\.csv, row 150",
        r"<- chosen",
        r"gives exactly the same motion",
        r"ends 0\.\d\d mm",
    ],
    "02_avoid_obstacles": [
        r"mapf +refused",
        r"certified can be executed: 2\d\.\d mm certified",
        r"samples of the path are exactly on the learned path",
        r"no path around box \"low wall\"",
        r"sphere \"jar\" covers the goal",
        r"path ends at \[0\.699 0\.39\d 0\.003\]",
    ],
    "03_reproduce_on_an_arm": [
        r"^done: dirt in the pan",
        r"with a jar on the goal: box \"jar\" covers the goal",
        r"wrote sweep\.html",
    ],
    "04_your_own_arm": [
        r"six_axis: 6 joints",
        r"pose error \d\.\de-(0[7-9]|1\d)",
        r"six_axis can't bring its tool",
        r"a straight line of 20\.0 cm",
    ],
    "05_your_own_policy": [r"  acfra: clearance \d+ mm, .*finished", r"repelled: .*(touched|not finished)"],
    "06_retarget_a_person": [
        r"take 4: 5\.\d s, \d{1,2} mm from the true hand on average, (\d\d|100) % of the velocity limit and",
        r"learned \d+ components from 5 recordings of a person",
        r"nothing in the way: finished",
        r"a ball on the path: finished[,;] .*, \d\d mm from the ball",
    ],
    "07_reach_into_an_open_box": [
        r"10 teachers: the learned path is \d mm from the ideal path",
        r"3 obstacles: in the box, \d\.\d mm from the goal, clearance [23]\d mm",
        r"without avoidance: .*touched",
        r"with a lid: box \"lid\" covers the goal",
    ],
}


def test_every_example_is_here() -> None:
    """They are numbered from 1 without a gap, and what they must say is known."""
    assert [int(script.name[:2]) for script in SCRIPTS] == list(range(1, len(SCRIPTS) + 1))
    assert {script.stem for script in SCRIPTS} == set(SAYS)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_it_can_be_read_at_a_sitting(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    assert 50 <= len(text.splitlines()) <= 130
    assert ast.get_docstring(ast.parse(text))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_it_runs(script: Path, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=180,  # for a hang; a busy machine is not a failure
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr  # no warning left for the reader to wonder about
    for said in SAYS[script.stem]:
        assert re.search(said, done.stdout, re.MULTILINE), f"{said!r} is not in:\n{done.stdout}"
