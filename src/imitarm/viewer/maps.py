"""Maps of paths in the base frame: demonstrations, the learned path, and the path adapted around obstacles.

Every public function that draws returns one ``<svg>`` element. Figures over time are in :mod:`~imitarm.viewer.charts`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.pose import rotate
from imitarm.scene import Obstacle, Scene
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.viewer import palette
from imitarm.viewer.canvas import POINTS, Canvas, canvas, thin

Array = NDArray[np.float64]

_CHI_95: Final = 2.448  # 95 % of a two-dimensional Gaussian lies within 2.448 sigma
_WIDTH: Final = 5.5  # [inch]
_HEIGHTS: Final = (1.6, 4.4)  # [inch]


@dataclass(frozen=True)
class View:
    """The two axes of the base frame that a figure shows.

    Attributes:
        across: coordinate on the horizontal axis of the figure: 0, 1, 2 for x, y, z.
        up: coordinate on the vertical axis of the figure: 0, 1, 2 for x, y, z.
    """

    across: int = 0
    up: int = 1

    @property
    def depth(self) -> int:
        """The coordinate that the figure does not show, along the line of sight."""
        return 3 - self.across - self.up

    @property
    def title(self) -> str:
        """Title of the view for the figure, such as "seen from above"."""
        return {2: "seen from above", 1: "seen from the side", 0: "seen from the front"}[self.depth]

    @property
    def leftwards(self) -> bool:
        """Whether the horizontal coordinate increases to the left, as y does in a view from above with x upwards."""
        return (self.across, self.up) == (1, 0)

    @classmethod
    def best(cls, positions: ArrayLike) -> View:
        """Return the view that shows ``positions`` (n, 3) [m] largest; if nearly as large, the view from above."""
        spans = np.ptp(np.asarray(positions, dtype=float), axis=0)
        if spans[2] <= 1.25 * spans[:2].min():
            return cls(0, 1) if spans[0] >= spans[1] else cls(1, 0)
        return cls(0, 2) if spans[0] >= spans[1] else cls(1, 2)

    def of(self, positions: ArrayLike) -> Array:
        """Return the two coordinates that are shown, shape (..., 2) [m]."""
        return np.asarray(positions, dtype=float)[..., [self.across, self.up]]


@contextmanager
def drawn_map(
    name: str, text: str, view: View, corners: Array, *, legend_rows: int, note: str = "", stretched: bool = False
) -> Iterator[tuple[Any, Canvas]]:
    """Yield axes that show the area between ``corners``. After the drawing, convert the figure to SVG.

    Args:
        name: name of the figure, unique in the page.
        text: description of the figure, for screen readers.
        view: the axes to show.
        corners: lower and upper corner of the area that must be visible, shape (2, 2) [m].
        legend_rows: number of rows of the legend.
        note: text added to the title.
        stretched: whether a flat map may be stretched vertically; the title then states the factor. If
            ``stretched`` is False, both axes have the same scale.
    """
    span = np.maximum(corners[1] - corners[0], 1e-3)
    width = _WIDTH - 0.72
    height = float(np.clip(width * span[1] / span[0], *_HEIGHTS))
    scales = np.full(2, max(span[0] / width, span[1] / height))  # [m/inch]
    stretch = scales[1] / (span[1] / height)
    if stretched and stretch > 1.2:
        scales[1] = span[1] / height
        note += f"; {'xyz'[view.up]} is stretched {stretch:.1f} times"
    below = 0.48 + 0.2 * legend_rows
    with canvas(name, text, (_WIDTH, below + height + 0.3)) as drawing:
        axes = drawing.axes(0.64, below, 0.64 + width, below + height)
        for i, (limits, inches) in enumerate(((axes.set_xlim, width), (axes.set_ylim, height))):
            middle, half = corners[:, i].mean(), 0.5 * scales[i] * inches
            limits(middle - half, middle + half)
        if view.leftwards:
            axes.invert_xaxis()
        axes.locator_params(nbins=8)
        axes.set_xlabel(f"{'xyz'[view.across]} of the base [m]")
        axes.set_ylabel(f"{'xyz'[view.up]} of the base [m]")
        axes.set_title(view.title + note, loc="left")
        yield axes, drawing
        drawing.legend(3)


def corners_of(points: Array, margin: float) -> Array:
    """Return the lower and the upper corner (2, 2) of a box around all ``points``, with a margin [m]."""
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


@dataclass(frozen=True, eq=False)
class Grid:
    """A grid of points on a map: horizontal ``across`` (columns,) and vertical ``up`` (rows,) coordinates [m]."""

    view: View
    across: Array
    up: Array

    @classmethod
    def of(cls, axes: Any, view: View) -> Grid:
        """Return a grid that covers the axes."""
        low, high = np.sort(np.array([axes.get_xlim(), axes.get_ylim()]), axis=1).T
        step = float((high - low).max()) / 160.0
        return cls(view, *(np.arange(low[i], high[i] + step, step) for i in range(2)))

    def distance_to(self, obstacle: Obstacle, depths: Array) -> Array:
        """Return each grid point's smallest distance to an obstacle over all ``depths``, shape (rows, columns) [m].

        ``depths`` are coordinates along the line of sight. The line on which the distance is 0 is an outline. With one
        depth, it is the outline of the obstacle's cross-section. With many depths, it is the outline of the obstacle's
        projection.
        """
        points = np.empty((len(depths), len(self.up), len(self.across), 3))
        points[..., self.view.across] = self.across
        points[..., self.view.up] = self.up[:, None]
        points[..., self.view.depth] = depths[:, None, None]
        return np.asarray(obstacle.signed_distance(points).min(axis=0))


def draw_ellipses(axes: Any, means: ArrayLike, covariances: ArrayLike, view: View, **style: Any) -> None:
    """Fill the 95 % ellipses of Gaussians, projected onto the two coordinates that the map shows."""
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
    """Draw demonstrations, the learned Gaussian components, and the learned path.

    Args:
        shown: the demonstrations.
        means: means of the components' positions, shape (n_components, 3) [m].
        covariances: covariances of the components' positions, shape (n_components, 3, 3) [m^2].
        predicted: the learned path.
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    view = View.best(np.concatenate([d.trajectory.positions for d in shown]))
    text = (
        f"{len(shown)} demonstrations, {len(np.asarray(means))} Gaussian components and the learned path, {view.title}"
    )
    reach = _CHI_95 * np.sqrt(np.einsum("kii->ki", np.asarray(covariances, dtype=float)))
    spread = [d.trajectory.positions for d in shown] + [np.asarray(means) - reach, np.asarray(means) + reach]
    corners = corners_of(view.of(np.concatenate(spread)), 0.01)
    with drawn_map(name, text, view, corners, legend_rows=1, stretched=True) as (axes, drawing):
        for i, demonstration in enumerate(shown):
            path = view.of(demonstration.trajectory.positions)[thin(len(demonstration))]
            axes.plot(
                *path.T,
                color=palette.DEMONSTRATION,
                lw=0.9,
                alpha=0.75,
                label="demonstrations" if i == 0 else None,
                zorder=2,
            )
        style = {"facecolor": palette.UNMOVED, "edgecolor": palette.UNMOVED, "alpha": 0.28, "zorder": 1}
        draw_ellipses(axes, means, covariances, view, **style)
        axes.plot(*view.of(means).T, ".", color=palette.UNMOVED, ms=5, label="Gaussian components, 95 %", zorder=3)
        if predicted is not None:
            path = view.of(predicted.positions)[thin(len(predicted))]
            axes.plot(*path.T, color=palette.ADAPTED, lw=1.6, label="learned path", zorder=4)
    return drawing.svg


def _tool_along(path: Trajectory, spheres: ArrayLike | None) -> tuple[Array, Array]:
    """Return the centers of the tool's spheres at some samples of a path, (n, m, 3) [m], and their radii (m,) [m]."""
    rows = np.zeros((1, 4)) if spheres is None else np.asarray(spheres, dtype=float).reshape(-1, 4)
    some = thin(len(path), 80)
    centres = np.broadcast_to(rows[:, :3], (len(some), len(rows), 3))
    if path.quaternions is not None:
        centres = rotate(path.quaternions[some][:, None], centres)
    return centres + path.positions[some][:, None], rows[:, 3]


def _draw_swept(axes: Any, grid: Grid, centres: Array, radii: Array) -> None:
    """Fill the area swept by moving spheres, and draw its outline; ``centres`` has the shape (n, m, 2)."""
    distance = np.full((len(grid.up), len(grid.across)), np.inf)
    for instant in centres:
        for (across, up), radius in zip(instant, radii, strict=True):
            np.minimum(distance, np.hypot(grid.across - across, (grid.up - up)[:, None]) - radius, out=distance)
    axes.contourf(grid.across, grid.up, distance, levels=[-1e3, 0.0], colors=[palette.ADAPTED], alpha=0.07, zorder=0.5)
    look = {"colors": [palette.ADAPTED], "linewidths": 0.7, "linestyles": "dotted", "zorder": 3}
    axes.contour(grid.across, grid.up, distance, levels=[0.0], **look)
    axes.plot([], [], ":", color=palette.ADAPTED, lw=0.9, label="swept by the tool")


def draw_obstacles(axes: Any, scene: Scene, grid: Grid, depth: Array, clearance: float, path: Array) -> None:
    """Fill the obstacles, and draw a dashed line at the required clearance around each of them."""
    depths = np.linspace(depth.min(), depth.max(), 9) if np.ptp(depth) > 2e-3 else np.array([depth.mean()])
    for obstacle in scene.obstacles:
        distance = grid.distance_to(obstacle, depths)
        if distance.min() < 0.0:
            look = {"levels": [-1e3, 0.0], "colors": [palette.OBSTACLE], "alpha": 0.85, "zorder": 2}
            axes.contourf(grid.across, grid.up, distance, **look)
            if obstacle.name:
                _name(axes, grid, distance - clearance, obstacle.name, path)
        if distance.min() < clearance:
            look = {"levels": [clearance], "colors": [palette.LIMIT], "linewidths": 0.9, "linestyles": "dashed"}
            axes.contour(grid.across, grid.up, distance, zorder=2, **look)
    axes.plot([], [], "--", color=palette.LIMIT, lw=0.9, label="required clearance")


def _name(axes: Any, grid: Grid, distance: Array, name: str, path: Array) -> None:
    """Write the name of an obstacle above or below it, on the side that faces away from the path (n, 2) [m].

    The obstacle covers the grid points at which ``distance`` is negative.
    """
    rows, columns = np.nonzero(distance < 0.0)
    across = float(grid.across[columns].mean())
    beside = path[np.argmin(np.abs(path[:, 0] - across)), 1]
    below = float(grid.up[rows].mean()) < beside
    place = (across, float(grid.up[rows].min() if below else grid.up[rows].max()))
    look = {"textcoords": "offset points", "ha": "center", "va": "top" if below else "bottom", "fontsize": 7.5}
    axes.annotate(name.replace("$", r"\$"), place, xytext=(0, -2 if below else 2), zorder=6, **look)


def _band(path: Array, covariances: Array, view: View) -> Array:
    """Return the outline (2 n, 2) [m] of the band within two standard deviations on both sides of a path."""
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
    """Draw a learned path, the path adapted around obstacles, and the displaced components.

    Args:
        nominal: the learned path.
        adapted: the path around the obstacles.
        scene: the obstacles, in the base frame.
        clearance: distance that the tool must keep from every obstacle [m].
        tool_spheres: spheres that contain the tool, rows of x, y, z, radius in the tool frame, shape (m, 4) [m].
        tolerance: covariance of the demonstrations along the path, shape (n_steps, 3, 3) [m^2].
        means: means of the components before they were moved, shape (n_components, 3) [m].
        covariances: covariances of the components, shape (n_components, 3, 3) [m^2].
        displacement: displacement of the components, shape (n_components, 3) [m].
        moved: whether each component was displaced, shape (n_components,).
        measured: the measured path of the robot's tool.
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    everything = np.concatenate([nominal.positions, adapted.positions])
    view = View.best(everything)
    tool, radii = _tool_along(adapted, tool_spheres)
    obstacles = scene.obstacles if scene is not None else ()
    text = f"The learned and the adapted path around {len(obstacles)} obstacles, {view.title}"
    shown = view.of(tool)
    swept = np.concatenate([shown - radii[:, None], shown + radii[:, None]]).reshape(-1, 2)
    corners = corners_of(np.concatenate([view.of(everything), swept]), 0.04)
    for obstacle in obstacles:
        bounds = np.clip(
            view.of(obstacle.bounds()), corners[0] - 0.15, corners[1] + 0.15
        )  # [m] obstacles far away do not matter
        corners = corners_of(np.concatenate([corners, corners_of(bounds, clearance + 0.01)]), 0.0)
    with drawn_map(name, text, view, corners, legend_rows=3, note="; ● start, ■ end") as (axes, drawing):
        grid = Grid.of(axes, view)
        if radii.max() > 0.0:
            _draw_swept(axes, grid, shown, radii)
        if scene is not None and obstacles:
            draw_obstacles(axes, scene, grid, tool[..., view.depth], clearance, view.of(nominal.positions))
        if means is not None and covariances is not None:
            draw_components(axes, view, means, covariances, displacement, moved)
        if tolerance is not None:
            band = _band(adapted.positions, np.asarray(tolerance, dtype=float), view)[
                thin(2 * len(adapted), 2 * POINTS)
            ]
            axes.fill(*band.T, color=palette.ADAPTED, alpha=0.16, lw=0, label="tolerance, 2σ", zorder=3)
        for path, label, look in (
            (nominal, "learned path", {"color": palette.NOMINAL, "ls": (0, (5, 2)), "lw": 1.5}),
            (adapted, "adapted path", {"color": palette.ADAPTED, "lw": 2.2}),
            (measured, "measured path", {"color": palette.MEASURED, "lw": 1.0}),
        ):
            if path is not None:
                axes.plot(*view.of(path.positions)[thin(len(path))].T, label=label, zorder=4, **look)
        axes.plot(*view.of(adapted.positions[0]), "o", color=palette.ADAPTED, ms=6, zorder=5)
        axes.plot(*view.of(adapted.positions[-1]), "s", color=palette.ADAPTED, ms=6, zorder=5)
    return drawing.svg


def draw_components(
    axes: Any,
    view: View,
    means: ArrayLike,
    covariances: ArrayLike,
    displacement: ArrayLike | None,
    moved: ArrayLike | None,
) -> None:
    """Draw the components; a displaced component is drawn at its new position, with an arrow from its old position."""
    centres, spreads = np.asarray(means, dtype=float), np.asarray(covariances, dtype=float)
    shift = np.zeros_like(centres) if displacement is None else np.asarray(displacement, dtype=float)
    went = np.linalg.norm(shift, axis=1) > 0.0 if moved is None else np.asarray(moved, dtype=bool)
    for chosen, colour, label in (
        (~went, palette.UNMOVED, "component, not moved"),
        (went, palette.MOVED, "component, moved"),
    ):
        if chosen.any():
            look = {"facecolor": colour, "edgecolor": colour, "zorder": 1}
            draw_ellipses(axes, (centres + shift)[chosen], spreads[chosen], view, alpha=0.25, **look)
            axes.plot([], [], "o", color=colour, alpha=0.5, ms=8, label=label)
    for start, end in zip(view.of(centres[went]), view.of((centres + shift)[went]), strict=True):
        arrow = {"arrowstyle": "-|>", "color": palette.MOVED, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", end, start, arrowprops=arrow, zorder=5)
