"""Consistency: compares the errors of a Kalman filter with the covariance that the filter reports."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.html_table import html_table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Consistency:
    """The mean normalised squared error of a Kalman filter, and the band in which this mean lies for a correct filter.

    The normalised squared error is ``d^2 = e' C^-1 e``, where ``C`` is the filter's covariance of the error ``e``. For
    a correct filter, ``d^2`` has a chi-square distribution with as many degrees of freedom as ``e`` has components. If
    ``e`` is the innovation, ``d^2`` is called NIS; if ``e`` is the error of the estimate, ``d^2`` is called NEES.
    A tracker assigns no detection whose NIS exceeds a limit, the gate, so the largest possible NIS is the gate. For a
    correct filter, the *band* contains the mean with a probability of 95 %. If the mean is above the band, the filter
    is too confident: the true noise is larger than the assumed noise. If the mean is below the band, the filter is too
    cautious.

    Attributes:
        mean: mean of ``d^2``; nan if there are no values.
        low: lower end of the band for ``mean``.
        high: upper end of the band for ``mean``.
        count: number of values.
    """

    mean: float
    low: float
    high: float
    count: int

    @property
    def inside(self) -> bool:
        """Whether the mean lies in the band; True if there are no values."""
        return not self.count or self.low <= self.mean <= self.high

    @property
    def band(self) -> tuple[float, float]:
        """Lower and upper end of the band."""
        return self.low, self.high

    @classmethod
    def of(
        cls, values: Array, degrees: int = 3, *, gate: float = math.inf, independent: float | None = None
    ) -> Consistency:
        """Return the mean of normalised squared errors, and the band in which this mean lies for a correct filter.

        Args:
            values: normalised squared errors, shape (n,).
            degrees: number of components of the error ``e``.
            gate: largest value that can occur; inf: values of any size can occur.
            independent: number of independent values that carry as much information as ``values``; None: all values are
                independent. Errors of successive estimates are correlated, so this number is then less than n.
        """
        n = float(len(values)) if independent is None else independent
        expected, variance = chi_square_moments(degrees, gate)
        if not len(values):
            return cls(math.nan, expected, expected, 0)
        half = 1.959964 * math.sqrt(variance / n)
        return cls(float(np.mean(values)), expected - half, expected + half, len(values))

    def __str__(self) -> str:
        verdict = "inside" if self.inside else "above" if self.mean > self.high else "below"
        return f"{self.mean:.2f}, {verdict} {self.low:.2f} to {self.high:.2f} ({self.count} values)"

    def _repr_html_(self) -> str:
        return html_table("Consistency", {"mean, band": str(self)})


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return the chi-square quantile for a ``probability`` and the number of ``degrees`` of freedom."""
    from scipy.special import gammaincinv  # noqa: PLC0415  slow to import

    return 2.0 * float(gammaincinv(0.5 * degrees, probability))


def chi_square_moments(degrees: int, gate: float = math.inf) -> tuple[float, float]:
    """Return mean and variance of a chi-square variable, restricted to values below ``gate``."""
    if math.isinf(gate):
        return float(degrees), 2.0 * degrees
    from scipy.special import gammainc  # noqa: PLC0415

    below, once, twice = (float(gammainc(0.5 * (degrees + 2 * i), 0.5 * gate)) for i in range(3))
    mean = degrees * once / below
    return mean, degrees * (degrees + 2) * twice / below - mean * mean
