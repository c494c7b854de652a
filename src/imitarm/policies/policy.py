"""What every way of reproducing a skill has in common: look at the scene, answer with a twist."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose
from imitarm.scene.scene import Scene

if TYPE_CHECKING:
    from imitarm.skills.skill import Skill

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Observation:
    """What a policy is told at one instant.

    Attributes:
        time: since the reproduction began [s].
        tool_to_base: measured pose of the tool in the base frame.
        scene: goal and obstacles as they are known now.
    """

    time: float
    tool_to_base: Pose
    scene: Scene


class Policy(ABC):
    """Decides the next twist of the tool from what is seen now.

    A policy holds state between ``reset`` and the end of one reproduction, and nothing else: the same observations
    give the same twists.
    """

    def __init__(self, skill: Skill) -> None:
        self.skill = skill

    @abstractmethod
    def reset(self, observation: Observation) -> None:
        """Begin a reproduction in the scene that is seen.

        Raises:
            InfeasibleError: when the policy knows beforehand that it can't be done; the message says why.
        """

    @abstractmethod
    def step(self, observation: Observation, dt: float) -> Array:
        """Return the twist (6,) of the tool in the base frame for the next ``dt`` seconds.

        Linear velocity [m/s] first, then angular velocity [rad/s].
        """

    @abstractmethod
    def finished(self, observation: Observation) -> bool:
        """Tell whether the motion has arrived."""
