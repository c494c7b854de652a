"""MotionFilter: Kalman filters of many obstacles, computed together, with one or several models of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.validation import choice, finite_number

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MOTIONS: dict[str, tuple[int, ...]] = {  # order of the highest derivative in the state of each model
    "constant-velocity": (1,),
    "ekf": (1,),
    "constant-acceleration": (2,),
    "imm": (1, 2),
}
DEFAULT_NOISE: dict[str, tuple[float, ...]] = {  # of each model; [m^2/s^3] for order 1, [m^2/s^5] for order 2
    "constant-velocity": (0.05,),
    "ekf": (0.05,),
    "constant-acceleration": (1.0,),
    "imm": (0.02, 30.0),
}
DWELL_TIME = 0.5  # [s] mean time for which an obstacle keeps one model of an IMM
INITIAL_ACCELERATION = 2.0  # [m/s^2] standard deviation of each component of a new obstacle's acceleration


class Belief(NamedTuple):
    """Gaussian estimates of the states of n obstacles; each obstacle has one estimate for each of M models of motion.

    The state of an obstacle contains its position p and velocity v, and its acceleration a if any model uses one. The
    state has m = 6 or 9 components.

    Attributes:
        mean: mean of each state, shape (n, M, m) [m, m/s, m/s^2].
        covariance: covariance of each state, shape (n, M, m, m).
        weights: probability of each model, shape (n, M).
    """

    mean: Array
    covariance: Array
    weights: Array

    def rows(self, rows: Indices | Sequence[int]) -> Belief:
        """Return the beliefs about the obstacles with the indices ``rows``."""
        return Belief(self.mean[rows], self.covariance[rows], self.weights[rows])

    def replaced(self, rows: Indices, other: Belief) -> Belief:
        """Return these beliefs, with the obstacles ``rows`` replaced by the obstacles of ``other``."""
        copied = Belief(*(x.copy() for x in self))
        for array, new in zip(copied, other, strict=True):
            array[rows] = new
        return copied

    def joined(self, other: Belief) -> Belief:
        """Return these beliefs, followed by the beliefs ``other``."""
        return Belief(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def combined(self) -> tuple[Array, Array]:
        """Return mean (n, m) and covariance (n, m, m) of the mixture of all models."""
        if self.mean.shape[1] == 1:
            return self.mean[:, 0], self.covariance[:, 0]
        mean = np.einsum("nk,nki->ni", self.weights, self.mean)
        spread = self.mean - mean[:, None]
        covariance = self.covariance + spread[..., :, None] * spread[..., None, :]
        return mean, np.einsum("nk,nkij->nij", self.weights, covariance)


class Measurements(NamedTuple):
    """Measured positions of obstacles, one row for each obstacle that was measured.

    A measurement of the position ``p`` is ``h(p) + noise``. Without ``rotations``, ``h(p)`` is ``p`` itself. With
    ``rotations``, ``h(p)`` is ``(x/z, y/z, z)``, where x, y and z are the coordinates of the position in the camera's
    frame. The extended Kalman filter uses the Jacobian ``H`` of ``h``.

    Attributes:
        positions: measured positions in the base frame, shape (k, 3) [m].
        noise: covariances ``R`` of the measured positions, shape (k, 3, 3) [m^2].
        rotations: rotation from base to camera for each measurement, shape (k, 3, 3), nan for a measurement without a
            camera; None: no measurement has a camera.
        origins: positions of the cameras, shape (k, 3) [m]; None without cameras.
    """

    positions: Array
    noise: Array
    rotations: Array | None = None
    origins: Array | None = None

    def rows(self, rows: Indices | Sequence[int]) -> Measurements:
        """Return the measurements with the indices ``rows``."""
        if self.rotations is None or self.origins is None:
            return Measurements(self.positions[rows], self.noise[rows])
        return Measurements(self.positions[rows], self.noise[rows], self.rotations[rows], self.origins[rows])

    def innovation(self, predicted: Array) -> tuple[Array, Array | None, Array]:
        """Return the innovation ``z - h(p)``, the Jacobian ``H = dh/dp`` and the noise, in the units of ``h``.

        Args:
            predicted: predicted positions ``p``, shape (k, ..., 3) [m].

        Returns:
            Innovations (k, ..., 3); Jacobians (k, ..., 3, 3), or None for the unit matrix; covariances of the noise (k,
            1..., 3, 3).
        """
        extra = (1,) * (predicted.ndim - 2)
        measured = self.positions.reshape(-1, *extra, 3)
        noise = self.noise.reshape(-1, *extra, 3, 3)
        if self.rotations is None or self.origins is None:
            return measured - predicted, None, noise
        by_camera = np.isfinite(self.rotations[:, 0, 0]).reshape(-1, *extra)
        rotations = np.where(by_camera[..., None, None], self.rotations.reshape(-1, *extra, 3, 3), np.eye(3))
        origins = np.where(by_camera[..., None], self.origins.reshape(-1, *extra, 3), 0.0)
        seen, _, d_seen = _camera_coordinates(measured, rotations, origins)
        expected, ahead, jacobian = _camera_coordinates(predicted, rotations, origins)
        innovation = np.where(ahead[..., None], seen - expected, np.inf)  # nothing is measured behind the camera
        noise_seen = d_seen @ noise @ d_seen.swapaxes(-1, -2)
        direct = ~by_camera
        return (
            np.where(direct[..., None], measured - predicted, innovation),
            np.where(direct[..., None, None], np.eye(3), jacobian),
            np.where(direct[..., None, None], noise, noise_seen),
        )


def _camera_coordinates(points: Array, rotations: Array, origins: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """Return ``(x/z, y/z, z)`` of points (..., 3), whether they are in front, and the Jacobian (..., 3, 3)."""
    q = (rotations @ (points - origins)[..., None])[..., 0]
    ahead = q[..., 2] > 1e-3
    depth = np.where(ahead, q[..., 2], 1.0)
    u, v = q[..., 0] / depth, q[..., 1] / depth
    jacobian = np.zeros((*q.shape, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0 / depth
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -u / depth, -v / depth
    jacobian[..., 2, 2] = 1.0
    return np.stack([u, v, q[..., 2]], axis=-1), ahead, jacobian @ rotations


# entries of a flattened 3x3 matrix: cofactor k is m[A[k]] m[B[k]] - m[C[k]] m[D[k]]
_A, _B, _C, _D = (
    np.array([3 * ((j + a) % 3) + (i + b) % 3 for i in range(3) for j in range(3)])
    for a, b in ((1, 1), (2, 2), (1, 2), (2, 1))
)


def inverse_3x3(matrices: Array) -> tuple[Array, Array]:
    """Return the inverses (..., 3, 3) and determinants (...) of matrices (..., 3, 3), by cofactors."""
    flat = matrices.reshape(-1, 9)
    adjugate = flat.take(_A, axis=1)
    adjugate *= flat.take(_B, axis=1)
    adjugate -= flat.take(_C, axis=1) * flat.take(_D, axis=1)
    determinant = flat[:, 0] * adjugate[:, 0]
    determinant += flat[:, 1] * adjugate[:, 3]
    determinant += flat[:, 2] * adjugate[:, 6]
    adjugate /= determinant[:, None]
    return adjugate.reshape(matrices.shape), determinant.reshape(matrices.shape[:-2])


class Innovation(NamedTuple):
    """Innovations of k measurements (measured minus predicted values), with the matrices that a Kalman filter needs.

    Attributes:
        value: innovation ``nu``, shape (k, ..., 3).
        jacobian: Jacobian ``H`` of the measurement, shape (k, ..., 3, 3); None: the unit matrix.
        noise: covariance ``R`` of the noise in the units of the innovation, shape (k, ..., 3, 3).
        inverse: inverse of the innovation's covariance ``S``, shape (k, ..., 3, 3).
        determinant: determinant of ``S``, shape (k, ...).
    """

    value: Array
    jacobian: Array | None
    noise: Array
    inverse: Array
    determinant: Array

    @classmethod
    def of(cls, positions: Array, covariances: Array, measured: Measurements) -> Innovation:
        """Return the innovations of predicted positions (k, ..., 3) with covariances (k, ..., 3, 3)."""
        value, jacobian, noise = measured.innovation(positions)
        S = covariances if jacobian is None else jacobian @ covariances @ jacobian.swapaxes(-1, -2)
        return cls(value, jacobian, noise, *inverse_3x3(S + noise))

    @property
    def squared(self) -> Array:
        """Normalised innovations squared ``nu' S^-1 nu``, shape (k, ...)."""
        with np.errstate(invalid="ignore"):  # behind the camera, the innovation is infinite
            weighted = (self.value[..., None, :] @ self.inverse)[..., 0, :]
            weighted *= self.value
        squared = np.add.reduce(weighted, axis=-1)
        return np.where(np.isnan(squared), np.inf, squared) if self.jacobian is not None else squared

    def rows(self, rows: Indices) -> Innovation:
        """Return the innovations with the indices ``rows``."""
        jacobian = None if self.jacobian is None else self.jacobian[rows]
        return Innovation(self.value[rows], jacobian, self.noise[rows], self.inverse[rows], self.determinant[rows])


class MotionFilter:
    """Kalman filters of all obstacles, computed together: every operation acts on the arrays of all obstacles.

    A model of order 1 assumes a constant velocity (thesis Eq 5.2, with the noise written as a covariance). Its state is
    ``x = [p; v]``. White noise with the spectral density ``q`` [m^2/s^3] disturbs each component of the velocity ``v``.
    Over a time ``dt``::

        F = [I, dt I; 0, I]        Q = q [dt^3/3 I, dt^2/2 I; dt^2/2 I, dt I]
        x <- F x                   P <- F P F' + Q

    A model of order 2 assumes a constant acceleration. Its state also contains the acceleration. White noise with the
    spectral density ``q`` [m^2/s^5] disturbs the acceleration. A measured position ``z`` with the covariance ``R``
    changes the state as follows, where ``H = [I, 0]``::

        S = H P H' + R    K = P H' S^-1    x <- x + K (z - H x)    P <- (I - K H) P (I - K H)' + K R K'

    An interacting multiple model (IMM) filter runs several models and weights them by the likelihood of the
    measurements. Before each prediction, the filter mixes the states of the models, because the obstacle's motion may
    change from one model to another. The IMM filter assumes that an obstacle changes its model after ``DWELL_TIME`` [s]
    on average.

    Attributes:
        orders: order of each model: 1 for constant velocity, 2 for constant acceleration.
        noise: spectral density ``q`` of each model [m^2/s^3 for order 1, m^2/s^5 for order 2].
        initial_speed: standard deviation of each component of a new obstacle's velocity [m/s].
        size: number ``m`` of components of the state.
        variances: variances of each component of a new obstacle's velocity and acceleration [m^2/s^2, m^2/s^4].
    """

    def __init__(self, motion: str, noise: float | Sequence[float] | None, initial_speed: float) -> None:
        """Check the arguments; see :class:`~imitarm.perception.ObstacleTracker`."""
        self.orders = MOTIONS[choice(motion, MOTIONS, "motion")]
        self.noise = DEFAULT_NOISE[motion] if noise is None else _checked_noise(noise, self.orders)
        self.initial_speed = finite_number(initial_speed, "ObstacleTracker: initial_speed", "m/s", above=0.0)
        self.size = m = 3 * (max(self.orders) + 1)
        models = len(self.orders)
        self._motion = np.zeros((max(self.orders) + 1, models, m, m))  # F = sum_i dt^i F_i
        self._noise = np.zeros((2 * max(self.orders) + 1, models, m, m))  # Q = sum_i dt^(i+1) Q_i
        for k, (order, q) in enumerate(zip(self.orders, self.noise, strict=True)):
            self._fill(k, order, q)
        self._powers = np.arange(len(self._noise) + 1)
        self._unit = np.eye(m)
        self.variances = self.initial_speed**2, INITIAL_ACCELERATION**2

    def _fill(self, k: int, order: int, q: float) -> None:
        """Fill in the matrices of model ``k``; entry ``i, j`` of F is ``dt^(j-i) / (j-i)!``."""
        eye = np.eye(3)
        for i in range(order + 1):
            for j in range(order + 1):
                block = (k, slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3))
                if j >= i:
                    self._motion[(j - i, *block)] = eye / math.factorial(j - i)
                left, right = order - i, order - j  # noise enters the highest derivative and is integrated
                power = left + right + 1
                factor = q / (math.factorial(left) * math.factorial(right) * power)
                self._noise[(power - 1, *block)] = factor * eye

    def transition(self, dt: float) -> tuple[Array, Array]:
        """Return ``F`` and ``Q`` of each model over a time ``dt`` [s], shape (M, m, m); Q grows with ``|dt|``."""
        ahead = abs(dt)
        powers = ahead**self._powers
        shape = self._motion.shape[1:]
        Q = (powers[1:] @ self._noise.reshape(len(self._noise), -1)).reshape(shape)
        if dt < 0.0:
            powers, Q = dt**self._powers, _mirrored(Q)
        F = powers[: len(self._motion)] @ self._motion.reshape(len(self._motion), -1)
        return F.reshape(shape), Q

    def born(self, positions: Array, noise: Array) -> Belief:
        """Return the beliefs about new obstacles at measured positions (k, 3) [m] with covariances (k, 3, 3) [m^2]."""
        k, models, m = len(positions), len(self.orders), self.size
        mean, covariance = np.zeros((k, models, m)), np.zeros((k, models, m, m))
        mean[..., :3] = positions[:, None]
        covariance[..., :3, :3] = noise[:, None]
        variances = 0.0, *self.variances
        for model, order in enumerate(self.orders):
            for i in range(3, 3 * (order + 1)):
                covariance[:, model, i, i] = variances[i // 3]
        return Belief(mean, covariance, np.full((k, models), 1.0 / models))

    def predict(self, belief: Belief, dt: float) -> Belief:
        """Return the beliefs ``dt`` [s] later, or earlier if ``dt`` is negative."""
        if dt == 0.0 or not len(belief.mean):
            return belief
        F, Q = self.transition(dt)
        mean, covariance, weights = belief if len(self.orders) == 1 else self._mixed(belief, dt)
        transposed = F.swapaxes(-1, -2)
        mean = (mean[..., None, :] @ transposed)[..., 0, :]
        return Belief(mean, F @ covariance @ transposed + Q, weights)

    def _mixed(self, belief: Belief, dt: float) -> Belief:
        """Return the beliefs with which each model of an IMM starts its prediction."""
        stay = math.exp(-abs(dt) / DWELL_TIME)
        models = len(self.orders)
        change = stay * np.eye(models) + (1.0 - stay) / models  # row: model before, column: model after
        weights = belief.weights @ change
        share = belief.weights[:, :, None] * change / weights[:, None, :]  # (n, before, after)
        mean = np.einsum("nij,nik->njk", share, belief.mean)
        spread = belief.mean[:, :, None] - mean[:, None]  # (n, before, after, m)
        covariance = np.einsum("nij,nikl->njkl", share, belief.covariance)
        covariance += np.einsum("nij,nijk,nijl->njkl", share, spread, spread)
        return Belief(mean, covariance, weights)

    def update(self, belief: Belief, measured: Measurements, innovation: Innovation | None = None) -> Belief:
        """Return the beliefs after each obstacle has been measured once.

        Matrices with 3 rows or columns are padded to the size of the state. NumPy multiplies such contiguous matrices
        faster than parts of larger matrices.

        Args:
            belief: beliefs about k obstacles.
            measured: k measurements, one of each obstacle.
            innovation: innovations of these measurements; None: they are computed. With several models, they are always
                computed.
        """
        mean, P, weights = belief
        if innovation is None or len(self.orders) > 1:
            innovation = Innovation.of(mean[..., :3], P[..., :3, :3], measured)
        else:
            innovation = Innovation(*(None if x is None else x[:, None] for x in innovation))  # type: ignore[arg-type]
        inverse, noise = self._padded(innovation.inverse, P), self._padded(innovation.noise, P)
        if innovation.jacobian is None:
            K, transposed = P @ inverse, inverse @ P
            A, A_transposed = self._unit - K, self._unit - transposed
        else:
            H = self._padded(innovation.jacobian, P)
            transposed = inverse @ (H @ P)
            K = np.ascontiguousarray(transposed.swapaxes(-1, -2))
            A = self._unit - K @ H
            A_transposed = np.ascontiguousarray(A.swapaxes(-1, -2))
        mean = mean + (innovation.value[..., None, :] @ transposed[..., :3, :])[..., 0, :]
        P = A @ P @ A_transposed
        P += K @ noise @ transposed
        if len(self.orders) > 1:
            log = -0.5 * (innovation.squared + np.log(innovation.determinant))
            weights = weights * np.exp(log - log.max(axis=1, keepdims=True))
            weights = np.maximum(weights / weights.sum(axis=1, keepdims=True), 1e-6)
            weights /= weights.sum(axis=1, keepdims=True)
        return Belief(mean, P, weights)

    def _padded(self, matrices: Array, like: Array) -> Array:
        """Return matrices (k, ..., 3, 3) in the upper left corner of zero matrices of the shape of ``like``."""
        padded = np.zeros(like.shape)
        padded[..., :3, :3] = matrices
        return padded


def _mirrored(Q: Array) -> Array:
    """Return the noise of a step back in time: the velocities of both ends are correlated with the other sign."""
    sign = np.where(np.arange(Q.shape[-1]) // 3 % 2 == 0, 1.0, -1.0)
    return Q * sign[:, None] * sign


def _checked_noise(noise: float | Sequence[float], orders: tuple[int, ...]) -> tuple[float, ...]:
    given = list(noise) if isinstance(noise, Sequence) else [noise]
    if len(given) != len(orders):
        raise InputError(
            f"ObstacleTracker: process_noise must have {len(orders)} number(s), one for each model of motion, got "
            f"{noise!r}"
        )
    units = ("", "m^2/s^3", "m^2/s^5")
    return tuple(
        finite_number(q, "ObstacleTracker: process_noise", units[order], at_least=0.0)
        for q, order in zip(given, orders, strict=True)
    )
