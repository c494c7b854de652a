"""One colour, one meaning, in the 3-D view, in the figures and in the page.

All are taken from the Okabe-Ito palette (or are greys), so that they stay apart for colour-blind readers too.
Line styles repeat what the colours say: no figure needs colour to be read.
"""

from __future__ import annotations

from typing import Final

NOMINAL: Final = "#8b919c"  # the learnt path, before anything was in the way
ADAPTED: Final = "#0072b2"  # the path around the obstacles
MEASURED: Final = "#e69f00"  # what the robot did
DEMONSTRATION: Final = "#cc79a7"  # what was shown
UNMOVED: Final = "#009e73"  # a Gaussian component that stayed
MOVED: Final = "#d55e00"  # a Gaussian component that was displaced
OBSTACLE: Final = "#7d6b60"
LIMIT: Final = "#b3261e"  # a line that must not be crossed


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of ``"#rrggbb"``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
