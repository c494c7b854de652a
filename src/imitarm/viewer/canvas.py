"""Matplotlib drawings as inline SVG, which adapts to the light or dark colours of the page.

Text and axes have the colour of the text around the drawing (``currentColor``). Curves and areas have the colours of
:mod:`~imitarm.viewer.palette`. The SVG does not load anything from outside the page.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError

Array = NDArray[np.float64]

_LONG: Final = re.compile(r"(\d+\.\d\d)\d+")  # 0.01 points are precise enough
POINTS: Final = 300  # samples of one line; more make no visible difference
INK: Final = "#010203"  # placeholder for the text colour of the page
MM: Final = 1000.0  # [mm/m]
_STYLE: Final[Mapping[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "imitarm",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": INK,
    "grid.alpha": 0.13,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


class Canvas:
    """A matplotlib figure to draw on. When the drawing is finished, the attribute ``svg`` contains its SVG text.

    The positions of axes are given in inches, because an automatic layout would draw every figure twice.
    """

    def __init__(self, figure: Any, size: tuple[float, float]) -> None:
        self.figure, self.size = figure, size
        self.svg = ""

    def axes(self, left: float, bottom: float, right: float, top: float, **options: Any) -> Any:
        """Return axes; the arguments are the positions of their edges, from the figure's lower left corner [inch]."""
        width, height = self.size
        return self.figure.add_axes(
            (left / width, bottom / height, (right - left) / width, (top - bottom) / height), **options
        )

    def legend(self, columns: int) -> None:
        """Add a legend at the bottom of the figure."""
        self.figure.legend(loc="lower center", ncols=columns, borderaxespad=0.1, handlelength=1.8, columnspacing=1.4)


@contextmanager
def canvas(name: str, description: str, size: tuple[float, float]) -> Iterator[Canvas]:
    """Yield a figure of ``size`` [inch] to draw on, then convert it to SVG.

    Args:
        name: name that is unique in the page; all ids in the SVG begin with it.
        description: description of the figure, for screen readers.
        size: width and height [inch].
    """
    try:
        import matplotlib  # noqa: PLC0415 (heavy, and an extra)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "the report's figures need matplotlib, which is not installed; "
            "install it with: pip install 'imitarm[report]'"
        ) from error
    with matplotlib.rc_context(dict(_STYLE)):
        drawing = Canvas(Figure(figsize=size), size)
        yield drawing
        text = io.StringIO()
        drawing.figure.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    drawing.svg = _inline(text.getvalue(), name, description)


def _inline(svg: str, name: str, description: str) -> str:
    """Convert the text of an SVG file to an ``<svg>`` element that can stand in a page with other SVG elements."""
    prefix = re.sub(r"\W+", "-", name)
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)  # two figures may not share an id
    svg = re.sub(
        r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg class="figure" viewBox="\1" role="img"__LABEL__>', svg, count=1
    )
    svg = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", svg, count=1, flags=re.DOTALL)  # it is for the whole page
    svg = svg.replace("xlink:href", "href").replace(INK, "currentColor")
    svg = re.sub(r"font: ([^;\"]*?)'DejaVu Sans'(, sans-serif)?", r"font: \1system-ui, 'DejaVu Sans', sans-serif", svg)
    svg = re.sub(r' d="[^"]*"', lambda path: _LONG.sub(r"\1", path[0]), svg)
    return svg.replace("__LABEL__", f' aria-label="{escape(description, quote=True)}"', 1)


def thin(n: int, most: int = POINTS) -> NDArray[np.int64]:
    """Return at most ``most`` evenly spaced indices of ``n`` samples, including the first and the last sample."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def thin_extremes(values: Array, most: int = POINTS) -> NDArray[np.int64]:
    """Return about ``most`` indices of samples to draw. Every short interval keeps its minimum and maximum."""
    if len(values) <= most:
        return np.arange(len(values))
    stretches = np.array_split(np.arange(len(values)), most // 2)
    kept = [s[[np.argmin(values[s]), np.argmax(values[s])]] for s in stretches]
    return np.unique(np.concatenate([*kept, [0, len(values) - 1]]))
