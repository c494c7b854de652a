"""Many runs of one task: saved results, and the table."""

from __future__ import annotations

import pytest

from imitarm.benchmark import repeated_tasks
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.repeated_tasks import REPEATED_TASKS, TaskExperiment, TaskResult, run_repeatedly, success_tables
from imitarm.benchmark.running import Workers
from imitarm.cli import main
from imitarm.errors import InputError


def result(seed, success=True, clearance=0.03, task="packing"):
    values = {"duration": 10.0 + seed, "clearance": clearance, "avoiding": 0.4}
    outcome, reason = ("success", "in the box") if success else ("failed", "the cube fell")
    return TaskResult(TaskExperiment(task, "sensor", seed), code_version(), outcome, reason, values)


@pytest.fixture
def runs(monkeypatch):
    made = []

    def fake(experiment):
        made.append(experiment)
        return result(experiment.seed, success=experiment.seed != 2, task=experiment.task)

    monkeypatch.setattr(repeated_tasks, "run_one", fake)
    return made


def test_an_interrupted_benchmark_continues(tmp_path, runs):
    one = Workers(1)
    run_repeatedly("packing", 2, workers=one, out=tmp_path)
    file = tmp_path / "sensor.jsonl"
    text = file.read_text()
    file.write_text(text + '{"experiment": {"met')  # killed while it wrote
    found = run_repeatedly("packing", 4, workers=one, out=tmp_path)
    assert [experiment.seed for experiment in runs] == [0, 1, 2, 3]
    assert [one.experiment.seed for one in found] == [0, 1, 2, 3] and not found[2].success
    assert found[3].values == result(3).values
    file.write_text(text.replace(code_version(), "commit 0123456789"))
    run_repeatedly("packing", 1, workers=one, out=tmp_path)
    assert runs[-1] == TaskExperiment("packing", "sensor", 0)  # results of other code do not count


def test_a_run_needs_a_positive_count(tmp_path):
    with pytest.raises(InputError, match="count must be at least 1"):
        run_repeatedly("packing", 0, out=tmp_path)


@pytest.mark.parametrize("task", REPEATED_TASKS)
def test_the_table_lists_the_failures(tmp_path, runs, capsys, task):
    rate, failures = success_tables(
        [result(seed, success=seed != 2, clearance=0.01 * (seed + 1), task=task) for seed in range(4)]
    )
    assert rate.rows[0][:2] == ("sensor", "3 of 4") and rate.rows[0][3:5] == ("11.5", "10.0")
    assert failures.rows == (("2", "the cube fell"),)
    assert len(success_tables([result(0)])) == 1
    command = ["benchmark", task, "--seeds", "3", "--jobs", "1", "--out", str(tmp_path / "new")]
    assert main(command) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert REPEATED_TASKS[task].title in out and "2 of 3" in out and "the cube fell" in out
