"""From a person's arm to a robot's arm: one method a file."""

from collections.abc import Mapping

from imitarm.retarget.correspondence import FACING, Correspondence
from imitarm.retarget.limbs import LimbLengths, measure_limbs
from imitarm.retarget.modern import ModernRetargeter
from imitarm.retarget.retargeter import Command, Retargeter, Retargeting, retarget
from imitarm.retarget.thesis import ThesisRetargeter

RETARGETERS: Mapping[str, type[Retargeter]] = {"modern": ModernRetargeter, "thesis": ThesisRetargeter}
"""All methods by name."""

__all__ = [
    "FACING",
    "RETARGETERS",
    "Command",
    "Correspondence",
    "LimbLengths",
    "ModernRetargeter",
    "Retargeter",
    "Retargeting",
    "ThesisRetargeter",
    "measure_limbs",
    "retarget",
]
