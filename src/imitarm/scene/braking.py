r"""How fast the distance between an arm and an obstacle may shrink, so that the arm can still brake or yield in time.

The joints can change the speed of a part of the arm along a direction only within some time t, while the distance goes
on shrinking. Let w be the rate at which the remaining distance h shrinks, T the delay after which a command takes
effect, and let the joints bring w evenly to zero. The remaining distance suffices if

.. math:: h \;\ge\; w\,T + \tfrac12 w\,t \qquad\Leftrightarrow\qquad w \;\le\; \frac{h}{T + t/2} .

:func:`shrink_rates` returns the factor of h. The rows of the safety filter
(:class:`~imitarm.scene.clearance_limit.ClearanceLimit`) and the execution times of planned paths use it, so they agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

APPROACH_RATE = 6.0
"""A distance to an obstacle never shrinks by more than this fraction of itself per second [1/s]."""
LONGEST_YIELD = 1.5
"""The arm begins to yield to an obstacle at most this time before it would be touched, times one half [s]."""
SHARE = 0.1
"""Only this fraction is counted of the acceleration that all joints together could give to a part of the arm."""


def shrink_rates(
    arm: ArmModel,
    gradients: Array,
    approach: Array | None,
    velocity: Array | None = None,
    *,
    most: float = APPROACH_RATE,
    delay: Array | float = 0.01,
) -> Array | float:
    r"""Return the fraction of each distance by which it may shrink per second [1/s].

    The result is :math:`\min(\text{most},\, 1/(T + t/2))`. The time t [s] is the longer one of two times:

    * All joints brake together from the velocity :math:`\dot q` to rest in :math:`\max_j |\dot q_j| / a_j`, where
      :math:`a_j` is the acceleration limit of joint j.
    * A part of the arm at rest reaches the speed :math:`v_o` of the obstacle that approaches it in
      :math:`v_o / (0.1 \sum_j |g_j| a_j)`, at most 1.5 s. Here, g is the gradient of the distance with respect to the
      joints, and the sum is the acceleration along the normal if every joint served this part alone. Only a tenth of it
      is counted on, because other parts of the arm must yield at the same time, and the tool shall stay where it is.
      For a part that can't become as fast as the obstacle, this time is 0, because an early start would not help.

    Args:
        arm: the arm, with its limits of velocity and acceleration.
        gradients: derivatives of k distances with respect to the joints, shape (k, n_joints) [m/rad].
        approach: speed at which each obstacle approaches, shape (k,) [m/s]; None: all are at rest.
        velocity: joint velocity, one of shape (n_joints,) or one for each distance (k, n_joints) [rad/s]; None: at
            rest.
        most: largest result [1/s].
        delay: T, the control period plus the latency, one number or of shape (k,) [s].

    Returns:
        Shape (k,), or one number for all if all obstacles are at rest.
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
