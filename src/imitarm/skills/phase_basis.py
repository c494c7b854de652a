"""The phase of a primitive, and the basis functions over it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DECAY = float(np.log(100.0))  # alpha: the phase is 0.01 when the duration is over
_TINY = 1e-300  # far past the end all basis functions underflow to 0


@dataclass(frozen=True)
class PhaseBasis:
    r"""Basis functions over the phase s, which falls from 1 to 0.01 and on towards 0.

    .. math::
        \tau \dot s = -\alpha s, \qquad b_i(s) = \frac{\psi_i(s) s}{\sum_j \psi_j(s)}, \qquad
        \psi_i(s) = \exp(-h_i (s - c_i)^2)

    The centres are spread equally in time, and h_i is 2 over the squared gap to the next centre.

    Attributes:
        n_basis: number N of functions.
    """

    n_basis: int

    @cached_property
    def centers(self) -> Array:
        """c_i, shape (N,)."""
        return np.exp(-DECAY * np.linspace(0.0, 1.0, self.n_basis))

    @cached_property
    def widths(self) -> Array:
        """h_i, shape (N,)."""
        gaps = -np.diff(self.centers)
        return np.asarray(2.0 / np.concatenate([gaps, gaps[-1:]]) ** 2)

    def at(self, s: Array) -> Array:
        """Return b_i(s) for phases s (n,), shape (n, N)."""
        distance = s[:, None] - self.centers
        psi = np.exp(distance * distance * -self.widths)
        psi *= (s / (psi.sum(axis=1) + _TINY))[:, None]
        return psi


@lru_cache(maxsize=8)
def phase_basis(n_basis: int) -> PhaseBasis:
    """Return the basis of that size, always the same one."""
    return PhaseBasis(n_basis)


@lru_cache(maxsize=16)
def on_grid(n_basis: int, n_steps: int) -> tuple[Array, Array]:
    """Return phases (2 n + 1,) and basis (2 n + 1, N) at the begin, middle and end of ``n_steps`` equal steps."""
    s = np.exp(-DECAY * np.linspace(0.0, 1.0, 2 * n_steps + 1))
    basis = phase_basis(n_basis).at(s)
    s.setflags(write=False)
    basis.setflags(write=False)
    return s, basis
