"""Policy: the interface of all policies, which observe an arm and its scene and return commands."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.command import Command
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.validation import finite_array, finite_number, instance

Array = NDArray[np.float64]

_NEED_NOT_HAVE = ("arm", "max_tilt", "goal_tilt", "pinned")  # options that not every policy has


@dataclass(frozen=True, eq=False)
class Observation:
    """The input of a policy at one control step.

    Attributes:
        time: time since the reproduction began [s].
        state: measured state of the arm.
        tool_to_base: measured pose of the tool in the base frame.
        scene: goal and obstacles at the time of the last detections, ``scene.stamp``. ``scene.at(time)`` predicts the
            obstacles at the current time.
    """

    time: float
    state: ArmState
    tool_to_base: Pose
    scene: Scene

    def __post_init__(self) -> None:
        finite_number(self.time, "Observation: time", "s")
        instance(self.state, ArmState, "Observation: state")
        instance(self.tool_to_base, Pose, "Observation: tool_to_base")
        instance(self.scene, Scene, "Observation: scene")


class Policy(ABC):
    """Decides the next command from the current observation.

    To write your own policy, implement the methods :meth:`reset`, :meth:`step` and :meth:`finished` in a subclass.
    Register the policy under the entry point group ``imitarm.policies``, or by ``POLICIES.register(name, policy)``. The
    policy then appears in ``imitarm reproduce --policy``, in ``imitarm benchmark placements`` and in their reports.
    These commands construct the policy with the arguments below. A policy must be deterministic: after each
    :meth:`reset`, the same observations must give the same commands.

    Args:
        skill: the skill to reproduce.
        tool_spheres: spheres that contain the tool, rows x y z r in the tool's frame, shape (m, 4) [m]; None: the tool
            is a point.
        clearance: required distance of the tool to every obstacle [m].
        forbidden: directions in which the path must not be displaced from the learned path, shape (m, 3).
        arm: the arm that executes the commands, for policies that plan joint motions; None: unknown.

    Attributes:
        plan: plan to draw in a report, an :class:`~imitarm.policies.Adaptation`; None if the policy has no plan.
    """

    plan: Any = None

    def __init__(
        self,
        skill: Skill,
        *,
        tool_spheres: ArrayLike | None = None,
        clearance: float = 0.02,
        forbidden: ArrayLike = (),
        arm: ArmModel | None = None,
    ) -> None:
        self.arm = None if arm is None else instance(arm, ArmModel, "Policy: arm")
        self.skill = instance(skill, Skill, "Policy: skill")
        _ = self.skill.duration_  # an unfitted skill has none, and says so
        self.tool_spheres = (
            None if tool_spheres is None else finite_array(tool_spheres, (None, 4), "Policy: tool_spheres", "m")
        )
        if self.tool_spheres is not None and (self.tool_spheres[:, 3] < 0.0).any():
            raise InputError("Policy: tool_spheres has a negative radius [m]; each row is x y z r")
        self.clearance = finite_number(clearance, "Policy: clearance", "m", at_least=0.0)
        self.forbidden = forbidden
        if np.size(directions := finite_array(forbidden, (...,), "Policy: forbidden")):
            rows = np.atleast_2d(finite_array(directions, (..., 3), "Policy: forbidden"))
            if not rows.any(axis=-1).all():
                raise InputError("Policy: forbidden has a direction of length 0; leave it out")

    @classmethod
    def build(cls, skill: Skill, **options: Any) -> Self:
        """Return a policy, constructed with the options that the command line and the benchmarks pass to every policy.

        The options ``arm``, ``max_tilt``, ``goal_tilt`` and ``pinned`` are passed only to policies whose constructors
        take them.

        Raises:
            InputError: when the constructor does not take another option.
        """
        known = _parameters(cls)
        options = {name: value for name, value in options.items() if name in known or name not in _NEED_NOT_HAVE}
        try:
            return cls(skill, **options)
        except TypeError as error:
            raise InputError(
                f"{cls.__name__}: can't be built with the arguments {', '.join(options)}: {error}; let its "
                f"constructor take the arguments of Policy's constructor"
            ) from error

    @classmethod
    def takes(cls, option: str) -> bool:
        """Return whether the constructor takes the option of this name."""
        return option in _parameters(cls)

    @abstractmethod
    def reset(self, observation: Observation) -> None:
        """Start a reproduction in the observed scene.

        Raises:
            InfeasibleError: when the policy finds before the motion that the reproduction is impossible; the message
                gives the reason.
        """

    @abstractmethod
    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command for the next ``dt`` seconds."""

    @abstractmethod
    def finished(self, observation: Observation) -> bool:
        """Return whether the motion is over and the tool has arrived at the goal."""


def _parameters(policy: type[Policy]) -> set[str]:
    """Return the names of a constructor's parameters, with those of the bases to which ``**options`` are passed."""
    names: set[str] = set()
    for cls in policy.__mro__:
        if "__init__" in vars(cls):
            parameters = inspect.signature(vars(cls)["__init__"]).parameters.values()
            names |= {parameter.name for parameter in parameters}
            if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
                break
    return names
