"""ACFRA, adaptive collision-free reaching (thesis Chapter 4): adapt the whole path, then follow it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InfeasibleError, InputError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_log, quaternion_multiply
from imitarm.policies.adaptation import ADAPTERS, Adaptation, adapt
from imitarm.policies.policy import Observation, Policy

if TYPE_CHECKING:
    from imitarm.skills.skill import Skill

Array = NDArray[np.float64]

_LEAST_PATIENCE = 5e-3  # [m] no robot follows more closely than this at every moment
_SAME_PLACE = 5e-3  # [m, rad] a start nearer than this to the learnt one is the learnt one


class ACFRA(Policy):
    """Adapt the whole path once, then follow it (thesis Chapter 4).

    ``reset`` adapts the skill to the scene that is seen and refuses when it can't keep the clearance. ``step`` follows
    the adapted path with the velocity that belongs to it plus a pull towards it::

        twist = r v_d(s) + K [p_d(s) - p; log(R_d(s) R^T)],     ds/dt = r = max(0, 1 - (|p_d - p| / e_0)^2)

    so the phase ``s`` waits for a robot that lags (its speed limits, a hand that holds it). With ``e_0`` the asked
    clearance, no corner is cut by more than half of it: each point of the straight way back is within ``e_0 / 2`` of
    the tool or of its target, and both are clear.

    Only ``"certified"`` knows beforehand that it can't keep the clearance, and refuses; the thesis's potential fields
    (``"mapf"``, ``"literal"``) are followed wherever they lead, so that they can be compared.

    Attributes:
        adaptation: what the last ``reset`` found.
    """

    def __init__(
        self,
        skill: Skill,
        *,
        method: str = "certified",
        tool_radius: float | None = None,
        tool_spheres: ArrayLike | None = None,
        clearance: float = 0.02,
        forbidden: ArrayLike = (),
        pinned: Sequence[float] = (),
        gain: float = 8.0,  # [1/s]
        patience: float | None = None,  # [m] e_0: the phase stops at this lag; None: the clearance, at least 5 mm
        arrival: float = 0.003,  # [m]
    ) -> None:
        super().__init__(skill)
        self._refuses = ADAPTERS[method].refuses
        self._options = {
            "method": method,
            "tool_radius": tool_radius,
            "tool_spheres": tool_spheres,
            "clearance": clearance,
            "forbidden": forbidden,
            "pinned": pinned,
        }
        self._gain, self._arrival = gain, arrival
        self._patience = max(clearance, _LEAST_PATIENCE) if patience is None else patience
        self.adaptation: Adaptation | None = None
        self._phase = 0.0

    def reset(self, observation: Observation) -> None:
        """Adapt the path to the scene, beginning where the tool is.

        Raises:
            InfeasibleError: when the clearance can't be kept, with the obstacle and the reason.
        """
        away = observation.tool_to_base.error_to(self.skill.start_)
        if not self.skill.gmr_.has_orientation_:
            away = away[:3]
        start = observation.tool_to_base if np.linalg.norm(away) > _SAME_PLACE else None
        self.adaptation = adapt(self.skill, observation.scene, start=start, **self._options)  # type: ignore[arg-type]
        if not self.adaptation.feasible and self._refuses:
            raise InfeasibleError(self.adaptation.reason)
        path = self.adaptation.trajectory
        self._velocity = np.gradient(path.positions, path.times, axis=0)
        self._rotation = np.zeros((len(path), 3))
        if path.quaternions is not None:
            turn = quaternion_multiply(path.quaternions[1:], quaternion_conjugate(path.quaternions[:-1]))
            self._rotation[:-1] = quaternion_log(turn) / np.diff(path.times)[:, None]
        self._hold = observation.tool_to_base
        self._phase = 0.0

    @property
    def phase(self) -> float:
        """How far along the demonstrated time the motion is [s]."""
        return self._phase

    def _target(self, adaptation: Adaptation) -> tuple[Pose, Array]:
        """Return the desired pose and the twist (6,) that belongs to it at the present phase."""
        path = adaptation.trajectory
        positions, quaternions = path.at([self._phase])
        pose = Pose(positions[0], self._hold.quaternion if quaternions is None else quaternions[0])
        rates = np.concatenate([self._velocity, self._rotation], axis=1)
        twist = np.array([np.interp(self._phase, path.times, column) for column in rates.T])
        return pose, twist

    def step(self, observation: Observation, dt: float) -> Array:
        """Return the twist (6,) that follows the adapted path.

        Raises:
            InputError: when ``reset`` was not called.
        """
        if self.adaptation is None:
            raise InputError("ACFRA.step: call reset(observation) first")
        target, forward = self._target(self.adaptation)
        error = observation.tool_to_base.error_to(target)
        if self.adaptation.trajectory.quaternions is None:
            error[3:] = quaternion_log(
                quaternion_multiply(self._hold.quaternion, quaternion_conjugate(observation.tool_to_base.quaternion))
            )
        lag = float(np.linalg.norm(error[:3])) / self._patience
        pace = max(0.0, 1.0 - lag**2) if self._phase < self.adaptation.trajectory.times[-1] else 0.0
        self._phase = min(self._phase + pace * dt, float(self.adaptation.trajectory.times[-1]))
        return pace * forward + self._gain * error

    def finished(self, observation: Observation) -> bool:
        """Tell whether the end of the path is reached within ``arrival``."""
        if self.adaptation is None:
            return False
        path = self.adaptation.trajectory
        away = np.linalg.norm(observation.tool_to_base.position - path.positions[-1])
        return self._phase >= path.times[-1] and bool(away < self._arrival)
