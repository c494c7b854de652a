"""Consistency: whether the errors of a filter are as large as the filter says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.html_table import html_table

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Consistency:
    """The mean of a normalised error squared, beside the values that are expected of a correct filter.

    The normalised error squared is ``d^2 = e' C^-1 e``, where ``C`` is the covariance of the error ``e`` according to
    the filter. For a correct filter, ``d^2`` has a chi-square distribution with as many degrees of freedom as ``e`` has
    components. With the innovation as error, it is called NIS; with the error of the estimate, NEES. Detections outside
    the gate are never assigned, so the distribution of the NIS ends at the gate. The *band* contains the mean of
    ``count`` independent values with a probability of 95 %. A mean above the band: the filter is too confident (the
    noise is larger than stated). Below the band: the filter is too cautious.

    Attributes:
        mean: mean of ``d^2``; nan without values.
        low: lower end of the band.
        high: upper end of the band.
        count: number of values.
    """

    mean: float
    low: float
    high: float
    count: int

    @property
    def inside(self) -> bool:
        """Whether the mean lies in the band; True without values."""
        return not self.count or self.low <= self.mean <= self.high

    @property
    def band(self) -> tuple[float, float]:
        """Both ends of the band."""
        return self.low, self.high

    @classmethod
    def of(
        cls, values: Array, degrees: int = 3, *, gate: float = math.inf, independent: float | None = None
    ) -> Consistency:
        """Return the mean of normalised errors squared, and its band.

        Args:
            values: normalised errors squared, shape (n,).
            degrees: number of components of the error.
            gate: largest possible value.
            independent: number of independent values among them; None: all. The errors of successive estimates are
                correlated, so that they contain fewer.
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
    """Return the value below which a chi-square variable lies with the given probability."""
    from scipy.special import gammaincinv  # noqa: PLC0415  slow to import

    return 2.0 * float(gammaincinv(0.5 * degrees, probability))


def chi_square_moments(degrees: int, gate: float = math.inf) -> tuple[float, float]:
    """Return mean and variance of a chi-square variable that is below ``gate``."""
    if math.isinf(gate):
        return float(degrees), 2.0 * degrees
    from scipy.special import gammainc  # noqa: PLC0415

    below, once, twice = (float(gammainc(0.5 * (degrees + 2 * i), 0.5 * gate)) for i in range(3))
    mean = degrees * once / below
    return mean, degrees * (degrees + 2) * twice / below - mean * mean
