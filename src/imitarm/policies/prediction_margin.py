r"""PredictionMargin: the additional distance that a plan keeps from an obstacle whose position is only predicted.

The error of a prediction grows with the time :math:`\tau` since the obstacle was last detected. A
:class:`~imitarm.perception.CoverageMargin` bounds this error by :math:`m(\tau) = a + b\,\tau`. With a stated
probability, the bound holds for all :math:`\tau` up to the calibrated horizon. At each time t, a plan keeps the
distance

.. math:: d_i(t) \ge c + m_i(t), \qquad m_i(t) = a + b \min(t + \tau_i, T) .

Here, :math:`d_i` is the distance to the predicted obstacle i, and c is the required clearance. :math:`\tau_i` is the
time between the last detection of the obstacle and the start of the plan (t = 0). T is the horizon: the margin does not
grow after the time T. As long as the prediction is wrong by at most :math:`m_i`, the distance to the true obstacle is
at least c.

The function :math:`m_i` is concave, so on a straight segment of the path, :math:`d_i - m_i` is a convex function of
time, like :math:`d_i` itself. The modules ``certificate`` and ``arm_certificate`` can therefore treat :math:`d_i - m_i`
like a distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.margins import CoverageMargin
from imitarm.scene.distances import PackedObstacles
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, instance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictionMargin:
    """The margin m(t) of one obstacle.

    Attributes:
        offset: margin at time 0 [m].
        growth: growth of the margin with time [m/s].
        until: time from which on the margin is constant [s].
    """

    offset: float
    growth: float
    until: float = np.inf

    def at(self, times: Array) -> Array:
        """Return the margin [m] at each of ``times`` [s]."""
        return np.asarray(self.offset + self.growth * np.minimum(times, self.until))

    def slopes_after(self, times: Array) -> Array:
        """Return the time derivative of the margin [m/s] just after each of ``times`` [s]."""
        return np.where(times < self.until, self.growth, 0.0)

    def slopes_before(self, times: Array) -> Array:
        """Return the time derivative of the margin [m/s] just before each of ``times`` [s]."""
        return np.where(times <= self.until, self.growth, 0.0)


class EstimatedMargin(NamedTuple):
    r"""The margin of RCAMO, which follows from the estimates of the obstacles.

    .. math:: m(t) = \min(\beta \sigma, c) + \min(g\,(|v| + |\omega|\,r)\,t,\ c_g)

    Sigma is the largest standard deviation of the obstacle's observed position. The second term grows with the time t
    since the observation, because the obstacle may change its velocity. The obstacle has the speed ``|v|`` and the
    angular speed ``|omega|``; r is the radius of the sphere around it, but at most ``lever``. If an obstacle has no
    covariance, its motion is known exactly, and its margin is 0.

    Attributes:
        beta: number of standard deviations.
        cap: c, largest first term [m].
        growth: g, fraction of the obstacle's speed.
        growth_cap: c_g, largest second term [m].
        lever: largest r [m]; a half-space has no radius.
    """

    beta: float
    cap: float
    growth: float
    growth_cap: float
    lever: float = 1.0

    def at(self, packed: PackedObstacles, times: Array) -> Array:
        """Return the margin of n obstacles at times (H,) [s] since the observation, shape (n, H) [m]."""
        if not packed.covariances.any():
            return np.zeros((len(packed), len(times)))
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(packed.covariances)[:, -1], 0.0))
        v, omega = packed.velocities, packed.angular_velocities
        speed = np.sqrt(np.sum(omega * omega, axis=1)) * np.minimum(packed.radii, self.lever)
        speed += np.sqrt(np.sum(v * v, axis=1))
        speed = np.where(sigma > 0.0, self.growth * speed, 0.0)
        offset = np.minimum(self.beta * sigma, self.cap)
        return np.asarray(offset[:, None] + np.minimum(speed[:, None] * times, self.growth_cap))


def margins_in(
    scene: Scene, margin: CoverageMargin | None, margin_horizon: float | None
) -> tuple[PredictionMargin | None, ...]:
    """Return the margin of each obstacle of a scene; None for an obstacle whose position is known exactly.

    An obstacle has a margin if it moves, or if a tracker estimates it, so that it has a ``track_id`` or a
    ``covariance``. The positions of all other obstacles are exact.

    Args:
        scene: obstacles at the start of a plan. ``scene.packed.stamps`` contains the time of each obstacle's last
            detection.
        margin: bound of the prediction error; None: predictions count as exact.
        margin_horizon: time after the last detection of an obstacle at which the margin stops growing [s]; None: never.

    Raises:
        InputError: when an argument is not valid.
    """
    if margin is None:
        return (None,) * len(scene.packed)
    offset, growth = instance(margin, CoverageMargin, "margin").offset, margin.growth
    until = np.inf if margin_horizon is None else finite_number(margin_horizon, "margin_horizon", "s", at_least=0.0)
    if margin.is_zero:
        return (None,) * len(scene.packed)
    ages = np.maximum(scene.stamp - scene.packed.stamps, 0.0).tolist()
    return tuple(
        PredictionMargin(offset + growth * min(age, until), growth, max(until - age, 0.0))
        if is_predicted(obstacle)
        else None
        for obstacle, age in zip(scene.obstacles, ages, strict=True)
    )


def is_predicted(obstacle: Obstacle) -> bool:
    """Return whether an obstacle moves or is estimated by a tracker, so that its position is not known exactly."""
    return obstacle.track_id is not None or obstacle.covariance is not None or obstacle.moves
