"""Oracles for a whole arm among moving obstacles: a search over postures and time.

The tool moves between the places of a grid. The grid extends along the learned path, to its sides and upwards. The arm
has one posture for each place. Time is divided into layers of 0.05 s. From one layer to the next, the arm may stay or
move to a neighbouring place. The search finds the motion of least cost on which all links keep a margin from every
obstacle. The oracles do not use the search of any compared method.

* ``oracle-future`` knows the true future motion of all obstacles. If this oracle finds no motion, the scene may have no
  solution.
* ``oracle-tracks`` knows only what the camera has observed, like the compared methods. It searches again every 0.3 s.

Both oracles may move faster or more slowly than the learned motion, or back along the path. A scene that both fail to
solve may still have a solution with other postures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from imitarm.benchmark.static_measures import LATEST
from imitarm.command import Command, Status
from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath, track
from imitarm.policies.policy import Observation, Policy
from imitarm.scene import MovingScene, Scene
from imitarm.skills.skill import Skill

Array = NDArray[np.float64]
Free = NDArray[np.bool_]

ORACLES = "oracle-future", "oracle-tracks"
"""The oracles by name."""
LAYER = 0.05
"""Time between two layers of the search [s]."""
_PLACES = 72  # along the path
_ASIDE = np.array([-0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24])  # [m] displacements to the side
_ABOVE = np.array([0.0, 0.08, 0.16, 0.24, 0.32])  # [m] and upwards
_FADES = 0.12  # of the path, at both ends, in which the displacements begin and end
_OFF_PLACE = 1e-3  # [m] error of a posture that is used
_SPEED = 0.9  # of the speed limits of the joints
_BLUR = 1.5  # layers: standard deviation of the filter that smooths the motion
_MARGINS = (0.045, 0.03, 0.02, 0.01)  # [m] that the links keep, largest first
_TOUCHED = 0.002  # [m] a smoothed motion that comes nearer than this is not used
_PERIOD, _AHEAD = 0.3, 3.0  # [s] between two searches with tracked obstacles; how far they look ahead
_LATE = 0.97  # of the longest duration, for the arrival
_GAIN = 8.0  # [1/s]
_ARRIVED = 3e-3  # [m]
_LAG, _DISPLACED = 1.0, 25.0  # cost per layer of one second of lag, squared; of a squared metre of displacement


@dataclass(frozen=True, eq=False)
class Postures:
    """The postures that the search may use: one posture for each place of a grid along, beside and above the path.

    Attributes:
        arm: the arm with its tool.
        joints: joint angles of the posture at each place, shape (n_places, n_aside, n_above, n_joints) [rad].
        centers: centres of the spheres that cover the arm, shape (n_places, n_aside, n_above, n_spheres, 3) [m].
        usable: whether the arm reaches the place within its joint limits, shape (n_places, n_aside, n_above).
        learned: time at which the learned motion passes each place along the path, shape (n_places,) [s].
    """

    arm: ArmModel
    joints: Array
    centers: Array
    usable: Free
    learned: Array

    @classmethod
    def of(cls, skill: Skill, arm: ArmModel, start: Array) -> Postures:
        """Compute the postures for the path of a skill.

        ``start`` is the start posture of the arm, shape (n_joints,) [rad].
        """
        learned = np.linspace(0.0, skill.duration_, _PLACES)
        path = skill.nominal(np.linspace(0.0, skill.duration_, 400))
        positions, quaternions = path.at(learned)
        if quaternions is None:
            quaternions = np.tile(arm.tool_pose(start).quaternion, (_PLACES, 1))
        share = np.linspace(0.0, 1.0, _PLACES)
        fade = np.clip(np.minimum(share, 1.0 - share) / _FADES, 0.0, 1.0)
        fade = fade * fade * (3.0 - 2.0 * fade)
        ahead = np.gradient(positions, axis=0)
        aside = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(_PLACES)], axis=1)
        aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
        shape = (_PLACES, len(_ASIDE), len(_ABOVE))
        joints, usable = np.empty((*shape, arm.n_joints)), np.empty(shape, dtype=bool)
        for (i, side), (j, up) in product(enumerate(_ASIDE), enumerate(_ABOVE)):
            places = positions + fade[:, None] * (side * aside + np.array([0.0, 0.0, up]))
            joints[:, i, j] = track(arm, start, places, quaternions)
            reached = ArmPath.of(arm, joints[:, i, j]).positions
            usable[:, i, j] = np.linalg.norm(reached - places, axis=1) < _OFF_PLACE
        usable &= ((joints >= arm.lower) & (joints <= arm.upper)).all(axis=-1)
        centers = ArmPath.of(arm, joints.reshape(-1, arm.n_joints)).centers
        return cls(arm, joints, centers.reshape(*shape, -1, 3), usable, learned)

    def free(self, scene: Scene, margin: float) -> Free:
        """Return which postures keep a margin [m] from every obstacle, shape (n_places, n_aside, n_above)."""
        free, radii = self.usable.copy(), self.arm.cover.radii + margin
        centers = self.centers.reshape(-1, self.centers.shape[-2], 3)
        flat = free.reshape(-1)
        for obstacle, reach in zip(scene.obstacles, scene.packed.radii, strict=True):
            middle = obstacle.solid().position
            away = centers - middle
            near = np.einsum("nsi,nsi->ns", away, away) < (radii + reach) ** 2
            near[~flat] = False
            posture, sphere = np.nonzero(near)
            if len(posture):
                gap = obstacle.distances_at(centers[posture, sphere], gradient=False)[0] - radii[sphere]
                flat[posture[gap < 0.0]] = False
        return free


@lru_cache(maxsize=2)
def postures_of(skill: Skill, arm: ArmModel, start: tuple[float, ...]) -> Postures:
    """Return the postures of an arm for a skill. Repeated calls with the same arguments reuse the result."""
    return Postures.of(skill, arm, np.array(start))


def search(
    postures: Postures, place: tuple[int, int, int], free: list[Free], due: Array, *, arrives: bool
) -> list[tuple[int, int, int]] | None:
    """Return the cheapest sequence of places, one place for each layer of time; None if no sequence is possible.

    Args:
        postures: the postures.
        place: first place of the sequence, as indices along, beside and above the path.
        free: for each layer of time, which postures keep the margin; arrays of shape (n_places, n_aside, n_above).
        due: index of the place along the path that the learned motion has reached in each layer, shape (n_layers,). The
            index may be fractional.
        arrives: whether the sequence must end at the goal.
    """
    shape = postures.usable.shape
    moves = sorted(product((-1, 0, 1), repeat=3), key=lambda m: sum(i * i for i in m))
    longest = _SPEED * postures.arm.max_velocity * LAYER
    allowed = []
    for move in moves:
        here, there = _slices(move, shape)
        allowed.append((np.abs(postures.joints[here] - postures.joints[there]) <= longest).all(axis=-1))
    step = float(postures.learned[1])
    beside = _DISPLACED * (_ASIDE[:, None] ** 2 + _ABOVE**2)
    cost = np.full(shape, np.inf)
    cost[place] = 0.0
    chosen = np.zeros((len(free), *shape), dtype=np.int8)
    for k in range(1, len(free)):
        best = np.full(shape, np.inf)
        for number, (move, can) in enumerate(zip(moves, allowed, strict=True)):
            here, there = _slices(move, shape)
            moved = np.where(can, cost[there] + 1e-3 * sum(i * i for i in move), np.inf)
            better = moved < best[here]
            best[here] = np.where(better, moved, best[here])
            chosen[k][here] = np.where(better, number, chosen[k][here])
        lag = _LAG * ((np.arange(shape[0]) - due[k]) * step) ** 2
        cost = np.where(free[k], best + lag[:, None, None] + beside, np.inf)
    if arrives:
        end = (shape[0] - 1, len(_ASIDE) // 2, 0)
    else:
        flat = np.unravel_index(int(np.argmin(cost)), shape)
        end = (int(flat[0]), int(flat[1]), int(flat[2]))
    if not np.isfinite(cost[end]):
        return None
    chain = [end]
    for k in range(len(free) - 1, 0, -1):
        move, at = moves[chosen[k][chain[-1]]], chain[-1]
        chain.append((at[0] - move[0], at[1] - move[1], at[2] - move[2]))
    return chain[::-1]


def _slices(move: tuple[int, ...], shape: tuple[int, ...]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the places that a move can reach, and for each of them the place from which the move starts."""
    here = tuple(slice(max(m, 0), n + min(m, 0)) for m, n in zip(move, shape, strict=True))
    there = tuple(slice(max(-m, 0), n + min(-m, 0)) for m, n in zip(move, shape, strict=True))
    return here, there


class ArmOracle(Policy):
    """Follow the joint motion that the search finds.

    Args:
        skill: skill to reproduce.
        truth: the true motion of the obstacles.
        start: start posture, shape (n_joints,) [rad].
        tracked: False: search once, with the true motion of the obstacles. True: search again every 0.3 s, with the
            observed obstacles.
        options: arguments of :class:`~imitarm.policies.Policy`; ``arm`` is required.
    """

    title: ClassVar[str] = "oracle"

    def __init__(self, skill: Skill, truth: MovingScene, start: Array, *, tracked: bool, **options: Any) -> None:
        super().__init__(skill, **options)
        if self.arm is None:
            raise InputError("ArmOracle: the search needs an arm; pass arm=ArmModel.load(...)")
        self._arm, self.truth, self.tracked = self.arm, truth, tracked
        self._postures = postures_of(skill, self.arm, tuple(start.tolist()))
        self._end = _LATE * LATEST * skill.duration_
        self._goal = skill.nominal(np.array([0.0, skill.duration_])).positions[-1]

    def reset(self, observation: Observation) -> None:
        """Search for a motion from the present state of the arm.

        Raises:
            InfeasibleError: when ``tracked`` is False and the search finds no motion.
        """
        self._times, self._motion = np.zeros(1), observation.state.q[None]
        self._searched, self._place = -np.inf, (0, len(_ASIDE) // 2, 0)
        if not self.tracked and not self._search(0.0, observation):
            raise InfeasibleError("the search finds no motion")

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the joint velocity that follows the motion of the latest successful search."""
        time, q = observation.time, observation.state.q
        if self.tracked and time - self._searched >= _PERIOD - 1e-9:
            self._searched = time
            self._search(time, observation)
        velocity = (self._at(time + dt) - self._at(time)) / dt + _GAIN * (self._at(time) - q)
        velocity = np.clip(velocity, -self._arm.max_velocity, self._arm.max_velocity)
        return Command(self._arm.jacobian(q) @ velocity, velocity, status=Status.AVOIDING, reason="searched")

    def finished(self, observation: Observation) -> bool:
        """Return whether the tool is at the goal and the duration of the learned motion has passed."""
        away = np.linalg.norm(observation.tool_to_base.position - self._goal)
        return bool(observation.time >= self.skill.duration_ and away < _ARRIVED)

    def _at(self, time: float) -> Array:
        return np.array([np.interp(time, self._times, column) for column in self._motion.T])

    def _search(self, time: float, observation: Observation) -> bool:
        """Search for a motion that begins now; return whether the search found a motion."""
        until = min(time + _AHEAD, self._end) if self.tracked else self._end
        times = np.arange(time, until + 1e-9, LAYER)
        if len(times) < 3:
            return False
        scenes = [observation.scene.at(float(t)) if self.tracked else self.truth.at(float(t)) for t in times]
        due = np.minimum(times / self.skill.duration_, 1.0) * (_PLACES - 1)
        if self.tracked:  # a motion that was late goes on from where it is
            away = np.abs(self._postures.joints - observation.state.q).max(axis=-1)
            at = np.unravel_index(int(np.argmin(np.where(self._postures.usable, away, np.inf))), away.shape)
            self._place = (int(at[0]), int(at[1]), int(at[2]))
            due = np.minimum(self._place[0] + (times - time) / self._postures.learned[1], _PLACES - 1.0)
        for margin in _MARGINS:
            free = [self._postures.free(scene, margin) for scene in scenes]
            chain = search(self._postures, self._place, free, due, arrives=not self.tracked)
            if chain is not None and self._take(times, chain, observation.state.q):
                return True
        return False

    def _take(self, times: Array, chain: list[tuple[int, int, int]], q: Array) -> bool:
        """Smooth a chain and follow it; return False if the smoothed motion touches an obstacle."""
        joints = np.array([self._postures.joints[place] for place in chain])
        fade = np.exp(-(times - times[0]) / 0.3)[:, None]
        joints = joints + fade * (q - joints[0])
        smooth = gaussian_filter1d(joints, _BLUR, axis=0, mode="nearest")
        smooth += np.exp(-(times - times[0]) / (2.0 * LAYER))[:, None] * (q - smooth[0])
        if not self.tracked and not self._is_clear(times, smooth):
            return False
        self._times, self._motion = times, smooth
        return True

    def _is_clear(self, times: Array, joints: Array) -> bool:
        """Return whether the whole arm touches nothing on a motion, with the true obstacles."""
        dense = np.arange(times[0], times[-1], 0.2 * LAYER)
        path = np.stack([np.interp(dense, times, column) for column in joints.T], axis=1)
        centers = ArmPath.of(self._arm, path).centers
        radii = self._arm.cover.radii
        for time, places in zip(dense, centers, strict=True):
            obstacles = self.truth.at(float(time)).obstacles
            if min(float((o.distances_at(places, gradient=False)[0] - radii).min()) for o in obstacles) < _TOUCHED:
                return False
        return True
