"""The report's figures of paths: what was shown, what was learnt, how it was bent around obstacles.

Every function returns one ``<svg>`` element. Figures over time and over components are in
:mod:`~imitarm.viewer.charts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.pose import rotate
from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer import palette
from imitarm.viewer.canvas import POINTS, thin
from imitarm.viewer.views import Grid, View, corners_of, drawn_map

Array = NDArray[np.float64]

_CHI_95: Final = 2.448  # 95 % of a plane Gaussian is within 2.448 sigma


def _ellipses(axes: Any, means: ArrayLike, covariances: ArrayLike, view: View, **style: Any) -> None:
    """Fill the 95 % ellipses of Gaussians, as they are seen in the view: of the two shown coordinates."""
    pick = [view.across, view.up]
    angles = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = _CHI_95 * np.stack([np.cos(angles), np.sin(angles)])
    for mean, covariance in zip(view.of(means), np.asarray(covariances, dtype=float), strict=True):
        variances, vectors = np.linalg.eigh(covariance[np.ix_(pick, pick)])
        outline = mean[:, None] + vectors @ (np.sqrt(np.maximum(variances, 2.5e-7))[:, None] * circle)
        axes.fill(*outline, **style)


def demonstrations(
    shown: Sequence[Demonstration],
    means: ArrayLike,
    covariances: ArrayLike,
    predicted: Trajectory | None = None,
    *,
    name: str = "demonstrations",
) -> str:
    """Draw what was shown, the Gaussian components that were learnt from it and the path they predict.

    Args:
        shown: the demonstrations.
        means: of the components' positions, shape (n_components, 3) [m].
        covariances: of the components' positions, shape (n_components, 3, 3) [m^2].
        predicted: the learnt path.
        name: unique in the page.

    Returns:
        An SVG element.
    """
    view = View.best(np.concatenate([d.trajectory.positions for d in shown]))
    text = (
        f"{len(shown)} demonstrations, {len(np.asarray(means))} Gaussian components and the learnt path, {view.title}"
    )
    reach = _CHI_95 * np.sqrt(np.einsum("kii->ki", np.asarray(covariances, dtype=float)))
    spread = [d.trajectory.positions for d in shown] + [np.asarray(means) - reach, np.asarray(means) + reach]
    corners = corners_of(view.of(np.concatenate(spread)), 0.01)
    with drawn_map(name, text, view, corners, legend_rows=1, stretched=True) as (axes, drawing):
        for i, demonstration in enumerate(shown):
            path = view.of(demonstration.trajectory.positions)[thin(len(demonstration))]
            axes.plot(
                *path.T, color=palette.DEMONSTRATION, lw=0.9, alpha=0.75, label="shown" if i == 0 else None, zorder=2
            )
        style = {"facecolor": palette.UNMOVED, "edgecolor": palette.UNMOVED, "alpha": 0.28, "zorder": 1}
        _ellipses(axes, means, covariances, view, **style)
        axes.plot(*view.of(means).T, ".", color=palette.UNMOVED, ms=5, label="Gaussian component, 95 %", zorder=3)
        if predicted is not None:
            path = view.of(predicted.positions)[thin(len(predicted))]
            axes.plot(*path.T, color=palette.ADAPTED, lw=1.6, label="learnt path", zorder=4)
    return drawing.svg


def _tool_along(path: Trajectory, spheres: ArrayLike | None) -> tuple[Array, Array]:
    """Return where the tool's spheres are at some instants of a path, (n, m, 3) [m], and their radii (m,) [m]."""
    rows = np.zeros((1, 4)) if spheres is None else np.asarray(spheres, dtype=float).reshape(-1, 4)
    some = thin(len(path), 80)
    centres = np.broadcast_to(rows[:, :3], (len(some), len(rows), 3))
    if path.quaternions is not None:
        centres = rotate(path.quaternions[some][:, None], centres)
    return centres + path.positions[some][:, None], rows[:, 3]


def _draw_swept(axes: Any, grid: Grid, centres: Array, radii: Array) -> None:
    """Fill the area that spheres with ``centres`` (n, m, 2) sweep over, as one area with one outline."""
    distance = np.full((len(grid.up), len(grid.across)), np.inf)
    for instant in centres:
        for (across, up), radius in zip(instant, radii, strict=True):
            np.minimum(distance, np.hypot(grid.across - across, (grid.up - up)[:, None]) - radius, out=distance)
    axes.contourf(grid.across, grid.up, distance, levels=[-1e3, 0.0], colors=[palette.ADAPTED], alpha=0.07, zorder=0.5)
    look = {"colors": [palette.ADAPTED], "linewidths": 0.7, "linestyles": "dotted", "zorder": 3}
    axes.contour(grid.across, grid.up, distance, levels=[0.0], **look)
    axes.plot([], [], ":", color=palette.ADAPTED, lw=0.9, label="swept by the tool")


def _draw_obstacles(axes: Any, scene: Scene, grid: Grid, depth: Array, clearance: float, path: Array) -> None:
    """Fill the obstacles and dash the line that the tool must stay outside of."""
    depths = np.linspace(depth.min(), depth.max(), 9) if np.ptp(depth) > 2e-3 else np.array([depth.mean()])
    for i, obstacle in enumerate(scene.obstacles):
        distance = grid.distance(scene, i, depths)
        if distance.min() < 0.0:
            look = {"levels": [-1e3, 0.0], "colors": [palette.OBSTACLE], "alpha": 0.85, "zorder": 2}
            axes.contourf(grid.across, grid.up, distance, **look)
            if obstacle.name:
                _name(axes, grid, distance, obstacle.name, path)
        if distance.min() < clearance:
            look = {"levels": [clearance], "colors": [palette.LIMIT], "linewidths": 0.9, "linestyles": "dashed"}
            axes.contour(grid.across, grid.up, distance, zorder=2, **look)
    axes.plot([], [], "--", color=palette.LIMIT, lw=0.9, label="asked distance")


def _name(axes: Any, grid: Grid, distance: Array, name: str, path: Array) -> None:
    """Write an obstacle's name beside it, on the side where the path (n, 2) [m] is not."""
    rows, columns = np.nonzero(distance < 0.0)
    across = float(grid.across[columns].mean())
    beside = path[np.argmin(np.abs(path[:, 0] - across)), 1]
    below = float(grid.up[rows].mean()) < beside
    place = (across, float(grid.up[rows].min() if below else grid.up[rows].max()))
    look = {"textcoords": "offset points", "ha": "center", "va": "top" if below else "bottom", "fontsize": 7.5}
    axes.annotate(name.replace("$", r"\$"), place, xytext=(0, -2 if below else 2), zorder=6, **look)


def _band(path: Array, covariances: Array, view: View) -> Array:
    """Return the outline (2 n, 2) of two standard deviations on both sides of a path, seen in the view."""
    pick = [view.across, view.up]
    points = view.of(path)
    tangents = np.gradient(points, axis=0)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    variance = np.einsum("ni,nij,nj->n", normals, np.asarray(covariances)[:, pick][:, :, pick], normals)
    offset = 2.0 * np.sqrt(np.maximum(variance, 0.0))[:, None] * normals
    return np.concatenate([points + offset, (points - offset)[::-1]])


def adaptation(
    nominal: Trajectory,
    adapted: Trajectory,
    *,
    scene: Scene | None = None,
    clearance: float = 0.02,
    tool_spheres: ArrayLike | None = None,
    tolerance: ArrayLike | None = None,
    means: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    displacement: ArrayLike | None = None,
    moved: ArrayLike | None = None,
    measured: Trajectory | None = None,
    name: str = "adaptation",
) -> str:
    """Draw how a learnt path was bent around obstacles, and which components were moved for it.

    Args:
        nominal: the learnt path.
        adapted: the path around the obstacles.
        scene: the obstacles, in the base frame.
        clearance: asked distance of the tool to every obstacle [m].
        tool_spheres: that hold the tool, rows of x, y, z, radius in the tool's frame, shape (m, 4) [m].
        tolerance: spread of the demonstrations along the path, shape (n_steps, 3, 3) [m^2].
        means: of the components before they were moved, shape (n_components, 3) [m].
        covariances: of the components, shape (n_components, 3, 3) [m^2].
        displacement: of the components, shape (n_components, 3) [m].
        moved: which components were displaced, shape (n_components,).
        measured: the path that the robot's tool took.
        name: unique in the page.

    Returns:
        An SVG element.
    """
    everything = np.concatenate([nominal.positions, adapted.positions])
    view = View.best(everything)
    tool, radii = _tool_along(adapted, tool_spheres)
    obstacles = scene.obstacles if scene is not None else ()
    text = f"The learnt and the adapted path around {len(obstacles)} obstacles, {view.title}"
    shown = view.of(tool)
    swept = np.concatenate([shown - radii[:, None], shown + radii[:, None]]).reshape(-1, 2)
    corners = corners_of(np.concatenate([view.of(everything), swept]), 0.04)
    for obstacle in obstacles:
        bounds = np.clip(view.of(obstacle.bounds()), corners[0] - 0.15, corners[1] + 0.15)  # [m] far is of no interest
        corners = corners_of(np.concatenate([corners, corners_of(bounds, clearance + 0.01)]), 0.0)
    with drawn_map(name, text, view, corners, legend_rows=3, note="; ● start, ■ end") as (axes, drawing):
        grid = Grid.of(axes, view)
        if radii.max() > 0.0:
            _draw_swept(axes, grid, shown, radii)
        if scene is not None and obstacles:
            _draw_obstacles(axes, scene, grid, tool[..., view.depth], clearance, view.of(nominal.positions))
        if means is not None and covariances is not None:
            _draw_components(axes, view, means, covariances, displacement, moved)
        if tolerance is not None:
            band = _band(adapted.positions, np.asarray(tolerance, dtype=float), view)[
                thin(2 * len(adapted), 2 * POINTS)
            ]
            axes.fill(*band.T, color=palette.ADAPTED, alpha=0.16, lw=0, label="tolerance, 2σ", zorder=3)
        for path, label, look in (
            (nominal, "learnt path", {"color": palette.NOMINAL, "ls": (0, (5, 2)), "lw": 1.5}),
            (adapted, "adapted path", {"color": palette.ADAPTED, "lw": 2.2}),
            (measured, "measured on the robot", {"color": palette.MEASURED, "lw": 1.0}),
        ):
            if path is not None:
                axes.plot(*view.of(path.positions)[thin(len(path))].T, label=label, zorder=4, **look)
        axes.plot(*view.of(adapted.positions[0]), "o", color=palette.ADAPTED, ms=6, zorder=5)
        axes.plot(*view.of(adapted.positions[-1]), "s", color=palette.ADAPTED, ms=6, zorder=5)
    return drawing.svg


def _draw_components(
    axes: Any,
    view: View,
    means: ArrayLike,
    covariances: ArrayLike,
    displacement: ArrayLike | None,
    moved: ArrayLike | None,
) -> None:
    """Draw unmoved components filled, moved ones where they went, with an arrow from where they were."""
    centres, spreads = np.asarray(means, dtype=float), np.asarray(covariances, dtype=float)
    shift = np.zeros_like(centres) if displacement is None else np.asarray(displacement, dtype=float)
    went = np.linalg.norm(shift, axis=1) > 0.0 if moved is None else np.asarray(moved, dtype=bool)
    for chosen, colour, label in (
        (~went, palette.UNMOVED, "component, unmoved"),
        (went, palette.MOVED, "component, moved"),
    ):
        if chosen.any():
            look = {"facecolor": colour, "edgecolor": colour, "zorder": 1}
            _ellipses(axes, (centres + shift)[chosen], spreads[chosen], view, alpha=0.25, **look)
            axes.plot([], [], "o", color=colour, alpha=0.5, ms=8, label=label)
    for start, end in zip(view.of(centres[went]), view.of((centres + shift)[went]), strict=True):
        arrow = {"arrowstyle": "-|>", "color": palette.MOVED, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", end, start, arrowprops=arrow, zorder=5)
