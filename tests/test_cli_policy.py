"""A policy of another package: one file and one line, and it is in the command line, the benchmark and the report."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from imitarm.demonstrations import align, read
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS
from test_registry import install

THEIRS = '''
import numpy as np
from imitarm import Command, Policy, Pose

class Plain(Policy):
    """Follow the learned path by the clock, blind to obstacles."""

    def reset(self, observation):
        self.path = self.skill.generate(observation.tool_to_base)

    def step(self, observation, dt):
        positions, quaternions = self.path.at([observation.time + dt])
        twist = 6.0 * observation.tool_to_base.error_to(Pose(positions[0], quaternions[0]))
        return Command(twist, progress=min(observation.time / self.path.duration, 1.0))

    def finished(self, observation):
        away = np.linalg.norm(self.path.positions[-1] - observation.tool_to_base.position)
        return observation.time > self.path.duration and bool(away < 0.005)
'''


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    folder = tmp_path_factory.mktemp("theirs")
    (folder / "their_policy.py").write_text(THEIRS, encoding="utf-8")
    install(folder, "imitarm.policies", plain="their_policy:Plain")
    Skill(10).fit(align(read(DEMONSTRATIONS))).save(folder / "sweep.json")
    return folder


def imitarm(package, *arguments):
    paths = os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")]).strip(os.pathsep)
    command = [
        sys.executable,
        "-c",
        "import sys; from imitarm.cli import main; sys.exit(main(sys.argv[1:]))",
        *arguments,
    ]
    return subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": paths, "COLUMNS": "200"},
        cwd=package,
        capture_output=True,
        text=True,
        check=False,
    )


def test_it_is_listed_reproduces_and_is_in_the_report(package):
    assert "plain" in imitarm(package, "reproduce", "--help").stdout
    arm = ["--robot", "sawyer", "--tool", "brush"]
    done = imitarm(package, "reproduce", "sweep.json", *arm, "--policy", "plain", "--report", "page.html")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "nan" not in done.stdout  # a policy without an adaptation has no numbers of one
    page = (package / "page.html").read_text(encoding="utf-8")
    assert "plain" in page
    wrong = imitarm(package, "reproduce", "sweep.json", *arm, "--policy", "plain", "--method", "mapf")
    assert wrong.returncode == 2 and "--method is an option of --policy acfra" in wrong.stderr


def test_it_is_in_the_benchmark(package):
    done = imitarm(
        package, "benchmark", "placements", "--policies", "plain", "acfra", "--seeds", "1", "--first", "0", "--list"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line for line in done.stdout.splitlines() if "│" in line]
    assert any("plain" in row for row in rows) and any("acfra" in row for row in rows)


def test_one_that_can_not_be_imported_is_named_when_it_is_chosen(package, tmp_path):
    install(tmp_path, "imitarm.policies", broken="no_such_module:Policy")
    done = imitarm(tmp_path, "reproduce", str(package / "sweep.json"), "--policy", "broken", "--tool", "brush")
    assert done.returncode == 2 and "no_such_module" in done.stderr and "Traceback" not in done.stderr
