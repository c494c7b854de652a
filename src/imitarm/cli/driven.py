"""The simulated robot, with its drives and its weight, does what a retargeting commands; and how well it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from imitarm.retarget import Retargeting
from imitarm.robots import SimulatedRobot
from imitarm.scene import Scene
from imitarm.viewer.retarget_content import Measure, MethodResult

_FOLLOW = 5.0  # [1/s] how quickly the set-point is brought back to the commands after a limit cut one


def driven(
    result: MethodResult, scene: Scene | None = None, progress: Callable[[float], None] | None = None
) -> MethodResult:
    """Return a result with what a simulated robot measured when it did the same.

    The robot's own limits guard it: what a method asks for beyond them is cut, and the arm falls behind.

    Args:
        result: of a method.
        scene: obstacles, as solid bodies.
        progress: called with the share that is done, 0 to 1.
    """
    run: Retargeting = result.run
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
    measures = [
        Measure("driven: worst joint behind, RMS", 1e3 * float(np.sqrt(np.mean(behind**2))), "mrad", 1, "less"),
        Measure("driven: worst joint behind, at most", 1e3 * float(behind.max()), "mrad", 0, "less"),
        Measure("driven: highest torque", 100.0 * float(torques.max()), "% of the rated", 0, "less"),
        Measure("driven: commands cut by the robot's limits", cut, "frames", 0, "less"),
    ]
    notes = []
    if np.isfinite(clearance):
        notes.append(f"driven: the arm came as near as {1e3 * clearance:.0f} mm to an obstacle")
    if robot.contacts:
        notes.append("driven: touched " + ", ".join(sorted({obstacle for _, obstacle in robot.contacts})))
    if robot.fault:
        notes.append(f"driven: after {robot.time:.1f} s the robot stopped itself ({robot.fault})")
    return replace(result, measures=[*result.measures, *measures], notes=[*result.notes, *notes])
