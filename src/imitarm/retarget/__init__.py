"""From a person's arm to a robot's arm: one method a file."""

from collections.abc import Mapping

from imitarm.retarget.baselines.adaptive_control import AdaptiveControl
from imitarm.retarget.baselines.demonstration_modification import DemonstrationModification
from imitarm.retarget.baselines.incremental_ik import IncrementalIK
from imitarm.retarget.baselines.thesis import ThesisRetargeter
from imitarm.retarget.correspondence import FACING, Correspondence
from imitarm.retarget.limbs import LimbLengths, measure_limbs
from imitarm.retarget.modern import ModernRetargeter
from imitarm.retarget.retargeter import Retargeter, Retargeting, RetargetStep

RETARGETERS: Mapping[str, type[Retargeter]] = {
    "modern": ModernRetargeter,
    "thesis": ThesisRetargeter,
    "m1": DemonstrationModification,
    "m2": AdaptiveControl,
    "m3": IncrementalIK,
}
"""All methods by name."""

__all__ = [
    "FACING",
    "RETARGETERS",
    "AdaptiveControl",
    "Correspondence",
    "DemonstrationModification",
    "IncrementalIK",
    "LimbLengths",
    "ModernRetargeter",
    "RetargetStep",
    "Retargeter",
    "Retargeting",
    "ThesisRetargeter",
    "measure_limbs",
]
