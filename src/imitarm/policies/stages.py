"""StagedPolicy: several motions one after another, with gripper commands in between, for example to pick and place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.pose import Pose
from imitarm.policies.policy import Observation, Policy
from imitarm.scene.scene import Scene
from imitarm.validation import finite_number, sequence

_RETRY = 0.2  # [s] after which a stage that could not start is tried again


def learned_goal(scene: Scene) -> Pose | None:
    """Return the goal of the scene; None: the learned goal."""
    return scene.goal


@dataclass(frozen=True, eq=False)
class Stage:
    """One motion of a :class:`StagedPolicy`, and the motion of the gripper after it.

    Attributes:
        name: name of the stage, for messages.
        policy: policy that makes the motion.
        goal: function that gets the observed scene and returns the goal of the motion (tool_to_base). The policy calls
            it in every control step, so the goal can follow an object. The default returns the goal of the scene.
        opening: distance between the gripper's fingers after the motion [m]; None: unchanged.
        hold: time for which the arm stands still after the motion, while the fingers move [s].
    """

    name: str
    policy: Policy
    goal: Callable[[Scene], Pose | None] = learned_goal
    opening: float | None = None
    hold: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.policy, Policy):
            raise InputError(f"stage {self.name!r}: policy must be a Policy, got {self.policy!r}")
        finite_number(self.hold, f"stage {self.name!r}: hold", "s", at_least=0.0)
        if not callable(self.goal):
            raise InputError(f"stage {self.name!r}: goal must be a function of the scene, got {self.goal!r}")


class StagedPolicy(Policy):
    """Makes several motions one after another, for example to pick an object and to place it.

    Each stage has its own policy. When the tool has arrived at the goal of a stage, the gripper opens or closes, and
    the arm stands still for the time ``hold``. Then the next stage begins at the measured pose. The policy of a stage
    may refuse to start, for example because an obstacle is at the goal. If this is the first stage, ``reset`` raises an
    error. Otherwise, the arm waits, and the stage is tried again every 0.2 s.

    Args:
        stages: the stages in the order of their execution, at least one.

    Raises:
        InputError: when there is no stage.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        self.stages = tuple(sequence(stages, Stage, "StagedPolicy: stages"))
        if not self.stages:
            raise InputError("StagedPolicy: stages is empty; give at least one Stage")
        first = self.stages[0].policy
        super().__init__(first.skill, tool_spheres=first.tool_spheres, clearance=first.clearance, arm=first.arm)
        self._index, self._waiting, self._retry, self._arrived = 0, "", 0.0, float("nan")

    @property
    def plan(self) -> Any:
        """Plan of the current stage's policy."""
        return self.stage.policy.plan

    @property
    def stage(self) -> Stage:
        """The current stage."""
        return self.stages[self._index]

    def reset(self, observation: Observation) -> None:
        """Begin the first stage.

        Raises:
            InfeasibleError: when the policy of the first stage refuses to start.
        """
        self._begin(0)
        self.stage.policy.reset(self._seen(observation))

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command of the current stage; between stages, the arm stands still while the fingers move."""
        if self._waiting:
            self._start(observation)
            if self._waiting:
                return self._still(Status.WAITING, self._waiting)
        seen = self._seen(observation)
        if np.isnan(self._arrived) and self.stage.policy.finished(seen):
            self._arrived = observation.time
        if np.isnan(self._arrived):
            command = self.stage.policy.step(seen, dt)
            reason = f"{self.stage.name}: {command.reason}" if command.reason else ""
            return replace(command, progress=self._progress(command.progress), reason=reason)
        over = observation.time - self._arrived >= self.stage.hold
        if over and self._index + 1 < len(self.stages):
            opening = self.stage.opening
            self._begin(self._index + 1)
            self._start(observation)
            return replace(self._still(Status.NOMINAL, ""), opening=opening)
        return replace(self._still(Status.NOMINAL, ""), opening=self.stage.opening)

    def finished(self, observation: Observation) -> bool:
        """Return whether the last motion has arrived and its hold time is over."""
        last = self._index + 1 == len(self.stages)
        return last and bool(observation.time - self._arrived >= self.stage.hold)

    def _begin(self, index: int) -> None:
        self._index, self._waiting, self._arrived = index, "", float("nan")
        self._retry = -np.inf

    def _start(self, observation: Observation) -> None:
        """Start the present stage, or note why it can't start yet."""
        if observation.time < self._retry:
            return
        try:
            self.stage.policy.reset(self._seen(observation))
        except InfeasibleError as refusal:
            self._waiting, self._retry = f"{self.stage.name} can't start: {refusal}", observation.time + _RETRY
        else:
            self._waiting = ""

    def _seen(self, observation: Observation) -> Observation:
        """Return the observation with the goal of the present stage."""
        goal = self.stage.goal(observation.scene)
        if goal is observation.scene.goal:
            return observation
        return replace(observation, scene=observation.scene.with_goal(goal))

    def _progress(self, progress: float) -> float:
        return (self._index + (0.0 if np.isnan(progress) else progress)) / len(self.stages)

    def _still(self, status: Status, reason: str) -> Command:
        done = 0.0 if self._waiting else 1.0
        return Command(np.zeros(6), progress=self._progress(done), status=status, reason=reason)
