"""Maps of the base frame: from which side they are seen, their axes, and grids of points all over them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.scene import Scene
from imitarm.viewer.canvas import Canvas, canvas

Array = NDArray[np.float64]

_WIDTH: Final = 5.5  # [inch]
_HEIGHTS: Final = (1.6, 4.4)  # [inch]


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
def drawn_map(
    name: str, text: str, view: View, corners: Array, *, legend_rows: int, note: str = "", stretched: bool = False
) -> Iterator[tuple[Any, Canvas]]:
    """Give axes that show ``corners`` (2, 2) [m], in a figure that is as high as they need; its SVG comes at the end.

    Args:
        name: unique in the page.
        text: what is to be seen, for readers that do not see it.
        view: from which side.
        corners: lower and upper corner of what must be seen.
        legend_rows: room for the legend.
        note: added to the title.
        stretched: whether a flat map may be stretched upwards, instead of keeping both scales equal; the title says so.
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
    """Return the lower and the upper corner (2, 2) of what holds all ``points``, with a margin [m]."""
    return np.array([points.min(axis=0) - margin, points.max(axis=0) + margin])


@dataclass(frozen=True, eq=False)
class Grid:
    """Points all over a map: coordinates ``across`` (columns,) and ``up`` (rows,) [m] of the axes of ``view``."""

    view: View
    across: Array
    up: Array

    @classmethod
    def of(cls, axes: Any, view: View) -> Grid:
        """Cover the axes."""
        low, high = np.sort(np.array([axes.get_xlim(), axes.get_ylim()]), axis=1).T
        step = float((high - low).max()) / 160.0
        return cls(view, *(np.arange(low[i], high[i] + step, step) for i in range(2)))

    def distance(self, scene: Scene, obstacle: int, depths: Array) -> Array:
        """Return how far an obstacle is from each point (rows, columns) [m], the nearest over ``depths``.

        For a motion at one height it is the cut at that height, for others the obstacle's shadow where the tool is.
        """
        points = np.empty((len(depths), len(self.up), len(self.across), 3))
        points[..., self.view.across] = self.across
        points[..., self.view.up] = self.up[:, None]
        points[..., self.view.depth] = depths[:, None, None]
        return np.asarray(scene.obstacles[obstacle].signed_distance(points).min(axis=0))
