"""Base class of the baselines that plan the path of the tool, and the distances from tool to obstacles."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.command import Command, Status
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies.baselines.reaction import Reaction, changed
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.policies.policy import Observation
from imitarm.scene.distances import distances, distances_and_gradients
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_array

Array = NDArray[np.float64]

_NEARLY = 0.98  # fraction of the duration after which a motion may have arrived
_NEAR, _SLOW = 5e-3, 3e-3  # [m], [m/s] a tool that rests so near the goal has arrived, as in a planned motion
_BESIDE = 2e-3  # [m] from the learned path: less is not called avoiding


class ToolGaps:
    """Distances between all obstacles of a scene and the tool, which is represented by one sphere about its tip.

    If the tip is at the position ``x``, the gap to obstacle ``o`` is ``g_o(x) = sd_o(x) - r``. Here, ``sd_o`` is the
    signed distance from the obstacle, and ``r`` is the radius of the sphere. The gap is negative if the sphere and the
    obstacle overlap. The gradient of the gap is the obstacle's outward normal ``n``, so the closest point of the
    obstacle is ``x - sd_o(x) n``.

    Args:
        scene: the obstacles at time 0.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m]; None: the tool
            is a point.

    Attributes:
        radius: radius r of the sphere that represents the tool [m].
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
            points: positions of the tip, shape (..., 3) [m]; if ``times`` is given, shape (k, ..., 3).
            times: time since the motion began for each of the k groups of points, shape (k,) [s]; None: time 0 for all
                points.
        """
        return distances(self._packed, points, times) - self.radius

    def gaps_and_normals(self, points: ArrayLike, times: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return the result of :meth:`gaps`, and the outward normals of the obstacles, shape (n_obstacles, ..., 3)."""
        distance, normal = distances_and_gradients(self._packed, points, times)
        return distance - self.radius, normal


class BaselinePolicy(PathPolicy):
    """Base class of the baselines that plan the path of the tool; all of them use the same learned path and gaps.

    A subclass implements :meth:`tool_path`. At each fraction of the duration, the tool has the learned orientation.

    While the scene does not change, the policy plans its path only once. If the subclass also implements
    :meth:`reaction`, the policy reacts to obstacles that move, appear or disappear. As soon as the scene changes, the
    policy integrates its equations one control period at a time, with the observed obstacles. From then on, it does not
    refuse a scene.

    Args:
        skill: skill to reproduce.
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`.

    Attributes:
        predicts: whether the planned path avoids moving obstacles at their predicted positions. The policy then follows
            the path at the planned times.
    """

    predicts: ClassVar[bool] = False

    def __init__(self, skill: Skill, **options: Any) -> None:
        super().__init__(skill, **options)
        self._path = ComponentPath.of_skill(skill)
        directions = finite_array(np.reshape(np.asarray(self.forbidden, dtype=float), (-1, 3)), (None, 3), "forbidden")
        self._forbidden = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self._reaction: Reaction | None = None

    def reaction(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> Reaction | None:
        """Return a motion that reacts to a changing scene; None if the method can only plan a whole path.

        Args:
            nominal: learned path between the start and the goal of this motion, with 200 samples.
            position: measured position of the tool, shape (3,) [m].
            velocity: velocity of the tool, shape (3,) [m/s].
            fraction: elapsed time divided by the duration.
        """
        del nominal, position, velocity, fraction
        return None

    @abstractmethod
    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the planned path of the tool's tip.

        Args:
            nominal: learned path between the start and the goal of this motion, with 200 samples from time 0.
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

    def reset(self, observation: Observation) -> None:
        """Begin to react step by step if an obstacle moves and the method has a reaction; otherwise, plan the path.

        Raises:
            InfeasibleError: when the method plans a path and finds no solution; the message gives the reason.
        """
        scene = observation.scene.now(observation.time)
        self._observed, self._reaction, self._last = scene.packed, None, np.zeros(3)
        self._nominal = self._path.between(self.skill, self.start_of(observation), scene.goal).nominal
        if not scene.packed.still and self._reacts(observation, 0.0):
            self.motion = PathPlan.beside(self._nominal, self._nominal)
            self._hold, self._began = observation.tool_to_base, observation.time
            self._phase, self._void = 0.0, ""
            return
        super().reset(observation)

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command that follows the planned path, or reacts to the observed obstacles.

        Raises:
            InputError: when ``reset`` was not called.
        """
        if self.motion is None:
            raise InputError(f"{type(self).__name__}.step: call reset(observation) first")
        scene = observation.scene.now(observation.time)
        if self._reaction is None and changed(self._observed, scene.packed):
            self._reacts(observation, (observation.time - self._began) / self._nominal.duration)
        if self._reaction is None:
            command = super().step(observation, dt)
        else:
            command = self._reacting(self._reaction, observation, scene, dt)
        self._last = command.twist[:3]
        return command

    def finished(self, observation: Observation) -> bool:
        """Return whether the motion has arrived at its goal."""
        if self._reaction is None:
            return super().finished(observation)
        away = float(np.linalg.norm(observation.tool_to_base.position - self._reaction.goal))
        rests = float(np.linalg.norm(self._reaction.velocity)) < _SLOW
        return self._reaction.fraction >= _NEARLY and (away < self._arrival or (away < _NEAR and rests))

    def _reacts(self, observation: Observation, fraction: float) -> bool:
        """Begin to react, and return whether the method can."""
        self._reaction = self.reaction(self._nominal, observation.tool_to_base.position, self._last, fraction)
        return self._reaction is not None

    def _reacting(self, motion: Reaction, observation: Observation, scene: Scene, dt: float) -> Command:
        """Return the command of a method that reacts: its velocity, and feedback to where the tool should be."""
        tool = observation.tool_to_base
        lag = motion.position - tool.position
        if float(np.linalg.norm(lag)) > self._patience:  # the robot could not follow: go on from where it is
            motion.position, lag = tool.position.copy(), np.zeros(3)
        velocity = motion.advance(scene, dt) + self._gain * lag
        end = min(motion.fraction, 1.0)
        _, learned = self._nominal.at([self._nominal.times[0] + end * self._nominal.duration])
        quaternion = self._hold.quaternion if learned is None else learned[0]
        turning = self._gain * tool.error_to(Pose(tool.position, quaternion))[3:]
        beside = float(np.linalg.norm(motion.position - motion.learned(motion.fraction)))
        status = (Status.NOMINAL, "")
        if beside > _BESIDE and len(scene.packed):
            status = Status.AVOIDING, f"the tool is {1e3 * beside:.0f} mm from the learned path because of an obstacle"
        return Command(np.concatenate([velocity, turning]), progress=end, status=status[0], reason=status[1])

    def allowed(self, vectors: Array) -> Array:
        """Return forces or velocities, shape (..., 3), without their components in forbidden directions."""
        for direction in self._forbidden:
            vectors = vectors - np.maximum(vectors @ direction, 0.0)[..., None] * direction
        return vectors
