"""How near the arm is to the obstacles, measured by the simulator's own geometry and not by the planner's."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FAR = 100.0  # [m] farther pairs are not measured


class ClearanceGauge:
    """Smallest distance between two groups of geoms, and the pair that has it.

    Bounding spheres come first: the centres' distance less both radii is a lower bound of a pair's distance.
    Pairs are then measured by ``mj_geomDistance``, nearest bound first, until the next bound exceeds the smallest
    distance found. So most pairs cost nothing.

    Args:
        model: the compiled world.
        arm_geoms: ids of the first group's geoms.
        obstacle_geoms: ids of the second group's geoms.
    """

    def __init__(self, model: mujoco.MjModel, arm_geoms: Sequence[int], obstacle_geoms: Sequence[int]) -> None:
        self._model = model
        self._arm = np.array(arm_geoms, dtype=np.intp)
        self._obstacles = np.array(obstacle_geoms, dtype=np.intp)
        bounding = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, np.inf, model.geom_rbound)
        self._radii = bounding[self._arm][:, None] + bounding[self._obstacles][None]
        self._group = np.zeros(model.ngeom, dtype=np.int8)
        self._group[self._arm], self._group[self._obstacles] = 1, 2
        self._from_to = np.zeros(6)

    def measure(self, data: mujoco.MjData) -> tuple[float, tuple[int, int] | None]:
        """Return the smallest signed distance [m], negative in contact, and the ids of the two geoms.

        Without obstacles, or when all are farther than 100 m: inf and None.
        """
        if not self._radii.size:
            return np.inf, None
        apart = data.geom_xpos[self._arm][:, None] - data.geom_xpos[self._obstacles][None]
        bounds = (np.sqrt(np.einsum("ijk,ijk->ij", apart, apart)) - self._radii).ravel()
        smallest, pair = _FAR, None
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
        """Return the pairs (arm geom, obstacle geom) that the contact solver has in contact now."""
        if not data.ncon or not self._radii.size:
            return set()
        geoms = data.contact.geom
        both = self._group[geoms].sum(axis=1) == 3
        if not both.any():
            return set()
        ordered = np.where(self._group[geoms[both, :1]] == 1, geoms[both], geoms[both][:, ::-1])
        return {(int(a), int(b)) for a, b in ordered}
