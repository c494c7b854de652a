"""The control loop: observe, decide, filter, move, record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.command import Command, Status
from imitarm.control_loop.contact import Contact, ContactDetector
from imitarm.control_loop.interventions import InterventionLog
from imitarm.control_loop.watchdog import Watchdog
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.policy import Observation, Policy
from imitarm.robots.robot import Robot
from imitarm.safety import SafetyFilter, SafetyStep
from imitarm.scene import Scene
from imitarm.trajectory import Rollout, Trajectory
from imitarm.validation import finite_number, flag, function, instance

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Step:
    """One control step, the argument of ``on_step``.

    Attributes:
        time: time since the reproduction began [s].
        tool_to_base: measured pose of the tool after the step.
        state: measured state of the arm after the step.
        scene: the observed scene.
        command: the policy's command, possibly slowed down by the watchdog.
        safety: result of the safety filter for this command.
        clearance: measured distance from arm and tool to the nearest obstacle [m].
    """

    time: float
    tool_to_base: Pose
    state: ArmState
    scene: Scene
    command: Command
    safety: SafetyStep
    clearance: float


def reproduce(
    policy: Policy,
    robot: Robot,
    observe: Callable[[float], Scene],
    *,
    dt: float = 0.01,
    timeout: float = 60.0,
    safety: SafetyFilter | None = None,
    watchdog: Watchdog | None = None,
    contact: ContactDetector | bool = True,
    on_step: Callable[[Step], None] | None = None,
) -> Rollout:
    """Let ``policy`` reproduce its skill on ``robot``, and record what happens.

    In every control period ``dt``, ``observe`` returns the scene, and the policy returns a
    :class:`~imitarm.command.Command`. The :class:`~imitarm.safety.SafetyFilter` converts the command to joint
    velocities that keep the arm's limits and clearances, and the robot moves. If the command contains a new gripper
    opening, the gripper moves its fingers. The motion ends when the policy has finished, when the robot has stopped to
    protect itself, when the torques of the joints show a contact, or at ``timeout``. The robot is always braked to a
    stop, also after an exception.

    Args:
        policy: policy that decides the motion; its ``reset`` is called first.
        robot: robot that executes the motion.
        observe: function that takes the time since the start [s] and returns the latest known scene. The scene may have
            been measured earlier; its ``stamp`` is the time of that measurement [s].
        dt: control period [s]; for a simulated robot, it must be a multiple of the simulation's timestep.
        timeout: longest duration [s].
        safety: safety filter; None: a filter that keeps the arm within its joint limits, its links at least 10 mm apart
            and the whole arm out of contact with obstacles. The filter's ``dt`` must equal this ``dt``.
        watchdog: object that slows the arm down and stops it while no new scenes arrive; None: a
            :class:`~imitarm.control_loop.watchdog.Watchdog` with its default times.
        contact: detector of contacts. True: a :class:`~imitarm.control_loop.contact.ContactDetector` with its default
            thresholds, if the masses of the arm are known. False: contacts are not detected.
        on_step: function called after each step, for progress or drawing; an exception in this function stops the
            robot, and is then passed on to the caller.

    Returns:
        The measured motion from rest to rest. Its attribute ``success`` means that the motion finished in time, touched
        nothing, and kept the clearance that the filter requires. Its ``details`` contain the commanded ``"twists"`` (n,
        6) and several counts. ``"clamped"`` contains the number of commands that each limit of the robot changed. The
        count ``"filtered"`` is the number of steps in which the filter changed a command to keep a clearance, and
        ``"unsafe"`` is the number of steps without a safe motion. ``"interventions"`` is a tuple of
        :class:`~imitarm.control_loop.interventions.Intervention`, which name the parts that came close to each other.
        ``"contact"`` is the detected :class:`~imitarm.control_loop.contact.Contact`, or None. ``"statuses"`` contains
        the number of steps with each status of the policy. The details also contain the entries of the robot's
        :meth:`~imitarm.robots.robot.Robot.report`. The attribute ``reason`` describes contacts and interventions of the
        safety filter.

    Raises:
        InputError: when ``dt`` or ``timeout`` is not positive, an argument has the wrong type, or ``safety`` or
            ``contact`` was made for another arm. Also when the policy does not return a Command.
        InfeasibleError: when the arm starts in contact with an obstacle, or the policy refuses to start; in both cases,
            the robot has not moved.
    """
    dt, timeout = finite_number(dt, "reproduce: dt", "s"), finite_number(timeout, "reproduce: timeout", "s")
    if not 0.0 < dt <= timeout:
        raise InputError(f"reproduce: needs 0 < dt <= timeout [s], got dt {dt!r} and timeout {timeout!r}")
    instance(policy, Policy, "reproduce: policy")  # type: ignore[type-abstract]
    instance(robot, Robot, "reproduce: robot")  # type: ignore[type-abstract]
    function(observe, "reproduce: observe")
    if on_step is not None:
        function(on_step, "reproduce: on_step")
    keeper = SafetyFilter(robot.arm, dt=dt) if safety is None else instance(safety, SafetyFilter, "reproduce: safety")
    if keeper.dt != dt:
        raise InputError(
            f"reproduce: the safety filter was made for dt {keeper.dt:g} s, not {dt:g} s; use the same dt for both"
        )
    _check_arm(keeper.arm, robot, "safety filter")
    watch = Watchdog() if watchdog is None else instance(watchdog, Watchdog, "reproduce: watchdog")
    watch.reset()
    detector, touch = _detector(robot, contact), None
    log = _Log(robot)
    if log.clearances[0] <= 0.0:
        raise InfeasibleError(f"the arm starts in contact ({_nearest(robot)}): move the obstacle, or start elsewhere")
    policy.reset(Observation(0.0, log.state, log.tool_to_base, observe(0.0)))
    finished, last, opening = False, Command(np.zeros(6)), float("nan")
    try:
        for k in range(round(timeout / dt) + 1):
            observation = Observation(k * dt, log.state, log.tool_to_base, observe(k * dt))
            finished = policy.finished(observation)
            if finished:
                break
            last = policy.step(observation, dt)
            if not isinstance(last, Command):
                raise InputError(f"{type(policy).__name__}.step must return a Command, got {last!r}")
            if last.opening is not None and last.opening != opening:
                opening = last.opening
                robot.grasp(opening)
            last = watch.guard(last, observation.scene.stamp, k * dt)
            scene = observation.scene.now(k * dt)
            kept = keeper.step(last, robot.set_point, robot.velocity, scene)
            robot.move(kept.velocity, dt)
            step = log.take(robot, scene, last, kept)
            if on_step is not None:
                on_step(step)
            touch = None if detector is None else detector.update(step.state)
            if robot.fault or touch is not None:
                break
    finally:
        robot.stop(dt)
    log.take(robot, observation.scene, Command(np.zeros(6)), None)
    log.contact = touch
    fault = robot.fault or str(touch or "") or ("" if finished else _unfinished(timeout, last, robot))
    return log.rollout(robot, fault, keeper.clearance)


def _detector(robot: Robot, contact: ContactDetector | bool) -> ContactDetector | None:
    """Return the detector of contacts for one motion; None if there is none."""
    if isinstance(contact, ContactDetector):
        _check_arm(contact.arm, robot, "detector of contacts")
        contact.reset()
        return contact
    if flag(contact, "reproduce: contact") and robot.arm.has_dynamics:
        return ContactDetector(robot.arm)
    return None


def _check_arm(arm: ArmModel, robot: Robot, what: str) -> None:
    """Reject a filter or a detector that was made for an arm with other joints."""
    if arm.joint_names != robot.arm.joint_names:
        raise InputError(
            f"reproduce: the {what} was made for the arm {arm.name}, not for the robot's arm {robot.arm.name}; make it "
            "with robot.arm"
        )


def _unfinished(timeout: float, last: Command, robot: Robot) -> str:
    """Return why a motion has not finished in time."""
    reason = f"not finished within {timeout:g} s"
    if last.status in {Status.WAITING, Status.BRAKING}:
        reason += f": {last.status.value}, {last.reason}"
        if last.status is Status.WAITING and robot.nearest_pair() is not None:
            reason += f"; nearest: {_nearest(robot)}"
    return reason


def _nearest(robot: Robot) -> str:
    """Return the name of the obstacle nearest to the arm, and its distance."""
    pair = robot.nearest_pair() or ("the arm", "an obstacle")
    return f"{pair[0]} and {pair[1]}, {1e3 * robot.clearance():.1f} mm apart"


@dataclass
class _Log:
    """The record of a reproduction."""

    robot: Robot
    states: list[ArmState] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    clearances: list[float] = field(default_factory=list)
    twists: list[Array] = field(default_factory=list)
    clamped: Counter[str] = field(default_factory=Counter)
    statuses: Counter[str] = field(default_factory=Counter)
    interventions: InterventionLog = field(default_factory=InterventionLog)
    contact: Contact | None = None
    filtered: int = 0
    unsafe: int = 0

    def __post_init__(self) -> None:
        self.begin = self.robot.state().time
        self.take(self.robot, Scene(), Command(np.zeros(6)), None)

    @property
    def state(self) -> ArmState:
        return self.states[-1]

    @property
    def tool_to_base(self) -> Pose:
        return self.poses[-1]

    def take(self, robot: Robot, scene: Scene, command: Command, safety: SafetyStep | None) -> Step:
        state, clearance = robot.state(), robot.clearance()
        pose = robot.arm.tool_pose(state.q)
        if not self.states or state.time > self.state.time:
            self.states.append(state)
            self.poses.append(pose)
            self.clearances.append(clearance)
            self.twists.append(command.twist)
        self.clamped.update(robot.clamped)
        if safety is None:
            safety = SafetyStep(robot.velocity, 0.0, 0.0, True)
        else:
            self.statuses[command.status.value] += 1
            self.filtered += safety.changed > 0.0
            self.unsafe += not safety.safe
            self.interventions.take(state.time - self.begin, safety)
        return Step(state.time - self.begin, pose, state, scene, command, safety, clearance)

    def rollout(self, robot: Robot, fault: str, required: float | None) -> Rollout:
        times = np.array([state.time for state in self.states]) - self.begin
        positions = np.array([pose.position for pose in self.poses])
        quaternions = np.array([pose.quaternion for pose in self.poses])
        report = robot.report()
        touched = sorted(report.get("contacts", ()))
        if touched:
            fault = "; ".join(filter(None, [fault, "touched: " + ", ".join(" with ".join(pair) for pair in touched)]))
        nearest = float(np.min(self.clearances, initial=np.inf))
        if not fault and required is not None and nearest < required:
            fault = f"clearance fell to {1e3 * nearest:.1f} mm, but {1e3 * required:.1f} mm are required"
            if self.clearances[0] < required:
                fault += f"; at the start, the clearance was {1e3 * self.clearances[0]:.1f} mm"
        details: dict[str, Any] = {
            "twists": np.array(self.twists),
            "clamped": dict(self.clamped),
            "filtered": self.filtered,
            "unsafe": self.unsafe,
            "interventions": self.interventions.result(),
            "contact": self.contact,
            "statuses": dict(self.statuses),
            **report,
        }
        return Rollout(
            Trajectory(times, positions, quaternions),
            joints=np.array([state.q for state in self.states]),
            velocities=np.array([state.velocity for state in self.states]),
            torques=np.array([state.torque for state in self.states]),
            clearance=np.array(self.clearances),
            success=not fault,
            reason="; ".join(filter(None, [fault or "finished", self.interventions.sentence()])),
            details=details,
        )
