"""Texts of an adaptation: what its guarantee assumes, and why an obstacle can't be avoided."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import (
    MAX_DISPLACEMENT,
    MAX_JERK_RATIO,
    MAX_STEP_RATIO,
    AvoidanceProblem,
    Detour,
    PathAdapter,
)
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.scene.scene import Scene


def depends_on_time(scene: Scene, margins: Sequence[PredictionMargin | None]) -> bool:
    """Return whether a guarantee depends on the schedule: because an obstacle moves, or because a margin grows."""
    growing = any(margin is not None and margin.growth > 0.0 for margin in margins)
    return growing or any(obstacle.velocity.any() for obstacle in scene.obstacles)


def validity(scene: Scene, duration: float, margins: Sequence[PredictionMargin | None], *, arm: bool = False) -> str:
    """Return a text that says what a guarantee assumes and what it does not cover."""
    moving = [scene.name_of(i) for i, obstacle in enumerate(scene.obstacles) if obstacle.velocity.any()]
    covers = "it covers the tool on the planned path, but neither the links of the arm nor tracking errors"
    if arm:
        covers = "it covers every moving part of the arm on the planned joint path, but no tracking errors"
    rotating = [scene.name_of(i) for i, obstacle in enumerate(scene.obstacles) if obstacle.angular_velocity.any()]
    if rotating:
        covers += f"; {' and '.join(rotating)} may rotate in any way about the obstacle's centre"
    if not moving and not depends_on_time(scene, margins):
        return f"the guarantee holds while the obstacles stand still; {covers}"
    return (
        f"the guarantee holds only from 0 to {duration:.2f} s (arrival), and only while the motion is on time and "
        f"{_assumed(scene, moving, margins)}; {covers}"
    )


def _assumed(scene: Scene, moving: Sequence[str], margins: Sequence[PredictionMargin | None]) -> str:
    """Return what a guarantee assumes of the obstacles."""
    kept = f"{' and '.join(moving)} {'keeps' if len(moving) == 1 else 'keep'} the given velocity"
    with_margin = [scene.name_of(i) for i, margin in enumerate(margins) if margin is not None]
    if not with_margin:
        return kept
    margin = next(margin for margin in margins if margin is not None)
    verb = "is" if len(with_margin) == 1 else "are"
    apart = f"{' and '.join(with_margin)} {verb} where predicted, or off by less than {1e3 * margin.offset:.0f} mm"
    if margin.growth > 0.0:
        apart += f" and {1e3 * margin.growth:.0f} mm more each second"
        apart += f" until {margin.until:.2f} s" if np.isfinite(margin.until) else ""
    others = [name for name in moving if name not in with_margin]
    return apart if not others else f"{apart}, and {' and '.join(others)} keep the given velocity"


def jerk_reason(scene: Scene, detour: Detour, ratio: float, clearance: float) -> str:
    """Return why the jerk of a path exceeds its limit; empty if it does not."""
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
    """Return a message that says which obstacle can't be avoided, why, and what to change."""
    path, k = problem.path, problem.nominal.tool.n_spheres
    required = f"{1e3 * problem.clearance:.0f} mm required"
    if any(margin is not None for margin in problem.nominal.tool.margins):
        required += " beyond the margin for its prediction"
    fixed = path.fixed
    at_fixed = problem.nominal.distance[:, fixed]
    if at_fixed.min(initial=np.inf) < problem.clearance:
        pair, i = np.unravel_index(int(np.argmin(at_fixed)), at_fixed.shape)
        return _at_fixed(path, scene.name_of(pair // k), int(fixed[i]), float(at_fixed.min()), required)
    worst = int(np.argmin(detour.bounds))
    name = scene.name_of(worst // k)
    left = f"{1e3 * float(detour.bounds[worst]) + 0.0:.1f} mm"
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


def _at_fixed(path: ComponentPath, name: str, sample: int, left: float, required: str) -> str:
    """Return a message which says that an obstacle is too close to a point that must not move."""
    at, end = path.nominal.times[sample], path.nominal.times[-1]
    where = "start" if at < 0.02 * end else "goal" if at > 0.98 * end else f"pinned point at {at:.2f} s"
    gap = f"leaves {1e3 * left:.0f} mm of clearance at the {where} ({required})"
    lies = f"covers the {where}" if left <= 0.0 and required.endswith("required") else gap
    other = where if where in {"start", "goal"} else "pinned time"
    return f"{name} {lies}; this point must not move: move the obstacle, or choose another {other}"
