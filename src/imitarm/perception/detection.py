"""Detection: one obstacle as a camera measured it at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene.obstacle import Obstacle
from imitarm.validation import finite_array, text

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Detection:
    """A measured shape at its measured pose; a tracker turns detections into tracks.

    Attributes:
        obstacle: shape and pose in the base frame; its velocity is ignored, because one measurement contains none.
        covariance: covariance of the measured position (the origin of the obstacle's local frame), shape (3, 3) [m^2].
        label: name of a known object, for example of the target; empty if unknown.

    Raises:
        InputError: when ``obstacle`` is not an obstacle, or ``covariance`` is not a finite, symmetric and positive
            semi-definite matrix.
    """

    obstacle: Obstacle
    covariance: Array
    label: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.obstacle, Obstacle):
            raise InputError(f"Detection: obstacle must be an obstacle such as Sphere or Box, got {self.obstacle!r}")
        text(self.label, "Detection: label")
        covariance = np.array(finite_array(self.covariance, (3, 3), "Detection: covariance", "m^2"))
        scale = np.abs(covariance).max()
        if np.abs(covariance - covariance.T).max() > 1e-9 * scale or np.linalg.eigvalsh(covariance)[0] < -1e-9 * scale:
            raise InputError("Detection: covariance must be symmetric and positive semi-definite [m^2]")
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    @property
    def position(self) -> Array:
        """The measured position: the origin of the obstacle's local frame in the base frame, shape (3,) [m]."""
        return self.obstacle.solid().position
