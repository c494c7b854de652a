"""One trial of stacking: a made-up person, a camera, a method, the simulated robot; and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.limbs import LimbLengths, measure_limbs
from imitarm.retarget.retargeter import Retargeter
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.tasks.operator import Operator, Sight
from imitarm.tasks.stack import CLOSED, OPEN, History, StackTask

Array = NDArray[np.float64]

DT = 0.01  # [s] control period
TIMEOUT = 90.0  # [s]
_WATCH_EVERY = 3  # control steps between two looks at the cubes
_SETTLE = 1.0  # [s] that the robot rests before the verdict
_FOLLOW = 5.0  # [1/s] how quickly the set-point is brought back to the commands after a limit cut one
_CALIBRATION = 3.0  # [s] for which a person holds an arm before the sensor, to have it measured


class Factory(Protocol):
    """Builds the method that is tried, for example ``ModernRetargeter``."""

    def __call__(self, arm: ArmModel, correspondence: Correspondence, *, dt: float) -> Retargeter:
        """Return a retargeter for this arm and this person."""
        ...


@dataclass(frozen=True, eq=False)
class StackResult:
    """What came of one trial; plain values, so that it can be pickled.

    Attributes:
        seed: of the person.
        repeat: which trial of this person.
        method: name of the method.
        success: whether four cubes stand in order.
        failure: one of :data:`imitarm.tasks.stack.FAILURES`; empty on success.
        reason: in words.
        stacked: cubes in the tower at the end, counted from cube 1.
        time: until the person was done, or time was up [s].
        path_length: of the tool [m].
        times: of the log, shape (n,) [s].
        joints: measured, shape (n, n_joints) [rad].
        torques: of the drives, shape (n, n_joints) [N m].
        tool: positions, shape (n, 3) [m].
        openings: of the gripper, shape (n,) [m].
        clamped: control steps in which the robot's limits changed the command.
        lengths: of the arm, as measured before the trial.
        skeletons: as the camera gave them.
        truth: the person as it truly was in each frame, also in those that the camera lost.
    """

    seed: int
    repeat: int
    method: str
    success: bool
    failure: str
    reason: str
    stacked: int
    time: float
    path_length: float
    times: Array
    joints: Array
    torques: Array
    tool: Array
    openings: Array
    clamped: int
    lengths: LimbLengths
    skeletons: tuple[Skeleton, ...]
    truth: tuple[Skeleton, ...]


def stack_correspondence(person: Person, lengths: LimbLengths | None = None) -> Correspondence:
    """Return what all methods are given for this task: motion one to one, the gripper looks down all the time."""
    lengths = LimbLengths(person.upper_arm, person.forearm) if lengths is None else lengths
    return Correspondence(lengths=lengths, orientation="fixed")


def calibrate(person: Person, camera: SkeletonCamera) -> LimbLengths:
    """Measure a person's arm as it is done before a trial: held before the sensor for 3 s."""
    seen, time = [], 0.0
    side = person.shoulder() + np.array([0.35, -0.1, -0.6]) * person.reach
    while time < _CALIBRATION:
        skeleton = camera.see(person.skeleton(time, side))
        if skeleton is not None:
            seen.append(skeleton)
        time = camera.next_time(time)
    return measure_limbs(seen)


def stack_once(
    seed: int,
    repeat: int,
    factory: Factory,
    *,
    arm: ArmModel | None = None,
    camera: Callable[[int], SkeletonCamera] = SkeletonCamera.from_seed,
    latency: float = 0.03,
    control: Control = "torque",
    timeout: float = TIMEOUT,
) -> StackResult:
    """Let person number ``seed`` stack the cubes by a method, and return what came of it.

    100 times a second: the camera's newest skeleton goes to the retargeter, its answer to the robot, and what the robot
    and the cubes then look like to the person. The person, the cubes' places and the camera's faults depend on
    ``seed`` and ``repeat`` alone; but the loop is closed, so what the person does depends on what the method did.

    Args:
        seed: of the person.
        repeat: which trial of this person.
        factory: of the method.
        arm: the Sawyer with the gripper, when it is loaded already.
        camera: makes the camera from a seed; by default one with 1 to 2 cm of noise and all the other faults.
        latency: from exposure until the skeleton is there [s].
        control: of the robot's drives; the softer ones by default, because contacts are to be expected.
        timeout: [s].

    Raises:
        InputError: when ``timeout`` or ``latency`` is not usable.
    """
    if not (0.0 < timeout <= 3600.0 and 0.0 <= latency <= 0.5):
        raise InputError(f"stack_once: needs timeout to 3600 s and latency to 0.5 s, got {timeout!r} and {latency!r}")
    return _Trial(seed, repeat, factory, arm, camera, latency, control).run(timeout)


class _Trial:
    """The state of one trial."""

    def __init__(
        self,
        seed: int,
        repeat: int,
        factory: Factory,
        arm: ArmModel | None,
        camera: Callable[[int], SkeletonCamera],
        latency: float,
        control: Control,
    ) -> None:
        self.seed, self.repeat, self.latency = seed, repeat, latency
        number = 1000 * seed + repeat
        self.task = StackTask(number)
        self.robot: SimulatedRobot = self.task.robot(arm, control=control)
        self.operator = Operator(seed, repeat)
        self.lengths = calibrate(self.operator.person, camera(2 * number + 1))
        self.camera = camera(2 * number)
        correspondence = stack_correspondence(self.operator.person, self.lengths)
        self.retargeter = factory(self.robot.arm, correspondence, dt=DT)
        self.retargeter.start(self.robot.set_point)
        self.history = History()
        self.skeletons: list[Skeleton] = []
        self.truth: list[Skeleton] = []
        self.exposure, self.given = 0.0, 0
        self.log: list[tuple[float, Array, Array, Array, float]] = []
        self.clamped, self.closed = 0, False
        self.tool = self.robot.tool_to_base.position

    def run(self, timeout: float) -> StackResult:
        """Go on until the person is done, the robot has stopped to protect itself, or time is up; then judge."""
        steps = round(timeout / DT)
        k = 0
        while k < steps and not self.operator.finished and not self.robot.fault:
            self.step(k * DT)
            if k % _WATCH_EVERY == 0:
                self.task.watch(self.robot, self.history)
            k += 1
        time = k * DT
        self.robot.stop(DT)
        for _ in range(round(_SETTLE / DT)):
            self.robot.move(np.zeros(self.robot.arm.n_joints), DT)
        self.task.watch(self.robot, self.history)
        return self.result(time)

    def step(self, time: float) -> None:
        """One control step."""
        self.operator.see(self.sight(time))
        self.expose(time)
        robot, before = self.robot, self.retargeter.latest.q
        self.retargeter.step(self.newest(time), robot.state().q)
        if self.retargeter.latest.closed is not None and self.retargeter.latest.closed != self.closed:
            self.closed = self.retargeter.latest.closed
            robot.grasp(CLOSED if self.closed else OPEN)
        robot.move(self.retargeter.latest.velocity + _FOLLOW * (before - robot.set_point), DT)
        self.clamped += bool(robot.clamped)
        state = robot.state()
        self.tool = robot.tool_to_base.position
        self.log.append((time + DT, state.q, state.torque, self.tool, robot.opening))

    def sight(self, time: float) -> Sight:
        """Return what there is to see."""
        robot = self.robot
        lamp = self.retargeter.latest.state.engaged
        return Sight(time, self.tool, robot.opening, self.task.cubes(robot), lamp)

    def expose(self, time: float) -> None:
        """Let the camera take the frames that are due."""
        while self.exposure <= time:
            truth = self.operator.act(self.exposure)
            self.truth.append(truth)
            seen = self.camera.see(truth)
            if seen is not None:
                self.skeletons.append(seen)
            self.exposure = self.camera.next_time(self.exposure)

    def newest(self, time: float) -> Skeleton | None:
        """Return the newest skeleton that has arrived since the last step."""
        newest = None
        while self.given < len(self.skeletons) and self.skeletons[self.given].time <= time - self.latency + 1e-9:
            newest = self.skeletons[self.given]
            self.given += 1
        return newest

    def result(self, time: float) -> StackResult:
        """Judge, and put everything together."""
        verdict = self.task.judge(self.robot, self.history)
        times, joints, torques, tool, openings = (np.array(column) for column in zip(*self.log, strict=True))
        return StackResult(
            self.seed,
            self.repeat,
            self.retargeter.name,
            verdict.success,
            verdict.failure,
            verdict.reason,
            verdict.stacked,
            time,
            float(np.linalg.norm(np.diff(tool, axis=0), axis=1).sum()),
            times,
            joints,
            torques,
            tool,
            openings,
            self.clamped,
            self.lengths,
            tuple(self.skeletons),
            tuple(self.truth),
        )
