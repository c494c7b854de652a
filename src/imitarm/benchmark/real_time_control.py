"""The control process of the real-time benchmark: the arm sweeps back and forth, and every period is timed."""

from __future__ import annotations

import gc
import itertools
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from numpy.typing import ArrayLike

from imitarm.benchmark.real_time import Shared
from imitarm.benchmark.real_time_world import CLEARANCE, RealTimeSetup
from imitarm.command import Command
from imitarm.compiled import library
from imitarm.control_loop import Step, reproduce
from imitarm.errors import TaskFailedError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.policies import Observation, Policy
from imitarm.robots.udp import UdpRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Obstacle, Scene
from imitarm.transmission.rate import RateLimiter
from imitarm.transmission.sockets import Address

_WARM_UP = 0.5  # [s] of motion before the measurement; the first steps build what the later steps reuse
_LONGEST = 2.5  # duration of one motion over its learned duration
_FIRST_SCENE = 60.0  # [s] until the first obstacle must have been tracked


class _TimedRobot(UdpRobot):
    """A remote robot that remembers when the last command was sent.

    Attributes:
        sent: time at which the last command was sent [ns].
    """

    sent = 0

    def move(self, velocity: ArrayLike, dt: float) -> ArmState:
        """Send a command, and note the time."""
        state = super().move(velocity, dt)
        self.sent = time.monotonic_ns()
        return state


class _Limited(Policy):
    """A policy that also finishes when the duration of the measurement is over.

    The argument ``timeout`` of ``reproduce`` counts steps, so missed periods would prolong the measurement.
    """

    def __init__(self, policy: Policy, over: Callable[[], bool]) -> None:
        self._policy, self._over = policy, over

    def reset(self, observation: Observation) -> None:
        """Start the motion."""
        self._policy.reset(observation)

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command of the policy."""
        return self._policy.step(observation, dt)

    def finished(self, observation: Observation) -> bool:
        """Return whether the policy has finished, or the duration is over."""
        return self._over() or self._policy.finished(observation)


class TimedLoop:
    """Starts the control periods on schedule, returns the newest tracked scene, and records the times of each period.

    :meth:`observe` is the argument ``observe`` of :func:`~imitarm.control_loop.reproduce`. As ``reproduce`` calls it at
    the start of each step, it can also wait there until the next period is due.

    **Clock of the scenes.** A scene has the stamp of its image, on the clock of the simulation. ``reproduce`` counts
    the steps, and so its clock falls behind by one period if a period is missed. When a scene arrives, its age is the
    newest simulated time minus its stamp. On the clock of the loop, the new stamp is the time of the step minus this
    age. Missed periods therefore cause no lasting error.

    Args:
        shared: shared memory with the newest simulated time.
        scenes: connection on which the tracker sends its scenes.
        robot: robot that is controlled.
        dt: control period [s].

    Attributes:
        n_periods: number of periods after which the measurement is over, including the skipped ones.
        late: delay of the start of each step [ns].
        computed: time from the start of each step until the command was sent [ns].
        worked: time from the start of each step to the end of its last calculation [ns].
        ages: age of the scene that each step used [s].
        skipped: number of periods in which no step was started.
    """

    def __init__(self, shared: Shared, scenes: Connection, robot: _TimedRobot, dt: float) -> None:
        self._shared, self._scenes, self._robot, self._dt = shared, scenes, robot, dt
        self._received, self._stamp, self._scene = 0, 0.0, Scene()
        self._obstacles: tuple[Obstacle, ...] = ()
        self.clear(0)
        self.begin()

    def clear(self, n_periods: int) -> None:
        """Forget all measured times, and start a measurement of ``n_periods`` periods."""
        self.n_periods = n_periods
        self.late: list[int] = []
        self.computed: list[int] = []
        self.worked: list[int] = []
        self.ages: list[float] = []
        self.skipped = 0

    @property
    def periods(self) -> int:
        """Number of measured periods, including the skipped ones."""
        return len(self.late) + self.skipped

    def over(self) -> bool:
        """Return whether all periods of the measurement have passed."""
        return self.periods >= self.n_periods

    def begin(self) -> None:
        """Begin a motion with a new schedule."""
        self._limiter = RateLimiter(self._dt)
        self._resets, self._age = True, 0.0
        self._started = self._sent = self._ended = 0
        self._old_clock = True  # the stamp of the scene is on the clock of the motion before

    def observe(self, t: float) -> Scene:
        """Wait until the next period is due, and return the newest scene; ``t`` [s] is the time of the step.

        The first call in a motion is made by the reset of the policy, and does not wait.
        """
        if self._resets:
            self._resets = False
            return self._newest(t)
        self.end_step(time.monotonic_ns())
        self.skipped += self._limiter.wait()
        self._started = time.monotonic_ns()
        scene = self._newest(t)
        self._age = self._shared.time - self._stamp
        return scene

    def on_step(self, _: Step) -> None:
        """Note that a step is complete; stop if the other processes stop.

        Raises:
            TaskFailedError: when the processes must stop.
        """
        self._sent, self._ended = self._robot.sent, time.monotonic_ns()
        if self._shared.stopping:
            raise TaskFailedError("the measurement was stopped")

    def end_step(self, now: int | None = None) -> None:
        """Record the last step, unless it has sent no command; ``now`` is the current time [ns]."""
        if self._sent > self._started:
            self.late.append(round(1e9 * self._limiter.late))
            self.computed.append(self._sent - self._started)
            self.worked.append((self._ended if now is None else now) - self._started)
            self.ages.append(self._age)
        self._sent = 0

    def wait_for_obstacles(self) -> None:
        """Wait until the tracker has sent a scene with obstacles.

        Raises:
            TaskFailedError: when no obstacle is tracked in time.
        """
        until = time.monotonic() + _FIRST_SCENE
        while not self._newest(0.0).obstacles:
            if time.monotonic() > until or self._shared.stopping:
                raise TaskFailedError(f"the tracker has tracked no obstacle within {_FIRST_SCENE:g} s")
            time.sleep(0.02)

    def _newest(self, t: float) -> Scene:
        """Return the newest scene that has arrived, with its stamp on the clock of the loop."""
        arrived = self._shared.scenes  # a number in shared memory is read faster than a connection is asked
        if arrived > self._received or self._old_clock:
            while self._received < arrived:
                self._stamp, self._obstacles = self._scenes.recv()
                self._received += 1
            self._scene = Scene(None, self._obstacles, t - (self._shared.time - self._stamp))
            self._old_clock = False
        return self._scene


def control(setup: RealTimeSetup, shared: Shared, simulation: Connection, scenes: Connection) -> dict[str, Any]:
    """Let the arm sweep back and forth until the duration is over, and return the measured times.

    Args:
        setup: what is measured.
        shared: shared memory.
        simulation: connection to the simulation. It receives the start posture, and sends the address of the server.
        scenes: connection on which the tracker sends its scenes.

    Raises:
        TaskFailedError: when the robot does not follow, or no obstacle is tracked.
    """
    arm, start, policies = setup.motions()
    simulation.send(start)
    address: Address = simulation.recv()
    shared.start()
    with _TimedRobot(arm, address) as robot:
        loop = TimedLoop(shared, scenes, robot, setup.dt)
        loop.wait_for_obstacles()
        # A collection of all garbage takes tens of milliseconds, much longer than a period. The loop makes hardly any
        # garbage that only the collector can find, so it is collected between two motions, while the arm is at rest.
        gc.collect()
        gc.freeze()
        gc.disable()
        loop.clear(round(_WARM_UP * setup.rate))
        _move(setup, arm, policies[0], robot, loop)
        loop.clear(round(setup.duration * setup.rate))
        shared.measure()
        motions = []
        for policy in itertools.cycle(policies):
            if loop.over():
                break
            motions.append(_move(setup, arm, policy, robot, loop))
            gc.collect()
    shared.stop()
    return {
        "late": loop.late,
        "computed": loop.computed,
        "worked": loop.worked,
        "ages": loop.ages,
        "skipped": loop.skipped,
        "motions": motions,
        "interruptions": robot.interruptions,
        "compiled": library() is not None,
    }


def _move(setup: RealTimeSetup, arm: ArmModel, policy: Policy, robot: _TimedRobot, loop: TimedLoop) -> dict[str, Any]:
    """Make one motion; return whether it has finished, why it has ended, and what policy and filter did."""
    robot.enable()
    loop.begin()
    rollout = reproduce(
        _Limited(policy, loop.over),
        robot,
        loop.observe,
        dt=setup.dt,
        timeout=_LONGEST * policy.skill.duration_,
        safety=SafetyFilter(arm, dt=setup.dt, clearance=CLEARANCE),
        contact=False,  # the observer needs the torques of every period, but after a missed period some are unknown
        on_step=loop.on_step,
    )
    loop.end_step()
    details = rollout.details
    return {
        "finished": bool(rollout.success) and not loop.over(),
        "reason": rollout.reason,
        "steps": sum(details["statuses"].values()),
        "avoiding": details["statuses"].get("avoiding", 0),
        "filtered": details["filtered"],
        "unsafe": details["unsafe"],
    }
