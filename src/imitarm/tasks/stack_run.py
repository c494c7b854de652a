"""run_stack: one run of the stacking task with a simulated person, a camera, a retargeter and the simulated robot.

``IdealFollower`` is a reference for comparison: its gripper follows the true hand without filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.person import Person
from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.pose import matrix_to_quaternion
from imitarm.kinematics.tasks import TwistTask
from imitarm.retarget.arm_estimator import ArmEstimate
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import EngagementRule
from imitarm.retarget.human_arm import hand_rotation
from imitarm.retarget.limbs import LimbLengths, measure_limbs
from imitarm.retarget.retargeter import Goal, Retargeter
from imitarm.robots.simulated import Control, SimulatedRobot
from imitarm.tasks.stack import CLOSED, OPEN, CubeHistory, StackTask
from imitarm.tasks.stacking_operator import OperatorView, SimulatedOperator

Array = NDArray[np.float64]

DT = 0.01  # [s] control period
TIMEOUT = 90.0  # [s]
_WATCH_EVERY = 3  # control steps between two updates of the history
_SETTLE = 1.0  # [s] the robot rests before the result is evaluated
_FEEDBACK = 5.0  # [1/s] gain that returns the set-point to the retargeter's joint positions after a limit
_CALIBRATION = 3.0  # [s] the person holds an arm before the sensor, to have it measured
_IDEAL_GAIN = 0.3  # fraction of the error that the ideal follower corrects in a step; with more the joints cannot brake
_CLOSED_STATE = {HandState.OPEN: False, HandState.CLOSED: True}


class RetargeterFactory(Protocol):
    """Builds a retargeter, for example ``ModernRetargeter``."""

    def __call__(self, arm: ArmModel, correspondence: Correspondence, *, dt: float) -> Retargeter:
        """Return a retargeter for this arm and this person."""
        ...


@dataclass(frozen=True, eq=False)
class StackResult:
    """The result of one run; it can be pickled.

    Attributes:
        seed: seed of the person.
        repeat: number of the run of this person.
        method: name of the retargeter.
        success: whether four cubes stand in order.
        failure: one of :data:`imitarm.tasks.stack.FAILURES`; empty on success.
        reason: explanation of success or failure.
        stacked: number of cubes in the tower at the end, counted from cube 1.
        time: time at which the person finished, or the timeout [s].
        path_length: length of the tool's path [m].
        times: times of the log, shape (n,) [s].
        joints: measured joint positions, shape (n, n_joints) [rad].
        torques: torques of the drives, shape (n, n_joints) [N m].
        tool: positions of the tool, shape (n, 3) [m].
        openings: openings of the gripper, shape (n,) [m].
        clamped: number of control steps in which the robot's limits changed the command.
        lengths: lengths of the person's upper arm and forearm, as measured before the run.
        skeletons: skeletons from the camera.
        truth: true skeletons at the times of all camera frames, including frames that the camera lost.
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
    """Return the mapping from the person's motion to the robot's: the scale is 1, and the gripper points down."""
    lengths = LimbLengths(person.upper_arm, person.forearm) if lengths is None else lengths
    return Correspondence(lengths=lengths, orientation="fixed")


def calibrate_limbs(person: Person, camera: SkeletonCamera) -> LimbLengths:
    """Measure the limb lengths of a person who holds the arm in front of the sensor for 3 s."""
    seen, time = [], 0.0
    side = person.shoulder() + np.array([0.35, -0.1, -0.6]) * person.reach
    while time < _CALIBRATION:
        skeleton = camera.see(person.skeleton(time, side))
        if skeleton is not None:
            seen.append(skeleton)
        time = camera.next_time(time)
    return measure_limbs(seen)


def run_stack(
    seed: int,
    repeat: int,
    factory: RetargeterFactory,
    *,
    arm: ArmModel | None = None,
    camera: Callable[[int], SkeletonCamera] = SkeletonCamera.from_seed,
    latency: float = 0.03,
    control: Control = "torque",
    timeout: float = TIMEOUT,
) -> StackResult:
    """Let person number ``seed`` stack the cubes with a retargeter.

    The loop runs 100 times per second. In each step, the retargeter receives the newest skeleton from the camera. The
    robot then receives a joint velocity from the retargeter, and the person sees the robot and the cubes. The person,
    the positions of the cubes and the errors of the camera depend only on ``seed`` and ``repeat``. The person reacts to
    what the robot does, so the motion of the person also depends on the retargeter.

    Args:
        seed: seed of the person.
        repeat: number of the run of this person.
        factory: function that builds the retargeter.
        arm: model of the Sawyer with the gripper; None: the model is loaded here.
        camera: function that builds the camera from a seed. The default camera has noise of 1 to 2 cm and all other
            errors that the simulation offers.
        latency: time from the exposure of a camera frame until its skeleton arrives [s].
        control: control mode of the robot's drives. The default is computed torque, which is compliant, because the
            gripper touches the cubes.
        timeout: longest duration [s].

    Raises:
        InputError: when ``timeout`` or ``latency`` is out of range.
    """
    if not (0.0 < timeout <= 3600.0 and 0.0 <= latency <= 0.5):
        raise InputError(
            "run_stack: timeout must be above 0 and at most 3600 s, latency from 0 to 0.5 s, "
            f"got {timeout!r} and {latency!r}"
        )
    return _StackRun(seed, repeat, factory, arm, camera, latency, control).run(timeout)


class _StackRun:
    """The state of one run of the task."""

    def __init__(
        self,
        seed: int,
        repeat: int,
        factory: RetargeterFactory,
        arm: ArmModel | None,
        camera: Callable[[int], SkeletonCamera],
        latency: float,
        control: Control,
    ) -> None:
        self.seed, self.repeat, self.latency = seed, repeat, latency
        number = 1000 * seed + repeat
        self.task = StackTask(number)
        self.robot: SimulatedRobot = self.task.robot(arm, control=control)
        self.operator = SimulatedOperator(seed, repeat)
        self.lengths = calibrate_limbs(self.operator.person, camera(2 * number + 1))
        self.camera = camera(2 * number)
        correspondence = stack_correspondence(self.operator.person, self.lengths)
        self.retargeter = factory(self.robot.arm, correspondence, dt=DT)
        self.retargeter.start(self.robot.set_point)
        self.history = CubeHistory()
        self.skeletons: list[Skeleton] = []
        self.truth: list[Skeleton] = []
        self.next_exposure, self.n_used = 0.0, 0
        self.log: list[tuple[float, Array, Array, Array, float]] = []
        self.clamped, self.closed = 0, False
        self.tool = self.robot.tool_to_base.position

    def run(self, timeout: float) -> StackResult:
        """Run until the person has finished, the robot stops itself, or the timeout is reached; return the result."""
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
        """Make one control step."""
        self.operator.see(self.view(time))
        self.expose(time)
        robot, before = self.robot, self.retargeter.latest.q
        self.retargeter.step(self.newest(time), robot.state().q)
        if self.retargeter.latest.closed is not None and self.retargeter.latest.closed != self.closed:
            self.closed = self.retargeter.latest.closed
            robot.grasp(CLOSED if self.closed else OPEN)
        robot.move(self.retargeter.latest.velocity + _FEEDBACK * (before - robot.set_point), DT)
        self.clamped += bool(robot.clamped)
        state = robot.state()
        self.tool = robot.tool_to_base.position
        self.log.append((time + DT, state.q, state.torque, self.tool, robot.opening))

    def view(self, time: float) -> OperatorView:
        """Return what the operator sees now."""
        robot = self.robot
        following = self.retargeter.latest.state.engaged
        return OperatorView(time, self.tool, robot.opening, self.task.cubes(robot), following)

    def expose(self, time: float) -> None:
        """Let the camera take the frames that are due."""
        while self.next_exposure <= time:
            truth = self.operator.act(self.next_exposure)
            self.truth.append(truth)
            seen = self.camera.see(truth)
            if seen is not None:
                self.skeletons.append(seen)
            self.next_exposure = self.camera.next_time(self.next_exposure)

    def newest(self, time: float) -> Skeleton | None:
        """Return the newest skeleton that has arrived since the last step."""
        newest = None
        while self.n_used < len(self.skeletons) and self.skeletons[self.n_used].time <= time - self.latency + 1e-9:
            newest = self.skeletons[self.n_used]
            self.n_used += 1
        return newest

    def result(self, time: float) -> StackResult:
        """Evaluate the run and return its result."""
        evaluation = self.task.evaluate(self.robot, self.history)
        times, joints, torques, tool, openings = (np.array(column) for column in zip(*self.log, strict=True))
        return StackResult(
            self.seed,
            self.repeat,
            self.retargeter.name,
            evaluation.success,
            evaluation.failure,
            evaluation.reason,
            evaluation.stacked,
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


class IdealFollower(Retargeter):
    """A retargeter that moves the tool to its target by inverse kinematics, without filters or corrections.

    This retargeter assumes that every skeleton is exact. With an :func:`ideal_camera`, the robot's tool follows the
    person's hand with a lag of a few hundredths of a second. The benchmark records simulated people who work with this
    retargeter, and gives these recordings to every retargeter.
    """

    name: ClassVar[str] = "ideal"
    rule: ClassVar[EngagementRule] = EngagementRule(seen_for=0.0, follow_until=math.inf)

    def _begin(self) -> None:
        self._rotation = np.array([1.0, 0.0, 0.0, 0.0])
        self._closed: bool | None = None

    def _rest_at(self, q: Array) -> None:
        self._velocity = np.zeros(self.arm.n_joints)

    def _see(self, skeleton: Skeleton | None) -> ArmEstimate | None:
        """Return the person's arm exactly as in the skeleton."""
        if skeleton is None:
            return None
        arm = skeleton.arm(self.correspondence.side)
        if not arm.seen:
            return None
        points = self.correspondence.sensor_to_base.apply(arm.points)
        rotation = hand_rotation(points[2], points[4], points[5])
        self._rotation = self._rotation if rotation is None else matrix_to_quaternion(rotation)
        self._closed = _CLOSED_STATE.get(arm.hand_state, self._closed)
        still, sure = np.zeros((3, 3)), (1.0, 1.0, 1.0)
        shoulder, elbow, wrist = points[:3]
        return ArmEstimate(arm.time, shoulder, elbow, wrist, still, self._rotation, still[0], sure, self._closed)

    def _advance(self, goal: Goal | None, measured: Array) -> Array:
        q, twist = self.latest.q, np.zeros(6)
        if goal is not None:
            twist = (_IDEAL_GAIN / self.dt) * self.arm.tool_pose(q).error_to(goal.target)
        self._velocity = solve_ik(self.arm, q, TwistTask(twist), dt=self.dt, velocity=self._velocity)
        return q + self.dt * self._velocity


def ideal_camera(seed: int = 0) -> SkeletonCamera:
    """Return a camera that reports the true skeleton 100 times per second."""
    return SkeletonCamera.ideal(rate=100.0)
