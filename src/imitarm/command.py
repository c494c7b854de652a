"""Command: the motion that a policy requests for the next control period, with its status."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.validation import finite_number, finite_vector

Array = NDArray[np.float64]


class Status(Enum):
    """Status of the reproduction of a skill, as reported by the policy."""

    NOMINAL = "nominal"
    """The motion follows the learned path."""
    AVOIDING = "avoiding"
    """The motion differs from the learned path because of an obstacle."""
    WAITING = "waiting"
    """The motion is paused until something changes, for example until an obstacle moves away."""
    BRAKING = "braking"
    """The motion is being stopped because its plan is no longer valid."""


@dataclass(frozen=True, eq=False)
class Command:
    """The motion that a policy requests for the next control period.

    Attributes:
        twist: twist of the tool in the base frame, linear velocity first, shape (6,) [m/s, rad/s].
        joint_velocity: velocity of the joints, shape (n_joints,) [rad/s]; if given, the robot follows it instead of the
            twist. None: the inverse kinematics computes the joint velocity from the twist.
        posture: joint positions towards which the arm drifts in the null space of the twist, shape (n_joints,) [rad].
            With None, the arm has no preferred position.
        elbow: SEW (shoulder-elbow-wrist) angle to which the elbow rotates in the null space of the twist [rad]; None:
            no preference.
        progress: completed fraction of the motion, 0 to 1; nan if unknown.
        status: state of the reproduction.
        reason: explanation of why the motion is not nominal, with the name of the obstacle; empty when nominal.
        opening: opening to which the gripper's fingers move [m]; None: the last commanded opening stays valid.
    """

    twist: Array
    joint_velocity: Array | None = None
    posture: Array | None = None
    elbow: float | None = None
    progress: float = math.nan
    status: Status = Status.NOMINAL
    reason: str = ""
    opening: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "twist", finite_vector(self.twist, 6, "Command: twist", "m/s, rad/s"))
        for name, unit in (("joint_velocity", "rad/s"), ("posture", "rad")):
            value = getattr(self, name)
            if value is not None:
                n = len(value) if isinstance(value, np.ndarray | list | tuple) else 0
                object.__setattr__(self, name, finite_vector(value, max(n, 1), f"Command: {name}", unit))
        if self.elbow is not None:
            object.__setattr__(self, "elbow", finite_number(self.elbow, "Command: elbow", "rad"))
        if self.opening is not None:
            opening = finite_number(self.opening, "Command: opening", "m", at_least=0.0)
            object.__setattr__(self, "opening", opening)
        if not isinstance(self.status, Status):
            raise InputError(f"Command: status must be a Status such as Status.NOMINAL, got {self.status!r}")
