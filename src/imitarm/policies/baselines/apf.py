"""APF: move along the forces of a classical artificial potential field from the start to the goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InfeasibleError
from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.potential_field import (
    attractive_force,
    attractive_potential,
    repulsive_force,
    repulsive_potential,
)
from imitarm.policies.baselines.reaction import Reaction
from imitarm.policies.component_path import quintic_step
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_STEP = 0.01  # [s]
_LONGEST = 2.0  # durations of the learned motion
_ARRIVED = 5e-4  # [m] from the goal
_START = 0.1  # of the duration: the motion starts from rest during this part
_HALVINGS = 12  # of a step that would increase the potential


class APF(BaselinePolicy):
    r"""Classical artificial potential field (Khatib 1986; thesis 2.2.5, Eqs 2.15-2.22).

    The tool moves with the velocity ``F_a + F_r`` of :mod:`~imitarm.policies.baselines.potential_field`, from the start
    to the goal. The method uses only the ends and the speed of the learned path. The mean speed scales the attraction,
    and the largest speed limits the velocity. The distance ``d`` is the distance from the tool's sphere to the
    obstacle, minus the required clearance. If a step would increase the potential, the step is halved until it does
    not. The tool therefore does not oscillate between two obstacles.

    **Known failure.** The sum of the forces is also zero at local minima of the potential, for example in front of an
    obstacle between tool and goal. The tool would stop at such a minimum, so the method refuses the scene.

    Args:
        skill: skill whose start, goal and speed are used.
        repulsion: factor k of the repulsion [m^4/s].
        influence: d_0, the distance beyond which an obstacle does not repel [m].
        cap: rho_c, the distance from the goal beyond which the attraction is constant [m].
        speed: speed of the tool far from the goal and from obstacles, divided by the mean speed of the learned motion.
            This argument determines the gain ``eta`` of the attraction [1/s]: ``eta`` times ``cap`` is the tool's speed
            [m/s].
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {
        "repulsion": (1e-8, 1e-4),
        "influence": (0.02, 0.2),
        "cap": (0.02, 0.2),
    }

    def __init__(
        self,
        skill: Skill,
        *,
        repulsion: float = 1e-6,
        influence: float = 0.05,
        cap: float = 0.05,
        speed: float = 1.5,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        self.repulsion = finite_number(repulsion, "APF: repulsion", "m^4/s", at_least=0.0)
        self.influence = finite_number(influence, "APF: influence", "m", above=0.0)
        self.cap = finite_number(cap, "APF: cap", "m", above=0.0)
        self.speed = finite_number(speed, "APF: speed", above=0.0)

    def field(self, nominal: Trajectory, gaps: ToolGaps, *, moving: bool) -> _Field:
        """Return the potential field of a scene; ``moving`` says whether obstacles move."""
        stiffness = self.speed * max(nominal.path_length / nominal.duration, 1e-6) / self.cap
        return _Field(self, gaps, nominal.positions[-1], stiffness, moving=moving)

    def reaction(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> Reaction:
        """Return the motion along the forces in a changing scene, which is computed one control period at a time."""
        return _FieldReaction(self, nominal, position, velocity, fraction)

    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the path along the forces, from the start of ``nominal`` to its goal.

        Raises:
            InfeasibleError: when the tool stops in a local minimum, or does not arrive within twice the duration.
        """
        x, duration = nominal.positions[0].copy(), nominal.duration
        speeds = np.linalg.norm(np.diff(nominal.positions, axis=0), axis=1) / np.diff(nominal.times)
        field = self.field(nominal, gaps, moving=not scene.packed.still)
        path = [x]
        for k in range(round(_LONGEST * duration / _STEP)):
            time = k * _STEP
            if time >= _START * duration and np.linalg.norm(x - field.goal) < _ARRIVED:
                break
            distance, normal = field.distances(x, time)
            force = field.force(x, distance, normal)
            most = float(speeds.max()) * float(quintic_step((time + _STEP) / (_START * duration)))
            step = force * (_STEP * min(1.0, most / max(float(np.linalg.norm(force)), 1e-12)))
            step = field.downhill(x, step, distance, time)
            if not field.moving and not step.any():
                break
            x = np.asarray(x + step)
            path.append(x)
        away = float(np.linalg.norm(x - field.goal))
        if away >= _ARRIVED:
            where = "after twice the learned duration" if field.moving else "in a local minimum of the potential"
            raise InfeasibleError(
                f"APF: the tool stops {1e3 * away:.0f} mm from the goal, at {np.round(x, 3).tolist()} m, {where}; "
                f"choose another repulsion or influence, or another policy"
            )
        return np.linspace(0.0, _STEP * (len(path) - 1), len(path)), np.stack(path)


class _FieldReaction(Reaction):
    """The forces of the observed obstacles, one control period at a time."""

    def __init__(self, policy: APF, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> None:
        super().__init__(nominal, position, velocity, fraction)
        self._policy = policy
        speeds = np.linalg.norm(np.diff(nominal.positions, axis=0), axis=1) / np.diff(nominal.times)
        self._fastest = float(speeds.max())

    def step(self, scene: Scene, dt: float) -> None:
        """Move along the forces."""
        field = self._policy.field(self.nominal, ToolGaps(scene, self._policy.tool_spheres), moving=True)
        distance, normal = field.distances(self.position, 0.0)
        force = field.force(self.position, distance, normal)
        step = dt / self.nominal.duration
        most = self._fastest * float(quintic_step((self.fraction + step) / _START))
        move = force * (dt * min(1.0, most / max(float(np.linalg.norm(force)), 1e-12)))
        self.position = self.position + field.downhill(self.position, move, distance, 0.0)
        self.fraction += step


class _Field(NamedTuple):
    """The potential of one scene, with the parameters of one policy."""

    policy: APF
    gaps: ToolGaps
    goal: Array
    stiffness: float
    moving: bool

    def distances(self, x: Array, time: float) -> tuple[Array, Array]:
        """Return the distances (n,) [m] beyond the required clearance, and their gradients (n, 3)."""
        if self.moving:
            gap, normal = self.gaps.gaps_and_normals(x[None], [time])
            return gap[:, 0] - self.policy.clearance, normal[:, 0]
        gap, normal = self.gaps.gaps_and_normals(x)
        return gap - self.policy.clearance, normal

    def force(self, x: Array, distance: Array, normal: Array) -> Array:
        """Return the force, shape (3,) [m/s]; the repulsion has no part in a forbidden direction."""
        repulsion = repulsive_force(distance, normal, self.policy.repulsion, self.policy.influence)
        return attractive_force(x, self.goal, self.stiffness, self.policy.cap) + self.policy.allowed(repulsion)

    def potential(self, x: Array, distance: Array) -> float:
        """Return the potential at ``x``, whose distances to the obstacles are given."""
        repulsive = repulsive_potential(distance, self.policy.repulsion, self.policy.influence)
        return attractive_potential(x, self.goal, self.stiffness, self.policy.cap) + repulsive

    def downhill(self, x: Array, step: Array, distance: Array, time: float) -> Array:
        """Halve a step until it does not increase the potential at ``time``; return 0 if no step is short enough."""
        if np.min(distance, initial=np.inf) > self.policy.influence + float(np.linalg.norm(step)):
            return step
        now = self.potential(x, distance)
        for _ in range(_HALVINGS):
            there = x + step
            if self.potential(there, self.distances(there, time)[0]) <= now:
                return step
            step = 0.5 * step
        return np.zeros(3)
