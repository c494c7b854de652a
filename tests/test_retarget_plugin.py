"""A retargeter of another package is one class and one line: it appears in the CLI, in the benchmark and in reports."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from test_registry import install

THEIR_MODULE = """\
import numpy as np
from imitarm.retarget import Retargeter


class Damped(Retargeter):
    name, title, caption = "damped", "Their damped method", "Damped least squares from another package."

    def _advance(self, goal, measured):
        q = self.latest.q
        if goal is None:
            return q
        jacobian = self.arm.tool_jacobian(q)
        error = self.arm.tool_pose(q).error_to(goal.target)
        return q + 0.2 * jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), error)
"""


@pytest.fixture
def their_package(tmp_path: Path) -> Path:
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "their_retargeter.py").write_text(THEIR_MODULE, encoding="utf-8")
    install(folder, "imitarm.retargeters", damped="their_retargeter:Damped")
    return folder


def imitarm(package: Path | None, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a fresh process in which the package is installed."""
    paths = [*([str(package)] if package else []), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "200"}
    program = "import sys; from imitarm.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_it_is_a_method_of_the_command_line_with_a_demonstration_and_a_report(their_package, tmp_path):
    words = ["retarget", "synthetic:1", "--seconds", "2", "--tool", "gripper", "--method", "damped"]
    done = imitarm(their_package, tmp_path, *words, "--out", "demo.csv", "--report", "page.html")
    assert done.returncode == 0, done.stderr
    assert "Their damped method: " in done.stdout
    assert (tmp_path / "demo.csv").exists()
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Their damped method" in page and "Damped least squares from another package." in page


def test_it_is_a_row_of_the_mapping_benchmark_and_of_its_report(their_package, tmp_path):
    small = ["--people", "1", "--first", "0", "--seconds", "4", "--kinds", "inside", "--no-live", "--jobs", "1"]
    words = ["benchmark", "mapping", *small, "--methods", "m3", "damped", "--out", "out", "--report", "page.html"]
    done = imitarm(their_package, tmp_path, *words)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "out" / "mapping.json").read_text(encoding="utf-8"))["results"]
    theirs = next(result for result in results if "damped" in result["name"])
    assert not theirs["failure"] and 0.0 < theirs["values"]["tool_rms"] < 0.2
    assert "Their damped method" in (tmp_path / "out" / "mapping.md").read_text(encoding="utf-8")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Person and robot: Their damped method" in page


def test_without_the_package_the_name_is_refused_with_those_that_exist(tmp_path):
    done = imitarm(None, tmp_path, "retarget", "synthetic:1", "--method", "damped")
    assert done.returncode == 2
    assert "damped" in done.stderr and "modern" in done.stderr
