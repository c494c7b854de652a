"""The recordings of the mapping benchmark: simulated cameras record simulated people.

All methods use the same recordings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.formats import MotionCapture
from imitarm.capture.motions import DRAWINGS, REST, Truth, drawing, reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.errors import InputError, TaskFailedError, UnknownNameError, UnreachableError
from imitarm.evaluation.tracking import TrueArm, motion_end
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.retarget.correspondence import FACING, Correspondence, Orientation
from imitarm.retarget.fitting import fit_motion
from imitarm.retarget.limbs import LimbLengths
from imitarm.tasks.stack import StackTask
from imitarm.tasks.stack_run import IdealFollower, calibrate_limbs, ideal_camera, run_stack

Array = NDArray[np.float64]

KINDS = ("inside", "edge", "drawing", "stacking")
"""Kinds of recordings of simulated people.

In "inside", the person reaches to points well inside the robot's workspace. In "edge", the person also stretches the
arm every 4 s, so that the target is farther away than the robot can reach. In "drawing", the person draws circles,
eights and waves. In "stacking", the person stacks four cubes."""
CAPTURED = "captured"
"""The kind of recording that needs real data: a simulated camera observes a real arm that motion capture has
recorded."""

REPEATS = 100
"""Largest number of recordings of one kind and person. A larger number would reuse the seeds of the next person."""
_LONGEST = 120.0  # [s] of a recording

REACH = 0.80  # [m] from the Sawyer's shoulder to its wrist when it is stretched
BEYOND = 1.25  # scale of "edge": with it, a person's stretched arm is beyond the robot's reach
_TAIL = 2.0  # [s] of rest at the end, to measure settling
_STEP = 0.01  # [s] between samples of the truth
_STRETCH = 4.0  # [s] from one full stretch to the next
_OUT = 1.02  # of the reach: a little farther than the arm is long
_MOCAP = Path("mocap_arm", "recording.tsv")
_TRIES = 5  # trials of a person, until one stacks the tower with the ideal follower


@dataclass(frozen=True)
class Plan:
    """The definition of a recording, which contains only text and numbers.

    Attributes:
        kind: one of :data:`KINDS`, or :data:`CAPTURED`.
        person: seed of the simulated person. The seed determines the lengths of the limbs and the habits of motion.
        repeat: which recording of this person, from 0 to 99. The number also determines the random motion and the
            camera's errors. For motion capture, it is the number of the simulated camera.
        seconds: approximate duration of reaching and drawing motions, and largest duration of motion capture [s]. The
            kind "stacking" ignores it.
        sigma: standard deviation of the camera's error [m]; None: 1 to 2 cm, chosen by the seed.
        data: folder of real recordings; only for the kind :data:`CAPTURED`.

    Raises:
        UnknownNameError: when there is no such kind.
        InputError: when a number is out of range.
    """

    kind: str
    person: int
    repeat: int = 0
    seconds: float = 10.0
    sigma: float | None = None
    data: str = ""

    def __post_init__(self) -> None:
        if self.kind not in {*KINDS, CAPTURED}:
            raise UnknownNameError.among("kind of recording", self.kind, (*KINDS, CAPTURED))
        if self.person < 0 or not 0 <= self.repeat < REPEATS or not 4.0 <= self.seconds <= _LONGEST:
            raise InputError(
                f"Plan: person must be at least 0, repeat from 0 to {REPEATS - 1}, and seconds from 4 to "
                f"{_LONGEST:g}; got {self}"
            )
        if self.sigma is not None and not 0.0 <= self.sigma <= 0.1:
            raise InputError(f"Plan: sigma must be between 0 and 0.1 m, got {self.sigma!r}")

    @property
    def number(self) -> int:
        """The unique seed of this recording."""
        return 10 * (REPEATS * self.person + self.repeat) + (*KINDS, CAPTURED).index(self.kind)

    def camera(self, number: int) -> SkeletonCamera:
        """Return a simulated camera with realistic errors; ``number`` is its seed."""
        return SkeletonCamera.from_seed(number) if self.sigma is None else SkeletonCamera(number, sigma=self.sigma)


@dataclass(frozen=True, eq=False)
class MappingRecording:
    """A recording, and the true motion of the recorded person.

    The methods receive only the skeletons, the correspondence and the start posture.

    Attributes:
        plan: the definition of the recording.
        skeletons: skeletons that the simulated camera measured.
        correspondence: map from the person's motion to the robot's motion, which all methods use.
        start: start posture of the robot, shape (n_joints,) [rad].
        true_times: times of the true positions, shape (m,) [s]. Time 0 is the time of the first skeleton.
        true_points: true positions of shoulder, elbow, wrist, hand, hand tip and thumb, shape (m, 6, 3) [m], in the
            sensor's frame.
    """

    plan: Plan
    skeletons: tuple[Skeleton, ...]
    correspondence: Correspondence
    start: Array
    true_times: Array
    true_points: Array

    def true_arm(self, times: Array) -> TrueArm:
        """Return the true arm of the person at ``times``, shape (n,) [s], interpolated linearly.

        Before the first and after the last recorded time, the arm has its first or last recorded position.
        """
        flat = self.true_points.reshape(len(self.true_times), -1)
        points = np.column_stack([np.interp(times, self.true_times, column) for column in flat.T])
        return TrueArm.from_points(times, points.reshape(-1, 6, 3), self.correspondence)

    def save(self, path: Path) -> None:
        """Write the recording to a NumPy file (.npz) without executable code.

        A failure never leaves an incomplete file.
        """
        c, lengths = self.correspondence, self.correspondence.lengths
        assert lengths is not None
        aside = path.with_name(f".{path.name}.{np.random.default_rng().integers(1 << 62):x}.part")
        try:
            with aside.open("wb") as file:
                np.savez_compressed(
                    file,
                    times=[s.time for s in self.skeletons],
                    positions=[s.positions for s in self.skeletons],
                    tracking=[s.tracking for s in self.skeletons],
                    hands=[s.hand_states for s in self.skeletons],
                    start=self.start,
                    true_times=self.true_times,
                    true_points=self.true_points,
                    lengths=[lengths.upper_arm, lengths.forearm, *lengths.spread, lengths.n_frames],
                    scale=c.scale,
                    orientation=c.orientation,
                )
            aside.replace(path)
        finally:
            aside.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: Path, plan: Plan) -> MappingRecording:
        """Read a recording from a file that :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            seen = zip(file["times"], file["positions"], file["tracking"], file["hands"], strict=True)
            skeletons = tuple(Skeleton(t, p, k, (HandState(left), HandState(right))) for t, p, k, (left, right) in seen)
            upper, fore, first, second, n = file["lengths"].tolist()
            correspondence = Correspondence(
                lengths=LimbLengths(upper, fore, (first, second), int(n)),
                scale=float(file["scale"]),
                orientation=str(file["orientation"]),  # type: ignore[arg-type]  # checked there
            )
            return cls(plan, skeletons, correspondence, file["start"], file["true_times"], file["true_points"])


def make_recording(plan: Plan, arm: ArmModel) -> MappingRecording:
    """Make a recording. The same plan always gives the same recording.

    Args:
        plan: the definition of the recording.
        arm: the robot that will follow the recording; determines the start posture.

    Raises:
        InputError: when the recording needs real data that are missing.
        TaskFailedError: when the person can't stack the cubes even with an ideal gripper, which moves exactly like the
            hand.
    """
    person = Person.from_seed(plan.person)
    truth, end, task = _MAKERS[plan.kind](plan, person)
    camera = plan.camera(2 * plan.number)
    skeletons, time = [], 0.0
    while time <= end + _TAIL:
        seen = camera.see(truth(time))
        if seen is not None:
            skeletons.append(seen)
        time = camera.next_time(time)
    first = skeletons[0].time
    true_times = np.arange(0.0, skeletons[-1].time - first + _STEP, _STEP)
    points = np.array([truth(first + t).arm("right").points for t in true_times])
    if plan.kind == CAPTURED:  # measured bones, and a motion that was not made for this robot
        lengths = LimbLengths(*np.median(np.linalg.norm(np.diff(points[:, :3], axis=1), axis=2), axis=0).tolist())
        wrist = FACING.apply(points[:, 2])
        fit = fit_motion(arm, wrist, wrist[0])
        start, scale = fit.q, fit.scale
    else:
        lengths = calibrate_limbs(person, plan.camera(2 * plan.number + 1))
        start, scale = _start(plan, arm, points[0]), _scale(plan, person)
    correspondence = Correspondence(lengths=lengths, scale=scale, orientation=task)
    return MappingRecording(plan, tuple(skeletons), correspondence, start, true_times, points)


def _scale(plan: Plan, person: Person) -> float:
    """Return the scale: robot motion divided by the person's motion. It is 1 for all kinds except "edge"."""
    return BEYOND * REACH / (person.upper_arm + person.forearm) if plan.kind == "edge" else 1.0


def _start(plan: Plan, arm: ArmModel, points: Array) -> Array:
    """Return the start posture of the robot.

    For stacking, the task defines it. Otherwise it matches the person's first wrist position.
    """
    if plan.kind == "stacking":
        return StackTask().start_posture(arm)
    s, e, w = FACING.apply(points[:3])
    reach = np.linalg.norm(e - s) + np.linalg.norm(w - e)
    shoulder, _, wrist = arm.sew_points(arm.home)
    tool = arm.tool_pose(arm.home)
    try:
        shift = shoulder + REACH / reach * (w - s) - wrist
        return find_posture(arm, Pose(tool.position + shift, tool.quaternion), q0=arm.home, restarts=0)
    except UnreachableError:
        return arm.home


def _inside(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    truth = reaching(person, plan.number, duration=plan.seconds)
    return truth, _end(truth, plan.seconds + 8.0), "upright"


def _edge(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    """Return reaching motions as in the kind "inside", but with the arm fully stretched every few seconds."""
    inside, shoulder = reaching(person, plan.number, duration=plan.seconds), person.shoulder()
    begun, ended = REST, max(plan.seconds - 1.0, REST + _STRETCH)
    cycles = max(round((ended - begun) / _STRETCH), 1)

    def truth(time: float) -> Skeleton:
        away = inside(time).arm("right").wrist - shoulder
        fraction = min(max((time - begun) / (ended - begun), 0.0), 1.0)
        out = 0.5 - 0.5 * math.cos(2.0 * math.pi * cycles * fraction)
        return person.skeleton(time, shoulder + away * (1.0 + out * (_OUT * person.reach / np.linalg.norm(away) - 1.0)))

    return truth, _end(truth, plan.seconds + 8.0), "upright"


def _drawing(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    shapes = tuple(DRAWINGS)
    shape = shapes[(plan.person + plan.repeat) % len(shapes)]
    truth = drawing(person, plan.number, duration=plan.seconds, kind=shape)
    return truth, _end(truth, plan.seconds + 1.0), "upright"


def _stacking(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    """Return the motion of a person who stacks with a gripper that moves exactly like the hand (no retargeter)."""
    for k in range(_TRIES):
        done = run_stack(plan.person, plan.repeat + REPEATS * k, IdealFollower, camera=ideal_camera)
        if done.success:
            return _between(done.truth), done.truth[-1].time, "fixed"
    raise TaskFailedError(
        f"person {plan.person} did not stack the tower in {_TRIES} trials, although the gripper moved exactly like "
        "the hand; choose another person"
    )


def _captured(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    path = Path(plan.data) / _MOCAP
    if not path.is_file():
        raise InputError(
            f"{path}: the motion capture data are missing; give the folder that contains {_MOCAP} with --data"
        )
    capture = MotionCapture.load(path)
    moving = capture.truth(person)
    end = min(capture.duration, plan.seconds)

    def truth(time: float) -> Skeleton:
        still = moving(min(max(time - REST, 0.0), end))
        return Skeleton(time, still.positions, still.tracking, still.hand_states)

    return truth, end + REST, "upright"


_MAKERS: dict[str, Callable[[Plan, Person], tuple[Truth, float, Orientation]]] = {
    "inside": _inside,
    "edge": _edge,
    "drawing": _drawing,
    "stacking": _stacking,
    CAPTURED: _captured,
}


def _end(truth: Truth, latest: float) -> float:
    """Return the time at which a motion ends, but at most ``latest`` [s]."""
    times = np.arange(0.0, latest, 0.02)
    return motion_end(times, np.array([truth(t).arm("right").wrist for t in times]))


def _between(frames: tuple[Skeleton, ...]) -> Truth:
    """Return the motion of a person as a function of time, by linear interpolation between frames."""
    times = np.array([frame.time for frame in frames])
    positions = np.array([frame.positions for frame in frames])

    def truth(time: float) -> Skeleton:
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        fraction = float(np.clip((time - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0))
        at = positions[after - 1] + fraction * (positions[after] - positions[after - 1])
        return Skeleton(time, at, hand_states=frames[after - (fraction < 1.0)].hand_states)

    return truth


def beyond_reach(recording: MappingRecording, arm: ArmModel) -> float:
    """Return the fraction of the time in which the target of the robot's wrist is beyond the reach of the arm.

    The target is the start position of the robot's wrist plus the scaled displacement of the person's wrist. The
    function assumes that the tool keeps its orientation.

    Raises:
        InputError: when the arm's file does not define shoulder and wrist.
    """
    shoulder, _, wrist = arm.sew_points(recording.start)
    true = recording.true_arm(recording.true_times)
    target = wrist + recording.correspondence.scale * (true.wrist - true.wrist[0])
    return float(np.mean(np.linalg.norm(target - shoulder, axis=1) > REACH))
