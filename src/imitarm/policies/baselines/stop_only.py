"""Stop-only: speed and separation monitoring, which stops the tool in front of an obstacle and never avoids it."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.command import Command, Status
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.policy import Observation, Policy
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]

_SAMPLES = 200
_GAIN = 8.0  # [1/s] of the feedback
_ARRIVED = 3e-3  # [m]
_STANDS = 0.02  # rate of the phase below which the arm is said to wait


class StopOnly(Policy):
    r"""Follow the learned path, and stop while an obstacle is too near.

    An obstacle is too near if its distance is less than the required clearance plus the protective separation distance
    of speed and separation monitoring (ISO/TS 15066):

    .. math:: S = v_h (T_r + T_s) + v_r T_r + S_s + C + Z_d + Z_r

    Here, :math:`v_h` is the speed at which the tracked obstacle approaches the tool, or 0 if the obstacle moves away.
    :math:`v_r` is the speed of the tool on the learned path, and :math:`T_r` is the reaction time. With the
    deceleration a, the tool has the stopping time :math:`T_s = v_r / a` and the stopping distance :math:`S_s = v_r^2 /
    (2 a)`. C is the intrusion distance: how far an obstacle may enter the monitored zone before a sensor detects it.
    :math:`Z_d` is the uncertainty of the obstacle's position: two standard deviations in the direction to the tool.
    :math:`Z_r` is the uncertainty of the tool's position. The tool brakes and accelerates along the path with the
    acceleration a.

    **Known failure.** The tool never leaves the path. If an obstacle moves towards the stopped tool, it hits the tool.
    If an obstacle stays near the path, the motion never continues.

    Args:
        skill: skill to reproduce.
        reaction: reaction time T_r [s].
        deceleration: deceleration and acceleration a [m/s^2].
        intrusion: intrusion distance C [m].
        tool_uncertainty: uncertainty Z_r of the tool's position [m].
        options: arguments of :class:`~imitarm.policies.Policy`.
    """

    title: ClassVar[str] = "stop only"

    def __init__(
        self,
        skill: Skill,
        *,
        reaction: float = 0.1,
        deceleration: float = 5.0,
        intrusion: float = 0.0,
        tool_uncertainty: float = 0.005,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        self.reaction = finite_number(reaction, "StopOnly: reaction", "s", at_least=0.0)
        self.deceleration = finite_number(deceleration, "StopOnly: deceleration", "m/s^2", above=0.0)
        self.intrusion = finite_number(intrusion, "StopOnly: intrusion", "m", at_least=0.0)
        self.tool_uncertainty = finite_number(tool_uncertainty, "StopOnly: tool_uncertainty", "m", at_least=0.0)
        self._phase: float | None = None

    def reset(self, observation: Observation) -> None:
        """Begin the motion at the start of the learned path."""
        away = observation.tool_to_base.error_to(self.skill.start_)[:3]
        start = None if np.linalg.norm(away) <= _ARRIVED else observation.tool_to_base
        times = np.linspace(0.0, self.skill.duration_, _SAMPLES)
        self._nominal = self.skill.nominal(times, start, observation.scene.goal)
        self._velocity = np.gradient(self._nominal.positions, self._nominal.times, axis=0)
        self._hold, self._rate, self._phase = observation.tool_to_base.quaternion, 0.0, 0.0

    @property
    def phase(self) -> float:
        """Completed fraction of the motion."""
        return 0.0 if self._phase is None else self._phase / self._nominal.duration

    def step(self, observation: Observation, dt: float) -> Command:
        """Return the command that follows the path, or brakes.

        Raises:
            InputError: when ``reset`` was not called.
        """
        if self._phase is None:
            raise InputError("StopOnly.step: call reset(observation) first")
        path, tool = self._nominal, observation.tool_to_base
        velocity = np.array([np.interp(self._phase, path.times, column) for column in self._velocity.T])
        speed = float(np.linalg.norm(velocity))
        near = self._too_near(observation.scene.now(observation.time), tool.position, speed)
        change = self.deceleration * dt / max(speed, 1e-3)
        self._rate = max(0.0, self._rate - change) if near else min(1.0, self._rate + change)
        moves = self._rate * velocity
        self._phase = min(self._phase + self._rate * dt, path.duration)
        positions, quaternions = path.at([path.times[0] + self._phase])
        target = Pose(positions[0], self._hold if quaternions is None else quaternions[0])
        twist = _GAIN * tool.error_to(target)
        twist[:3] += moves if self._phase < path.duration else 0.0
        status = Status.NOMINAL
        if near:
            status = Status.WAITING if self._rate < _STANDS else Status.BRAKING
        return Command(twist, progress=self.phase, status=status, reason=near)

    def finished(self, observation: Observation) -> bool:
        """Return whether the path has ended and the tool is at its end."""
        if self._phase is None or self._phase < self._nominal.duration:
            return False
        away = np.linalg.norm(observation.tool_to_base.position - self._nominal.positions[-1])
        return bool(away < _ARRIVED)

    def separation(self, approach: Array, speed: float, uncertainty: Array) -> Array:
        """Return the protective separation distance S of each obstacle, shape (n,) [m].

        Args:
            approach: speed v_h of each obstacle towards the tool, shape (n,) [m/s].
            speed: speed v_r of the tool [m/s].
            uncertainty: uncertainty Z_d of each obstacle's position, shape (n,) [m].
        """
        stopping = speed / self.deceleration
        own = speed * self.reaction + 0.5 * speed * stopping
        return np.asarray(
            approach * (self.reaction + stopping) + own + self.intrusion + uncertainty + self.tool_uncertainty
        )

    def _too_near(self, scene: Scene, position: Array, speed: float) -> str:
        """Return why the tool must stop; empty if it need not."""
        packed = scene.packed
        if not len(packed):
            return ""
        gap, normal = ToolGaps(scene, self.tool_spheres).gaps_and_normals(position)
        approach = np.maximum(np.einsum("nd,nd->n", packed.velocities, normal), 0.0)
        spread = 2.0 * np.sqrt(np.maximum(np.einsum("nd,nde,ne->n", normal, packed.covariances, normal), 0.0))
        spare = gap - self.separation(approach, speed, spread) - self.clearance
        worst = int(np.argmin(spare))
        if spare[worst] >= 0.0:
            return ""
        return f"{scene.name_of(worst)} is {1e3 * gap[worst]:.0f} mm from the tool"
