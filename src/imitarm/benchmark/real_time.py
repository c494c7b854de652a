"""The real-time benchmark: the control loop beside simulation, camera and tracker, each in a process of its own.

.. code-block:: text

    simulation  --- joint positions, time (shared memory) --->  camera
        ^                                                          | detected obstacles (pipe)
        | commands and states (UDP)                                v
        v                                                       tracker
     control   <------------ tracked obstacles (pipe) -------------+
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.real_time_results import RealTimeResult, machine
from imitarm.benchmark.real_time_world import RealTimeSetup
from imitarm.benchmark.running import end_with
from imitarm.errors import ImitarmError, TaskFailedError
from imitarm.transmission.messages import MAX_JOINTS

Array = NDArray[np.float64]

ROLES = {
    "simulation": "imitarm.benchmark.real_time_processes:simulate",
    "camera": "imitarm.benchmark.real_time_processes:watch",
    "tracker": "imitarm.benchmark.real_time_processes:track",
    "control": "imitarm.benchmark.real_time_control:control",
}
"""The function that each process runs, by the name of the process. Only this process imports the function's module."""

_END_TIME = 5.0  # [s] in which a process must end by itself
_OTHERS = 0.5  # [s] after the first failure, in which the process that caused the failure becomes known
_LOST = "lost the connection to another process"

_RUNNING, _MEASURING, _STOPPING = 1.0, 2.0, 3.0
_PHASE, _SCENES, _VERSION, _TIME, _Q = range(5)  # places in the shared memory


class Shared:
    """Memory that all processes share: the state of the simulation, and whether the processes must stop.

    One process writes the state, the others read it. The writer increments a version number before and after it writes.
    A reader that finds an odd version, or another version afterwards, reads again. Nobody waits for a lock.

    Args:
        context: context of :mod:`multiprocessing` in which the processes are started.
    """

    def __init__(self, context: Any) -> None:
        self._values = context.RawArray("d", _Q + MAX_JOINTS)

    def start(self) -> None:
        """Let the camera begin."""
        if not self.stopping:
            self._values[_PHASE] = _RUNNING

    def measure(self) -> None:
        """Let all processes begin to count; what happened before is not measured."""
        if not self.stopping:
            self._values[_PHASE] = _MEASURING

    def stop(self) -> None:
        """Let all processes end."""
        self._values[_PHASE] = _STOPPING

    @property
    def started(self) -> bool:
        """Whether the camera may take images."""
        return bool(self._values[_PHASE] >= _RUNNING)

    @property
    def measuring(self) -> bool:
        """Whether the measurement has begun."""
        return bool(self._values[_PHASE] >= _MEASURING)

    @property
    def stopping(self) -> bool:
        """Whether all processes must end."""
        return bool(self._values[_PHASE] == _STOPPING)

    @property
    def scenes(self) -> int:
        """Number of scenes that the tracker has sent; only the tracker may change it."""
        return int(self._values[_SCENES])

    @scenes.setter
    def scenes(self, number: int) -> None:
        """Set the number of scenes that the tracker has sent."""
        self._values[_SCENES] = number

    @property
    def time(self) -> float:
        """The latest time that the simulation has written [s]."""
        return float(self._values[_TIME])

    def publish(self, time: float, q: Array) -> None:
        """Write the simulated time [s] and the joint positions (n_joints,) [rad]."""
        values = self._values
        values[_VERSION] += 1.0
        values[_TIME] = time
        values[_Q : _Q + len(q)] = q.tolist()
        values[_VERSION] += 1.0

    def state(self, n_joints: int) -> tuple[float, Array]:
        """Return the newest simulated time [s] and the joint positions (n_joints,) [rad] at this time."""
        while True:
            values = self._values[_VERSION : _Q + n_joints]
            if values[0] % 2.0 == 0.0 and values[0] == self._values[_VERSION]:
                return values[1], np.array(values[2:])
            time.sleep(0.0)


class Processes:
    """Processes with names, which all end with the ``with`` block, also after an exception or Ctrl-C.

    Attributes:
        shared: memory that the processes share.
    """

    def __init__(self) -> None:
        # "spawn" works on every system, and the children inherit no threads and no locks
        self._context = multiprocessing.get_context("spawn")
        self.shared = Shared(self._context)
        self._processes: dict[str, Any] = {}
        self._reports: dict[str, Connection] = {}
        self._results: dict[str, dict[str, Any]] = {}
        self._failures: dict[str, str] = {}

    def pipe(self, *, duplex: bool = False) -> tuple[Connection, Connection]:
        """Return two ends of a pipe; if it is not duplex, the first end receives, and the second end sends."""
        return self._context.Pipe(duplex=duplex)

    def start(self, name: str, *arguments: Any) -> None:
        """Start a process.

        Args:
            name: name of the process, a key of :data:`ROLES`.
            arguments: arguments of its function, without the shared memory, which is the second argument. Connections
                among them are closed in this process, so that the other end of a pipe notices when the started process
                ends.
        """
        receive, send = self.pipe()
        process = self._context.Process(
            target=_enter, args=(ROLES[name], arguments, self.shared, send, os.getpid()), name=name, daemon=True
        )
        with _ignoring_interrupts():
            process.start()
        self._processes[name], self._reports[name] = process, receive
        for connection in (send, *arguments):
            if isinstance(connection, Connection):
                connection.close()

    def result(self, name: str) -> dict[str, Any]:
        """Wait until a process has finished, and return the result of its function.

        Raises:
            TaskFailedError: when this process or another process failed; the message names the process that caused the
                failure.
        """
        while name not in self._results:
            self._listen(None)
            if self._failures:
                until = time.monotonic() + _OTHERS
                while (left := until - time.monotonic()) > 0.0 and self._waiting():
                    self._listen(left)
                raise TaskFailedError(self._cause())
        return self._results[name]

    def _waiting(self) -> dict[Connection, str]:
        """Return the processes that have not reported yet."""
        return {r: name for name, r in self._reports.items() if name not in self._results | self._failures}

    def _listen(self, seconds: float | None) -> None:
        """Receive the reports of processes that have finished or failed; wait at most this time for the first [s]."""
        waiting = self._waiting()
        ready = wait(list(waiting), seconds)
        for report, name in waiting.items():
            if report not in ready:
                continue
            try:
                succeeded, value = report.recv()
            except EOFError:  # the process has ended without a report
                succeeded, value = False, self._end_of(name)
            if succeeded:
                self._results[name] = value
            else:
                self._failures[name] = value

    def _end_of(self, name: str) -> str:
        """Return how a process has ended that was killed."""
        process = self._processes[name]
        process.join(_END_TIME)
        code = process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit status {code}"
        return f"ended unexpectedly ({how})"

    def _cause(self) -> str:
        """Return a sentence about the first cause; a process that has only lost a connection is not the cause."""
        for lost in (False, True):
            for name, text in self._failures.items():
                if (text == _LOST) is lost:
                    return f"the {name} process {text}"
        return ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        """Let all processes end; end those that don't within 5 s."""
        self.shared.stop()
        until = time.monotonic() + (_END_TIME if kind is None else 1.0)
        for process in self._processes.values():
            process.join(max(until - time.monotonic(), 0.0))
        for process in self._processes.values():
            if process.is_alive():
                process.terminate()
                process.join(1.0)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        for report in self._reports.values():
            report.close()


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C in a process that is started in the ``with`` block; its parent then lets it end.

    A new process inherits this setting, so it prints no traceback if Ctrl-C comes while it imports its modules.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _enter(role: str, arguments: Sequence[Any], shared: Shared, report: Connection, parent: int) -> None:
    """Run the function of a process, and report its result or its failure."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent lets this one end
    end_with(parent)
    module, _, function = role.partition(":")
    try:
        run: Callable[..., dict[str, Any]] = getattr(importlib.import_module(module), function)
        report.send((True, run(arguments[0], shared, *arguments[1:])))
    except (EOFError, ConnectionError):
        report.send((False, _LOST))
    except ImitarmError as error:
        report.send((False, f"failed: {error}"))
    except Exception as error:  # every failure is reported; the parent raises it
        report.send((False, f"failed: {type(error).__name__}: {error}"))


def run_real_time(setup: RealTimeSetup, *, on_started: Callable[[], object] = lambda: None) -> RealTimeResult:
    """Run the four processes for the duration of the measurement, and return what they measured.

    Args:
        setup: what is measured.
        on_started: called when the processes have been started.

    Raises:
        TaskFailedError: when a process fails or ends too early; no process then continues to run.
    """
    with Processes() as processes:
        simulation, control_of_simulation = processes.pipe(duplex=True)
        tracker_in, camera_out = processes.pipe()
        control_in, tracker_out = processes.pipe()
        processes.start("simulation", setup, simulation)
        processes.start("camera", setup, camera_out)
        processes.start("tracker", setup, tracker_in, tracker_out)
        processes.start("control", setup, control_of_simulation, control_in)
        on_started()
        found = {name: processes.result(name) for name in ROLES}
    return RealTimeResult(setup, code_version(), machine(), **found)
