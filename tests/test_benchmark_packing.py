"""Many runs of the packing task: saved results, and the table."""

from __future__ import annotations

import pytest

from imitarm.benchmark import packing
from imitarm.benchmark.packing import PackingResult, PackingStore, packing_tables, run_packings
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import Workers
from imitarm.cli import main
from imitarm.errors import FileFormatError, InputError


def result(seed, success=True, **changes):
    values = {"observer": "sensor", "duration": 10.0 + seed, "clearance": 0.03, "avoiding": 0.4, "code": code_version()}
    return PackingResult(seed=seed, success=success, reason="" if success else "the cube fell", **(values | changes))


@pytest.fixture
def runs(monkeypatch):
    made = []

    def fake(experiment):
        made.append(experiment)
        return result(experiment[1], success=experiment[1] != 2)

    monkeypatch.setattr(packing, "run_one", fake)
    return made


def test_an_interrupted_benchmark_continues(tmp_path, runs):
    out, one = tmp_path / "packing.jsonl", Workers(1)
    run_packings(2, workers=one, out=out)
    text = out.read_text()
    out.write_text(text + '{"seed": 9, "observ')  # killed while it wrote
    found = run_packings(4, workers=one, out=out)
    assert [experiment[1] for experiment in runs] == [0, 1, 2, 3]
    assert [one.seed for one in found] == [0, 1, 2, 3] and not found[2].success
    assert len(out.read_text().splitlines()) == 4
    other = text.replace(code_version(), "commit 0123456789")
    out.write_text(other)
    run_packings(1, workers=one, out=out)
    assert runs[-1] == ("sensor", 0)  # results of other code do not count


def test_a_damaged_file_is_refused(tmp_path, runs):
    out = tmp_path / "packing.jsonl"
    for text in ("nonsense\n", '{"seed": 1}\n'):
        out.write_text(text)
        with pytest.raises(FileFormatError, match="line 1"):
            PackingStore(out).known([("sensor", 1)])
    with pytest.raises(InputError, match="count must be at least 1"):
        run_packings(0)


def test_the_table_lists_the_failures(tmp_path, runs, capsys):
    rate, failures = packing_tables([result(seed, success=seed != 2, clearance=0.01 * (seed + 1)) for seed in range(4)])
    assert rate.rows[0][:2] == ("sensor", "3 of 4") and rate.rows[0][3:5] == ("11.5", "10.0")
    assert failures.rows == (("2", "the cube fell"),)
    assert len(packing_tables([result(0)])) == 1
    command = ["benchmark", "packing", "--seeds", "3", "--jobs", "1", "--out", str(tmp_path / "new.jsonl")]
    assert main(command) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "2 of 3" in out and "the cube fell" in out
