"""Pace: a fixed rate without drift, which leaves out what it has missed."""

from __future__ import annotations

import time
from collections.abc import Callable


class Pace:
    """Ticks at multiples of a period, counted from its first tick.

    When a tick comes a whole period late or more, the missed ones are counted and left out, and the rhythm stays: a
    burst of steps would move an arm faster than each of them says.

    Args:
        period: [s].
        clock_ns: the time [ns].
        sleep: waits some seconds.

    Attributes:
        ticks: periods that have begun, those that were missed included.
        overruns: periods that were missed.
    """

    def __init__(
        self,
        period: float,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period = round(1e9 * period)
        self._clock_ns, self._sleep = clock_ns, sleep
        self._start: int | None = None
        self.ticks = self.overruns = 0

    @property
    def left(self) -> float:
        """Until the next tick is due [s]; 0 when it is."""
        if self._start is None:
            return 0.0
        return max(1e-9 * (self._start + self.ticks * self._period - self._clock_ns()), 0.0)

    def tick(self) -> int:
        """Begin the next period, now that it is due; return how many were missed."""
        now = self._clock_ns()
        if self._start is None:
            self._start = now
        missed = max((now - self._start) // self._period - self.ticks, 0)
        self.ticks += missed + 1
        self.overruns += missed
        return missed

    def wait(self) -> int:
        """Sleep until the next tick is due, and begin it; return how many were missed."""
        while (left := self.left) > 0.0:
            self._sleep(left)
        return self.tick()
