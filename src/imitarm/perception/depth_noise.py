"""Noise of a depth camera: the standard deviation of a measured depth, and simulated images with this noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.perception.depth_frame import DepthFrame
from imitarm.validation import finite_number, instance, real_array

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthNoise:
    r"""The noise of a depth camera: random errors of the depth, lost pixels, and rounding.

    The standard deviation of a depth ``z`` is :math:`\sigma(z) = a + b\,(z - z_0)^2`. Nguyen, Izadi and Lovell measured
    the default values of a, b and z_0 for a Kinect (*Modeling Kinect sensor noise for improved 3D reconstruction and
    tracking*, 3DIMPVT 2012). With these values, the standard deviation is 1.2 mm at 0.4 m, 6 mm at 2 m and 41 mm at 5
    m.

    Attributes:
        offset: ``a``, standard deviation at the depth ``z_0`` [m].
        growth: ``b``, factor of ``(z - z_0)^2`` in the standard deviation [1/m].
        nearest: ``z_0``, depth with the smallest standard deviation [m].
        edge_dropout: probability that a pixel at a depth edge is lost. At a depth edge, the depths of two neighbouring
            pixels differ by more than 5 cm.
        dropout: probability that any other pixel is lost.
        mixed: probability that a pixel at a depth edge, if it is not lost, measures a depth between the two surfaces.
        step: depths are rounded to multiples of this step [m]; 0: depths are not rounded.

    Raises:
        InputError: when a number is negative or not finite, or a probability is above 1.
    """

    offset: float = 0.0012
    growth: float = 0.0019
    nearest: float = 0.4
    edge_dropout: float = 0.3
    dropout: float = 0.002
    mixed: float = 0.1
    step: float = 0.001

    def __post_init__(self) -> None:
        for key, unit in (("offset", "m"), ("growth", "1/m"), ("nearest", "m"), ("step", "m")):
            finite_number(getattr(self, key), f"DepthNoise: {key}", unit, at_least=0.0)
        for key in ("edge_dropout", "dropout", "mixed"):
            finite_number(getattr(self, key), f"DepthNoise: {key}", at_least=0.0, at_most=1.0)

    @classmethod
    def none(cls) -> DepthNoise:
        """Return the noise of an ideal camera: all attributes are zero."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def sigma(self, depth: ArrayLike) -> Array:
        """Return the standard deviation of measured depths, including the error of rounding, shape (...) [m].

        Args:
            depth: depths, shape (...) [m].
        """
        z = real_array(depth, (...,), "depth", "m")
        axial = self.offset + self.growth * (z - self.nearest) ** 2
        return np.asarray(np.hypot(axial, self.step / np.sqrt(12.0)) if self.step else axial)

    def apply(self, frame: DepthFrame, rng: np.random.Generator) -> DepthFrame:
        """Return the image with simulated noise in its depths.

        Args:
            frame: image with exact depths.
            rng: random number generator; the same state of the generator gives the same noise.
        """
        instance(frame, DepthFrame, "DepthNoise.apply: frame")
        exact = frame.depth
        noise, lost, between = rng.standard_normal(exact.shape), rng.random(exact.shape), rng.random((2, *exact.shape))
        farthest = _farthest_neighbour(exact)
        edge = farthest - exact > _EDGE
        depth = np.where(edge & (between[0] < self.mixed), exact + between[1] * (farthest - exact), exact)
        depth = depth + (self.offset + self.growth * (depth - self.nearest) ** 2) * noise
        if self.step:
            depth = np.round(depth / self.step) * self.step
        lost_here = lost < np.where(edge | ~np.isfinite(farthest), self.edge_dropout, self.dropout)
        depth[lost_here | ~(depth > 0.0)] = np.nan
        return replace(frame, depth=depth)


_EDGE = 0.05  # [m]


def _farthest_neighbour(depth: Array) -> Array:
    """Return the largest depth of the four neighbours of each pixel, shape (height, width); nan beside an empty one."""
    padded = np.pad(depth, 1, mode="edge")
    sides = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    return np.maximum.reduce(sides)
