"""FreeSpace: finds the space that a depth image shows to be empty, and the space in which an obstacle may be hidden."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.perception.depth_frame import DepthFrame
from imitarm.scene import Obstacle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class FreeSpace:
    """The space that a camera saw to be empty.

    Each pixel of a depth image has a ray, which ends at the measured depth. A point is empty if the ray of its pixel
    ends behind the point. A point is hidden if it is behind a surface, outside of the image, or in a pixel without a
    measurement. An obstacle may be at a hidden point. Exception: if a pixel and its eight neighbours have no
    measurement, the surface is probably beyond the camera's range. All points on the ray of this pixel then count as
    empty. Points inside known objects, such as a table, belong to no obstacle and count as empty.

    Args:
        frame: depth image; None (for example, with a point cloud): only points inside the known objects count as empty,
            and no point counts as hidden.
        surfaces: known objects that are not obstacles, such as the table.
        sigma: function that returns the standard deviation [m] of a depth [m].
    """

    def __init__(self, frame: DepthFrame | None, surfaces: Sequence[Obstacle], sigma: Callable[[Array], Array]) -> None:
        self._frame, self._surfaces, self._sigma = frame, surfaces, sigma
        if frame is not None:
            nothing = np.pad(np.isnan(frame.depth), 1, constant_values=False)
            alone = np.ones(frame.depth.shape, dtype=bool)
            height, width = frame.depth.shape
            for row in range(3):
                for column in range(3):
                    alone &= nothing[row : row + height, column : column + width]
            self._depth = np.where(alone, np.inf, frame.depth)
            self._base_to_camera = frame.camera_to_base.inverse()

    def empty(self, points: Array, margin: float = 0.01) -> Mask:
        """Return whether the camera saw that the points (..., 3) are empty, shape (...).

        Args:
            points: points in the base frame [m].
            margin: a point counts as empty only if the camera's ray through it ends behind it, by more than this
                distance plus three standard deviations of the depth [m].
        """
        empty = np.zeros(points.shape[:-1], dtype=bool)
        for surface in self._surfaces:
            empty |= surface.distances_at(points, False)[0] < -margin
        if self._frame is None:
            return empty
        measured, depth = self._seen(points)
        with np.errstate(invalid="ignore"):
            return empty | (measured > depth + margin + 3.0 * self._sigma(depth))

    def hidden(self, points: Array, margin: float = 0.01) -> Mask:
        """Return whether points (..., 3) are behind a measured surface or outside of the image, shape (...).

        Args:
            points: points in the base frame [m].
            margin: a point counts as hidden only if the camera's ray through it ends in front of it, by more than this
                distance plus three standard deviations of the depth [m].
        """
        if self._frame is None:
            return np.zeros(points.shape[:-1], dtype=bool)
        measured, depth = self._seen(points)
        with np.errstate(invalid="ignore"):
            return np.isneginf(measured) | (measured < depth - margin - 3.0 * self._sigma(depth))

    def _seen(self, points: Array) -> tuple[Array, Array]:
        """Return the measured depths of the pixels of points [m], -inf outside of the image, and the points' depths."""
        assert self._frame is not None
        camera = self._frame.intrinsics
        x, y, z = np.moveaxis(self._base_to_camera.apply(points), -1, 0)
        ahead = z > 1e-3
        z = np.where(ahead, z, 1.0)
        column = np.rint(camera.fx * x / z + camera.cx)
        row = np.rint(camera.fy * y / z + camera.cy)
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        pixel = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
        return np.where(inside, self._depth[pixel], -np.inf), z

    def below(self, points: Array, reach: float) -> Array:
        """Project the points (n, 3) that are closer than ``reach`` [m] to a known surface onto this surface."""
        found = [np.zeros((0, 3))]
        for surface in self._surfaces:
            distance, normal = surface.distances_at(points, True)
            near = (distance > 0.0) & (distance < reach)
            found.append(points[near] - distance[near, None] * normal[near])
        return np.concatenate(found)
