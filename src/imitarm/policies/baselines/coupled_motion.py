"""Base class of the baselines that add a coupling term to a dynamic movement primitive."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InfeasibleError
from imitarm.policies.baselines.baseline_policy import BaselinePolicy, ToolGaps
from imitarm.policies.baselines.reaction import Reaction
from imitarm.scene.distances import PackedObstacles
from imitarm.scene.scene import Scene
from imitarm.skills.dynamical_systems import DECAY, propagator, targets_by_step
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number

Array = NDArray[np.float64]

GAP_FLOOR = 0.005  # [m] shorter distances count as this one
_STEP = 0.01  # [s]
_LONGEST = 2.0  # durations
_ARRIVED, _SLOW = 1e-3, 0.1  # [m] from the goal, and fraction of the mean speed: the motion ends
_NEAR, _STILL = 5e-3, 5e-4  # [m] from the goal, and within a quarter of the duration: likewise, beside an obstacle


class MotionState(NamedTuple):
    """State of a primitive's motion, with the distances and directions between the tool and the obstacles.

    Velocities are multiplied by the duration T, as in the equation of a motion primitive, and thus have the unit m.

    Attributes:
        position: position x of the tool, shape (3,) [m].
        velocity: velocity of the tool times T, v = T x', shape (3,) [m].
        phase: phase s of the primitive, which decays from 1 at the start to 0.01 after the duration T.
        fraction: elapsed time divided by the duration T.
        learned: position of the nominal path at this time, shape (3,) [m].
        distance: the gap, or 5 mm if the gap is smaller, shape (n,) [m].
        reach: distance from the tool's tip to the closest point of each obstacle, or 5 mm if it is nearer, shape (n,)
            [m].
        normal: outward normals at the closest points ``x - reach normal``, shape (n, 3).
        relative: velocity of the tool relative to each obstacle's closest point, times T, shape (n, 3) [m].
        gap: distance from the tool to each obstacle, minus the required clearance; may be negative, shape (n,) [m].
    """

    position: Array
    velocity: Array
    phase: float
    fraction: float
    learned: Array
    distance: Array
    reach: Array
    normal: Array
    relative: Array
    gap: Array

    @property
    def velocity_of_obstacles(self) -> Array:
        """Velocity of the closest point of each obstacle, times T, shape (n, 3) [m]."""
        return self.velocity - self.relative


class CoupledMotion(BaselinePolicy):
    r"""Base class of the baselines that add a coupling term ``Phi`` to a dynamic movement primitive.

    The equation is::

        T^2 x'' = K (y(s) - x) - D T x' + Phi,        |Phi| <= T^2 a_max

    The primitive is a spring with damping that follows the target ``y(s)`` of the skill; its gains K and D are those of
    the skill. T is the duration [s]. The equation is solved exactly in steps of 10 ms, during which ``Phi`` is
    constant. The motion ends when the tool is at the goal, but not before the time T. If the tool is more than 5 mm
    from the goal after the time 2 T, the method refuses the scene.

    A subclass implements :meth:`term`. The component of ``Phi`` in a forbidden direction is removed. The published
    methods have no limit ``a_max``. Here, the limit is necessary, because some terms grow without bound near an
    obstacle and could move the tool far away within one step.

    Args:
        skill: skill to reproduce.
        max_acceleration: a_max, the largest acceleration that ``Phi`` may cause [m/s^2].
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`.
    """

    predicts = True

    def __init__(self, skill: Skill, *, max_acceleration: float = 10.0, **options: Any) -> None:
        super().__init__(skill, **options)
        name = type(self).__name__
        self.max_acceleration = finite_number(max_acceleration, f"{name}: max_acceleration", "m/s^2", above=0.0)

    @abstractmethod
    def term(self, state: MotionState) -> Array:
        """Return the coupling term Phi at a state, the sum over all obstacles, shape (3,) [m]."""

    def bounded_term(self, state: MotionState, limit: float) -> Array:
        """Return the coupling term (3,) [m] without forbidden components, scaled down to the norm ``limit`` [m]."""
        phi = self.allowed(self.term(state))
        size = float(np.sqrt(phi.dot(phi)))
        return phi * (limit / size) if size > limit else phi

    def constrained(self, before: Array, after: Array, state: MotionState, step: float) -> Array:
        """Return the position and the velocity after a step; a subclass may change them.

        Args:
            before: position and scaled velocity [x; T x'] before the step, shape (2, 3) [m].
            after: [x; T x'] after the step, as the equation of the primitive gives it, shape (2, 3) [m].
            state: state before the step, with the obstacles.
            step: length of the step, as a fraction of the duration.
        """
        del before, state, step
        return after

    def reaction(self, nominal: Trajectory, position: Array, velocity: Array, fraction: float) -> Reaction:
        """Return the motion of the primitive in a changing scene, which is computed one control period at a time."""
        return _CoupledReaction(self, nominal, position, velocity, fraction)

    def target(self, nominal: Trajectory, fractions: Array) -> Array:
        """Return the target of the spring, shape (n, 3) [m].

        Args:
            nominal: the learned path between the start and the goal of this motion.
            fractions: times divided by the duration T, shape (n,).
        """
        begun = self.skill.dmp_.begin(nominal.positions[0], nominal.positions[-1])
        return begun.target.at(np.exp(-DECAY * fractions))

    def start_velocity(self) -> Array:
        """Return the scaled velocity T x' at the start, shape (3,) [m]."""
        return self.skill.dmp_.start_velocity_ * self.skill.duration_

    def tool_path(self, nominal: Trajectory, gaps: ToolGaps, scene: Scene) -> tuple[Array, Array]:
        """Return the path of the primitive with its coupling term.

        Raises:
            InfeasibleError: when the tool is not within 5 mm of the goal after twice the duration.
        """
        T, goal = nominal.duration, nominal.positions[-1]
        surroundings = Surroundings(gaps, scene.packed, self.clearance, T)
        n = max(1, round(T / _STEP))
        one = propagator(self.skill.dmp_.gains_, 1.0 / n, self.skill.dmp_.n_basis)
        n_steps = round(_LONGEST * n)
        targets = self.target(nominal, np.linspace(0.0, _LONGEST, 2 * one.n_parts * n_steps + 1))
        drives = one.drive @ np.moveaxis(targets_by_step(one, targets), 0, 1)
        learned = nominal.at(np.minimum(nominal.times[0] + T / n * np.arange(n_steps), nominal.times[-1]))[0]
        z = np.stack([nominal.positions[0], self.start_velocity()])
        path, limit, slow = [z[0]], self.max_acceleration * T * T, _SLOW * nominal.path_length
        for k in range(n_steps):
            if k >= n and _has_arrived(path, z[1], goal, n // 4, slow):
                break
            state = surroundings.state(z, k / n, learned[k])
            phi = self.bounded_term(state, limit)
            z = self.constrained(z, one.transition.dot(z) + drives[k] + one.push[:, None] * phi, state, 1.0 / n)
            path.append(z[0])
        away = float(np.linalg.norm(z[0] - goal))
        if away > _NEAR:
            raise InfeasibleError(
                f"{type(self).__name__}: the tool is still {1e3 * away:.0f} mm from the goal after twice the learned "
                f"duration; choose another gain, or another policy"
            )
        return np.linspace(0.0, T * (len(path) - 1) / n, len(path)), np.stack(path)


def _has_arrived(path: list[Array], velocity: Array, goal: Array, quarter: int, slow: float) -> bool:
    """Return whether the tool is at the goal and slow, or near the goal and at rest for a quarter of the duration."""
    away = float(np.linalg.norm(path[-1] - goal))
    if away < _ARRIVED:
        return float(np.linalg.norm(velocity)) <= slow
    return away < _NEAR and all(
        float(np.linalg.norm(path[-1] - path[-1 - back])) < _STILL for back in (quarter, quarter // 2, quarter // 4)
    )


class _CoupledReaction(Reaction):
    """The equation of :class:`CoupledMotion`, one control period at a time."""

    def __init__(
        self, policy: CoupledMotion, nominal: Trajectory, position: Array, velocity: Array, fraction: float
    ) -> None:
        super().__init__(nominal, position, velocity, fraction)
        self.policy, self._steps, self._dt = policy, 0, 0.0
        if fraction == 0.0:
            self.velocity = policy.start_velocity() / nominal.duration

    def step(self, scene: Scene, dt: float) -> None:
        """Move by one step of the spring, with the coupling term of the observed obstacles."""
        policy, T = self.policy, self.nominal.duration
        if dt != self._dt:
            self._prepare(dt)
        k = min(self._steps, len(self._drives) - 1)
        around = Surroundings(ToolGaps(scene, policy.tool_spheres), scene.packed, policy.clearance, T)
        z = np.stack([self.position, T * self.velocity])
        state = around.state(z, self.fraction, self.learned(self.fraction), 0.0)
        phi = policy.bounded_term(state, policy.max_acceleration * T * T)
        z = policy.constrained(
            z, self._one.transition.dot(z) + self._drives[k] + self._one.push[:, None] * phi, state, dt / T
        )
        self.position, self._end = z[0], z[1] / T
        self._steps, self.fraction = self._steps + 1, self.fraction + dt / T

    def advance(self, scene: Scene, dt: float) -> Array:
        """Return the mean velocity of the step; the velocity at its end belongs to the state of the spring."""
        before = self.position
        self.step(scene, dt)
        self.velocity = self._end
        return np.asarray((self.position - before) / dt)

    def _prepare(self, dt: float) -> None:
        """Compute what the target adds to the spring in each period, from now to three times the duration."""
        policy, step = self.policy, dt / self.nominal.duration
        self._dt, self._steps = dt, 0
        self._one = propagator(policy.skill.dmp_.gains_, step, policy.skill.dmp_.n_basis)
        n = max(1, math.ceil((_LONGEST + 1.0 - self.fraction) / step))
        fractions = self.fraction + step * np.linspace(0.0, n, 2 * self._one.n_parts * n + 1)
        targets = policy.target(self.nominal, fractions)
        self._drives = self._one.drive @ np.moveaxis(targets_by_step(self._one, targets), 0, 1)


class Surroundings:
    """Computes distances and directions from the tool to the obstacles of one scene during a motion.

    Args:
        gaps: distances to the obstacles.
        packed: the obstacles at time 0.
        clearance: required clearance [m].
        duration: duration T of the motion [s].
    """

    def __init__(self, gaps: ToolGaps, packed: PackedObstacles, clearance: float, duration: float) -> None:
        self._gaps, self._packed = gaps, packed
        self._clearance, self._duration = clearance, duration

    def state(self, z: Array, fraction: float, learned: Array, time: float | None = None) -> MotionState:
        """Return the state of the motion for a position and a velocity.

        Args:
            z: [x; T x'], the position and the velocity times the duration T, shape (2, 3) [m].
            fraction: elapsed time divided by the duration T.
            learned: position of the nominal path at this time, shape (3,) [m].
            time: time since the stamp of the scene, for the positions of moving obstacles [s]; None: time since the
                motion began.
        """
        x, v = z
        time = fraction * self._duration if time is None else time
        if self._packed.still:
            gap, normal = self._gaps.gaps_and_normals(x)
            relative = v - self._packed.velocities  # 0
        else:
            gap, normal = self._gaps.gaps_and_normals(x[None], [time])
            gap, normal = gap[:, 0], normal[:, 0]
            closest = x - (gap + self._gaps.radius)[:, None] * normal
            relative = v - self._duration * self._velocities(closest, time)
        return MotionState(
            x,
            v,
            float(np.exp(-DECAY * fraction)),
            fraction,
            learned,
            np.maximum(gap - self._clearance, GAP_FLOOR),
            np.maximum(gap + self._gaps.radius, GAP_FLOOR),
            normal,
            relative,
            gap - self._clearance,
        )

    def _velocities(self, points: Array, time: float) -> Array:
        """Return the velocity of one point of each obstacle, shape (n, 3) [m/s]."""
        packed = self._packed
        if not packed.rotating:
            return packed.velocities
        arm = points - packed.positions - time * packed.velocities
        return packed.velocities + np.cross(packed.angular_velocities, arm)
