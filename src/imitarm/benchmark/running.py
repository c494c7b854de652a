"""Run many experiments in parallel. Each result is saved immediately, so an interrupted benchmark can be continued.

Every benchmark runs its experiments with :func:`run_experiments`. The benchmark passes a function that runs one
experiment, and a store that saves results. Only the main process saves results. Therefore the worker processes, which
run the experiments, may be on other machines and need no common folder.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import os
import queue
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar

from imitarm.benchmark.provenance import code_version
from imitarm.errors import InputError, TaskFailedError

LOCAL, DASK = "loky", "dask"
"""Names of two backends. ``LOCAL`` uses processes of this machine (joblib). ``DASK`` uses the workers of a Dask
scheduler."""
_CONNECT = 10.0  # [s] until a scheduler must answer
_SILENCE = 5.0  # [s] between two checks whether the scheduler is still there
_AHEAD = 3  # experiments that each worker of a scheduler has waiting
_RESUME = "start the benchmark again; valid results are kept"

Work = TypeVar("Work", bound=Hashable)
Outcome = TypeVar("Outcome")

OnDone = Callable[[int, int], None]
"""Type of a function that is called with the number of finished experiments and the number of all experiments."""


class Store(ABC, Generic[Work, Outcome]):
    """Interface of a place in which a benchmark saves its results."""

    @abstractmethod
    def known(self, experiments: Sequence[Work]) -> dict[Work, Outcome]:
        """Return the saved results of those experiments that have a valid result."""

    @abstractmethod
    def save(self, experiment: Work, outcome: Outcome) -> Outcome:
        """Save one result.

        If the process is killed meanwhile, :meth:`known` finds either the whole result or no result.

        Returns:
            The result as :meth:`known` would return it.

        Raises:
            OSError: when the result can't be written.
        """


@dataclass(frozen=True)
class Workers:
    """The processes that run experiments.

    Attributes:
        jobs: number of processes; None: one for each processor; 1: only this process. With Dask, this number has no
            effect.
        backend: :data:`LOCAL`, :data:`DASK`, or another backend of joblib.
        scheduler: address of the Dask scheduler, such as ``tcp://10.0.0.1:8786``; only for :data:`DASK`.

    Raises:
        InputError: when the Dask backend has no scheduler, or another backend has a scheduler.
    """

    jobs: int | None = None
    backend: str = LOCAL
    scheduler: str = ""

    def __post_init__(self) -> None:
        if self.backend == DASK and not self.scheduler:
            raise InputError(
                "backend 'dask' needs the address of a scheduler (--scheduler tcp://HOST:8786); start one with 'dask "
                "scheduler', and workers with 'dask worker ADDRESS'"
            )
        if self.scheduler and self.backend != DASK:
            raise InputError(f"--scheduler works only with --backend dask, but the backend is {self.backend!r}")


def run_experiments(
    experiments: Sequence[Work],
    run: Callable[[Work], Outcome],
    store: Store[Work, Outcome],
    workers: Workers | None = None,
    *,
    fresh: bool = False,
    on_done: OnDone | None = None,
) -> list[Outcome]:
    """Run the experiments that have no saved result, and return all results in the order of the experiments.

    The results do not depend on ``workers``.

    Args:
        experiments: the experiments to run.
        run: function that runs one experiment; other processes must be able to import it.
        store: store that saves the results.
        workers: processes that run the experiments; None: one for each processor.
        fresh: whether to ignore saved results and run all experiments again.
        on_done: function that is called with the progress after each experiment.

    Raises:
        InputError: when the backend does not exist.
        TaskFailedError: when a process or the scheduler ended unexpectedly, or a result can't be saved. All earlier
            results stay saved.
        KeyboardInterrupt: after Ctrl-C. The results of finished experiments stay saved.
    """
    known = {} if fresh else store.known(experiments)
    missing = [e for e in dict.fromkeys(experiments) if e not in known]
    total, done = len(experiments), sum(e in known for e in experiments)
    report = on_done if on_done is not None else _ignore
    report(done, total)
    with contextlib.closing(in_parallel(run, missing, workers)) as finished:
        for experiment, outcome in finished:
            try:
                known[experiment] = store.save(experiment, outcome)
            except OSError as error:
                full = error.errno in {errno.ENOSPC, errno.EDQUOT}
                raise TaskFailedError(
                    f"a result can't be saved ({error.strerror or error}); "
                    f"{'free some space, then' if full else 'remove the cause, then'} {_RESUME}"
                ) from error
            done += 1
            report(done, total)
    return [known[e] for e in experiments]


def in_parallel(
    function: Callable[[Work], Outcome], works: Sequence[Work], workers: Workers | None = None
) -> Generator[tuple[Work, Outcome], None, None]:
    """Call a function for each experiment, in parallel.

    Yield each experiment with its result as soon as it is finished.

    Raises:
        InputError: when the backend does not exist.
        TaskFailedError: when a worker process ended unexpectedly.
    """
    if not works:
        return
    using = workers if workers is not None else Workers()
    if using.backend == DASK:
        yield from _by_dask(function, works, using.scheduler)
    else:
        yield from _by_joblib(function, works, using)


def _by_joblib(
    function: Callable[[Work], Outcome], works: Sequence[Work], workers: Workers
) -> Generator[tuple[Work, Outcome], None, None]:
    import joblib  # noqa: PLC0415  (takes long to import)

    n = max(min(workers.jobs or os.cpu_count() or 1, len(works)), 1)
    job = joblib.delayed(_Job(function, code_version(), os.getpid() if workers.backend == LOCAL else 0))
    try:
        pool: Any = joblib.Parallel(n, backend=workers.backend, batch_size=1, return_as="generator_unordered")
        outcomes = pool(job(work) for work in works)
        try:
            for outcome in outcomes:  # noqa: UP028 ("yield from" would close the pool before its warning is off)
                yield outcome
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that jobs are given up, which is intended
                outcomes.close()
    except BrokenProcessPool as error:
        raise TaskFailedError(f"a worker process ended unexpectedly ({error}); {_RESUME}") from error
    except (ValueError, ImportError) as error:
        raise InputError(f"backend {workers.backend!r}: {error}") from error


def _by_dask(
    function: Callable[[Work], Outcome], works: Sequence[Work], address: str
) -> Generator[tuple[Work, Outcome], None, None]:
    """Run the jobs on the workers of a Dask scheduler.

    Joblib also has a backend for Dask. It is not used, because it returns the jobs of a lost scheduler as if they were
    results.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); start one with 'dask scheduler'"
        ) from error
    try:
        if not client.ncores():
            raise TaskFailedError(f"the scheduler at {address} has no workers; start some with 'dask worker {address}'")
        yield from _submitted(client, _Job(function, code_version(), 0), works, distributed)
    except (asyncio.CancelledError, CancelledError, OSError) as error:  # OSError also when the connection ends
        raise TaskFailedError(f"the connection to the Dask scheduler was lost; {_RESUME}") from error
    finally:
        with contextlib.suppress(asyncio.CancelledError, CancelledError, OSError):
            client.close(timeout=2.0)


def _submitted(client: Any, job: _Job[Work, Outcome], works: Sequence[Work], dask: Any) -> Iterator[Any]:
    """Keep a few jobs waiting for each worker, and yield their results.

    Raises:
        TaskFailedError: when the scheduler or all workers are lost.
    """
    finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
    waiting, pending = iter(works), set()

    def submit(n: int) -> None:
        for work in itertools.islice(waiting, n):
            future = client.submit(job, work, pure=False)
            pending.add(future)
            future.add_done_callback(finished.put)

    submit(_AHEAD * max(sum(client.ncores().values()), 1))
    while pending:
        try:
            future = finished.get(timeout=_SILENCE)
        except queue.Empty:
            future = None
        if client.status != "running" or (future is not None and future.status in {"lost", "cancelled"}):
            raise TaskFailedError(f"the connection to the Dask scheduler was lost; {_RESUME}")
        if future is None:
            if not client.ncores():
                raise TaskFailedError(f"the Dask scheduler has no workers any more; {_RESUME}")
            continue
        pending.discard(future)
        try:
            yield future.result()
        except dask.KilledWorker as error:
            raise TaskFailedError(f"a worker of the Dask scheduler ended unexpectedly ({error}); {_RESUME}") from error
        submit(1)


def _distributed() -> Any:
    try:
        import distributed  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise InputError(
            "--backend dask needs the package distributed, which is not installed; install it with: pip install "
            "'imitarm[dask]'"
        ) from error
    return distributed


@dataclass(frozen=True)
class _Job(Generic[Work, Outcome]):
    """Run one experiment in a worker.

    Attributes:
        function: function that runs the experiment.
        version: version of the code that the worker must have.
        parent: process that started the worker, with which the worker ends; 0: the worker is not ours.
    """

    function: Callable[[Work], Outcome]
    version: str
    parent: int

    def __call__(self, work: Work) -> tuple[Work, Outcome]:
        """Return the experiment and its result."""
        if self.parent:
            end_with(self.parent)
        if code_version() != self.version:
            raise TaskFailedError(
                f"a worker runs another version of the code ({code_version()}) than the benchmark ({self.version}); "
                f"use the same code everywhere, and do not change it while the benchmark runs; then {_RESUME}"
            )
        return work, self.function(work)


@lru_cache(maxsize=1)
def end_with(parent: int) -> None:
    """End this process when its parent process has ended; otherwise, worker processes outlive a killed parent.

    Args:
        parent: id of the parent process.
    """
    if os.getpid() == parent:  # jobs run in the main process
        return
    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)  # only the main process saves results: only what was half done is lost


def _ignore(_done: int, _total: int) -> None:
    """Report to nobody."""
