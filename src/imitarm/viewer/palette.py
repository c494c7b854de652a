"""Colours; each colour has the same meaning in the 3-D view, the figures and the page.

All colours are greys or from the Okabe-Ito palette, which colour-blind readers can distinguish. In every figure, lines
of different colours also have different styles, so the figure can be read without colour.
"""

from __future__ import annotations

from typing import Final

NOMINAL: Final = "#8b919c"  # the learned path, without obstacles
ADAPTED: Final = "#0072b2"  # the path around the obstacles
MEASURED: Final = "#e69f00"  # the measured motion of the robot
DEMONSTRATION: Final = "#cc79a7"  # a demonstration
UNMOVED: Final = "#009e73"  # a Gaussian component that was not moved
MOVED: Final = "#d55e00"  # a Gaussian component that was moved
OBSTACLE: Final = "#7d6b60"
PREDICTED: Final = "#56b4e9"  # where a tracker expects an obstacle
LIMIT: Final = "#b3261e"  # a limit or a required clearance


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of ``"#rrggbb"``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
