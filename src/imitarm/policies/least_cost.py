"""LeastCost: the choice of RCAMO among candidates for the coupling acceleration and the speed of the motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.compiled.kernels import Record
from imitarm.policies.obstacle_cost import DistanceCost, Groups, ObstacleCost, PredictedObstacles
from imitarm.skills.dynamical_systems import Gains

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_TOUCHES = 1e-6  # [m] of the clearance at the goal
_TIED = 1e-13  # costs that differ by less are equal: it is above the rounding of symmetric scenes


class Response(NamedTuple):
    r"""The response of a motion primitive to a constant coupling acceleration.

    Let xi be the position that the primitive would have without coupling, x the position of the tool, and u the
    coupling acceleration. The forcing term of the primitive depends only on the phase. The deviation e = x - xi
    therefore obeys a linear equation:

    .. math::
        \tau^2 \ddot e + D \tau \dot e + K e = \tau^2 u, \qquad
        e(t) = A(t)\,e_0 + B(t)\,\dot e_0 + G(t)\,u, \qquad G = \frac{\tau^2}{K} (1 - A)

    Let l_1 and l_2 be the roots of ``tau^2 l^2 + D tau l + K = 0``. Then ``A = (l_1 exp(l_2 t) - l_2 exp(l_1 t)) / (l_1
    - l_2)`` and ``B = (exp(l_1 t) - exp(l_2 t)) / (l_1 - l_2)``. If u is 0, the deviation decays to 0, so the tool
    returns to the path.

    Attributes:
        A: factor of the initial deviation e_0 at k times, shape (k,).
        B: factor of the initial rate of the deviation, shape (k,) [s].
        G: factor of the coupling acceleration, shape (k,) [s^2].
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
        """Return the deviations (k, 3) [m] that follow from ``deviation`` = [e_0; e_0'] (2, 3) without coupling."""
        return self.A[:, None] * deviation[0] + self.B[:, None] * deviation[1]


class Prediction(NamedTuple):
    """The predicted motion without coupling, at H times of the horizon and for R speeds of the phase.

    Attributes:
        centers: centres of the tool's spheres without coupling, shape (R, H, S, 3) [m].
        arrived: whether the phase has reached the end of the motion, shape (R, H).
        goal: centres of the tool's spheres at the goal, shape (S, 3) [m].
    """

    centers: Array
    arrived: NDArray[np.bool_]
    goal: Array


class Choice(NamedTuple):
    """The candidate of least cost.

    Attributes:
        scaled: coupling acceleration u / u_max, shape (3,).
        rate: speed of the phase; 1 is the learned speed.
        cost: predicted cost of this candidate.
        nearest: index of the obstacle that comes nearest to the tool; -1 if no obstacle is near.
        gap: smallest distance of the tool to this obstacle, minus the margin of its prediction [m].
    """

    scaled: Array
    rate: float
    cost: float
    nearest: int
    gap: float


STAY = Choice(np.zeros(3), 1.0, 0.0, -1, math.inf)
"""The choice if no obstacle is near: no coupling acceleration, so the tool returns to its path."""


@dataclass(frozen=True, eq=False)
class LeastCost:
    r"""Choose the coupling acceleration u and the speed r of the phase with the least predicted cost.

    .. math::
        J(u, r) = \sum_{m=1}^{H} \gamma^m \left[ \tfrac12 w_e\, e_m^T \Theta e_m + \sum_i b_i(\xi_m + e_m, m) \right]
        + w_\Delta \|\hat u - \hat u_{prev}\|^2 + w_u \|\hat u\|^2 + w_r (1 - r)^2, \qquad \hat u = u / u_{max}

    The formula corrects thesis Eq 5.5 in three points. The task cost depends on the deviations e, where the thesis has
    the trajectory itself. The cost b of an obstacle decreases with the distance. Both costs are summed over a horizon
    of H times, where e_m is the deviation at the m-th time. Theta is the precision (inverse covariance) of the
    demonstrations at the current phase. The candidates for u are 0 and, in each direction of ``units``, the three
    ``sizes``. The candidates for r are the ``rates``, which include waiting (r = 0) and going back (r < 0). The
    attributes explain the other symbols.

    The search finds the least cost of all candidates, but computes only few distances. Two facts make this possible. A
    candidate costs at least as much as it would cost without obstacles. An obstacle has no cost at times before the
    tool can reach it.

    The cost of an obstacle decreases gradually with the distance, so an obstacle beside the goal would keep the tool
    away from the goal. If a tool at the goal keeps the clearance, the policy therefore subtracts from b the value of b
    at the goal. It does so after the end of the phase.

    Attributes:
        times: times of the horizon, from now, shape (H,) [s].
        gains: stiffness and damping of the deviation.
        time_constant: tau, the time constant of the deviation [s].
        obstacle_cost: b, the cost of being near an obstacle.
        max_push: u_max, the largest coupling acceleration [m/s^2].
        units: candidate directions of u, unit vectors in the frame of :func:`~imitarm.policies.headings.frame`, shape
            (k, d).
        max_acceleration: largest acceleration of the deviation by u, spring and damper together [m/s^2].
        discount: gamma, the factor by which the weight decreases from one time of the horizon to the next.
        deviation_weight: w_e, weight of the deviation [1/m^2].
        change_weight: w_Delta, weight of a change of u since the last step.
        size_weight: w_u, weight of the squared norm of u.
        wait_weight: w_r, weight of the difference between r and the learned speed 1.
        rates: candidates for the speed r of the phase; the first is 1, the learned speed.
        sizes: candidates for the norm of u, as fractions of u_max.
    """

    times: Array
    gains: Gains
    time_constant: float
    obstacle_cost: ObstacleCost
    max_push: float
    units: Array
    max_acceleration: float = math.inf
    discount: float = 0.93
    deviation_weight: float = 16.0
    change_weight: float = 0.02
    size_weight: float = 0.02
    wait_weight: float = 2.0
    rates: tuple[float, ...] = (1.0, 0.5, 0.0, -0.5)
    sizes: tuple[float, ...] = (0.2, 0.5, 1.0)

    @cached_property
    def response(self) -> Response:
        """Response of the deviation to u, at the times of the horizon."""
        return Response.of(self.gains, self.time_constant, self.times)

    @cached_property
    def _weights(self) -> Array:
        return np.asarray(self.discount ** np.arange(1.0, len(self.response.G) + 1.0))

    @cached_property
    def _gains(self) -> Array:
        """Deviation at each instant per unit of u / u_max, shape (H,) [m]."""
        return self.max_push * self.response.G

    @cached_property
    def _task(self) -> tuple[Array, Array, float]:
        """Weights of the deviations (H,), the same times the gains (H,), and the sum of the same times the gains."""
        task = self.deviation_weight * self._weights
        pull = task * self._gains
        return task, pull, float(pull.dot(self._gains))

    @cached_property
    def _candidates(self) -> tuple[Array, Array]:
        """All candidates u / u_max in the frame of the motion (C, d), and the cost of their size (C,)."""
        zero = np.zeros((1, self.units.shape[1]))
        scaled = np.concatenate([zero, *[size * self.units for size in self.sizes]])
        return scaled, (self.size_weight + self.change_weight) * np.sum(scaled * scaled, axis=1)

    @cached_property
    def _waiting(self) -> Array:
        """The cost of each speed, shape (R,)."""
        return np.array([self.wait_weight * (1.0 - rate) ** 2 for rate in self.rates])

    def record(self, spheres: Array, one_sided: Array, tool_radius: float, *numbers: float) -> Record:
        """Return the C structure ``LeastCost``; the obstacle cost must be a :class:`DistanceCost`.

        Args:
            spheres: centres of the tool's spheres relative to its tip, shape (S, 3) [m].
            one_sided: directions along which u must have no positive component, shape (m, 3).
            tool_radius: largest distance of the tool's surface from its tip [m].
            numbers: values of the last fields of the structure: ``rate_time`` [s], ``beta``, ``cap`` [m], ``growth``,
                ``growth_cap`` [m] and ``lever`` [m].
        """
        cost, response, (task, pull, curvature) = self.obstacle_cost, self.response, self._task
        assert isinstance(cost, DistanceCost)
        candidates, rates = self._candidates[0], np.array(self.rates)
        sizes = (*(len(x) for x in (self.times, spheres)), *candidates.shape, len(rates), len(one_sided))
        arrays = (self.times, response.A, response.B, self._gains, self._weights, task, pull, candidates)
        more = (one_sided, rates, self._waiting, cost.radii, spheres)
        influence = cost.influence_distance
        factors = (
            curvature,
            self.change_weight,
            self.size_weight + self.change_weight,
            self.max_acceleration / self.max_push,
            cost.clearance,
            cost.width,
            influence,
            tool_radius + self.travel + influence,
            np.abs(response.A - 1.0).max(),
            np.abs(response.B).max(),
            *numbers,
        )
        every = [np.ascontiguousarray(x, dtype=float) for x in (*arrays, *more)]
        return Record(*sizes, *every, *(float(factor) for factor in factors))

    @property
    def travel(self) -> float:
        """Largest deviation that u can cause within the horizon [m]."""
        return float(self._gains[-1])

    def smooth_costs(self, scaled: Array, sizes: Array, previous: Array, free: Array, precision: Array) -> Array:
        """Return a part of the cost J of each of C candidates for u: all terms except those of b and r, shape (C,).

        This part contains the task cost and the costs of the change and the size of u. The task cost is a quadratic
        form in u, so the method does not compute the deviations e of each candidate.

        Args:
            scaled: u / u_max of the candidates, shape (C, 3).
            sizes: cost of the size of each candidate, shape (C,).
            previous: u / u_max of the last choice, shape (3,).
            free: deviations without coupling, shape (H, 3) [m].
            precision: Theta at the current phase, shape (3, 3).
        """
        task, pull, curvature = self._task
        pulled = free.dot(precision)
        constant = 0.5 * float(task.dot(np.add.reduce(pulled * free, axis=1)))
        constant += self.change_weight * float(previous.dot(previous))
        slope = pull.dot(pulled) - 2.0 * self.change_weight * previous
        bent = scaled.dot(precision)
        bent *= scaled
        return np.asarray(scaled.dot(slope) + (0.5 * curvature) * np.add.reduce(bent, axis=1) + (sizes + constant))

    def choose(
        self,
        axes: Array,
        one_sided: Array,
        previous: Array,
        free: Array,
        precision: Array,
        predict: Callable[[Array], Prediction],
        obstacles: PredictedObstacles,
        pull: Array | None = None,
    ) -> Choice:
        """Return the candidate of least cost.

        If a candidate u would accelerate the deviation by more than ``max_acceleration``, it is moved towards ``pull``
        until the acceleration ``u - pull`` has this size.

        Args:
            axes: frame of the motion (:func:`~imitarm.policies.headings.frame`), shape (3, d).
            one_sided: directions along which u must have no positive component, shape (m, 3).
            previous: u / u_max of the last choice, shape (3,).
            free: deviations without coupling, shape (H, 3) [m].
            precision: Theta at the current phase, shape (3, 3).
            predict: function that gets speeds of the phase (R,) and returns the predicted motion without coupling.
            obstacles: the obstacles that may come near.
            pull: acceleration ``D e' / tau + K e / tau^2`` with which spring and damper reduce the deviation, shape
                (3,) [m/s^2]; None: the acceleration is not limited.
        """
        scaled, sizes = self._candidates
        scaled = scaled @ axes.T
        if pull is not None:
            scaled, sizes = self._feasible(scaled, sizes, pull / self.max_push)
        if len(one_sided):
            allowed = (scaled @ one_sided.T <= 1e-9).all(axis=1)
            scaled, sizes = scaled[allowed], sizes[allowed]
        smooth = self.smooth_costs(scaled, sizes, previous, free, precision)
        least, best = float(smooth.min()), None
        for begin, end in ((0, 1), (1, len(self.rates))):
            waiting = self._waiting[begin:end]
            bound = math.inf if best is None else best.cost
            if least + waiting.min(initial=math.inf) > bound:
                break
            prediction = predict(np.array(self.rates[begin:end]))
            found = self._best(scaled, smooth + waiting[:, None], prediction, obstacles, bound)
            if found is not None and found[2] < bound - _TIED:
                rate, index, cost, nearest, gap = found
                best = Choice(scaled[index], self.rates[begin + rate], cost, nearest, gap)
        assert best is not None
        return best

    def _feasible(self, scaled: Array, sizes: Array, pull: Array) -> tuple[Array, Array]:
        """Return candidates whose acceleration, less that of spring and damper, keeps the limit; the first one is 0."""
        change = scaled - pull
        factor = self.max_acceleration / self.max_push / np.sqrt(np.maximum(np.sum(change * change, axis=1), 1e-12))
        factor[0] = 1.0
        if factor.min() >= 1.0:
            return scaled, sizes
        scaled = np.where((factor < 1.0)[:, None], pull + factor[:, None] * change, scaled)
        scaled = scaled / np.maximum(np.sqrt(np.sum(scaled * scaled, axis=1)), 1.0)[:, None]
        return scaled, (self.size_weight + self.change_weight) * np.sum(scaled * scaled, axis=1)

    def _best(
        self, scaled: Array, smooth: Array, prediction: Prediction, obstacles: PredictedObstacles, bound: float
    ) -> tuple[int, int, float, int, float] | None:
        """Return speed, candidate, cost, nearest obstacle and its distance of the best one; None if above ``bound``."""
        n_rates, H, S, _ = prediction.centers.shape
        n, shape = len(obstacles.packed), (n_rates, len(obstacles.packed), H, S)
        centers = prediction.centers.reshape(-1, 3)
        every = _Pairs.all(*shape)
        still = centers[every.center], np.zeros(len(every.key)), scaled[:1]
        gaps = self.obstacle_cost.gaps(obstacles, every.groups, *still)
        free_gaps = gaps.reshape(shape)
        costs = np.full((n_rates, len(scaled)), math.inf)
        values = self.obstacle_cost.values(obstacles, every.groups, *still, gaps).reshape(shape)
        values = values[..., 0] if S == 1 else values.max(axis=3)
        reduction = self._reduction(prediction, obstacles)
        if reduction is not None:
            values = np.maximum(values - reduction, 0.0)
        free = np.add.reduce(values, axis=1) @ self._weights
        costs[:, 0] = smooth[:, 0] + free
        least = min(bound, float(costs[:, 0].min()))
        columns = (smooth.min(axis=0) <= least + _TIED).nonzero()[0]
        columns = columns[columns > 0]
        found: _Evaluated | None = None
        if len(columns):
            found = self._evaluate(scaled[columns], prediction, obstacles, free_gaps, reduction)
            costs[:, columns] = smooth[:, columns] + found.costs
        rate, index = _first_of_best(costs, scaled)
        cost = float(costs[rate, index])
        if cost > bound:
            return None
        if index == 0 or found is None or rate not in found.pairs.rate:
            each = free_gaps[rate].reshape(n, -1).min(axis=1)
            nearest = int(each.argmin())
            return rate, index, cost, nearest, float(each[nearest])
        return rate, index, cost, *found.nearest(rate, int(np.searchsorted(columns, index)))

    def _reduction(self, prediction: Prediction, obstacles: PredictedObstacles) -> Array | None:
        """Return by how much the costs of obstacles are reduced at the end, shape (R, n, H); None before the end."""
        if not prediction.arrived.any():
            return None
        n, H, S = len(obstacles.packed), len(self.times), len(prediction.goal)
        groups = _Pairs.all(1, n, H, S).groups
        still = prediction.goal[groups.sphere], np.zeros(n * H * S), np.zeros((1, 3))
        gaps = self.obstacle_cost.gaps(obstacles, groups, *still)
        values = self.obstacle_cost.values(obstacles, groups, *still, gaps).reshape(n, H, S).max(axis=2)
        keeps = gaps.reshape(n, H, S).min(axis=2) >= self.obstacle_cost.clearance - _TOUCHES
        return np.where(prediction.arrived[:, None] & keeps, values, 0.0)

    def _evaluate(
        self,
        scaled: Array,
        prediction: Prediction,
        obstacles: PredictedObstacles,
        free_gaps: Array,
        reduction: Array | None,
    ) -> _Evaluated:
        """Return the costs of candidates (C, 3), with those pairs only that any candidate can bring near each other."""
        gains, S = self._gains[:, None], free_gaps.shape[3]
        near = free_gaps - gains <= self.obstacle_cost.influence(obstacles.packed)[:, None, None]
        if S > 1:  # a sphere that can't become the nearest one has no effect
            near &= free_gaps <= free_gaps.min(axis=3, keepdims=True) + 2.0 * gains
        pairs = _Pairs.where(near)
        rate, groups = pairs.rate, pairs.groups
        moved = prediction.centers.reshape(-1, 3)[pairs.center], self._gains[groups.instant], scaled
        gaps = self.obstacle_cost.gaps(obstacles, groups, *moved)
        values = self.obstacle_cost.values(obstacles, groups, *moved, gaps)
        key, instant = pairs.key, groups.instant
        if S > 1 and len(rate):
            first = np.flatnonzero(np.diff(key, prepend=-1))
            values = np.maximum.reduceat(values, first, axis=0)
            key, rate, instant = key[first], rate[first], instant[first]
        if reduction is not None:
            values = np.maximum(values - reduction.ravel()[key, None], 0.0)
        weights = np.zeros((len(free_gaps), len(rate)))
        weights[rate, np.arange(len(rate))] = self._weights[instant]
        return _Evaluated(weights @ values, gaps, pairs)


class _Pairs(NamedTuple):
    """Pairs of an obstacle and a sphere at one instant and one speed of the phase.

    Attributes:
        rate: index of the speed, shape (k,).
        groups: obstacle, instant and sphere.
        center: index of the sphere's centre among all (rate, instant, sphere), shape (k,).
        key: number of (rate, obstacle, instant), shape (k,).
    """

    rate: Indices
    groups: Groups
    center: Indices
    key: Indices

    @classmethod
    def of(cls, flat: Indices, n_obstacles: int, horizon: int, spheres: int) -> _Pairs:
        key, sphere = np.divmod(flat, spheres) if spheres > 1 else (flat, np.zeros_like(flat))
        block, instant = np.divmod(key, horizon)
        rate, obstacle = np.divmod(block, n_obstacles)
        return cls(rate, Groups(obstacle, instant, sphere), (rate * horizon + instant) * spheres + sphere, key)

    @classmethod
    def where(cls, chosen: NDArray[np.bool_]) -> _Pairs:
        """Return the pairs for which ``chosen`` (R, n, H, S) is true."""
        return cls.of(chosen.ravel().nonzero()[0], *chosen.shape[1:])

    @staticmethod
    @lru_cache(maxsize=64)
    def all(rates: int, n_obstacles: int, horizon: int, spheres: int) -> _Pairs:
        """Return all pairs, in the order (rate, obstacle, instant, sphere)."""
        return _Pairs.of(np.arange(rates * n_obstacles * horizon * spheres), n_obstacles, horizon, spheres)


class _Evaluated(NamedTuple):
    """Costs of candidates because of obstacles (R, C), and the gaps (k, C) [m] of the pairs that were computed."""

    costs: Array
    gaps: Array
    pairs: _Pairs

    def nearest(self, rate: int, column: int) -> tuple[int, float]:
        """Return the obstacle that comes nearest with one candidate, and its distance [m]."""
        gaps = np.where(self.pairs.rate == rate, self.gaps[:, column], math.inf)
        least = int(gaps.argmin())
        return int(self.pairs.groups.obstacle[least]), float(gaps[least])


def _first_of_best(costs: Array, scaled: Array) -> tuple[int, int]:
    """Return speed and candidate of the least cost; of equal ones, that which leads highest, then the first one."""
    least = float(costs.min())
    rates, tied = (costs <= least + _TIED * max(1.0, abs(least))).nonzero()
    if len(tied) == 1:
        return int(rates[0]), int(tied[0])
    height = scaled[tied, 2]
    first = int((height >= height.max() - _TIED).nonzero()[0][0])
    return int(rates[first]), int(tied[first])
