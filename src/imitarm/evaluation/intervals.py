"""Statistical uncertainty: bootstrap over persons, paired comparisons by random sign flips, Holm's correction.

Persons are resampled, not frames or recordings, because the recordings of one person are similar. Treating recordings
as independent would make every interval too narrow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_DRAWS, _RESAMPLED = 10_000, 2000
_EXACT = 14  # largest number of persons for which all sign flips are evaluated; beyond: _DRAWS
_TINY = 1e-12
_ALIKE, _COUNTS = 0.3, 2  # prior correlation of one person's trials, and how many persons it counts as
_FINEST = 1000  # largest number of steps of a rate, for unequal numbers of trials


@dataclass(frozen=True)
class Interval:
    """A mean over persons and its 95 % confidence interval.

    Attributes:
        mean: mean over persons, where each person is represented by the mean of the person's recordings.
        low: lower end of the interval; nan with fewer than two persons.
        high: upper end of the interval; nan with fewer than two persons.
        persons: number of persons.
        used: number of recordings that have a value.
        of: number of all recordings.
    """

    mean: float
    low: float
    high: float
    persons: int
    used: int
    of: int

    @property
    def excludes_zero(self) -> bool:
        """Whether zero is outside the interval."""
        return self.low > 0.0 or self.high < 0.0


Values = Mapping[tuple[int, Any], float]
"""Measured values; the keys are (person, second key), for example (person, recording). A missing value is nan."""


def person_means(values: Values) -> Array:
    """Return the mean of each person, in the order of the persons; recordings without a value are left out."""
    persons: dict[int, list[float]] = {}
    for (person, _), value in sorted(values.items(), key=lambda item: (item[0][0], str(item[0][1]))):
        if math.isfinite(value):
            persons.setdefault(person, []).append(value)
    return np.array([np.mean(persons[person]) for person in sorted(persons)])


def interval(values: Values, *, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Return the mean over persons and its bootstrap confidence interval.

    Args:
        values: values of each recording.
        confidence: confidence level of the interval.
        seed: seed of the resampling.
    """
    means = person_means(values)
    used = sum(math.isfinite(value) for value in values.values())
    if len(means) == 0:
        return Interval(math.nan, math.nan, math.nan, 0, 0, len(values))
    low, high = bootstrap(means, confidence=confidence, seed=seed)
    return Interval(float(means.mean()), low, high, len(means), used, len(values))


def bootstrap(samples: ArrayLike, *, confidence: float = 0.95, seed: int = 0) -> tuple[float, float]:
    r"""Return the percentile bootstrap interval of a mean.

    The means of resampled data vary too little: with n samples, their standard deviation is too small by the factor
    :math:`\sqrt{(n-1)/n}`. Therefore the difference between each resampled mean and the sample mean is divided by this
    factor. Without this division, a "95 %" interval of ten samples would contain the true mean in only 90 % of all
    cases.

    Args:
        samples: shape (n,).
        confidence: confidence level of the interval.
        seed: seed of the resampling.

    Returns:
        Lower and upper end of the interval; nan with fewer than two samples.
    """
    x = np.asarray(samples, dtype=float)
    n = len(x)
    if n < 2:
        return math.nan, math.nan
    draws = x[np.random.default_rng(seed).integers(0, n, (_DRAWS, n))].mean(axis=1)
    widened = x.mean() + (draws - x.mean()) * math.sqrt(n / (n - 1))
    low, high = np.quantile(widened, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence])
    return float(low), float(high)


def block_bootstrap(
    values: ArrayLike, times: ArrayLike, block: float, *, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Return the bootstrap interval of the mean of a time series in which successive values are correlated.

    The series is cut into blocks of equal duration, and whole blocks are resampled, so that the correlation inside a
    block is kept. A block should be several times as long as the time over which values are correlated.

    Args:
        values: values of the time series, shape (n,).
        times: time of each value, shape (n,) [s].
        block: duration of a block [s].
        confidence: confidence level of the interval.
        seed: seed of the resampling.

    Returns:
        Lower and upper end of the interval; nan with fewer than two blocks.
    """
    x, t = np.asarray(values, dtype=float), np.asarray(times, dtype=float)
    if not len(x):
        return math.nan, math.nan
    _, member = np.unique(np.floor((t - t.min()) / block), return_inverse=True)
    counts, sums = np.bincount(member), np.bincount(member, weights=x)
    n = len(counts)
    if n < 2:
        return math.nan, math.nan
    drawn = np.random.default_rng(seed).integers(0, n, (_DRAWS, n))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    widened = x.mean() + (means - x.mean()) * math.sqrt(n / (n - 1))
    low, high = np.quantile(widened, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence])
    return float(low), float(high)


def median_ratio(
    ours: ArrayLike, theirs: ArrayLike, *, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float, float]:
    """Return the ratio of the medians of two measures of the same cases, and its bootstrap interval.

    The cases are resampled, so that the two values of a case stay together.

    Args:
        ours: values of the first measure, one for each case, shape (n,).
        theirs: positive values of the second measure for the same cases, shape (n,).
        confidence: confidence level of the interval.
        seed: seed of the resampling.

    Returns:
        Ratio, lower end and upper end of its interval. With one case, both ends are nan; without cases, all three
        values are nan.
    """
    x = np.stack([np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float)])
    n = x.shape[1]
    if n == 0:
        return math.nan, math.nan, math.nan
    one, other = np.median(x, axis=1)
    if n < 2:
        return float(one / other), math.nan, math.nan
    chosen = np.random.default_rng(seed).integers(0, n, (_RESAMPLED, n))
    first, second = np.median(x[:, chosen], axis=2)
    low, high = np.quantile(first / second, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence])
    return float(one / other), float(low), float(high)


@dataclass(frozen=True)
class Comparison:
    """Comparison of two methods on the same recordings.

    Attributes:
        difference: mean difference, first method minus second, over the recordings for which both methods have a value.
        relative: ``difference`` relative to the absolute mean of the second method; nan where that mean is zero.
        p: p-value of ``difference``: how probable a difference of at least this size would be if the two methods were
            equal. The p-value is computed by random sign flips of the persons' differences.
        corrected: ``p`` after Holm's correction for all comparisons that are made together.
    """

    difference: Interval
    relative: float
    p: float
    corrected: float = math.nan


def compare(ours: Values, theirs: Values) -> Comparison:
    """Compare two methods on pairs of values, one pair for each recording.

    Args:
        ours: values of the first method, by recording.
        theirs: values of the second method, for the same recordings.
    """
    both = {key: ours[key] - theirs[key] for key in ours if key in theirs}
    paired = {key: theirs[key] for key, value in both.items() if math.isfinite(value)}
    base = float(person_means(paired).mean()) if paired else math.nan
    found = interval(both)
    relative = found.mean / abs(base) if abs(base) > _TINY else math.nan
    return Comparison(found, relative, sign_flip_p(person_means(both)))


def rate_interval(outcomes: Values) -> Interval:
    r"""Return the success rate, averaged over persons, with its 95 % interval.

    The trials of one person are similar. Therefore N trials count only as :math:`N / D` independent trials. The Wilson
    interval is computed for this smaller number of trials (Rao and Scott, Biometrics 1992).
    :math:`D = 1 + (m - 1) \rho` is the design effect of m trials per person. :math:`\rho` is the correlation between
    trials of one person. The correlation is estimated from the variance of the persons' success rates, compared with
    the variance that chance alone would cause. An estimate from a few persons is inaccurate. It is therefore averaged
    with a prior correlation of 0.3, which has the weight of two persons. If all trials had the same result, or if there
    is only one person, the correlation is set to 0.3. :math:`N / D` lies between the number of persons and N.

    With this rule alone, one more failure could make the interval narrower. For example, the persons seem to differ if
    only one person fails, but seem to be alike if a second person fails as well. To prevent this effect, the function
    also computes the intervals of all results that are at least as good as ``outcomes`` in each trial. It returns the
    lowest of their lower ends. In the same way, it considers all results that are at least as bad as ``outcomes`` in
    each trial, and returns the highest of their upper ends.

    Args:
        outcomes: outcome of each trial, 1 for success, 0 for failure.
    """
    rates = person_means(outcomes)
    n, used = len(rates), sum(math.isfinite(value) for value in outcomes.values())
    if n == 0:
        return Interval(math.nan, math.nan, math.nan, 0, 0, len(outcomes))
    tried: dict[int, int] = {}
    for (person, _), value in outcomes.items():
        tried[person] = tried.get(person, 0) + math.isfinite(value)
    step = min(math.lcm(*(count for count in tried.values() if count)), _FINEST)
    low, high = _lower_end(rates, used / n, step), 1.0 - _lower_end(1.0 - rates, used / n, step)
    return Interval(float(rates.mean()), low, high, n, used, len(outcomes))


def _lower_end(rates: Array, each: float, step: int) -> float:
    """Return the lower end of the interval of a success rate.

    The function considers every result in which each person has at least the rate in ``rates``, and returns the lowest
    of the lower ends. Among results with the same mean, the lower end is lowest where the persons differ most. To make
    the persons differ most, first raise the rate of the best person to 1, then the rate of the next best person, and so
    on (such a result majorises all others with the same mean). Therefore the function examines only results that are
    reached in this way.

    Args:
        rates: success rate of each person, shape (n,).
        each: average number of trials per person.
        step: number of steps in which the sum of the rates is raised by 1.
    """
    own = np.sort(rates)[::-1]
    room = 1.0 - own
    raised = np.linspace(0.0, room.sum(), round(step * room.sum()) + 1)[:, None]
    better = own + np.clip(raised - (np.cumsum(room) - room), 0.0, room)
    trials = len(own) * each / _design_effect(better, each)
    return min(wilson_interval(p * n, n)[0] for p, n in zip(better.mean(axis=1).tolist(), trials.tolist(), strict=True))


def _design_effect(rates: Array, each: float) -> Array:
    """Return the design effect (k,): how many trials of one person count as one independent trial.

    Args:
        rates: success rates of n persons in k results, shape (k, n).
        each: average number of trials per person.
    """
    n, mean = rates.shape[1], rates.mean(axis=1)
    within, alike = mean * (1.0 - mean), np.full(len(rates), _ALIKE)
    known = (within > _TINY) & (n > 1) & (each > 1.0)
    if known.any():
        effect = each * rates[known].var(axis=1, ddof=1) / within[known]
        found = np.clip((effect - 1.0) / (each - 1.0), 0.0, 1.0)
        alike[known] = ((n - 1) * found + _COUNTS * _ALIKE) / (n - 1 + _COUNTS)
    return 1.0 + (each - 1.0) * alike


def wilson_interval(successes: float, trials: float, z: float = 1.959964) -> tuple[float, float]:
    """Return the Wilson score interval of a rate (95 % by default).

    Args:
        successes: number of successes, 0 to ``trials``; both numbers may be fractional.
        trials: number of trials, at least 1.
        z: quantile of the standard normal distribution for the confidence level; 1.96 for 95 %.
    """
    p = min(max(successes / trials, 0.0), 1.0)
    centre = p + z * z / (2 * trials)
    spread = z * np.sqrt(p * (1 - p) / trials + z * z / (4 * trials**2))
    scale = 1 + z * z / trials
    return max(0.0, float((centre - spread) / scale)), min(1.0, float((centre + spread) / scale))


def sign_flip_p(differences: ArrayLike, *, seed: int = 0) -> float:
    """Return the two-sided p-value of the mean difference, from random sign flips of the differences.

    The p-value is the probability of a mean at least as large as the observed mean if each difference had either sign
    with equal probability. For up to 14 differences, all sign flips are evaluated, so the result is exact. With n
    differences, the p-value can't be less than 2 / 2^n.

    Args:
        differences: mean difference of each person, shape (n,).
        seed: seed of the random sign flips, which are used for more than 14 differences.

    Returns:
        The probability; 1 without differences.
    """
    d = np.asarray(differences, dtype=float)
    n = len(d)
    if n == 0:
        return 1.0
    if n <= _EXACT:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
    else:
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (_DRAWS, n))
        signs[0] = 1.0
    sums = np.abs(signs @ d)
    return float(np.mean(sums >= abs(float(d.sum())) * (1.0 - 1e-9)))


def holm(p: Sequence[float]) -> list[float]:
    """Return the p-values ``p`` after correction for multiple comparisons (Holm 1979), in the same order."""
    order = sorted(range(len(p)), key=lambda i: p[i])
    corrected, largest = [0.0] * len(p), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        corrected[i] = largest
    return corrected
