"""Many experiments on local processes or a cluster; what is done is kept, so an interrupted benchmark goes on."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from imitarm.benchmark.experiment import REPLAYS, Experiment, Result
from imitarm.benchmark.provenance import code_version
from imitarm.errors import FileFormatError, ImitarmError, InputError, TaskFailedError

LOCAL = "local"
"""Backend: processes of this machine."""
_RUNS, _RECORDINGS = "runs", "recordings"

OnDone = Callable[[int, int], None]
"""Is told how many experiments are done, and of how many."""


def run_all(
    experiments: Sequence[Experiment],
    folder: str | Path,
    *,
    jobs: int | None = None,
    fresh: bool = False,
    reuse: bool = False,
    backend: str = LOCAL,
    on_done: OnDone | None = None,
) -> list[Result]:
    """Run experiments side by side and return their results, in their order.

    Each result is a file of its own in ``folder/runs``, written as soon as the experiment is done. A saved result of
    the same configuration and the same code is read instead of run again.

    Args:
        experiments: what to run.
        folder: where results and recordings are kept; made when it is not there.
        jobs: processes; None: one for each processor.
        fresh: run again what has been run.
        reuse: read saved results of the same configuration whatever code made them; each says which.
        backend: ``"local"``, or the name of a joblib backend, such as ``"loky"``, ``"dask"`` or ``"ray"``, whose
            workers see the same folder.
        on_done: is told of the progress.

    Raises:
        InputError: when the folder can't be written to, or the backend is not there.
        TaskFailedError: when a worker was lost; what it and others had finished is kept.
        KeyboardInterrupt: after Ctrl-C; what was finished is kept.
    """
    place = _prepared(folder)
    known = {} if fresh else {e: found for e in experiments if (found := _kept(place, e, reuse)) is not None}
    missing = [e for e in experiments if e not in known]
    total, done = len(experiments), len(known)
    tell = on_done if on_done is not None else _silent
    tell(done, total)
    if not missing:
        return [known[e] for e in experiments]
    firsts = {e.plan: e for e in missing if e.task in REPLAYS}  # recordings first: every method then finds them made
    version, workers = code_version(), max(min(jobs or os.cpu_count() or 1, len(missing)), 1)
    with _backend(backend, workers) as mapped:
        for _ in mapped(_make, [(e, str(place), version) for e in firsts.values()]):
            pass
        for experiment in mapped(_run, [(e, str(place), version) for e in missing]):
            done += 1
            tell(done, total)
            known[experiment] = Result.load(Result.path(place / _RUNS, experiment))
    return [known[e] for e in experiments]


def _prepared(folder: str | Path) -> Path:
    place = Path(folder)
    try:
        (place / _RUNS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{place}: results can't be kept there ({error.strerror}); name another folder") from error
    return place


def _kept(place: Path, experiment: Experiment, reuse: bool) -> Result | None:
    """Return the saved result; None when there is none, it can't be read, or other code made it and that counts."""
    path = Result.path(place / _RUNS, experiment)
    try:
        found = Result.load(path) if path.exists() else None
    except FileFormatError:
        return None
    return found if found is not None and (reuse or found.code == code_version()) else None


Job = tuple[Experiment, str, str]


def _make(job: Job) -> Experiment:
    """Make the recording of an experiment; one that can't be made is the experiment's own failure, later."""
    experiment, folder, _ = job
    with contextlib.suppress(ImitarmError):
        experiment.recording(Path(folder) / _RECORDINGS)
    return experiment


def _run(job: Job) -> Experiment:
    experiment, folder, version = job
    if code_version() != version:
        raise TaskFailedError("the code was changed while the benchmark ran; start it again, what is valid is kept")
    experiment.run(Path(folder) / _RECORDINGS).save(Path(folder) / _RUNS)
    return experiment


Mapped = Callable[[Callable[[Job], Experiment], Sequence[Job]], Iterator[Experiment]]
"""Does a function for each job, side by side, and gives what comes of it as it comes."""


@contextlib.contextmanager
def _backend(name: str, workers: int) -> Iterator[Mapped]:
    """Give what does jobs side by side, while the ``with`` block runs."""
    if name != LOCAL:
        yield _joblib(name, workers)
        return
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin_worker)

    def mapped(function: Callable[[Job], Experiment], jobs: Sequence[Job]) -> Iterator[Experiment]:
        try:
            for future in as_completed([pool.submit(function, job) for job in jobs]):
                yield future.result()
        except BrokenProcessPool as error:
            raise TaskFailedError(f"a worker was lost ({error}); start again, what was finished is kept") from error

    try:
        yield mapped
    finally:  # also after Ctrl-C: what runs is finished, what waits is dropped
        pool.shutdown(wait=True, cancel_futures=True)


def _joblib(name: str, workers: int) -> Mapped:
    try:
        joblib: Any = importlib.import_module("joblib")  # optional
    except ImportError as error:
        raise InputError(f"backend {name!r} needs joblib, which is not installed: pip install joblib") from error

    def mapped(function: Callable[[Job], Experiment], jobs: Sequence[Job]) -> Iterator[Experiment]:
        try:
            with joblib.parallel_config(backend=name, n_jobs=workers):
                parallel = joblib.Parallel(return_as="generator_unordered")
                yield from parallel(joblib.delayed(function)(job) for job in jobs)
        except (ValueError, ImportError) as error:
            raise InputError(f"backend {name!r}: {error}") from error

    return mapped


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end with it: a pool's workers outlive a parent that was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # results are written aside and renamed: nothing is lost but what was half done


def _silent(_done: int, _total: int) -> None:
    """Tell nobody."""
