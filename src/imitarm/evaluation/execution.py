"""Execution of commanded joint positions by an ideal arm with limits, or by a simulated robot with drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.limits import JointLimits
from imitarm.retarget import Retargeting
from imitarm.robots import SimulatedRobot
from imitarm.scene import Scene

Array = NDArray[np.float64]

CATCH_UP = 5.0  # [1/s] fraction of the remaining error to the commanded position that is corrected per second


def execute_within_limits(arm: ArmModel, joints: ArrayLike, dt: float) -> Array:
    r"""Return the joint positions of an arm that follows commands but keeps its limits, shape (n, n_joints) [rad].

    Let :math:`q^c_k` be the commanded and :math:`q_k` the actual position in control period k. The velocity of the arm
    is the commanded velocity plus a correction towards the commanded position, limited by the function ``clip``:

    .. math:: \dot q_k = \mathrm{clip}\left((q^c_{k+1} - q^c_k) / dt + 5\,\mathrm{s}^{-1}\,(q^c_k - q_k)\right)

    The function ``clip`` limits the velocity to a box (:class:`~imitarm.kinematics.limits.JointLimits`). After any
    velocity in this box, the arm can still keep all its limits of position, velocity and acceleration. Commands within
    the limits are executed unchanged.

    Args:
        arm: arm whose limits are kept.
        joints: commanded positions, shape (n, n_joints) [rad]; the arm starts at rest at the first position.
        dt: sampling period [s].
    """
    commanded = np.asarray(joints, dtype=float)
    limits, done = JointLimits(arm), np.empty_like(commanded)
    q, velocity = commanded[0].copy(), np.zeros(commanded.shape[1])
    done[0] = q
    for i, wanted in enumerate(np.diff(commanded, axis=0) / dt):
        lower, upper = limits.box(q, dt, velocity)
        velocity = np.clip(wanted + CATCH_UP * (commanded[i] - q), lower, upper)
        q = q + dt * velocity
        done[i + 1] = q
    return done


@dataclass(frozen=True)
class Execution:
    """Measurements on a simulated robot that executed a retargeted motion.

    Attributes:
        error_rms: root mean square over time of the largest position error of any joint [rad].
        error_max: largest position error of a joint [rad].
        peak_torque_ratio: largest torque of a drive, relative to the rated torque.
        limited: number of frames in which a limit of the robot changed a command.
        clearance: smallest distance between the arm and an obstacle [m]; inf without obstacles.
        touched: names of the obstacles that were touched.
        fault: reason of a protective stop; empty without a protective stop.
        duration: time until the protective stop, or duration of the whole motion [s].
    """

    error_rms: float
    error_max: float
    peak_torque_ratio: float
    limited: int
    clearance: float
    touched: tuple[str, ...]
    fault: str
    duration: float


def execute_on_robot(
    run: Retargeting, scene: Scene | None = None, progress: Callable[[float], None] | None = None
) -> Execution:
    """Let a simulated robot execute a retargeted motion; the simulation includes drives and gravity.

    The robot enforces its limits. If a command exceeds a limit, the robot reduces the command, and the arm lags behind
    the motion.

    Args:
        run: retargeting run whose motion the robot executes.
        scene: obstacles, which are solid bodies in the simulation.
        progress: function called with the finished fraction, 0 to 1.
    """
    robot = SimulatedRobot(run.arm, scene=scene, q=run.joints[0])
    dt, n = float(run.times[1] - run.times[0]), len(run.times)
    errors, torques, limited, clearance = np.zeros(n), np.zeros(n), 0, np.inf
    for i in range(1, n):
        state = robot.move(run.velocities[i] + CATCH_UP * (run.joints[i - 1] - robot.set_point), dt)
        if robot.fault:
            break
        errors[i] = np.abs(state.q - run.joints[i]).max()
        torques[i] = (np.abs(state.torque) / run.arm.max_torque).max()
        limited += bool(robot.clamped)
        clearance = min(clearance, robot.clearance())
        if progress is not None:
            progress(i / n)
    return Execution(
        float(np.sqrt(np.mean(errors**2))),
        float(errors.max()),
        float(torques.max()),
        limited,
        float(clearance),
        tuple(sorted({obstacle for _, obstacle in robot.contacts})),
        robot.fault,
        robot.time,
    )
