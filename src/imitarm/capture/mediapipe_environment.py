"""MediaPipe's own Python environment.

This module finds the environment, creates it, and runs MediaPipe in it as a process that writes lines of text.

MediaPipe 0.10.21, the last version that includes its models, needs numpy below 2, but imitarm needs numpy 2. MediaPipe
is therefore installed in an environment of its own, without imitarm::

    python -m imitarm.capture.mediapipe_environment # creates this environment
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time as clock
import weakref
from collections import deque
from pathlib import Path
from typing import IO

from imitarm.errors import ImitarmError, InputError, TaskFailedError

VARIABLE = "IMITARM_MEDIAPIPE_PYTHON"
"""Environment variable: path of a Python interpreter that has MediaPipe; if set, :func:`folders` is not searched."""

VERSION = "0.10.21"
VERSIONS = ((3, 9), (3, 12))  # versions of Python for which it exists
REQUIREMENTS = (
    "numpy<2",
    "opencv-python-headless>=4.9,<4.12",  # headless: no libGL; the next one needs numpy 2
    "protobuf>=4.25.3,<5",
    "absl-py",
    "attrs>=19.1",
    "flatbuffers>=2.0",
    "matplotlib",
)
"""Packages that pose tracking needs.

Only these packages are installed together with MediaPipe. MediaPipe also declares jax, sentencepiece and sounddevice as
requirements, but pose tracking does not need them.
"""

_STAMP = "imitarm-mediapipe.txt"  # written last: without it the environment is incomplete
_COMMAND = "-m imitarm.capture.mediapipe_environment"
_TRIAL = "import cv2, mediapipe; mediapipe.solutions.pose.Pose(model_complexity=1).close()"


def find_python() -> Path:
    """Return the path of a Python interpreter that can import MediaPipe.

    If the environment variable ``IMITARM_MEDIAPIPE_PYTHON`` is set, its value is returned. Otherwise, the folders of
    :func:`folders` are searched.

    Raises:
        InputError: when there is no interpreter that can import MediaPipe; the message says how to create the
            environment.
    """
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).is_file():
            raise InputError(
                f"{VARIABLE}: {named} is not a file; set it to the path of a Python that has mediapipe {VERSION}"
            )
        return Path(named)
    for folder in folders():
        if (folder / _STAMP).is_file():
            return python_of(folder)
    raise InputError(
        f"the sources video and webcam need MediaPipe in an environment of its own; create it once by "
        f"'{sys.executable} {_COMMAND}' (130 MB to download, 410 MB on disk), or set {VARIABLE} to a Python that has "
        f"mediapipe {VERSION}"
    )


def folders() -> list[Path]:
    """Return the folders in which the environment may be, in the order in which they are searched.

    If imitarm runs from a checkout of its repository, the first folder is in this checkout. The last folder is in the
    user's data folder. By default, a new environment is created in the first folder of the list.
    """
    checkout = Path(__file__).resolve().parents[3]
    beside = [checkout / ".venv-mediapipe"] if (checkout / "pyproject.toml").is_file() else []
    if sys.platform == "win32":
        data = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        data = Path.home() / "Library" / "Application Support"
    else:
        data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return [*beside, data / "imitarm" / "mediapipe"]


def python_of(folder: Path) -> Path:
    """Return the path of the Python interpreter of a virtual environment."""
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def make(folder: Path) -> Path:
    """Create the environment, replacing an existing one, and return the path of its Python interpreter.

    Args:
        folder: folder of the environment; it must be new, empty, or an existing environment.

    Raises:
        InputError: when the folder holds anything other than an environment, or this machine has no suitable Python.
        TaskFailedError: when a step fails; the message ends with the output of that step.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / "pyvenv.cfg").is_file():
        raise InputError(f"{folder}: this folder exists and is not a Python environment; choose a new folder")
    python = python_of(folder)
    (folder / _STAMP).unlink(missing_ok=True)
    _run("create an environment", [suitable_python(), "-m", "venv", "--clear", str(folder)])
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    _run("fetch mediapipe", [*install, "--no-deps", f"mediapipe=={VERSION}"])
    _run("fetch the packages that mediapipe needs", [*install, *REQUIREMENTS])
    _run("start mediapipe", [str(python), "-I", "-c", _TRIAL])
    (folder / _STAMP).write_text(f"mediapipe {VERSION}, made by imitarm\n", encoding="utf-8")
    return python


def suitable_python() -> str:
    """Return the command of a Python interpreter whose version MediaPipe supports.

    If the version of the running interpreter is not supported, the search path (``PATH``) is searched for another
    interpreter.

    Raises:
        InputError: when this machine has no Python version that MediaPipe supports.
    """
    (major, oldest), (_, newest) = VERSIONS
    if VERSIONS[0] <= sys.version_info[:2] <= VERSIONS[1]:
        return sys.executable
    for minor in range(newest, oldest - 1, -1):
        found = shutil.which(f"python{major}.{minor}")
        if found:
            return found
    raise InputError(
        f"mediapipe {VERSION} supports Python {major}.{oldest} to {major}.{newest}; this is Python "
        f"{sys.version_info[0]}.{sys.version_info[1]} and no supported version is on the path; install one, or set "
        f"{VARIABLE} to a Python that has mediapipe"
    )


def _run(what: str, command: list[str]) -> None:
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        said = " ".join(done.stdout.split())[-600:]
        raise TaskFailedError(f"mediapipe: could not {what} (exit status {done.returncode}): {said}")


def main(arguments: list[str]) -> int:
    """Create the environment in the given folder (default: the first of :func:`folders`); return the exit status."""
    folder = Path(arguments[0]) if arguments else folders()[0]
    try:
        sys.stdout.write(f"made {make(folder)}\n")
    except ImitarmError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


# --- the process

LONGEST = 65536  # [bytes] of a line
_GRACE = 1.0  # [s] within which the program may end by itself
_READ, _TAIL = 20000, 600  # [characters] of its last output that are read, and returned


class LineProcess:
    """Another program whose standard output is read line by line, with a timeout.

    The program must exit when its standard input is closed. The program then also exits when the Python process that
    started it is killed. Calling :meth:`close` or deleting this object ends every program.

    Args:
        command: command with all its arguments.
        keep: largest number of unread lines to store.
        newest: what happens when the number of stored unread lines reaches ``keep``. True: the oldest unread line is
            dropped, but never the program's first line. False: the program waits until a line is read.
        chatter: regular expression for lines on standard error that :meth:`ended` leaves out.

    Raises:
        OSError: when the program can't be started.
    """

    def __init__(
        self, command: list[str | Path], *, keep: int = 64, newest: bool = False, chatter: str | None = None
    ) -> None:
        self._chatter = None if chatter is None else re.compile(chatter)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (is closed at the end)
        try:
            self._process = subprocess.Popen(
                [str(part) for part in command],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
            )
        except BaseException:
            self._errors.close()
            raise
        self._lines = _Lines(keep, newest)
        thread = threading.Thread(target=self._lines.fill, args=(self._process.stdout,), daemon=True)
        thread.start()
        self._finish = weakref.finalize(self, _finish, self._process, self._lines, thread, self._errors)

    @property
    def pid(self) -> int:
        """Identifier that the operating system gave to the process."""
        return self._process.pid

    def line(self, timeout: float) -> bytes | None:
        """Return the next line without its line break, or None when no line arrived within ``timeout`` seconds.

        Raises:
            EOFError: when the program's output has ended and all its lines have been returned.
        """
        return self._lines.take(timeout)

    def ended(self) -> str:
        """Wait up to a second for the program to end; return the exit status and the last output on standard error."""
        try:
            status = f"exit status {self._process.wait(_GRACE)}"
        except subprocess.TimeoutExpired:
            status = "still running"
        self._errors.seek(0, 2)
        self._errors.seek(max(self._errors.tell() - _READ, 0))
        lines = self._errors.read().decode("utf-8", "replace").splitlines()
        kept = [line for line in lines if self._chatter is None or not self._chatter.match(line)]
        said = " ".join(" ".join(kept).split())[-_TAIL:]
        return f"{status}{': ' + said if said else ''}"

    def close(self) -> None:
        """End the program; a second call does nothing."""
        self._finish()


class _Lines:
    """A queue of lines that one thread fills and another thread empties."""

    def __init__(self, keep: int, newest: bool) -> None:
        self._waiting: deque[bytes] = deque()
        self._keep, self._newest = keep, newest
        self._changed = threading.Condition()
        self._over = self._stopped = self._begun = False

    def fill(self, pipe: IO[bytes]) -> None:
        try:
            while line := pipe.readline(LONGEST):
                with self._changed:
                    if self._newest and self._begun and len(self._waiting) >= self._keep:
                        self._waiting.popleft()
                    self._changed.wait_for(lambda: self._stopped or len(self._waiting) < self._keep)
                    if self._stopped:
                        return
                    self._waiting.append(line.rstrip(b"\r\n"))
                    self._changed.notify_all()
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()

    def take(self, timeout: float) -> bytes | None:
        until = clock.monotonic() + timeout
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._over, max(until - clock.monotonic(), 0.0))
            if self._waiting:
                line, self._begun = self._waiting.popleft(), True
                self._changed.notify_all()
                return line
            if self._over:
                raise EOFError
            return None

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()


def _finish(process: subprocess.Popen[bytes], lines: _Lines, thread: threading.Thread, errors: IO[bytes]) -> None:
    """Ask a process to end, kill it if it does not, and release its resources."""
    lines.stop()
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
    try:
        process.wait(0.2 * _GRACE)
    except subprocess.TimeoutExpired:
        process.terminate()
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    thread.join()
    assert process.stdout is not None
    process.stdout.close()
    errors.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
