r"""Rates at which the distance from an arm to an obstacle may shrink, so that the arm can still brake or yield.

Let h be the distance that remains before the required clearance is reached [m], and w the rate at which it shrinks
[m/s]. A command takes effect after the delay T [s]. Then the joints reduce w evenly to zero within the time t [s],
while the distance still shrinks. The remaining distance suffices if

.. math:: h \;\ge\; w\,T + \tfrac12 w\,t \qquad\Leftrightarrow\qquad w \;\le\; \frac{h}{T + t/2} .

The function :func:`shrink_rates` returns the factor 1 / (T + t/2). The safety filter
(:class:`~imitarm.scene.clearance_limit.ClearanceLimit`) and the timing of planned paths use the same factor, so that
they allow the same speeds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

APPROACH_RATE = 6.0
"""Upper limit of the rate at which a distance to an obstacle may shrink, divided by the distance itself [1/s]."""
LONGEST_YIELD = 1.5
"""Upper limit of the yielding time, in which a part of the arm reaches the speed of an obstacle [s]."""
SHARE = 0.1
"""Assumed acceleration of a yielding part of the arm, as a fraction of what all joints together could give it."""


def shrink_rates(
    arm: ArmModel,
    gradients: Array,
    approach: Array | None,
    velocity: Array | None = None,
    *,
    most: float = APPROACH_RATE,
    delay: Array | float = 0.01,
) -> Array | float:
    r"""Return the rate at which each distance may shrink, divided by the distance itself [1/s].

    The result is :math:`\min(\text{most},\, 1/(T + t/2))`. The time t [s] is the longer of two times:

    * The braking time :math:`\max_j |\dot q_j| / a_j`, in which all joints together brake from the velocity :math:`\dot
      q` to rest. :math:`a_j` is the acceleration limit of joint j.
    * The yielding time :math:`v_o / (0.1 \sum_j |g_j| a_j)`, at most 1.5 s, in which a part of the arm at rest reaches
      the speed :math:`v_o` of an approaching obstacle. Here, g is the gradient of the distance with respect to the
      joint angles. The sum is the largest acceleration that the joints can give to this part of the arm, away from the
      obstacle. The formula uses only a tenth of the sum, because the joints must move other parts of the arm at the
      same time. If the part can't become as fast as the obstacle, yielding early would not help, and the yielding time
      is 0.

    Args:
        arm: the arm, with its limits of velocity and acceleration.
        gradients: derivatives of k distances with respect to the joints, shape (k, n_joints) [m/rad].
        approach: speed at which each obstacle approaches, shape (k,) [m/s]; None: all obstacles are at rest.
        velocity: joint velocity, shape (n_joints,), or one for each distance, shape (k, n_joints) [rad/s]; None: the
            arm is at rest.
        most: largest result [1/s].
        delay: T, the control period plus the latency [s]; one number, or one for each distance, shape (k,).

    Returns:
        One rate for each distance, shape (k,) [1/s], or one number for all distances if all obstacles are at rest.
    """
    time: Array | float = 0.0
    if velocity is not None:
        time = (np.abs(velocity) / arm.max_acceleration).max(axis=-1)
    if approach is None or approach.max(initial=0.0) <= 0.0:
        return np.minimum(most, 1.0 / (delay + 0.5 * time))
    reach = np.abs(gradients)
    times = approach / np.maximum(SHARE * (reach @ arm.max_acceleration), 1e-9)
    times[(approach <= 0.0) | (approach > reach @ arm.max_velocity)] = 0.0
    times = np.maximum(np.minimum(times, LONGEST_YIELD), time)
    return np.minimum(most, 1.0 / (delay + 0.5 * times))
