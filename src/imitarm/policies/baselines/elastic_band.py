"""Elastic band (Quinlan and Khatib 1993): a path under tension that obstacles repel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.expert import PathProblem, displaced_paths
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_ITERATIONS = 200
_SETTLED = 1e-6  # [m] the band is at rest when no node moves farther in one step


class ElasticBand(BaselinePolicy):
    r"""Displace the learned path like an elastic band (Quinlan and Khatib 1993).

    The band has nodes ``x_i = x0_i + d_i``, which are the learned positions ``x0_i`` plus displacements ``d_i``. A
    tension pulls each node towards its neighbours. Let ``gap_o`` be the distance from obstacle o to the tool at a node,
    minus the required clearance. If ``gap_o`` is smaller than the influence distance ``d_0``, the obstacle repels the
    node along the obstacle's normal ``n_o``::

        F_i = (d_(i-1) - 2 d_i + d_(i+1)) + k sum_o max(d_0 - gap_o(x_i), 0) n_o

    The start and the goal are fixed. The equilibrium minimises an energy:
    ``1/2 sum |d_(i+1) - d_i|^2 + k/2 sum max(d_0 - gap, 0)^2``.
    Newton steps, which treat the normals as constant, find this minimum. As in the paper, the first band is a
    collision-free path. It is the learned path, displaced around each obstacle to the side that needs the least jerk.

    Args:
        skill: skill to reproduce.
        repulsion: k, stiffness of the repulsion divided by the stiffness of the tension.
        influence: d_0, the gap below which an obstacle repels [m].
        options: arguments of :class:`~imitarm.policies.baselines.baseline_policy.BaselinePolicy`.
    """

    predicts = True
    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"repulsion": (1e-3, 10.0), "influence": (0.005, 0.2)}

    def __init__(self, skill: Skill, *, repulsion: float = 0.1, influence: float = 0.03, **options: Any) -> None:
        super().__init__(skill, **options)
        self.repulsion = finite_number(repulsion, "ElasticBand: repulsion", above=0.0)
        self.influence = finite_number(influence, "ElasticBand: influence", "m", above=0.0)

    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the band at its equilibrium, or after 200 steps."""
        del scene
        problem = PathProblem.of(nominal, gaps, self.clearance, self._forbidden)
        path = next(iter(displaced_paths(problem)), problem.nominal)
        energy, force, stiffness = self._state(problem, path)
        for _ in range(_ITERATIONS):
            step = solveh_banded(stiffness, force.ravel()).reshape(force.shape)
            step *= min(1.0, self.influence / max(float(np.abs(step).max()), _SETTLED))
            while np.abs(step).max() >= _SETTLED:
                moved = path.copy()
                moved[1:-1] = problem.nominal[1:-1] + self._kept((path - problem.nominal)[1:-1] + step)
                lower, force, stiffness = self._state(problem, moved)
                if lower < energy:
                    break
                step = 0.5 * step
            else:
                break
            energy, path = lower, moved
        return problem.times, path

    def _kept(self, deviation: Array) -> Array:
        """Return the deviation (98, 3) without its parts in forbidden directions."""
        for f in self._forbidden:
            deviation = deviation - np.maximum(deviation @ f, 0.0)[:, None] * f
        return deviation

    def _state(self, problem: PathProblem, path: Array) -> tuple[float, Array, Array]:
        """Return the energy [m^2], the forces on the inner nodes (98, 3) [m], and the stiffness as an upper band."""
        gap, normal = problem.gaps_at(path)
        pressed = np.maximum(self.influence - (gap - problem.clearance), 0.0)[:, 1:-1]
        normal = normal[:, 1:-1]
        deviation = path - problem.nominal
        stretch = np.diff(deviation, axis=0)
        energy = 0.5 * float(np.sum(stretch**2)) + 0.5 * self.repulsion * float(np.sum(pressed**2))
        force = np.diff(stretch, axis=0) + self.repulsion * np.einsum("oi,oij->ij", pressed, normal)
        blocks = self.repulsion * np.einsum("oi,oij,oik->ijk", pressed > 0.0, normal, normal)
        band = np.zeros((4, force.size))  # coordinates are coupled with those of the same node, and of the next
        band[0, 3:] = -1.0
        for row in range(3):
            for column in range(row, 3):
                band[3 - (column - row), column::3] = blocks[:, row, column] + 2.0 * (row == column)
        return energy, force, band
