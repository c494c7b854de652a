"""Chooses a shape for the visible points of an object, and extends the shape to parts that the camera can't see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose
from imitarm.perception import shape_fit
from imitarm.perception.detection import Detection
from imitarm.perception.free_space import FreeSpace
from imitarm.perception.shape_fit import Fit, Visible
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, Obstacle, Sphere

Array = NDArray[np.float64]

SHAPES = ("sphere", "cylinder", "capsule", "box", "convex_hull")
_PARAMETERS = {"sphere": 4, "cylinder": 7, "capsule": 7, "box": 9}
_DIRECTIONS = 64  # surface points of a shape that are compared with the free space
_UNLIKE = 0.05  # standard deviation of the position of an object that is not exactly of the fitted shape, in its size
_WITHIN = 0.8  # where these points are, from the middle of the shape to its surface: a corner may be seen to be empty
_FLOATING = 0.25  # largest fraction of a shape's surface in the free space
_RELATED = 4.0  # neighbouring points have similar errors: so many points count as one
_GRID = np.stack(np.meshgrid([-0.9, 0.0, 0.9], [-0.9, 0.0, 0.9]), axis=-1).reshape(-1, 2)
_FEW_EMPTY = 0.2  # fraction of the samples of a new layer in empty space: the layer does not belong to the object
_MOST_GROWN = 0.3  # [m] by which an unseen side is extended at most


def fit_shape(
    visible: Visible, space: FreeSpace, shapes: Sequence[str] = SHAPES, every: Array | None = None
) -> Detection:
    r"""Fit shapes of all kinds, choose the best shape, and extend it to parts that may be hidden.

    Let ``s`` be the root mean square distance of the points from the surface of a shape with ``k`` parameters. ``s`` is
    at least the standard deviation of the measurement. Neighbouring points have similar errors, so ``n`` is a quarter
    of the number of points. The function chooses the shape with the smallest value of the Bayesian information
    criterion

    .. math:: n \log s^2 + k \log n

    A shape is rejected if more than a quarter of its surface lies in space that the camera saw to be empty. If every
    shape is rejected, or if the points are much farther from the best shape than the noise explains, the convex hull of
    the points is used. The radius of a sphere, cylinder or capsule is enlarged by its standard deviation. If the object
    in the image is even wider, the radius is enlarged by up to three standard deviations.

    Then the ends and faces that the camera did not see are moved outwards, until the shape reaches empty space. The
    extension is at most the size of the visible part, and at most 0.3 m. Finally, the shape is enlarged until no
    visible point is outside by more than twice the standard deviation of the noise.

    The covariance of the position is a sum of four terms. The first term results from the noise of the points, and the
    second from the distance between neighbouring rays. The third term corresponds to a standard deviation of a
    twentieth of the size, because no object has exactly the fitted shape. The fourth term results from the unknown size
    of the hidden part. A side that was moved outwards by ``g`` may in truth end anywhere in between. The fourth term
    therefore contains ``g^2 / 12`` for each such side.

    Args:
        visible: points to which the shapes are fitted.
        space: the space that the camera saw to be empty.
        shapes: kinds of shapes that may be chosen.
        every: all points that the returned shape must contain, shape (m, 3) [m]; None: ``visible.points``.
    """
    every = visible.points if every is None else every
    n = len(visible.points)
    if n < 8 or np.ptp(visible.points, axis=0).max() < 2.0 * visible.spacing:
        return _ball(visible, every)
    floor = float(np.hypot(visible.sigma, 0.002))
    count = n / _RELATED
    scored: list[tuple[float, float, Fit]] = []
    for kind in (kind for kind in _PARAMETERS if kind in shapes):
        penalty = _PARAMETERS[kind] * np.log(count)
        least = min(scored, key=lambda entry: entry[0])[0] if scored else np.inf
        if least < count * np.log(floor**2) + penalty:  # no shape with more parameters can be better
            break
        for fit in candidates(visible, kind):
            distances = np.abs(fit.obstacle.distances_at(visible.points, False)[0])
            capped = np.mean(np.minimum(distances, 4.0 * floor) ** 2)
            score = count * np.log(max(capped, floor**2)) + penalty
            scored.append((float(score), float(np.sqrt(np.mean(distances**2))), fit))
    scored.sort(key=lambda entry: entry[0])
    standing = (entry for entry in scored if _floating(entry[2].obstacle, visible, space) <= _FLOATING)
    _, spread, best = next(standing, (np.inf, np.inf, None))
    if best is None or ("convex_hull" in shapes and spread > 2.0 * floor + 0.004):
        removed = 0.01 + 1.5 * visible.sigma + visible.spacing  # [m] above a surface, where points are lost
        unseen = [space.below(visible.points, removed), _behind_others(visible, space)]
        best = shape_fit.hull(visible, np.concatenate(unseen))
        spread = 1.0 / np.sqrt(_RELATED)  # its covariance is complete
    variance = max(spread, visible.sigma) ** 2 * _RELATED
    obstacle, grown = grow(_wider(best, best.radius * float(np.sqrt(variance))), visible, space)
    noise = variance * best.covariance
    extent = float(np.mean(np.ptp(visible.points, axis=0)))
    covariance = noise + (visible.spacing**2 / 12.0 + (_UNLIKE * extent) ** 2 + 1e-6) * np.eye(3) + grown
    return Detection(contain(obstacle, every, 2.0 * visible.sigma), 0.5 * (covariance + covariance.T))


def candidates(visible: Visible, kind: str) -> list[Fit]:
    """Fit one kind of shape; return one fit for each possible direction of the shape's axis."""
    if kind == "sphere":
        fit = shape_fit.sphere(visible)
        return [] if fit is None else [fit]
    if kind == "box":
        return [shape_fit.box(visible, axis) for axis in box_axes(visible)]
    function = shape_fit.cylinders if kind == "cylinder" else shape_fit.capsules
    return function(visible, np.array(axes(visible)))


def axes(visible: Visible) -> list[Array]:
    """Return possible axes of a cylinder or capsule: across all normals, along the longest side, and the vertical."""
    normals, points = visible.normals, visible.points - visible.points.mean(axis=0)
    least = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    longest = np.linalg.eigh(points.T @ points)[1][:, 2]
    return _distinct([least, longest, np.array([0.0, 0.0, 1.0])])


def box_axes(visible: Visible) -> list[Array]:
    """Return possible directions of a box's edge: the most frequent normal of the points, and the vertical."""
    normals = visible.normals[:: max(1, len(visible.normals) // 100)]
    alike = np.abs(normals @ normals.T) > 0.97
    common = alike[int(alike.sum(axis=1).argmax())]
    chosen = normals[common]
    direction = np.linalg.eigh(chosen.T @ chosen)[1][:, 2]
    return _distinct([direction, np.array([0.0, 0.0, 1.0])])


def _behind_others(visible: Visible, space: FreeSpace) -> Array:
    """Return points to which an object may extend behind others that hide a part of it, shape (k, 3).

    From the outline, the object may go on sideways as long as the camera's view is blocked by something nearer, at most
    by half of its visible width.
    """
    points = visible.points
    sight = points.mean(axis=0) - visible.origin
    first, second = np.concatenate(shape_fit.basis_across((sight / np.linalg.norm(sight))[None]))
    angles = np.arange(16) * (np.pi / 8.0)
    directions = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    along = points @ directions.T
    rim = points[along.argmax(axis=0)]
    lengths = _steps(max(0.5 * float(np.ptp(along, axis=0).max()), visible.spacing), visible)
    samples = rim[:, None] + (visible.spacing + lengths)[:, None] * directions[:, None]
    hidden = np.logical_and.accumulate(space.hidden(samples), axis=1)
    far = hidden.sum(axis=1)
    found = far > 0
    return np.asarray(samples[found, far[found] - 1])


def _wider(fit: Fit, by: float) -> Obstacle:
    """Return a round shape that is wider by ``by`` [m], and up to three times as much if it was seen to be so wide."""
    obstacle = fit.obstacle
    if isinstance(obstacle, Sphere | Cylinder | Capsule):
        by = min(by, 0.5 * obstacle.radius)
        return replace(obstacle, radius=max(obstacle.radius + by, min(fit.outline, obstacle.radius + 3.0 * by)))
    return obstacle


def _distinct(directions: list[Array]) -> list[Array]:
    kept: list[Array] = []
    for direction in directions:
        if all(abs(direction @ other) < 0.985 for other in kept):
            kept.append(direction)
    return kept


def _floating(obstacle: Obstacle, visible: Visible, space: FreeSpace) -> float:
    """Return the fraction of points on a shape that are in space that the camera saw to be empty."""
    points = obstacle.support(_SPHERE)
    center = obstacle.solid().position
    return float(space.empty(center + _WITHIN * (points - center), margin=0.01 + visible.spacing).mean())


def grow(obstacle: Obstacle, visible: Visible, space: FreeSpace) -> tuple[Obstacle, Array]:
    """Extend the unseen faces or ends of a shape until they reach space that the camera saw to be empty.

    Args:
        obstacle: the fitted shape.
        visible: the points to which the shape was fitted.
        space: the space that the camera saw to be empty.

    Returns:
        The extended shape; and the part of its position's covariance that results from the unknown size, shape (3, 3)
        [m^2].
    """
    if isinstance(obstacle, Box):
        return _grow_box(obstacle, visible, space)
    if isinstance(obstacle, Cylinder | Capsule):
        return _grow_bar(obstacle, visible, space)
    return obstacle, np.zeros((3, 3))


def _steps(limit: float, visible: Visible) -> Array:
    """Return the lengths by which a side is extended in turn [m]."""
    return np.linspace(0.0, limit, max(2, int(limit / max(0.5 * visible.spacing, 0.005)) + 1))[1:]


def _grow_box(box: Box, visible: Visible, space: FreeSpace) -> tuple[Obstacle, Array]:
    rotation, half = box.pose.rotation, 0.5 * box.size
    low, high, variance = -half.copy(), half.copy(), np.zeros(3)
    eye = (visible.origin - box.pose.position) @ rotation
    for j in np.argsort(-half):
        others = [i for i in range(3) if i != j]
        for sign in (-1.0, 1.0):
            if sign * eye[j] > half[j]:  # a face that the camera sees is where it is seen
                continue
            lengths = _steps(min(_MOST_GROWN, max(2.0 * float(half.max()), 0.02)), visible)
            face = np.empty((len(lengths), len(_GRID), 3))
            middle, span = 0.5 * (low + high)[others], 0.5 * (high - low)[others]
            face[:, :, others] = middle + _GRID * span
            face[:, :, j] = ((high if sign > 0.0 else -low)[j] + lengths[:, None]) * sign
            grown = _until_empty(box.pose.position + face @ rotation.T, lengths, space, visible)
            if sign > 0.0:
                high[j] += grown
            else:
                low[j] -= grown
            variance[j] += grown**2 / 12.0
    pose = Pose(box.pose.position + rotation @ (0.5 * (low + high)), box.pose.quaternion)
    return Box(pose, high - low), rotation @ np.diag(variance) @ rotation.T


def _grow_bar(bar: Cylinder | Capsule, visible: Visible, space: FreeSpace) -> tuple[Obstacle, Array]:
    solid = bar.solid()
    rotation = Pose(solid.position, solid.quaternion).rotation
    axis = rotation[:, 2]
    e1, e2 = rotation[:, 0], rotation[:, 1]
    half = 0.5 * float(solid.size[1])
    cap = bar.radius if isinstance(bar, Capsule) else 0.0
    ends, variance = [], 0.0
    for sign in (-1.0, 1.0):
        grown = 0.0
        if sign * ((visible.origin - solid.position) @ axis) <= half + cap or cap:
            lengths = _steps(min(_MOST_GROWN, max(2.0 * half, 2.0 * bar.radius)), visible)
            disc = 0.7 * bar.radius * (_GRID[:, :1] * e1 + _GRID[:, 1:] * e2) * (0.5 if cap else 1.0)
            along = (half + cap + lengths)[:, None, None] * sign * axis
            grown = _until_empty(solid.position + along + disc, lengths, space, visible)
        ends.append(solid.position + sign * (half + grown) * axis)
        variance += grown**2 / 12.0
    covariance = variance * np.outer(axis, axis)
    if isinstance(bar, Capsule):
        return replace(bar, start=ends[0], end=ends[1]), covariance
    middle = 0.5 * (ends[0] + ends[1])
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return replace(bar, pose=Pose(middle, bar.pose.quaternion), length=length), covariance


def _until_empty(samples: Array, lengths: Array, space: FreeSpace, visible: Visible) -> float:
    """Return the length before the first layer of ``samples`` (k, m, 3) in empty space; 0 if it is the first."""
    empty = space.empty(samples, margin=0.005).mean(axis=1) > _FEW_EMPTY
    if not empty.any():
        return float(lengths[-1])
    first = int(empty.argmax())
    return float(lengths[first - 1]) if first else 0.0


def contain(obstacle: Obstacle, points: Array, tolerance: float = 0.0) -> Obstacle:
    """Enlarge a shape until no point of ``points`` (n, 3) [m] is outside by more than ``tolerance`` [m]."""
    slack = 1e-9
    if isinstance(obstacle, Sphere | Capsule):
        outside = float(obstacle.distances_at(points, False)[0].max()) - tolerance
        return replace(obstacle, radius=obstacle.radius + max(outside, 0.0) + slack)
    if isinstance(obstacle, Box):
        rotation = obstacle.pose.rotation
        local = (points - obstacle.pose.position) @ rotation
        low = np.minimum(local.min(axis=0) + tolerance, -0.5 * obstacle.size) - slack
        high = np.maximum(local.max(axis=0) - tolerance, 0.5 * obstacle.size) + slack
        middle = obstacle.pose.position + rotation @ (0.5 * (low + high))
        return replace(obstacle, pose=Pose(middle, obstacle.pose.quaternion), size=high - low)
    if isinstance(obstacle, Cylinder):
        rotation = obstacle.pose.rotation
        local = (points - obstacle.pose.position) @ rotation
        half = 0.5 * obstacle.length
        low = min(float(local[:, 2].min()) + tolerance, -half) - slack
        high = max(float(local[:, 2].max()) - tolerance, half) + slack
        radius = max(obstacle.radius, float(np.hypot(local[:, 0], local[:, 1]).max()) - tolerance) + slack
        middle = obstacle.pose.position + rotation[:, 2] * 0.5 * (low + high)
        return replace(obstacle, pose=Pose(middle, obstacle.pose.quaternion), radius=radius, length=high - low)
    beyond = obstacle.distances_at(points, False)[0] > tolerance + slack
    if isinstance(obstacle, ConvexHull) and beyond.any():
        return shape_fit.centered_hull(np.concatenate([obstacle.points, points[beyond]]))
    return obstacle


def _ball(visible: Visible, every: Array) -> Detection:
    """Return a sphere around few points, which show no shape."""
    center = 0.5 * (every.min(axis=0) + every.max(axis=0))
    radius = float(np.linalg.norm(every - center, axis=1).max()) + visible.spacing
    return Detection(Sphere(center, max(radius, shape_fit.THINNEST)), (radius**2 / 3.0 + visible.sigma**2) * np.eye(3))


def _fibonacci(n: int) -> Array:
    """Return n directions that are spread evenly over the sphere, shape (n, 3)."""
    k = np.arange(n) + 0.5
    z, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


_SPHERE = _fibonacci(_DIRECTIONS)
