"""Retargeting: convert the motion of a human arm to the motion of a robot arm.

:data:`RETARGETERS` lists the built-in methods and the methods of other packages.
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
"""All methods by name.

Other packages add methods under the entry-point group ``imitarm.retargeters``.
Methods of other packages then appear in all commands that take a retargeting method, and in the reports.
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
