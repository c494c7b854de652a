r"""certified_stop: a motion that brakes an arm to rest and holds it, with a guarantee of its clearance.

All joints brake with constant decelerations and stop at the same time, so the arm moves on a straight line in joint
space. The joint that needs the longest time determines the braking time

.. math:: t_b = \max_j \frac{|\dot q_j|}{a_j} .

Here, :math:`\dot q_j` is the velocity of joint j, and :math:`a_j` is 80 % of its acceleration limit. After the braking,
the arm keeps its posture until the end of the horizon. The guarantee (:mod:`~imitarm.policies.arm_certificate`) covers
the braking and the time at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.arm_path import ArmPath
from imitarm.perception.margins import CoverageMargin
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.arm_pairs import SELF
from imitarm.policies.prediction_margin import margins_in
from imitarm.policies.whole_arm import links_apart
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, instance

Array = NDArray[np.float64]

_DECELERATION = 0.8  # of the largest one
_SAMPLES = 9  # while the arm brakes
_STANDS = 1e-4  # [rad/s]


@dataclass(frozen=True, eq=False)
class Stop:
    """A motion that ends at rest, and its guaranteed clearance.

    Attributes:
        times: times of the samples, from 0 to the end of the horizon, shape (n,) [s].
        joints: joint positions, shape (n, n_joints) [rad]; linear between the samples.
        clearance: guaranteed lower bound of the clearance of the whole arm [m]. If ``certified`` is False, this is a
            clearance below the required one that was measured at one point of the motion.
        certified: whether the whole arm keeps its clearances until the end of the horizon.
        reason: text that names the link and the object that come too close to each other; empty if ``certified``.
    """

    times: Array
    joints: Array
    clearance: float
    certified: bool
    reason: str


def certified_stop(
    arm: ArmModel,
    state: ArmState,
    scene: Scene,
    *,
    clearance: float = 0.02,
    horizon: float = 1.0,
    margin: CoverageMargin | None = None,
    margin_horizon: float | None = None,
) -> Stop:
    """Return the motion that brakes the arm to rest and holds it there, with its guaranteed clearance.

    Args:
        arm: the arm with its tool.
        state: measured state of the arm.
        scene: the observed obstacles with their velocities, and the fixtures. If a part of the arm is already nearer to
            a fixture than ``clearance``, it may stay at this distance.
        clearance: required distance from the whole arm to every obstacle [m].
        horizon: time from now for which the clearance must be guaranteed [s].
        margin: bound of the error of the predicted obstacle positions; see :func:`~imitarm.policies.adapt`.
        margin_horizon: time after the last detection of an obstacle at which the margin stops growing [s]; None: never.

    Raises:
        InputError: when an argument is not valid.
    """
    instance(arm, ArmModel, "arm")
    q, velocity = instance(state, ArmState, "state").q, state.velocity
    if len(q) != arm.n_joints:
        raise InputError(f"certified_stop: state has {len(q)} joints, but {arm.name} has {arm.n_joints}")
    instance(scene, Scene, "scene")
    clearance = finite_number(clearance, "clearance", "m", at_least=0.0)
    horizon = finite_number(horizon, "horizon", "s", above=0.0)
    times, joints = _braking(q, velocity, _DECELERATION * arm.max_acceleration, horizon)
    around = ArmAmongObstacles(
        arm,
        scene.obstacles,
        clearance,
        fixtures=scene.fixtures,
        contacts=q[None],
        own=links_apart(arm),
        margins=margins_in(scene, margin, margin_horizon),
    )
    found = around.clearance_of(ArmPath.of(arm, joints), times)
    reason = ""
    if found.room < 0.0:
        what = _named(scene, found.obstacle)
        within = times[min(found.sample + 1, len(times) - 1)]
        reason = f"{arm.cover.bodies[found.sphere]} comes too close to {what} within {within:.2f} s"
    return Stop(times, joints, clearance + found.room, found.room >= 0.0, reason)


def _named(scene: Scene, index: int) -> str:
    """Return the name of an obstacle, or of a fixture, whose indices follow those of the obstacles."""
    if index == SELF:
        return "another link"
    n = len(scene.obstacles)
    if index < n:
        return scene.name_of(index)
    fixture = scene.fixtures[index - n]
    return fixture.name or fixture.kind


def _braking(q: Array, velocity: Array, deceleration: Array, horizon: float) -> tuple[Array, Array]:
    """Return times (n,) [s] and joint positions (n, n_joints) [rad] of a stop and the rest after it."""
    if np.abs(velocity).max() < _STANDS:
        return np.array([0.0, horizon]), np.stack([q, q])
    duration = float((np.abs(velocity) / deceleration).max())
    times = np.linspace(0.0, duration, _SAMPLES)
    joints = q + np.outer(times - 0.5 * times**2 / duration, velocity)
    if horizon > duration:
        times, joints = np.append(times, horizon), np.concatenate([joints, joints[-1:]])
    return times, joints
