"""Many runs of the packing task: saved results, and the table."""

from __future__ import annotations

import pytest

from imitarm.benchmark import packing
from imitarm.benchmark.packing import PackingExperiment, PackingResult, packing_tables, run_packings
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import Workers
from imitarm.cli import main
from imitarm.errors import InputError


def result(seed, success=True, clearance=0.03):
    values = {"duration": 10.0 + seed, "clearance": clearance, "avoiding": 0.4}
    outcome, reason = ("packed", "in the box") if success else ("failed", "the cube fell")
    return PackingResult(PackingExperiment("sensor", seed), code_version(), outcome, reason, values)


@pytest.fixture
def runs(monkeypatch):
    made = []

    def fake(experiment):
        made.append(experiment)
        return result(experiment.seed, success=experiment.seed != 2)

    monkeypatch.setattr(packing, "run_one", fake)
    return made


def test_an_interrupted_benchmark_continues(tmp_path, runs):
    one = Workers(1)
    run_packings(2, workers=one, out=tmp_path)
    file = tmp_path / "sensor.jsonl"
    text = file.read_text()
    file.write_text(text + '{"experiment": {"met')  # killed while it wrote
    found = run_packings(4, workers=one, out=tmp_path)
    assert [experiment.seed for experiment in runs] == [0, 1, 2, 3]
    assert [one.experiment.seed for one in found] == [0, 1, 2, 3] and not found[2].success
    assert found[3].values == result(3).values
    file.write_text(text.replace(code_version(), "commit 0123456789"))
    run_packings(1, workers=one, out=tmp_path)
    assert runs[-1] == PackingExperiment("sensor", 0)  # results of other code do not count


def test_a_run_needs_a_positive_count(tmp_path):
    with pytest.raises(InputError, match="count must be at least 1"):
        run_packings(0, out=tmp_path)


def test_the_table_lists_the_failures(tmp_path, runs, capsys):
    rate, failures = packing_tables([result(seed, success=seed != 2, clearance=0.01 * (seed + 1)) for seed in range(4)])
    assert rate.rows[0][:2] == ("sensor", "3 of 4") and rate.rows[0][3:5] == ("11.5", "10.0")
    assert failures.rows == (("2", "the cube fell"),)
    assert len(packing_tables([result(0)])) == 1
    command = ["benchmark", "packing", "--seeds", "3", "--jobs", "1", "--out", str(tmp_path / "new")]
    assert main(command) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "2 of 3" in out and "the cube fell" in out
