"""PointCloud: the points that a sensor measured at one time, from a lidar, a stereo camera or a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.html_table import html_table
from imitarm.kinematics.pose import Pose
from imitarm.perception.depth_frame import check_colors, check_lengths
from imitarm.validation import finite_number, instance, real_array, time_stamp

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """Measured points on surfaces, in any order and without the rows and columns of an image.

    Attributes:
        stamp: time at which the points were measured [s].
        measured: points in the sensor's frame, shape (n, 3) [m]; rows that are not finite are removed.
        sensor_to_base: pose of the sensor when the points were measured.
        spacing: angle between neighbouring rays [rad]. This angle times the distance of a surface from the sensor is
            the distance between neighbouring points of the surface.
        colors: red, green and blue of each point, 0 to 1, shape (n, 3); None without colours.

    Raises:
        InputError: when a shape is wrong, or the stamp or the spacing is not a finite number. Also when most points are
            beyond 100 m, as in millimetres, or a colour is not from 0 to 1.
    """

    stamp: float
    measured: Array
    sensor_to_base: Pose
    spacing: float = 0.005
    colors: Array | None = None

    def __post_init__(self) -> None:
        instance(self.sensor_to_base, Pose, "PointCloud: sensor_to_base")
        object.__setattr__(self, "stamp", time_stamp(self.stamp, "PointCloud: stamp"))
        object.__setattr__(self, "spacing", finite_number(self.spacing, "PointCloud: spacing", "rad", above=0.0))
        measured = real_array(self.measured, (None, 3), "PointCloud: measured", "m")
        finite = np.isfinite(measured).all(axis=1)
        if self.colors is not None:
            colors = real_array(self.colors, (len(measured), 3), "PointCloud: colors")[finite]
            check_colors(colors, "PointCloud: colors")
            object.__setattr__(self, "colors", colors)
        measured = measured[finite]
        check_lengths(np.abs(measured).max(axis=1, initial=0.0), "PointCloud: measured")
        measured.setflags(write=False)
        object.__setattr__(self, "measured", measured)

    def points(self) -> Array:
        """Return the points in the base frame, shape (n, 3) [m]."""
        return self.sensor_to_base.apply(self.measured)

    def __repr__(self) -> str:
        return f"PointCloud({len(self.measured)} points, stamp {self.stamp:g} s)"

    def _repr_html_(self) -> str:
        place = f"at {np.round(self.sensor_to_base.position, 3).tolist()} m"
        return html_table(
            "PointCloud", {"points": str(len(self.measured)), "stamp": f"{self.stamp:g} s", "sensor": place}
        )
