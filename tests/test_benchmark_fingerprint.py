from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import imitarm
from imitarm.benchmark import fingerprint
from imitarm.benchmark.fingerprint import code_version, deciding_files, essence, tables_version

PACKAGE = Path(imitarm.__file__).parent
RUNS, TABLES = "imitarm.benchmark.experiment", "imitarm.benchmark.mapping"


def names(module):
    return {path.relative_to(PACKAGE).as_posix() for path in deciding_files(module)}


def test_all_that_decides_a_result_is_in_its_fingerprint_and_nothing_that_only_shows_it():
    runs, tables = names(RUNS), names(TABLES)
    for deciding in (
        *("retarget/modern.py", "retarget/thesis.py", "retarget/arm_estimator.py", "retarget/adaptive_control.py"),
        *("kinematics/arm.py", "kinematics/ik.py", "kinematics/self_clearance.py", "capture/camera_model.py"),
        *("capture/person.py", "tasks/operator.py", "tasks/stack_trial.py", "robots/simulated.py"),
        *("robots/models/sawyer.xml", "robots/models/gripper.xml", "benchmark/recordings.py"),
        "benchmark/recording_plan.py",
        *("benchmark/mapping_metrics.py", "benchmark/tracking.py", "benchmark/stacking.py"),
    ):
        assert deciding in runs
    assert {"benchmark/intervals.py", "benchmark/mapping_pairs.py", "benchmark/thesis_table.py"} <= tables - runs
    assert runs < tables
    for folder in ("viewer", "cli", "skills", "policies", "demonstrations"):
        assert not any(name.startswith(f"{folder}/") for name in tables)
    for told in ("robots/udp.py", "capture/mediapipe.py", "benchmark/mapping_report.py", "benchmark/mapping_plots.py"):
        assert told not in tables


@pytest.mark.slow
def test_what_an_experiment_loads_is_in_the_fingerprint():
    """What else is loaded is there because a package's own file lists it beside what is used."""
    script = (
        "import sys\n"
        "from imitarm.benchmark.experiment import Experiment\n"
        "from imitarm.benchmark.mapping_methods import MAIN\n"
        "for name in MAIN:\n"
        "    assert not Experiment('inside', name, seconds=4.0).run().failure\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('imitarm.')), sep='\\n')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600, check=True)
    loaded = {Path(line).relative_to(PACKAGE).as_posix() for line in done.stdout.split("\n") if line}
    listed = {name for name in loaded if name.endswith("__init__.py")}
    wire = {"robots/server.py", "robots/supervisor.py", "robots/udp.py", "datagram.py", "gate.py", "messages.py"}
    wire |= {"pace.py", "sockets.py", "latency.py", "tasks/sweep.py"}
    assert loaded - names(RUNS) - listed <= wire
    assert len(loaded & names(RUNS)) > 50


def test_comments_and_docstrings_change_no_fingerprint_and_code_does():
    source = 'from x import y  # why\n\n\ndef f(a):\n    """Say it.\n\n    At length.\n    """\n    return "# no" + a\n'
    said = (
        source.replace("# why", "# for another reason").replace("At length", "In other words").replace("\n\n\n", "\n")
    )
    assert essence(said) == essence(source)
    assert essence(source.replace("# no", "# yes")) != essence(source)
    assert essence(source.replace("+ a", "- a")) != essence(source)
    assert "At length" not in essence(source)
    assert essence('A = 1\n"""What it is."""\n') == "A = 1"


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A package of three files, whose fingerprints are taken anew each time."""
    for name, text in {"a.py": "from imitarm.b import x\n", "b.py": "x = 1\n", "c.py": "y = 1\n"}.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(fingerprint, "_PACKAGE", tmp_path)
    return tmp_path, lambda: fingerprint._version("imitarm.a")


def test_a_change_of_what_is_imported_is_noticed_and_of_what_is_not_is_not(elsewhere):
    folder, version = elsewhere
    before = version()
    (folder / "c.py").write_text("y = 2\n")
    (folder / "b.py").write_bytes(b"x = 1  # one\r\n")  # as another system ends lines
    assert version() == before
    (folder / "b.py").write_text("x = 2\n")
    assert version() != before
    assert [path.name for path in deciding_files("imitarm.a")] == ["a.py", "b.py"]


def test_the_two_fingerprints_differ():
    assert code_version() != tables_version()
    assert code_version().startswith(f"{imitarm.__version__}+")
