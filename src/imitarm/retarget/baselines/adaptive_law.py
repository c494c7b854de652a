r"""AdaptiveLaw: torques by which joints track a reference, with feed-forward, stiffness and damping that adapt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

START_STIFFNESS = (200.0, 200.0, 100.0, 100.0, 20.0, 20.0, 20.0)  # [N m/rad] METHODS B
SLIDING_GAIN = (10.0, 10.0, 5.0, 5.0, 1.0, 1.0, 1.0)  # [N m s/rad] Gamma
_KAPPA = 5.0  # [1/s]
_RATES = (0.5, 5.0, 0.5)  # Q_F, Q_K, Q_D
_FORGETTING = (0.2, 5.0)  # a, b
_DAMPING_RATIO = 0.7
_STIFFER = 2.0  # K_hi over K_lo: of a closed hand over an open one
_FLOOR = 0.5  # Kmin over Kmax(h)


@dataclass(frozen=True, eq=False)
class Torques:
    """What the law gave in one period.

    Attributes:
        wanted: shape (n_joints,) [N m].
        given: cut to the rated torques, shape (n_joints,) [N m].
    """

    wanted: Array
    given: Array


class AdaptiveLaw:
    r"""A discrete-time adaptive controller of joints (METHODS B, M2).

    With :math:`e = q - q_r`, :math:`\dot e = (e - e_{k-1})/T`, :math:`\varepsilon = \dot e + \kappa e`,
    :math:`\dot q_e = \dot q_r - \kappa e` and :math:`\ddot q_e` by differences,

    .. math::
        u = M(q)\,\ddot q_e + C(q, \dot q)\,\dot q_e + G(q) - \Gamma\varepsilon - F - K e - D \dot e

    .. math::
        F \leftarrow F + Q_F(\varepsilon - \gamma F), \quad
        K \leftarrow [K + Q_K(\varepsilon e - \gamma K)]_{K_{min}}^{K_{max}(h)}, \quad
        D \leftarrow [D + Q_D(\varepsilon\dot e - \gamma D)]_0^{D_{max}}

    joint by joint, with the forgetting :math:`\gamma = a/(1 + b|\varepsilon|^2)`. The closed hand stiffens:
    :math:`K_{max}(h) = K_{lo} + h(K_{hi} - K_{lo})`. M, C and G are the rigid arm's, as ``ArmModel`` has them; what it
    leaves out (rotors, friction) is for F, K and D to make up for. C is the matrix of Christoffel symbols, for which
    :math:`C(q, a)\,b = \tfrac12\,(h(a+b) - h(a) - h(b))` with :math:`h(v) = C(q, v)\,v`.

    At small deviations :math:`\gamma = a` and :math:`Q_K \gamma = 1`: the stiffness forgets all but :math:`K_{min}`
    within one period. So that the hand still counts, :math:`K_{min} = K_{max}(h)/2`, which the source leaves open.

    Args:
        arm: whose M, C, G and rated torques.
        period: T [s].

    Raises:
        InputError: when the arm has not seven joints, for which the gains are.
    """

    def __init__(self, arm: ArmModel, period: float) -> None:
        if arm.n_joints != len(START_STIFFNESS):
            raise InputError(
                f"AdaptiveLaw: {arm.name} has {arm.n_joints} joints, but the gains are for {len(START_STIFFNESS)}; "
                "take modern, thesis or m3"
            )
        self.arm, self.period = arm, period
        self._gamma = np.array(SLIDING_GAIN)
        self.start()

    def start(self) -> None:
        """Forget all that was learnt."""
        n = self.arm.n_joints
        self.stiffness = np.array(START_STIFFNESS)
        self.damping = 2.0 * _DAMPING_RATIO * np.sqrt(self.stiffness)
        self.force = np.zeros(n)
        self._error: Array | None = None
        self._reference_velocity = np.zeros(n)
        self._before: Array | None = None  # reference one period ago

    def torques(self, q: ArrayLike, velocity: ArrayLike, reference: ArrayLike, closure: float) -> Torques:
        """Return the torques of one period, and adapt.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            velocity: joint velocities, shape (n_joints,) [rad/s].
            reference: where the joints should be, shape (n_joints,) [rad].
            closure: of the person's hand, 0 open to 1 closed.
        """
        q, velocity, wanted = (np.asarray(x, dtype=float) for x in (q, velocity, reference))
        error = q - wanted
        rate = np.zeros_like(error) if self._error is None else (error - self._error) / self.period
        reference_rate = np.zeros_like(q) if self._before is None else (wanted - self._before) / self.period
        sliding = rate + _KAPPA * error
        v_e = reference_rate - _KAPPA * error
        a_e = np.zeros_like(q) if self._error is None else (v_e - self._reference_velocity) / self.period
        self._error, self._before, self._reference_velocity = error, wanted, v_e
        torque = (
            self.arm.mass_matrix(q) @ a_e
            + self._coriolis(q, velocity, v_e)
            + self.arm.gravity_torque(q)
            - self._gamma * sliding
            - self.force
            - self.stiffness * error
            - self.damping * rate
        )
        self._adapt(error, rate, sliding, closure)
        return Torques(torque, np.clip(torque, -self.arm.max_torque, self.arm.max_torque))

    def _coriolis(self, q: Array, velocity: Array, along: Array) -> Array:
        """Return C(q, velocity) along, shape (n_joints,) [N m]."""
        rest = np.zeros_like(q)
        gravity = self.arm.gravity_torque(q)

        def quadratic(v: Array) -> Array:
            return self.arm.inverse_dynamics(q, v, rest) - gravity

        return 0.5 * (quadratic(velocity + along) - quadratic(velocity) - quadratic(along))

    def _adapt(self, error: Array, rate: Array, sliding: Array, closure: float) -> None:
        a, b = _FORGETTING
        forgetting = a / (1.0 + b * float(sliding @ sliding))
        q_f, q_k, q_d = _RATES
        ceiling = np.array(START_STIFFNESS) * (1.0 + closure * (_STIFFER - 1.0))
        self.force = self.force + q_f * (sliding - forgetting * self.force)
        stiffness = self.stiffness + q_k * (sliding * error - forgetting * self.stiffness)
        self.stiffness = np.clip(stiffness, _FLOOR * ceiling, ceiling)
        damping = self.damping + q_d * (sliding * rate - forgetting * self.damping)
        self.damping = np.clip(damping, 0.0, 2.0 * _DAMPING_RATIO * np.sqrt(ceiling))
