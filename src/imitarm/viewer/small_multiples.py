"""One small chart for each joint, side by side, on one paper: what a joint did and what it may do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, canvas, thin_extremes

Array = NDArray[np.float64]

_WIDTH: Final = 5.5  # [inch]
_ROW: Final = 1.15  # [inch]
_SMALL: Final[dict[str, Any]] = {"fontsize": 7.5}


@dataclass(frozen=True, eq=False)
class JointCurve:
    """What one joint did.

    Attributes:
        title: above its chart.
        values: over time, shape (n_steps,).
        lower: least value that is allowed.
        upper: largest value that is allowed.
        zero: whether a line at 0 helps to read it.
    """

    title: str
    values: Array
    lower: float
    upper: float
    zero: bool = True


def small_multiples(name: str, description: str, unit: str, times: Array, curves: Sequence[JointCurve]) -> str:
    """Draw one small chart for each joint, each between its own limits.

    Args:
        name: unique in the page.
        description: for readers that do not see it.
        unit: of the values, for the axis.
        times: shape (n_steps,) [s].
        curves: of the joints.

    Returns:
        An SVG element.
    """
    columns = min(len(curves), 4)
    rows = -(-len(curves) // columns)
    size = (_WIDTH, 0.3 + _ROW * rows)
    with canvas(name, description, size) as drawing:
        paper = drawing.axes(0.0, 0.0, *size, xlim=(0.0, size[0]), ylim=(0.0, size[1]))  # its units are inches
        paper.set_axis_off()
        for i, curve in enumerate(curves):
            row, column = divmod(i, columns)
            left = 0.58 + (size[0] - 0.26) / columns * column
            bottom = size[1] - _ROW * row - 0.94
            _Panel(left, bottom, (size[0] - 0.26) / columns - 0.42, 0.68).draw(paper, times, curve)
        paper.text(size[0] / 2, 0.06, "time [s]", ha="center")
        paper.text(0.08, size[1] / 2, unit, ha="center", va="center", rotation=90)
    return drawing.svg


@dataclass(frozen=True)
class _Panel:
    """A small chart on a paper whose units are inches: matplotlib's own axes take ten times as long, for each joint."""

    left: float
    bottom: float
    width: float
    height: float

    def draw(self, paper: Any, times: Array, curve: JointCurve) -> None:
        """Draw what a joint did between its limits."""
        low, high = min(curve.lower, float(curve.values.min())), max(curve.upper, float(curve.values.max()))
        low, high = low - 0.06 * (high - low), high + 0.06 * (high - low)
        right = self.left + self.width
        kept = thin_extremes(curve.values, 160)
        span = max(float(times[-1] - times[0]), 1e-9)
        across = self.left + self.width * (times[kept] - times[0]) / span

        def up(values: Any) -> Any:
            return self.bottom + self.height * (values - low) / (high - low)

        paper.plot(across, up(curve.values[kept]), color=palette.ADAPTED, lw=1.1)
        marks = [(curve.lower, True), (curve.upper, True)]
        if curve.zero and curve.lower < 0.0 < curve.upper:
            marks.append((0.0, False))
        for value, limit in marks:
            look = {"color": palette.LIMIT, "lw": 1.0, "ls": "--"} if limit else {"color": INK, "lw": 0.6, "alpha": 0.3}
            paper.plot([self.left, right], [up(value)] * 2, **look)
            paper.text(self.left - 0.04, up(value), f"{value:.3g}", ha="right", va="center", **_SMALL)
        paper.plot(
            [self.left, self.left, right], [self.bottom + self.height, self.bottom, self.bottom], color=INK, lw=0.6
        )
        for x, value in ((self.left, times[0]), (right, times[-1])):
            paper.text(x, self.bottom - 0.04, f"{value:.3g}", ha="center", va="top", **_SMALL)
        paper.text(self.left, self.bottom + self.height + 0.05, curve.title.replace("$", r"\$"), fontsize=8.0)
