r"""Execution times for a joint path, from rest to rest, within the limits of velocity, acceleration and torque.

Along a path q(s) with the path parameter s and the speed :math:`\dot s`, all limits are linear in :math:`b = \dot s^2`
and :math:`a = \ddot s`:

.. math:: |q'| \sqrt b \le \dot q_{max}, \qquad |q' a + q'' b| \le \ddot q_{max}, \qquad
          |M q'\,a + (M q'' + C(q, q') q')\,b + g| \le \tau_{max}

A first pass, from the end to the start, finds for each sample the largest :math:`b` from which the rest of the path can
still be executed. A second pass, from the start to the end, takes the largest possible :math:`a` at each sample. The
method is that of Pham and Pham, "A new approach to time-optimal path parameterization based on reachability analysis",
IEEE T-RO 34(3), 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.arm_certificate import SELF, ArmAmongObstacles

Array = NDArray[np.float64]

SELF_CLEARANCE = 0.012
"""Planned distance between links of the arm that do not share a joint [m]."""

_VELOCITY, _ACCELERATION, _TORQUE = 0.95, 0.9, 0.9  # fractions of the limits that are used
_HALVINGS = 40
_NO_EFFECT = 1e-9  # a coefficient smaller than this does not limit a
_SLOWEST = 1e-6  # squared speed below which the path counts as blocked
_FILTER_SELF, _FILTER_MARGIN = 0.01, 1e-3  # [m] that the safety filter keeps between links; that it adds to a clearance
_APPROACH_RATE, _SELF_RATE = 5.4, 4.5  # [1/s] distances shrink no faster than this times what is left; the filter: 6, 5
_REACH = 0.15  # [m] pairs farther apart than the clearance and this do not slow the motion
_CREEP = 1e-3  # [m/s] closing speed that is always allowed, so that the motion goes on


@dataclass(frozen=True, eq=False)
class Timing:
    """Execution times of a path.

    Attributes:
        times: time of each sample, from 0, shape (n,) [s].
        blocked: index of the first sample at which a limit does not allow any motion; -1 if there is no such sample.
        joint: index of the joint whose torque limit does not allow any motion; -1 if there is no such joint.
    """

    times: Array
    blocked: int = -1
    joint: int = -1


def retimed(arm: ArmModel, joints: Array, parameters: Array, fastest: Array) -> Timing:
    """Return the shortest execution times of a path within the limits of an arm, from rest to rest.

    Args:
        arm: the arm with its tool.
        joints: joint positions at the samples, shape (n, n_joints) [rad].
        parameters: path parameter s of each sample, increasing, shape (n,) [s]. If the rate ds/dt is 1 everywhere, each
            sample is reached at the time s.
        fastest: largest allowed rate ds/dt at each sample, shape (n,).
    """
    first = np.gradient(joints, parameters, axis=0)
    second = np.gradient(first, parameters, axis=0)
    of_a, of_b, bound = _limits(arm, joints, first, second)
    static = bound.min(axis=1)
    if static.min() < 0.0:  # the weight of the arm alone exceeds a torque
        sample = int(np.flatnonzero(static < 0.0)[0])
        return Timing(np.array(parameters - parameters[0]), sample, int(np.argmin(bound[sample])) % arm.n_joints)
    with np.errstate(divide="ignore"):
        most = (_VELOCITY * arm.max_velocity / np.abs(first)).min(axis=1)
    most = np.minimum(most, fastest) ** 2
    step = 2.0 * np.diff(parameters)
    n = len(joints)
    reachable = np.zeros(n)
    for i in range(n - 2, -1, -1):
        reachable[i] = _largest(of_a[i], of_b[i], bound[i], float(most[i]), float(step[i]), float(reachable[i + 1]))
    b = np.zeros(n)
    for i in range(n - 1):
        high = _interval(of_a[i], of_b[i], bound[i], float(b[i]))[1]
        b[i + 1] = min(max(b[i] + high * step[i], 0.0), reachable[i + 1])
    speeds = np.sqrt(b)
    means = 0.5 * (speeds[1:] + speeds[:-1])
    slow = np.flatnonzero(means <= _SLOWEST)
    if len(slow):
        return Timing(np.array(parameters - parameters[0]), int(slow[0]), -1)
    return Timing(np.concatenate([[0.0], np.cumsum(np.diff(parameters) / means)]))


def safe_rates(around: ArmAmongObstacles, path: ArmPath, times: Array, clock: Array, allowance: float) -> Array:
    """Return the largest rate ds/dt at each sample at which no distance shrinks faster than the safety filter allows.

    Args:
        around: the arm, its obstacles and the required clearances.
        path: the arm at n samples.
        times: path parameter s of each sample, increasing, shape (n,) [s].
        clock: time at which each sample is compared with the places of the obstacles, shape (n,) [s].
        allowance: required clearance minus the clearance that the safety filter keeps [m].

    Returns:
        Shape (n,), at most 1.
    """
    speed = np.linalg.norm(np.gradient(path.centers, times, axis=0), axis=2)
    gaps = around.gaps(path, clock, min(2.0 * float(speed.max(initial=0.0)) / _SELF_RATE, _REACH))
    own = gaps.obstacle == SELF
    margin = np.where(own, SELF_CLEARANCE - _FILTER_SELF, max(allowance - _FILTER_MARGIN, 0.0))
    rate = np.where(own, _SELF_RATE, _APPROACH_RATE)
    allowed = np.maximum(rate * (np.maximum(gaps.room, 0.0) + margin) + gaps.drift, _CREEP)
    # A distance shrinks at most as fast as the sphere moves; that of two spheres at most twice as fast.
    closing = np.flatnonzero(allowed < 2.0 * speed[gaps.sample, gaps.sphere])
    velocity = np.gradient(path.joints, times, axis=0)[gaps.sample[closing]]
    approach = np.maximum(-np.einsum("kj,kj->k", gaps.rates(closing), velocity), 1e-9)
    fastest = np.ones(len(path))
    np.minimum.at(fastest, gaps.sample[closing], allowed[closing] / approach)
    return fastest


def _limits(arm: ArmModel, joints: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return the coefficients of m limits ``of_a * a + of_b * b <= bound`` at each sample, each of shape (n, m)."""
    of_a, of_b, room = [first], [second], [np.broadcast_to(_ACCELERATION * arm.max_acceleration, first.shape)]
    upper, lower = list(room), list(room)
    if np.isfinite(arm.max_torque).any() and arm.has_dynamics:
        zero = np.zeros(arm.n_joints)
        weight = np.array([arm.inverse_dynamics(q, zero, zero) for q in joints])
        of_a.append(np.array([arm.inverse_dynamics(q, zero, d) for q, d in zip(joints, first, strict=True)]) - weight)
        moved = [arm.inverse_dynamics(q, d, dd) for q, d, dd in zip(joints, first, second, strict=True)]
        of_b.append(np.array(moved) - weight)
        upper.append(_TORQUE * arm.max_torque - weight)
        lower.append(_TORQUE * arm.max_torque + weight)
    a, b = np.concatenate(of_a, axis=1), np.concatenate(of_b, axis=1)
    bound = np.concatenate([*upper, *lower], axis=1)
    a, b = np.concatenate([a, -a], axis=1), np.concatenate([b, -b], axis=1)
    return a, b, np.where(np.isfinite(bound), bound, 1e12)


def _interval(of_a: Array, of_b: Array, bound: Array, b: float) -> tuple[float, float]:
    """Return the smallest and the largest acceleration ``a`` that the limits allow at the squared speed ``b``."""
    room = bound - of_b * b
    up, down = of_a > _NO_EFFECT, of_a < -_NO_EFFECT
    if (room[~(up | down)] < 0.0).any():
        return 1.0, -1.0
    high = float((room[up] / of_a[up]).min(initial=1e9))
    low = float((room[down] / of_a[down]).max(initial=-1e9))
    return low, high


def _largest(of_a: Array, of_b: Array, bound: Array, most: float, step: float, after: float) -> float:
    """Return the largest squared speed ``b``, at most ``most``, from which the path can continue.

    The limits must allow an acceleration that leads to a squared speed in [0, ``after``] at the next sample.
    """

    def works(b: float) -> bool:
        low, high = _interval(of_a, of_b, bound, b)
        return max(low, -b / step) <= min(high, (after - b) / step)

    if works(most):
        return most
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if works(middle) else (low, middle)
    return low
