"""Clearance rows as a function, until its callers use :class:`~imitarm.scene.clearance_limit.ClearanceLimit`."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.scene.clearance_limit import ClearanceLimit
from imitarm.scene.scene import Scene

Array = NDArray[np.float64]


def clearance_rows(arm: ArmModel, q: ArrayLike, scene: Scene, clearance: float) -> tuple[Array, Array] | None:
    """Return ``ClearanceLimit(arm, clearance).rows(q, scene)``."""
    return _limit(arm, clearance).rows(q, scene)


@lru_cache(maxsize=8)
def _limit(arm: ArmModel, clearance: float) -> ClearanceLimit:
    return ClearanceLimit(arm, clearance)
