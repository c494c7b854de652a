"""AdaptiveControl: rival M2, the person's joint angles tracked by an adaptive controller of the joints."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.baselines.adaptive_law import AdaptiveLaw
from imitarm.retarget.baselines.baseline_retargeter import BaselineRetargeter
from imitarm.retarget.baselines.joint_mapping import Approach, JointMapping
from imitarm.retarget.baselines.joint_plant import JointPlant
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.retargeter import Goal
from imitarm.scene import Scene

Array = NDArray[np.float64]

CUT_OFF = 3.0  # [Hz] of the reference's low-pass
_GRIP = 0.2  # [s] in which a hand counts as closed more and more


class AdaptiveControl(BaselineRetargeter):
    r"""Rival M2: our reading of "discrete-time adaptive control" in the thesis (METHODS B).

    It stands for Liang et al. 2016, of which the abstract is known: the arm's configuration from a Kinect by vectors, a
    stiffness index by the hand's gesture, a biomimetic controller in discrete time, on a Baxter in simulation. The
    equations are those of the human-like controllers of Yang et al. 2011 and Li and Burdet 2016, made discrete, from
    memory.

    The person's joint angles, held from frame to frame, go through a low-pass of first order at 3 Hz,
    :math:`q_r \leftarrow q_r + (1 - e^{-2\pi f T})(q_h - q_r)`; an
    :class:`~imitarm.retarget.baselines.adaptive_law.AdaptiveLaw` gives torques, cut to the rated ones, at which the
    arm's own dynamics (:class:`~imitarm.retarget.baselines.joint_plant.JointPlant`) move. Where they have moved it to
    is the command. What it adapts is joints: the tool is not where the hand is.

    A joint's velocity is limited by nothing but its torque. In ``notes``: ``"saturated"``, joints and steps at the
    rated torque, ``"peak_torque"`` as a share of it before it is cut, and ``"rms_torque"`` [N m] over all joints and
    steps.

    Args:
        arm: the robot's arm with its tool.
        correspondence: what of the person's arm stands for what of the robot's.
        dt: control period T [s].
        scene: not heeded.
        velocity_scaling: scale every step, of the reference and of the command, so that no joint exceeds its limit.
        relative: map the change of the person's joints since the hold was taken; else the joints themselves, which are
            approached at limited speed. See :class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`.

    Attributes:
        torque: of the last control period, shape (n_joints,) [N m].

    Raises:
        InputError: when the arm has not the axes of a person's arm.
    """

    name: ClassVar[str] = "m2"
    title: ClassVar[str] = "M2"
    caption: ClassVar[str] = "Our reading of an adaptive controller in discrete time that follows the person's joints."

    def __init__(
        self,
        arm: ArmModel,
        correspondence: Correspondence | None = None,
        *,
        dt: float = 0.01,
        scene: Scene | None = None,
        velocity_scaling: bool = False,
        relative: bool = True,
    ) -> None:
        super().__init__(arm, correspondence, dt=dt, scene=scene, velocity_scaling=velocity_scaling)
        self._mapping = JointMapping(arm, relative=relative)
        self._law = AdaptiveLaw(arm, dt)
        self._plant = JointPlant(arm, dt)
        self._share = 1.0 - math.exp(-2.0 * math.pi * CUT_OFF * dt)
        self.torque = np.zeros(arm.n_joints)
        self._peak = self._squares = 0.0
        self._periods = 0

    def _begin(self) -> None:
        super()._begin()
        self._peak = self._squares = 0.0
        self._periods = 0

    def _rest_at(self, q: Array) -> None:
        self._mapping.start(q)
        self._approach = Approach(self.arm, self.dt)
        self._joint_goal, self._held_goal, self._reference = q, q, q
        self._closure, self._driven = 0.0, False
        self._law.start()
        self._plant.start(q)
        self.torque = self.arm.gravity_torque(q)

    def _wanted(self, goal: Goal) -> Array:
        self._driven = True  # the brakes open
        if goal.fresh:
            joints = self._mapping.joints(goal.estimate, goal.clutch)
            self._joint_goal = np.minimum(np.maximum(joints, self.arm.lower), self.arm.upper)
            closed = 1.0 if goal.estimate.closed else 0.0
            self._closure += (closed - self._closure) * min(self._period / _GRIP, 1.0)
        self._held_goal = self._approach.towards(self._held_goal, self._joint_goal)
        return self._driven_on()

    def _holding(self) -> Array:
        return self._driven_on() if self._driven else self.latest.q

    def _driven_on(self) -> Array:
        """Let the reference, the controller and the arm go on by one period; return where the arm is then."""
        step = self._share * (self._held_goal - self._reference)
        if self.velocity_scaling:
            step = step / max(float((np.abs(step) / (self.dt * self.arm.max_velocity)).max()), 1.0)
        self._reference = self._reference + step
        torques = self._law.torques(self._plant.q, self._plant.velocity, self._reference, self._closure)
        self.torque = torques.given
        shares = np.abs(torques.wanted) / self.arm.max_torque
        self.counts["saturated"] += int(np.count_nonzero(shares > 1.0))
        self._peak = max(self._peak, float(shares.max()))
        self._squares += float(np.mean(self.torque**2))
        self._periods += 1
        self._plant.step(self.torque)
        return self._plant.q

    @property
    def notes(self) -> dict[str, float]:
        """Counts and RMS torque so far; see the class and its base."""
        rms = math.sqrt(self._squares / self._periods) if self._periods else 0.0
        return {
            **super().notes,
            "saturated": float(self.counts["saturated"]),
            "peak_torque": self._peak,
            "rms_torque": rms,
        }
