r"""The distance that a plan keeps in addition to its clearance, because the motion of an obstacle is only predicted.

The error of a prediction grows with the time :math:`\tau` since the obstacle was seen. A
:class:`~imitarm.perception.CoverageMargin` bounds the error by :math:`m(\tau) = a + b\,\tau`, with a stated
probability for all :math:`\tau` up to the horizon for which it was calibrated. A plan keeps at each time t

.. math:: d_i(t) \ge c + m_i(t), \qquad m_i(t) = a + b \min(t + \tau_i, T) .

Here :math:`d_i` is the distance to the predicted obstacle i, c the clearance, :math:`\tau_i` the age of the estimate at
time 0, and T the horizon, beyond which the margin no longer grows. As long as the prediction is wrong by at most
:math:`m_i`, the distance to the true obstacle is at least c.

The function :math:`m_i` is concave, so :math:`d_i - m_i` is a convex function of the time on a straight segment of the
path, as :math:`d_i` is. The certificates therefore hold for :math:`d_i - m_i` without change, with the slopes of
:math:`m_i` on the two sides of a sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.margins import CoverageMargin
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
        until: time after which the margin does not grow [s].
    """

    offset: float
    growth: float
    until: float = np.inf

    def at(self, times: Array) -> Array:
        """Return m at times [s], of the same shape [m]."""
        return np.asarray(self.offset + self.growth * np.minimum(times, self.until))

    def slopes_after(self, times: Array) -> Array:
        """Return the derivative of m just after times [s], of the same shape [m/s]."""
        return np.where(times < self.until, self.growth, 0.0)

    def slopes_before(self, times: Array) -> Array:
        """Return the derivative of m just before times [s], of the same shape [m/s]."""
        return np.where(times <= self.until, self.growth, 0.0)


def margins_in(
    scene: Scene, margin: CoverageMargin | None, margin_horizon: float | None
) -> tuple[PredictionMargin | None, ...]:
    """Return the margin of each obstacle of a scene; None for an obstacle whose place is known.

    A margin applies to an obstacle that a tracker estimates (with a ``track_id`` or a ``covariance``), and to one that
    moves. The scene states where all others are.

    Args:
        scene: obstacles at the time at which a plan begins. ``scene.packed.stamps`` says when each was seen.
        margin: bound of the error of predictions; None: predictions are exact.
        margin_horizon: time since an obstacle was seen after which the margin does not grow [s]; None: it always grows.

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
    """Return whether the place of an obstacle is only estimated, because it was tracked or because it moves."""
    return obstacle.track_id is not None or obstacle.covariance is not None or obstacle.moves
