"""Run many experiments in parallel; each result is saved immediately, so an interrupted benchmark can be continued."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from pathlib import Path
from typing import Any

from imitarm.benchmark.experiment import REPLAYS, Experiment, Result
from imitarm.benchmark.provenance import code_version
from imitarm.errors import FileFormatError, ImitarmError, InputError, TaskFailedError

LOCAL = "loky"
"""Backend of joblib: processes of this machine."""
_RUNS, _RECORDINGS = "runs", "recordings"

OnDone = Callable[[int, int], None]
"""Type of a function that is called with the number of finished experiments and the total number."""


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
    """Run experiments in parallel and return their results in the same order.

    Each result is a separate file in ``folder/runs``, written as soon as the experiment is finished. If a result of the
    same configuration and the same code was saved earlier, this result is read, and the experiment is not run again.
    The measured values do not depend on ``jobs``.

    Args:
        experiments: the experiments to run.
        folder: folder for results and recordings; created if missing.
        jobs: number of processes; None: one for each processor; 1: only this process.
        fresh: whether to ignore saved results and run all experiments again.
        reuse: whether to use saved results of the same configuration even if another version of the code produced them;
            each result names the version.
        backend: a backend of joblib: ``"loky"`` (local processes), or one whose workers see the same folder, such as
            ``"dask"`` or ``"ray"``.
        on_done: function called with the progress.

    Raises:
        InputError: when the folder can't be written to, or the backend does not exist.
        TaskFailedError: when a worker process ended unexpectedly; finished results are kept.
        KeyboardInterrupt: after Ctrl-C; finished results are kept.
    """
    place = _prepared(folder)
    known = {} if fresh else {e: found for e in experiments if (found := _kept(place, e, reuse)) is not None}
    missing = [e for e in experiments if e not in known]
    total, done = len(experiments), len(known)
    report = on_done if on_done is not None else _ignore
    report(done, total)
    if not missing:
        return [known[e] for e in experiments]
    workers, common = max(min(jobs or os.cpu_count() or 1, len(missing)), 1), (str(place), code_version(), os.getpid())
    firsts = {e.plan: e for e in missing if e.task in REPLAYS}  # recordings first, so that methods share the files
    for _ in _parallel(_make, [(e, *common) for e in firsts.values()], backend, workers):
        pass
    for experiment in _parallel(_run, [(e, *common) for e in missing], backend, workers):
        done += 1
        report(done, total)
        known[experiment] = Result.load(Result.path(place / _RUNS, experiment))
    return [known[e] for e in experiments]


def _prepared(folder: str | Path) -> Path:
    place = Path(folder)
    try:
        (place / _RUNS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{place}: results can't be saved there ({error.strerror}); name another folder") from error
    return place


def _kept(place: Path, experiment: Experiment, reuse: bool) -> Result | None:
    """Return the saved result; None if it is missing, unreadable or (without ``reuse``) produced by other code."""
    path = Result.path(place / _RUNS, experiment)
    try:
        found = Result.load(path) if path.exists() else None
    except FileFormatError:
        return None
    return found if found is not None and (reuse or found.code == code_version()) else None


Job = tuple[Experiment, str, str, int]
"""The data of one job: the experiment, the folder, the version of the code, and the parent process."""


def _make(job: Job) -> Experiment:
    """Make the recording of an experiment; an error is ignored here, because the experiment reports it later."""
    experiment, folder, _, parent = job
    _end_with(parent)
    with contextlib.suppress(ImitarmError):
        experiment.recording(Path(folder) / _RECORDINGS)
    return experiment


def _run(job: Job) -> Experiment:
    experiment, folder, version, parent = job
    _end_with(parent)
    if code_version() != version:
        raise TaskFailedError(
            "the code was changed while the benchmark ran; start the benchmark again; valid results are kept"
        )
    experiment.run(Path(folder) / _RECORDINGS).save(Path(folder) / _RUNS)
    return experiment


def _parallel(
    function: Callable[[Job], Experiment], jobs: Sequence[Job], backend: str, workers: int
) -> Iterator[Experiment]:
    """Call a function for each job, in parallel, and yield each result as soon as it is available."""
    import joblib  # noqa: PLC0415  (takes long to import)

    try:
        pool: Any = joblib.Parallel(workers, backend=backend, batch_size=1, return_as="generator_unordered")
        yield from pool(joblib.delayed(function)(job) for job in jobs)
    except BrokenProcessPool as error:
        raise TaskFailedError(
            f"a worker process ended unexpectedly ({error}); start the benchmark again; valid results are kept"
        ) from error
    except (ValueError, ImportError) as error:
        raise InputError(f"backend {backend!r}: {error}") from error


@lru_cache(maxsize=1)
def _end_with(parent: int) -> None:
    """End this worker process when its parent process has ended, because workers survive if the parent is killed."""
    if os.getppid() == parent:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)  # results are written atomically: only what was half done is lost


def _ignore(_done: int, _total: int) -> None:
    """Report to nobody."""
