"""DepthFrame: one image of a depth camera, with the camera's pose and intrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.html_table import html_table
from imitarm.kinematics.pose import Pose
from imitarm.validation import finite_array, finite_number, instance, real_array, time_stamp, whole_number

Array = NDArray[np.float64]

_FARTHEST = 100.0  # [m] if most depths are larger, they are in millimetres


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion.

    The point ``(x, y, z)`` in the camera's frame is projected to column ``u = fx x/z + cx`` and row ``v = fy y/z +
    cy``. The frame has its origin at the pinhole, x to the right of the image, y down and z forward. The centre of the
    first pixel is at ``u = v = 0``.

    Attributes:
        width: number of columns.
        height: number of rows.
        fx: focal length along the columns [pixel].
        fy: focal length along the rows [pixel].
        cx: column of the optical axis [pixel].
        cy: row of the optical axis [pixel].

    Raises:
        InputError: when a number is not finite, or a size or focal length is not positive.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for key in ("width", "height"):
            object.__setattr__(self, key, whole_number(getattr(self, key), f"Intrinsics: {key}", at_least=1))
        for key in ("fx", "fy"):
            value = finite_number(getattr(self, key), f"Intrinsics: {key}", "pixel", above=0.0)
            object.__setattr__(self, key, value)
        for key in ("cx", "cy"):
            object.__setattr__(self, key, finite_number(getattr(self, key), f"Intrinsics: {key}", "pixel"))

    @classmethod
    def from_field_of_view(cls, width: int, height: int, vertical: float) -> Intrinsics:
        """Return a camera with square pixels, a centred optical axis and a given vertical field of view [rad]."""
        height = whole_number(height, "height", at_least=1)
        angle = finite_number(vertical, "vertical field of view", "rad", above=0.0)
        if angle >= np.pi:
            raise InputError(f"vertical field of view must be below pi [rad], got {angle:g}")
        focal = 0.5 * height / float(np.tan(0.5 * angle))
        return cls(width, height, focal, focal, 0.5 * (whole_number(width, "width") - 1), 0.5 * (height - 1))

    def project(self, points: ArrayLike) -> Array:
        """Return the pixel coordinates (column u, row v) of points.

        Args:
            points: points in the camera's frame, shape (..., 3) [m].

        Returns:
            u and v, shape (..., 2) [pixel]; nan for points that are not in front of the camera. Projected points may be
            outside the image.
        """
        x, y, z = np.moveaxis(finite_array(points, (..., 3), "points", "m"), -1, 0)
        ahead = np.where(z > 0.0, z, np.nan)
        return np.stack([self.fx * x / ahead + self.cx, self.fy * y / ahead + self.cy], axis=-1)

    def rays(self) -> Array:
        """Return the point with ``z = 1`` on the ray of each pixel, in the camera's frame, shape (height, width, 3)."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class DepthFrame:
    """One depth image.

    Attributes:
        stamp: time at which the image was taken [s].
        depth: depth of the surface at each pixel, shape (height, width) [m]. The depth is the coordinate z in the
            camera's frame, not the length of the ray. Pixels without a measurement are nan; 0 and infinity are replaced
            by nan.
        intrinsics: intrinsic parameters of the camera.
        camera_to_base: pose of the camera when the image was taken.
        color: red, green and blue of each pixel, 0 to 1, shape (height, width, 3); nan where a colour is unknown. None
            for a camera without colours.

    Raises:
        InputError: when the shape does not match the camera, a depth is negative, or the stamp is not finite. Also when
            most depths are beyond 100 m, as in an image in millimetres, or a colour is not from 0 to 1.
    """

    stamp: float
    depth: Array
    intrinsics: Intrinsics
    camera_to_base: Pose
    color: Array | None = None

    def __post_init__(self) -> None:
        camera = instance(self.intrinsics, Intrinsics, "DepthFrame: intrinsics")
        instance(self.camera_to_base, Pose, "DepthFrame: camera_to_base")
        object.__setattr__(self, "stamp", time_stamp(self.stamp, "DepthFrame: stamp"))
        depth = np.array(real_array(self.depth, (camera.height, camera.width), "DepthFrame: depth", "m"))
        if np.any(depth < 0.0):
            row, column = np.argwhere(depth < 0.0)[0].tolist()
            raise InputError(
                f"DepthFrame: depth must not be negative [m], but depth[{row}, {column}] is {depth[row, column]}"
            )
        depth[(depth == 0.0) | np.isinf(depth)] = np.nan
        check_lengths(depth, "DepthFrame: depth")
        depth.setflags(write=False)
        object.__setattr__(self, "depth", depth)
        if self.color is not None:
            color = np.array(real_array(self.color, (camera.height, camera.width, 3), "DepthFrame: color"))
            check_colors(color, "DepthFrame: color")
            color.setflags(write=False)
            object.__setattr__(self, "color", color)

    @property
    def spacing(self) -> float:
        """Angle between the rays of neighbouring pixels near the optical axis [rad]."""
        return 1.0 / min(self.intrinsics.fx, self.intrinsics.fy)

    def points(self) -> Array:
        """Return the measured points in the base frame, row by row of the image, shape (n, 3) [m]."""
        measured = ~np.isnan(self.depth)
        rays = self.intrinsics.rays()[measured]
        return self.camera_to_base.apply(rays * self.depth[measured][:, None])

    def __repr__(self) -> str:
        width, height = self.intrinsics.width, self.intrinsics.height
        return f"DepthFrame({width} x {height}, stamp {self.stamp:g} s, {self._measured()})"

    def _repr_html_(self) -> str:
        rows = {
            "size": f"{self.intrinsics.width} x {self.intrinsics.height} pixels",
            "stamp": f"{self.stamp:g} s",
            "measured": self._measured(),
            "camera": f"at {np.round(self.camera_to_base.position, 3).tolist()} m",
        }
        return html_table("DepthFrame", rows)

    def _measured(self) -> str:
        measured = self.depth[~np.isnan(self.depth)]
        if not len(measured):
            return "nothing measured"
        share = 100.0 * len(measured) / self.depth.size
        return f"{share:.0f} % measured, from {measured.min():.2f} to {measured.max():.2f} m"


def check_lengths(lengths: Array, what: str) -> None:
    """Reject measured lengths of which most are beyond 100 m, because these are probably in millimetres.

    Args:
        lengths: lengths of any shape [m]; nan where nothing was measured.
        what: the name of the argument in the message.

    Raises:
        InputError: when more than half of the measured lengths are beyond 100 m.
    """
    far = int(np.count_nonzero(lengths > _FARTHEST))
    if far and far > 0.5 * np.count_nonzero(~np.isnan(lengths)):
        raise InputError(f"{what}: most of the measured lengths are beyond {_FARTHEST:g} m; give them in m, not in mm")


def check_colors(colors: Array, what: str) -> None:
    """Reject colours that are not from 0 to 1; nan is allowed.

    Args:
        colors: red, green and blue, shape (..., 3).
        what: the name of the argument in the message.

    Raises:
        InputError: when a colour is out of range.
    """
    wrong = (colors < 0.0) | (colors > 1.0)
    if wrong.any():
        raise InputError(f"{what} must be from 0 to 1, got {colors[wrong][0]:g}; divide colours of 8 bits by 255")
