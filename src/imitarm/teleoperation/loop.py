"""Teleoperation: the real-time loop from a person's skeletons to a robot, in this process or over UDP."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.capture.stream import Arrival, UdpSource
from imitarm.command import Command
from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.kinematics.arm import ArmState
from imitarm.retarget import Retargeter, RetargetStep
from imitarm.retarget.engagement import EngagementState
from imitarm.robots import Robot, UdpRobot
from imitarm.safety import SafetyFilter
from imitarm.transmission.datagram import now_ns
from imitarm.transmission.latency import LatencyLog
from imitarm.transmission.messages import RobotStatus
from imitarm.transmission.rate import RateLimiter
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_FEEDBACK = 5.0  # [1/s] gain that returns the set-point to the retargeter's joint positions after a limit
_END_TIME = 1.0  # [s] the loop continues after the end of the source, so that the retargeter brings the arm to rest
_MAX_BACKLOG = 64  # skeletons read in one step
_MAX_UNANSWERED = 256  # commands for which the skeleton they were computed from is remembered


@dataclass(frozen=True, eq=False)
class StepInfo:
    """The result of one control step; the function ``on_step`` receives this object.

    Attributes:
        time: time since the start [s].
        skeleton: newest skeleton that arrived in this step; None if no skeleton arrived.
        command: command that the retargeter computed.
        state: measured state of the robot.
        engagement: whether the retargeter waits, follows, coasts, holds or is stopped; None while the robot cannot be
            controlled.
        problem: why the robot cannot be controlled; empty if it can be controlled.
    """

    time: float
    skeleton: Skeleton | None
    command: RetargetStep
    state: ArmState
    engagement: EngagementState | None
    problem: str


@dataclass
class Summary:
    """The result of a teleoperation.

    Attributes:
        duration: duration [s].
        steps: number of control steps.
        overruns: number of control steps that were skipped because the computer was busy.
        skeletons: number of skeletons that the retargeter processed.
        engagement: number of steps that the retargeter spent in each state (waiting, following, coasting, holding,
            stopped).
        interrupted: number of steps in which the robot could not be controlled.
        clamped: for each limit of the robot, the number of steps in which this limit changed the command.
        filtered: number of steps in which the safety filter changed the command.
        unsafe: number of steps in which no joint velocity could keep all limits and clearances.
        speed: largest joint velocity of the set-point, as a fraction of the joint's velocity limit.
        acceleration: largest joint acceleration of the set-point, as a fraction of the joint's acceleration limit.
        interruptions: number of times that control of the robot was lost.
        reason: why the teleoperation has ended; empty while it runs.
        latency: duration of each processing stage, for each skeleton.
    """

    duration: float = 0.0
    steps: int = 0
    overruns: int = 0
    skeletons: int = 0
    engagement: Counter[EngagementState] = field(default_factory=Counter)
    interrupted: int = 0
    clamped: Counter[str] = field(default_factory=Counter)
    filtered: int = 0
    unsafe: int = 0
    speed: float = 0.0
    acceleration: float = 0.0
    interruptions: int = 0
    reason: str = ""
    latency: LatencyLog = field(default_factory=LatencyLog)


class Teleoperation:
    """Lets a person move a robot in real time, at the retargeter's control period.

    In each period, the retargeter computes a joint velocity from the newest skeleton. The safety filter corrects this
    velocity, and :meth:`Robot.move <imitarm.robots.robot.Robot.move>` sends it to the robot. While the robot is
    stopped, slows down or does not answer, it cannot be controlled. When control returns, the robot is first brought to
    rest. The retargeter then starts again from the arm's current position, so the arm never jumps.

    Args:
        source: skeletons of one person, live or replayed in real time.
        retargeter: method that converts the motion of the person's arm to the robot's motion.
        robot: robot to control.
        safety: safety filter that checks every command. None: a filter that keeps the joint limits, keeps the links at
            least 10 mm apart, and prevents contact with the obstacles of the retargeter's scene.
        stream: UDP stream from which ``source`` reads, used to measure latencies; None: ``source`` reads no UDP stream.
        recorder: records the robot's motion from the time when the person first moves the robot; None: no recording.
        confirm_enable: function that decides whether a robot on a server may be enabled again. The function is called
            as ``confirm_enable(reason, stopped)`` in each step in which the robot cannot be controlled, and returns
            True or False. None: the robot is not enabled again.
        on_step: function called after every step.
        clock_ns: function that returns the time [ns], on the same clock as ``stream`` and ``robot``.
        rate_limiter: timer that starts the control steps; None: a timer that runs in real time.
    """

    def __init__(
        self,
        source: SkeletonSource,
        retargeter: Retargeter,
        robot: Robot,
        *,
        safety: SafetyFilter | None = None,
        stream: UdpSource | None = None,
        recorder: DemonstrationRecorder | None = None,
        confirm_enable: Callable[[str, bool], bool] | None = None,
        on_step: Callable[[StepInfo], None] | None = None,
        clock_ns: Callable[[], int] = now_ns,
        rate_limiter: RateLimiter | None = None,
    ) -> None:
        self.source, self.retargeter, self.robot = source, retargeter, robot
        self.summary = Summary()
        self.safety = SafetyFilter(robot.arm, dt=retargeter.dt) if safety is None else safety
        self._stream, self._recorder = stream, recorder
        self._confirm_enable, self._on_step = confirm_enable, on_step
        self._clock_ns = clock_ns
        self._rate_limiter = RateLimiter(retargeter.dt) if rate_limiter is None else rate_limiter
        self._remote = robot if isinstance(robot, UdpRobot) else None
        self._zero = np.zeros(robot.arm.n_joints)
        self._started, self._closed, self._has_followed = False, False, False
        self._recorded = float("nan")  # time of the last recorded state, on the robot's clock
        self._arrival: Arrival | None = None
        self._origins: dict[int, tuple[int, int]] = {}  # sequence of a command: row of the log, time of exposure [ns]

    def run(self, seconds: float | None = None) -> Summary:
        """Run until the time is up, the source ends, the robot has a fault, or the user presses Ctrl-C.

        The robot is brought to rest in every case.

        Args:
            seconds: duration [s]; None: unlimited.

        Raises:
            InputError: when the duration is not positive.
        """
        if seconds is not None:
            seconds = finite_number(seconds, "Teleoperation: seconds", "s", above=0.0)
        dt, summary = self.retargeter.dt, self.summary
        ending: float | None = None
        if self._stream is not None:
            self._stream.flush()
        try:
            while not summary.reason:
                skeleton = self._newest()
                self._rate_limiter.wait()
                time = (self._rate_limiter.ticks - 1) * dt
                self.step(time, skeleton)
                summary.duration, summary.steps = time + dt, summary.steps + 1
                summary.overruns = self._rate_limiter.overruns
                if self.source.over:
                    ending = time if ending is None else ending
                    if time - ending >= _END_TIME:
                        summary.reason = "the source has ended"
                if seconds is not None and summary.duration >= seconds - 1e-9:
                    summary.reason = "the time is up"
        except KeyboardInterrupt:
            summary.reason = "stopped by the user"
        finally:
            self.robot.stop(dt)
        return summary

    def step(self, time: float, skeleton: Skeleton | None) -> None:
        """Make one control step.

        Args:
            time: time since the start [s].
            skeleton: newest skeleton that has arrived since the last step; None if no skeleton has arrived.
        """
        before, summary = self.robot.velocity, self.summary
        problem = self._problem()
        if problem:
            self._started = False
            self._wait_for_robot(problem)
        elif not self._started:
            self._begin()
        else:
            self._follow(skeleton)
        engagement = self.retargeter.latest.state if self._started else None
        if engagement is None:
            summary.interrupted += 1
        else:
            summary.engagement[engagement] += 1
        summary.skeletons += skeleton is not None
        if self._remote is not None:
            self._match_echoes(self._remote)
            if self._remote.interruptions != summary.interruptions:  # it has taken over the server's set-point
                summary.interruptions, self._started = self._remote.interruptions, False
        if self._started:
            self._measure(before)
        state = self.robot.state()
        self._record(time, engagement, state)
        if self._on_step is not None:
            self._on_step(StepInfo(time, skeleton, self.retargeter.latest, state, engagement, problem))

    # --- input

    def _newest(self) -> Skeleton | None:
        """Return the newest skeleton that arrives before the next step is due, and store its arrival times."""
        newest = None
        for _ in range(_MAX_BACKLOG):
            remaining = self._rate_limiter.remaining
            skeleton = None if self.source.over else self.source.read(remaining)
            if skeleton is not None:
                newest, now = skeleton, self._clock_ns()
                arrival = None if self._stream is None else self._stream.arrival
                self._arrival = Arrival(np.nan, np.nan, now) if arrival is None else arrival
            elif remaining == 0.0 or self.source.over:
                break
        return newest

    def _problem(self) -> str:
        """Return why the robot cannot be controlled; empty if it can."""
        if self._remote is None:
            if self.robot.fault:
                self.summary.reason = self.robot.fault
            return self.robot.fault
        self._remote.listen()
        if self._remote.fresh and self._remote.reported.status is RobotStatus.FAULT:
            self.summary.reason = self._remote.problem
        return self._remote.problem if not self._remote.ready else ""

    def _wait_for_robot(self, problem: str) -> None:
        """Hold the robot still, and enable it again once ``confirm_enable`` allows it."""
        self.robot.move(self._zero, self.retargeter.dt)
        remote = self._remote
        if remote is None or self._confirm_enable is None or self.summary.reason:
            return
        stopped = remote.fresh and remote.reported.status is RobotStatus.STOPPED
        if self._confirm_enable(problem, stopped) and stopped:
            remote.request_enable()

    # --- output

    def _begin(self) -> None:
        """Bring the robot to rest, then start the retargeter from the robot's position."""
        self.robot.move(self._zero, self.retargeter.dt)
        if not self.robot.velocity.any():
            arm = self.robot.arm
            self.retargeter.start(np.clip(self.robot.set_point, arm.lower, arm.upper))
            self._started = True

    def _follow(self, skeleton: Skeleton | None) -> None:
        """Make one step with the retargeter and send the result to the robot."""
        robot, retargeter = self.robot, self.retargeter
        before, taken = retargeter.latest.q, self._clock_ns()
        retargeter.step(skeleton, robot.state().q)
        ready = self._clock_ns()
        self._grasp(retargeter.latest.closed)
        velocity = retargeter.latest.velocity + _FEEDBACK * (before - robot.set_point)
        command = Command(np.zeros(6), joint_velocity=velocity)
        safe = self.safety.step(command, robot.set_point, robot.velocity, retargeter.scene)
        robot.move(safe.velocity, retargeter.dt)
        self.summary.clamped.update(robot.clamped)
        self.summary.filtered += safe.changed > 0.0
        self.summary.unsafe += not safe.safe
        if skeleton is not None and self._arrival is not None:
            self._log_latency(self._arrival, taken, ready, self._clock_ns())

    def _grasp(self, closed: bool | None) -> None:
        """Close or open the gripper, if there is one, when the person has closed or opened the hand."""
        if closed is None or closed == self._closed or not self.robot.widest_opening > 0.0:
            return
        self._closed = closed
        self.robot.grasp(0.0 if closed else self.robot.widest_opening)

    # --- measurements

    def _measure(self, before: Array) -> None:
        """Update the largest velocity and acceleration of the set-point."""
        arm, summary, velocity = self.robot.arm, self.summary, self.robot.velocity
        change = np.abs(velocity - before) / (arm.max_acceleration * self.retargeter.dt)
        summary.speed = max(summary.speed, float((np.abs(velocity) / arm.max_velocity).max()))
        summary.acceleration = max(summary.acceleration, float(change.max()))

    def _log_latency(self, arrival: Arrival, taken: int, ready: int, sent: int) -> None:
        """Log the latencies of a skeleton up to the sending of its command; the later ones are not known yet."""
        log = self.summary.latency
        row = log.add()
        waits = {"expose": arrival.waited, "arrive": arrival.queued, "wait": 1e-9 * (taken - arrival.received_ns)}
        log.record(row, retarget=1e-9 * (ready - taken), send=1e-9 * (sent - ready), **waits)
        until_received = np.nan_to_num(arrival.waited) + np.nan_to_num(arrival.queued)
        exposed = arrival.received_ns - round(1e9 * float(until_received))
        if self._remote is None:
            log.record(row, total=1e-9 * (sent - exposed))
        elif self._remote.sequence is not None:
            if len(self._origins) > _MAX_UNANSWERED:
                self._origins.clear()
            self._origins[self._remote.sequence] = row, exposed

    def _match_echoes(self, remote: UdpRobot) -> None:
        """Add the latencies measured by the robot to the log, for each command that the robot has acknowledged."""
        for echo in remote.echoes():
            origin = self._origins.pop(echo.sequence, None)
            if origin is not None:
                row, exposed = origin
                total = 1e-9 * (echo.applied_ns - exposed)
                self.summary.latency.record(row, robot=echo.sent, apply=echo.applied, total=total)

    def _record(self, time: float, engagement: EngagementState | None, state: ArmState) -> None:
        self._has_followed = self._has_followed or engagement is EngagementState.FOLLOWING
        if self._recorder is not None and self._has_followed and state.time != self._recorded:
            self._recorded = state.time  # a served robot may not have sent a new state
            self._recorder.write(time, state.q)
