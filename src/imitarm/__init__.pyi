from .capture import SOURCES, Skeleton, SkeletonSource
from .command import Command, Status
from .control_loop import reproduce
from .demonstrations import Finding, align, lint, read
from .errors import ImitarmError, InfeasibleError, InputError, TaskFailedError, UnreachableError
from .kinematics.arm import ArmModel, ArmState
from .kinematics.arm_kinematics import find_posture
from .kinematics.ik import IKSolver, solve_ik
from .kinematics.limits import JointLimits, singularity_limits
from .kinematics.pose import Pose
from .kinematics.tasks import ElbowTask, JointVelocityTask, PostureTask, TwistTask
from .policies import ACFRA, HORIZONTAL_ONLY, NOT_DOWN, POLICIES, Adaptation, Observation, Policy, adapt, replan
from .retarget import RETARGETERS, Correspondence, Retargeter
from .robots import Robot, SimulatedRobot
from .safety import SafetyFilter
from .scene import (
    Box,
    Capsule,
    Cone,
    ConvexHull,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Obstacle,
    Scene,
    Sphere,
    load_scene,
    save_scene,
)
from .skills import DMP, GMR, GaussianMixture, Skill
from .trajectory import Demonstration, Rollout, Trajectory
from .viewer.plot import plot

__version__: str
__all__ = [
    "ACFRA",
    "DMP",
    "GMR",
    "HORIZONTAL_ONLY",
    "NOT_DOWN",
    "POLICIES",
    "RETARGETERS",
    "SOURCES",
    "Adaptation",
    "ArmModel",
    "ArmState",
    "Box",
    "Capsule",
    "Command",
    "Cone",
    "ConvexHull",
    "Correspondence",
    "Cylinder",
    "Demonstration",
    "ElbowTask",
    "Ellipsoid",
    "Finding",
    "GaussianMixture",
    "HalfSpace",
    "IKSolver",
    "ImitarmError",
    "InfeasibleError",
    "InputError",
    "JointLimits",
    "JointVelocityTask",
    "Observation",
    "Obstacle",
    "Policy",
    "Pose",
    "PostureTask",
    "Retargeter",
    "Robot",
    "Rollout",
    "SafetyFilter",
    "Scene",
    "SimulatedRobot",
    "Skeleton",
    "SkeletonSource",
    "Skill",
    "Sphere",
    "Status",
    "TaskFailedError",
    "Trajectory",
    "TwistTask",
    "UnreachableError",
    "adapt",
    "align",
    "find_posture",
    "lint",
    "load_scene",
    "plot",
    "read",
    "replan",
    "reproduce",
    "save_scene",
    "singularity_limits",
    "solve_ik",
]
