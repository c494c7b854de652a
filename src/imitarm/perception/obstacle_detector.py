"""ObstacleDetector: detects obstacles in one depth image or point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, uniform_filter

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import segmentation
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.depth_noise import DepthNoise
from imitarm.perception.detection import Detection
from imitarm.perception.free_space import FreeSpace
from imitarm.perception.point_cloud import PointCloud
from imitarm.perception.self_filter import SelfFilter
from imitarm.perception.shape_choice import SHAPES, fit_shape
from imitarm.perception.shape_fit import Visible
from imitarm.perception.target import Target
from imitarm.scene import Box, HalfSpace, Obstacle, Scene
from imitarm.validation import choice, finite_array, finite_number, flag, instance, sequence, whole_number

Array = NDArray[np.float64]
Frame = DepthFrame | PointCloud

_SLANTED = 2.5  # neighbouring points of a slanted surface are farther apart than the rays by up to this factor
_CLEARLY_CONCAVE = 0.003  # [m] above the noise
_MOST_PARTS = 4  # of one cluster
_MOST_VOXELS = 300  # of one object; more don't improve the fit
_ENOUGH = 200  # points from which the pose of the camera is checked
_CHECKED = 1500  # points with which it is checked
_SEARCHED = 0.25  # [m] around its place in which a surface is searched for
_MOVED, _TILTED = 0.03, 0.07  # [m], [rad] by which a surface may appear at a wrong place
_INSIDE = 0.1  # largest fraction of rays through known surfaces
_UP = np.array([0.0, 0.0, 1.0])


class _Measured(NamedTuple):
    """Points in the base frame (n, 3), their depths (n,), pixels (n,) of an image, colours, and the camera."""

    points: Array
    depth: Array
    pixel: NDArray[np.intp] | None
    colors: Array | None
    origin: Array
    spacing: float
    camera: Pose | None = None  # camera_to_base of an image

    def only(self, kept: NDArray[np.bool_]) -> _Measured:
        pixel = None if self.pixel is None else self.pixel[kept]
        colors = None if self.colors is None else self.colors[kept]
        return self._replace(points=self.points[kept], depth=self.depth[kept], pixel=pixel, colors=colors)


class ObstacleDetector:
    """Finds obstacles in depth images and point clouds.

    The steps of :meth:`detect`:

    1. Remove points out of the camera's range, and pixels that measured a mixture of two surfaces
    (:func:`segmentation.mixed_pixels`).
    2. Remove points outside of the workspace, on the known surfaces (table, floor, pedestal) and on the robot
       (:class:`SelfFilter`).
    3. Divide the remaining points into groups at gaps that are wider than ``gap``; each group is one object. A clearly
    concave group probably shows two objects that touch, for example a hand and a bottle. It is cut in two
    (:func:`segmentation.best_cut`).
    4. Fit a sphere, a cylinder, a capsule, a box or a convex hull to each object, and compute the covariance of its
       position. Extend the shape into space that the camera can't see
       (:func:`~imitarm.perception.shape_choice.fit_shape`).

    No visible point of an object is outside of the fitted shape by more than two standard deviations of the noise.

    Args:
        arm: arm with its tool; points on both are removed. None: no robot is in view.
        surfaces: known objects that are not obstacles, for example ``Scene.fixtures``; points inside and near them are
            removed. Use a ``HalfSpace`` for a floor or a table.
        find_table: whether to also find the largest horizontal plane in each image and remove its points.
        workspace: lowest and highest corner of the box in which obstacles are detected, in the base frame, shape (2, 3)
            [m].
        depth_range: least and largest depth that the camera measures well [m].
        noise: noise of the camera, from which margins are computed; None: the noise of a Kinect.
        surface_margin: points within this distance from a known surface belong to the surface [m]; the detector adds
            the noise of each point.
        padding: distance from the arm within which points belong to the arm [m], see :class:`SelfFilter`.
        stamp_uncertainty: uncertainty of the time stamps [s], see :class:`SelfFilter`.
        voxel: edge length of the voxels in which points are averaged [m].
        gap: largest gap between two parts of one object [m]. Far from the camera, where neighbouring rays are farther
            apart than this, the gap is larger.
        min_points: smallest number of points of an object; a smaller group counts as noise.
        shapes: shapes that may be fitted.
        split: whether clearly concave groups are cut into parts.
        targets: known objects; if a detection matches a target, its label is the target's name. Points with the colour
            of a target form a separate object, even if they touch another object. If the images have no colours, only
            shapes are compared.
        max_obstacles: largest number of detections; if there are more, the detections nearest to the camera are kept.

    Raises:
        InputError: when an argument can't be used.
    """

    def __init__(
        self,
        arm: ArmModel | None = None,
        *,
        surfaces: Sequence[Obstacle] = (),
        find_table: bool = False,
        workspace: ArrayLike = ((-1.5, -1.5, -0.8), (1.5, 1.5, 2.0)),
        depth_range: tuple[float, float] = (0.5, 5.0),
        noise: DepthNoise | None = None,
        surface_margin: float = 0.01,
        padding: float = 0.03,
        stamp_uncertainty: float = 0.04,
        voxel: float = 0.012,
        gap: float = 0.03,
        min_points: int = 6,
        shapes: Sequence[str] = SHAPES,
        split: bool = True,
        targets: Sequence[Target] = (),
        max_obstacles: int = 32,
    ) -> None:
        self.arm = None if arm is None else instance(arm, ArmModel, "ObstacleDetector: arm")
        known = sequence(surfaces, Obstacle, "ObstacleDetector: surfaces")  # type: ignore[type-abstract]
        self.surfaces = Scene(fixtures=known).fixtures
        self.find_table = flag(find_table, "ObstacleDetector: find_table")
        self.workspace = finite_array(workspace, (2, 3), "ObstacleDetector: workspace", "m").copy()
        if not (self.workspace[0] < self.workspace[1]).all():
            raise InputError("ObstacleDetector: workspace must be the lowest and the highest corner of a box [m]")
        near, far = finite_array(depth_range, (2,), "ObstacleDetector: depth_range", "m").tolist()
        if not 0.0 <= near < far:
            raise InputError(
                f"ObstacleDetector: depth_range must be two increasing depths from 0 [m], got {depth_range}"
            )
        self.depth_range = near, far
        self.noise = DepthNoise() if noise is None else instance(noise, DepthNoise, "ObstacleDetector: noise")
        self.surface_margin = finite_number(surface_margin, "ObstacleDetector: surface_margin", "m", at_least=0.0)
        self.voxel = finite_number(voxel, "ObstacleDetector: voxel", "m", above=0.0)
        self.gap = finite_number(gap, "ObstacleDetector: gap", "m", above=0.0)
        self.min_points = whole_number(min_points, "ObstacleDetector: min_points", at_least=1)
        names = sequence(shapes, str, "ObstacleDetector: shapes")
        self.shapes = tuple(choice(shape, SHAPES, "shape to fit") for shape in names)
        if not self.shapes:
            raise InputError("ObstacleDetector: shapes must name at least one shape")
        self.split = flag(split, "ObstacleDetector: split")
        self.targets = sequence(targets, Target, "ObstacleDetector: targets")
        self.max_obstacles = whole_number(max_obstacles, "ObstacleDetector: max_obstacles", at_least=1)
        padding = finite_number(padding, "ObstacleDetector: padding", "m", at_least=0.0)
        delta = finite_number(stamp_uncertainty, "ObstacleDetector: stamp_uncertainty", "s", at_least=0.0)
        self.self_filter = None if arm is None else SelfFilter(arm, padding=padding, stamp_uncertainty=delta)

    def record(self, stamp: float, q: ArrayLike) -> None:
        """Store the joint positions ``q`` (n_joints,) [rad] at ``stamp`` [s]; :meth:`detect` interpolates them."""
        if self.self_filter is not None:
            self.self_filter.record(stamp, q)

    def detect(self, frame: Frame, q: ArrayLike | None = None) -> list[Detection]:
        """Return the obstacles in one image, in the order of their distance from the camera.

        Args:
            frame: depth image or point cloud.
            q: joint positions when the image was taken, shape (n_joints,) [rad]; None: interpolated between the
                positions given to :meth:`record`.

        Raises:
            InputError: when ``frame`` is neither an image nor a point cloud, ``q`` has a wrong shape, or the detector
                has an arm whose joint positions are unknown.
        """
        measured, surfaces = self._obstacle_points(_checked(frame, "detect"), q, "detect")
        if len(measured.points) < self.min_points:
            return []
        space = FreeSpace(frame if isinstance(frame, DepthFrame) else None, surfaces, self.noise.sigma)
        objects = [part for group in self._of_one_color(measured) for part in self._objects(group)]
        objects.sort(key=lambda part: float(part.depth.min()))
        return [self._detection(part, space) for part in objects[: self.max_obstacles]]

    def obstacle_points(self, frame: Frame, q: ArrayLike | None = None) -> Array:
        """Return all points except those of the robot and of the known surfaces, in the base frame, shape (n, 3) [m].

        The arguments have the same meaning as in :meth:`detect`.
        """
        return self._obstacle_points(_checked(frame, "obstacle_points"), q, "obstacle_points")[0].points

    def camera_error(self, frame: Frame) -> str:
        """Check the pose of the camera that the frame states; return a message about an error, or an empty string.

        If somebody has moved a camera, the known surfaces appear at wrong places. The method looks for two such errors.
        First, many rays go through known surfaces. Second, the plane of a known half-space, or the upper face of a
        known box, contains hardly any points, and the measured plane is more than 3 cm or 4 degrees away.

        Args:
            frame: depth image or point cloud.

        Raises:
            InputError: when ``frame`` is neither an image nor a point cloud.
        """
        measured = _measured(_checked(frame, "camera_error"), self.depth_range)
        if len(measured.points) < _ENOUGH:
            return ""
        chosen = np.linspace(0, len(measured.points) - 1, min(len(measured.points), _CHECKED)).astype(int)
        points, margin = measured.points[chosen], _MOVED + self.noise.sigma(measured.depth[chosen])
        rays = points - measured.origin
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        samples = points[:, None] - np.arange(0.0, 0.6, 0.04)[:, None] * rays[:, None]
        inside = np.zeros(len(points), dtype=bool)
        for surface in self.surfaces:
            inside |= (surface.distances_at(samples, False)[0] < -margin[:, None]).any(axis=1)
            message = self._misplaced(surface, points)
            if message:
                return message
        if inside.mean() > _INSIDE:
            return (
                f"{100.0 * inside.mean():.0f} % of the rays go through known surfaces; the camera was moved (calibrate "
                "it again), or a surface is smaller than stated (a table top is a Box, a HalfSpace has no edges)"
            )
        return ""

    def _misplaced(self, surface: Obstacle, points: Array) -> str:
        """Return a message if a horizontal surface is seen beside its place."""
        normal = _upper_normal(surface)
        if normal is None:
            return ""
        height = surface.distances_at(points, False)[0]
        near = points[np.abs(height) < _SEARCHED]
        if len(near) < 0.1 * _ENOUGH or (np.abs(height) < _MOVED).sum() > 0.25 * len(near):
            return ""
        found = segmentation.fit_plane(near, normal=normal, least_fraction=0.3)
        if found is None:
            return ""
        middle = near[np.abs(found.distances_at(near, False)[0]) < 0.02].mean(axis=0)
        off = abs(float(surface.signed_distance(middle)))
        tilt = float(np.arccos(np.clip(found.normal @ normal, -1.0, 1.0)))
        if off <= _MOVED and tilt <= _TILTED:
            return ""
        return (
            f"the surface {surface.name or surface.kind!r} is seen {1e3 * off:.0f} mm and {np.degrees(tilt):.0f} deg "
            "away from its known place; the camera was moved: calibrate the camera again"
        )

    def _obstacle_points(self, frame: Frame, q: ArrayLike | None, what: str) -> tuple[_Measured, tuple[Obstacle, ...]]:
        """Return the points of obstacles, and the surfaces whose points were removed."""
        if self.self_filter is None and q is not None:
            raise InputError(f"{what}: q was given, but the detector has no arm; make it with arm=ArmModel.load(...)")
        if self.self_filter is not None and q is not None:
            self.self_filter.record(frame.stamp, q)
        elif self.self_filter is not None and not self.self_filter.ready:
            raise InputError(
                f"{what}: the joint positions of the arm are unknown, so its points can't be removed; give q, or call "
                "record(stamp, q) first"
            )
        measured = _measured(frame, self.depth_range)
        low, high = self.workspace
        measured = measured.only(((measured.points >= low) & (measured.points <= high)).all(axis=1))
        surfaces = self.surfaces
        if self.find_table and len(measured.points):
            plane = segmentation.fit_plane(measured.points, normal=_UP)
            surfaces = surfaces if plane is None else (*surfaces, plane)
        for surface in surfaces:
            measured = measured.only(self._off(surface, measured, frame))
        if self.self_filter is None:
            return measured, surfaces
        own = self.self_filter.on_arm(measured.points, frame.stamp, 2.0 * self.noise.sigma(measured.depth))
        if measured.pixel is not None and isinstance(frame, DepthFrame) and own.any():
            image = np.zeros(frame.depth.size, dtype=bool)
            image[measured.pixel[own]] = True
            beside = binary_dilation(image.reshape(frame.depth.shape), np.ones((3, 3), dtype=bool))
            own |= beside.ravel()[measured.pixel]  # mixed pixels at the outline of the arm
        return measured.only(~own), surfaces

    def _off(self, surface: Obstacle, measured: _Measured, frame: Frame) -> NDArray[np.bool_]:
        """Return which points don't belong to a surface, shape (n,).

        A point is off the surface if it is three standard deviations above it. In an image, a lower point is off the
        surface too if five or six of the nine pixels around it are at least one standard deviation above.
        """
        sigma = self.noise.sigma(measured.depth)
        height = surface.distances_at(measured.points, False)[0] - self.surface_margin
        off = height > 3.0 * sigma
        if measured.pixel is not None and isinstance(frame, DepthFrame):
            above = np.zeros(frame.depth.shape)
            above.ravel()[measured.pixel] = height > sigma
            count = np.rint(9.0 * uniform_filter(above, 3, mode="constant").ravel()[measured.pixel])
            off |= ((height > sigma) & (count >= 5)) | ((height > 0.0) & (count >= 6))
        return off

    def _of_one_color(self, measured: _Measured) -> list[_Measured]:
        """Return the points of each target's colour, and all other points."""
        if measured.colors is None:
            return [measured]
        groups, rest = [], np.ones(len(measured.points), dtype=bool)
        for target in self.targets:
            own = rest & target.has_color(measured.colors) if target.color is not None else np.zeros_like(rest)
            groups.append(measured.only(own))
            rest &= ~own
        return [group for group in (*groups, measured.only(rest)) if len(group.points) >= self.min_points]

    def _objects(self, measured: _Measured) -> list[_Measured]:
        return [part for cluster in self._clusters(measured) for part in self._parts(cluster)]

    def _label(self, obstacle: Obstacle, colors: Array | None) -> str:
        """Return the name of the target that an object matches; empty if none."""
        color = None if colors is None or not self.targets else np.median(colors, axis=0)[None]
        for target in self.targets:
            if target.color is not None and (color is None or not target.has_color(color)[0]):
                continue
            if target.has_shape(obstacle):
                return target.name
        return ""

    def _clusters(self, measured: _Measured) -> list[_Measured]:
        """Return the points of each object."""
        index, n = segmentation.voxels(measured.points, self.voxel)
        centers = segmentation.voxel_means(np.column_stack([measured.points, measured.depth]), index, n)
        gaps = np.maximum(self.gap, _SLANTED * measured.spacing * centers[:, 3])
        owner = segmentation.connected(centers[:, :3], gaps)[index]
        order = np.argsort(owner, kind="stable")
        ends = np.cumsum(np.bincount(owner))
        groups = np.split(order, ends[:-1])
        return [_take(measured, group) for group in groups if len(group) >= self.min_points]

    def _parts(self, cluster: _Measured, parts: int = 1) -> list[_Measured]:
        """Cut a clearly concave group in two, and each of the two again."""
        points = cluster.points
        if not self.split or parts >= _MOST_PARTS or len(points) < 4 * self.min_points:
            return [cluster]
        depth = float(np.median(cluster.depth))
        allowed = _CLEARLY_CONCAVE + 3.0 * float(self.noise.sigma(depth))
        sample = points[np.linspace(0, len(points) - 1, min(len(points), _MOST_VOXELS)).astype(int)]
        before = segmentation.concavity(sample)
        if before <= allowed:
            return [cluster]
        side, after = segmentation.best_cut(points, cluster.origin)
        if after > 0.5 * before or min(side.sum(), (~side).sum()) < self.min_points:
            return [cluster]
        return [part for half in (side, ~side) for part in self._parts(cluster.only(half), parts + 1)]

    def _detection(self, part: _Measured, space: FreeSpace) -> Detection:
        depth = float(np.median(part.depth))
        sigma, spacing = float(self.noise.sigma(depth)), part.spacing * depth
        index, n = segmentation.voxels(part.points, self.voxel)
        centers = segmentation.voxel_means(part.points, index, n)
        if n > _MOST_VOXELS:
            centers = centers[np.linspace(0, n - 1, _MOST_VOXELS).astype(int)]
        visible = Visible.of(centers, part.origin, sigma, spacing)
        found = fit_shape(visible, space, self.shapes, part.points)
        label = self._label(found.obstacle, part.colors)
        return replace(found, label=label, camera_to_base=part.camera)


def _upper_normal(surface: Obstacle) -> Array | None:
    """Return the normal of a half-space or of the upper face of an upright box; None for other surfaces."""
    if isinstance(surface, HalfSpace):
        return surface.normal
    upright = isinstance(surface, Box) and abs(surface.pose.rotation[2, 2]) > 0.999
    return _UP if upright else None


def _take(measured: _Measured, group: NDArray[np.intp]) -> _Measured:
    chosen = np.zeros(len(measured.points), dtype=bool)
    chosen[group] = True
    return measured.only(chosen)


def _checked(frame: Frame, what: str) -> Frame:
    if not isinstance(frame, DepthFrame | PointCloud):
        raise InputError(f"{what}: frame must be a DepthFrame or a PointCloud, got {frame!r}")
    return frame


def _measured(frame: Frame, depth_range: tuple[float, float]) -> _Measured:
    """Return the points of a frame that are in the camera's range and not mixed."""
    near, far = depth_range
    if isinstance(frame, PointCloud):
        depth = np.linalg.norm(frame.measured, axis=1)
        kept = (depth >= near) & (depth <= far)
        measured = _Measured(frame.points(), depth, None, frame.colors, frame.sensor_to_base.position, frame.spacing)
        return measured.only(kept)
    with np.errstate(invalid="ignore"):
        kept = (frame.depth >= near) & (frame.depth <= far) & ~segmentation.mixed_pixels(frame.depth)
    pixel = np.flatnonzero(kept.ravel())
    depth = frame.depth.ravel()[pixel]
    points = frame.camera_to_base.apply(_rays(frame.intrinsics)[pixel] * depth[:, None])
    colors = None if frame.color is None else frame.color.reshape(-1, 3)[pixel]
    pose = frame.camera_to_base
    return _Measured(points, depth, pixel, colors, pose.position, frame.spacing, pose)


@lru_cache(maxsize=4)
def _rays(camera: Intrinsics) -> Array:
    rays = camera.rays().reshape(-1, 3)
    rays.setflags(write=False)
    return rays
