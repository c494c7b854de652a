"""AdaptiveControl: baseline M2, an adaptive controller that tracks the person's joint angles on a simulated arm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget.baselines.baseline_retargeter import BaselineRetargeter
from imitarm.retarget.baselines.joint_mapping import Approach, JointMapping
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.retargeter import Goal
from imitarm.scene import Scene

Array = NDArray[np.float64]

_SUBSTEP = 0.002  # [s] longest simulation step

START_STIFFNESS = (200.0, 200.0, 100.0, 100.0, 20.0, 20.0, 20.0)  # [N m/rad] K_lo
SLIDING_GAIN = (10.0, 10.0, 5.0, 5.0, 1.0, 1.0, 1.0)  # [N m s/rad] Gamma
_KAPPA = 5.0  # [1/s]
_RATES = (0.5, 5.0, 0.5)  # Q_F, Q_K, Q_D
_FORGETTING = (0.2, 5.0)  # a, b
_DAMPING_RATIO = 0.7
_STIFFER = 2.0  # K_hi / K_lo: closed hand over open hand
_FLOOR = 0.5  # Kmin over Kmax(h)

CUT_OFF = 3.0  # [Hz] of the reference's low-pass filter
_GRIP = 0.2  # [s] in which the closure follows a closing hand


class JointPlant:
    """A MuJoCo simulation of a robot arm that a joint controller moves. It includes gravity, but no contacts.

    The simulation includes rotor inertia, viscous damping and dry friction of the joints. ``ArmModel`` contains only
    the rigid links, so a controller with an ``ArmModel`` does not know these effects.

    Args:
        arm: arm model to simulate.
        dt: control period, during which the torque is constant [s].

    Attributes:
        substeps: number of simulation steps per control period.

    Raises:
        InputError: when ``dt`` is out of range.
    """

    def __init__(self, arm: ArmModel, dt: float) -> None:
        if not 0.0 < dt <= 0.1:
            raise InputError(f"JointPlant: dt must be above 0 and at most 0.1 s, got {dt!r}")
        spec = arm.spec()
        self.substeps = math.ceil(dt / _SUBSTEP - 1e-9)
        spec.option.timestep = dt / self.substeps
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        self._model, self._arm = spec.compile(), arm
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name).id for name in arm.joint_names]
        self._qpos, self._dofs = self._model.jnt_qposadr[joints], self._model.jnt_dofadr[joints]
        self.start(arm.home)

    def start(self, q: ArrayLike) -> None:
        """Reset the arm to rest at ``q``, shape (n_joints,) [rad].

        The fingers of a gripper stay in their home position.
        """
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = self._arm.posture(self._model, q)
        mujoco.mj_forward(self._model, self._data)
        self._data.ctrl[:] = self._data.actuator_length

    @property
    def q(self) -> Array:
        """Joint positions, shape (n_joints,) [rad]."""
        return np.asarray(self._data.qpos[self._qpos])

    @property
    def velocity(self) -> Array:
        """Joint velocities, shape (n_joints,) [rad/s]."""
        return np.asarray(self._data.qvel[self._dofs])

    @property
    def energy(self) -> float:
        """Kinetic plus potential energy of the arm at the start of the last simulation step [J]."""
        return float(self._data.energy.sum())

    def step(self, torque: Array) -> None:
        """Simulate one control period with constant torques on the joints, shape (n_joints,) [N m]."""
        self._data.qfrc_applied[self._dofs] = torque
        mujoco.mj_step(self._model, self._data, self.substeps)


@dataclass(frozen=True, eq=False)
class Torques:
    """Joint torques of one control period.

    Attributes:
        wanted: torques of the control law without limits, shape (n_joints,) [N m].
        applied: these torques, limited to the rated torques of the joints, shape (n_joints,) [N m].
    """

    wanted: Array
    applied: Array


class AdaptiveLaw:
    r"""A discrete-time adaptive joint controller (baseline M2).

    Let q be the joint positions, :math:`q_r` the desired joint positions (the reference), :math:`e = q - q_r` the error
    and T the control period. With :math:`\dot e = (e - e_{k-1})/T`, :math:`\varepsilon = \dot e + \kappa e`,
    :math:`\dot q_e = \dot q_r - \kappa e`, and :math:`\ddot q_e` from the differences of :math:`\dot q_e`, the torque
    is

    .. math::
        u = M(q)\,\ddot q_e + C(q, \dot q)\,\dot q_e + G(q) - \Gamma\varepsilon - F - K e - D \dot e

    The feed-forward torque F, the stiffness K and the damping D of each joint adapt according to

    .. math::
        F \leftarrow F + Q_F(\varepsilon - \gamma F), \quad
        K \leftarrow [K + Q_K(\varepsilon e - \gamma K)]_{K_{min}}^{K_{max}(h)}, \quad
        D \leftarrow [D + Q_D(\varepsilon\dot e - \gamma D)]_0^{D_{max}}

    Here, :math:`\gamma = a/(1 + b|\varepsilon|^2)` is the forgetting factor. The closure h of the person's hand is 0 if
    the hand is open and 1 if it is closed. It raises the largest stiffness: :math:`K_{max}(h) = K_{lo} + h(K_{hi} -
    K_{lo})`. The symbols :math:`\kappa, \Gamma, Q_F, Q_K, Q_D, a, b, K_{lo}, K_{hi}` are constant gains, and
    :math:`D_{max} = 1.4 \sqrt{K_{max}(h)}`. The inertia matrix M, the Coriolis matrix C and the gravity torque G come
    from the rigid links of ``ArmModel``. The adapted values F, K and D compensate for rotor inertia and friction. C is
    computed from Christoffel symbols, so that :math:`C(q, a)\,b = \tfrac12\,(c(a+b) - c(a) - c(b))` with :math:`c(v) =
    C(q, v)\,v`.

    The control law is a discrete form of the laws of Yang et al. (IEEE Trans. Robotics 2011) and Li and Burdet. The
    values of the gains are our choice. For small errors, :math:`\gamma` is a, and the product of a and :math:`Q_K` is
    1. The stiffness then returns to :math:`K_{min}` within one period. The papers do not specify :math:`K_{min}`. We
    set :math:`K_{min} = K_{max}(h)/2`, so that the closure of the hand has an effect even then.

    Args:
        arm: arm model with M, C, G and the rated torques.
        period: control period T [s].

    Raises:
        InputError: when the arm does not have seven joints, for which the gains are defined.
    """

    def __init__(self, arm: ArmModel, period: float) -> None:
        if arm.n_joints != len(START_STIFFNESS):
            raise InputError(
                f"AdaptiveLaw: {arm.name} has {arm.n_joints} joints, but the gains are for {len(START_STIFFNESS)} "
                "joints; use the method modern, thesis or m3"
            )
        self.arm, self.period = arm, period
        self._gamma = np.array(SLIDING_GAIN)
        self.start()

    def start(self) -> None:
        """Reset all adapted values."""
        n = self.arm.n_joints
        self.stiffness = np.array(START_STIFFNESS)
        self.damping = 2.0 * _DAMPING_RATIO * np.sqrt(self.stiffness)
        self.force = np.zeros(n)
        self._error: Array | None = None
        self._reference_velocity = np.zeros(n)
        self._before: Array | None = None  # reference one period ago

    def torques(self, q: ArrayLike, velocity: ArrayLike, reference: ArrayLike, closure: float) -> Torques:
        """Return the torques of one control period, and update the adapted values.

        Args:
            q: joint positions, shape (n_joints,) [rad].
            velocity: joint velocities, shape (n_joints,) [rad/s].
            reference: desired joint positions :math:`q_r`, shape (n_joints,) [rad].
            closure: closure of the person's hand, from 0 (open) to 1 (closed).
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
        """Return the product of the matrix C(q, velocity) and the vector ``along``, shape (n_joints,) [N m]."""
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


class AdaptiveControl(BaselineRetargeter):
    r"""Baseline M2: our interpretation of "discrete-time adaptive control" in the thesis.

    The thesis refers to Liang et al. 2016. We know only the abstract of this paper. It describes a discrete-time
    controller of a simulated Baxter arm. The arm angles are computed from Kinect data, and the stiffness depends on the
    hand's gesture. We use a discrete form of the controllers of Yang et al. 2011 and Li and Burdet 2016, which resemble
    human motor control.

    The joint angles of the person are mapped to joint positions :math:`q_h` of the robot, once per frame. A first-order
    low-pass filter with the cut-off frequency f = 3 Hz computes the reference from :math:`q_h`: :math:`q_r \leftarrow
    q_r + (1 - e^{-2\pi f T})(q_h - q_r)`. An :class:`AdaptiveLaw` computes torques within the rated limits, and these
    torques drive the simulated arm (:class:`JointPlant`). The joint positions of the simulated arm are the command to
    the robot. The method tracks joint angles, so the tool does not have the position of the hand.

    If ``velocity_scaling`` is False, only the torque limits restrict the joint velocity. The dictionary ``notes`` has
    three additional entries:

    * ``"saturated"``: number of torques above the rated torque, counted over all joints and control steps;
    * ``"peak_torque"``: largest torque before it is limited, as a multiple of the joint's rated torque;
    * ``"rms_torque"``: root mean square torque over all joints and control steps [N m].

    Args:
        arm: the robot's arm with its tool.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        dt: control period T [s].
        scene: ignored.
        velocity_scaling: whether to scale down all joints together in every step of the reference and of the command,
            so that no joint exceeds its velocity limit.
        relative: True: changes of the person's joint angles since the robot began to follow are added to the robot's
            joint positions. False: the angles themselves are mapped, and the robot first moves to the result at limited
            speed. See :class:`~imitarm.retarget.baselines.joint_mapping.JointMapping`.

    Attributes:
        torque: torques applied in the last control period, shape (n_joints,) [N m].

    Raises:
        InputError: when the arm does not have the joint axes of a person's arm.
    """

    name: ClassVar[str] = "m2"
    title: ClassVar[str] = "M2"
    caption: ClassVar[str] = (
        "Our interpretation of an adaptive discrete-time controller that follows the person's joints."
    )

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
        self._filter_weight = 1.0 - math.exp(-2.0 * math.pi * CUT_OFF * dt)
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
        """Advance the reference, controller and simulated arm by one period; return the joint positions reached."""
        step = self._filter_weight * (self._held_goal - self._reference)
        if self.velocity_scaling:
            step = step / max(float((np.abs(step) / (self.dt * self.arm.max_velocity)).max()), 1.0)
        self._reference = self._reference + step
        torques = self._law.torques(self._plant.q, self._plant.velocity, self._reference, self._closure)
        self.torque = torques.applied
        fractions = np.abs(torques.wanted) / self.arm.max_torque
        self.counts["saturated"] += int(np.count_nonzero(fractions > 1.0))
        self._peak = max(self._peak, float(fractions.max()))
        self._squares += float(np.mean(self.torque**2))
        self._periods += 1
        self._plant.step(self.torque)
        return self._plant.q

    @property
    def notes(self) -> dict[str, float]:
        """Counts and torques since :meth:`start`; see the docstrings of this class and of its base class."""
        rms = math.sqrt(self._squares / self._periods) if self._periods else 0.0
        return {
            **super().notes,
            "saturated": float(self.counts["saturated"]),
            "peak_torque": self._peak,
            "rms_torque": rms,
        }
