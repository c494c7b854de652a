"""The recordings of the mapping benchmark: made-up people before made-up cameras, the same for every method."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.recording_plan import CAPTURED, REPEATS, Plan
from imitarm.capture.motion_capture import MotionCapture
from imitarm.capture.motions import DRAWINGS, REST, Truth, drawing, reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import HandState, Skeleton
from imitarm.errors import InputError, TaskFailedError, UnreachableError
from imitarm.evaluation.tracking import TrueArm, motion_end
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.posture import find_posture
from imitarm.retarget.correspondence import FACING, Correspondence, Orientation
from imitarm.retarget.fitting import fit_motion
from imitarm.retarget.limbs import LimbLengths
from imitarm.tasks.ideal import IdealFollower, ideal_camera
from imitarm.tasks.stack import StackTask
from imitarm.tasks.stack_trial import calibrate, stack_once

Array = NDArray[np.float64]

REACH = 0.80  # [m] from the Sawyer's shoulder to its wrist when it is stretched (METHODS A.5)
BEYOND = 1.25  # "edge" is mapped so much larger that the stretched arm of a person is beyond the robot's reach
_TAIL = 2.0  # [s] of rest at the end, so that settling can be seen
_STEP = 0.01  # [s] at which the truth is kept
_STRETCH = 4.0  # [s] from one full stretch to the next
_OUT = 1.02  # of the reach: as far as the arm is long, and a little more wished for
_MOCAP = Path("mocap_arm", "recording.tsv")
_TRIES = 5  # repeats of a person's stacking, until one succeeds with the ideal follower


@dataclass(frozen=True, eq=False)
class MappingRecording:
    """A recording with all that a method is given, and what it is never given: the truth.

    Attributes:
        plan: which it is.
        skeletons: as the camera gave them.
        correspondence: for all methods the same.
        start: posture of the robot at first, shape (n_joints,) [rad].
        true_times: shape (m,) [s] since the first skeleton.
        true_points: shoulder, elbow, wrist, hand, hand tip and thumb as they truly were, shape (m, 6, 3) [m], in the
            sensor's frame.
    """

    plan: Plan
    skeletons: tuple[Skeleton, ...]
    correspondence: Correspondence
    start: Array
    true_times: Array
    true_points: Array

    def true_arm(self, times: Array) -> TrueArm:
        """Return the true arm at the times (n,) of a run [s]; beyond the ends it is as it was there."""
        flat = self.true_points.reshape(len(self.true_times), -1)
        points = np.column_stack([np.interp(times, self.true_times, column) for column in flat.T])
        return TrueArm.from_points(times, points.reshape(-1, 6, 3), self.correspondence)

    def save(self, path: Path) -> None:
        """Write it aside, then rename; nothing in the file can be executed."""
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
        """Read what :meth:`save` wrote."""
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
    """Make a recording; the same plan gives the same one, whatever the method.

    Args:
        plan: which.
        arm: the robot that will follow it.

    Raises:
        InputError: when real data are asked for that are not there.
        TaskFailedError: when this person can't stack the cubes even with a gripper that is the own hand.
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
    if plan.kind == CAPTURED:  # bones of its own, and a motion that was not made for this robot
        lengths = LimbLengths(*np.median(np.linalg.norm(np.diff(points[:, :3], axis=1), axis=2), axis=0).tolist())
        wrist = FACING.apply(points[:, 2])
        fit = fit_motion(arm, wrist, wrist[0])
        start, scale = fit.q, fit.scale
    else:
        lengths = calibrate(person, plan.camera(2 * plan.number + 1))
        start, scale = _start(plan, arm, points[0]), _scale(plan, person)
    correspondence = Correspondence(lengths=lengths, scale=scale, orientation=task)
    return MappingRecording(plan, tuple(skeletons), correspondence, start, true_times, points)


def _scale(plan: Plan, person: Person) -> float:
    """Return the robot's motion over the person's: a centimetre is a centimetre, but where the edge is wanted."""
    return BEYOND * REACH / (person.upper_arm + person.forearm) if plan.kind == "edge" else 1.0


def _start(plan: Plan, arm: ArmModel, points: Array) -> Array:
    """Return the posture to begin in: that of the stacking task, else the wrist where the person's maps to."""
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
    """Reaches as inside, but every few seconds the arm is stretched out to its full length where it points."""
    inside, shoulder = reaching(person, plan.number, duration=plan.seconds), person.shoulder()
    begun, ended = REST, max(plan.seconds - 1.0, REST + _STRETCH)
    cycles = max(round((ended - begun) / _STRETCH), 1)

    def truth(time: float) -> Skeleton:
        away = inside(time).arm("right").wrist - shoulder
        share = min(max((time - begun) / (ended - begun), 0.0), 1.0)
        out = 0.5 - 0.5 * math.cos(2.0 * math.pi * cycles * share)
        return person.skeleton(time, shoulder + away * (1.0 + out * (_OUT * person.reach / np.linalg.norm(away) - 1.0)))

    return truth, _end(truth, plan.seconds + 8.0), "upright"


def _drawing(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    shapes = tuple(DRAWINGS)
    shape = shapes[(plan.person + plan.repeat) % len(shapes)]
    truth = drawing(person, plan.number, duration=plan.seconds, kind=shape)
    return truth, _end(truth, plan.seconds + 1.0), "upright"


def _stacking(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    """A person who stacks with a gripper that is where the hand is: no method has shaped it."""
    for k in range(_TRIES):
        done = stack_once(plan.person, plan.repeat + REPEATS * k, IdealFollower, camera=ideal_camera)
        if done.success:
            return _between(done.truth), done.truth[-1].time, "fixed"
    raise TaskFailedError(f"person {plan.person} stacked no tower in {_TRIES} tries with the ideal gripper")


def _captured(plan: Plan, person: Person) -> tuple[Truth, float, Orientation]:
    path = Path(plan.data) / _MOCAP
    if not path.is_file():
        raise InputError(f"{path}: the motion capture is not there; give the folder that holds {_MOCAP} with --data")
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
    """Return when a motion is over that is at ``latest`` [s]."""
    times = np.arange(0.0, latest, 0.02)
    return motion_end(times, np.array([truth(t).arm("right").wrist for t in times]))


def _between(frames: tuple[Skeleton, ...]) -> Truth:
    """Return a person in motion from frames, straight between them."""
    times = np.array([frame.time for frame in frames])
    positions = np.array([frame.positions for frame in frames])

    def truth(time: float) -> Skeleton:
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        share = float(np.clip((time - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0))
        at = positions[after - 1] + share * (positions[after] - positions[after - 1])
        return Skeleton(time, at, hand_states=frames[after - (share < 1.0)].hand_states)

    return truth


def beyond_reach(recording: MappingRecording, arm: ArmModel) -> float:
    """Return the share of the time in which the clutch's law wants the robot's wrist farther than its arm is long.

    The tool is taken to keep its rotation.

    Raises:
        InputError: when the arm's file does not say where shoulder and wrist are.
    """
    shoulder, _, wrist = arm.sew_points(recording.start)
    true = recording.true_arm(recording.true_times)
    wanted = wrist + recording.correspondence.scale * (true.wrist - true.wrist[0])
    return float(np.mean(np.linalg.norm(wanted - shoulder, axis=1) > REACH))
