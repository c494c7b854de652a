"""The direction of least cost: candidates for the coupling acceleration of a primitive, and their predicted cost."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.skills.dynamical_systems import Gains

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_TIED = 1e-9  # costs that differ by less are equal


class Response(NamedTuple):
    r"""How a deviation from the primitive's motion develops while a coupling acceleration is constant.

    The deviation e = x - xi of a primitive with the coupling acceleration u obeys a linear equation, because the
    primitive's force depends on the phase only:

    .. math::
        \tau^2 \ddot e + D \tau \dot e + K e = \tau^2 u, \qquad
        e(t) = A(t)\,e_0 + B(t)\,\dot e_0 + G(t)\,u, \qquad G = \frac{\tau^2}{K} (1 - A)

    With the roots l_1, l_2 of ``tau^2 l^2 + D tau l + K = 0``, ``A = (l_1 exp(l_2 t) - l_2 exp(l_1 t)) / (l_1 - l_2)``
    and ``B = (exp(l_1 t) - exp(l_2 t)) / (l_1 - l_2)``. Without u, the deviation returns to 0: the tool returns to the
    path by itself.

    Attributes:
        A: see above, shape (k,).
        B: shape (k,) [s].
        G: shape (k,) [s^2].
        a_rate: derivative of A, shape (k,) [1/s].
        b_rate: derivative of B, shape (k,).
        g_rate: derivative of G, shape (k,) [s].
    """

    A: Array
    B: Array
    G: Array
    a_rate: Array
    b_rate: Array
    g_rate: Array

    @classmethod
    def of(cls, gains: Gains, tau: float, times: Array) -> Response:
        """Return the response at ``times`` (k,) [s]; ``tau`` [s] is the time constant of the primitive."""
        stiffness, damping = gains.stiffness / tau**2, gains.damping / tau
        root = np.sqrt(complex(0.25 * damping**2 - stiffness))
        if abs(root) < 1e-6 * damping:  # critical: both roots are equal
            decay = np.exp(-0.5 * damping * times)
            A, B = (1.0 + 0.5 * damping * times) * decay, times * decay
        else:
            first, second = -0.5 * damping + root, -0.5 * damping - root
            one, two = np.exp(first * times), np.exp(second * times)
            A = np.real((first * two - second * one) / (first - second))
            B = np.real((one - two) / (first - second))
        return cls(A, B, (1.0 - A) / stiffness, -stiffness * B, A - damping * B, B.copy())

    def free(self, deviation: Array) -> Array:
        """Return the deviations without coupling, shape (k, 3) [m], from ``deviation`` = [e_0; e_0'] (2, 3)."""
        return self.A[:, None] * deviation[0] + self.B[:, None] * deviation[1]


def allowed_axes(forbidden: Array) -> tuple[Array, Array]:
    """Return the space in which a path may be displaced.

    Args:
        forbidden: directions in which the path must not be displaced, unit rows (m, 3).

    Returns:
        An orthonormal basis of the directions that are not forbidden both ways, as columns, shape (3, d), and the
        remaining forbidden directions in this basis, shape (m', d).
    """
    both = np.any(forbidden @ forbidden.T < -1.0 + 1e-9, axis=1)
    _, size, basis = np.linalg.svd(np.concatenate([np.zeros((1, 3)), forbidden[both]]))
    axes = basis[np.count_nonzero(size > 1e-9) :].T
    return axes, forbidden[~both] @ axes


def headings(axes: Array) -> Array:
    """Return unit vectors of coordinates in the frame of :func:`frame`: 26 in space, 12 in a plane, 2 on a line.

    Args:
        axes: orthonormal basis of the directions in which the tool may deviate, as columns, shape (3, d).
    """
    d = axes.shape[1]
    if d == 2:
        angles = np.arange(12) * (np.pi / 6.0)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    grid = np.array(list(itertools.product((1.0, 0.0, -1.0), repeat=d))).reshape(-1, d)
    grid = grid[grid.any(axis=1)] if d else grid[:0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


def frame(tangent: Array, axes: Array) -> Array:
    """Return an orthonormal frame (3, d) of the directions ``axes`` (3, d): along the motion, to its left, and up.

    The frame depends on the motion and the vertical only, so a scene that is rotated about the vertical, or mirrored,
    has the rotated or mirrored candidates.
    """
    d = axes.shape[1]
    along = axes @ (tangent @ axes)
    length = float(np.sqrt(along.dot(along)))
    if d < 2 or length < 1e-6:
        return axes
    along = along / length
    for other in (_UP, axes[:, 0], axes[:, 1]):
        rest = axes @ (other @ axes)
        rest = rest - along * along.dot(rest)
        length = float(np.sqrt(rest.dot(rest)))
        if length > 1e-3:
            break
    rest = rest / length
    if d == 2:
        return np.stack([along, rest], axis=1)
    left = np.array(
        [
            rest[1] * along[2] - rest[2] * along[1],
            rest[2] * along[0] - rest[0] * along[2],
            rest[0] * along[1] - rest[1] * along[0],
        ]
    )
    return np.stack([along, left, rest], axis=1)


class Prediction(NamedTuple):
    """The motion without coupling over the horizon, for one speed of the phase.

    Attributes:
        centers: centres of the tool's spheres without coupling, shape (H, S, 3) [m].
        free: deviations without coupling, shape (H, 3) [m].
        precision: Theta, shape (H, 3, 3).
    """

    centers: Array
    free: Array
    precision: Array


class Choice(NamedTuple):
    """The candidate of least cost.

    Attributes:
        push: coupling acceleration u, shape (3,) [m/s^2].
        rate: speed of the phase, 1 is the learned speed.
        cost: its cost.
        nearest: index of the obstacle that comes nearest, and its distance less the margin [m]; None if none is near.
    """

    push: Array
    rate: float
    cost: float
    nearest: tuple[int, float] | None


@dataclass(frozen=True, eq=False)
class LeastCost:
    r"""Choose the coupling acceleration u and the speed r of the phase with the least predicted cost.

    .. math::
        J(u, r) = \sum_{m=1}^{H} \gamma^m \left[ \tfrac12 w_e\, e_m^T \Theta_m e_m + \sum_i b_i(\xi_m + e_m, m) \right]
        + w_\Delta \|\hat u - \hat u_{prev}\|^2 + w_u \|\hat u\|^2 + w_r (1 - r)^2, \qquad \hat u = u / a_{max}

    This is thesis Eq 5.5, corrected: the task cost instead of the trajectory, an obstacle cost b that falls with the
    distance, and a horizon over which both are summed. The candidates are u = 0, and three sizes of u in each heading.
    The speeds are those of ``rates``: to wait (r = 0) and to go back (r < 0) are candidates like the others.

    The parts of the cost without obstacles cost nearly nothing to compute. The candidates are therefore taken in the
    order of these parts, and the search ends when no remaining one can be better.

    Attributes:
        response: deviation at the instants of the horizon.
        max_acceleration: a_max [m/s^2].
        discount: gamma.
        deviation_weight: w_e [1/m^2].
        change_weight: w_Delta.
        size_weight: w_u.
        wait_weight: w_r.
        rates: speeds of the phase.
        sizes: sizes of u, as fractions of a_max.
    """

    response: Response
    max_acceleration: float
    discount: float = 0.93
    deviation_weight: float = 16.0
    change_weight: float = 0.02
    size_weight: float = 0.02
    wait_weight: float = 2.0
    rates: tuple[float, ...] = (1.0, 0.5, 0.0, -0.5)
    sizes: tuple[float, ...] = (0.35, 0.7, 1.0)

    def candidates(self, directions: Array) -> Array:
        """Return u / a_max of all candidates for unit directions (k, 3), shape (1 + 3 k, 3)."""
        sized = [size * directions for size in self.sizes]
        return np.concatenate([np.zeros((1, 3)), *sized])

    def smooth_cost(self, scaled: Array, prediction: Prediction, previous: Array) -> Array:
        """Return the cost of candidates ``scaled`` = u / a_max (C, 3) without the obstacles, shape (C,).

        The task cost is a quadratic form in u, so the deviations of the candidates are not needed.
        """
        weight = self.deviation_weight * self.discount ** np.arange(1.0, len(self.response.G) + 1.0)
        gain = self.max_acceleration * self.response.G
        pulled = np.matmul(prediction.precision, prediction.free[..., None])[..., 0]
        constant = 0.5 * float(np.sum(weight[:, None] * pulled * prediction.free))
        slope = (weight * gain) @ pulled
        curvature = np.tensordot(weight * gain * gain, prediction.precision, axes=1)
        cost = constant + scaled @ slope + 0.5 * np.sum((scaled @ curvature) * scaled, axis=1)
        change = scaled - previous
        cost += self.change_weight * np.sum(change * change, axis=1) + self.size_weight * np.sum(
            scaled * scaled, axis=1
        )
        return np.asarray(cost)

    def choose(
        self,
        scaled: Array,
        previous: Array,
        predict: Callable[[float], Prediction],
        obstacles: Callable[[Array], tuple[Array, Array]] | None,
    ) -> Choice:
        """Return the candidate of least cost.

        Args:
            scaled: u / a_max of the candidates, shape (C, 3).
            previous: u / a_max of the last choice, shape (3,).
            predict: returns the motion without coupling for a speed of the phase.
            obstacles: returns costs (n, H, C) and gaps (n, H, C) of the spheres' centres (H, C, S, 3); None if no
                obstacle is near.
        """
        best: Choice | None = None
        for rate in self.rates:
            waiting = self.wait_weight * (1.0 - rate) ** 2
            if best is not None and waiting > best.cost + _TIED:
                continue
            prediction = predict(rate)
            smooth = self.smooth_cost(scaled, prediction, previous) + waiting
            found = self._best(scaled, smooth, prediction, obstacles, np.inf if best is None else best.cost)
            if found is not None and (best is None or found[1] < best.cost - _TIED):
                index, cost, nearest = found
                best = Choice(self.max_acceleration * scaled[index], rate, cost, nearest)
            if obstacles is None:
                break
        assert best is not None
        return best

    def _best(
        self,
        scaled: Array,
        smooth: Array,
        prediction: Prediction,
        obstacles: Callable[[Array], tuple[Array, Array]] | None,
        bound: float,
    ) -> tuple[int, float, tuple[int, float] | None] | None:
        """Return index, cost and nearest obstacle of the best candidate for one speed; None if none is below bound."""
        if obstacles is None:
            return 0, float(smooth[0]), None  # the tool returns to the path by itself
        weight = self.discount ** np.arange(1.0, len(self.response.G) + 1.0)
        order = np.argsort(smooth, kind="stable")
        gain = (self.max_acceleration * self.response.G)[:, None, None, None]
        costs = np.full(len(scaled), np.inf)
        gaps: dict[int, Array] = {}
        begin = 0
        for end in (1, 9, len(order)):
            part = order[begin:end]
            bound_now = min(bound, float(costs.min())) + _TIED
            part = part[smooth[part] <= bound_now]
            if not len(part):
                break
            points = prediction.centers[:, None] + gain * scaled[part][:, None]
            cost, gap = obstacles(points)
            costs[part] = smooth[part] + np.sum(weight[:, None] * cost.sum(axis=0), axis=0)
            for column, candidate in enumerate(part.tolist()):
                gaps[candidate] = gap[:, :, column]
            begin = end
        index = self._first_of_best(costs, scaled)
        if not np.isfinite(costs[index]):
            return None
        each = gaps[index].min(axis=1)
        nearest = int(each.argmin())
        return index, float(costs[index]), (nearest, float(each[nearest]))

    @staticmethod
    def _first_of_best(costs: Array, scaled: Array) -> int:
        """Return the index of the least cost; of equal ones, that which leads highest, then the first one."""
        least = float(costs.min())
        tied = (costs <= least + _TIED * max(1.0, abs(least))).nonzero()[0]
        if len(tied) == 1 or not np.isfinite(least):
            return int(costs.argmin())
        height = scaled[tied, 2]
        return int(tied[(height >= height.max() - _TIED).nonzero()[0][0]])
