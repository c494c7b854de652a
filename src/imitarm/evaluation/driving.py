"""What a simulated robot, with its drives and its weight, makes of joint positions that a method commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imitarm.retarget import Retargeting
from imitarm.robots import SimulatedRobot
from imitarm.scene import Scene

_FOLLOW = 5.0  # [1/s] how quickly the set-point is brought back to the commands after a limit cut one


@dataclass(frozen=True)
class Driven:
    """What was measured while a simulated robot did what a method commanded.

    Attributes:
        behind_rms: root mean square over time of how far the worst joint was behind its command [rad].
        behind_max: the farthest that a joint was behind [rad].
        peak_torque_ratio: largest torque of a drive over the rated one.
        cut: frames in which the robot's own limits changed a command.
        clearance: smallest distance of the arm to an obstacle [m]; inf without any.
        touched: names of the obstacles that were touched.
        fault: why the robot stopped itself; empty when it did not.
        duration: until then, or the whole [s].
    """

    behind_rms: float
    behind_max: float
    peak_torque_ratio: float
    cut: int
    clearance: float
    touched: tuple[str, ...]
    fault: str
    duration: float


def drive(run: Retargeting, scene: Scene | None = None, progress: Callable[[float], None] | None = None) -> Driven:
    """Let a simulated robot do what a method commanded.

    The robot's own limits guard it: what a method asks for beyond them is cut, and the arm falls behind.

    Args:
        run: of the method.
        scene: obstacles, as solid bodies.
        progress: called with the share that is done, 0 to 1.
    """
    robot = SimulatedRobot(run.arm, scene=scene, q=run.joints[0])
    dt, n = float(run.times[1] - run.times[0]), len(run.times)
    behind, torques, cut, clearance = np.zeros(n), np.zeros(n), 0, np.inf
    for i in range(1, n):
        state = robot.move(run.velocities[i] + _FOLLOW * (run.joints[i - 1] - robot.set_point), dt)
        if robot.fault:
            break
        behind[i] = np.abs(state.q - run.joints[i]).max()
        torques[i] = (np.abs(state.torque) / run.arm.max_torque).max()
        cut += bool(robot.clamped)
        clearance = min(clearance, robot.clearance())
        if progress is not None:
            progress(i / n)
    return Driven(
        float(np.sqrt(np.mean(behind**2))),
        float(behind.max()),
        float(torques.max()),
        cut,
        float(clearance),
        tuple(sorted({obstacle for _, obstacle in robot.contacts})),
        robot.fault,
        robot.time,
    )
