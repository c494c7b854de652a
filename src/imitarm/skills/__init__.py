"""Skills: motions learned from demonstrations. A skill contains no obstacles; a policy avoids obstacles."""

from __future__ import annotations

from imitarm.skills.dmp import DMP, DMPState
from imitarm.skills.dynamical_systems import GAINS, Gains
from imitarm.skills.fit_quality import DemonstrationDistance, FitQuality, PoorFitWarning
from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture, ellipsoid_scale
from imitarm.skills.gmr import GMR, SingleDemonstrationWarning, UnalignedWarning
from imitarm.skills.rhythmic_dmp import RhythmicDMP
from imitarm.skills.rotations import QuaternionDMP
from imitarm.skills.skill import Skill

__all__ = [
    "DMP",
    "GAINS",
    "GMR",
    "DMPState",
    "DegenerateAxisWarning",
    "DemonstrationDistance",
    "FitQuality",
    "Gains",
    "GaussianMixture",
    "PoorFitWarning",
    "QuaternionDMP",
    "RhythmicDMP",
    "SingleDemonstrationWarning",
    "Skill",
    "UnalignedWarning",
    "ellipsoid_scale",
]
