"""Rhythmic movement primitive: a spring and damper about a centre, driven by a learned periodic force."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills.dmp import number_of_steps
from imitarm.skills.dynamical_systems import Gains, propagator, roll_out
from imitarm.skills.rotations import RotationReference
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number, finite_vector, function, instance, whole_number

Array = NDArray[np.float64]

_GRID = 512  # points of one period
_CLOSES = 0.1  # of the extent: a motion that ends a period further than this from where it began is not periodic


class RhythmicDMPState(NamedTuple):
    """State of a rhythmic movement primitive during a motion.

    ``RhythmicDMP.begin`` creates a state and ``RhythmicDMP.step`` advances it.

    Attributes:
        motion: [x; P x'] with the period P, shape (2, D). The coordinates x are the position [m] and, if rotation was
            learned, a rotation vector [rad].
        periods: number of periods since the start, phi / (2 pi).
        center: g, the centre of the motion, shape (D,) [m, rad].
        amplitude: r, the factor by which the learned motion is multiplied.
        period: P, the duration of one period [s].
    """

    motion: Array
    periods: float
    center: Array
    amplitude: float
    period: float

    @property
    def position(self) -> Array:
        """Position (3,) [m]."""
        return self.motion[0, :3]

    @property
    def velocity(self) -> Array:
        """Velocity (3,) [m/s]."""
        return self.motion[1, :3] / self.period


class RhythmicDMP:
    r"""Rhythmic movement primitive, for example for wiping, stirring or polishing.

    .. math::
        \tau \dot v = K (g - x) - D v + K r f(\phi), \quad \tau \dot x = v, \quad \tau \dot \phi = 2 \pi

        f(\phi) = \frac{\sum_i w_i \psi_i(\phi)}{\sum_i \psi_i(\phi)}, \quad
        \psi_i(\phi) = \exp(h (\cos(\phi - c_i) - 1))

    Here, x is the position, tau the period, phi the phase, g the centre of the motion and r its amplitude. These
    equations are the rhythmic form of Ijspeert et al. (2013). Ridge regression on the positions gives the weights. The
    spring's periodic response to each basis function is known exactly. The spring multiplies the k-th Fourier
    coefficient by ``K / (K - (2 pi k)^2 + 2 pi k D i)``, where i is the imaginary unit. Rotations are represented by
    rotation vectors relative to their mean rotation. All rotations must stay within 120 degrees of the mean.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.dynamical_systems.Gains`.
        n_basis: number N of basis functions in one period.
        regularisation: weight of the penalty in the ridge regression, relative to the mean square response of a basis
            function.

    Attributes:
        gains_: stiffness and damping.
        weights_: weights of the basis functions, shape (N, D), D = 3, or 6 with rotation.
        center_: learned centre g of the motion, shape (D,) [m, rad].
        period_: learned period [s].
        reference_: mean rotation; None when the demonstration had no quaternions.

    Raises:
        InputError: when an option is out of range.
        UnknownNameError: when no gains have that name.
    """

    weights_: Array
    center_: Array
    period_: float
    reference_: RotationReference | None

    def __init__(self, gains: str | Gains = "critical", *, n_basis: int = 30, regularisation: float = 1e-7) -> None:
        self.gains_ = Gains.of(gains, "RhythmicDMP")
        self.n_basis = whole_number(n_basis, "RhythmicDMP: n_basis", at_least=3, at_most=2000)
        self.regularisation = finite_number(regularisation, "RhythmicDMP: regularisation", above=0.0)

    def _basis(self, periods: Array) -> Array:
        """Return psi_i / sum psi after ``periods`` (n,), shape (n, N)."""
        angle = 2.0 * np.pi * (periods[:, None] - np.arange(self.n_basis) / self.n_basis)
        psi = np.exp(0.1 * self.n_basis**2 * (np.cos(angle) - 1.0))
        return np.asarray(psi / psi.sum(axis=1, keepdims=True))

    def _responses(self) -> tuple[CubicSpline, Array]:
        """Return the periodic response to each basis function over a period, and its rate of change at phase 0."""
        K, D = self.gains_
        omega = 2.0 * np.pi * np.arange(_GRID // 2 + 1)
        spectrum = np.fft.rfft(self._basis(np.arange(_GRID) / _GRID), axis=0)
        spectrum *= (K / (K - omega**2 + 1j * omega * D))[:, None]
        responses = np.fft.irfft(spectrum, _GRID, axis=0)
        rates = np.fft.irfft(1j * omega[:, None] * spectrum, _GRID, axis=0)
        closed = np.concatenate([responses, responses[:1]])
        return CubicSpline(np.linspace(0.0, 1.0, _GRID + 1), closed, bc_type="periodic"), rates[0]

    def fit(self, trajectory: Trajectory, period: float | None = None) -> Self:
        """Learn from one trajectory that contains one or more periods.

        Args:
            trajectory: the motion; its first time need not be 0.
            period: period of the motion [s]; None: the trajectory is exactly one period.

        Raises:
            InputError: when the period is not above 0 or is longer than the trajectory, when positions one period apart
                differ too much, or when the motion rotates too far.
        """
        instance(trajectory, Trajectory, "RhythmicDMP.fit: trajectory")
        t = trajectory.times - trajectory.times[0]
        P = trajectory.duration
        if period is not None:
            P = finite_number(period, "RhythmicDMP.fit: period", "s", above=0.0, at_most=P * (1.0 + 1e-9))
        later, _ = trajectory.at(np.minimum(trajectory.times + P, trajectory.times[-1]))
        overlap = t <= trajectory.duration - P + 1e-9 * P
        gap = float(np.linalg.norm((later - trajectory.positions)[overlap], axis=1).max())
        extent = float(np.linalg.norm(np.ptp(trajectory.positions, axis=0)))
        if gap > _CLOSES * extent:
            raise InputError(
                f"RhythmicDMP.fit: positions one period of {P:g} s apart differ by up to {1e3 * gap:.0f} mm (the "
                f"motion's extent is {1e3 * extent:.0f} mm); give the right period, or record whole periods"
            )
        columns = trajectory.positions
        self.reference_ = None
        if trajectory.quaternions is not None:
            self.reference_ = RotationReference.among([(t, trajectory.quaternions)])
            if len(self.reference_.times) > 1:
                raise InputError(
                    "RhythmicDMP.fit: the motion must not rotate more than 120 degrees from its mean rotation"
                )
            columns = np.column_stack([columns, self.reference_.to_vectors(t, trajectory.quaternions)])
        self.period_ = P
        spline, self._rate_at_start = self._responses()
        R = spline((t / P) % 1.0)
        self.center_ = columns.mean(axis=0)
        normal = R.T @ R / len(R)
        normal[np.diag_indices(self.n_basis)] += self.regularisation * np.trace(normal) / self.n_basis
        weights = np.linalg.solve(normal, R.T @ (columns - self.center_) / len(R))
        self.center_ += weights.mean(axis=0)  # the mean over one period, also when part of a period was recorded twice
        self.weights_ = weights - weights.mean(axis=0)
        self._value_at_start = spline(0.0)
        return self

    def begin(
        self,
        start: Pose | None = None,
        *,
        center: ArrayLike | None = None,
        amplitude: float = 1.0,
        period: float | None = None,
    ) -> RhythmicDMPState:
        """Return the state at phase 0.

        Args:
            start: pose in which the tool rests; from there, the motion approaches the learned cycle. None: the motion
                begins on the learned cycle.
            center: centre of the motion's positions (3,) [m]; None: the learned centre.
            amplitude: factor by which the learned motion is multiplied.
            period: period of the motion [s]; None: the learned period.

        Raises:
            InputError: when not fitted, or an argument is out of range.
        """
        if not hasattr(self, "weights_"):
            raise InputError("RhythmicDMP: not fitted yet; call fit first")
        P = self.period_ if period is None else finite_number(period, "RhythmicDMP: period", "s", above=0.0)
        r = finite_number(amplitude, "RhythmicDMP: amplitude")
        g = self.center_.copy()
        if center is not None:
            g[:3] = finite_vector(center, 3, "RhythmicDMP: center", "m")
        swing = np.stack([self._value_at_start, self._rate_at_start]) @ self.weights_ * r
        motion = np.stack([g + swing[0], swing[1]])
        if start is not None:
            instance(start, Pose, "RhythmicDMP: start")
            motion[1] = 0.0
            motion[0, :3] = start.position
            if self.reference_ is not None:
                motion[0, 3:] = self.reference_.to_vectors(np.zeros(1), start.quaternion[None])[0]
        return RhythmicDMPState(motion, 0.0, g, r, P)

    def _check(self, state: RhythmicDMPState) -> None:
        if not hasattr(self, "weights_"):
            raise InputError("RhythmicDMP: not fitted yet; call fit first")
        instance(state, RhythmicDMPState, "RhythmicDMP: state")
        for name in ("motion", "periods", "center", "amplitude"):
            if not np.all(np.isfinite(getattr(state, name))):
                raise InputError(f"RhythmicDMP: {name} of the state must be finite")
        finite_number(state.period, "RhythmicDMP: period of the state", "s", above=0.0)

    def _target(self, state: RhythmicDMPState, periods: Array) -> Array:
        return np.asarray(state.center + state.amplitude * (self._basis(periods) @ self.weights_))

    def step(
        self, state: RhythmicDMPState, dt: float, *, coupling: Callable[[Array, Array], ArrayLike] | None = None
    ) -> RhythmicDMPState:
        """Return the state ``dt`` seconds later.

        Args:
            state: state returned by :meth:`begin` or by the last step. To change the motion during its execution,
                replace ``amplitude``, ``center`` or ``period`` of the state.
            dt: length of the step [s], above 0.
            coupling: function from position and velocity to an acceleration (3,) [m/s^2] that is added during this
                step.

        Raises:
            InputError: when not fitted, or an argument is not finite or of a wrong shape.
        """
        self._check(state)
        h = finite_number(dt, "RhythmicDMP.step: dt", "s", above=0.0, at_most=100.0 * state.period) / state.period
        h = max(h, 1e-100)
        one = propagator(self.gains_, h, self.n_basis)
        motion = one.transition @ state.motion + one.drive @ self._target(state, state.periods + one.instants)
        if coupling is not None:
            added = function(coupling, "RhythmicDMP: coupling")(state.position, state.velocity)
            added = finite_vector(added, 3, "RhythmicDMP: acceleration that coupling returns", "m/s^2")
            motion[:, :3] += one.push[:, None] * added * state.period**2
        return state._replace(motion=motion, periods=state.periods + h)

    def quaternion(self, state: RhythmicDMPState) -> Array | None:
        """Return the rotation wxyz (4,), or None when no rotation was learned.

        Raises:
            InputError: when not fitted, or ``state`` is not valid.
        """
        self._check(state)
        if self.reference_ is None:
            return None
        return self.reference_.to_quaternions(np.zeros(1), state.motion[:1, 3:])[0]

    def generate(
        self,
        duration: float | None = None,
        dt: float = 0.01,
        *,
        start: Pose | None = None,
        center: ArrayLike | None = None,
        amplitude: float = 1.0,
        period: float | None = None,
    ) -> Trajectory:
        """Return the motion, ``round(duration / dt) + 1`` samples from 0 s to ``duration``.

        Args:
            duration: duration of the motion [s]; None: one period.
            dt: length of a step [s], adjusted so that a whole number of steps fills the duration.
            start: see :meth:`begin`.
            center: see :meth:`begin`.
            amplitude: see :meth:`begin`.
            period: see :meth:`begin`.

        Raises:
            InputError: for the same reasons as :meth:`begin`, and when ``duration`` or ``dt`` is out of range.
        """
        state = self.begin(start, center=center, amplitude=amplitude, period=period)
        T = state.period
        if duration is not None:
            T = finite_number(duration, "RhythmicDMP.generate: duration", "s", above=0.0)
        n = number_of_steps(T, dt, "RhythmicDMP.generate")
        h = T / n / state.period
        one = propagator(self.gains_, h, self.n_basis)
        target = self._target(state, np.linspace(0.0, n * h, 2 * n * one.n_parts + 1))
        x = roll_out(one, state.motion, target)[0]
        times = np.linspace(0.0, T, n + 1)
        if self.reference_ is None:
            return Trajectory(times, x)
        return Trajectory(times, x[:, :3], self.reference_.to_quaternions(times, x[:, 3:]))
