"""Adaptation: a path that was adapted to a scene, with its guaranteed clearance, or the reason why there is no path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.html_table import html_table
from imitarm.policies.approach import Approach
from imitarm.policies.arm_planner import ArmPlan
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import (
    MAX_DISPLACEMENT,
    MAX_JERK_RATIO,
    MAX_STEP_RATIO,
    AvoidanceProblem,
    Detour,
    PathAdapter,
)
from imitarm.scene.scene import Scene
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Adaptation:
    """The path of a skill, adapted to a scene.

    Attributes:
        nominal: the learned path between the start and the goal, without obstacles.
        trajectory: the adapted path, at the same times; if not ``feasible``, it is the best attempt, which must not be
            executed.
        displacement: displacement of each component's mean, shape (n_components, 3) [m].
        moved: whether each component moved, shape (n_components,).
        means: centres of the components before they moved, shape (n_components, 3) [m].
        covariances: position covariances of the components, shape (n_components, 3, 3) [m^2].
        responsibilities: responsibilities ``h_k`` of the components at the n samples of the path, shape (n,
            n_components).
        divided: whether the learned components were too wide for this scene and were divided into narrower components.
            If True, the arrays above describe the narrower components.
        tolerance: covariance of the demonstrated positions along the path, shape (n, 3, 3) [m^2].
        min_clearance: smallest distance from the tool's spheres to an obstacle, at the samples [m]; inf without
            obstacles. If an obstacle has a margin for its prediction error, the margin is subtracted from its distance.
        certified_clearance: guaranteed lower bound of the clearance at the samples and between them [m]. The bound
            holds while the error of each obstacle's predicted position is at most the margin of this obstacle.
        only_on_schedule: whether the guarantee depends on time, because an obstacle moves or its margin grows. The
            guarantee then holds only if the tool reaches each sample of ``trajectory`` at the sample's time, counted
            from the scene's ``stamp``. The guarantee ends at the time of the last sample.
        validity: text that says what the guarantee assumes and what it does not cover.
        deviation: largest displacement of a component's mean, in standard deviations of the demonstrations (Mahalanobis
            distance).
        jerk_ratio: largest jerk of the adapted path, divided by the largest jerk of the nominal path.
        jerk_reason: text that says why ``jerk_ratio`` exceeds 10; empty if it is at most 10.
        feasible: whether ``certified_clearance`` is at least the required clearance, and the displacements and the
            steps of the path are within the method's limits.
        reason: text that says which obstacle blocks the path, and why it can't be avoided; empty if ``feasible``.
        method: name of the adaptation method.
        compute_time: computing time of the whole adaptation [s].
        joints: joint positions along the path, shape (n, n_joints) [rad]; None when only the tool was planned. Between
            two samples the joints move linearly.
        tilt: largest rotation of the tool away from the learned rotation [rad].
        approach: motion of the arm from its start posture to the first posture of ``joints``; execute it before the
            path. None if both postures are equal.
        arm_plan: the plan of the whole arm, which ``replan`` uses as its first guess; None when only the tool was
            planned.
    """

    nominal: Trajectory
    trajectory: Trajectory
    displacement: Array
    moved: NDArray[np.bool_]
    means: Array
    covariances: Array
    responsibilities: Array
    divided: bool
    tolerance: Array
    min_clearance: float
    certified_clearance: float
    only_on_schedule: bool
    validity: str
    deviation: float
    jerk_ratio: float
    jerk_reason: str
    feasible: bool
    reason: str
    method: str
    compute_time: float
    joints: Array | None = None
    tilt: float = 0.0
    approach: Approach | None = None
    arm_plan: ArmPlan | None = None

    @property
    def unmoved_fraction(self) -> float:
        """Fraction of the components that were not moved."""
        return float(1.0 - np.mean(self.moved))

    @property
    def rmse_to_nominal(self) -> float:
        """Root mean square distance between adapted and nominal path (thesis Eq 4.9, with the square root) [m]."""
        return float(np.sqrt(np.mean(np.sum((self.trajectory.positions - self.nominal.positions) ** 2, axis=1))))

    def __repr__(self) -> str:
        if not self.feasible:
            return f"Adaptation({self.method}, not feasible: {self.reason})"
        clear = "no obstacles" if np.isinf(self.certified_clearance) else f"{1e3 * self.certified_clearance:.1f} mm"
        return (
            f"Adaptation({self.method}, feasible, certified clearance {clear}, {int(self.moved.sum())} of "
            f"{len(self.moved)} components moved, {1e3 * self.compute_time:.1f} ms)"
        )

    def _repr_html_(self) -> str:
        clear = "no obstacles" if np.isinf(self.certified_clearance) else f"{1e3 * self.certified_clearance:.2f} mm"
        rows = {
            "method": self.method,
            "feasible": "yes" if self.feasible else f"no: {self.reason}",
            "certified clearance": clear,
            "valid": self.validity,
            "components moved": f"{int(self.moved.sum())} of {len(self.moved)}",
            "RMSE to the nominal path": f"{1e3 * self.rmse_to_nominal:.1f} mm",
            "jerk": f"{self.jerk_ratio:.1f} times that of the nominal path",
            "jerk above the limit": self.jerk_reason,
            "joint path": "not planned" if self.joints is None else f"{self.joints.shape[1]} joints",
            "largest tilt of the tool": f"{np.degrees(self.tilt):.1f} degrees",
            "motion to the first posture": "none" if self.approach is None else f"{self.approach.times[-1]:.1f} s",
            "compute time": f"{1e3 * self.compute_time:.1f} ms",
        }
        return html_table("Adaptation", rows)


def jerk_reason(scene: Scene, detour: Detour, ratio: float, clearance: float) -> str:
    """Return a text that says why the jerk of a path exceeds its limit; empty if it does not exceed the limit."""
    if ratio <= MAX_JERK_RATIO:
        return ""
    tool = detour.clearance.tool
    pair = int(np.argmin(detour.clearance.distance.min(axis=1))) if tool.n_pairs else 0
    name = scene.name_of(pair // tool.n_spheres) if tool.n_pairs else "an obstacle"
    return (
        f"no smoother path was found that keeps {1e3 * clearance:.0f} mm from {name}: the jerk of the best path is "
        f"{ratio:.0f} times that of the nominal path (limit {MAX_JERK_RATIO:.0f}); execute it more slowly, or move the "
        "obstacle"
    )


def refusal(scene: Scene, problem: AvoidanceProblem, detour: Detour, method: str, adapter: PathAdapter) -> str:
    """Return a message that names the obstacle that can't be avoided, the reason, and what the user can change."""
    path, k = problem.path, problem.nominal.tool.n_spheres
    required = f"{1e3 * problem.clearance:.3g} mm required"
    if any(margin is not None for margin in problem.nominal.tool.margins):
        required += " beyond the margin for its prediction"
    fixed = path.fixed
    at_fixed = problem.nominal.distance[:, fixed]
    if at_fixed.min(initial=np.inf) < problem.clearance:
        pair, i = np.unravel_index(int(np.argmin(at_fixed)), at_fixed.shape)
        return _at_fixed(path, _name(scene, int(pair) // k), int(fixed[i]), float(at_fixed.min()), required)
    worst = int(np.argmin(detour.bounds))
    name = _name(scene, worst // k)
    left = _millimetres(float(detour.bounds[worst]))
    if not adapter.refuses:
        return (
            f"the path passes {name} at a distance of {left} ({required}): method {method!r} pushes components and "
            "ignores the path between them; try method 'certified'"
        )
    if not problem.allowed.dimension:
        return (
            f"{name} blocks the path ({left} of clearance, {required}), and every direction is forbidden: allow "
            f"at least one direction"
        )
    if detour.out_of_limits:
        far = np.linalg.norm(detour.clearance.positions - path.nominal.positions, axis=1).max()
        return (
            f"no path around {name} with {required} within the limits: the path would lead {far:.2f} m away from the "
            f"nominal path (limit {MAX_DISPLACEMENT:g} m) or have steps longer than {MAX_STEP_RATIO:.0f} times the "
            "longest nominal step; move the obstacle, or reduce the required clearance"
        )
    near = {pair // k for pair in np.flatnonzero(detour.bounds < problem.clearance).tolist()} - {worst // k}
    sample = int(np.argmin(detour.clearance.distance[worst]))
    held = path.basis[sample].sum() < 0.5
    n_forbidden = len(problem.allowed.forbidden)
    clauses = [
        f"no path around {name} with {required}: the best attempt has a clearance of {left}",
        f"other obstacles that are too close: {', '.join(map(scene.name_of, sorted(near)))}" if near else "",
        "the obstacle is too close to a point that must not move" if held else "",
        f"the path may not move in {n_forbidden} forbidden direction(s)" if n_forbidden else "",
        "move an obstacle, allow another direction, or reduce the required clearance",
    ]
    return "; ".join(filter(None, clauses))


def _name(scene: Scene, i: int) -> str:
    """Return the name of an obstacle for a message, which says how a rotating obstacle is treated."""
    turning = scene.obstacles[i].angular_velocity.any()
    return scene.name_of(i) + (" (it rotates, so it counts as a sphere that contains it)" if turning else "")


def _millimetres(length: float) -> str:
    """Return a length in millimetres, rounded down, so that a clearance below the required one looks like less."""
    return f"{math.floor(1e4 * length + 1e-6) / 10.0 + 0.0:.1f} mm"


def _at_fixed(path: ComponentPath, name: str, sample: int, left: float, required: str) -> str:
    """Return a message which says that an obstacle is too close to a point that must not move."""
    at, end = path.nominal.times[sample], path.nominal.times[-1]
    where = "start" if at < 0.02 * end else "goal" if at > 0.98 * end else f"pinned point at {at:.2f} s"
    gap = f"leaves {_millimetres(left)} of clearance at the {where} ({required})"
    lies = f"covers the {where}" if left <= 0.0 and required.endswith("required") else gap
    other = where if where in {"start", "goal"} else "pinned time"
    return f"{name} {lies}; this point must not move: move the obstacle, or choose another {other}"
