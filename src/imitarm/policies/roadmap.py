"""A roadmap of displacements over time: possible positions of the tool at each time, and connections between them.

At some times along the nominal path (layers), rays start at the nominal position. On each ray, the points just outside
the
inflated obstacles are the nodes. Edges lead from each node to the nodes of the next layer on the same and on
neighbouring rays. The cost of an edge is the change of the displacement, plus a large amount where the two tangents at
its ends do not prove the clearance. Dynamic programming from both ends gives the cheapest route through every node at
once. A route is only a proposal: the least detour takes its tangents along it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.certificate import ToolAmongObstacles, crossing_of_tangents
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import MAX_DISPLACEMENT, MAX_STEP_RATIO, AllowedDirections

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_LAYERS = 20  # about so many times, and some more next to fixed ones
_NEAR_FIXED = (1, 2, 4, 7)  # samples from a fixed one that are layers too
_RAYS = {1: 2, 2: 16, 3: 42}  # by the number of dimensions in which components may move
_NEIGHBOURS = {1: 2, 2: 5, 3: 8}  # rays to which edges lead, the same one included
_SLOTS = 4  # nodes on a ray
_JUST_OUTSIDE = 3e-4  # [m] between an obstacle and the node next to it
_FARTHER = (0.0, 0.015, 0.05)  # [m] beyond it: round an edge, the straight line between two exits is not free
_RADII = (0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.16, 0.22, 0.28, 0.36, 0.45)  # [m] further candidates for nodes
_APART = (0.0, 0.02, 0.06, 0.12)  # [m] least distance of a node from the one before on its ray
_VIOLATION_COST = 1e5  # [1/m] price of clearance that the tangents of an edge do not prove
_CHANGE_SCALE = 0.02  # [m] a displacement that changes by this much between layers costs as much as one sigma
_DIFFERENT = 0.04  # [m] two routes differ when they are this far apart where the first one failed
_BLOCKED = 1e9


class Roadmap:
    """Nodes, edges and the cheapest routes among one set of obstacles.

    Attributes:
        layers: samples of the path that are layers, shape (n_layers,).
        nodes: displacements of the nominal positions, shape (n_layers, n_nodes, 3) [m]; node 0 is the nominal position.
    """

    def __init__(
        self, path: ComponentPath, tool: ToolAmongObstacles, clearance: float, allowed: AllowedDirections
    ) -> None:
        self.path, self.tool, self.clearance = path, tool, clearance + _JUST_OUTSIDE
        self.layers = self._layers()
        rays = allowed.unit_directions(_spread_directions(allowed))
        radii, free = self._radii(rays)
        n_layers, n_rays = len(self.layers), len(rays)
        self.nodes = np.zeros((n_layers, 1 + n_rays * _SLOTS, 3))
        self.nodes[:, 1:] = (radii[..., None] * rays[None, :, None, :]).reshape(n_layers, -1, 3)
        fixed = np.isin(self.layers, path.fixed)
        self.exists = np.ones(self.nodes.shape[:2], dtype=bool)
        self.exists[:, 1:] = free.reshape(n_layers, -1) & ~fixed[:, None]
        self.pairs_of_nodes = _edges(rays, _NEIGHBOURS.get(allowed.dimension, 1))
        self.edge_costs, self.violations = self._edges_between_layers()

    def routes(self, n: int) -> Iterator[Array]:
        """Yield up to ``n`` routes as displacements of the tip at all samples (n_samples, 3) [m], cheapest first.

        Each further route goes through another node of the layer in which the previous routes came closest to an
        obstacle.
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

    def _radii(self, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return radii (n_layers, n_rays, n_slots) [m] of nodes, and which of them exist."""
        centre = self.path.nominal.positions[self.layers]
        shape = (len(centre), len(rays))
        candidates = [np.full(shape, radius) for radius in _RADII]
        for obstacle in range(len(self.tool.obstacles)):
            exits = np.minimum(self._exits(obstacle, centre, rays), 2.0 * MAX_DISPLACEMENT) + _JUST_OUTSIDE
            candidates += [exits + more for more in _FARTHER]
        radius = np.sort(np.stack(candidates, axis=-1), axis=-1)
        points = centre[:, None, None, :] + radius[..., None] * rays[None, :, None, :]
        spread = np.moveaxis(points, 0, -2)  # the layers last but one, as distances() wants them
        free = np.moveaxis(self.tool.distances(spread, self.layers).min(axis=0), -1, 0) >= self.clearance
        free &= radius <= MAX_DISPLACEMENT
        slots, exists, last = np.zeros((*shape, _SLOTS)), np.zeros((*shape, _SLOTS), dtype=bool), np.full(shape, -1.0)
        for s in range(_SLOTS):
            fits = free & (radius > (last + _APART[s])[..., None])
            first = np.argmax(fits, axis=-1)
            exists[..., s] = np.take_along_axis(fits, first[..., None], axis=-1)[..., 0]
            found = np.take_along_axis(radius, first[..., None], axis=-1)[..., 0]
            slots[..., s] = last = np.where(exists[..., s], found, np.maximum(last, 0.0))
        return slots, exists

    def _exits(self, obstacle: int, centre: Array, rays: Array) -> Array:
        """Return the distance at which rays (m, 3) finally leave the inflated obstacle, shape (n_layers, m) [m]."""
        solid, k = self.tool.obstacles[obstacle], self.tool.n_spheres
        answer = np.zeros((len(centre), len(rays)))
        for sphere in range(k):
            points = self.tool.centres(obstacle * k + sphere, centre, self.layers)
            reach = self.clearance + self.tool.radii[sphere] + MAX_DISPLACEMENT
            near = np.flatnonzero(solid.signed_distance(points) < reach)
            if len(near):
                lift = self.tool.exits(obstacle * k + sphere, points[near], rays, self.clearance, 1e-4)
                answer[near] = np.maximum(answer[near], lift.T)
        return answer

    def _edges_between_layers(self) -> tuple[Array, Array]:
        """Return the cost and the missing (unproven) clearance [m] of every edge, shapes (n_layers - 1, n_edges)."""
        start, end = self.pairs_of_nodes
        positions = self.path.nominal.positions[self.layers][:, None, :] + self.nodes
        spread = np.swapaxes(positions, 0, 1)  # (n_nodes, n_layers, 3)
        violation = np.zeros((len(self.layers) - 1, len(start)))
        for pair in range(self.tool.n_pairs):
            centres = np.swapaxes(self.tool.centres(pair, spread, self.layers), 0, 1)
            d, n = self.tool.distance_and_normal(pair, centres)
            if d.min() > self.clearance + 2.0 * MAX_DISPLACEMENT:
                continue
            own = np.einsum("lkd,lkd->lk", n, centres)
            a = (n[:-1] @ np.swapaxes(centres[1:], 1, 2))[:, start, end] - own[:-1, start]
            b = own[1:, end] - (centres[:-1] @ np.swapaxes(n[1:], 1, 2))[:, start, end]
            low = crossing_of_tangents(d[:-1, start], a, d[1:, end], b, 1.0)[0]
            np.maximum(violation, self.clearance - _JUST_OUTSIDE - low, out=violation)
        change = self.nodes[1:, end] - self.nodes[:-1, start]
        cost = np.einsum("led,led->le", change, change) / _CHANGE_SCALE**2 + _VIOLATION_COST * violation
        step = positions[1:, end] - positions[:-1, start]
        steps = np.diff(self.path.nominal.positions, axis=0)
        longest = MAX_STEP_RATIO * float(np.sqrt(np.einsum("nd,nd->n", steps, steps).max()))
        too_fast = np.einsum("led,led->le", step, step) > (longest * np.diff(self.layers)[:, None]) ** 2
        missing = ~(self.exists[:-1, start] & self.exists[1:, end])
        return np.where(too_fast | missing, _BLOCKED, cost), violation

    def _sweep(self, *, forward: bool) -> tuple[Array, Index]:
        """Return the lowest cost from the start to each node (or from it to the goal), and the adjacent node."""
        precisions = np.linalg.inv(self.path.tolerance[self.layers] + 0.005**2 * np.eye(3))
        style = np.einsum("lkd,lde,lke->lk", self.nodes, precisions, self.nodes) * (
            self.path.n_components / len(self.layers)
        )
        n_layers, n_nodes = self.exists.shape
        start, end = self.pairs_of_nodes if forward else self.pairs_of_nodes[::-1]
        order = np.argsort(end, kind="stable")
        first = np.searchsorted(end[order], np.arange(n_nodes))
        cost, via = np.full((n_layers, n_nodes), _BLOCKED), np.zeros((n_layers, n_nodes), dtype=np.intp)
        layers = range(n_layers) if forward else range(n_layers - 1, -1, -1)
        before: int | None = None
        for layer in layers:
            if before is None:
                cost[layer, 0] = 0.0
            else:
                edges = self.edge_costs[before if forward else layer][order]
                total = cost[before][start[order]] + edges
                least = np.minimum.reduceat(total, first)
                is_least = np.flatnonzero(total == least[end[order]])
                via[layer, end[order][is_least]] = start[order][is_least]
                cost[layer] = least + style[layer]
            before = layer
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

    def violation(self) -> float:
        """Return the largest missing clearance of an edge of the cheapest route [m]; inf when there is no route."""
        if not self._forward[0][-1, 0] < _BLOCKED:
            return np.inf
        edges = self._edges_of(self._through(len(self.layers) - 1, 0))
        return float(self.violations[np.arange(len(edges)), edges].max())

    def _edges_of(self, chosen: Index) -> Index:
        """Return the index of the edge that a route takes from each layer to the next."""
        n = self.nodes.shape[1]
        keys = self.pairs_of_nodes[0] * n + self.pairs_of_nodes[1]  # sorted
        return np.asarray(np.searchsorted(keys, chosen[:-1] * n + chosen[1:]), dtype=np.intp)

    def _worst_layer(self, chosen: Index) -> int:
        """Return the layer at which a route costs most.

        When all of its edges are free, the layer with the largest displacement.
        """
        edges = self._edges_of(chosen)
        costs = self.edge_costs[np.arange(len(edges)), edges]
        if costs.max() > 1.0:
            return int(np.clip(np.argmax(costs), 1, len(self.layers) - 2))
        away = np.linalg.norm(self.nodes[np.arange(len(chosen)), chosen], axis=1)
        return int(np.argmax(away))

    def _at_samples(self, route: Array) -> Array:
        samples = np.arange(len(self.path.nominal))
        return np.stack([np.interp(samples, self.layers, column) for column in route.T], axis=1)


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

    From the nominal node to all nodes, and from each ray to its neighbours.
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
