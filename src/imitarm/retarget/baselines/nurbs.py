"""NURBS: rational spline curves (thesis Eq 3.6 and 3.7), and their fit to noisy samples of a motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack
from scipy.optimize import brentq, minimize_scalar

from imitarm.errors import InputError

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Smoothing = float | str

SMOOTHINGS = ("gcv", "morozov")
"""Names of the rules that choose the weight mu of the smoothing."""

_MU = (-6.0, 6.0)  # decades to search
_HUBER, _PASSES = 2.5, 3  # an outlier is farther than 2.5 sigma; number of reweightings
_MAD = 1.4826  # median absolute deviation to standard deviation
_WEIGHTS = (0.2, 5.0)  # of rational curves
_RATIONAL_PASSES = 3


def basis_functions(knots: Array, degree: int, u: ArrayLike) -> tuple[Indices, Array]:
    r"""Return the values of the non-zero B-spline basis functions (thesis Eq 3.7, corrected).

    .. math::
        N_{i,0}(u) = \begin{cases} 1 & u_i \le u < u_{i+1} \\ 0 & \text{else} \end{cases} \qquad
        N_{i,p}(u) = \frac{u - u_i}{u_{i+p} - u_i} N_{i,p-1}(u)
        + \frac{u_{i+p+1} - u}{u_{i+p+1} - u_{i+1}} N_{i+1,p-1}(u)

    where 0/0 = 0. The last knot span includes its right end, so that the last function is 1 at the end of the curve. At
    every ``u``, only p + 1 functions are non-zero, and only these are computed.

    Args:
        knots: non-decreasing knots, shape (m,); the first degree + 1 knots are equal, and the last degree + 1 knots are
            equal.
        degree: degree p of the curve.
        u: parameters, shape (k,); values outside the range of the knots are clipped.

    Returns:
        The index of the first non-zero function at each parameter, shape (k,); and the values of this function and of
        the following ``degree`` functions, shape (k, degree + 1).
    """
    at = np.minimum(np.maximum(np.asarray(u, dtype=float), knots[degree]), knots[-degree - 1])
    span = np.searchsorted(knots[degree + 1 : -degree - 1], at, side="right") + degree
    values = np.zeros((len(at), degree + 1))
    values[:, 0] = 1.0
    for p in range(1, degree + 1):
        carried: Array = np.zeros(len(at))
        for j in range(p):
            right, left = knots[span + j + 1], knots[span + j + 1 - p]
            part = values[:, j] / (right - left)
            values[:, j] = carried + (right - at) * part
            carried = (at - left) * part
        values[:, p] = carried
    return span - degree, values


@dataclass(frozen=True, eq=False)
class NURBS:
    r"""A non-uniform rational B-spline curve (thesis Eq 3.6; Piegl and Tiller, The NURBS Book).

    .. math:: C(u) = \frac{\sum_i N_{i,p}(u)\, w_i P_i}{\sum_i N_{i,p}(u)\, w_i}

    :math:`N_{i,p}` are the functions of :func:`basis_functions` with the knots
    :math:`\{a, \dots, a, u_{p+1}, \dots, u_{m-p-1}, b, \dots, b\}`, in which a and b are repeated p + 1 times; the last
    knot has the index m. For a curve that is fitted to a motion, the parameter u is the time [s].

    Attributes:
        knots: the knots, not decreasing, shape (n + degree + 1,).
        control_points: control points P, shape (n, d).
        weights: weights w of the control points, positive, shape (n,).
        degree: degree p, at least 1.

    Raises:
        InputError: when shapes do not match, a weight is not positive, or the knots are not as described above.
    """

    knots: Array
    control_points: Array
    weights: Array
    degree: int = 3

    def __post_init__(self) -> None:
        knots, points, weights = (np.array(x, dtype=float) for x in (self.knots, self.control_points, self.weights))
        p, n = self.degree, len(points)
        if p < 1 or points.ndim != 2 or n < p + 1 or weights.shape != (n,) or knots.shape != (n + p + 1,):
            raise InputError(
                f"NURBS: degree {p} needs n >= {p + 1} control points (n, d), n weights and n + {p + 1} knots; "
                f"got control points {points.shape}, weights {weights.shape} and knots {knots.shape}"
            )
        if not (np.isfinite(knots).all() and np.isfinite(points).all()):
            raise InputError("NURBS: knots and control points must be finite numbers")
        if not (np.diff(knots) >= 0.0).all() or knots[p] != knots[0] or knots[-p - 1] != knots[-1]:
            raise InputError(f"NURBS: knots must not decrease; the first and the last must be repeated {p + 1} times")
        if not (knots[p + 1 :] > knots[: -p - 1]).all():
            raise InputError(
                f"NURBS: a knot inside the curve is repeated more than {p} times, so the curve would be discontinuous"
            )
        if not (np.isfinite(weights) & (weights > 0.0)).all():
            raise InputError("NURBS: weights must be positive")
        for name, value in (("knots", knots), ("control_points", points), ("weights", weights)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def domain(self) -> tuple[float, float]:
        """The smallest and the largest parameter u of the curve."""
        return float(self.knots[0]), float(self.knots[-1])

    def evaluate(self, u: ArrayLike) -> Array:
        """Return the points of the curve at ``u`` (k,), shape (k, d); beyond its ends, the curve is constant.

        If ``u`` is a single number, the result is one point, shape (d,).
        """
        at = np.asarray(u, dtype=float)
        first, values = basis_functions(self.knots, self.degree, at.reshape(-1))
        near = first[:, None] + np.arange(self.degree + 1)
        weighted = values * self.weights[near]
        points = (weighted[:, None, :] @ self.control_points[near])[:, 0] / weighted.sum(axis=1, keepdims=True)
        return np.asarray(points.reshape(*at.shape, points.shape[1]))

    def derivative(self, u: ArrayLike, order: int = 1) -> Array:
        r"""Return a derivative of the curve with respect to its parameter at ``u`` (k,), shape (k, d).

        With :math:`A = \sum N_i w_i P_i` and :math:`W = \sum N_i w_i`, the derivative of order r is :math:`C^{(r)} =
        \frac1W \bigl(A^{(r)} - \sum_{j=1}^r \binom rj W^{(j)} C^{(r-j)}\bigr)`.

        Args:
            u: parameters, shape (k,), or a single number, for which the result has the shape (d,). Values beyond the
                ends of the curve are clipped.
            order: order r of the derivative, from 0 (the point itself) to ``degree``.

        Raises:
            InputError: when the order is out of range.
        """
        if not 0 <= order <= self.degree:
            raise InputError(f"NURBS.derivative: order must be 0 to {self.degree}, got {order!r}")
        at = np.asarray(u, dtype=float)
        flat = at.reshape(-1)
        table = np.column_stack([self.control_points * self.weights[:, None], self.weights])
        knots, parts = self.knots, []
        found: list[Array] = []
        for r in range(order + 1):
            first, values = basis_functions(knots, self.degree - r, flat)
            parts.append(np.einsum("ka,kad->kd", values, table[first[:, None] + np.arange(self.degree - r + 1)]))
            if r < order:
                wide = knots[self.degree - r + 1 : -1] - knots[1 : -(self.degree - r) - 1]
                slope = np.divide(self.degree - r, wide, out=np.zeros_like(wide), where=wide > 0.0)  # 0/0 = 0
                table = slope[:, None] * np.diff(table, axis=0)
                knots = knots[1:-1]
        bottom = parts[0][:, -1:]
        for r in range(order + 1):
            top = parts[r][:, :-1]
            for j in range(1, r + 1):
                top = top - math.comb(r, j) * parts[j][:, -1:] * found[r - j]
            found.append(top / bottom)
        return found[order].reshape(*at.shape, self.control_points.shape[1])


def averaged_knots(u: Array, n_control: int, degree: int) -> Array:
    """Return knots that are distributed like the data, with data in every knot span (Piegl and Tiller, Eq 9.69).

    Args:
        u: parameters of the data, increasing, shape (k,), with k at least ``n_control``.
        n_control: number of control points.
        degree: degree of the curve.

    Returns:
        The knots, shape (n_control + degree + 1,).
    """
    inner = np.arange(1, n_control - degree) * (len(u) / (n_control - degree))
    i = inner.astype(int)
    fraction = inner - i
    between = (1.0 - fraction) * u[i - 1] + fraction * u[i]
    return np.concatenate([np.full(degree + 1, u[0]), between, np.full(degree + 1, u[-1])])


class _Problem:
    """Data of a fit: samples, basis functions, and what the normal equations contain besides the confidences."""

    def __init__(self, first: Indices, values: Array, points: Array, rows: Array) -> None:
        self.first, self.values, self.points, self.rows = first, values, points, rows
        self.n_control = n_control = len(rows) + 2
        self.order, self.dim = order, dim = values.shape[1], points.shape[1]
        self.reached = first[:, None] + np.arange(order)  # control points that each sample depends on
        pairs = [(a, b) for a in range(order) for b in range(a + 1)]
        a, b = (np.array(x) for x in zip(*pairs, strict=True))
        self._cells = ((a - b) * n_control + self.reached[:, b]).ravel()
        self._products = values[:, a] * values[:, b]
        self._places = (self.reached[:, :, None] * dim + np.arange(dim)).ravel()
        self._moments = (values[:, :, None] * points[:, None, :]).reshape(len(first), -1)
        self.bend = _bend_band(rows, order)

    def normal(self, confidence: Array) -> tuple[Array, Array]:
        """Return the lower band of R^T C R, shape (degree + 1, n), and R^T C Q, shape (n, d).

        R contains the basis functions at the samples, C the confidences (diagonal), and Q the sample points.
        """
        c, n, order, dim = confidence[:, None], self.n_control, self.order, self.dim
        band = np.bincount(self._cells, (c * self._products).ravel(), order * n)
        right = np.bincount(self._places, (c * self._moments).ravel(), n * dim)
        return np.asarray(band.reshape(order, n), dtype=float), np.asarray(right.reshape(n, dim), dtype=float)

    def residual(self, control: Array) -> Array:
        """Return R P - Q, shape (k, d)."""
        return np.asarray((self.values[:, None, :] @ control[self.reached])[:, 0] - self.points)

    def with_weights(self, weights: Array) -> _Problem:
        """Return the data of the same samples for a rational curve with weights (n,)."""
        weighted = self.values * weights[self.reached]
        return _Problem(self.first, weighted / weighted.sum(axis=1, keepdims=True), self.points, self.rows)


def fit_nurbs(
    times: ArrayLike,
    points: ArrayLike,
    confidence: ArrayLike | None = None,
    *,
    degree: int = 3,
    n_control: int | None = None,
    smoothing: Smoothing = "gcv",
    sigma: float | None = None,
    robust: bool = True,
    rational: bool = False,
) -> NURBS:
    r"""Fit a curve to a motion, with each sample weighted by its confidence (docs/thesis_map.md).

    .. math:: \min_P \sum_k c_k \Bigl|\sum_i R_{ik} P_i - Q_k\Bigr|^2 + \mu \sum_j |(D P)_j|^2,
        \qquad R_{ik} = \frac{N_i(t_k)\, w_i}{\sum_j N_j(t_k)\, w_j}

    Here, :math:`Q_k` are the samples at the times :math:`t_k` and :math:`c_k` their confidences. D is the matrix of
    second differences from :func:`bends`, so the second term makes the curve smooth. The parameter of the curve is the
    time instead of the chord length, because the speed is a part of the motion. The computing time grows linearly with
    the number of samples, except for the rule ``"gcv"``, which needs the inverse of a matrix.

    Args:
        times: times of the samples, strictly increasing, shape (k,) [s].
        points: samples Q, shape (k, d); a sample with the confidence 0 is ignored and may be nan.
        confidence: confidence c of each sample, 0 to 1, shape (k,); None: all 1.
        degree: degree p of the curve.
        n_control: number of control points; None: k/4 + p, for k samples and degree p.
        smoothing: the weight :math:`\mu`, or a rule that chooses it. ``"gcv"``: generalised cross-validation, for
            independent errors. ``"morozov"``: the weight with which the root mean square of the residuals on one axis
            equals ``sigma``.
        sigma: standard deviation of the samples' errors on each axis, in the unit of the points; None: it is estimated
            from the residuals.
        robust: whether samples farther than 2.5 ``sigma`` from the curve get a smaller weight (Huber weights).
        rational: whether to fit the weights w, too, with values between 0.2 and 5 and the mean 1. If False, all weights
            w are 1. Only exact circular arcs need other weights.

    Raises:
        InputError: when shapes do not match, times do not increase, fewer than p + 1 samples have a confidence above 0,
            or an option is invalid.
    """
    t, q, c = _checked(times, points, confidence, degree)
    _check_options(smoothing, sigma)
    used_times = t[c > 0.0]
    n = min(math.ceil(len(t) / 4) + degree, len(used_times)) if n_control is None else n_control
    if not degree + 1 <= n <= len(used_times):
        raise InputError(
            f"fit_nurbs: n_control must be {degree + 1} to {len(used_times)}, the number of samples "
            f"with confidence above 0, got {n}"
        )
    knots = averaged_knots(used_times, n, degree)
    knots[: degree + 1], knots[-degree - 1 :] = t[0], t[-1]
    first, values = basis_functions(knots, degree, t)
    problem = _Problem(first, values, q, bends(knots, degree))
    used = c
    mu = _strength(problem, c, smoothing, sigma)
    control = _solve(problem, c, mu)
    for _ in range(_PASSES if robust else 0):
        away = problem.residual(control)
        least = _MAD * float(np.median(np.abs(away[c > 0.0]))) if sigma is None else sigma
        used = c * _huber(away, _HUBER * least)
        control = _solve(problem, used, mu)
    if robust and isinstance(smoothing, str):
        mu = _strength(problem, used, smoothing, sigma)
        control = _solve(problem, used, mu)
    weights = np.ones(n)
    if rational:
        weights = _rational_weights(problem, used, mu)
        problem = problem.with_weights(weights)
        control = _solve(problem, used, mu)
    return NURBS(knots, control, weights, degree)


def _checked(
    times: ArrayLike, points: ArrayLike, confidence: ArrayLike | None, degree: int
) -> tuple[Array, Array, Array]:
    t, q = np.asarray(times, dtype=float), np.array(points, dtype=float)
    c = np.ones(len(t)) if confidence is None else np.array(confidence, dtype=float)
    if t.ndim != 1 or q.ndim != 2 or len(q) != len(t) or c.shape != t.shape:
        raise InputError(f"fit_nurbs: needs times (k,), points (k, d) and confidence (k,), got {t.shape}, {q.shape}")
    if degree < 2:
        raise InputError(f"fit_nurbs: degree must be at least 2, or the speed is discontinuous; got {degree!r}")
    if not (np.isfinite(t).all() and (np.diff(t) > 0.0).all()):
        raise InputError(
            "fit_nurbs: times must be finite and strictly increasing; sort them and remove repeated frames"
        )
    if not ((c >= 0.0) & (c <= 1.0)).all():
        raise InputError("fit_nurbs: confidence must be between 0 and 1")
    if int((c > 0.0).sum()) < degree + 1:
        raise InputError(
            f"fit_nurbs: degree {degree} needs {degree + 1} samples of confidence above 0, got {int((c > 0.0).sum())}"
        )
    q[c == 0.0] = 0.0
    if not np.isfinite(q).all():
        raise InputError("fit_nurbs: points must be finite where their confidence is above 0")
    return t, q, c


def _check_options(smoothing: Smoothing, sigma: float | None) -> None:
    if isinstance(smoothing, str) and smoothing not in SMOOTHINGS:
        raise InputError(f"fit_nurbs: smoothing must be a number or one of {SMOOTHINGS}, got {smoothing!r}")
    if not isinstance(smoothing, str) and not 0.0 <= smoothing < math.inf:
        raise InputError(f"fit_nurbs: smoothing must not be negative, got {smoothing!r}")
    if sigma is not None and not 0.0 < sigma < math.inf:
        raise InputError(f"fit_nurbs: sigma must be positive, got {sigma!r}")
    if smoothing == "morozov" and sigma is None:
        raise InputError("fit_nurbs: smoothing='morozov' needs sigma, the standard deviation of a sample")


def bends(knots: Array, degree: int) -> Array:
    r"""Return the coefficients of the second differences D, shape (n - 2, 3); row i acts on control points i, i+1, i+2.

    Each control point corresponds to the parameter :math:`g_j = (u_{j+1} + \dots + u_{j+p}) / p`, the mean of p knots.
    Near the ends of the curve, the parameters :math:`g_j` are closer together than elsewhere. Plain differences
    :math:`P_{j+1} - 2 P_j + P_{j-1}` would therefore not be zero there for a straight uniform motion, so a fit would
    slow this motion down. The second differences are divided differences instead, with j = i + 1:

    .. math:: h \left( \frac{P_{j+1} - P_j}{g_{j+1} - g_j} - \frac{P_j - P_{j-1}}{g_j - g_{j-1}} \right)

    Here, h is the mean distance between successive :math:`g_j`. For uniform knots, the result is the same as plain
    differences.
    """
    means = np.convolve(knots[1:-1], np.full(degree, 1.0 / degree), "valid")
    apart = np.diff(means)
    ratio = apart.mean() / apart
    return np.column_stack([ratio[:-1], -ratio[:-1] - ratio[1:], ratio[1:]])


def _bend_band(rows: Array, order: int) -> Array:
    """Return the lower band of the matrix D^T D, shape (order, n)."""
    n = len(rows) + 2
    band = np.zeros((order, n))
    for shift in range(3):
        for j in range(3 - shift):
            band[shift, j : n - 2 + j] += rows[:, j] * rows[:, j + shift]
    return band


def _system(problem: _Problem, confidence: Array, mu: float) -> tuple[Array, Array, Array]:
    band, right = problem.normal(confidence)
    system = band + mu * problem.bend
    system[0] += 1e-12 * float(system[0].max())  # stays finite where there are no samples and no smoothing
    return band, system, right


def _solve(problem: _Problem, confidence: Array, mu: float) -> Array:
    _, system, right = _system(problem, confidence, mu)
    return np.asarray(lapack.dpbsv(system, right, lower=1)[1])


def _huber(residual: Array, delta: float) -> Array:
    length = np.sqrt(np.sum(residual * residual, axis=1))
    return np.asarray(np.minimum(1.0, delta / np.maximum(length, 1e-300)))


def _strength(problem: _Problem, confidence: Array, smoothing: Smoothing, sigma: float | None) -> float:
    """Return mu."""
    if not isinstance(smoothing, str):
        return float(smoothing)
    if smoothing == "morozov":
        assert sigma is not None
        total, dim = float(confidence.sum()), problem.points.shape[1]

        def excess(decade: float) -> float:
            away = problem.residual(_solve(problem, confidence, 10.0**decade))
            return math.sqrt(float(confidence @ np.sum(away * away, axis=1)) / (total * dim)) - sigma

        low, high = excess(_MU[0]), excess(_MU[1])
        if low >= 0.0 or high <= 0.0:  # the residual can't be that small or that large
            return float(10.0 ** (_MU[0] if low >= 0.0 else _MU[1]))
        return float(10.0 ** brentq(excess, *_MU, xtol=0.02))
    return _cross_validated(problem, confidence)


def _cross_validated(problem: _Problem, confidence: Array) -> float:
    r"""Return the mu with the lowest score of generalised cross-validation.

    The score is :math:`k\,RSS / (k - \mathrm{tr} H)^2` for k samples, the residual sum of squares RSS, and the
    smoothing matrix H, which maps the samples to the points of the curve.
    """
    count = float((confidence > 0.0).sum())
    eye = np.eye(problem.n_control)

    def score(decade: float) -> float:
        band, system, right = _system(problem, confidence, 10.0**decade)
        both = lapack.dpbsv(system, np.column_stack([right, eye]), lower=1)[1]
        control, inverse = both[:, : right.shape[1]], both[:, right.shape[1] :]
        trace = float(band[0] @ np.diagonal(inverse))
        for shift in range(1, len(band)):
            trace += 2.0 * float(band[shift, :-shift] @ np.diagonal(inverse, -shift))
        away = problem.residual(control)
        return float(confidence @ np.sum(away * away, axis=1)) / max(count - trace, 1e-6) ** 2

    return _least(score)


def _least(score: Callable[[float], float]) -> float:
    """Return ``10**d`` with the lowest ``score(d)``; whole numbers d are tried first, then values near the best one."""
    decades = np.arange(_MU[0], _MU[1] + 0.5)
    best = float(decades[int(np.argmin([score(float(d)) for d in decades]))])
    finer = minimize_scalar(score, bounds=(best - 1.0, best + 1.0), method="bounded", options={"xatol": 0.1})
    return float(10.0 ** float(finer.x))


def _rational_weights(problem: _Problem, confidence: Array, mu: float) -> Array:
    r"""Return the weights w (n,), with mean 1, from a least-squares problem.

    Let :math:`W_k` be the denominator of the curve at sample k with the previous weights. The cost :math:`\sum_k
    \frac{c_k}{W_k^2} |\sum_i N_i X_i - Q_k \sum_i N_i w_i|^2` with :math:`X_i = w_i P_i` is quadratic in X and w. X is
    eliminated. If the cost has several minima, the function returns the weights closest to 1.
    """
    n = problem.n_control
    basis = np.zeros((len(problem.first), n))
    np.put_along_axis(basis, problem.reached, problem.values, axis=1)
    middle = problem.points - problem.points.mean(axis=0)  # independent of the origin
    weights = np.ones(n)
    bend = np.zeros((n - 2, n))
    np.put_along_axis(bend, np.arange(n - 2)[:, None] + np.arange(3), problem.rows, axis=1)
    stiff = mu * bend.T @ bend
    for _ in range(_RATIONAL_PASSES):
        scaled = (confidence / np.square(basis @ weights))[:, None] * basis
        inverse = np.linalg.pinv(basis.T @ scaled + stiff)
        cost = np.zeros((n, n))
        for axis in middle.T:
            cross = scaled.T @ (axis[:, None] * basis)
            cost += (np.square(axis)[:, None] * scaled).T @ basis - cross.T @ inverse @ cross
        near = 1e-9 * np.trace(cost) / n + 1e-300
        weights = np.linalg.solve(cost + near * np.eye(n), near * np.ones(n))
        weights = np.clip(weights / weights.mean(), *_WEIGHTS) if weights.mean() != 0.0 else np.ones(n)
    return weights
