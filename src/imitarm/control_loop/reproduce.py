"""The control loop: look, decide, solve the inverse kinematics, move, note."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.tasks import TwistTask
from imitarm.policies.policy import Observation, Policy
from imitarm.robots.robot import Robot
from imitarm.scene import Scene
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.trajectory import Rollout, Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Step:
    """One turn of the control loop, as ``on_step`` gets it.

    Attributes:
        time: since the reproduction began [s].
        tool_to_base: measured pose of the tool.
        state: measured state of the arm.
        scene: what was observed.
        twist: what the policy asked for, shape (6,).
        clearance: measured distance from arm and tool to the nearest obstacle [m].
    """

    time: float
    tool_to_base: Pose
    state: ArmState
    scene: Scene
    twist: Array
    clearance: float


def reproduce(
    policy: Policy,
    robot: Robot,
    observe: Callable[[float], Scene],
    *,
    dt: float = 0.01,
    timeout: float = 60.0,
    method: str = "qp",
    link_clearance: float | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Rollout:
    """Let ``policy`` reproduce its skill on ``robot``, and note what happens.

    Every ``dt``: the scene is observed, the policy answers with a twist of the tool, :func:`solve_ik` turns it into
    joint velocities within the arm's limits, and the robot moves. The motion ends when the policy has finished, when
    the robot has stopped to protect itself, or at ``timeout``. Whatever happens, also an exception, the robot is
    braked to a stop.

    Args:
        policy: what decides; its ``reset`` is called first.
        robot: what moves.
        observe: the scene as it is known at a time since the beginning [s].
        dt: control period [s]; a simulated robot needs a multiple of its timestep.
        timeout: longest duration [s].
        method: of :func:`solve_ik`.
        link_clearance: distance that every link must keep to every obstacle [m], held by
            :class:`~imitarm.scene.clearance_limit.ClearanceLimit` in the inverse kinematics (``method="qp"``); the tool
            then leaves its path where a link would not get by. None: only the policy looks after obstacles.
        on_step: called after each step, for progress or drawing; what it raises stops the robot and is passed on.

    Returns:
        The measured motion from rest to rest. ``success`` means finished in time without a touch; ``details`` holds
        ``"twists"`` (n, 6) as asked, ``"clamped"``: how often each limit changed a command, and what the robot
        has in its :meth:`~imitarm.robots.robot.Robot.report`.

    Raises:
        InputError: when ``dt`` or ``timeout`` is not positive, or the policy's answer is no twist.
        InfeasibleError: passed on from ``policy.reset``; the robot has not moved.
    """
    if not 0.0 < dt <= timeout < np.inf:
        raise InputError(f"reproduce: needs 0 < dt <= timeout [s], got dt {dt!r} and timeout {timeout!r}")
    notes = _Notes(robot)
    policy.reset(Observation(0.0, notes.tool_to_base, observe(0.0)))
    finished = False
    try:
        for k in range(round(timeout / dt) + 1):
            observation = Observation(k * dt, notes.tool_to_base, observe(k * dt))
            finished = policy.finished(observation)
            if finished:
                break
            twist = np.asarray(policy.step(observation, dt), dtype=float)
            if twist.shape != (6,) or not np.isfinite(twist).all():
                raise InputError(f"{type(policy).__name__}.step must answer 6 finite numbers, got {twist!r}")
            q, rows = notes.state.q, None
            if link_clearance is not None:
                rows = ClearanceLimit(robot.arm, link_clearance).rows(q, observation.scene)
            velocity = solve_ik(
                robot.arm, q, TwistTask(twist), method=method, dt=dt, velocity=robot.velocity, rows=rows
            )
            robot.move(velocity, dt)
            step = notes.take(robot, observation.scene, twist)
            if on_step is not None:
                on_step(step)
            if robot.fault:
                break
    finally:
        robot.stop(dt)
    notes.take(robot, observation.scene, np.zeros(6))
    return notes.rollout(robot, robot.fault or ("" if finished else f"not finished within {timeout:g} s"))


@dataclass
class _Notes:
    """What is written down during a reproduction."""

    robot: Robot
    states: list[ArmState] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    clearances: list[float] = field(default_factory=list)
    twists: list[Array] = field(default_factory=list)
    clamped: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.begin = self.robot.state().time
        self.take(self.robot, Scene(), np.zeros(6))

    @property
    def state(self) -> ArmState:
        return self.states[-1]

    @property
    def tool_to_base(self) -> Pose:
        return self.poses[-1]

    def take(self, robot: Robot, scene: Scene, twist: Array) -> Step:
        state, clearance = robot.state(), robot.clearance()
        pose = robot.arm.tool_pose(state.q)
        if not self.states or state.time > self.state.time:
            self.states.append(state)
            self.poses.append(pose)
            self.clearances.append(clearance)
            self.twists.append(twist)
        self.clamped.update(robot.clamped)
        return Step(state.time - self.begin, pose, state, scene, twist, clearance)

    def rollout(self, robot: Robot, fault: str) -> Rollout:
        times = np.array([state.time for state in self.states]) - self.begin
        positions = np.array([pose.position for pose in self.poses])
        quaternions = np.array([pose.quaternion for pose in self.poses])
        report = robot.report()
        touched = sorted(report.get("contacts", ()))
        if touched:
            fault = "; ".join(filter(None, [fault, "touched: " + ", ".join(" with ".join(pair) for pair in touched)]))
        details: dict[str, Any] = {"twists": np.array(self.twists), "clamped": dict(self.clamped), **report}
        return Rollout(
            Trajectory(times, positions, quaternions),
            joints=np.array([state.q for state in self.states]),
            velocities=np.array([state.velocity for state in self.states]),
            torques=np.array([state.torque for state in self.states]),
            clearance=np.array(self.clearances),
            success=not fault,
            reason=fault or "finished",
            details=details,
        )
