"""The world of the moving benchmark without an arm: a tool that follows the commanded velocity within its limits."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.moving_scenes import MovingCase
from imitarm.benchmark.static_measures import LATEST, MAX_ACCELERATION, MAX_SPEED
from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.policy import Observation, Policy
from imitarm.scene import Scene

Array = NDArray[np.float64]

DT = 0.01
"""Control period [s]."""
_STILL = 0.005  # [m/s] a tool slower than this is at rest


class Seen(NamedTuple):
    """The tracked obstacles that the policy observed in one control step.

    Attributes:
        time: time of the observation [s].
        positions: position of each tracked obstacle, shape (n, 3) [m].
        velocities: velocity of each tracked obstacle, shape (n, 3) [m/s].
        covariances: covariance of each position, shape (n, 3, 3) [m^2]; nan if it is unknown.
        track_ids: number of each track, shape (n,).
    """

    time: float
    positions: Array
    velocities: Array
    covariances: Array
    track_ids: Array

    @classmethod
    def of(cls, scene: Scene, time: float) -> Seen:
        """Return the tracked obstacles of a scene that was observed at ``time`` [s]."""
        packed = scene.packed
        return cls(time, packed.positions, packed.velocities, packed.covariances, np.asarray(packed.track_ids))


@dataclass
class ToolRun:
    """The motion of the tool in one run.

    Attributes:
        times: start of each of the n control periods, and end of the last period, shape (n + 1,) [s].
        positions: positions of the tool at these times, shape (n + 1, 3) [m].
        statuses: status of the policy's command in each of the n periods.
        seen: what the policy observed in every third control step.
        step_seconds: computing time of each call of the policy's ``step`` [s].
        reset_seconds: computing time of the policy's ``reset`` [s].
        arrived: whether the policy reported that the motion has arrived.
        refusal: reason why the policy refused the task before any motion; empty if it did not refuse.
        last: the last command of the policy.
    """

    times: Array = field(default_factory=lambda: np.zeros(1))
    positions: Array = field(default_factory=lambda: np.zeros((1, 3)))
    statuses: list[Status] = field(default_factory=list)
    seen: list[Seen] = field(default_factory=list)
    step_seconds: list[float] = field(default_factory=list)
    reset_seconds: float = 0.0
    arrived: bool = False
    refusal: str = ""
    last: Command = field(default_factory=lambda: Command(np.zeros(6)))


def run_tool(policy: Policy, case: MovingCase, observe: Callable[[float], Scene]) -> ToolRun:
    r"""Run a policy with a tool in a scene.

    The run ends when the tool rests at its goal, or after twice the learned duration.

    The velocity v of the tool follows the commanded velocity u within the limits of speed and acceleration. With the
    control period h, the position x of the tool is

    .. math::
        v_{k+1} = v_k + \mathrm{clip}(u_k - v_k,\ a_{max} h), \qquad x_{k+1} = x_k + h v_{k+1},
        \qquad |v| \le v_{max}

    The limits :math:`v_{max}` and :math:`a_{max}` are the same as in the static benchmark. After its arrival, the tool
    brakes. The tool never rotates.

    Args:
        policy: the policy.
        case: the scene.
        observe: function that returns, for a time [s], the scene that the policy observes.
    """
    state = ArmState(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
    x, v = case.skill.start_.position.copy(), np.zeros(3)
    path, run = [x], ToolRun()
    began = clock.perf_counter()
    try:
        policy.reset(Observation(0.0, state, _pose(x), observe(0.0)))
    except InfeasibleError as refusal:
        run.refusal = str(refusal)
    run.reset_seconds = clock.perf_counter() - began
    n = 0 if run.refusal else round(LATEST * case.skill.duration_ / DT)
    for k in range(n):
        observation = Observation(k * DT, state, _pose(x), observe(k * DT))
        if k % 3 == 0:
            run.seen.append(Seen.of(observation.scene, k * DT))
        run.arrived = policy.finished(observation)
        if run.arrived and float(np.linalg.norm(v)) < _STILL:
            break
        began = clock.perf_counter()
        run.last = Command(np.zeros(6)) if run.arrived else policy.step(observation, DT)
        run.step_seconds.append(clock.perf_counter() - began)
        v = within_limits(v, run.last.twist[:3])
        x = x + DT * v
        path.append(x)
        run.statuses.append(run.last.status)
    run.positions = np.array(path)
    run.times = np.asarray(DT * np.arange(len(path)), dtype=float)
    return run


def within_limits(velocity: Array, wanted: Array, dt: float = DT) -> Array:
    """Return the velocity after one period, shape (3,) [m/s]: as near to ``wanted`` as the limits allow."""
    size = float(np.linalg.norm(wanted))
    target = wanted * min(1.0, MAX_SPEED / size) if size > 0.0 else wanted
    change = target - velocity
    size = float(np.linalg.norm(change))
    return np.asarray(velocity + change * min(1.0, MAX_ACCELERATION * dt / max(size, 1e-12)))


def _pose(position: Array) -> Pose:
    return Pose.trusted(position, _UPRIGHT)


_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
