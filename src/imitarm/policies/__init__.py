"""How a skill is reproduced around obstacles, one method a file.

``POLICIES`` is the registry: a new method is one file and one line here.
"""

from imitarm.policies.acfra import ACFRA
from imitarm.policies.adaptation import HORIZONTAL_ONLY, METHODS, NOT_DOWN, Adaptation, adapt
from imitarm.policies.policy import Observation, Policy

POLICIES: dict[str, type[Policy]] = {"acfra": ACFRA}

__all__ = [
    "ACFRA",
    "HORIZONTAL_ONLY",
    "METHODS",
    "NOT_DOWN",
    "POLICIES",
    "Adaptation",
    "Observation",
    "Policy",
    "adapt",
]
