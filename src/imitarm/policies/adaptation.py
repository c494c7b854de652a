"""Adapt a whole learnt path to a scene by moving only the components near an obstacle (thesis Chapter 4)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose
from imitarm.policies.baselines.potential_components import push_components
from imitarm.policies.certificate import Detour, distances, judged
from imitarm.policies.certified import find_detour
from imitarm.policies.component_path import STILL, ComponentPath
from imitarm.scene.scene import Scene
from imitarm.trajectory import Trajectory

if TYPE_CHECKING:
    from imitarm.skills.skill import Skill

Array = NDArray[np.float64]

METHODS = ("certified", "mapf", "literal")
HORIZONTAL_ONLY = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))  # stay in the plane of the table: 2-D avoidance
NOT_DOWN = ((0.0, 0.0, -1.0),)  # never into the table


@dataclass(frozen=True, eq=False)
class Adaptation:
    """What became of a skill's path in a scene.

    Attributes:
        nominal: the path without obstacles.
        trajectory: the adapted path, same times; where it is not ``feasible``, the best attempt, not to be executed.
        displacement: of each component's mean, shape (n_components, 3) [m].
        moved: which components moved, shape (n_components,).
        means: centres of the components before they moved, shape (n_components, 3) [m].
        covariances: position covariances of the components, shape (n_components, 3, 3) [m^2].
        responsibilities: of each component for each sample, shape (n, n_components).
        tolerance: covariance of the demonstrations along the path, shape (n, 3, 3) [m^2].
        min_clearance: smallest distance from the tool's spheres to an obstacle, at the samples [m]; inf without any.
        certified_clearance: proven lower bound of it on the whole polyline through the samples [m].
        deviation: how many demonstrated sigmas the farthest mean moved (Mahalanobis).
        feasible: whether ``certified_clearance`` reaches what was asked.
        reason: empty when feasible, else which obstacle is in the way and why it can't be avoided.
        method: which method was used.
        compute_time: of the whole adaptation [s].
    """

    nominal: Trajectory
    trajectory: Trajectory
    displacement: Array
    moved: NDArray[np.bool_]
    means: Array
    covariances: Array
    responsibilities: Array
    tolerance: Array
    min_clearance: float
    certified_clearance: float
    deviation: float
    feasible: bool
    reason: str
    method: str
    compute_time: float

    @property
    def unmoved_share(self) -> float:
        """Share of the components that stayed where they were learnt."""
        return float(1.0 - np.mean(self.moved))

    @property
    def rmse_to_nominal(self) -> float:
        """Root mean square distance between adapted and nominal path (thesis Eq 4.9 with its root) [m]."""
        return float(np.sqrt(np.mean(np.sum((self.trajectory.positions - self.nominal.positions) ** 2, axis=1))))


def adapt(
    skill: Skill,
    scene: Scene,
    method: str = "certified",
    *,
    tool_radius: float = 0.0,
    tool_spheres: ArrayLike | None = None,
    clearance: float = 0.02,
    forbidden: ArrayLike = (),
    pinned: Sequence[float] = (),
    start: Pose | None = None,
    n_samples: int = 200,
) -> Adaptation:
    """Adapt the whole path of a skill to the obstacles of a scene.

    ``certified`` moves the affected components by the least that keeps the clearance on the whole path, or refuses and
    says why; ``mapf`` and ``literal`` are the thesis's potential fields (see ``potential_components``), which may fail.
    Start, goal and ``pinned`` instants do not move.

    Args:
        skill: a fitted skill.
        scene: goal (None: the learnt one) and obstacles.
        method: ``"certified"``, ``"mapf"`` or ``"literal"``.
        tool_radius: radius of a sphere about the tool's tip that holds the tool [m].
        tool_spheres: instead of one radius, spheres that hold the tool: rows x y z r in the tool's frame, shape
            (m, 4) [m], as ``ArmModel.tool_spheres`` gives them. They turn as the skill turns the tool.
        clearance: asked distance from them to every obstacle [m].
        forbidden: directions in which nothing may move, shape (m, 3): see ``HORIZONTAL_ONLY`` and ``NOT_DOWN``.
        pinned: instants [s] at which the path must not move, for example where the dirt lies.
        start: where the motion begins; None: where it was learnt.
        n_samples: samples along the path.

    Returns:
        The adaptation; look at ``feasible`` before executing it.

    Raises:
        UnknownNameError: when there is no such method.
        InputError: when a radius, a clearance or a direction can't be used.
    """
    if method not in METHODS:
        raise UnknownNameError.among("method", method, METHODS)
    for name, length in (("tool_radius", tool_radius), ("clearance", clearance)):
        if not 0.0 <= length < np.inf:
            raise InputError(f"{name} must be >= 0 m, got {length:g}")
    if tool_spheres is not None and tool_radius > 0.0:
        raise InputError("give tool_radius or tool_spheres, not both")
    spheres = ((0.0, 0.0, 0.0, tool_radius),) if tool_spheres is None else tool_spheres
    axes = _unit_rows(forbidden)
    began = time.perf_counter()
    path = ComponentPath.of_skill(
        skill, spheres=spheres, n_samples=n_samples, start=start, goal=scene.goal, pinned=pinned
    )
    detour = _detour(path, scene, clearance, method, axes)
    return Adaptation(
        nominal=path.nominal,
        trajectory=Trajectory(path.nominal.times, detour.positions, path.nominal.quaternions),
        displacement=detour.displacement,
        moved=np.linalg.norm(detour.displacement, axis=1) > STILL,
        means=path.means,
        covariances=path.covariances,
        responsibilities=path.responsibilities,
        tolerance=path.tolerance,
        min_clearance=float(np.min(detour.nearest, initial=np.inf)),
        certified_clearance=float(np.min(detour.bounds, initial=np.inf)),
        deviation=path.deviation(detour.displacement),
        feasible=detour.feasible,
        reason="" if detour.feasible else _reason(path, scene, detour, method, clearance, len(axes)),
        method=method,
        compute_time=time.perf_counter() - began,
    )


def _unit_rows(directions: ArrayLike) -> Array:
    rows = np.asarray(directions, dtype=float)
    rows = rows.reshape(-1, 3) if rows.size % 3 == 0 else np.full((1, 3), np.nan)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not np.all(np.isfinite(length)) or np.any(length == 0.0):
        raise InputError("forbidden: give directions as rows of 3 finite numbers, none of them zero")
    return np.asarray(rows / length)


def _detour(path: ComponentPath, scene: Scene, clearance: float, method: str, axes: Array) -> Detour:
    """Return the detour of the method; nothing is searched when nothing is in the way or a pinned point is covered."""
    still = np.zeros((path.n_components, 3))
    if not scene.obstacles:
        return Detour(still, path.nominal.positions, np.empty(0), np.empty(0), True, 0)
    pairs = path.pairs(scene.obstacles)
    positions = path.nominal.positions
    distance, normal = distances(pairs, positions)
    covered = bool(distance[:, _pins(path)].min() < clearance)
    if covered or distance.min() >= clearance:  # else a sample already tells that it has to move
        unmoved = judged(pairs, still, positions, distance, normal, clearance)
        if unmoved.feasible or (covered and method == "certified"):
            return unmoved
    if method == "certified":
        return find_detour(path, pairs, clearance, distance, normal, forbidden=axes)
    reach = float(np.max(np.linalg.norm(path.spheres[:, :3], axis=1) + path.spheres[:, 3]))
    pushed = push_components(path, scene.obstacles, reach + clearance, method=method, forbidden=axes)
    positions = path.displaced(pushed)
    return judged(pairs, pushed, positions, *distances(pairs, positions), clearance)


def _pins(path: ComponentPath) -> NDArray[np.intp]:
    """Return the indices of the samples that no displacement can move."""
    return np.flatnonzero(path.basis.max(axis=1) == 0.0)


def _reason(path: ComponentPath, scene: Scene, detour: Detour, method: str, clearance: float, n_forbidden: int) -> str:
    """Say which obstacle can't be avoided and why, in words that tell what to change."""
    asked = f"{1e3 * clearance:.0f} mm asked"
    pairs = path.pairs(scene.obstacles)
    pins = _pins(path)
    at_pins = distances(pairs, detour.positions)[0][:, pins]
    if at_pins.min() < clearance:
        pair, pin = np.unravel_index(int(np.argmin(at_pins)), at_pins.shape)
        return _at_pin(path, scene.name_of(pairs[pair].index), int(pins[pin]), float(at_pins.min()), asked)
    worst = int(np.argmin(detour.bounds))
    name = scene.name_of(pairs[worst].index)
    left = f"{1e3 * float(detour.bounds[worst]) + 0.0:.1f} mm"
    if method != "certified":
        return (
            f"the path passes {name} at {left} ({asked}): method {method!r} pushes components and does "
            "not look at the path between them; try method 'certified'"
        )
    if detour.strays:
        far = np.linalg.norm(detour.positions - path.nominal.positions, axis=1).max()
        return (
            f"no way round {name} with {asked}: next to a point that must not move it would lead {far:.2f} m away or "
            "jump; move the obstacle, or ask for less clearance"
        )
    near = {pairs[i].index for i in np.flatnonzero(detour.bounds < clearance)} - {pairs[worst].index}
    sample = int(np.argmin(pairs[worst].distance(detour.positions)))
    held = path.basis[sample].sum() < 0.5
    return (
        f"no way round {name} with {asked}: the best attempt leaves {left}"
        + (f", and {', '.join(map(scene.name_of, sorted(near)))} too near as well" if near else "")
        + ("; it stands too close to a point that must not move" if held else "")
        + (f"; {n_forbidden} forbidden direction(s) were kept" if n_forbidden else "")
        + ": move an obstacle, allow another direction, or ask for less clearance"
    )


def _at_pin(path: ComponentPath, name: str, sample: int, left: float, asked: str) -> str:
    """Say that an obstacle is too near to a point that must not move."""
    moment, end = path.nominal.times[sample], path.nominal.times[-1]
    where = "start" if moment < 0.02 * end else "goal" if moment > 0.98 * end else f"pinned point at {moment:.2f} s"
    lies = f"covers the {where}" if left <= 0.0 else f"leaves {1e3 * left:.0f} mm at the {where} ({asked})"
    return f"{name} {lies}, which must not move: move the obstacle, or ask for another {where.split(maxsplit=1)[0]}"
