"""The live loop: skeletons come in, a retargeter turns them into commands, a robot moves, here or over the wire."""

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
from imitarm.robots import Robot, UdpRobot
from imitarm.safety import SafetyFilter
from imitarm.transmission.datagram import now_ns
from imitarm.transmission.latency import LatencyLog
from imitarm.transmission.messages import Status
from imitarm.transmission.pace import Pace

Array = NDArray[np.float64]

INTERRUPTED = "interrupted"
"""What the loop does while the robot is not ready to be led; the other states are the retargeter's."""

_FOLLOW = 5.0  # [1/s] how quickly the set-point is brought back to the commands after a limit cut one
_ENDING = 1.0  # [s] that a source's end is followed by, so that the arm comes to rest as the method has it
_BACKLOG = 64  # skeletons taken at once at most
_UNANSWERED = 256  # commands of which it is remembered what they were made from


@dataclass(frozen=True, eq=False)
class Moment:
    """One control step, as ``on_step`` gets it.

    Attributes:
        time: since the beginning [s].
        skeleton: that came in, the newest one; None: none.
        command: the retargeter's result.
        state: of the robot, as measured.
        doing: the retargeter's state, or :data:`INTERRUPTED`.
        trouble: why the robot can't be led, in words; empty when it can.
    """

    time: float
    skeleton: Skeleton | None
    command: RetargetStep
    state: ArmState
    doing: str
    trouble: str


@dataclass
class Tally:
    """What came of a teleoperation.

    Attributes:
        duration: [s].
        steps: control steps that were made.
        overruns: that were missed, because the machine was busy.
        frames: skeletons that were used.
        doing: steps in each of the retargeter's states and in :data:`INTERRUPTED`.
        clamped: steps in which the robot changed the command, by limit.
        filtered: steps in which the safety filter changed the command for a clearance.
        unsafe: steps in which no joint velocity kept every limit and clearance.
        speed: largest velocity of the set-point over its limit.
        acceleration: largest acceleration of the set-point over its limit.
        interruptions: how often the robot could not be led any more.
        reason: why it has ended.
        latency: of the stages, frame by frame.
    """

    duration: float = 0.0
    steps: int = 0
    overruns: int = 0
    frames: int = 0
    doing: Counter[str] = field(default_factory=Counter)
    clamped: Counter[str] = field(default_factory=Counter)
    filtered: int = 0
    unsafe: int = 0
    speed: float = 0.0
    acceleration: float = 0.0
    interruptions: int = 0
    reason: str = ""
    latency: LatencyLog = field(default_factory=LatencyLog)


class Teleoperation:
    """Lets a person lead a robot, at the retargeter's control period.

    Each period the newest skeleton goes to the retargeter, and its answer to
    :meth:`Robot.move <imitarm.robots.robot.Robot.move>`. Whenever a robot could not be led for a while, because it was
    stopped, has slowed or does not answer, it is first brought to rest, and the retargeter begins anew from where the
    arm is: the person takes hold once more, and nothing jumps.

    Args:
        source: skeletons of one person, live or in real time.
        retargeter: the method.
        robot: to lead.
        safety: what every command passes through, whatever the method; None: one that keeps the limits of the arm, its
            links 10 mm apart, and touches nothing in the retargeter's scene.
        stream: the stream that ``source`` is fed by, for the latencies; None: it is none.
        recorder: is given the robot's motion from when the person first took hold.
        operator: is told at every step why a served robot can't be led, and whether it is stopped; answers whether it
            may move again.
        on_step: is called after every step.
        clock_ns: the time [ns], the same as that of ``stream`` and ``robot``.
        pace: of the control; None: real time.
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
        operator: Callable[[str, bool], bool] | None = None,
        on_step: Callable[[Moment], None] | None = None,
        clock_ns: Callable[[], int] = now_ns,
        pace: Pace | None = None,
    ) -> None:
        self.source, self.retargeter, self.robot = source, retargeter, robot
        self.tally = Tally()
        self.safety = SafetyFilter(robot.arm, dt=retargeter.dt) if safety is None else safety
        self._stream, self._recorder = stream, recorder
        self._operator, self._on_step = operator, on_step
        self._clock_ns = clock_ns
        self._pace = Pace(retargeter.dt) if pace is None else pace
        self._wire = robot if isinstance(robot, UdpRobot) else None
        self._rest = np.zeros(robot.arm.n_joints)
        self._engaged, self._closed, self._followed = False, False, False
        self._recorded = float("nan")  # time of the state that was recorded last, by the robot's clock
        self._arrival: Arrival | None = None
        self._made_from: dict[int, tuple[int, int]] = {}  # sequence of a command: row of the log, time of exposure

    def run(self, seconds: float | None = None) -> Tally:
        """Go on for some seconds, until the source is over, the robot is faulty, or the user presses Ctrl-C.

        Whatever happens, the robot is brought to rest.

        Args:
            seconds: None: until something else ends it.
        """
        dt, tally = self.retargeter.dt, self.tally
        ending: float | None = None
        if self._stream is not None:
            self._stream.flush()
        try:
            while not tally.reason:
                skeleton = self._newest()
                self._pace.wait()
                time = (self._pace.ticks - 1) * dt
                self.step(time, skeleton)
                tally.duration, tally.steps, tally.overruns = time + dt, tally.steps + 1, self._pace.overruns
                if self.source.over:
                    ending = time if ending is None else ending
                    if time - ending >= _ENDING:
                        tally.reason = "the source is over"
                if seconds is not None and tally.duration >= seconds - 1e-9:
                    tally.reason = "the time is up"
        except KeyboardInterrupt:
            tally.reason = "stopped by the user"
        finally:
            self.robot.stop(dt)
        return tally

    def step(self, time: float, skeleton: Skeleton | None) -> None:
        """Make one control step.

        Args:
            time: since the beginning [s].
            skeleton: the newest that has come since the last step; None: none has.
        """
        before, tally = self.robot.velocity, self.tally
        trouble = self._trouble()
        if trouble:
            self._engaged = False
            self._ask(trouble)
        elif not self._engaged:
            self._begin()
        else:
            self._lead(skeleton)
        doing = self.retargeter.latest.state if self._engaged else INTERRUPTED
        tally.doing[doing] += 1
        tally.frames += skeleton is not None
        if self._wire is not None:
            self._match_echoes(self._wire)
            if self._wire.interruptions != tally.interruptions:  # the set-point is the robot's own again
                tally.interruptions, self._engaged = self._wire.interruptions, False
        if self._engaged:
            self._measure(before)
        state = self.robot.state()
        self._record(time, doing, state)
        if self._on_step is not None:
            self._on_step(Moment(time, skeleton, self.retargeter.latest, state, doing, trouble))

    # --- what comes in

    def _newest(self) -> Skeleton | None:
        """Return the newest skeleton that comes until the next step is due, and when and how it came."""
        newest = None
        for _ in range(_BACKLOG):
            left = self._pace.left
            skeleton = None if self.source.over else self.source.read(left)
            if skeleton is not None:
                newest, now = skeleton, self._clock_ns()
                came = None if self._stream is None else self._stream.arrival
                self._arrival = Arrival(np.nan, np.nan, now) if came is None else came
            elif left == 0.0 or self.source.over:
                break
        return newest

    def _trouble(self) -> str:
        """Return why the robot can't be led; empty when it can."""
        if self._wire is None:
            if self.robot.fault:
                self.tally.reason = self.robot.fault
            return self.robot.fault
        self._wire.listen()
        if self._wire.fresh and self._wire.reported.status is Status.FAULT:
            self.tally.reason = self._wire.trouble
        return self._wire.trouble if not self._wire.ready else ""

    def _ask(self, trouble: str) -> None:
        """See how the robot is, and let the operator decide whether it may move again."""
        self.robot.move(self._rest, self.retargeter.dt)
        wire = self._wire
        if wire is None or self._operator is None or self.tally.reason:
            return
        stopped = wire.fresh and wire.reported.status is Status.STOPPED
        if self._operator(trouble, stopped) and stopped:
            wire.request_enable()

    # --- what goes out

    def _begin(self) -> None:
        """Bring the robot to rest, and let the retargeter begin from there."""
        self.robot.move(self._rest, self.retargeter.dt)
        if not self.robot.velocity.any():
            arm = self.robot.arm
            self.retargeter.start(np.clip(self.robot.set_point, arm.lower, arm.upper))
            self._engaged = True

    def _lead(self, skeleton: Skeleton | None) -> None:
        """Let the retargeter decide, and the robot do it."""
        robot, retargeter = self.robot, self.retargeter
        before, taken = retargeter.latest.q, self._clock_ns()
        retargeter.step(skeleton, robot.state().q)
        ready = self._clock_ns()
        self._grasp(retargeter.latest.closed)
        wanted = retargeter.latest.velocity + _FOLLOW * (before - robot.set_point)
        command = Command(np.zeros(6), joint_velocity=wanted)
        kept = self.safety.step(command, robot.set_point, robot.velocity, retargeter.scene)
        robot.move(kept.velocity, retargeter.dt)
        self.tally.clamped.update(robot.clamped)
        self.tally.filtered += kept.changed > 0.0
        self.tally.unsafe += not kept.safe
        if skeleton is not None and self._arrival is not None:
            self._note(self._arrival, taken, ready, self._clock_ns())

    def _grasp(self, closed: bool | None) -> None:
        """Close or open the gripper, if there is one and the hand has changed."""
        if closed is None or closed == self._closed or not self.robot.widest_opening > 0.0:
            return
        self._closed = closed
        self.robot.grasp(0.0 if closed else self.robot.widest_opening)

    # --- what is noted

    def _measure(self, before: Array) -> None:
        """Note how much of the limits the set-point takes."""
        arm, tally, velocity = self.robot.arm, self.tally, self.robot.velocity
        change = np.abs(velocity - before) / (arm.max_acceleration * self.retargeter.dt)
        tally.speed = max(tally.speed, float((np.abs(velocity) / arm.max_velocity).max()))
        tally.acceleration = max(tally.acceleration, float(change.max()))

    def _note(self, arrival: Arrival, taken: int, ready: int, sent: int) -> None:
        """Note the latencies of a skeleton as far as they are known now."""
        log = self.tally.latency
        row = log.begin()
        waits = {"expose": arrival.waited, "arrive": arrival.queued, "wait": 1e-9 * (taken - arrival.received_ns)}
        log.note(row, retarget=1e-9 * (ready - taken), send=1e-9 * (sent - ready), **waits)
        way = np.nan_to_num(arrival.waited) + np.nan_to_num(arrival.queued)
        exposed = arrival.received_ns - round(1e9 * float(way))
        if self._wire is None:
            log.note(row, total=1e-9 * (sent - exposed))
        elif self._wire.sequence is not None:
            if len(self._made_from) > _UNANSWERED:
                self._made_from.clear()
            self._made_from[self._wire.sequence] = row, exposed

    def _match_echoes(self, wire: UdpRobot) -> None:
        """Complete the rows of which the robot has told what became of the command."""
        for echo in wire.echoes():
            made = self._made_from.pop(echo.sequence, None)
            if made is not None:
                row, exposed = made
                total = 1e-9 * (echo.applied_ns - exposed)
                self.tally.latency.note(row, robot=echo.sent, apply=echo.applied, total=total)

    def _record(self, time: float, doing: str, state: ArmState) -> None:
        self._followed = self._followed or doing == "following"
        if self._recorder is not None and self._followed and state.time != self._recorded:
            self._recorded = state.time  # a robot at the end of a wire has not always told something new
            self._recorder.write(time, state.q)
