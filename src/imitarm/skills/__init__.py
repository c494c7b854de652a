"""What is learnt from demonstrations; knows nothing of obstacles."""

from __future__ import annotations

from imitarm.skills.dmp import DMP
from imitarm.skills.dmp_state import DMPState
from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture, ellipsoid_scale
from imitarm.skills.gmr import GMR
from imitarm.skills.quaternion_dmp import QuaternionDMP
from imitarm.skills.rhythmic_dmp import RhythmicDMP
from imitarm.skills.samples import SingleDemonstrationWarning, UnalignedWarning
from imitarm.skills.skill import Skill
from imitarm.skills.spring import GAINS, Gains

__all__ = [
    "DMP",
    "GAINS",
    "GMR",
    "DMPState",
    "DegenerateAxisWarning",
    "Gains",
    "GaussianMixture",
    "QuaternionDMP",
    "RhythmicDMP",
    "SingleDemonstrationWarning",
    "Skill",
    "UnalignedWarning",
    "ellipsoid_scale",
]
