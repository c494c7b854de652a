"""How near the arm is to the obstacles, measured by the simulator's own geometry and not by the planner's."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FAR = 100.0  # [m] farther pairs are not measured


class ClearanceGauge:
    """Smallest distance from an arm to obstacles, and what touches what, from the simulator's geoms.

    Bounding spheres come first: the distance between centres less both radii is a lower bound of a pair's distance.
    Pairs are then measured by ``mj_geomDistance``, nearest bound first, until the next bound exceeds the smallest
    distance found. So most pairs cost nothing.

    Args:
        model: the compiled world.
        arm_geoms: ids of the geoms of arm and tool.
        obstacle_geoms: ids of the geoms whose distance is measured.
        fixture_geoms: ids of geoms that count for contact only: what the arm stands on.
        links: for each arm geom how many of the arm's joints move it. Two geoms with different numbers that touch are
            a self-contact; None for no self-contacts.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        arm_geoms: Sequence[int],
        obstacle_geoms: Sequence[int],
        fixture_geoms: Sequence[int] = (),
        links: Sequence[int] | None = None,
    ) -> None:
        self._model = model
        self._arm = np.array(arm_geoms, dtype=np.intp)
        self._obstacles = np.array(obstacle_geoms, dtype=np.intp)
        bounding = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, np.inf, model.geom_rbound)
        self._radii = bounding[self._arm][:, None] + bounding[self._obstacles][None]
        self._other = np.zeros(model.ngeom, dtype=bool)
        self._other[self._obstacles] = True
        self._other[np.array(fixture_geoms, dtype=np.intp)] = True
        self._link = np.full(model.ngeom, -1)  # -1: not a geom of the arm
        self._link[self._arm] = 0 if links is None else links
        self._by_design: set[tuple[int, int]] = set()
        self._from_to = np.zeros(6)

    def ignore_present_self_contacts(self, data: mujoco.MjData) -> None:
        """Take the pairs of links that touch now for overlaps of the model, as neighbours have in some files."""
        self._by_design = {(first, second) for _, first, second in self._self_contacts(data)}

    def measure(self, data: mujoco.MjData) -> tuple[float, tuple[int, int] | None]:
        """Return the smallest signed distance [m], negative in contact, and the ids of the two geoms.

        A self-contact counts with its depth. Without obstacles, or when all are farther than 100 m: inf and None.
        """
        smallest, pair = _FAR, None
        for depth, first, second in self._self_contacts(data):
            if depth < smallest:
                smallest, pair = depth, (first, second)
        if self._radii.size:
            apart = data.geom_xpos[self._arm][:, None] - data.geom_xpos[self._obstacles][None]
            bounds = (np.sqrt(np.einsum("ijk,ijk->ij", apart, apart)) - self._radii).ravel()
            for flat in np.argsort(bounds):
                if bounds[flat] >= smallest:
                    break
                i, j = divmod(int(flat), len(self._obstacles))
                first, second = int(self._arm[i]), int(self._obstacles[j])
                distance = mujoco.mj_geomDistance(self._model, data, first, second, smallest, self._from_to)
                if distance < smallest:
                    smallest, pair = distance, (first, second)
        return (smallest, pair) if pair is not None else (np.inf, None)

    def touching(self, data: mujoco.MjData) -> set[tuple[int, int]]:
        """Return the pairs of geoms in contact now: arm and obstacle, arm and fixture, arm and arm (lower id first)."""
        if not data.ncon:
            return set()
        geoms = data.contact.geom
        pairs: set[tuple[int, int]] = set()
        for first, second in (geoms.T, geoms.T[::-1]):
            hits = (self._link[first] >= 0) & self._other[second]
            pairs.update(zip(first[hits].tolist(), second[hits].tolist(), strict=True))
        return pairs | {(first, second) for _, first, second in self._self_contacts(data)}

    def _self_contacts(self, data: mujoco.MjData) -> list[tuple[float, int, int]]:
        """Return depth (negative) [m] and geoms of each contact between two links of the arm."""
        if not data.ncon:
            return []
        geoms = data.contact.geom
        first, second = self._link[geoms[:, 0]], self._link[geoms[:, 1]]
        hits = (first >= 0) & (second >= 0) & (first != second)
        if not hits.any():
            return []
        pairs = np.sort(geoms[hits], axis=1).tolist()
        found = zip(data.contact.dist[hits].tolist(), pairs, strict=True)
        return [(depth, a, b) for depth, (a, b) in found if (a, b) not in self._by_design]
