"""Methods that check the static benchmark: their results are known, so they show whether it measures correctly.

* ``no-avoidance`` follows the learned path. If this method succeeded, the obstacles would not block the learned path.
* ``aims-at-obstacle`` steers through the middle of the nearest obstacle. If this method ever succeeded, the benchmark
  would measure contacts wrongly.
* ``oracle`` is the independent search of :mod:`imitarm.benchmark.refusal_oracle`. It decides which scenes have a
  solution. If a method solved a scene that the oracle proves impossible, the method or the oracle would be wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.refusal_oracle import decide
from imitarm.benchmark.refusal_proof import Answer
from imitarm.benchmark.refusal_question import Question
from imitarm.errors import InfeasibleError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.component_path import ComponentPath, quintic_step
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.scene import Obstacle, Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_SAMPLES = 200
_BUMP = 0.25  # fraction of the duration over which the path leaves the learned path


class NoAvoidance(PathPolicy):
    """Follow the learned path as if there were no obstacles."""

    title: ClassVar[str] = "no avoidance"

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Return the learned path."""
        nominal = _nominal(self.skill, scene, start)
        return PathPlan.beside(nominal, nominal)


class AimsAtObstacle(PathPolicy):
    r"""Displace the learned path so that it passes through the middle of the obstacle that is nearest to the path.

    Let c be the middle of this obstacle [m], and j the index of the learned sample that is nearest to c. The displaced
    path passes through c at sample j:

    .. math:: x_i = \bar x_i + w_i (c - \bar x_j), \qquad w_j = 1

    Here, x_i is sample i of the displaced path and x̄_i is sample i of the learned path [m]. The weight w_i is 1 at
    sample j, and falls smoothly to 0 before and after this sample. No displacement has a component in a forbidden
    direction.
    """

    title: ClassVar[str] = "aims at the obstacle"

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Return the path through the obstacle."""
        nominal = _nominal(self.skill, scene, start)
        positions = nominal.positions
        if scene.obstacles:
            nearest = scene.obstacles[int(np.argmin(scene.distances(positions).min(axis=1)))]
            centre = middle(nearest)
            j = int(np.argmin(np.linalg.norm(positions - centre, axis=1)))
            aside = centre - positions[j]
            for direction in np.asarray(self.forbidden, dtype=float).reshape(-1, 3):
                unit = direction / np.linalg.norm(direction)
                aside = aside - max(aside @ unit, 0.0) * unit
            distance = np.abs(np.arange(len(positions)) - j) / (_BUMP * len(positions))
            positions = positions + quintic_step(1.0 - distance)[:, None] * aside
        return PathPlan.beside(nominal, nominal.with_positions(positions))


class Oracle(PathPolicy):
    """Reproduce the path that the oracle finds, or refuse the scene if the oracle finds none.

    Args:
        skill: skill to reproduce.
        pinned: times at which the path must pass exactly through the learned path [s].
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`.

    Attributes:
        answer: what the oracle found in the last scene: a path, a proof that no path exists, or neither.
    """

    title: ClassVar[str] = "oracle"

    def __init__(self, skill: Skill, *, pinned: Sequence[float] = (), **options: Any) -> None:
        super().__init__(skill, **options)
        self._pinned = tuple(pinned)
        self.answer: Answer | None = None

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Search for a path with the oracle, and return it.

        Raises:
            InfeasibleError: when the oracle finds no path; the message says whether the oracle proved that no path
                exists.
        """
        path = ComponentPath.of_skill(self.skill, n_samples=_SAMPLES, pinned=self._pinned)
        path = path.between(self.skill, start, scene.goal)
        spheres = np.zeros((1, 4)) if self.tool_spheres is None else self.tool_spheres
        forbidden = np.asarray(self.forbidden, dtype=float).reshape(-1, 3)
        question = Question(
            path.nominal, path.basis, scene.obstacles, spheres, self.clearance, forbidden, path.fixed_times
        )
        self.answer, positions = decide(question)
        if positions is None:
            proved = self.answer is Answer.IMPOSSIBLE
            raise InfeasibleError(
                "the oracle proved that no path exists"
                if proved
                else "the oracle found neither a path nor a proof that no path exists"
            )
        return PathPlan.beside(path.nominal, path.nominal.with_positions(positions))


def middle(obstacle: Obstacle) -> Array:
    """Return a point inside a convex obstacle: the mean of its farthest points in 26 directions, shape (3,) [m]."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    directions = grid[np.any(grid != 0.0, axis=1)]
    return np.asarray(obstacle.support(directions / np.linalg.norm(directions, axis=1, keepdims=True)).mean(axis=0))


def _nominal(skill: Skill, scene: Scene, start: Pose | None) -> Trajectory:
    return skill.nominal(np.linspace(0.0, skill.duration_, _SAMPLES), start, scene.goal)


CONTROLS: dict[str, type[PathPolicy]] = {
    "no-avoidance": NoAvoidance,
    "aims-at-obstacle": AimsAtObstacle,
    "oracle": Oracle,
}
"""The methods that check the benchmark, by name."""
