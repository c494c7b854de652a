"""Common parts of the baselines that plan the path of the tool: gaps to obstacles, and the learned path."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.scene.distances import distances, distances_and_gradients
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array

Array = NDArray[np.float64]


class ToolGaps:
    """Distances between the tool, as one sphere about its tip, and all obstacles of a scene.

    The gap to obstacle ``o`` at the tip position ``x`` is ``g_o(x) = sd_o(x) - r``, with the signed distance ``sd_o``
    and the radius ``r`` of the sphere that contains the tool. The gap is negative in contact. Its gradient is the
    obstacle's outward normal ``n``, so the closest point of the obstacle is ``x - sd_o(x) n``.

    Args:
        scene: the obstacles at time 0.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m]; None: the tip.

    Attributes:
        radius: r [m].
        n_obstacles: number of obstacles.
    """

    def __init__(self, scene: Scene, tool_spheres: ArrayLike | None) -> None:
        self._packed = scene.packed
        spheres = (
            np.zeros((1, 4)) if tool_spheres is None else finite_array(tool_spheres, (None, 4), "tool_spheres", "m")
        )
        self.radius = float(np.max(np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]))
        self.n_obstacles = len(self._packed)

    def gaps(self, points: ArrayLike, times: ArrayLike | None = None) -> Array:
        """Return the gap of every tip position to every obstacle, shape (n_obstacles, ...) [m].

        Args:
            points: positions of the tip, shape (..., 3) [m]; with ``times``, shape (k, ..., 3).
            times: times since the motion began, shape (k,) [s]; None: all points at time 0.
        """
        return distances(self._packed, points, times) - self.radius

    def gaps_and_normals(self, points: ArrayLike, times: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return :meth:`gaps` and the outward normals of the obstacles, shape (n_obstacles, ..., 3)."""
        distance, normal = distances_and_gradients(self._packed, points, times)
        return distance - self.radius, normal


class BaselinePolicy(PathPolicy):
    """Base class of the baselines that plan the path of the tool, from the same learned path and the same gaps.

    A subclass implements :meth:`tool_path`. The orientation of the tool is the learned one at equal phases.

    Args:
        skill: skill to reproduce.
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`.

    Attributes:
        predicts: whether the planned path avoids moving obstacles where they will be at the planned times. Such a plan
            is followed on schedule.
    """

    predicts: ClassVar[bool] = False

    def __init__(self, skill: Skill, **options: Any) -> None:
        super().__init__(skill, **options)
        self._path = ComponentPath.of_skill(skill)
        directions = finite_array(np.reshape(np.asarray(self.forbidden, dtype=float), (-1, 3)), (None, 3), "forbidden")
        self._forbidden = directions / np.linalg.norm(directions, axis=1, keepdims=True)

    @abstractmethod
    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the planned path of the tool's tip.

        Args:
            nominal: the learned path between the start and the goal of this motion, 200 samples from time 0.
            gaps: distances to the obstacles.
            scene: the scene.

        Returns:
            Times from 0, shape (n,) [s], and positions, shape (n, 3) [m].

        Raises:
            InfeasibleError: when the method knows that it has no solution; the message says why.
        """

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Plan the path of the tool.

        Raises:
            InfeasibleError: when the method knows that it has no solution; the message says why.
        """
        del state
        nominal = self._path.between(self.skill, start, scene.goal).nominal
        times, positions = self.tool_path(nominal, ToolGaps(scene, self.tool_spheres), scene)
        quaternions = None
        if nominal.quaternions is not None:
            _, quaternions = nominal.at(nominal.times[0] + times / times[-1] * nominal.duration)
        plan = PathPlan.beside(nominal, Trajectory(times, positions, quaternions))
        return replace(plan, only_on_schedule=self.predicts and not scene.packed.still)

    def allowed(self, vectors: Array) -> Array:
        """Return forces or velocities, shape (..., 3), without their parts in forbidden directions."""
        for direction in self._forbidden:
            vectors = vectors - np.maximum(vectors @ direction, 0.0)[..., None] * direction
        return vectors
