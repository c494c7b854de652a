"""Retargeting: convert the motion of a human arm to the motion of a robot arm.

The registry :data:`RETARGETERS` contains the methods of this package and of other packages.
"""

from imitarm.registry import Registry
from imitarm.retarget.correspondence import FACING, Correspondence
from imitarm.retarget.engagement import EngagementRule, EngagementState
from imitarm.retarget.limbs import LimbLengths, measure_limbs
from imitarm.retarget.modern import ModernRetargeter
from imitarm.retarget.retargeter import Goal, Retargeter, Retargeting, RetargetStep

RETARGETERS: Registry[type[Retargeter]] = Registry(
    "retargeting method",
    "imitarm.retargeters",
    {
        "modern": "imitarm.retarget.modern:ModernRetargeter",
        "thesis": "imitarm.retarget.baselines.thesis:ThesisRetargeter",
        "m1": "imitarm.retarget.baselines.demonstration_modification:DemonstrationModification",
        "m2": "imitarm.retarget.baselines.adaptive_control:AdaptiveControl",
        "m3": "imitarm.retarget.baselines.incremental_ik:IncrementalIK",
    },
)
"""Registry of all retargeting methods: the class of each method by its name.

Another package adds a method by an entry point of the group ``imitarm.retargeters``. The method then appears in all
commands that take a retargeting method, and in their reports.
"""

__all__ = [
    "FACING",
    "RETARGETERS",
    "Correspondence",
    "EngagementRule",
    "EngagementState",
    "Goal",
    "LimbLengths",
    "ModernRetargeter",
    "RetargetStep",
    "Retargeter",
    "Retargeting",
    "measure_limbs",
]
