"""Timing two calls in turns, and the interval of the ratio between their times.

The two sides of a row are timed alternately, A B A B, so that whatever else the machine does slows both. Each pair of
neighbouring measurements gives one ratio. The table prints the median of these ratios and the distribution-free 95 %
confidence interval of that median (from order statistics).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import quantile_test

LEAST_PAIRS = 6  # with fewer, not even the smallest and the largest ratio enclose the median with 95 %
_BLOCK = 2e-3  # [s] a block of calls takes at least this long, so that the clock's resolution does not matter


def _no_check() -> tuple[bool, str]:
    return True, ""


@dataclass(frozen=True)
class Row:
    """A comparison of our time with the time of a reference.

    Attributes:
        name: description of the job.
        ours: function that does the job once with our code.
        reference: function for comparison: the same job in another library, or a standard computation.
        reference_name: name of the reference, with its version.
        faster: target: the reference takes at least this many times as long as ours; 0 when ``cost`` is the target.
        cost: target: ours takes at most this many times as long as the reference; 0 when ``faster`` is the target.
        check: evaluates the results: whether they are good enough, and a remark. Speed at the expense of accuracy
            does not count.
        repeats: number of pairs, at least :data:`LEAST_PAIRS`.
        self_timed: both calls measure themselves and return seconds.

    Raises:
        ValueError: when there is not exactly one target, or there are too few pairs.
    """

    name: str
    ours: Callable[[], Any]
    reference: Callable[[], Any]
    reference_name: str
    faster: float = 0.0
    cost: float = 0.0
    check: Callable[[], tuple[bool, str]] = field(default=_no_check)
    repeats: int = 41
    self_timed: bool = False

    def __post_init__(self) -> None:
        if (self.faster > 0.0) == (self.cost > 0.0):
            raise ValueError(f"Row {self.name!r}: give one target, faster or cost")
        if self.repeats < LEAST_PAIRS:
            raise ValueError(f"Row {self.name!r}: needs at least {LEAST_PAIRS} pairs, got {self.repeats}")


@dataclass(frozen=True)
class Ratio:
    """A ratio of times.

    Attributes:
        median: median of the paired ratios.
        low: lower end of its 95 % confidence interval.
        high: upper end.
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, numerator: Sequence[float], denominator: Sequence[float]) -> Ratio:
        """Return the ratio of two lists of times [s] that were measured in pairs."""
        ratios = np.asarray(numerator) / np.asarray(denominator)
        median = float(np.median(ratios))
        interval = quantile_test(ratios, q=median, p=0.5).confidence_interval(0.95)
        low, high = (x if math.isfinite(x) else end for x, end in zip(interval, (0.0, math.inf), strict=True))
        return cls(median, float(low), float(high))

    def __str__(self) -> str:
        return f"{number(self.median)} ({number(self.low)} to {number(self.high)})"


@dataclass(frozen=True)
class Measurement:
    """The result of a row.

    Attributes:
        name: name of the row.
        ours: median time of our code [s]; nan when it could not be measured.
        reference: median time of the reference [s]; nan when it could not be measured.
        reference_name: name of the reference.
        ratio: ratio in the direction of the target; None when it could not be measured.
        target: in words.
        passed: whether the whole interval of the ratio meets the target, and the results are good; None when it could
            not be measured.
        note: the remark of the check, or how to install what is missing.
    """

    name: str
    ours: float
    reference: float
    reference_name: str
    ratio: Ratio | None
    target: str
    passed: bool | None
    note: str


def measure(row: Row) -> Measurement:
    """Time a row, both sides in turns."""
    sides = row.ours, row.reference
    blocks = [1, 1] if row.self_timed else [block_size(call) for call in sides]
    times: list[list[float]] = [[], []]
    for _ in range(row.repeats):
        for call, block, seconds in zip(sides, blocks, times, strict=True):
            seconds.append(float(call()) if row.self_timed else seconds_of(call, block))
    good, note = row.check()
    ours, reference = times
    if row.faster:
        ratio, target = Ratio.of(reference, ours), f"at least {row.faster:g} times as fast"
        met = ratio.low >= row.faster
    else:
        ratio, target = Ratio.of(ours, reference), f"at most {row.cost:g} times as long"
        met = ratio.high <= row.cost
    medians = float(np.median(ours)), float(np.median(reference))
    return Measurement(row.name, *medians, row.reference_name, ratio, target, met and good, note)


def seconds_of(call: Callable[[], Any], block: int) -> float:
    """Return how long one of ``block`` calls takes on average [s]."""
    begin = time.perf_counter()
    for _ in range(block):
        call()
    return (time.perf_counter() - begin) / block


def block_size(call: Callable[[], Any]) -> int:
    """Return how many calls take at least 2 ms, after one to warm up."""
    call()
    block = 1
    while seconds_of(call, block) * block < _BLOCK:
        block *= 2
    return block


def duration(seconds: float) -> str:
    """Return ``seconds`` in the unit that fits: s, ms or us."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"


def number(value: float) -> str:
    """Return a ratio with two significant digits, never as a power of ten."""
    if not math.isfinite(value):
        return str(value)
    digits = 1 - math.floor(math.log10(abs(value))) if value else 1
    return f"{value:.{min(max(digits, 0), 6)}f}"
