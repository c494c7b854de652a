"""The report's figures of paths: what was shown, what was learnt, how it was bent around obstacles.

Every function returns one ``<svg>`` element. Figures over time and over components are in
:mod:`~imitarm.viewer.charts`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.scene import Scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer import palette
from imitarm.viewer.canvas import POINTS, Canvas, canvas, thin

Array = NDArray[np.float64]

_WIDTH: Final = 5.5  # [inch]
_CHI_95: Final = 2.448  # 95 % of a plane Gaussian is within 2.448 sigma


@dataclass(frozen=True)
class View:
    """The two axes of the base frame that a figure shows, and the one it looks along.

    Attributes:
        across: axis that is shown across: 0, 1, 2 for x, y, z.
        up: axis that is shown upwards.
    """

    across: int = 0
    up: int = 1

    @property
    def depth(self) -> int:
        """The axis that is looked along."""
        return 3 - self.across - self.up

    @property
    def title(self) -> str:
        """How people call it."""
        return {2: "seen from above", 1: "seen from the side", 0: "seen from the front"}[self.depth]

    @property
    def leftwards(self) -> bool:
        """Whether ``across`` grows to the left: from above with x upwards, y does."""
        return (self.across, self.up) == (1, 0)

    @classmethod
    def best(cls, positions: ArrayLike) -> View:
        """Return the view that loses least of ``positions`` (n, 3) [m]: from above when that is nearly as good."""
        spans = np.ptp(np.asarray(positions, dtype=float), axis=0)
        if spans[2] <= 1.25 * spans[:2].min():
            return cls(0, 1) if spans[0] >= spans[1] else cls(1, 0)
        return cls(0, 2) if spans[0] >= spans[1] else cls(1, 2)

    def of(self, positions: ArrayLike) -> Array:
        """Return the two coordinates that are shown, shape (..., 2) [m]."""
        return np.asarray(positions, dtype=float)[..., [self.across, self.up]]


@contextmanager
def _map(name: str, text: str, view: View, corners: Array, legend_rows: int) -> Iterator[tuple[Canvas, Any]]:
    """Give axes of equal scale that show ``corners`` (2, 2) [m], in a figure that is as high as they need."""
    span = np.maximum(corners[1] - corners[0], 1e-3)
    width = _WIDTH - 0.72
    height = float(np.clip(width * span[1] / span[0], 1.6, 4.4))
    below = 0.48 + 0.2 * legend_rows
    with canvas(name, text, (_WIDTH, below + height + 0.3)) as drawing:
        axes = drawing.axes(0.64, below, 0.64 + width, below + height)
        scale = max(span[0] / width, span[1] / height)  # [m/inch]
        for i, (limits, inches) in enumerate(((axes.set_xlim, width), (axes.set_ylim, height))):
            middle, half = corners[:, i].mean(), 0.5 * scale * inches
            limits(middle - half, middle + half)
        if view.leftwards:
            axes.invert_xaxis()
        axes.set_aspect("equal")
        axes.locator_params(nbins=8)
        axes.set_xlabel(f"{'xyz'[view.across]} of the base [m]")
        axes.set_ylabel(f"{'xyz'[view.up]} of the base [m]")
        yield drawing, axes
        drawing.legend(3)


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
    corners = _corners(view.of(np.concatenate([d.trajectory.positions for d in shown])), 0.06)
    with _map(name, text, view, corners, legend_rows=1) as (drawing, axes):
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
            axes.plot(*path.T, color=palette.ADAPTED, lw=2.0, label="learnt path", zorder=4)
        axes.set_title(view.title, loc="left")
    return drawing.svg


def _footprint(scene: Scene, obstacle: int, view: View, corners: Array, depths: Array) -> tuple[Array, Array, Array]:
    """Return a grid (two axes) and how far an obstacle is from it, the nearest over ``depths``.

    For a path at one height it is the cut at that height, for a path in space the obstacle's shadow where the path is.
    """
    step = float(np.ptp(corners, axis=0).max()) / 150.0
    first, second = (np.arange(corners[0, i], corners[1, i] + step, step) for i in range(2))
    points = np.empty((len(depths), len(second), len(first), 3))
    points[..., view.across] = first
    points[..., view.up] = second[:, None]
    points[..., view.depth] = depths[:, None, None]
    return first, second, scene.obstacles[obstacle].signed_distance(points).min(axis=0)


def _corners(points: Array, margin: float) -> Array:
    """Return the lower and the upper corner (2, 2) of what holds all ``points``, with a margin [m]."""
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


def _draw_obstacles(axes: Any, scene: Scene, view: View, depth: Array, keep_away: float) -> None:
    """Fill the obstacles and dash the line that the tool's middle must stay outside of."""
    corners = np.sort(np.array([axes.get_xlim(), axes.get_ylim()]), axis=1).T
    depths = np.linspace(depth.min(), depth.max(), 9) if np.ptp(depth) > 2e-3 else np.array([depth.mean()])
    for i, obstacle in enumerate(scene.obstacles):
        first, second, distance = _footprint(scene, i, view, corners, depths)
        if distance.min() < 0.0:
            axes.contourf(first, second, distance, levels=[-1e3, 0.0], colors=[palette.OBSTACLE], alpha=0.8, zorder=2)
            row, column = np.unravel_index(np.argmin(distance), distance.shape)
            if obstacle.name:
                place, look = (first[column], second[row]), {"color": "white", "fontsize": 7.5, "zorder": 2.5}
                axes.annotate(obstacle.name.replace("$", r"\$"), place, ha="center", va="center", **look)
        if distance.min() < keep_away:
            look = {"colors": [palette.LIMIT], "linewidths": 0.9, "linestyles": "dashed", "zorder": 2}
            axes.contour(first, second, distance, levels=[keep_away], **look)


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
    keep_away: float = 0.02,
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
        keep_away: asked clearance plus the tool's radius [m]: the path of the tool's middle stays this far away.
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
    obstacles = len(scene.obstacles) if scene is not None else 0
    text = f"The learnt and the adapted path around {obstacles} obstacles, {view.title}"
    corners = _corners(view.of(everything), 0.06)
    if scene is not None:
        for obstacle in scene.obstacles:
            bounds = np.clip(
                view.of(obstacle.bounds()), corners[0] - 0.15, corners[1] + 0.15
            )  # [m] far is of no interest
            corners = _corners(np.concatenate([corners, _corners(bounds, keep_away + 0.01)]), 0.0)
    with _map(name, text, view, corners, legend_rows=3) as (drawing, axes):
        if scene is not None:
            _draw_obstacles(axes, scene, view, everything[:, view.depth], keep_away)
            axes.plot([], [], "--", color=palette.LIMIT, lw=0.9, label="asked distance") if obstacles else None
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
        axes.set_title(f"{view.title}; ● start, ■ end", loc="left")
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
