"""Roadmap: a graph of possible tool positions over time, in which routes around the obstacles are found.

The nodes of the graph are arranged in layers. Each layer belongs to one time on the nominal path. In each layer, rays
in all directions start at the nominal position of this time. The nodes are points on these rays, for example just
outside the obstacles, enlarged by the required clearance. Edges lead from each node to the nodes of the next layer on
the same ray and on neighbouring rays. The cost of an edge grows with the change of the displacement along the edge. It
is much larger if the clearance on the edge is not proven by the tangents at its two ends
(:mod:`~imitarm.policies.certificate`). A narrow gap between obstacles may lie between two rays. If there is no route, a
second roadmap therefore has additional rays that are aimed at gaps. Dynamic programming from both ends computes the
cheapest route through each node. A route is only a proposal, along which the search for the least detour begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import ToolAmongObstacles, crossing_of_tangents
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import MAX_DISPLACEMENT, MAX_STEP_RATIO, AllowedDirections, largest_step

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_LAYERS = 20  # about so many times, and some more next to fixed ones
_NEAR_FIXED = (1, 2, 4, 7)  # samples from a fixed one that are layers too
_RAYS = {1: 2, 2: 16, 3: 42}  # by the number of dimensions in which components may move
_NEIGHBOURS = {1: 2, 2: 5, 3: 8}  # rays to which edges lead, the same one included
_SLOTS = 4  # nodes on a ray
_JUST_OUTSIDE = 3e-4  # [m] between an obstacle and the node next to it
_FARTHER = (0.0, 0.015, 0.05)  # [m] beyond it: round an edge, the straight line between two exits is not free
_PROBED = 3  # layers at which gaps are searched, those with the largest violation
_PROBE_RADII = np.arange(0.04, MAX_DISPLACEMENT, 0.04)  # [m] of the points from which the search starts
_RING = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)  # directions of these points across the path
_PROBE_STEPS = np.geomspace(0.02, 2e-4, 40)  # [m] of the search, away from the obstacles
_NEAREST = 0.004  # [m] obstacles that are farther away than the nearest one by much more than this have no weight
_MAX_AIMED = 12  # rays that are added because they lead into a gap
_AIMED_APART = np.cos(np.radians(8.0))  # cosine of the least angle between them
_RADII = (0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.16, 0.22, 0.28, 0.36, 0.45)  # [m] further candidates for nodes
_APART = (0.0, 0.02, 0.06, 0.12)  # [m] least distance of a node from the one before on its ray
_VIOLATION_COST = 1e5  # [1/m] price of clearance that the tangents of an edge do not prove
_CHANGE_SCALE = 0.02  # [m] a displacement that changes by this much between layers costs as much as one sigma
_DIFFERENT = 0.04  # [m] two routes differ when they are this far apart where the first one failed
_HOPELESS = 0.012  # [m] a cheapest route with an edge that lacks more clearance than this leads to no detour
_BLOCKED = 1e9


class Roadmap:
    """The graph among one set of obstacles, and its cheapest routes.

    Args:
        path: the nominal path and its components.
        tool: the tool and the obstacles.
        clearance: required clearance [m].
        allowed: directions in which components may move.
        aimed: whether to add rays that lead into gaps between the obstacles.

    Attributes:
        layers: index of the path's sample at each layer, shape (n_layers,).
        nodes: displacement of each node from the nominal position, shape (n_layers, n_nodes, 3) [m]. Node 0 of each
            layer is the nominal position.
    """

    def __init__(
        self,
        path: ComponentPath,
        tool: ToolAmongObstacles,
        clearance: float,
        allowed: AllowedDirections,
        *,
        aimed: bool = False,
    ) -> None:
        self.path, self.tool, self.clearance = path, tool, clearance + _JUST_OUTSIDE
        self.layers = self._layers()
        rays, self.pairs_of_nodes = _graph(allowed)
        if aimed and allowed.dimension > 1:
            rays = np.concatenate([rays, self._rays_into_gaps(allowed)])
            self.pairs_of_nodes = _edges(rays, _NEIGHBOURS[allowed.dimension])
        radii, free = self._radii(rays)
        n_layers, n_rays = len(self.layers), len(rays)
        self.nodes = np.zeros((n_layers, 1 + n_rays * _SLOTS, 3))
        self.nodes[:, 1:] = (radii[..., None] * rays[None, :, None, :]).reshape(n_layers, -1, 3)
        fixed = np.isin(self.layers, path.fixed)
        self.exists = np.ones(self.nodes.shape[:2], dtype=bool)
        self.exists[:, 1:] = free.reshape(n_layers, -1) & ~fixed[:, None]
        self.keys, self.costs, self.violations = self._edges_between_layers()

    def routes(self, n: int) -> Iterator[Array]:
        """Yield up to ``n`` routes as displacements of the tip at all samples (n_samples, 3) [m], cheapest first.

        All routes after the first one pass through different nodes of one layer: the layer in which the first route has
        its largest cost.
        """
        through = self._forward[0] + self._backward[0]
        used: list[Array] = []
        at, node = 0, 0
        for _ in range(n):
            chosen = self._through(at, node)
            route = self.nodes[np.arange(len(self.layers)), chosen]
            yield self._at_samples(route)
            used.append(route)
            at = self._worst_layer(chosen) if len(used) == 1 else at
            taken = np.stack([r[at] for r in used])
            apart = np.linalg.norm(self.nodes[at][:, None] - taken[None], axis=-1).min(axis=1) > _DIFFERENT
            costs = np.where(apart, through[at], np.inf)
            node = int(np.argmin(costs))
            if not costs[node] < _BLOCKED:
                return

    def _layers(self) -> Index:
        n = len(self.path.nominal)
        chosen = set(np.round(np.linspace(0, n - 1, min(_LAYERS, n))).astype(int).tolist())
        for fixed in self.path.fixed.tolist():
            chosen |= {fixed, *(fixed + k for k in _NEAR_FIXED), *(fixed - k for k in _NEAR_FIXED)}
        return np.array(sorted(j for j in chosen if 0 <= j < n), dtype=np.intp)

    def _rays_into_gaps(self, allowed: AllowedDirections) -> Array:
        """Return unit directions (m, 3) that lead into gaps near the layers at which the nominal path is blocked.

        Points across the path move away from the nearest obstacles until they are in the middle between obstacles.
        """
        centre = self.path.nominal.positions[self.layers]
        apart = [self.tool.distance(pair, centre, self.layers) for pair in range(self.tool.n_pairs)]
        lowest = np.min(apart, axis=0)
        blocked = np.argsort(lowest)[:_PROBED]
        probed = self.layers[blocked[lowest[blocked] < self.clearance]]
        if not len(probed):
            return np.empty((0, 3))
        starts, across, samples = self._probes(probed, allowed)
        points = starts.copy()
        for step in _PROBE_STEPS:
            distance, normal = self._distances_and_normals(points, samples)
            weight = np.exp((distance.min(axis=0) - distance) / _NEAREST)
            away = allowed.projected(np.einsum("pm,pmd->md", weight, normal))
            away -= np.einsum("md,md->m", away, across)[:, None] * across
            length = np.sqrt(np.einsum("md,md->m", away, away))
            points += away * (step / np.maximum(length, 1e-3))[:, None]
        free = self._distances_and_normals(points, samples)[0].min(axis=0) >= self.clearance
        if not free.any():
            return np.empty((0, 3))
        displacement = allowed.enforced((points - self.path.nominal.positions[samples])[free] @ allowed.axes)
        radius = np.linalg.norm(displacement, axis=1)
        rank = np.empty(len(radius))
        for sample in probed:  # the nearest gap of each layer first
            own = samples[free] == sample
            rank[own] = np.argsort(np.argsort(radius[own]))
        chosen: list[Array] = []
        for i in np.argsort(rank, kind="stable"):
            if len(chosen) == _MAX_AIMED:
                break
            ray = displacement[i] / max(radius[i], 1e-9)
            if radius[i] > _JUST_OUTSIDE and not (chosen and (np.stack(chosen) @ ray).max() > _AIMED_APART):
                chosen.append(ray)
        return np.array(chosen).reshape(-1, 3)

    def _probes(self, probed: Index, allowed: AllowedDirections) -> tuple[Array, Array, Index]:
        """Return the points (m, 3) from which gaps are searched, the path's tangents (m, 3) and samples (m,)."""
        positions = self.path.nominal.positions
        found, tangents, samples = [], [], []
        for sample in probed:
            tangent = positions[min(sample + 1, len(positions) - 1)] - positions[max(sample - 1, 0)]
            tangent = tangent / max(float(np.linalg.norm(tangent)), 1e-12)
            basis = np.linalg.svd(tangent[None])[2][1:]
            ring = np.cos(_RING)[:, None] * basis[0] + np.sin(_RING)[:, None] * basis[1]
            points = positions[sample] + (allowed.unit_directions(ring)[:, None] * _PROBE_RADII[:, None]).reshape(-1, 3)
            found.append(points)
            tangents.append(np.broadcast_to(tangent, points.shape))
            samples.append(np.full(len(points), sample))
        return np.concatenate(found), np.concatenate(tangents), np.concatenate(samples)

    def _distances_and_normals(self, points: Array, samples: Index) -> tuple[Array, Array]:
        """Return the distance (n_pairs, m) [m] of each pair at positions of the tip (m, 3), and its gradient."""
        tool = self.tool
        pairs = [
            tool.distance_and_normal(pair, tool.centres(pair, points, samples), tool.margin(pair, samples))
            for pair in range(tool.n_pairs)
        ]
        return np.stack([distance for distance, _ in pairs]), np.stack([normal for _, normal in pairs])

    def _radii(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the radii (n_layers, n_rays, n_slots) [m] of the nodes, and whether each node exists."""
        centre = self.path.nominal.positions[self.layers]
        shape = (len(centre), len(rays))
        candidates = [np.full(shape, radius) for radius in _RADII]
        for obstacle in range(len(self.tool.obstacles)):
            exits = np.minimum(self._exits(obstacle, centre, rays), 2.0 * MAX_DISPLACEMENT) + _JUST_OUTSIDE
            candidates += [exits + more for more in _FARTHER]
        radius = np.sort(np.stack(candidates, axis=-1), axis=-1)
        free = self._free(centre, rays, radius, np.arange(len(centre)))
        slots, exists, last = np.zeros((*shape, _SLOTS)), np.zeros((*shape, _SLOTS), dtype=bool), np.full(shape, -1.0)
        for s in range(_SLOTS):
            fits = free & (radius > (last + _APART[s])[..., None])
            first = np.argmax(fits, axis=-1)
            exists[..., s] = np.take_along_axis(fits, first[..., None], axis=-1)[..., 0]
            found = np.take_along_axis(radius, first[..., None], axis=-1)[..., 0]
            slots[..., s] = last = np.where(exists[..., s], found, np.maximum(last, 0.0))
        return slots, exists

    def _free(self, centre: Array, rays: Array, radius: Array, layers: Index) -> NDArray[np.bool_]:
        """Return which points at radii (n_layers, n_rays, n_radii) [m] on the rays keep the clearance.

        Args:
            centre: nominal positions at the layers, shape (n_layers, 3) [m].
            rays: unit directions, shape (n_rays, 3).
            radius: radii, shape (n_layers, n_rays, n_radii) [m].
            layers: indices of the layers, shape (n_layers,).
        """
        left = np.flatnonzero(radius <= MAX_DISPLACEMENT)
        points = centre[:, None, None, :] + radius[..., None] * rays[:, None, :]
        points, layer = points.reshape(-1, 3).take(left, axis=0), left // (radius.shape[1] * radius.shape[2])
        for pair in range(self.tool.n_pairs):
            kept = np.flatnonzero(self.tool.distance(pair, points, self.layers[layers[layer]]) >= self.clearance)
            if len(kept) < len(left):
                left, layer, points = left.take(kept), layer.take(kept), points.take(kept, axis=0)
        free = np.zeros(radius.shape, dtype=bool)
        free.reshape(-1)[left] = True
        return free

    def _exits(self, obstacle: int, centre: Array, rays: Array) -> Array:
        """Return the distance at which rays (m, 3) finally leave the inflated obstacle, shape (n_layers, m) [m]."""
        solid, k = self.tool.obstacles[obstacle], self.tool.n_spheres
        answer = np.zeros((len(centre), len(rays)))
        for sphere in range(k):
            points = self.tool.centres(obstacle * k + sphere, centre, self.layers)
            margin = np.broadcast_to(self.tool.margin(obstacle * k + sphere, self.layers), self.layers.shape)
            reach = self.clearance + (self.tool.radii[sphere] + margin) + MAX_DISPLACEMENT
            near = np.flatnonzero(solid.signed_distance(points) < reach)
            if len(near):
                lift = self.tool.exits(obstacle * k + sphere, points[near], rays, self.clearance, 1e-4, margin[near])
                answer[near] = np.maximum(answer[near], lift.T)
        return answer

    def _edges_between_layers(self) -> tuple[Index, Array, Array]:
        """Return the key, the cost and the missing (unproven) clearance [m] of every existing edge, each (n_edges,).

        The key of an edge from node ``i`` of layer ``l`` to node ``j`` of layer ``l + 1`` is ``(l n + i) n + j``, where
        n is the number of nodes in a layer. The keys are sorted.
        """
        start, end = self.pairs_of_nodes
        n_layers, n = self.exists.shape
        both = np.flatnonzero(self.exists[:-1].take(start, axis=1) & self.exists[1:].take(end, axis=1))
        layer = n * np.arange(n_layers - 1)[:, None]
        first, last = (layer + start).take(both), (layer + n + end).take(both)  # as columns of all nodes
        positions = self.path.nominal.positions[self.layers][:, None, :] + self.nodes
        length = _changes(_columns(positions), first, last)
        length = np.sqrt(np.einsum("ke,ke->e", length, length))
        longest = MAX_STEP_RATIO * largest_step(self.path.nominal.positions) * np.diff(self.layers)
        slow = np.flatnonzero(length <= np.repeat(longest, len(start)).take(both))
        first, last, length = first.take(slow), last.take(slow), length.take(slow)
        violation = np.zeros(len(first))
        spread = np.swapaxes(positions, 0, 1)  # (n_nodes, n_layers, 3)
        for pair in range(self.tool.n_pairs):
            centres = np.ascontiguousarray(np.swapaxes(self.tool.centres(pair, spread, self.layers), 0, 1))
            margin = np.broadcast_to(self.tool.margin(pair, self.layers), self.layers.shape)
            growth = np.diff(margin)  # from layer to layer
            distance, normal = self.tool.distance_and_normal(pair, centres, margin[:, None])
            f0, f1 = distance.take(first), distance.take(last)
            offset = self.tool.offsets[pair // self.tool.n_spheres]
            travelled = length
            if offset is not None:
                shift = np.diff(offset[pair % self.tool.n_spheres, self.layers], axis=0)
                travelled = length + np.sqrt(np.einsum("ld,ld->l", shift, shift)).take(first // n)
            travelled = travelled + growth.take(first // n) if growth.any() else travelled
            # The distance changes by at most one metre per metre: an edge as far away as this keeps the clearance.
            near = np.flatnonzero(f0 + f1 - travelled < 2.0 * self.clearance)
            if len(near):
                i, j, normals = first.take(near), last.take(near), _columns(normal)
                step = _changes(_columns(centres), i, j)
                a = np.einsum("ke,ke->e", normals.take(i, axis=1), step)
                b = np.einsum("ke,ke->e", normals.take(j, axis=1), step)
                if growth.any():
                    a, b = a - growth.take(i // n), b - growth.take(i // n)
                low = crossing_of_tangents(f0.take(near), a, f1.take(near), b, 1.0)[0]
                violation[near] = np.maximum(violation.take(near), self.clearance - _JUST_OUTSIDE - low)
        change = _changes(_columns(self.nodes), first, last)
        cost = np.einsum("ke,ke->e", change, change) / _CHANGE_SCALE**2 + _VIOLATION_COST * violation
        edges = (n * layer + n * start + end).take(both)
        return edges.take(slow), cost, violation

    def _sweep(self, *, forward: bool) -> tuple[Array, Index]:
        """Return the cheapest route from the start to each node: its cost, and the node before its last node.

        If ``forward`` is False, the routes lead from each node to the goal; the second result is the node after the
        first node.
        """
        precisions = np.linalg.inv(self.path.tolerance[self.layers] + 0.005**2 * np.eye(3))
        style = np.einsum("lkd,lkd->lk", self.nodes @ precisions, self.nodes) * (
            self.path.n_components / len(self.layers)
        )
        n_layers, n_nodes = self.exists.shape
        edges = np.full((n_layers - 1, n_nodes, n_nodes), _BLOCKED)
        edges.reshape(-1)[self.keys] = self.costs
        cost, via = np.full((n_layers, n_nodes), _BLOCKED), np.zeros((n_layers, n_nodes), dtype=np.intp)
        order = range(n_layers) if forward else range(n_layers - 1, -1, -1)
        cost[order[0], 0] = 0.0
        for before, layer in pairwise(order):
            total = cost[before] + (edges[before].T if forward else edges[layer])
            via[layer] = total.argmin(axis=1)
            cost[layer] = total[np.arange(n_nodes), via[layer]] + style[layer]
        if not forward:  # the style of a node must not count twice
            cost = cost - style
        return cost, via

    def _through(self, at: int, node: int) -> Index:
        """Return the node at each layer of the cheapest route through a given node."""
        chosen = np.zeros(len(self.layers), dtype=np.intp)
        chosen[at] = node
        for layer in range(at, 0, -1):
            chosen[layer - 1] = self._forward[1][layer, chosen[layer]]
        for layer in range(at, len(self.layers) - 1):
            chosen[layer + 1] = self._backward[1][layer, chosen[layer]]
        return chosen

    @cached_property
    def _forward(self) -> tuple[Array, Index]:
        return self._sweep(forward=True)

    @cached_property
    def _backward(self) -> tuple[Array, Index]:
        return self._sweep(forward=False)

    @property
    def is_hopeless(self) -> bool:
        """Whether the roadmap has no route, or its cheapest route comes much too close to an obstacle."""
        if not self._forward[0][-1, 0] < _BLOCKED:
            return True
        edges = self._edges_of(self._through(len(self.layers) - 1, 0))
        return bool(self.violations[edges].max() > _HOPELESS)

    def _edges_of(self, chosen: Index) -> Index:
        """Return the index of the edge that a route of existing edges takes from each layer to the next."""
        n = self.nodes.shape[1]
        keys = (np.arange(len(chosen) - 1) * n + chosen[:-1]) * n + chosen[1:]
        return np.asarray(np.searchsorted(self.keys, keys), dtype=np.intp)

    def _worst_layer(self, chosen: Index) -> int:
        """Return the layer at which a route costs most.

        When all edges of the route are free, the result is the layer with the largest displacement.
        """
        costs = self.costs[self._edges_of(chosen)]
        if costs.max() > 1.0:
            return int(np.clip(np.argmax(costs), 1, len(self.layers) - 2))
        away = np.linalg.norm(self.nodes[np.arange(len(chosen)), chosen], axis=1)
        return int(np.argmax(away))

    def _at_samples(self, route: Array) -> Array:
        samples = np.arange(len(self.path.nominal))
        return np.stack([np.interp(samples, self.layers, column) for column in route.T], axis=1)


def _columns(vectors: Array) -> Array:
    """Return vectors (..., 3) as contiguous columns (3, m), because numpy selects columns of this array faster."""
    return np.ascontiguousarray(vectors.reshape(-1, 3).T)


def _changes(columns: Array, first: Index, last: Index) -> Array:
    """Return the differences (3, e) of two selections of columns (3, m)."""
    change = columns.take(last, axis=1)
    change -= columns.take(first, axis=1)
    return change


@lru_cache(maxsize=8)
def _graph(allowed: AllowedDirections) -> tuple[Array, tuple[Index, Index]]:
    """Return the rays (m, 3), and the start and end node of every edge between two layers."""
    rays = allowed.unit_directions(_spread_directions(allowed))
    return rays, _edges(rays, _NEIGHBOURS.get(allowed.dimension, 1))


def _spread_directions(allowed: AllowedDirections) -> Array:
    """Return unit directions (m, 3) that are spread evenly over the dimensions in which components may move."""
    n = _RAYS.get(allowed.dimension, 0)
    if allowed.dimension == 3:  # points of a spiral on the sphere
        i = np.arange(n)
        z = 1.0 - (2.0 * i + 1.0) / n
        angle = i * np.pi * (3.0 - np.sqrt(5.0))
        flat = np.stack([np.cos(angle), np.sin(angle)]) * np.sqrt(1.0 - z**2)
        return np.concatenate([flat, z[None]]).T
    angle = 2.0 * np.pi * np.arange(n) / max(n, 1)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, : allowed.dimension]
    return flat @ allowed.axes.T


def _edges(rays: Array, n_neighbours: int) -> tuple[Index, Index]:
    """Return the start and end node of every edge between two layers.

    The edges lead from the nominal node to all nodes, and from each ray to its neighbours.
    """
    n = 1 + len(rays) * _SLOTS
    ray_of = np.concatenate([[-1], np.repeat(np.arange(len(rays)), _SLOTS)])
    near = np.zeros((len(rays), len(rays)), dtype=bool)
    if len(rays):
        closest = np.argsort(-(rays @ rays.T), axis=1)[:, :n_neighbours]
        near[np.arange(len(rays))[:, None], closest] = True
        near |= near.T
    joined = np.ones((n, n), dtype=bool)
    joined[1:, 1:] = near[ray_of[1:, None], ray_of[None, 1:]]
    start, end = np.nonzero(joined)
    return start.astype(np.intp), end.astype(np.intp)
