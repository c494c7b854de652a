"""LineProcess: another program that writes lines of text, read with a timeout, and surely ended."""

from __future__ import annotations

import contextlib
import re
import subprocess
import tempfile
import threading
import time as clock
import weakref
from collections import deque
from pathlib import Path
from typing import IO

LONGEST = 65536  # [bytes] of a line: more is foreign
_GRACE = 1.0  # [s] in which it may end by itself
_READ, _TAIL = 20000, 600  # [characters] of what it said last that are looked at, and given


class LineProcess:
    """A program whose standard output is read line by line.

    It is told to end by the end of its standard input, so it does not outlive this process even if that is killed;
    :meth:`close`, or the last reference to this object, ends it in any case.

    Args:
        command: with all its arguments.
        keep: so many lines wait to be read.
        newest: when more would wait, drop the oldest, though never the first of all; else the program waits too.
        chatter: what lines on its standard error look like that are no reason for anything.

    Raises:
        OSError: when it can't be started.
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
        """Number of the process."""
        return self._process.pid

    def line(self, timeout: float) -> bytes | None:
        """Return the next line without its end, or None when none came within ``timeout`` seconds.

        Raises:
            EOFError: when there will be no more.
        """
        return self._lines.take(timeout)

    def ended(self) -> str:
        """Wait a moment for the end; return how it ended and what it said last on standard error."""
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
        """End it; a second call does nothing."""
        self._finish()


class _Lines:
    """Lines that wait: filled by one thread, taken by another."""

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
    """End a process, first by asking, then by force, and let go of everything that belongs to it."""
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
