"""What is learnt from demonstrations; knows nothing of obstacles."""

from __future__ import annotations

from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture, ellipsoid_scale
from imitarm.skills.gmr import GMR, SingleDemonstrationWarning, UnalignedWarning

__all__ = [
    "GMR",
    "DegenerateAxisWarning",
    "GaussianMixture",
    "SingleDemonstrationWarning",
    "UnalignedWarning",
    "ellipsoid_scale",
]
