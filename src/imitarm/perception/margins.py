"""CoverageMargin: a bound on the error of a predicted obstacle's position, calibrated with measured errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.html_table import html_table
from imitarm.validation import finite_array, finite_number, finite_vector, whole_number

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CoverageMargin:
    """A margin ``m(tau) = a + b tau`` [m] that bounds the error of a predicted position with a given probability.

    The time ``tau`` [s] is the look-ahead time of the prediction. A policy adds the margin to the clearance that it
    keeps from the predicted obstacle. The margin is calibrated by split conformal prediction. A *window* consists of
    one prediction and the true motion after the prediction; its error at the look-ahead time ``tau_k`` is ``e(tau_k)``.
    One score is computed for each window::

        s = max_k e(tau_k) / (a0 + b0 tau_k)

    With n independent windows and the coverage ``1 - alpha``, the margin is ``s* (a0 + b0 tau)``, where ``s*`` is the
    ``ceil((n + 1) (1 - alpha))``-th smallest score. Then the error of a new window stays within the margin at all
    look-ahead times with a probability of at least ``1 - alpha``. This guarantee holds for any distribution of the
    errors. It requires that the new window is drawn like the calibration windows (that all windows are exchangeable).
    With several obstacles, ``alpha`` is divided by their number, so that the coverage holds for all obstacles together.

    Attributes:
        offset: ``a``, margin at the time of the prediction [m].
        growth: ``b``, increase of the margin per second of look-ahead time [m/s].

    Raises:
        InputError: when a number is negative or not finite.
    """

    offset: float
    growth: float = 0.0

    def __post_init__(self) -> None:
        offset = finite_number(self.offset, "CoverageMargin: offset", "m", at_least=0.0)
        growth = finite_number(self.growth, "CoverageMargin: growth", "m/s", at_least=0.0)
        object.__setattr__(self, "offset", offset)
        object.__setattr__(self, "growth", growth)

    @classmethod
    def none(cls) -> CoverageMargin:
        """Return a margin of zero, for predictions that count as exact."""
        return cls(0.0, 0.0)

    @property
    def is_zero(self) -> bool:
        """Whether the margin is zero at all times."""
        return self.offset == 0.0 and self.growth == 0.0

    def at(self, tau: ArrayLike) -> Array:
        """Return the margin for predictions over ``tau``.

        Args:
            tau: look-ahead times, shape (...) [s]; times before the prediction count as 0.

        Returns:
            Margins, shape (...) [m].

        Raises:
            InputError: when a time is not a finite number.
        """
        times = finite_array(tau, (...,), "CoverageMargin.at: tau", "s")
        return np.asarray(self.offset + self.growth * np.maximum(times, 0.0))

    @classmethod
    def calibrate(
        cls,
        windows: ArrayLike,
        coverage: float = 0.95,
        n_obstacles: int = 1,
        *,
        times: ArrayLike,
        shape: tuple[float, float] | None = None,
    ) -> CoverageMargin:
        """Calibrate a margin with measured errors, so that it holds with the probability ``coverage``.

        Args:
            windows: prediction errors of independent windows, shape (n_windows, n_times) [m]; the errors should include
                the error of the obstacle's fitted shape.
            coverage: probability that all obstacles stay within their margins, between 0 and 1.
            n_obstacles: number of obstacles present at the same time.
            times: look-ahead times of the errors, shape (n_times,) [s]; at least 0.
            shape: ``(a0, b0)``, offset and growth of the margin before its scaling by ``s*`` [m, m/s]. None: a0 and b0
                are fitted to a quarter of the windows, and ``s*`` is computed from the other windows.

        Raises:
            InputError: when an array has the wrong shape, a number is invalid, or there are too few windows for the
                coverage. The message states the required number of windows.
        """
        errors, ahead = _checked_windows(windows, times)
        level = finite_number(coverage, "CoverageMargin: coverage", above=0.0)
        if level >= 1.0:
            raise InputError(f"CoverageMargin: coverage must be below 1, got {level:g}")
        alpha = (1.0 - level) / whole_number(n_obstacles, "CoverageMargin: n_obstacles", at_least=1)
        if shape is None:
            quarter = np.arange(len(errors)) % 4 == 0
            shape, errors = fitted_shape(errors[quarter], ahead, alpha), errors[~quarter]
        a0, b0 = finite_vector(shape, 2, "CoverageMargin: shape", "m, m/s").tolist()
        cls(a0, b0)  # its checks
        scale = conformal_quantile(scores(errors, ahead, a0, b0), alpha)
        return cls(scale * a0, scale * b0)

    def covered(self, windows: ArrayLike, times: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the error of each window stays within the margin at all look-ahead times, shape (n_windows,).

        Args:
            windows: prediction errors, shape (n_windows, n_times) [m].
            times: look-ahead times of the errors, shape (n_times,) [s].

        Raises:
            InputError: when a shape is wrong or a number is invalid.
        """
        errors, ahead = _checked_windows(windows, times)
        return np.asarray((errors <= self.at(ahead)).all(axis=1))

    def _repr_html_(self) -> str:
        return html_table("CoverageMargin", {"offset": f"{self.offset:.4g} m", "growth": f"{self.growth:.4g} m/s"})


def scores(errors: Array, times: Array, offset: float, growth: float) -> Array:
    """Return the score ``max_k e(tau_k) / (a0 + b0 tau_k)`` of each window, shape (n_windows,)."""
    allowed = offset + growth * times
    if allowed.min() <= 0.0:
        raise InputError("CoverageMargin: the shape (a0, b0) must be positive at all look-ahead times")
    return np.asarray((errors / allowed).max(axis=1))


def conformal_quantile(values: Array, alpha: float) -> float:
    """Return the ``ceil((n + 1) (1 - alpha))``-th smallest of n values."""
    n = len(values)
    rank = math.ceil((n + 1) * (1.0 - alpha) - 1e-9)
    if rank > n:
        needed = math.ceil((1.0 - alpha) / alpha - 1e-9)
        raise InputError(
            f"CoverageMargin: {n} windows are too few for an error probability of {alpha:.3g} per obstacle; at least "
            f"{needed} are needed (and a third more if the shape is fitted too)"
        )
    return float(np.partition(values, rank - 1)[rank - 1])


def fitted_shape(errors: Array, times: Array, alpha: float) -> tuple[float, float]:
    """Fit a line ``a0 + b0 tau`` to the errors' ``1 - alpha`` quantile; return ``a0 > 0`` and ``b0 >= 0``.

    Args:
        errors: prediction errors, shape (n_windows, n_times) [m].
        times: look-ahead times, shape (n_times,) [s].
        alpha: fraction of the errors above the quantile.
    """
    if not len(errors):
        raise InputError("CoverageMargin: at least 1 window is required")
    quantile = np.quantile(errors, 1.0 - alpha, axis=0)
    spread = times - times.mean()
    slope = float(spread @ quantile / (spread @ spread)) if spread.any() else 0.0
    slope = max(slope, 0.0)
    largest = float(quantile.max())
    offset = max(float((quantile - slope * times).mean()), 0.05 * largest, 1e-6)
    return offset, slope


def _checked_windows(windows: ArrayLike, times: ArrayLike) -> tuple[Array, Array]:
    ahead = finite_array(times, (None,), "CoverageMargin: times", "s")
    if not len(ahead) or ahead.min() < 0.0:
        raise InputError("CoverageMargin: times must contain at least one look-ahead time, all of at least 0 [s]")
    errors = finite_array(windows, (None, len(ahead)), "CoverageMargin: windows", "m")
    if errors.size and errors.min() < 0.0:
        raise InputError("CoverageMargin: the errors in windows are lengths and must not be negative [m]")
    return errors, ahead
