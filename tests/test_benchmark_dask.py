"""The Dask backend with a real scheduler and two workers, on the loopback interface."""

from __future__ import annotations

import contextlib
import math
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from distributed import Client

from imitarm.benchmark.running import DASK, Store, Workers, run_experiments
from imitarm.benchmark.static import RESULTS, StaticExperiment, run_experiment
from imitarm.errors import InputError, TaskFailedError

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]


class Kept(Store):
    """Results in memory."""

    def __init__(self, full_after=math.inf):
        self.saved, self.full_after = {}, full_after

    def known(self, experiments):
        return {e: self.saved[e] for e in experiments if e in self.saved}

    def save(self, experiment, outcome):
        if len(self.saved) >= self.full_after:
            raise OSError(28, "No space left on device")
        self.saved[experiment] = outcome
        return outcome


def started(module, *words):
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{module}", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@contextlib.contextmanager
def cluster(folder):
    """Yield the address of a scheduler with two workers, and the processes."""
    file = folder / "scheduler.json"
    quiet = ("--no-dashboard",)
    processes = [started("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file), *quiet)]
    words = ("--scheduler-file", str(file), "--nthreads", "1", "--host", "127.0.0.1", "--no-nanny", *quiet)
    processes += [started("dask_worker", *words, "--local-directory", str(folder / str(i))) for i in range(2)]
    try:
        for _ in range(1200):
            if file.exists() and file.read_text().endswith("}"):
                break
            time.sleep(0.1)
        with Client(scheduler_file=str(file), set_as_default=False, timeout=120) as client:
            client.wait_for_workers(2, timeout=120)
            address = client.scheduler.address
        yield address, processes
    finally:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()


def test_results_of_two_workers_are_those_of_this_process(tmp_path):
    works = [0.5 * i for i in range(40)]
    with cluster(tmp_path) as (address, processes):
        told = []
        run = partial(pow, 2.0)
        found = run_experiments(
            works, run, Kept(), Workers(backend=DASK, scheduler=address), on_done=lambda *n: told.append(n)
        )
        assert found == run_experiments(works, run, Kept(), Workers(1)) == [2.0**w for w in works]
        assert told[0] == (0, 40) and told[-1] == (40, 40)

        scenes = [StaticExperiment("S1", d, seed, "acfra") for d in (2, 3) for seed in (1000, 1001)]
        stores = [RESULTS.store(tmp_path / name) for name in ("here", "there")]
        here = run_experiments(scenes, run_experiment, stores[0], Workers(1))
        there = run_experiments(scenes, run_experiment, stores[1], Workers(backend=DASK, scheduler=address))
        assert [r.values["clearance"] for r in there] == [r.values["clearance"] for r in here]
        assert [r.values["rmse"] for r in there] == [r.values["rmse"] for r in here]

        store = Kept(full_after=5)
        with pytest.raises(TaskFailedError, match=r"No space left.*free some space, then start the benchmark again"):
            run_experiments(works, run, store, Workers(backend=DASK, scheduler=address))
        assert len(store.saved) == 5

        store = Kept()
        naps = [0.1 + 1e-6 * i for i in range(400)]

        def gone_after(done, _):
            if done == 6:
                processes[0].send_signal(signal.SIGKILL)

        with pytest.raises(
            TaskFailedError, match="connection to the Dask scheduler was lost; start the benchmark again"
        ):
            run_experiments(naps, time.sleep, store, Workers(backend=DASK, scheduler=address), on_done=gone_after)
        assert 6 <= len(store.saved) < 400
        kept, again = dict(store.saved), []
        few = [*list(kept)[:6], naps[-1]]
        run_experiments(few, again.append, store, Workers(1, "threading"))
        assert again == [naps[-1]]


def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(InputError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers there"):
        run_experiments([1.0], math.sqrt, Kept(), Workers(backend=DASK, scheduler="tcp://127.0.0.1:9"))
    with pytest.raises(InputError, match="--scheduler"):
        Workers(backend=DASK)
    with pytest.raises(InputError, match="--backend dask"):
        Workers(scheduler="tcp://127.0.0.1:9")


def test_a_scheduler_without_workers_is_named(tmp_path):
    with cluster(tmp_path) as (address, processes):
        for worker in processes[1:]:
            worker.kill()
            worker.wait()
        with pytest.raises(TaskFailedError, match="no workers"):
            run_experiments([1.0], math.sqrt, Kept(), Workers(backend=DASK, scheduler=address))


def test_a_full_disk_and_a_broken_store_keep_what_is_saved():
    store = Kept(full_after=3)
    with pytest.raises(TaskFailedError, match="free some space"):
        run_experiments([1.0, 2.0, 3.0, 4.0, 5.0], math.sqrt, store, Workers(2))
    assert len(store.saved) == 3
    store.full_after = math.inf
    assert run_experiments([1.0, 2.0, 3.0, 4.0, 5.0], math.sqrt, store, Workers(1)) == [
        math.sqrt(w) for w in (1.0, 2.0, 3.0, 4.0, 5.0)
    ]
