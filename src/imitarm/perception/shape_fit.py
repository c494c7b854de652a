"""Fits of spheres, cylinders, capsules, boxes and hulls to the visible points of one object."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, Obstacle, Sphere
from imitarm.scene.obstacle import rotation_from_z

Array = NDArray[np.float64]

_ROUNDS = 8  # Gauss-Newton steps at most
_SMALL_STEP = 2e-4  # [m] after which a fit has converged
_LARGEST = 2.0  # [m] of a fitted radius
_FLATTEST = 2.0  # largest radius, in half widths of the visible points: with a larger one, they are as good as flat
_BEYOND = 0.75  # [spacings] from the outermost pixel of an object to its outline, which may be lost
_SIDEWAYS, _ALONG = 0.1, 0.25  # standard deviations of a hull's position, in its size, across and along the sight
_NEIGHBOURS = 12  # points from which a normal is estimated
_YAWS = np.radians(np.arange(0.0, 90.0, 5.0))
_FINE = np.radians(np.arange(-4.0, 5.0, 1.0))
THINNEST = 0.01  # [m] least size of a fitted shape


class Visible(NamedTuple):
    """The visible points of one object.

    Attributes:
        points: visible points, shape (n, 3) [m].
        normals: outward unit normals of the surface, which point towards the camera, shape (n, 3).
        origin: position of the camera, shape (3,) [m].
        sigma: standard deviation of the points along their rays [m].
        spacing: distance between neighbouring points on a surface that faces the camera [m].
    """

    points: Array
    normals: Array
    origin: Array
    sigma: float
    spacing: float

    @classmethod
    def of(cls, points: Array, origin: Array, sigma: float, spacing: float) -> Visible:
        """Return visible points with estimated normals; the arguments are the attributes of the class."""
        return cls(points, point_normals(points, origin), origin, sigma, spacing)


class Fit(NamedTuple):
    """A shape fitted to visible points.

    Attributes:
        obstacle: the fitted shape.
        covariance: block of ``(J^T J)^-1`` that belongs to the position, shape (3, 3). J is the Jacobian of the
            residuals; the residuals' variance times this block is the covariance of the position. For a hull, this is
            the covariance itself [m^2].
        radius: standard deviation of the radius divided by that of the residuals; 0 for shapes without a radius.
        outline: half of the object's width as the camera sees it [m]; 0 for shapes without a radius.
    """

    obstacle: Obstacle
    covariance: Array
    radius: float = 0.0
    outline: float = 0.0


def point_normals(points: Array, origin: Array) -> Array:
    """Estimate the unit normal of the surface at each point, directed towards the camera, shape (n, 3).

    The normal is the direction along which the positions of a point and its nearest neighbours vary least.

    Args:
        points: measured points, shape (n, 3) [m].
        origin: position of the camera, shape (3,) [m].
    """
    k = min(_NEIGHBOURS, len(points))
    near = points[cKDTree(points).query(points, k)[1].reshape(len(points), k)]
    centered = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))[1][:, :, 0]
    away = np.einsum("ij,ij->i", normals, origin - points) < 0.0
    normals[away] *= -1.0
    return np.asarray(normals)


def sphere(visible: Visible) -> Fit | None:
    """Fit a sphere with centre ``c`` and radius ``r``: minimise the sum of ``(|p - c| - r)^2`` over all points p."""
    points = visible.points
    shift = points.mean(axis=0)
    p = points - shift
    system = np.column_stack([2.0 * p, np.ones(len(p))])
    solution = np.linalg.lstsq(system, (p * p).sum(axis=1), rcond=None)[0]
    center, radius = solution[:3], float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-8)))
    for _ in range(_ROUNDS):
        away = p - center
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        jacobian = np.column_stack([-away / distance[:, None], -np.ones(len(p))])
        steps, normal = _steps(jacobian[None], (distance - radius)[None], visible, None)
        center, radius = center + steps[0, :3], radius + float(steps[0, 3])
        if _converged(steps):
            break
    if not _usable(center, radius) or radius > _FLATTEST * 0.5 * float(np.ptp(points, axis=0).max()):
        return None
    inverse = np.linalg.inv(normal[0])
    shape = Sphere(center + shift, max(radius, 0.5 * THINNEST))
    return Fit(shape, inverse[:3, :3], float(np.sqrt(inverse[3, 3])), _outline(visible, shape.center, None))


def cylinders(visible: Visible, axes: Array) -> list[Fit]:
    """Fit cylinders, starting from several directions ``axes`` (k, 3) of the axis.

    A point whose normal is perpendicular to the axis lies on the curved side; these points determine axis and radius. A
    point whose normal is parallel to the axis lies on a flat end and determines the position of this end. If no point
    lies on an end, the outermost points along the axis determine its position.
    """
    bars = _round_bars(visible, axes, np.abs(axes @ visible.normals.T) < 0.6)
    fits = []
    for center, axis, radius, inverse in zip(bars.centers, bars.axes, bars.radii.tolist(), bars.inverses, strict=True):
        if not _usable(center, radius):
            continue
        outline = _outline(visible, center, axis)
        if radius > _FLATTEST * outline:
            continue
        along = (visible.points - center) @ axis
        facing = visible.normals @ axis
        low, high = (_end(along, facing, sign, visible) for sign in (-1.0, 1.0))
        pose = Pose(center + 0.5 * (low + high) * axis, rotation_from_z(axis))
        shape = Cylinder(pose, max(radius, 0.5 * THINNEST), max(high - low, THINNEST))
        covariance = _bar_covariance(inverse, axis, 0.5 * (low + high))
        fits.append(Fit(shape, covariance, float(np.sqrt(inverse[4, 4])), outline))
    return fits


def capsules(visible: Visible, axes: Array) -> list[Fit]:
    """Fit capsules, starting from several directions ``axes`` (k, 3) of the axis.

    On a capsule, all points have the distance ``r`` from the segment between the two ends. Each Gauss-Newton step
    changes the axis, the radius and both ends together.
    """
    bars = _round_bars(visible, axes, np.ones((len(axes), len(visible.points)), dtype=bool), rounds=3)
    usable = [i for i, radius in enumerate(bars.radii.tolist()) if _usable(bars.centers[i], radius)]
    if not usable:
        return []
    centers, axes, radii = bars.centers[usable], bars.axes[usable], bars.radii[usable]
    p = visible.points - centers[:, None]
    along = np.einsum("bnk,bk->bn", p, axes)
    radii = np.minimum(radii, 0.5 * np.maximum(np.ptp(along, axis=1), THINNEST))
    low, high = along.min(axis=1) + radii, along.max(axis=1) - radii
    for _ in range(_ROUNDS):
        middle = 0.5 * (low + high)
        low, high = np.minimum(low, middle), np.maximum(high, middle)
        e1, e2 = basis_across(axes)
        p = visible.points - centers[:, None]
        along = np.einsum("bnk,bk->bn", p, axes)
        nearest = np.clip(along, low[:, None], high[:, None])
        away = p - nearest[..., None] * axes[:, None]
        distance = np.maximum(np.sqrt(np.einsum("bnk,bnk->bn", away, away)), 1e-9)
        away /= distance[..., None]
        u1, u2, ua = (np.einsum("bnk,bk->bn", away, e) for e in (e1, e2, axes))
        ends = -ua * (along < low[:, None]), -ua * (along > high[:, None])
        jacobian = np.stack([-u1, -u2, -nearest * u1, -nearest * u2, np.full_like(u1, -1.0), *ends], axis=-1)
        step, normal = _steps(jacobian, distance - radii[:, None], visible, None)
        centers, axes, radii = _moved(centers, axes, radii, e1, e2, step)
        low, high = low + step[:, 5], high + step[:, 6]
        if _converged(step):
            break
    fits = []
    for i, radius in enumerate(radii.tolist()):
        a, b = sorted((float(low[i]), float(high[i])))
        outline = _outline(visible, centers[i], axes[i])
        if _usable(centers[i], radius) and max(abs(a), abs(b)) < _LARGEST and radius <= _FLATTEST * outline:
            shape = Capsule(centers[i] + a * axes[i], centers[i] + b * axes[i], max(radius, 0.5 * THINNEST))
            inverse = np.asarray(np.linalg.inv(normal[i, :5, :5]), dtype=np.float64)
            covariance = _bar_covariance(inverse, axes[i], 0.5 * (a + b))
            fits.append(Fit(shape, covariance, float(np.sqrt(inverse[4, 4])), outline))
    return fits


def box(visible: Visible, axis: Array) -> Fit:
    """Fit a box of which one edge is parallel to ``axis`` (3,).

    The function chooses the rotation about ``axis`` with the smallest mean distance between the points and the nearest
    visible face (*L-shape fitting*: Zhang, Xu, Dong and Dolan, IV 2017). The position of a visible face is the mean of
    its points. The other faces are placed at the outermost points.
    """
    e1, e2 = np.concatenate(basis_across(axis[None]))
    local = np.column_stack([visible.points @ e1, visible.points @ e2, visible.points @ axis])
    eye = np.array([visible.origin @ e1, visible.origin @ e2, visible.origin @ axis])
    yaw = _best_yaw(local, eye, _YAWS)
    yaw = _best_yaw(local, eye, yaw + _FINE)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = c * e1 + s * e2, c * e2 - s * e1
    rotation = np.column_stack([x, y, axis])
    p, eye = visible.points @ rotation, visible.origin @ rotation
    low, high = p.min(axis=0), p.max(axis=0)
    n = visible.normals @ rotation
    variance = np.full((3, 2), visible.spacing**2 / 3.0 / max(visible.sigma, 1e-4) ** 2 + 1.0)
    for j in range(3):
        for sign, at in ((-1.0, low), (1.0, high)):
            if (eye[j] - at[j]) * sign > 0.0:
                close = (sign * (at[j] - p[:, j]) < 5.0 * visible.sigma + 0.004) & (sign * n[:, j] > 0.7)
                if close.sum() >= 4:
                    at[j] = p[close, j].mean()
                    variance[j, int(sign > 0.0)] = 1.0 / close.sum()
    size = np.maximum(high - low, THINNEST)
    pose = Pose(rotation @ (0.5 * (low + high)), matrix_to_quaternion(rotation))
    return Fit(Box(pose, size), rotation @ np.diag(0.25 * variance.sum(axis=1)) @ rotation.T)


def hull(visible: Visible, unseen: Array | None = None) -> Fit:
    """Fit a convex hull: enclose the visible points and their mirror image, which represents the hidden back.

    The back of a convex object begins at the outline that the camera sees. The mirror plane is therefore perpendicular
    to the line of sight and just behind the farthest points. The hull is at least as deep as the smallest width of the
    object in the image, so that even a single flat face becomes a solid.

    Args:
        visible: the visible points of the object.
        unseen: additional points that the hull must contain, for example on the table below the object, shape (m, 3)
            [m].
    """
    points = visible.points
    sight = points.mean(axis=0) - visible.origin
    sight = sight / np.linalg.norm(sight)
    depth = points @ sight
    across = points - depth[:, None] * sight
    narrow = float(np.linalg.svd(across - across.mean(axis=0), compute_uv=False)[1]) * np.sqrt(12.0 / len(points))
    near, far = float(depth.min()), float(depth.max())
    plane = max(far + _BEYOND * visible.spacing, near + 0.5 * (narrow + visible.spacing), near + THINNEST)
    back = points + (2.0 * (plane - depth))[:, None] * sight
    spread = _BEYOND * visible.spacing * _rim(across)
    size = 0.5 * (narrow + 2.0 * (plane - near))
    covariance = (_SIDEWAYS * size) ** 2 * np.eye(3) + (_ALONG * size) ** 2 * np.outer(sight, sight)
    more = np.zeros((0, 3)) if unseen is None else unseen
    return Fit(centered_hull(np.concatenate([points + spread, back + spread, more])), covariance)


def centered_hull(points: Array) -> ConvexHull:
    """Return the hull of points (n, 3) [m]; the origin of its local frame is near the centroid of its volume.

    The class ConvexHull places the local frame at the mean of the given points. The mean of all measured points would
    depend on how densely the camera sampled each side. Therefore, this function passes only the corners of the hull,
    together with many copies of a point in its middle.
    """
    corners = ConvexHull(points).vertices
    center = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    n = len(corners)
    inner = center + (center - corners.mean(axis=0)) / 3.0
    return ConvexHull(np.concatenate([corners, np.repeat(inner[None], 3 * n, axis=0)]))


def _rim(across: Array) -> Array:
    """Return the direction of each point from the middle, perpendicular to the line of sight, shape (n, 3)."""
    away = across - across.mean(axis=0)
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), 1e-6)[:, None])


class _Bars(NamedTuple):
    """Infinite cylinders: points of their axes (k, 3), axes (k, 3), radii (k,), and inverse normal matrices (k, 5, 5).

    The five parameters are two displacements across the axis, two tilts, and the radius.
    """

    centers: Array
    axes: Array
    radii: Array
    inverses: Array


def _round_bars(visible: Visible, axes: Array, chosen: NDArray[np.bool_], rounds: int = _ROUNDS) -> _Bars:
    """Fit infinite cylinders to chosen points (k, n), starting from the directions ``axes`` (k, 3)."""
    weights = np.where(chosen.sum(axis=1, keepdims=True) >= 8, chosen, True).astype(float)
    k, n = weights.shape
    centers = np.repeat(visible.points.mean(axis=0)[None], k, axis=0)
    e1, e2 = basis_across(axes)
    p = visible.points - centers[:, None]
    x, y = np.einsum("bnk,bk->bn", p, e1), np.einsum("bnk,bk->bn", p, e2)
    system = np.stack([2.0 * x, 2.0 * y, np.ones((k, n))], axis=-1)
    weighted = system * weights[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ system + 1e-9 * n * np.eye(3)
    a, b, c = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ (x * x + y * y)[..., None])[..., 0].T
    radii = np.clip(np.sqrt(np.maximum(c + a * a + b * b, 1e-8)), 0.0, _LARGEST)
    shift = np.clip(np.stack([a, b], axis=1), -_LARGEST, _LARGEST)
    centers = centers + shift[:, :1] * e1 + shift[:, 1:] * e2
    normal = np.tile(np.eye(5), (k, 1, 1))
    for _ in range(rounds):
        e1, e2 = basis_across(axes)
        p = visible.points - centers[:, None]
        along = np.einsum("bnk,bk->bn", p, axes)
        away = p - along[..., None] * axes[:, None]
        distance = np.maximum(np.sqrt(np.einsum("bnk,bnk->bn", away, away)), 1e-9)
        away /= distance[..., None]
        u1, u2 = np.einsum("bnk,bk->bn", away, e1), np.einsum("bnk,bk->bn", away, e2)
        jacobian = np.stack([-u1, -u2, -along * u1, -along * u2, np.full_like(u1, -1.0)], axis=-1)
        step, normal = _steps(jacobian, distance - radii[:, None], visible, weights)
        centers, axes, radii = _moved(centers, axes, radii, e1, e2, step)
        if _converged(step):
            break
    return _Bars(centers, axes, radii, np.linalg.inv(normal))


def _moved(centers: Array, axes: Array, radii: Array, e1: Array, e2: Array, step: Array) -> tuple[Array, Array, Array]:
    """Return centres (k, 3), axes (k, 3) and radii (k,) of bars after a Gauss-Newton step (k, 5 or more)."""
    tilt = np.clip(step[:, 2:4], -0.3, 0.3)
    centers = centers + step[:, :1] * e1 + step[:, 1:2] * e2
    tilted = axes + tilt[:, :1] * e1 + tilt[:, 1:] * e2
    return centers, tilted / np.sqrt(np.einsum("bk,bk->b", tilted, tilted))[:, None], np.abs(radii + step[:, 4])


def _outline(visible: Visible, center: Array, axis: Array | None) -> float:
    """Return half of the width in which an object is seen, across the line of sight, at least half of the thinnest [m].

    A camera sees an object in its full width, unless something hides a part; so no radius is smaller than this. The
    width of a bar is measured across its axis.
    """
    sight = center - visible.origin
    first, second = np.concatenate(basis_across((sight / np.linalg.norm(sight))[None]))
    if axis is None:
        directions = np.stack([first, second])
    else:
        across = np.cross(sight, axis)
        length = float(np.linalg.norm(across))
        directions = np.stack([first, second]) if length < 0.3 * np.linalg.norm(sight) else across[None] / length
    width = float(np.ptp(visible.points @ directions.T, axis=0).min())
    return max(0.5 * width + _BEYOND * visible.spacing * (1.0 if width > 0.0 else 0.5), 0.5 * THINNEST)


def _end(along: Array, facing: Array, sign: float, visible: Visible) -> float:
    """Return where a cylinder ends along its axis: the mean of the points of its flat end, or the outermost point."""
    last = float((sign * along).max())
    flat = (sign * facing > 0.8) & (sign * along > last - 5.0 * visible.sigma - 0.004)
    return float(along[flat].mean()) if flat.sum() >= 5 else sign * last


def _bar_covariance(inverse: Array, axis: Array, middle: float) -> Array:
    """Return the covariance of the middle of a bar for residuals of one metre, shape (3, 3)."""
    to_middle = np.array([[1.0, 0.0, middle, 0.0, 0.0], [0.0, 1.0, 0.0, middle, 0.0]])
    across = to_middle @ inverse @ to_middle.T
    basis = np.concatenate(basis_across(axis[None]))
    return np.asarray(basis.T @ across @ basis + np.outer(axis, axis))


def _best_yaw(local: Array, eye: Array, yaws: Array) -> float:
    """Return the angle about z at which the points are nearest to the visible faces of a box around them."""
    c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = c * local[:, 0] + s * local[:, 1], c * local[:, 1] - s * local[:, 0]
    eyes = (c * eye[0] + s * eye[1])[:, 0], (c * eye[1] - s * eye[0])[:, 0]
    z = np.broadcast_to(local[:, 2], x.shape)
    nearest = np.full(x.shape, np.inf)
    for values, own in ((x, eyes[0]), (y, eyes[1]), (z, np.full(len(yaws), eye[2]))):
        low, high = values.min(axis=1), values.max(axis=1)
        for face, visible in ((low, own < low), (high, own > high)):
            gap = np.where(visible[:, None], np.abs(values - face[:, None]), np.inf)
            nearest = np.minimum(nearest, gap)
    cost = np.where(np.isfinite(nearest), nearest, 1.0).mean(axis=1)
    return float(yaws[int(cost.argmin())])


def basis_across(axes: Array) -> tuple[Array, Array]:
    """Return two unit vectors for each of ``axes`` (k, 3), perpendicular to it and to each other: two arrays (k, 3).

    The formula is from Duff et al., *Building an orthonormal basis, revisited*, JCGT 2017.
    """
    x, y, z = axes.T
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return first, np.stack([b, sign + y * y * a, -y], axis=-1)


def _steps(jacobian: Array, residual: Array, visible: Visible, weights: Array | None) -> tuple[Array, Array]:
    """Return Gauss-Newton steps (k, m), with weights that limit the effect of outliers (Huber), and normal matrices.

    Args:
        jacobian: shape (k, n, m).
        residual: shape (k, n) [m].
        visible: points that were fitted.
        weights: additional weight of each residual, shape (k, n); None: 1.
    """
    limit = 2.0 * max(visible.sigma, 0.002)
    weight = limit / np.maximum(np.abs(residual), limit)
    if weights is not None:
        weight *= weights
    transposed = np.swapaxes(jacobian * weight[..., None], 1, 2)
    normal = transposed @ jacobian
    diagonal = np.einsum("bii->bi", normal)
    diagonal += 1e-6 * np.maximum(diagonal.sum(axis=1, keepdims=True), 1e-9)
    step = -np.linalg.solve(normal, transposed @ residual[..., None])[..., 0]
    longest = np.abs(step).max(axis=1, keepdims=True)
    return step * (0.3 / np.maximum(longest, 0.3)), normal


def _converged(step: Array) -> bool:
    return float(np.abs(step).max()) < _SMALL_STEP


def _usable(center: Array, radius: float) -> bool:
    return bool(np.isfinite(center).all() and 0.0 < radius < _LARGEST)
