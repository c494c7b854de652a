"""RateLimiter: runs a loop at a fixed rate without drift, and skips periods that were missed."""

from __future__ import annotations

import time
from collections.abc import Callable

from imitarm.validation import finite_number


class RateLimiter:
    """Starts control periods on a fixed schedule, at whole multiples of the period after the first start.

    If the loop is late by one period or more, it has missed periods. The limiter skips and counts these periods, and
    the following periods start on schedule. If the missed periods were run later in quick succession, an arm would move
    faster than intended.

    Args:
        period: length of a period [s].
        clock_ns: function that returns the time [ns].
        sleep: function that waits for a time [s].

    Attributes:
        ticks: number of periods since the first start, including missed periods.
        overruns: number of missed periods.
        late: delay of the current period after its scheduled start, less than one period [s].

    Raises:
        InputError: when the period is not at least 1 us.
    """

    def __init__(
        self,
        period: float,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period = round(1e9 * finite_number(period, "RateLimiter: period", "s", at_least=1e-6))
        self._clock_ns, self._sleep = clock_ns, sleep
        self._start: int | None = None
        self.ticks = self.overruns = 0
        self.late = 0.0

    @property
    def remaining(self) -> float:
        """Time until the next period is due [s]; 0 if it is due now."""
        if self._start is None:
            return 0.0
        return max(1e-9 * (self._start + self.ticks * self._period - self._clock_ns()), 0.0)

    def tick(self) -> int:
        """Start the next period, which must be due, and return the number of periods that were missed before it."""
        now = self._clock_ns()
        if self._start is None:
            self._start = now
        missed = max((now - self._start) // self._period - self.ticks, 0)
        self.late = 1e-9 * (now - self._start - (self.ticks + missed) * self._period)
        self.ticks += missed + 1
        self.overruns += missed
        return missed

    def wait(self) -> int:
        """Sleep until the next period is due, start this period, and return the number of missed periods before it."""
        while (remaining := self.remaining) > 0.0:
            self._sleep(remaining)
        return self.tick()
