"""Teach industrial robot arms by showing.

The public names are re-exported here and imported when first used, so that ``import imitarm`` stays quick.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from inspect import Signature

    from imitarm.benchmark.experiment import Experiment, Result
    from imitarm.capture import Skeleton, SkeletonSource
    from imitarm.demonstrations import Finding, align, lint, read
    from imitarm.errors import ImitarmError, InfeasibleError, InputError, TaskFailedError, UnreachableError
    from imitarm.kinematics.arm import ArmModel, ArmState
    from imitarm.kinematics.ik import find_posture, solve_ik
    from imitarm.kinematics.pose import Pose
    from imitarm.policies import ACFRA, HORIZONTAL_ONLY, NOT_DOWN, POLICIES, Adaptation, Observation, Policy, adapt
    from imitarm.reproduce import reproduce
    from imitarm.retarget import RETARGETERS, Correspondence, Retargeter, retarget
    from imitarm.robots import Robot, SimulatedRobot
    from imitarm.scene import (
        Box,
        Capsule,
        Cone,
        ConvexHull,
        Cylinder,
        Ellipsoid,
        Obstacle,
        Scene,
        Sphere,
        load_scene,
        save_scene,
    )
    from imitarm.skills import DMP, GMR, GaussianMixture, Skill
    from imitarm.trajectory import Demonstration, Rollout, Trajectory

__version__ = "0.1.0"
__all__ = [
    "ACFRA",
    "DMP",
    "GMR",
    "HORIZONTAL_ONLY",
    "NOT_DOWN",
    "POLICIES",
    "RETARGETERS",
    "Adaptation",
    "ArmModel",
    "ArmState",
    "Box",
    "Capsule",
    "Cone",
    "ConvexHull",
    "Correspondence",
    "Cylinder",
    "Demonstration",
    "Ellipsoid",
    "Experiment",
    "Finding",
    "GaussianMixture",
    "ImitarmError",
    "InfeasibleError",
    "InputError",
    "Observation",
    "Obstacle",
    "Policy",
    "Pose",
    "Result",
    "Retargeter",
    "Robot",
    "Rollout",
    "Scene",
    "SimulatedRobot",
    "Skeleton",
    "SkeletonSource",
    "Skill",
    "Sphere",
    "TaskFailedError",
    "Trajectory",
    "UnreachableError",
    "adapt",
    "align",
    "find_posture",
    "lint",
    "load_scene",
    "read",
    "reproduce",
    "retarget",
    "save_scene",
    "solve_ik",
]

_HOME = {
    "ACFRA": "imitarm.policies",
    "Adaptation": "imitarm.policies",
    "ArmModel": "imitarm.kinematics.arm",
    "ArmState": "imitarm.kinematics.arm",
    "Box": "imitarm.scene",
    "Capsule": "imitarm.scene",
    "Cone": "imitarm.scene",
    "ConvexHull": "imitarm.scene",
    "Correspondence": "imitarm.retarget",
    "Cylinder": "imitarm.scene",
    "DMP": "imitarm.skills",
    "Demonstration": "imitarm.trajectory",
    "Ellipsoid": "imitarm.scene",
    "Experiment": "imitarm.benchmark.experiment",
    "Finding": "imitarm.demonstrations",
    "GMR": "imitarm.skills",
    "GaussianMixture": "imitarm.skills",
    "HORIZONTAL_ONLY": "imitarm.policies",
    "ImitarmError": "imitarm.errors",
    "InfeasibleError": "imitarm.errors",
    "InputError": "imitarm.errors",
    "NOT_DOWN": "imitarm.policies",
    "Observation": "imitarm.policies",
    "Obstacle": "imitarm.scene",
    "POLICIES": "imitarm.policies",
    "Policy": "imitarm.policies",
    "Pose": "imitarm.kinematics.pose",
    "RETARGETERS": "imitarm.retarget",
    "Result": "imitarm.benchmark.experiment",
    "Retargeter": "imitarm.retarget",
    "Robot": "imitarm.robots",
    "Rollout": "imitarm.trajectory",
    "Scene": "imitarm.scene",
    "SimulatedRobot": "imitarm.robots",
    "Skeleton": "imitarm.capture",
    "SkeletonSource": "imitarm.capture",
    "Skill": "imitarm.skills",
    "Sphere": "imitarm.scene",
    "TaskFailedError": "imitarm.errors",
    "Trajectory": "imitarm.trajectory",
    "UnreachableError": "imitarm.errors",
    "adapt": "imitarm.policies",
    "align": "imitarm.demonstrations",
    "find_posture": "imitarm.kinematics.ik",
    "lint": "imitarm.demonstrations",
    "load_scene": "imitarm.scene",
    "read": "imitarm.demonstrations",
    "reproduce": "imitarm.reproduce",
    "retarget": "imitarm.retarget",
    "save_scene": "imitarm.scene",
    "solve_ik": "imitarm.kinematics.ik",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'imitarm' has no attribute {name!r}")
    home = importlib.import_module(_HOME[name])
    return home if home.__name__ == f"imitarm.{name}" else getattr(home, name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Module(ModuleType):
    """A module that is pickled and copied by its name: what others do for plain modules at most."""

    def __reduce__(self) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        return importlib.import_module, (self.__name__,)


class _Verb(_Module):
    """A module that does, when it is called, what its function of the same name does.

    ``imitarm.retarget`` is a package and ``imitarm.reproduce`` a module; both are public verbs, too. One name can't be
    two things, whichever was imported first, so it is one thing that can be both.
    """

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._function(*arguments, **options)

    @property
    def __signature__(self) -> Signature:
        inspect = importlib.import_module("inspect")  # slow to import, and seldom asked for
        signature: Signature = inspect.signature(self._function)
        return signature

    @property
    def _function(self) -> Callable[..., Any]:
        function: Callable[..., Any] = getattr(self, self.__name__.rpartition(".")[2])
        return function


class _Package(_Module):
    """Makes a verb of each module that has a public name: importing it puts it in here."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _HOME and isinstance(value, ModuleType):
            value.__class__ = _Verb
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
