"""Experiment and Result: run one retargeting method on a recording or in a closed-loop trial, and save the result."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time as clock
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.recordings import CAPTURED, KINDS, MappingRecording, Plan, beyond_reach, make_recording
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.errors import FileFormatError, ImitarmError, InputError, TaskFailedError, UnknownNameError
from imitarm.evaluation.mapping_metrics import measure
from imitarm.evaluation.motion import violations
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence, Retargeter
from imitarm.tasks.stack_run import DT, run_stack

REPLAYS = (*KINDS, CAPTURED)
"""Tasks in which a method follows a recording."""
LIVE = "live stacking"
"""The closed-loop task: a simulated person watches the robot and leads it through a retargeting method to stack
cubes."""
ROBOTS = ("sawyer", "panda")
FORMAT = "imitarm-result"
VERSION = 1
_NO_RECORDING = "the recording could not be made"


@dataclass(frozen=True)
class Method:
    """A retargeting method with its options. The tables have one row for each method.

    Attributes:
        retargeter: name of the method in :data:`imitarm.retarget.RETARGETERS`.
        label: name of the method in tables and figures; if empty, the title of the retargeter is used.
        options: options for the method's constructor.
    """

    retargeter: str
    label: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The name of the method in tables and figures."""
        return self.label or RETARGETERS[self.retargeter].title

    def __call__(self, arm: ArmModel, correspondence: Correspondence, *, dt: float = 0.01) -> Retargeter:
        """Create the retargeter for ``arm``; ``dt`` is the control period [s]."""
        return RETARGETERS[self.retargeter](arm, correspondence, dt=dt, **self.options)


MAIN: Mapping[str, Method] = {name: Method(name) for name in RETARGETERS}
"""Every registered method with its default options.

The thesis compares its method Me with the baselines M1 to M3 (Table 3.1 and Figs 3.6 to 3.8). ``thesis`` is the method
Me with corrected equations. ``m1`` to ``m3`` are our interpretations of the baselines. ``modern`` is the method of this
library. Other packages can add methods by entry points.
"""

VARIANTS: Mapping[str, Method] = {
    "me-thesis": Method("thesis", "Me-thesis", {"smoothing": "global", "small_angle": "thesis"}),
    "thesis-global": Method("thesis", "thesis, global", {"smoothing": "global"}),
    "thesis-small-angle": Method("thesis", "thesis, small angle", {"small_angle": "thesis"}),
    "thesis-printed": Method("thesis", "thesis, as printed", {"as_printed": True}),
    "m1-scaled": Method("m1", "M1, scaled", {"velocity_scaling": True}),
    "m3-scaled": Method("m3", "M3, scaled", {"velocity_scaling": True}),
}
"""Methods with changed options, which show the effects of the options:

* "Me-thesis" fits one NURBS curve to the whole recording and uses the small-angle term of the thesis.
* "global" fits one NURBS curve to the whole recording.
* "small angle" uses the small-angle term of the thesis.
* "as printed" keeps the misprints of the thesis, except those with which the program could not run.
* "scaled" slows all joints down by a common factor when one joint would be too fast.
"""

METHODS: Mapping[str, Method] = {**MAIN, **VARIANTS}
"""All methods by name."""


def method(name: str) -> Method:
    """Return a method by name.

    Raises:
        UnknownNameError: when there is no such method; the message lists all methods.
    """
    if name not in METHODS:
        raise UnknownNameError.among("method", name, METHODS)
    return METHODS[name]


@dataclass(frozen=True)
class Experiment:
    """The definition of one run of one method in one task.

    Another process or machine can run it, because it contains only text and numbers.

    ``Experiment("edge", "modern", seed=3).run()`` makes the recording, runs the method on the recording, and measures
    the result.

    Attributes:
        task: one of :data:`REPLAYS`, or :data:`LIVE`.
        method: one of :data:`METHODS`.
        robot: one of :data:`ROBOTS`; stacking needs the Sawyer.
        seed: seed of the simulated person.
        repeat: which recording or trial of this person, counted from 0.
        seconds: approximate duration of the recorded reaching and drawing motions [s].
        sigma: standard deviation of the camera's error [m]; None: 1 to 2 cm, chosen by the seed.
        data: folder of real recordings, which the task with motion capture needs.

    Raises:
        UnknownNameError: when task, method or robot is not known.
        InputError: when a number is out of range.
    """

    task: str
    method: str
    robot: str = "sawyer"
    seed: int = 0
    repeat: int = 0
    seconds: float = 10.0
    sigma: float | None = None
    data: str = ""

    def __post_init__(self) -> None:
        if self.task not in {*REPLAYS, LIVE}:
            raise UnknownNameError.among("task", self.task, (*REPLAYS, LIVE))
        method(self.method)
        if self.robot not in ROBOTS:
            raise UnknownNameError.among("robot", self.robot, ROBOTS)
        if self.robot != "sawyer" and self.task in {LIVE, "stacking"}:
            raise InputError(f"Experiment: {self.task} needs the robot 'sawyer', got {self.robot!r}")
        _ = self.plan  # its checks

    @property
    def plan(self) -> Plan:
        """Definition of the recording that the method follows.

        The closed-loop task has no recording, but uses the seeds of a recording of stacking.
        """
        kind = "stacking" if self.task == LIVE else self.task
        return Plan(kind, self.seed, self.repeat, self.seconds, self.sigma, self.data)

    @property
    def name(self) -> str:
        """A short name of the experiment, for messages and files."""
        return f"{self.task.replace(' ', '-')}-{self.method}-{self.robot}-{self.seed:02d}-{self.repeat}"

    def run(self, folder: str | Path | None = None) -> Result:
        """Run the method, and measure the result.

        Args:
            folder: folder in which the recording is saved, so that other methods can use the same file; None: the
                recording is not saved.

        Returns:
            The result. If the method fails, the result has no values, and ``failure`` states the reason.
        """
        began = clock.perf_counter()
        try:
            values = self._live() if self.task == LIVE else self._replayed(None if folder is None else Path(folder))
            failure = ""
        except ImitarmError as error:
            values, failure = {}, f"{type(error).__name__}: {error}"
        return Result(self, code_version(), values, failure, clock.perf_counter() - began)

    def recording(self, folder: Path | None = None) -> MappingRecording:
        """Return the recording.

        If ``folder`` already contains it, it is read; otherwise it is made and saved in ``folder``.
        """
        if folder is None:
            return make_recording(self.plan, _arm(self.robot))
        facts = json.dumps([asdict(self.plan), self.robot, code_version()])
        mark = hashlib.sha256(facts.encode()).hexdigest()[:12]
        path = folder / f"{self.plan.kind}-{self.robot}-{self.seed:02d}-{self.repeat}-{mark}.npz"
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            make_recording(self.plan, _arm(self.robot)).save(path)
        return MappingRecording.load(path, self.plan)

    def _replayed(self, folder: Path | None) -> dict[str, Any]:
        try:
            recording = self.recording(folder)
        except ImitarmError as error:
            raise TaskFailedError(f"{_NO_RECORDING}: {error}") from error
        retargeter = method(self.method)(_arm(self.robot), recording.correspondence)
        run = retargeter.run(recording.skeletons, recording.start)
        # a method that slows the motion afterwards is measured against the time that it reproduces
        shown = run.times if run.shown_times is None else run.shown_times
        metrics = measure(run, recording.correspondence, recording.true_arm(shown))
        facts = {
            "recorded": float(recording.true_times[-1]),
            "beyond_reach": beyond_reach(recording, _arm(self.robot)) if self.robot == "sawyer" else math.nan,
        }
        return {**asdict(metrics), **facts, "notes": dict(run.notes)}

    def _live(self) -> dict[str, Any]:
        return asdict(run_stacking(self.method, self.seed, self.repeat, self.sigma, _arm(self.robot)))


@dataclass(frozen=True)
class StackingOutcome:
    """The outcome of one closed-loop trial of stacking.

    Torques are measured at the drives, so they include the effect of contacts.

    Attributes:
        success: whether four cubes stand on one another in the right order.
        failure: one of :data:`imitarm.tasks.stack.FAILURES`; empty on success.
        reason: explanation of the outcome in words.
        stacked: number of cubes in the tower at the end.
        time: time at which the person finished, or the time limit if the person did not finish [s].
        path_length: path length of the tool [m].
        mean_torque: mean of the absolute torque of each joint [N m].
        rms_torque: root mean square of each joint's torque [N m].
        effort: integral over time of the squared torques, summed over the joints [N^2 m^2 s].
        peak_torque_ratio: largest ratio of a joint's torque to the rated torque of this joint.
        velocity_ratio: largest ratio of a joint's measured velocity to the velocity limit of this joint.
        clamped: number of control steps in which the robot's limits changed the command.
    """

    success: bool
    failure: str
    reason: str
    stacked: int
    time: float
    path_length: float
    mean_torque: tuple[float, ...]
    rms_torque: tuple[float, ...]
    effort: float
    peak_torque_ratio: float
    velocity_ratio: float
    clamped: int


def run_stacking(
    method_name: str, person: int, repeat: int = 0, sigma: float | None = None, arm: ArmModel | None = None
) -> StackingOutcome:
    """Simulate one trial: a person with a noisy camera stacks cubes through a retargeting method. Return the outcome.

    Args:
        method_name: one of :data:`METHODS`.
        person: seed of the person.
        repeat: which trial of this person, counted from 0.
        sigma: standard deviation of the camera's error [m]; None: 1 to 2 cm, chosen by the seed.
        arm: model of the Sawyer with the gripper; None: the model is loaded here.
    """
    arm = ArmModel.load("sawyer", tool="gripper") if arm is None else arm
    done = run_stack(person, repeat, method(method_name), arm=arm, camera=camera_maker(sigma))
    return StackingOutcome(
        success=done.success,
        failure=done.failure,
        reason=done.reason,
        stacked=done.stacked,
        time=done.time,
        path_length=done.path_length,
        mean_torque=tuple(np.abs(done.torques).mean(axis=0).tolist()),
        rms_torque=tuple(np.sqrt(np.mean(done.torques**2, axis=0)).tolist()),
        effort=float(np.sum(done.torques**2) * DT),
        peak_torque_ratio=float((np.abs(done.torques) / arm.max_torque).max()),
        velocity_ratio=violations(arm, done.joints, DT).velocity_ratio,
        clamped=done.clamped,
    )


def camera_maker(sigma: float | None) -> Callable[[int], SkeletonCamera]:
    """Return a function that makes a simulated camera from a seed.

    Args:
        sigma: standard deviation of the camera's error [m]; None: the seed also determines this standard deviation.
    """
    return SkeletonCamera.from_seed if sigma is None else partial(SkeletonCamera, sigma=sigma)


def count_failures(outcomes: Sequence[str]) -> str:
    """Return a text with the number of failures of each kind; the most frequent kind comes first.

    Args:
        outcomes: one text for each trial: the kind of failure, or an empty text after a success.
    """
    counted = Counter(outcome for outcome in outcomes if outcome)
    return ", ".join(f"{what}: {n}" for what, n in counted.most_common()) or "none"


@dataclass(frozen=True, eq=False)
class Result:
    """The result of an experiment, as plain values.

    Attributes:
        experiment: experiment that was run.
        code: version of the code that ran, see :func:`imitarm.benchmark.provenance.code_version`.
        values: measures by name; empty after a failure. For a recording, the measures are the attributes of
            :class:`~imitarm.evaluation.mapping_metrics.MappingMetrics`. There are three further measures: ``recorded``
            is the duration of the recording [s]. ``beyond_reach`` is the fraction of time in which the target is out of
            reach. ``notes`` are the method's own notes. For a closed-loop trial, the measures are the attributes of
            :class:`StackingOutcome`.
        failure: reason why there are no measures; empty if there are measures.
        seconds: computing time [s].
    """

    experiment: Experiment
    code: str
    values: Mapping[str, Any]
    failure: str
    seconds: float

    @property
    def without_recording(self) -> bool:
        """Whether the recording could not be made; in this case, the method has not failed."""
        return f": {_NO_RECORDING}: " in self.failure

    def value(self, name: str) -> float:
        """Return the measure with this name; nan when it is unknown."""
        found = self.values.get(name)
        return math.nan if found is None else float(found)

    @staticmethod
    def path(folder: Path, experiment: Experiment) -> Path:
        """Return the path of the file for an experiment's result.

        The file name contains a hash of the experiment's definition.
        """
        facts = json.dumps(asdict(experiment), sort_keys=True)
        return folder / f"{experiment.name}-{hashlib.sha256(facts.encode()).hexdigest()[:12]}.json"

    def save(self, folder: Path) -> Path:
        """Write the result to a file, and return its path. An interruption never leaves an incomplete file."""
        folder.mkdir(parents=True, exist_ok=True)
        path = self.path(folder, self.experiment)
        content = {
            "format": FORMAT,
            "version": VERSION,
            "experiment": asdict(self.experiment),
            "code": self.code,
            "failure": self.failure,
            "seconds": self.seconds,
            "values": plain(dict(self.values)),
        }
        write_text(path, json.dumps(content, indent=1, allow_nan=False))
        return path

    @classmethod
    def load(cls, path: Path) -> Result:
        """Read a result that :meth:`save` wrote; the value null in the file becomes nan.

        Raises:
            FileFormatError: when the file is not a result, or a result of another version.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT or content["version"] != VERSION:
                raise FileFormatError(
                    f"{path}: is not a result of this version; delete the file and run the benchmark again"
                )
            experiment = Experiment(**content["experiment"])
            values = {name: math.nan if value is None else value for name, value in content["values"].items()}
            return cls(experiment, str(content["code"]), values, str(content["failure"]), float(content["seconds"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(
                f"{path}: can't be read as a result ({error}); delete the file and run the benchmark again"
            ) from error


def plain(value: Any) -> Any:
    """Return a copy of ``value`` that JSON can hold: numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_text(path: Path, text: str) -> None:
    """Write a text file under a temporary name, then rename it, so that no other process reads an incomplete file."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_text(text, encoding="utf-8")
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


@lru_cache(maxsize=2)
def _arm(robot: str) -> ArmModel:
    return ArmModel.load(robot, tool="gripper")
