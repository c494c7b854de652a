"""Where expectation maximisation starts: responsibilities before any Gaussian is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.skills.em import packing

Array = NDArray[np.float64]

_SLOTS = 40  # equal time slots that segments are made of, at least; four times as many as components if that is more
_EDGE = 1e-4  # of a slot: a time that falls on an edge must not change sides by rounding (of epoch stamps, too)
_SOFT = 1e-6  # variance added to a segment, relative to the columns', so that a straight one costs a finite amount
_EVEN = 0.05  # cost of the squared lengths, beside about 10 that a sample costs: equal lengths where data don't care


def responsibilities_by_segments(features: Array, column: Array, numbers: Sequence[int]) -> list[Array]:
    """Cut time into the K segments that Gaussians describe best, for several K at once.

    The span of ``column`` is divided into slots of equal length. A segment with n of the N samples and covariance Sigma
    costs ``n (log det Sigma / 2 - log(n / N))``, what a Gaussian of its own would leave over in log-likelihood, and a
    little for its squared length, so that lengths are equal where the data don't care. Dynamic programming over the
    slots finds the cheapest cut into K segments for every K up to the largest. It is deterministic, and expectation
    maximisation needs fewer iterations from there than from equal bins.

    Args:
        features: of the standardised samples, shape (F, n).
        column: the time of the samples, shape (n,).
        numbers: the numbers K of segments wanted.

    Returns:
        Hard responsibilities (K, n) in the order of time, one for each K. Where slots don't suffice (few samples, or
        gaps in time) equal bins.
    """
    most = max(numbers)
    n_slots = max(_SLOTS, 4 * most)
    low, high = column.min(), column.max()
    slots = (column - low) * (n_slots / max(high - low, 1e-300)) + _EDGE
    slot = np.minimum(slots.astype(np.intp), n_slots - 1)
    sums = np.asarray(slot == np.arange(n_slots)[:, None], dtype=float) @ features.T
    cumulative = np.concatenate([np.zeros((1, len(features))), np.cumsum(sums, axis=0)])
    first, last = np.triu_indices(n_slots + 1, 1)
    cost = np.full((n_slots + 1, n_slots + 1), np.inf)
    evenly = _EVEN * len(column) * ((last - first) / n_slots) ** 2
    cost[first, last] = _segment_costs(cumulative[last] - cumulative[first], len(column)) + evenly
    cheapest = cost[0]
    came_from: list[NDArray[np.intp]] = []
    answers: dict[int, Array | None] = {}
    for k in range(1, most + 1):
        if k in numbers:
            answers[k] = _cut(slot, came_from, n_slots) if np.isfinite(cheapest[-1]) else None
        totals = cheapest[:, None] + cost
        came_from.append(np.argmin(totals, axis=0))
        cheapest = totals.min(axis=0)
    return [responsibilities_by_bins(column, k) if (cut := answers[k]) is None else cut for k in numbers]


def _segment_costs(statistics: Array, n_samples: int) -> Array:
    """Return the costs of segments with these sums of features, inf for those of too few samples."""
    number = statistics[:, 0]
    size = round(float(np.sqrt(8 * statistics.shape[1] + 1) - 1) / 2)
    moments = (statistics / np.maximum(number, 1.0)[:, None]).take(packing(size)[1], axis=-1)
    diagonal = np.arange(1, size)
    moments[:, diagonal, diagonal] += _SOFT
    moments[:, 0, 0] = 1.0
    log_det = np.linalg.slogdet(moments)[1]
    costs = number * (0.5 * log_det - np.log(np.maximum(number, 1.0) / n_samples))
    return np.where(number >= 2 * size, costs, np.inf)


def _cut(slot: NDArray[np.intp], came_from: list[NDArray[np.intp]], n_slots: int) -> Array:
    """Follow the cheapest way back from the last slot, and return the responsibilities (K, n)."""
    borders = [n_slots]
    for back in reversed(came_from):
        borders.append(int(back[borders[-1]]))
    labels = np.searchsorted(borders[::-1], np.arange(n_slots), side="right")
    return np.asarray(labels[slot] == np.arange(len(came_from) + 1)[:, None], dtype=float)


def responsibilities_by_bins(column: Array, n_bins: int) -> Array:
    """Return hard responsibilities (K, n) of equal bins of one column, in order.

    Bins of equal width; of equal number when one of those would hold fewer than two samples.
    """
    low, high = column.min(), column.max()
    labels = np.minimum(((column - low) * (n_bins / max(high - low, 1e-300)) + _EDGE).astype(np.intp), n_bins - 1)
    if np.bincount(labels, minlength=n_bins).min() < 2:
        order = np.argsort(column, kind="stable")
        labels = np.empty(len(column), dtype=np.intp)
        labels[order] = np.arange(len(column)) * n_bins // len(column)
    return np.asarray(labels == np.arange(n_bins)[:, None], dtype=float)


def responsibilities_by_seeds(Z: Array, n_components: int, rng: np.random.Generator, n_lloyd: int = 5) -> Array:
    """Return hard responsibilities (K, n) of k-means++ seeds (Arthur and Vassilvitskii 2007) and a few Lloyd passes."""
    seeds = Z[rng.integers(len(Z), size=1)]
    nearest = np.sum((Z - seeds[0]) ** 2, axis=1)
    while len(seeds) < n_components:
        total = nearest.sum()
        pick = rng.choice(len(Z), size=1, p=nearest / total if total > 0.0 else None)
        seeds = np.concatenate([seeds, Z[pick]])
        nearest = np.minimum(nearest, np.sum((Z - Z[pick]) ** 2, axis=1))
    for _ in range(n_lloyd):
        labels = np.argmin(np.sum(seeds**2, axis=1)[:, None] - 2.0 * seeds @ Z.T, axis=0)
        members = np.asarray(labels == np.arange(n_components)[:, None], dtype=float)
        number = members.sum(axis=1, keepdims=True)
        seeds = np.where(number > 0.0, members @ Z / np.maximum(number, 1.0), seeds)
    return members
