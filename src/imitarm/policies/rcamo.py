"""RCAMO, real-time collision avoidance for moving obstacles (thesis Chapter 5)."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from imitarm.command import Command, Status
from imitarm.compiled import library
from imitarm.compiled.kernels import Block, Record, address
from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    Pose,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    quaternion_to_matrix,
)
from imitarm.perception.margins import CoverageMargin
from imitarm.policies.headings import allowed_axes, frame, headings
from imitarm.policies.least_cost import STAY, Choice, LeastCost, Prediction, Response
from imitarm.policies.obstacle_cost import DistanceCost, GaussianCost, Groups, ObstacleCost, PredictedObstacles
from imitarm.policies.policy import Observation, Policy
from imitarm.policies.prediction_margin import EstimatedMargin
from imitarm.policies.primitive_path import PrimitivePath, learned_precision
from imitarm.scene.distances import PackedObstacles, distances
from imitarm.scene.packed_record import record_of
from imitarm.scene.scene import Scene
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import Gains
from imitarm.skills.skill import Skill
from imitarm.validation import choice, finite_array, finite_number, instance, whole_number

Array = NDArray[np.float64]

_SAME_PLACE = 5e-3  # [m, rad] a start nearer than this to the learned one is the learned one
_RATE_TIME = 0.1  # [s] in which the phase takes up another speed
_HELD, _AT_LEAST = 1.0, 0.95  # [s] for which the lag exceeds this fraction of the permitted lag: the arm cannot follow
_STANDS = 0.1  # speed of the phase below which the motion is said to wait
_DISPLACED = 1e-3  # [m] from the learned path: less is not called avoiding
_FASTEST_TURN = 1.0  # [rad/s] by which an error of the tool's rotation is corrected


class _Near(NamedTuple):
    """The obstacles that may come near, predicted, and their indices in the scene."""

    obstacles: PredictedObstacles
    indices: NDArray[np.intp]


class RCAMO(Policy):
    r"""Follow the motion primitive of a skill, and evade moving obstacles by the motion with the least predicted cost.

    The skill's motion primitive (a DMP, fitted to the mean of GMR) gives the motion ``xi(s)`` for a scene without
    obstacles. The phase s runs from 0 to 1. The tool is at ``x``. Its deviation ``e = x - xi(s)`` obeys the spring and
    damper of the primitive, with a coupling acceleration ``u``:

    .. math:: \tau^2 \ddot e + D \tau \dot e + K e = \tau^2 u, \qquad \dot s = r / T

    In every step, the policy chooses ``u`` and the speed ``r`` of the phase. For every candidate, it predicts the
    motion of the tool and of the obstacles over a horizon. It takes the candidate with the least cost (thesis Eq 5.5,
    corrected; see :class:`~imitarm.policies.least_cost.LeastCost`). The candidates include waiting and moving
    backwards. If no obstacle is near, ``u`` is 0, and the spring brings the tool back to its path. If the tool lags
    behind its commanded position, the phase slows down or stops. If this takes more than one second, the arm may be
    unable to reach so far to the side. Then only the lag along the path slows the phase down.

    The policy keeps only the tool clear of obstacles; the :class:`~imitarm.safety.SafetyFilter` keeps the links clear.
    The policy decides step by step. It does not know in advance whether the tool will reach the goal, and never raises
    InfeasibleError.

    Args:
        skill: skill to reproduce.
        cost: ``"distance"``: the cost of an obstacle depends on the signed distance, for any shape; ``"gaussian"``:
            Gaussian cost as in the thesis (see :mod:`~imitarm.policies.obstacle_cost`).
        gains: stiffness K and damping D of the primitive and of the deviation: ``"critical"`` (critical damping),
            ``"thesis"`` (K = 139.26, D = 28) or Gains.
        margin: a :class:`~imitarm.perception.CoverageMargin`: additional distance that grows with the look-ahead time.
            None: an :class:`~imitarm.policies.prediction_margin.EstimatedMargin` with the next four arguments.
        beta: the margin contains this number of standard deviations of an obstacle's observed position.
        cap: largest part of the margin because of these standard deviations [m].
        growth: fraction of an obstacle's speed at which the margin grows with the look-ahead time.
        growth_cap: largest growth of the margin [m].
        time_constant: tau, the time constant of the deviation [s]; the thesis uses 1 s.
        max_acceleration: largest acceleration of the deviation by u, spring and damper together [m/s^2].
        max_push: largest norm of u [m/s^2]. A constant u leads to the deviation ``tau^2 u / K``.
        horizon: number H of future times for which motions are predicted.
        interval: interval between these times [s].
        gain: feedback gain of the tool's position and rotation [1/s].
        patience: distance of the tool from its commanded position at which the phase stops [m].
        arrival: distance from the goal below which the tool has arrived [m].
        options: arguments of :class:`~imitarm.policies.Policy`.
    """

    def __init__(
        self,
        skill: Skill,
        *,
        cost: Literal["distance", "gaussian"] = "distance",
        gains: str | Gains = "critical",
        margin: CoverageMargin | None = None,
        beta: float = 1.0,
        cap: float = 0.01,
        growth: float = 0.4,
        growth_cap: float = 0.05,
        time_constant: float = 2.0,
        max_acceleration: float = 13.0,
        max_push: float = 40.0,
        horizon: int = 12,
        interval: float = 0.05,
        gain: float = 8.0,
        patience: float = 0.02,
        arrival: float = 0.003,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        choice(cost, ("distance", "gaussian"), "RCAMO: cost")
        self.gains = Gains.of(gains, "RCAMO")
        self._margin = None if margin is None else instance(margin, CoverageMargin, "RCAMO: margin")
        given = {"beta": (beta, ""), "cap": (cap, "m"), "growth": (growth, ""), "growth_cap": (growth_cap, "m")}
        numbers = [finite_number(x, f"RCAMO: {name}", unit, at_least=0.0) for name, (x, unit) in given.items()]
        self._estimated = EstimatedMargin(*numbers)
        self._tau = finite_number(time_constant, "RCAMO: time_constant", "s", above=0.0)
        self._gain = finite_number(gain, "RCAMO: gain", "1/s", above=0.0)
        self._patience = finite_number(patience, "RCAMO: patience", "m", above=0.0)
        self._arrival = finite_number(arrival, "RCAMO: arrival", "m", above=0.0)
        steps = whole_number(horizon, "RCAMO: horizon", at_least=1, at_most=200)
        times = finite_number(interval, "RCAMO: interval", "s", above=0.0) * np.arange(1.0, steps + 1.0)
        limit = finite_number(max_acceleration, "RCAMO: max_acceleration", "m/s^2", above=0.0)
        push = finite_number(max_push, "RCAMO: max_push", "m/s^2", above=0.0)
        spheres = np.zeros((1, 4)) if self.tool_spheres is None else self.tool_spheres
        self._spheres = spheres[:, :3]
        self._offset_spheres = bool(self._spheres.any())
        self._tool_radius = float(np.max(np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]))
        forbidden = finite_array(np.reshape(np.asarray(self.forbidden, dtype=float), (-1, 3)), (None, 3), "forbidden")
        self._axes, rest = allowed_axes(forbidden / np.linalg.norm(forbidden, axis=1, keepdims=True))
        self._one_sided = rest @ self._axes.T
        obstacle_cost: ObstacleCost = DistanceCost(self.clearance, spheres[:, 3])
        if cost == "gaussian":
            whole = LeastCost.deviation_weight * float(np.sum(LeastCost.discount ** np.arange(1.0, steps + 1.0)))
            obstacle_cost = GaussianCost(self.clearance, spheres[:, 3], stiffness=whole)
        self.least_cost = LeastCost(
            times, self.gains, self._tau, obstacle_cost, push, headings(self._axes), max_acceleration=limit
        )
        self._dmp, self._precision = _primitive(skill, self.gains), learned_precision(skill)
        self._steps: dict[float, tuple[Array, Array]] = {}  # by dt: how the deviation and its rate change
        self._stiffness = np.array([self.gains.stiffness / self._tau**2, self.gains.damping / self._tau])
        self._path: PrimitivePath | None = None
        self._learned_goal = skill.goal_
        self._known: tuple[Pose | None, PrimitivePath | None] = None, None  # a goal, and the motion to it
        self._path_record: tuple[PrimitivePath, Array, Record] | None = None
        self._room_for, self._room, self._state, self._out = -1, *(Block(np.zeros(n)) for n in (1, 30, 6))

    # ----- start

    def reset(self, observation: Observation) -> None:
        """Start the motion at the measured pose of the tool."""
        instance(observation, Observation, "RCAMO.reset: observation")
        away = observation.tool_to_base.error_to(self.skill.start_)
        if not self.skill.gmr_.has_orientation_:
            away = away[:3]
        start = None if np.linalg.norm(away) <= _SAME_PLACE else observation.tool_to_base
        self._path = PrimitivePath.of(self._dmp, self._precision, start, observation.scene.goal)
        self._begin(observation, 0.0)

    def resume(self, observation: Observation, phase: float) -> None:
        """Continue from the measured pose of the tool, at the phase ``phase`` of the motion, 0 to 1.

        The policy continues the motion that the last call of :meth:`reset` started. Without such a call, it continues
        the motion from the learned start.
        """
        phase = finite_number(phase, "RCAMO.resume: phase", at_least=0.0, at_most=1.0)
        instance(observation, Observation, "RCAMO.resume: observation")
        if self._path is None:
            self._path = PrimitivePath.of(self._dmp, self._precision, None, observation.scene.goal)
        self._begin(observation, phase)

    def _begin(self, observation: Observation, phase: float) -> None:
        path = self._followed(observation)
        self._phase, self._rate, self._held = phase, 1.0, 0.0
        self._deviation = np.zeros((2, 3))
        self._deviation[0] = observation.tool_to_base.position - path.position(phase)
        self._scaled = np.zeros(3)
        self._hold = observation.tool_to_base.quaternion
        self._reason = ""

    @property
    def phase(self) -> float:
        """Phase of the motion, from 0 at the start to 1 at the end."""
        return self._phase

    def _followed(self, observation: Observation) -> PrimitivePath:
        """Return the motion to the goal of the scene; if the goal has moved, the tool keeps its place."""
        path = self._path
        if path is None:
            raise InputError("RCAMO.step: call reset(observation) or resume(observation, phase) first")
        goal = self._learned_goal if observation.scene.goal is None else observation.scene.goal
        if goal is path.goal or (goal is self._known[0] and path is self._known[1]):
            return path
        if not (
            np.array_equal(goal.position, path.goal.position) and np.array_equal(goal.quaternion, path.goal.quaternion)
        ):
            moved = path.to(goal)
            self._deviation[0] -= moved.position(self._phase) - path.position(self._phase)
            path = self._path = moved
        self._known = goal, path
        return path

    @cached_property
    def _record(self) -> Record:
        """The C structure ``LeastCost``."""
        given = self._spheres, self._one_sided, self._tool_radius, _RATE_TIME, *self._estimated
        return self.least_cost.record(*given)

    # ----- each step

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command of least predicted cost.

        Raises:
            InputError: when neither ``reset`` nor ``resume`` was called, or ``dt`` is not a positive number.
        """
        instance(observation, Observation, "RCAMO.step: observation")
        dt = finite_number(dt, "RCAMO.step: dt", "s", above=0.0)
        path = self._followed(observation)
        x = observation.tool_to_base.position
        reference = path.position(self._phase) + self._deviation[0]
        lag = x - reference
        away = math.sqrt(lag.dot(lag))
        if away > self._patience:
            shift = lag * (1.0 - self._patience / away)
            self._deviation[0] += shift
            reference, lag, away = reference + shift, lag - shift, self._patience
        chosen = self._choose(observation, path, lag)
        self._scaled = chosen.scaled
        self._held = self._held + dt if away > _AT_LEAST * self._patience else 0.0
        behind = away if self._held < _HELD else max(0.0, -float(lag.dot(path.tangent(self._phase))))
        rate = chosen.rate * max(0.0, 1.0 - (behind / self._patience) ** 2)
        phase = self._advance(rate, self.least_cost.max_push * chosen.scaled, dt)
        moved = path.position(self._phase) + self._deviation[0]
        twist = np.empty(6)
        twist[:3] = (moved - reference) / dt - self._gain * lag
        twist[3:] = self._rotation(path, observation.tool_to_base, phase, dt)
        return self._command(twist, observation, chosen, away)

    def _advance(self, rate: float, push: Array, dt: float) -> float:
        """Advance phase and deviation by ``dt``; return the phase before."""
        matrices = self._steps.get(dt)
        if matrices is None:
            A, B, G, a, b, g = Response.of(self.gains, self._tau, np.array([dt]))
            matrices = self._steps[dt] = np.column_stack(([*A, *a], [*B, *b])), np.array([G, g])
        before = self._phase
        decay = math.exp(-dt / _RATE_TIME)
        travelled = rate * dt + (self._rate - rate) * _RATE_TIME * (1.0 - decay)
        self._phase = min(max(self._phase + travelled / self._dmp.duration_, 0.0), 1.0)
        self._rate = rate + (self._rate - rate) * decay
        by_itself, by_push = matrices
        self._deviation = by_itself.dot(self._deviation)
        self._deviation += by_push * push
        return before

    def _phases(self, rates: Array, times: Array) -> Array:
        """Return the phases at ``times`` (H,) [s] from now, when the phase takes up speeds (R, 1), shape (R, H)."""
        transient = (_RATE_TIME / self._dmp.duration_) * (1.0 - np.exp(times / -_RATE_TIME))
        return np.asarray(self._phase + rates * (times / self._dmp.duration_) + (self._rate - rates) * transient)

    def _choose(self, observation: Observation, path: PrimitivePath, lag: Array) -> Choice:
        """Return the choice; ``nearest`` is an index in the scene."""
        if not len(observation.scene.packed):
            return STAY
        kernel = library()
        if kernel is not None and type(self.least_cost.obstacle_cost) is DistanceCost:
            return self._compiled_choice(kernel, observation, path, lag)
        near = self._near(observation, path)
        if near is None:
            return STAY
        chosen = self._choose_by_numpy(path, lag, near)
        return chosen if chosen.nearest < 0 else chosen._replace(nearest=int(near.indices[chosen.nearest]))

    def _compiled_choice(self, kernel: Any, observation: Observation, path: PrimitivePath, lag: Array) -> Choice:
        packed, path_record = observation.scene.packed, self._path_record
        if path_record is None or path_record[0] is not path or path_record[1] is not self._hold:
            path_record = self._path_record = path, self._hold, path.record(self._offset_spheres, self._hold)
        (obstacles, dt), constants = record_of(packed), self._record.address
        if self._room_for < len(packed):
            self._room_for = len(packed)
            self._room = Block(np.empty(kernel.least_cost_scratch(constants, len(packed))))
        elapsed, state, margins = observation.time - observation.scene.stamp, self._state.array, None
        if self._margin is not None:
            margins = np.ascontiguousarray(self._margins(packed, elapsed))
        axes = frame(path.tangent(self._phase), self._axes)
        state[:3], state[3:6], state[6:12] = observation.tool_to_base.position, lag, self._deviation.ravel()
        state[12:15], state[15:18] = self._scaled, self._spring() / self.least_cost.max_push
        state[18:21] = self._phase, self._rate, elapsed
        state[21 : 21 + axes.size] = axes.ravel()
        places = constants, path_record[2].address, self._state.address, None if margins is None else address(margins)
        nearest = kernel.least_cost_choice(obstacles.address, dt, *places, self._room.address, self._out.address)
        if nearest < 0:
            return STAY
        x, y, z, rate, cost, gap = self._out.array.tolist()
        return Choice(np.array([x, y, z]), rate, cost, nearest, gap)

    def _spring(self) -> Array:
        """Return the acceleration of spring and damper, against the deviation, shape (3,) [m/s^2]."""
        return self._stiffness.dot(self._deviation)

    def _choose_by_numpy(self, path: PrimitivePath, lag: Array, near: _Near) -> Choice:
        least_cost, times = self.least_cost, self.least_cost.times
        free = least_cost.response.free(self._deviation) + least_cost.response.A[:, None] * lag

        goal = path.goal.position[None]
        if self._offset_spheres:
            goal = goal + self._offsets(path, np.full((1, 1), -1))[0, 0]
        precision = path.precision[round(self._phase * (len(path.precision) - 1))]

        def predict(rates: Array) -> Prediction:
            phases = self._phases(rates[:, None], times)
            centers = (path.positions_at(phases) + free)[:, :, None]
            if self._offset_spheres:
                centers = centers + self._offsets(path, path.nearest(phases))
            return Prediction(centers, phases >= 1.0, goal)

        axes = frame(path.tangent(self._phase), self._axes)
        given = free, precision, predict, near.obstacles, self._spring()
        return least_cost.choose(axes, self._one_sided, self._scaled, *given)

    def _offsets(self, path: PrimitivePath, samples: NDArray[np.intp]) -> Array:
        """Return the centres of the tool's spheres relative to its tip, shape (R, H, S, 3) [m]."""
        if path.rotations is None:
            return (self._spheres @ quaternion_to_matrix(self._hold).T)[None, None]
        return np.matmul(path.rotations[samples], self._spheres.T).swapaxes(-1, -2)

    def _near(self, observation: Observation, path: PrimitivePath) -> _Near | None:
        """Return the obstacles that may have an effect within the horizon; None if there is none."""
        scene = observation.scene
        packed = scene.packed
        if not len(packed):
            return None
        elapsed, span = observation.time - scene.stamp, float(self.least_cost.times[-1])
        x = observation.tool_to_base.position
        offset = packed.positions + elapsed * packed.velocities - x
        gap = np.sqrt(np.sum(offset * offset, axis=1)) - packed.radii
        unbounded = np.isinf(packed.radii)
        if unbounded.any():
            gap = np.where(unbounded, distances(packed, x[None, None], [elapsed])[:, 0, 0], gap)
        speed = np.sqrt(np.sum(packed.velocities * packed.velocities, axis=1))
        margin = self._margins(packed, elapsed)
        influence = self.least_cost.obstacle_cost.influence(packed) + margin.max(axis=1)
        reach = self._tool_radius + self._travel(path) + influence
        indices = (gap - span * speed <= reach).nonzero()[0]
        if not len(indices):
            return None
        if len(indices) < len(packed):
            packed, margin = packed.take(indices), margin[indices]
        return _Near(PredictedObstacles(packed, elapsed + self.least_cost.times, margin), indices)

    def _travel(self, path: PrimitivePath) -> float:
        """Return a bound of the tool's travel within the horizon [m]."""
        response, (e, v) = self.least_cost.response, self._deviation
        own = np.abs(response.A - 1.0).max() * np.sqrt(e.dot(e)) + np.abs(response.B).max() * np.sqrt(v.dot(v))
        return float(own + self.least_cost.travel + path.speed * self.least_cost.times[-1])

    def _margins(self, packed: PackedObstacles, elapsed: float) -> Array:
        """Return the additional distance to each of n obstacles at each instant, shape (n, H) [m]."""
        times = elapsed + self.least_cost.times
        if self._margin is not None:
            return np.broadcast_to(self._margin.at(times), (len(packed), len(times)))
        return self._estimated.at(packed, times)

    def _rotation(self, path: PrimitivePath, tool: Pose, phase: float, dt: float) -> Array:
        """Return the angular velocity that follows the learned rotation, shape (3,) [rad/s]."""
        before, after = path.quaternion(phase), path.quaternion(self._phase)
        forward = np.zeros(3)
        if before is None or after is None:
            before = self._hold
        else:
            forward = quaternion_log(quaternion_multiply(after, quaternion_conjugate(before))) / dt
        error = self._gain * tool.error_to(Pose.trusted(tool.position, before))[3:]
        size = math.sqrt(error.dot(error))
        return forward + (error * (_FASTEST_TURN / size) if size > _FASTEST_TURN else error)

    def _command(self, twist: Array, observation: Observation, chosen: Choice, lag: float) -> Command:
        if chosen.nearest >= 0:
            name = observation.scene.name_of(chosen.nearest)
            self._reason = f"{name}, predicted to come within {1e3 * chosen.gap:.0f} mm of the tool"
        deviation = math.sqrt(self._deviation[0].dot(self._deviation[0]))
        waits = self._rate < _STANDS and self._phase < 1.0
        if waits and chosen.rate < _STANDS:
            reason = f"the motion waits because of {self._reason}"
            return Command(twist, progress=self._phase, status=Status.WAITING, reason=reason)
        if waits or (self._phase >= 1.0 and lag >= 0.5 * self._patience):
            reason = f"the tool is {1e3 * lag:.0f} mm behind its motion"
            return Command(twist, progress=self._phase, status=Status.WAITING, reason=reason)
        if self._phase >= 1.0 and deviation > self._arrival and chosen.scaled.any():
            reason = f"the way to the goal is not free because of {self._reason}"
            return Command(twist, progress=self._phase, status=Status.WAITING, reason=reason)
        if self._reason and (deviation > _DISPLACED or chosen.rate < 1.0):
            reason = f"the tool is {1e3 * deviation:.0f} mm from its path because of {self._reason}"
            return Command(twist, progress=self._phase, status=Status.AVOIDING, reason=reason)
        return Command(twist, progress=self._phase)

    def cost_field(self, scene: Scene, points: ArrayLike) -> Array:
        r"""Return the cost of tool positions, for drawing it (thesis Eq 5.1, corrected).

        .. math:: J^G(\chi) = \tfrac12 w_e\,(\chi - \xi)^T \Theta\,(\chi - \xi) + \sum_i b_i(\chi)

        Here, chi is a tool position, and xi is the nearest point of the motion. The obstacles stay at their poses in
        the scene.

        Args:
            scene: goal and obstacles at one time.
            points: positions of the tool's tip, shape (..., 3) [m]; the tool has the rotation of the learned start.

        Returns:
            Shape (...).
        """
        chi = finite_array(points, (..., 3), "RCAMO.cost_field: points", "m")
        flat = chi.reshape(-1, 3)
        path = PrimitivePath.of(self._dmp, self._precision, None, scene.goal)
        nearest = KDTree(path.positions).query(flat)[1]
        away = flat - path.positions[nearest]
        pulled = np.matmul(path.precision[nearest], away[:, :, None])[..., 0]
        cost = 0.5 * self.least_cost.deviation_weight * np.sum(away * pulled, axis=1)
        turned = np.eye(3) if path.rotations is None else path.rotations[0]
        packed = scene.packed
        obstacles = PredictedObstacles(packed, np.zeros(1), np.zeros((len(packed), 1)))
        still = np.zeros(len(flat)), np.zeros((1, 3))
        for i in range(len(packed)):
            values = []
            for j, offset in enumerate(self._spheres @ turned.T):
                groups = Groups(*(np.full(len(flat), index, dtype=np.intp) for index in (i, 0, j)))
                gaps = self.least_cost.obstacle_cost.gaps(obstacles, groups, flat + offset, *still)
                values.append(
                    self.least_cost.obstacle_cost.values(obstacles, groups, flat + offset, *still, gaps)[:, 0]
                )
            cost += np.max(values, axis=0)
        return np.asarray(cost.reshape(chi.shape[:-1]))

    def finished(self, observation: Observation) -> bool:
        """Return whether the phase is 1 and the tool is nearer than ``arrival`` to the goal."""
        if self._path is None:
            return False
        goal = self._learned_goal if observation.scene.goal is None else observation.scene.goal
        away = observation.tool_to_base.position - goal.position
        return self._phase >= 1.0 and float(np.sqrt(away.dot(away))) < self._arrival


def _primitive(skill: Skill, gains: Gains) -> DMP:
    """Return the skill's primitive, or one with other gains that is trained on the same nominal path."""
    if skill.dmp_.gains_ == gains:
        return skill.dmp_
    n = skill.dmp_.n_basis
    return DMP(gains, n_basis=n).fit(skill.gmr_.trajectory(max(400, 5 * n)), exact_ends=True)
