"""Operator: the person at the terminal, who decides whether a robot that is stopped may move again."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable

from imitarm.errors import TaskFailedError
from imitarm.robots.udp import TAKEN


class Operator:
    """Says why a robot can't be led and, where it is stopped, waits for Enter without holding anything up.

    Lines that were typed before the question count for nothing. Where input has ended nobody can answer, and
    a stopped robot ends the command.

    Args:
        tell: shows a line.
        enable_first: let the robot move at the start without asking.
        read: waits for what is typed next and returns it; empty: input has ended. None: standard input.
    """

    def __init__(
        self, tell: Callable[[str], None], *, enable_first: bool = False, read: Callable[[], bytes] | None = None
    ) -> None:
        self._tell, self._first = tell, enable_first
        self._read = _standard_input if read is None else read
        self._typed: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._ended = False
        self._asked: tuple[str, bool] = ("", False)
        # a thread, since standard input can't be asked without waiting on every system
        threading.Thread(target=self._reading, daemon=True).start()

    def led(self) -> None:
        """Take note that the robot can be led."""
        self._first, self._asked = False, ("", False)

    def __call__(self, trouble: str, stopped: bool) -> bool:
        """Return whether a robot that is stopped may move again.

        Args:
            trouble: why it can't be led.
            stopped: whether that is because it is stopped.

        Raises:
            TaskFailedError: when it is stopped and nobody can answer.
        """
        self._first = self._first and trouble != TAKEN  # that was at the start, and is not to be taken over later
        if self._first:
            return stopped
        if (trouble, stopped) != self._asked:
            self._asked = (trouble, stopped)
            self._taken()
            question = ". Is the way free? Enter lets it move again" if stopped else ""
            self._tell(f"the robot can't be led: {trouble}{question}")
            return False
        if stopped and self._ended:
            raise TaskFailedError(
                f"the robot is stopped: {trouble}; nobody can let it move again, since there is no terminal. Run this "
                "in one, or begin with --enable"
            )
        return stopped and b"\n" in self._taken()

    def _reading(self) -> None:
        while typed := self._read():
            self._typed.put(typed)
        self._ended = True

    def _taken(self) -> bytes:
        typed = b""
        while not self._typed.empty():
            typed += self._typed.get()
        return typed


def _standard_input() -> bytes:
    """Wait for what is typed; empty when nobody can type here."""
    try:
        if os.isatty(0) and hasattr(os, "tcgetpgrp") and os.tcgetpgrp(0) != os.getpgrp():
            return b""  # in the background, where reading would halt the process
        return os.read(0, 4096)
    except OSError:
        return b""
