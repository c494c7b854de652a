r"""Execution times for a joint path, within the limits of velocity, acceleration and torque.

Let s [s] be the parameter of the joint path q(s), and :math:`\dot s` its rate. With :math:`b = \dot s^2` and :math:`a =
\ddot s`, the limits of acceleration and torque are linear in a and b, and the limit of velocity is a bound of b:

.. math:: |q'| \sqrt b \le \dot q_{max}, \qquad |q' a + q'' b| \le \ddot q_{max}, \qquad
          |M q'\,a + (M q'' + C(q, q') q')\,b + g| \le \tau_{max}

A first pass goes from the end of the path to its start. It finds the largest :math:`b` at each sample from which the
arm can still execute the rest of the path. A second pass goes from the start to the end and takes the largest possible
:math:`a` at each sample. The method was published by Pham and Pham, "A new approach to time-optimal path
parameterization based on reachability analysis", IEEE T-RO 34(3), 2018.

A *schedule* delays the motion or slows it down, so that a moving obstacle can pass first. It limits the rate ds/dt at
each sample. To wait at a sample, the arm moves very slowly from this sample to the next one. The two passes above brake
the arm before this sample and accelerate it afterwards, within all limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath
from imitarm.policies.arm_certificate import ArmAmongObstacles, Shrinking
from imitarm.policies.arm_pairs import SELF
from imitarm.scene.braking import APPROACH_RATE, LONGEST_YIELD, shrink_rates

Array = NDArray[np.float64]

SELF_CLEARANCE = 0.012
"""Planned distance between links of the arm that do not share a joint [m]."""

_VELOCITY, _ACCELERATION, _TORQUE = 0.95, 0.9, 0.9  # fractions of the limits that are used
_HALVINGS = 40
_ROUNDING = 1e-9
_NO_EFFECT = 1e-9  # a coefficient smaller than this does not limit a
_SLOWEST = 1e-6  # squared speed below which the path counts as blocked
_FILTER_SELF, _FILTER_MARGIN = 0.01, 1e-3  # [m] that the safety filter keeps between links; that it adds to a clearance
_USED = 0.9  # fraction that is used of the rates at which the safety filter lets distances shrink
_SELF_RATE = 5.0  # [1/s] that rate between links
_DELAY = 0.02  # [s] of the commands: twice the usual control period
_REACH = 0.15  # [m] pairs farther apart than the clearance and this do not slow the motion among resting obstacles
_CREEP = 1e-3  # [m/s] closing speed that is always allowed, so that the motion goes on
_WAITS = (0.4, 0.8, 1.4, 2.2, 3.2)  # [s] of a wait
_WAIT_AFTER = (0.0, 0.15, 0.3, 0.5, 0.8, 1.2, 1.8)  # [s] in the learned motion, before a wait
_SLOWER = (0.75, 0.5, 0.35)  # rates of the whole motion


@dataclass(frozen=True, eq=False)
class Timing:
    """The times at which an arm reaches the samples of a path.

    Attributes:
        times: time of each sample, from 0, shape (n,) [s].
        blocked: index of the first sample at which the limits of the arm allow no motion; -1 if there is none.
        joint: index of the joint whose torque limit allows no motion there; -1 if there is none.
        rate: the rate ds/dt at the first sample.
    """

    times: Array
    blocked: int = -1
    joint: int = -1
    rate: float = 0.0


def retimed(
    arm: ArmModel,
    joints: Array,
    parameters: Array,
    fastest: Array,
    *,
    path: ArmPath | None = None,
    rate: float = 0.0,
) -> Timing:
    """Return the earliest times of the samples within the limits of an arm; the motion ends at rest.

    Args:
        arm: the arm with its tool.
        joints: joint positions at the samples, shape (n, n_joints) [rad].
        parameters: path parameter s of each sample, increasing, shape (n,) [s]. If the rate ds/dt is 1 everywhere, the
            arm reaches each sample at the time s.
        fastest: largest allowed rate ds/dt at each sample, shape (n,).
        path: kinematics of the arm in these postures; None: they are computed.
        rate: desired rate ds/dt at the first sample; 0: the motion begins at rest. If the limits do not allow this
            rate, the function uses the largest allowed rate.
    """
    first = np.gradient(joints, parameters, axis=0)
    second = np.gradient(first, parameters, axis=0)
    of_a, of_b, bound = _limits(ArmPath.of(arm, joints) if path is None else path, first, second)
    static = bound.min(axis=1)
    if static.min() < 0.0:  # the weight of the arm alone exceeds a torque
        sample = int(np.flatnonzero(static < 0.0)[0])
        return Timing(np.array(parameters - parameters[0]), sample, int(np.argmin(bound[sample])) % arm.n_joints)
    with np.errstate(divide="ignore"):
        most = (_VELOCITY * arm.max_velocity / np.abs(first)).min(axis=1)
    most = np.minimum(most, fastest) ** 2
    step = 2.0 * np.diff(parameters)
    b = _squared_speeds(of_a[:-1] / step[:, None], of_b[:-1], bound[:-1], most, rate**2)
    speeds = np.sqrt(b)
    means = 0.5 * (speeds[1:] + speeds[:-1])
    slow = np.flatnonzero(means <= _SLOWEST)
    if len(slow):
        return Timing(np.array(parameters - parameters[0]), int(slow[0]), -1)
    return Timing(np.concatenate([[0.0], np.cumsum(np.diff(parameters) / means)]), rate=float(speeds[0]))


def safe_rates(
    around: ArmAmongObstacles, path: ArmPath, times: Array, clock: Array, allowance: float, *, tool_only: bool = False
) -> Array:
    """Return the largest rate ds/dt at each sample at which the safety filter does not slow the arm down.

    The filter limits how fast each distance may shrink (:func:`~imitarm.scene.braking.shrink_rates`); this function
    uses 90 % of these limits. The filter measures distances to the predicted positions of obstacles, so the margins do
    not count here. If a distance shrinks because the obstacle moves towards the arm, a slower motion would not help.
    The function therefore limits only the part of the shrinking that the arm's own motion causes.

    Args:
        around: the arm, its obstacles and the required clearances.
        path: postures of the arm at n samples.
        times: path parameter s of each sample, increasing, shape (n,) [s].
        clock: expected time of the arm at each sample, shape (n,) [s]; it determines the positions of moving obstacles.
        allowance: difference between the required clearance and the smaller clearance that the safety filter keeps [m].
        tool_only: True: only the distances between obstacles and the last link (with the tool) count. These distances
            do not depend on the posture of the other links.

    Returns:
        The rates, each at most 1, shape (n,).
    """
    velocity = np.gradient(path.joints, times, axis=0)
    fastest_obstacle, slowest = around.fastest_obstacle, APPROACH_RATE
    if fastest_obstacle > 0.0:
        slowest = 1.0 / (_DELAY + 0.5 * LONGEST_YIELD)
    reach = _REACH + 0.5 * LONGEST_YIELD * fastest_obstacle
    obstacles = Shrinking(_USED * slowest, max(allowance - _FILTER_MARGIN, 0.0), reach)
    links = Shrinking(_USED * _SELF_RATE, SELF_CLEARANCE - _FILTER_SELF, _REACH)
    gaps = around.without_margins.closing(path, clock, velocity, obstacles, links)
    own = gaps.obstacle == SELF
    margin = np.where(own, links.margin, obstacles.margin)
    rates, drift = gaps.rates(np.arange(len(gaps)))
    shrinking = shrink_rates(path.arm, rates, -drift, velocity[gaps.sample], delay=_DELAY)
    rate = _USED * np.where(own, _SELF_RATE, shrinking)
    allowed = np.maximum(rate * (np.maximum(gaps.room, 0.0) + margin) + np.maximum(drift, 0.0), _CREEP)
    approach = np.maximum(-np.einsum("kj,kj->k", rates, velocity[gaps.sample]), 1e-9)
    fastest = np.ones(len(path))
    counts = ~own & (path.arm.cover.links[gaps.sphere] == path.arm.n_joints) if tool_only else slice(None)
    np.minimum.at(fastest, gaps.sample[counts], (allowed / approach)[counts])
    return fastest


@dataclass(frozen=True, eq=False)
class Schedule:
    """Limits of the rate along a path that delay the motion or slow it down.

    Attributes:
        fastest: largest rate ds/dt at each sample, shape (n,).
        clock: approximate time of each sample, computed without the limits of acceleration, shape (n,) [s].
        delay: time by which the schedule delays the arrival [s].
    """

    fastest: Array
    clock: Array
    delay: float


def schedules(times: Array, clock: Array, *, at_rest: bool) -> list[Schedule]:
    """Return possible schedules for a path, in the order of their delay.

    Args:
        times: times of the samples in the learned motion, from 0, shape (n,) [s].
        clock: times at which the arm reaches the samples without a delay, shape (n,) [s].
        at_rest: whether the motion begins at rest, so that the arm can wait at the first sample.
    """
    return sorted(_schedules(times, clock, at_rest), key=lambda one: one.delay)


def _schedules(times: Array, clock: Array, at_rest: bool) -> Iterator[Schedule]:
    n = len(times)
    for ahead in _WAIT_AFTER if at_rest else _WAIT_AFTER[1:]:
        i = int(np.searchsorted(times, ahead))
        if i > n - 3:
            break
        for delay in _WAITS:
            fastest = np.ones(n)
            fastest[i : i + 2] = (times[i + 1] - times[i]) / delay
            yield Schedule(fastest, clock + delay * (np.arange(n) > i), delay)
    for rate in _SLOWER:
        yield Schedule(np.full(n, rate), clock / rate, float(clock[-1]) * (1.0 / rate - 1.0))


def _squared_speeds(of_a: Array, of_b: Array, bound: Array, most: Array, first: float) -> Array:
    """Return the largest squared speeds at n samples, until rest, shape (n,).

    Two neighbouring squared speeds, b and then c, are allowed if ``of_a * (c - b) + of_b * b <= bound`` in all m rows
    and if neither exceeds ``most``. These pairs (b, c) form a convex polygon that contains (0, 0). Its upper limit of b
    as a function of c is the smallest of several straight lines. It rises up to some ``turn`` and falls from there.

    Args:
        of_a: coefficients at all samples but the last one, shape (n - 1, m).
        of_b: shape (n - 1, m).
        bound: not negative, shape (n - 1, m).
        most: largest squared speed at each sample, shape (n,).
        first: squared speed at the first sample, if it is allowed.
    """
    of_b = of_b - of_a
    limits = of_b > _NO_EFFECT
    divisor = np.where(limits, of_b, 1.0)
    level = np.where(limits, bound / divisor, np.inf)
    fall = np.where(limits, of_a / divisor, 0.0)
    turn = _turns(of_a, of_b, bound, most, level, fall)
    most = np.append(np.minimum(most[:-1], (level - fall * turn[:, None]).min(axis=1)), 0.0)
    low, high = _ranges(level, fall, most[:-1])
    before, after = most.tolist(), 0.0
    for i, (most_c, a, b) in reversed(list(enumerate(zip(turn.tolist(), low.tolist(), high.tolist(), strict=True)))):
        c = min(after, most_c)
        if not a <= c <= b:
            before[i] = max(float((level[i] - fall[i] * c).min()), 0.0)
        after = before[i]
    limits = of_a > _NO_EFFECT
    divisor = np.where(limits, of_a, 1.0)
    level, fall = np.where(limits, bound / divisor, np.inf), np.where(limits, of_b / divisor, 0.0)
    low, high = _ranges(level, fall, np.array(before[1:]))
    now = min(first, before[0])
    speeds = [now]
    for i, (a, b) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        now = before[i + 1] if a <= now <= b else max(float((level[i] - fall[i] * now).min()), 0.0)
        speeds.append(now)
    return np.array(speeds)


def _ranges(level: Array, fall: Array, least: Array) -> tuple[Array, Array]:
    """Return the ranges of x in which ``level - fall * x`` is at least ``least`` in all columns; shapes (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = (level - least[:, None]) / fall
    low = np.where(fall < 0.0, crossing, -np.inf).max(axis=1)
    high = np.where(fall > 0.0, crossing, np.inf).min(axis=1)
    never = ((fall == 0.0) & (level < least[:, None])).any(axis=1)
    return np.where(never, np.inf, low), high


def _turns(of_a: Array, of_b: Array, bound: Array, most: Array, level: Array, fall: Array) -> Array:
    """Return the c at which the upper limit of b is largest, at most ``most`` of the next sample, shape (n - 1,)."""
    turn = most[1:].copy()
    low, high = np.zeros(len(turn)), turn.copy()
    rows = np.arange(len(turn))
    for _ in range(_HALVINGS):
        c = turn[rows, None]
        lines = level[rows] - fall[rows] * c
        active = lines.argmin(axis=1)
        here = np.arange(len(rows))
        upper = np.minimum(lines[here, active], most[rows])
        falling = (fall[rows, active] > 0.0) & (lines[here, active] < most[rows])
        # Beyond the last c that has an allowed b, the lower limits of b exceed the upper one.
        falling |= (of_a[rows] * c + of_b[rows] * np.maximum(upper, 0.0)[:, None] > bound[rows] + _ROUNDING).any(axis=1)
        falling |= upper < 0.0
        low[rows], high[rows] = np.where(falling, low[rows], turn[rows]), np.where(falling, turn[rows], high[rows])
        rows = rows[low[rows] < high[rows] * (1.0 - _ROUNDING)]
        if not len(rows):
            break
        turn[rows] = 0.5 * (low[rows] + high[rows])
    return low


def _limits(path: ArmPath, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return the coefficients of m limits ``of_a * a + of_b * b <= bound`` at each sample, each of shape (n, m)."""
    arm = path.arm
    of_a, of_b, room = [first], [second], [np.broadcast_to(_ACCELERATION * arm.max_acceleration, first.shape)]
    upper, lower = list(room), list(room)
    if np.isfinite(arm.max_torque).any() and arm.has_dynamics:
        none = np.zeros_like(first)
        motions = np.stack([none, none, first]), np.stack([none, first, second])
        weight, accelerating, moving = arm.chain.torques(path.placed, *motions)
        of_a.append(accelerating - weight)
        of_b.append(moving - weight)
        upper.append(_TORQUE * arm.max_torque - weight)
        lower.append(_TORQUE * arm.max_torque + weight)
    a, b = np.concatenate(of_a, axis=1), np.concatenate(of_b, axis=1)
    bound = np.concatenate([*upper, *lower], axis=1)
    a, b = np.concatenate([a, -a], axis=1), np.concatenate([b, -b], axis=1)
    return a, b, np.where(np.isfinite(bound), bound, 1e12)
