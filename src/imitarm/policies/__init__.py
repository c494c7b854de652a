"""Policies: methods that reproduce a skill around obstacles, with one file for each method.

To add a policy, write a file with its class and add one line to the registry ``POLICIES`` below.
"""

from imitarm.policies.acfra import ACFRA
from imitarm.policies.adaptation import ADAPTERS, HORIZONTAL_ONLY, NOT_DOWN, adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.certified_replanning import CertifiedRCAMO
from imitarm.policies.least_cost import LeastCost
from imitarm.policies.least_detour import PathAdapter
from imitarm.policies.obstacle_cost import DistanceCost, GaussianCost, ObstacleCost
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.policies.plan_in_execution import PlanInExecution
from imitarm.policies.policy import Observation, Policy
from imitarm.policies.primitive_path import PrimitivePath
from imitarm.policies.rcamo import RCAMO
from imitarm.policies.replanning import replan
from imitarm.policies.stages import Stage, StagedPolicy
from imitarm.policies.stopping import Stop, certified_stop
from imitarm.registry import Registry

POLICIES: Registry[type[Policy]] = Registry(
    "policy",
    "imitarm.policies",
    {
        "acfra": "imitarm.policies.acfra:ACFRA",
        "rcamo": "imitarm.policies.rcamo:RCAMO",
        "rcamo-certified": "imitarm.policies.certified_replanning:CertifiedRCAMO",
        "apf": "imitarm.policies.baselines.apf:APF",
        "dmp-steering": "imitarm.policies.baselines.dmp_steering:DMPSteering",
        "dmp-potential": "imitarm.policies.baselines.dmp_potential:DMPPotential",
        "gmm-dmp": "imitarm.policies.baselines.gmm_dmp:GMMDMP",
        "dmp-ann": "imitarm.policies.baselines.dmp_ann:DMPANN",
        "dmp-barrier": "imitarm.policies.baselines.dmp_barrier:DMPBarrier",
        "stop-only": "imitarm.policies.baselines.stop_only:StopOnly",
        "barrier": "imitarm.policies.baselines.barrier:Barrier",
        "elastic-band": "imitarm.policies.baselines.elastic_band:ElasticBand",
        "gmm-irl": "imitarm.policies.baselines.gmm_irl:GmmIrl",
        "tp-gmm": "imitarm.policies.baselines.tp_gmm:TPGMM",
        "modulation": "imitarm.policies.baselines.modulation:Modulation",
        "rrt-connect": "imitarm.policies.baselines.joint_planner:RRTConnect",
        "rrt-connect-tilt": "imitarm.policies.baselines.joint_planner:TiltLimitedRRTConnect",
    },
)
"""Registry of all policies: the class of each policy by its name."""

__all__ = [
    "ACFRA",
    "ADAPTERS",
    "HORIZONTAL_ONLY",
    "NOT_DOWN",
    "POLICIES",
    "RCAMO",
    "Adaptation",
    "CertifiedRCAMO",
    "DistanceCost",
    "GaussianCost",
    "LeastCost",
    "Observation",
    "ObstacleCost",
    "PathAdapter",
    "PathPlan",
    "PathPolicy",
    "PlanInExecution",
    "Policy",
    "PrimitivePath",
    "Stage",
    "StagedPolicy",
    "Stop",
    "adapt",
    "certified_stop",
    "replan",
]
