"""Detection: one obstacle as a sensor measured it, with the uncertainty of its position."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene import HalfSpace, Obstacle
from imitarm.scene.obstacle import Solid
from imitarm.validation import finite_array, instance, text

Array = NDArray[np.float64]

_FLOOR = 1e-18  # [m^2] smallest variance
_LARGEST = 1e4  # [m^2] largest variance; positions are at most 100 m away
_NEAREST = 1e-3  # [m] depth at which a camera's coordinates are still defined


@dataclass(frozen=True, eq=False)
class Detection:
    """One measurement of an obstacle: its shape at the measured pose, and the uncertainty of the position.

    The measured position ``z`` is the origin of the obstacle's local frame (its centre, for most shapes). The error of
    ``z`` has zero mean and the covariance ``R``.

    Attributes:
        obstacle: the shape at the measured pose in the base frame; its velocity is ignored. A half-space is not
            allowed, because it can't be tracked.
        covariance: covariance ``R`` of the measured position in the base frame, shape (3, 3) [m^2].
        label: what the sensor recognised, for example a colour; empty: nothing. Two detections with different labels
            that are not empty never belong to the same obstacle.
        camera_to_base: pose of the camera that took the measurement. Only the extended Kalman filter uses it.
        solid: geometry of the obstacle, without pose and velocity.
        row: position (3), covariance (9), size (3) and quaternion (4) in one row, shape (19,). The row's variances are
            increased by 1 nm^2, so that the covariance matrix of an exact detection can be inverted.
        row_bytes: the same row as bytes, for compiled code.
        outline: label, kind and name of the obstacle in one text; empty for a convex hull.

    Raises:
        InputError: when the obstacle is a half-space or is behind the camera. Also when the covariance is not symmetric
            and positive semi-definite, or is larger than 10 000 m^2.
    """

    obstacle: Obstacle
    covariance: Array
    label: str = ""
    camera_to_base: Pose | None = None
    solid: Solid = field(init=False, repr=False)
    row: Array = field(init=False, repr=False)
    row_bytes: bytes = field(init=False, repr=False)
    outline: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.obstacle, Obstacle):
            raise InputError(f"Detection: obstacle must be an obstacle such as Sphere or Box, got {self.obstacle!r}")
        if isinstance(self.obstacle, HalfSpace):
            raise InputError("Detection: a half-space has no centre to track; add it to the fixtures of the scene")
        covariance = np.array(finite_array(self.covariance, (3, 3), "Detection: covariance", "m^2"))
        scale = float(np.abs(covariance).max())
        if scale > _LARGEST:
            raise InputError(f"Detection: covariance must be at most {_LARGEST:g} m^2, got {scale:g}; give it in m^2")
        skewed = np.abs(covariance - covariance.T).max() > 1e-9 * scale
        if skewed or (scale > 0.0 and np.linalg.eigvalsh(covariance)[0] < -1e-9 * scale):
            raise InputError("Detection: covariance must be symmetric and positive semi-definite [m^2]")
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)
        solid = self.obstacle.solid()
        size = np.asarray(solid.size, dtype=float)
        row = np.concatenate([solid.position, (covariance + _FLOOR * np.eye(3)).ravel(), size, solid.quaternion])
        if not text(self.label, "Detection: label").isprintable():
            raise InputError(f"Detection: label must be one line of text, got {self.label!r}")
        outline = "" if solid.polytope is not None else f"{self.label}\n{solid.kind} {self.obstacle.name}"
        for name, value in {"solid": solid, "row": row, "row_bytes": row.tobytes(), "outline": outline}.items():
            object.__setattr__(self, name, value)
        if self.camera_to_base is not None:
            camera = instance(self.camera_to_base, Pose, "Detection: camera_to_base")
            depth = float(camera.inverse().apply(self.position)[2])
            if depth < _NEAREST:
                raise InputError(
                    f"Detection: the obstacle is not in front of the camera (depth {depth:.3f} m); camera_to_base maps "
                    "the camera's frame (z forward) to the base frame"
                )

    @property
    def position(self) -> Array:
        """Measured position ``z``: origin of the obstacle's local frame, shape (3,) [m]."""
        return self.solid.position

    def repeats(self, other: Detection) -> bool:
        """Return whether ``other`` has the same shape, pose, covariance and label as this detection."""
        return self is other or (
            self.solid.kind == other.solid.kind and self.label == other.label and bool((self.row == other.row).all())
        )


def estimated(obstacle: Obstacle, covariance: Array, track_id: int, name: str) -> Obstacle:
    """Return a copy of an obstacle with the given covariance, track number and name.

    The function does not check its arguments.

    Args:
        obstacle: obstacle at its estimated pose, with its estimated velocities.
        covariance: covariance of the position, shape (3, 3) [m^2].
        track_id: number of the track.
        name: name of the returned obstacle.
    """
    placed = copy.copy(obstacle)
    covariance = covariance.copy()
    covariance.setflags(write=False)
    for key, value in {"covariance": covariance, "track_id": track_id, "name": name}.items():
        object.__setattr__(placed, key, value)
    return placed
