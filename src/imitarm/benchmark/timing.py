"""Timing two calls in turns, so that whatever else the machine does hits both."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np


def _no_check() -> tuple[bool, str]:
    return True, ""


@dataclass(frozen=True)
class Row:
    """One comparison, or one absolute limit.

    Attributes:
        name: what is done.
        ours: does it once.
        peer: does the same once with the peer; None for an absolute limit.
        peer_name: name and version of the peer.
        least_ratio: how many times faster than the peer we must be.
        most_seconds: how long ours may take at most, for a row without a peer [s].
        check: looks at the results: whether they are good enough, and what to say about them.
        repeats: how often each is measured.
        self_timed: the calls measure themselves and return seconds.
    """

    name: str
    ours: Callable[[], Any]
    peer: Callable[[], Any] | None = None
    peer_name: str = ""
    least_ratio: float = 0.0
    most_seconds: float = float("inf")
    check: Callable[[], tuple[bool, str]] = field(default=_no_check)
    repeats: int = 21
    self_timed: bool = False


@dataclass(frozen=True)
class Measurement:
    """What a row came to.

    Attributes:
        name: of the row.
        ours: median time of ours [s]; nan when it could not be measured.
        peer: median time of the peer [s]; nan without one.
        peer_name: of the row.
        target: in words.
        passed: whether the target was met; None when it could not be measured.
        note: what the check said, or how to install what is missing.
    """

    name: str
    ours: float
    peer: float
    peer_name: str
    target: str
    passed: bool | None
    note: str

    @property
    def ratio(self) -> float:
        """How many times faster ours is."""
        return self.peer / self.ours


def measure(row: Row) -> Measurement:
    """Time a row: both sides in turns, medians."""
    calls = [row.ours] if row.peer is None else [row.ours, row.peer]
    batches = [1 if row.self_timed else _batch(call) for call in calls]
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(row.repeats):
        for call, batch, seconds in zip(calls, batches, times, strict=True):
            seconds.append(float(call()) if row.self_timed else _timed(call, batch))
    medians = [float(np.median(seconds)) for seconds in times]
    good, note = row.check()
    ours, peer = medians[0], medians[1] if len(medians) > 1 else float("nan")
    if row.peer is None:
        fast, target = ours <= row.most_seconds, f"at most {duration(row.most_seconds)}"
    else:
        fast, target = peer / ours >= row.least_ratio, f"at least {row.least_ratio:g} x"
    return Measurement(row.name, ours, peer, row.peer_name, target, fast and good, note)


def _timed(call: Callable[[], Any], batch: int) -> float:
    begin = time.perf_counter()
    for _ in range(batch):
        call()
    return (time.perf_counter() - begin) / batch


def _batch(call: Callable[[], Any], least: float = 2e-3) -> int:
    """Return how many calls take at least 2 ms, after one to warm up."""
    call()
    batch = 1
    while _timed(call, batch) * batch < least:
        batch *= 2
    return batch


def duration(seconds: float) -> str:
    """Return ``seconds`` as people write it, in s, ms or us."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e6:.3g} us"
