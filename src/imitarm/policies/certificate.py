"""Guarantee that a path of the tool keeps its clearance, at the samples of the path and between them.

The signed distance of a point from a convex obstacle is a convex function of the point. Its tangent plane at any point
is therefore a lower bound everywhere. The tangents at two samples give a lower bound of the distance on the straight
segment between them. If this bound is below the required clearance, the distance is measured at further points of the
segment. The measurements end when the bound is at least the required clearance, or when one of the points is too close.

An obstacle that moves at a constant velocity ``v`` stands still in coordinates that move with it. If ``t v`` is
subtracted from the position at each time t, the same bound holds for a moving obstacle. The path must then be executed
at its planned times.

An obstacle may have a margin that grows with time (:mod:`~imitarm.policies.prediction_margin`). The distance minus this
margin is also a convex function. In this module, all distances to such an obstacle are distances minus its margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import rotate
from imitarm.policies.prediction_margin import PredictionMargin
from imitarm.scene.edged import HalfSpace
from imitarm.scene.obstacle import Obstacle
from imitarm.scene.rounded import Sphere
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_NEWTON_STEPS = 12
_MAX_PROBES = 12  # points measured on a segment whose bound is too low; the bracket is then far below a micrometre


@dataclass(frozen=True, eq=False)
class ClosePoints:
    """Points between the samples of a path at which a sphere of the tool is closer to an obstacle than required.

    At the samples before and after such a point, the sphere is not too close.

    Attributes:
        pair: index of the pair (a sphere and an obstacle) that is too close at each point, shape (m,).
        segment: index of the sample before the point, shape (m,).
        fraction: position of the point between the sample before it (0) and the sample after it (1), shape (m,).
    """

    pair: Index
    segment: Index
    fraction: Array

    @classmethod
    def none(cls) -> ClosePoints:
        """Return an object without points."""
        return cls(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp), np.empty(0))

    def __len__(self) -> int:
        return len(self.pair)

    def __add__(self, other: ClosePoints) -> ClosePoints:
        pair, segment = np.append(self.pair, other.pair), np.append(self.segment, other.segment)
        return ClosePoints(pair, segment, np.append(self.fraction, other.fraction))


@dataclass(frozen=True, eq=False)
class ToolAmongObstacles:
    """The spheres that contain the tool, and the obstacles from which these spheres keep a distance.

    One sphere and one obstacle form a *pair*: pair ``i`` is obstacle ``i // n_spheres`` with sphere
    ``i % n_spheres``. At each sample, the tool has the same rotation as on the nominal path. The centre of a sphere is
    therefore the position of the tip plus a known offset.

    Attributes:
        obstacles: convex obstacles; a rotating obstacle is replaced by a sphere that contains it.
        spheres: centres in the tool's frame and radii, rows x y z r, shape (n_spheres, 4) [m].
        radii: radii of the spheres, shape (n_spheres,) [m].
        offsets: for each obstacle, an array of shape (n_spheres, n, 3) [m], or None if all its vectors are zero. It
            contains the vector from the tip to the centre of each sphere at each of n samples, minus the obstacle's
            displacement since time 0, in the base frame.
        bows: largest distance of each sphere's centre from the straight line between its positions at two successive
            samples, shape (n_spheres, n - 1) [m]. The centre leaves the line because the tool rotates.
        times: time of each sample, shape (n,) [s].
        margins: for each obstacle, its margin, or None for an obstacle without a margin.
    """

    obstacles: tuple[Obstacle, ...]
    spheres: Array
    radii: Array
    offsets: tuple[Array | None, ...]
    bows: Array
    times: Array
    margins: tuple[PredictionMargin | None, ...]

    @classmethod
    def along(
        cls,
        nominal: Trajectory,
        spheres: Array,
        obstacles: Sequence[Obstacle],
        margins: Sequence[PredictionMargin | None] | None = None,
    ) -> ToolAmongObstacles:
        """Compute the positions of the spheres relative to the tip and the obstacles along a path.

        Args:
            nominal: path with the times and rotations of the tool, n samples.
            spheres: centres in the tool's frame and radii, rows x y z r, shape (n_spheres, 4) [m].
            obstacles: obstacles at time 0, which keep their velocities. A rotating obstacle is replaced by a sphere
                about its centre that contains it.
            margins: the margin of each obstacle, or None for an obstacle without a margin; None: there are no margins.

        Raises:
            InputError: when a half-space rotates.
        """
        q, n = nominal.quaternions, len(nominal)
        bows = np.zeros((len(spheres), n - 1))
        centres: Array | None = None
        if q is not None and spheres[:, :3].any():
            half_angle = np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0.0, 1.0))
            centres = np.stack([rotate(q, sphere[:3]) for sphere in spheres])
            # Exact for a rotation at constant rate: the sagitta of the arc about the tip.
            bows = np.linalg.norm(spheres[:, :3], axis=1)[:, None] * (1.0 - np.cos(half_angle))
        offsets: list[Array | None] = []
        solids = tuple(without_rotation(obstacle) for obstacle in obstacles)
        for obstacle in solids:
            if not obstacle.velocity.any():
                offsets.append(centres)
                continue
            travelled = nominal.times[:, None] * obstacle.velocity
            moved = np.zeros((len(spheres), n, 3)) if centres is None else centres
            offsets.append(moved - travelled)
        given = (None,) * len(solids) if margins is None else tuple(margins)
        radii = np.ascontiguousarray(spheres[:, 3])
        return cls(solids, spheres, radii, tuple(offsets), bows, nominal.times, given)

    @property
    def n_spheres(self) -> int:
        """Number of spheres."""
        return len(self.radii)

    @property
    def reach(self) -> float:
        """Radius of the sphere about the tip that contains all spheres [m]."""
        return float(np.max(np.linalg.norm(self.spheres[:, :3], axis=1) + self.spheres[:, 3]))

    @property
    def n_pairs(self) -> int:
        """Number of pairs of a sphere and an obstacle."""
        return len(self.radii) * len(self.obstacles)

    def centres(self, pair: int, positions: Array, samples: Index | slice = slice(None)) -> Array:
        """Return positions of the centre of a pair's sphere, minus the obstacle's displacement since time 0.

        Args:
            pair: index of the pair of a sphere and an obstacle.
            positions: positions of the tip, shape (..., m, 3) [m].
            samples: indices of the m samples of the path to which the positions belong.

        Returns:
            Shape (..., m, 3) [m].
        """
        obstacle, sphere = divmod(pair, self.n_spheres)
        offset = self.offsets[obstacle]
        return positions if offset is None else positions + offset[sphere, samples]

    def distance(self, pair: int, positions: Array, samples: Index | slice) -> Array:
        """Return the distance (..., m) [m] between sphere and obstacle of a pair; see :meth:`centres`."""
        obstacle, sphere = divmod(pair, self.n_spheres)
        centres = self.centres(pair, positions, samples)
        kept_off = self.radii[sphere] + self.margin(pair, samples)
        return np.asarray(self.obstacles[obstacle].distances_at(centres, gradient=False)[0] - kept_off)

    def margin(self, pair: int, samples: Index | slice) -> Array | float:
        """Return the margin of a pair's obstacle at m samples, shape (m,) [m]; 0 if the obstacle has no margin."""
        margin = self.margins[pair // self.n_spheres]
        return 0.0 if margin is None else margin.at(self.times[samples])

    def margin_between(self, pair: int, segment: Index, fraction: Array) -> Array | float:
        """Return the margin of a pair's obstacle at points between samples; 0 if the obstacle has no margin.

        Args:
            pair: index of the pair of a sphere and an obstacle.
            segment: index of the sample before each point, shape (m,).
            fraction: position of the point between this sample (0) and the next sample (1), shape (m,).

        Returns:
            Shape (m,) [m], or 0.
        """
        margin = self.margins[pair // self.n_spheres]
        if margin is None:
            return 0.0
        return margin.at(self.times[segment] + fraction * (self.times[segment + 1] - self.times[segment]))

    def distance_and_normal(self, pair: int, centres: Array, margin: Array | float = 0.0) -> tuple[Array, Array]:
        """Return the distance (...) [m] from a sphere's surface to the obstacle, and its gradient (..., 3).

        Args:
            pair: index of the pair of a sphere and an obstacle.
            centres: results of :meth:`centres`, shape (..., 3) [m].
            margin: results of :meth:`margin` for the same points, broadcast to their shape (...) [m].
        """
        obstacle, sphere = divmod(pair, self.n_spheres)
        distance, normal = self.obstacles[obstacle].distances_at(centres, gradient=True)
        return np.asarray(distance - (self.radii[sphere] + margin)), normal

    def exits(
        self,
        pair: int,
        points: Array,
        directions: Array,
        target: float,
        tolerance: float,
        margin: Array | float = 0.0,
    ) -> Array:
        """Return how far points must move along directions until they are at the distance ``target`` from the obstacle.

        The *inflated obstacle* contains all points at which the pair's distance is below ``target``. Each point moves
        along a ray until it leaves the inflated obstacle for the last time. Newton's method starts on the ray beyond
        this exit. The signed distance along a ray is convex, so the computed displacement decreases towards the exit
        and never passes it.

        Args:
            pair: index of the pair of a sphere and an obstacle.
            points: positions of the centre of the pair's sphere, shape (p, 3) [m].
            directions: unit vectors, one for each row, shape (m, 3).
            target: distance between sphere and obstacle that the points must reach [m].
            tolerance: largest accepted excess of the distance over ``target`` [m].
            margin: results of :meth:`margin` for the same points, shape (p,) [m].

        Returns:
            Displacements of the p points along the m directions, shape (m, p) [m]; inf if a point never reaches the
            distance.
        """
        obstacle, sphere = divmod(pair, self.n_spheres)
        solid = self.obstacles[obstacle]
        if isinstance(solid, HalfSpace):
            missing = np.maximum(target + (self.radii[sphere] + margin) - solid.signed_distance(points), 0.0)
            slope = directions @ solid.normal
            lift = missing / np.where(slope > 1e-9, slope, np.nan)[:, None]
            return np.where(missing == 0.0, 0.0, np.where(np.isnan(lift), np.inf, lift))
        # Beyond the obstacle's farthest plane along a direction every point is clear: begin there.
        farthest = np.einsum("md,md->m", solid.support(directions), directions) + target + self.radii[sphere]
        lift = np.maximum(farthest[:, None] - directions @ points.T + margin, 0.0)
        for _ in range(_NEWTON_STEPS):
            d, n = self.distance_and_normal(pair, points + lift[..., None] * directions[:, None, :], margin)
            gap = d - target
            slope = (n @ directions[:, :, None])[..., 0]
            falling = slope <= 1e-9  # past the point of closest approach: the ray never enters
            lift = np.where(falling, 0.0, np.maximum(lift - gap / np.where(falling, 1.0, slope), 0.0))
            if np.all((gap < tolerance) | (lift <= 0.0)):
                break
        return lift

    def clearance_of(self, positions: Array) -> PathClearance:
        """Return the distances of all pairs along a path of the tip, whose positions have the shape (n, 3) [m]."""
        n, k = len(positions), self.n_spheres
        if k == 1 and len(self.obstacles) == 1 and self.offsets[0] is None and self.margins[0] is None:
            d, normals = self.obstacles[0].distances_at(positions, gradient=True)
            return PathClearance(self, positions, (d - self.radii[0])[None], normals[None])
        distance, normal = np.empty((self.n_pairs, n)), np.empty((self.n_pairs, n, 3))
        for o, obstacle in enumerate(self.obstacles):
            rows, offset = slice(o * k, (o + 1) * k), self.offsets[o]
            centres = positions if offset is None else positions + offset
            d, normal[rows] = obstacle.distances_at(centres, gradient=True)
            margin = self.margins[o]
            distance[rows] = d - self.radii[:, None]
            if margin is not None:
                distance[rows] -= margin.at(self.times)
        return PathClearance(self, positions, distance, normal)


@dataclass(frozen=True, eq=False)
class PathClearance:
    """Distances from the tool to the obstacles along one path of the tip, and their lower bounds between the samples.

    Attributes:
        tool: the spheres of the tool, and the obstacles.
        positions: positions of the tip, shape (n, 3) [m].
        distance: distance of each pair at each sample, shape (n_pairs, n) [m].
        normal: gradients of the distances, shape (n_pairs, n, 3).
    """

    tool: ToolAmongObstacles
    positions: Array
    distance: Array
    normal: Array

    @property
    def lowest(self) -> float:
        """The smallest distance at a sample [m]; inf without obstacles."""
        return float(self.distance.min(initial=np.inf))

    def segment_bounds(self) -> Array:
        """Bound the distance from below on each segment of the path.

        Let ``f`` be a convex function on a segment of length L. It has the value f0 and the slope a at the start, and
        the value f1 and the slope b at the end. Then ``f(s) >= max(f0 + a s, f1 - b (L - s))``. The minimum of this
        bound over s is at an end of the segment, or where the two terms of the maximum are equal. Between two samples,
        the tip moves along a straight line. If the tool rotates by ``angle`` at the same time, the centre of a sphere
        deviates from a straight line by at most ``|offset| (1 - cos(angle / 2))``. This deviation is subtracted from
        the bound.

        Returns:
            Shape (n_pairs, n - 1) [m].
        """
        tool, k = self.tool, self.tool.n_spheres
        tip = (self.positions[1:] - self.positions[:-1])[None]
        if all(offset is None for offset in tool.offsets):
            step = tip
        else:
            step = np.empty((tool.n_pairs, *tip.shape[1:]))
            for o, offset in enumerate(tool.offsets):
                step[o * k : (o + 1) * k] = tip if offset is None else tip + np.diff(offset, axis=1)
        a = (self.normal[:, :-1, None, :] @ step[..., None])[..., 0, 0]  # slopes over s in [0, 1] on each segment
        b = (self.normal[:, 1:, None, :] @ step[..., None])[..., 0, 0]
        for o, margin in enumerate(tool.margins):
            if margin is not None:
                rows, dt = slice(o * k, (o + 1) * k), np.diff(tool.times)
                a[rows] -= margin.slopes_after(tool.times[:-1]) * dt
                b[rows] -= margin.slopes_before(tool.times[1:]) * dt
        low = crossing_of_tangents(self.distance[:, :-1], a, self.distance[:, 1:], b, 1.0)[0]
        return low - (np.tile(tool.bows, (len(tool.obstacles), 1)) if tool.bows.any() else 0.0)

    def certified(self, clearance: float) -> tuple[Array, ClosePoints]:
        """Bound the distance from below on each segment, and refine the bound where it is below ``clearance``.

        Near a corner of an obstacle, the bound from the tangents at the two ends of a segment is much too low. The
        distance is therefore measured at the point where the tangents cross. If this distance is below the clearance,
        the path is too close to the obstacle. Otherwise, the point replaces one end of the segment: the first end if
        the distance decreases at the point, or the last end if it increases. The minimum of the distance therefore
        stays between the two ends, and the bound converges to this minimum.

        Args:
            clearance: required clearance [m].

        Returns:
            Lower bounds, shape (n_pairs, n - 1) [m], and the points that are closer than ``clearance``.
        """
        bounds, found = self.segment_bounds(), ClosePoints.none()
        if bounds.min(initial=np.inf) >= clearance:
            return bounds, found
        low = (bounds < clearance) & (self.distance[:, :-1] >= clearance) & (self.distance[:, 1:] >= clearance)
        for i in np.flatnonzero(low.any(axis=1)).tolist():
            segments = np.flatnonzero(low[i])
            bounds[i, segments], at = self._closer_look(i, segments, bounds[i, segments], clearance)
            close = bounds[i, segments] < clearance
            found = found + ClosePoints(np.full(int(close.sum()), i), segments[close], at[close])
        return bounds, found

    def _closer_look(self, pair: int, j: Index, bounds: Array, clearance: float) -> tuple[Array, Array]:
        """Return refined bounds of a pair on segments ``j``, and the fraction of each segment where it is lowest."""
        start = self.tool.centres(pair, self.positions[j], j)
        step = self.tool.centres(pair, self.positions[j + 1], j + 1) - start
        bow = self.tool.bows[pair % self.tool.n_spheres, j]
        left, right = np.zeros(len(j)), np.ones(len(j))
        f0, f1 = self.distance[pair, j], self.distance[pair, j + 1]
        a = np.einsum("sd,sd->s", self.normal[pair, j], step)
        b = np.einsum("sd,sd->s", self.normal[pair, j + 1], step)
        margin, dt = self.tool.margins[pair // self.tool.n_spheres], self.tool.times[j + 1] - self.tool.times[j]
        if margin is not None:
            a -= margin.slopes_after(self.tool.times[j]) * dt
            b -= margin.slopes_before(self.tool.times[j + 1]) * dt
        low, at = crossing_of_tangents(f0, a, f1, b, 1.0)
        close = np.zeros(len(j), dtype=bool)
        for _ in range(_MAX_PROBES):
            if np.all(close | (low - bow >= clearance)):
                break
            kept = self.tool.margin_between(pair, j, at)
            f, n = self.tool.distance_and_normal(pair, start + at[:, None] * step, kept)
            slope = np.einsum("sd,sd->s", n, step)
            if margin is not None:
                slope -= margin.slopes_after(self.tool.times[j] + at * dt) * dt
            close |= f - bow < clearance
            falls, rises = ~close & (slope <= 0.0), ~close & (slope > 0.0)
            left, f0, a = np.where(falls, (at, f, slope), (left, f0, a))
            right, f1, b = np.where(rises, (at, f, slope), (right, f1, b))
            low, inside = crossing_of_tangents(f0, a, f1, b, right - left)
            at = np.where(close, at, left + inside)
        return np.maximum(bounds, low - bow), at

    def at(self, points: ClosePoints) -> tuple[Array, Array]:
        """Return the distances (m,) [m] and the obstacles' normals (m, 3) at points between the samples."""
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        for i in np.unique(points.pair).tolist():
            of = np.flatnonzero(points.pair == i)
            j, s = points.segment[of], points.fraction[of, None]
            start = self.tool.centres(i, self.positions[j], j)
            step = self.tool.centres(i, self.positions[j + 1], j + 1) - start
            d, normal[of] = self.tool.distance_and_normal(i, start + s * step, self.tool.margin_between(i, j, s[:, 0]))
            distance[of] = d - self.tool.bows[i % self.tool.n_spheres, j]
        return distance, normal


def without_rotation(obstacle: Obstacle) -> Obstacle:
    """Return the obstacle if it does not rotate; otherwise, a sphere about its centre that contains it.

    Raises:
        InputError: when a half-space rotates.
    """
    if not obstacle.angular_velocity.any():
        return obstacle
    if isinstance(obstacle, HalfSpace):
        raise InputError(
            f"adapt: half-space {obstacle.name!r} rotates; a path among rotating half-spaces can't be certified"
        )
    centre = obstacle.solid().position
    corners = np.abs(obstacle.bounds() - centre).max(axis=0)
    return Sphere(centre, float(np.linalg.norm(corners)), velocity=obstacle.velocity, name=obstacle.name)


def crossing_of_tangents(f0: Array, a: Array, f1: Array, b: Array, length: Array | float) -> tuple[Array, Array]:
    """Return the minimum of ``max(f0 + a s, f1 - b (length - s))`` over s in [0, length], and its position s.

    Args:
        f0: values of the convex functions at the start of the interval, any shape.
        a: slopes of the functions at the start.
        f1: values of the functions at the end.
        b: slopes of the functions at the end.
        length: length of the interval, in the unit of s.
    """
    inside = (a < 0.0) & (b > 0.0)
    s = np.minimum(np.maximum((f1 - f0 - b * length) / np.where(inside, a - b, -1.0), 0.0), length)
    low = np.where(a >= 0.0, f0, f1)  # rising from the start, or falling until the end
    crossing = np.maximum(f0 + a * s, f1 + b * (s - length))
    return np.where(inside, crossing, low), np.where(inside, s, np.where(a >= 0.0, 0.0, length))
