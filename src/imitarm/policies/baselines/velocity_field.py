"""Base class of the baselines that change a desired velocity near obstacles, and move the tool with the result."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InfeasibleError
from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.reaction import Reaction
from imitarm.policies.headings import allowed_axes
from imitarm.scene.distances import PackedObstacles
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_LONGEST = 2.0  # durations
_ARRIVED, _NEAR = 1e-3, 5e-3  # [m] from the goal: the motion ends; after the longest time, the goal counts as reached
_FASTEST = 1.5  # times the highest speed of the learned path: limit of the desired velocity
_LARGEST_SIZE = 0.3  # [m] of an obstacle without bounds, such as a table


class NearObstacles(NamedTuple):
    """Distances and directions from the obstacles to the tool, expressed in the d directions that are not forbidden.

    Attributes:
        gap: distance of the tool to each obstacle, minus the required clearance, shape (n,) [m].
        normal: outward normals, projected on the d directions, shape (n, d).
        velocity: velocity of each obstacle at its closest point, shape (n, d) [m/s].
        drift: component along each normal of the tool's velocity in the directions that the method does not change,
            shape (n,) [m/s].
        outward: vector from the centre of each obstacle to the tool, or the normal of a half-space, shape (n, d) [m].
        size: radius of a sphere that contains the obstacle, plus the radius of the tool, plus the clearance, shape (n,)
            [m].
    """

    gap: Array
    normal: Array
    velocity: Array
    drift: Array
    outward: Array
    size: Array


class _Follow(NamedTuple):
    """The learned path at equal time steps, shape (n, 3) [m], and one step along it.

    Attributes:
        learned: the path.
        ratio: length of the step, in samples of the path.
        dt: length of the step [s].
        fastest: limit of the desired speed [m/s].
    """

    learned: Array
    ratio: float
    dt: float
    fastest: float


_Around = tuple[ToolGaps, PackedObstacles, float]


class VelocityField(BaselinePolicy):
    r"""Base class: the tool follows a point that moves along the learned path; near obstacles, its velocity changes.

    The point is at ``x_0(s)`` on the learned path, where the phase ``s`` [s] is a time. The tool at ``x`` has the
    desired velocity ``u``. If the tool lags behind the point, the rate ``r`` of the phase is below 1, so the point
    waits::

        u = r dx_0/ds + k (x_0(s) - x),     ds/dt = r = 1 / (1 + |x_0(s) - x| / e_0)

    The norm of ``u`` is limited to 1.5 times the highest speed of the learned path. A subclass implements
    :meth:`velocity`, which changes ``u`` near obstacles, and the tool moves with ``dx/dt = velocity(u)``. The motion
    ends at the goal. If the tool is more than 5 mm from the goal after twice the learned duration, the method refuses
    the scene.

    Args:
        skill: skill to reproduce.
        pull: k, the additional speed of the tool towards the point, divided by its distance from the point [1/s].
        slack: e_0, distance between tool and point at which the rate is one half [m].
        options: arguments of :class:`~imitarm.policies.baselines.baseline_policy.BaselinePolicy`.
    """

    predicts = True
    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"pull": (1.0, 20.0), "slack": (0.01, 0.3)}

    def __init__(self, skill: Skill, *, pull: float = 4.0, slack: float = 0.05, **options: Any) -> None:
        super().__init__(skill, **options)
        name = type(self).__name__
        self.pull = finite_number(pull, f"{name}: pull", "1/s", above=0.0)
        self.slack = finite_number(slack, f"{name}: slack", "m", above=0.0)
        self.axes, self.one_sided = allowed_axes(self._forbidden)

    @abstractmethod
    def velocity(self, desired: Array, around: NearObstacles, limits: Array) -> Array:
        """Return the velocity of the tool.

        Args:
            desired: desired velocity in the allowed directions, shape (d,) [m/s].
            around: the obstacles near the tool.
            limits: largest velocity in each direction ``self.one_sided``, shape (m,) [m/s]. The caller reduces a result
                that exceeds a limit.
        """

    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the path of the tool that follows the velocity field.

        Raises:
            InfeasibleError: when the tool is not within 5 mm of the goal after twice the duration.
        """
        n = len(nominal)
        times = np.linspace(0.0, nominal.duration, n)
        dt = float(times[1])
        learned, _ = nominal.at(nominal.times[0] + times)
        fastest = _fastest(learned, dt)
        x, phase = learned[0], 0.0
        path = [x]
        for step in range(int(_LONGEST * n)):
            if phase >= n - 1 and float(np.linalg.norm(_at(phase, learned) - x)) < _ARRIVED:
                break
            x, phase = self.moved(x, phase, _Follow(learned, 1.0, dt, fastest), (gaps, scene.packed, step * dt))
            path.append(x)
        away_from_goal = float(np.linalg.norm(learned[-1] - x))
        if away_from_goal > _NEAR:
            raise InfeasibleError(
                f"{type(self).__name__}: the tool is still {1e3 * away_from_goal:.0f} mm from the goal after twice the "
                f"learned duration; choose other options, or another policy"
            )
        return np.linspace(0.0, dt * (len(path) - 1), len(path)), np.stack(path)

    def moved(self, x: Array, phase: float, follow: _Follow, around: _Around) -> tuple[Array, float]:
        """Return the position of the tool and the phase after one step.

        Args:
            x: position of the tool before the step, shape (3,) [m].
            phase: index of the point among the samples of the learned path, not rounded.
            follow: the learned path, the length of the step in samples of the path and in seconds, and the largest
                speed [m/s].
            around: the gaps, the obstacles, and the time since the stamp of the scene [s].
        """
        learned, ratio, dt, fastest = follow
        target = _at(phase, learned)
        away = target - x
        rate = 1.0 / (1.0 + float(np.linalg.norm(away)) / self.slack)
        ahead = min(phase + ratio * rate, len(learned) - 1.0)
        forward = (_at(ahead, learned) - target) / dt
        desired = forward + self.pull * away
        desired *= min(1.0, fastest / max(float(np.linalg.norm(desired)), 1e-12))
        fixed = (np.eye(3) - self.axes @ self.axes.T) @ desired
        gaps, packed, time = around
        near = self._obstacles(x, time, fixed, gaps, packed)
        limits = self.one_sided @ (self.axes.T @ (forward + away / dt))
        v = self.velocity(desired @ self.axes, near, limits)
        for f, limit in zip(self.one_sided, limits, strict=True):
            v = v - max(float(f @ v) - limit, 0.0) * f
        return x + dt * (fixed + self.axes @ v), ahead

    def reaction(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> Reaction:
        """Return the motion in a changing scene, which is computed one control period at a time."""
        return _FieldReaction(self, nominal, position, velocity, fraction)

    def _obstacles(self, x: Array, time: float, fixed: Array, gaps: ToolGaps, packed: PackedObstacles) -> NearObstacles:
        """Return the obstacles at a time, seen from the tip at ``x``, which moves with ``fixed`` in any case."""
        gap, normal = gaps.gaps_and_normals(x[None, None], np.array([time]))
        gap, normal = gap[:, 0, 0], normal[:, 0, 0]
        outward = x - (packed.positions + time * packed.velocities)
        closest = outward - (gap + gaps.radius)[:, None] * normal
        velocity = packed.velocities
        if packed.rotating:
            velocity = velocity + np.cross(packed.angular_velocities, closest)
        bounded = np.isfinite(packed.radii)
        return NearObstacles(
            gap - self.clearance,
            normal @ self.axes,
            velocity @ self.axes,
            normal @ fixed,
            np.where(bounded[:, None], outward, normal) @ self.axes,
            np.where(bounded, packed.radii, _LARGEST_SIZE) + gaps.radius + self.clearance,
        )


class _FieldReaction(Reaction):
    """The velocity field of a policy, one control period at a time."""

    def __init__(
        self, policy: VelocityField, nominal: Trajectory, position: Array, velocity: Array, fraction: float
    ) -> None:
        super().__init__(nominal, position, velocity, fraction)
        self._policy, self._last = policy, len(nominal) - 1.0
        self._dt = nominal.duration / self._last
        self._learned, _ = nominal.at(nominal.times[0] + np.linspace(0.0, nominal.duration, len(nominal)))
        self._fastest = _fastest(self._learned, self._dt)

    def step(self, scene: Scene, dt: float) -> None:
        """Move with the field of the observed obstacles; the point on the path waits for the tool."""
        follow = _Follow(self._learned, dt / self._dt, dt, self._fastest)
        around = ToolGaps(scene, self._policy.tool_spheres), scene.packed, 0.0
        self.position, phase = self._policy.moved(self.position, self.fraction * self._last, follow, around)
        self.fraction = phase / self._last


def _fastest(learned: Array, dt: float) -> float:
    """Return the limit of the desired speed [m/s] for positions (n, 3) at intervals ``dt``."""
    return _FASTEST * float(np.linalg.norm(np.diff(learned, axis=0), axis=1).max()) / dt


def _at(index: float, rows: Array) -> Array:
    """Return the row at a fractional index, interpolated linearly."""
    i = min(int(index), len(rows) - 2)
    return np.asarray(rows[i] + (index - i) * (rows[i + 1] - rows[i]))
