from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from imitarm.benchmark.experiment import LIVE, METHODS, Experiment, Result
from imitarm.benchmark.mapping import run_all
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import Workers
from imitarm.errors import FileFormatError, InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS

SHORT = 4.0
ONE = Experiment("inside", "m3", seconds=SHORT)
ALONE = Workers(1)


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in (Path(folder) / "runs").iterdir()}


def without_clock(result):
    return {**asdict(result), "seconds": 0.0}


def test_a_run_is_the_same_every_time_and_whoever_made_the_recording(tmp_path):
    alone, first, second = ONE.run(), ONE.run(tmp_path), ONE.run(tmp_path)
    assert alone.failure == ""
    assert without_clock(alone) == without_clock(first) == without_clock(second)
    assert alone.value("engaged_fraction") > 0.5


def test_a_result_is_read_as_it_was_written(tmp_path):
    done = ONE.run()
    never = Result(done.experiment, done.code, {**done.values, "settling_time": float("nan")}, "", 1.0)
    for result in (done, never):
        read = Result.load(result.save(tmp_path))
        assert json.dumps(read.values) == json.dumps(
            {k: list(v) if isinstance(v, tuple) else v for k, v in result.values.items()}
        )
        assert read.experiment == ONE
    assert [p.suffix for p in tmp_path.iterdir()] == [".json"]


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"format": "imitarm-result", "version": 99}', "\x00"])
def test_a_foreign_file_is_no_result(tmp_path, content):
    path = tmp_path / "r.json"
    path.write_text(content)
    with pytest.raises(FileFormatError, match="delete the file and run"):
        Result.load(path)


def test_what_was_run_is_not_run_again(tmp_path):
    wanted = [ONE, replace(ONE, method="modern")]
    told = []
    first = run_all(wanted, tmp_path, ALONE, on_done=lambda done, of: told.append((done, of)))
    assert told == [(0, 2), (1, 2), (2, 2)]
    before = stamps(tmp_path)
    assert len(list((tmp_path / "recordings").iterdir())) == 1  # one for both
    told.clear()
    again = run_all(wanted, tmp_path, ALONE, on_done=lambda done, of: told.append((done, of)))
    assert told == [(2, 2)]
    assert stamps(tmp_path) == before
    assert [without_clock(r) for r in first] == [without_clock(r) for r in again]
    run_all(wanted[:1], tmp_path, ALONE, fresh=True)
    assert stamps(tmp_path) != before


def test_another_configuration_has_another_file(tmp_path):
    places = {Result.path(tmp_path, e) for e in (ONE, replace(ONE, seconds=5.0), replace(ONE, sigma=0.01))}
    assert len(places) == 3


def test_a_result_of_other_code_is_read_only_when_that_is_asked_for(tmp_path):
    saved = Result(ONE, "commit of long ago", {"engaged_fraction": 2.0}, "", 1.0)
    saved.save(tmp_path / "runs")
    (reused,) = run_all([ONE], tmp_path, ALONE, reuse=True)
    assert (reused.code, reused.value("engaged_fraction")) == ("commit of long ago", 2.0)
    (done,) = run_all([ONE], tmp_path, ALONE)
    assert done.code == code_version() and done.value("engaged_fraction") <= 1.0
    before = stamps(tmp_path)
    run_all([ONE], tmp_path, ALONE)
    assert stamps(tmp_path) == before


def test_a_damaged_result_is_run_again(tmp_path):
    run_all([ONE], tmp_path, ALONE)
    path = Result.path(tmp_path / "runs", ONE)
    whole = json.loads(path.read_text())
    path.write_text(path.read_text()[:200])
    (done,) = run_all([ONE], tmp_path, ALONE)
    assert json.loads(path.read_text())["values"] == whole["values"]
    assert done.failure == ""


def test_a_task_that_cant_be_done_is_a_result_that_says_why(tmp_path):
    (done,) = run_all([Experiment("captured", "m3", data=str(tmp_path))], tmp_path, ALONE)
    assert "--data" in done.failure
    assert not done.values


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_benchmark_goes_on_where_it_was(tmp_path, how):
    script = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # what runs in the background may ignore it
        "from imitarm.benchmark.experiment import Experiment\n"
        "from imitarm.benchmark.mapping import run_all\n"
        "from imitarm.benchmark.running import Workers\n"
        "if __name__ == '__main__':\n"
        "    run_all([Experiment('inside', 'm3', seed=s, seconds=4.0) for s in range(8)], sys.argv[1], Workers(2))\n"
    )
    program = tmp_path / "program.py"
    program.write_text(script)
    out = tmp_path / "out"
    child = subprocess.Popen([sys.executable, program, out], stderr=subprocess.PIPE, start_new_session=True)
    for _ in range(2400):
        if (out / "runs").is_dir() and len(list((out / "runs").glob("*.json"))) >= 1:
            break
        time.sleep(0.05)
    child.send_signal(how)
    child.communicate(timeout=60)  # until its workers, which have its standard error too, are gone
    assert child.returncode != 0
    kept = sorted((out / "runs").glob("*.json"))
    assert 1 <= len(kept) < 8
    before = stamps(out)
    found = {Result.load(path).experiment.seed for path in kept}
    other = next(s for s in range(8) if s not in found)
    wanted = [Experiment("inside", "m3", seed=s, seconds=4.0) for s in (*found, other)]
    results = run_all(wanted, out, ALONE)
    assert all(r.failure == "" for r in results)
    after = stamps(out)
    assert all(after[path.name] == before[path.name] for path in kept)


def test_results_do_not_depend_on_the_number_of_jobs_or_the_backend(tmp_path):
    wanted = [ONE, replace(ONE, seed=1)]
    alone = run_all(wanted, tmp_path / "a", ALONE)
    for folder, jobs, backend in (("b", 2, "loky"), ("c", 2, "threading")):
        found = run_all(wanted, tmp_path / folder, Workers(jobs, backend))
        assert [without_clock(r) for r in alone] == [without_clock(r) for r in found]
    with pytest.raises(InputError, match="nowhere"):
        run_all(wanted, tmp_path / "d", Workers(backend="nowhere"))


def test_a_folder_that_cant_be_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="another folder"):
        run_all([ONE], tmp_path / "file" / "x")


@pytest.mark.parametrize(
    "bad", [{"task": "dance"}, {"method": "magic"}, {"robot": "r2d2"}, {"task": LIVE, "robot": "panda"}, {"seed": -1}]
)
def test_what_is_no_experiment_is_refused(bad):
    with pytest.raises((InputError, UnknownNameError)):
        Experiment(**{"task": "inside", "method": "modern", **bad})


def test_every_method_is_a_row_and_every_row_can_be_built():
    assert set(RETARGETERS) <= set(METHODS)
    for row in METHODS.values():
        assert row(ArmModel.load("sawyer", tool="gripper"), None).name == row.retargeter
