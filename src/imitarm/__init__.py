"""Teach industrial robot arms by showing.

The public names are re-exported here and imported when first used, so that ``import imitarm`` stays quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from imitarm.errors import ImitarmError
    from imitarm.kinematics.pose import Pose
    from imitarm.trajectory import Demonstration, Rollout, Trajectory

__version__ = "0.1.0"
__all__ = ["Demonstration", "ImitarmError", "Pose", "Rollout", "Trajectory"]

_HOME = {
    "Demonstration": "imitarm.trajectory",
    "ImitarmError": "imitarm.errors",
    "Pose": "imitarm.kinematics.pose",
    "Rollout": "imitarm.trajectory",
    "Trajectory": "imitarm.trajectory",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'imitarm' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
