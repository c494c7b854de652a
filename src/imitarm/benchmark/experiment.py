"""Experiment and Result: one method, one recording or one trial; what came of it is a file that is compared later."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time as clock
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from imitarm.benchmark.mapping_methods import method
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.recording_plan import CAPTURED, KINDS, Plan
from imitarm.benchmark.recordings import MappingRecording, beyond_reach, make_recording
from imitarm.benchmark.stacking import StackingTrial, run_trial
from imitarm.errors import FileFormatError, ImitarmError, InputError, TaskFailedError, UnknownNameError
from imitarm.evaluation.mapping_metrics import measure
from imitarm.kinematics.arm import ArmModel

REPLAYS = (*KINDS, CAPTURED)
"""Tasks in which a recording is replayed through a method."""
LIVE = "live stacking"
"""The task in which a made-up person stacks cubes with a method in the loop."""
ROBOTS = ("sawyer", "panda")
FORMAT = "imitarm-result"
VERSION = 1
_NO_RECORDING = "the recording can't be made"


@dataclass(frozen=True)
class Experiment:
    """One method at one task; plain values, so that it can go to another process or machine.

    ``Experiment("edge", "modern", seed=3).run()`` makes the recording, lets the method follow it, and measures.

    Attributes:
        task: one of :data:`REPLAYS`, or :data:`LIVE`.
        method: one of :data:`imitarm.benchmark.mapping_methods.METHODS`.
        robot: one of :data:`ROBOTS`; the live task has a Sawyer.
        seed: of the person.
        repeat: which of this person's.
        seconds: about how long reaches and drawings take [s].
        sigma: of the camera's error [m]; None: 1 to 2 cm, by the seed.
        data: folder of real recordings, for the task that needs them.

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
            raise InputError(f"Experiment: {self.task} has a Sawyer, got robot {self.robot!r}")
        _ = self.plan  # its checks

    @property
    def plan(self) -> Plan:
        """The recording that is replayed; for the live task the one of the same seeds."""
        kind = "stacking" if self.task == LIVE else self.task
        return Plan(kind, self.seed, self.repeat, self.seconds, self.sigma, self.data)

    @property
    def name(self) -> str:
        """Short and unique among experiments that differ in nothing else."""
        return f"{self.task.replace(' ', '-')}-{self.method}-{self.robot}-{self.seed:02d}-{self.repeat}"

    def run(self, folder: str | Path | None = None) -> Result:
        """Do it, and measure.

        Args:
            folder: where recordings are kept, so that the next method need not have them made again; None: nowhere.

        Returns:
            The result; when the method could not do it, one with the reason in ``failure`` and without values.
        """
        began = clock.perf_counter()
        try:
            values = self._live() if self.task == LIVE else self._replayed(None if folder is None else Path(folder))
            failure = ""
        except ImitarmError as error:
            values, failure = {}, f"{type(error).__name__}: {error}"
        return Result(self, code_version(), values, failure, clock.perf_counter() - began)

    def recording(self, folder: Path | None = None) -> MappingRecording:
        """Return the recording: from ``folder`` when it is there, else made anew, and kept there."""
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
        return asdict(run_trial(StackingTrial(self.method, self.seed, self.repeat, self.sigma), _arm(self.robot)))


@dataclass(frozen=True, eq=False)
class Result:
    """What came of an experiment, as plain values.

    Attributes:
        experiment: which.
        code: which code did it, see :func:`imitarm.benchmark.provenance.code_version`.
        values: what was measured, by name: those of :class:`~imitarm.evaluation.mapping_metrics.MappingMetrics` with
            ``recorded`` [s], ``beyond_reach`` (share of the time) and the method's own ``notes``; or those of
            :class:`~imitarm.benchmark.stacking.TrialOutcome`; empty after a failure.
        failure: why there is nothing to measure; empty when there is.
        seconds: that it took to compute [s].
    """

    experiment: Experiment
    code: str
    values: Mapping[str, Any]
    failure: str
    seconds: float

    @property
    def unmade(self) -> bool:
        """Whether there was no recording to follow: that is no failure of the method."""
        return f": {_NO_RECORDING}: " in self.failure

    def value(self, name: str) -> float:
        """Return a measured number; nan when it is not known."""
        found = self.values.get(name)
        return math.nan if found is None else float(found)

    @staticmethod
    def path(folder: Path, experiment: Experiment) -> Path:
        """Return where the result of an experiment is kept: a digest of its configuration is in the name."""
        facts = json.dumps(asdict(experiment), sort_keys=True)
        return folder / f"{experiment.name}-{hashlib.sha256(facts.encode()).hexdigest()[:12]}.json"

    def save(self, folder: Path) -> Path:
        """Write it aside, then rename; return where it is."""
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
        """Read what :meth:`save` wrote; what is not known, None in the file, is nan again.

        Raises:
            FileFormatError: when the file is not such a result.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT or content["version"] != VERSION:
                raise FileFormatError(f"{path}: is no result of this version; delete it and run again")
            experiment = Experiment(**content["experiment"])
            values = {name: math.nan if value is None else value for name, value in content["values"].items()}
            return cls(experiment, str(content["code"]), values, str(content["failure"]), float(content["seconds"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{path}: can't be read as a result ({error}); delete it and run again") from error


def plain(value: Any) -> Any:
    """Return ``value`` with numbers that are not finite as None, ready for JSON."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_text(path: Path, text: str) -> None:
    """Write a text file aside, then rename: nobody ever reads half of it."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_text(text, encoding="utf-8")
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


@lru_cache(maxsize=2)
def _arm(robot: str) -> ArmModel:
    return ArmModel.load(robot, tool="gripper")
