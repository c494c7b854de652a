"""Stacking with a method in the loop: a made-up person, a noisy camera, real contact; one trial at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from imitarm.benchmark.mapping_methods import method
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.evaluation.motion import violations
from imitarm.kinematics.arm import ArmModel
from imitarm.tasks.stack_trial import DT, stack_once


@dataclass(frozen=True)
class StackingTrial:
    """Which trial, as plain values.

    Attributes:
        method: one of :data:`imitarm.benchmark.mapping_methods.METHODS`.
        person: seed of the person.
        repeat: which of this person's trials.
        sigma: of the camera's error [m]; None: 1 to 2 cm, by the seed.
    """

    method: str
    person: int
    repeat: int
    sigma: float | None = None

    @property
    def camera(self) -> Callable[[int], SkeletonCamera]:
        """Makes the camera from a seed: one with all the faults of a real one."""
        return SkeletonCamera.from_seed if self.sigma is None else partial(SkeletonCamera, sigma=self.sigma)


@dataclass(frozen=True)
class TrialOutcome:
    """What came of a trial, as plain values; torques are those of the drives, contacts included.

    Attributes:
        success: whether four cubes stand in order.
        failure: one of :data:`imitarm.tasks.stack.FAILURES`; empty on success.
        reason: in words.
        stacked: cubes in the tower at the end.
        time: until the person was done, or time was up [s].
        path_length: of the tool [m].
        mean_torque: mean of the absolute torque of each joint [N m].
        rms_torque: root mean square of each joint's torque [N m].
        effort: integral over time of the squared torques, summed over the joints [N^2 m^2 s].
        peak_torque_ratio: largest torque over the rated one.
        velocity_ratio: largest measured joint velocity over the one allowed.
        clamped: control steps in which the robot's own limits changed the command.
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


def run_trial(trial: StackingTrial, arm: ArmModel | None = None) -> TrialOutcome:
    """Let a person stack the cubes by a method, and measure.

    Args:
        trial: which.
        arm: the Sawyer with the gripper, when it is loaded already.
    """
    done = stack_once(trial.person, trial.repeat, method(trial.method), arm=arm, camera=trial.camera)
    arm = ArmModel.load("sawyer", tool="gripper") if arm is None else arm
    return TrialOutcome(
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


def failures(outcomes: Sequence[str]) -> str:
    """Return how often each failure happened, in words, the most frequent first; ``outcomes`` are "" on success."""
    counted = Counter(outcome for outcome in outcomes if outcome)
    return ", ".join(f"{n} {what}" for what, n in counted.most_common()) or "none"
