"""Target: a known object that is recognised among the obstacles by its colour, its shape, or both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene import Obstacle
from imitarm.validation import finite_number, finite_vector, text

Array = NDArray[np.float64]

_DARK = 0.1  # sum of the three colours below which a point has no colour
_BRIGHTNESS = 0.45  # largest difference of the mean of the three colours


@dataclass(frozen=True, eq=False)
class Target:
    """A known object. A detection that matches the object gets the object's name as its ``label``.

    The chromaticity of a colour consists of its red, green and blue, each divided by the sum of the three. The
    chromaticity depends little on the brightness of the light. A colour matches if its chromaticity is close to the
    chromaticity of the target. A shape matches if it is of the same kind as the target's shape, and no length differs
    by more than ``size_tolerance``.

    Attributes:
        name: name of the object, which becomes the label of matching detections.
        color: red, green and blue of the object, 0 to 1, shape (3,); None: any colour matches.
        shape: obstacle with the shape and size of the object, at any pose; None: any shape matches.
        color_tolerance: largest distance between two chromaticities that match.
        size_tolerance: largest difference between two lengths that match [m].

    Raises:
        InputError: when neither colour nor shape is given, or a value can't be used.
    """

    name: str
    color: Array | None = None
    shape: Obstacle | None = None
    color_tolerance: float = 0.08
    size_tolerance: float = 0.04

    def __post_init__(self) -> None:
        if not text(self.name, "Target: name"):
            raise InputError("Target: name must not be empty")
        if self.color is None and self.shape is None:
            raise InputError(f"Target {self.name!r}: give a color, a shape, or both")
        if self.color is not None:
            color = np.array(finite_vector(self.color, 3, "Target: color"))
            if color.min() < 0.0 or color.max() > 1.0 or color.sum() < _DARK:
                raise InputError(
                    f"Target: color must be red, green and blue from 0 to 1, not black, got {self.color!r}"
                )
            object.__setattr__(self, "color", color)
        if self.shape is not None and not isinstance(self.shape, Obstacle):
            raise InputError(f"Target: shape must be an obstacle such as Cylinder, got {self.shape!r}")
        finite_number(self.color_tolerance, "Target: color_tolerance", above=0.0)
        finite_number(self.size_tolerance, "Target: size_tolerance", "m", above=0.0)

    def has_color(self, colors: Array) -> NDArray[np.bool_]:
        """Return whether each of ``colors`` (n, 3) matches the target's colour, shape (n,); True if any colour does."""
        if self.color is None:
            return np.ones(len(colors), dtype=bool)
        total = colors.sum(axis=1)
        shares = colors / np.maximum(total, _DARK)[:, None]
        apart = np.linalg.norm(shares - self.color / self.color.sum(), axis=1)
        near = np.abs(total - self.color.sum()) <= 3.0 * _BRIGHTNESS
        return (apart <= self.color_tolerance) & near & (total >= _DARK)

    def has_shape(self, obstacle: Obstacle) -> bool:
        """Return whether a detected shape matches the target's shape; True if any shape matches."""
        if self.shape is None:
            return True
        found, known = obstacle.solid(), self.shape.solid()
        sizes = (np.array(solid.size, dtype=float) for solid in (found, known))
        a, b = (np.sort(size) if found.kind == "box" else size for size in sizes)
        return found.kind == known.kind and bool(np.abs(a - b).max() <= self.size_tolerance)
