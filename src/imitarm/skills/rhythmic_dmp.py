"""Rhythmic movement primitive: a spring and damper about a centre, driven round and round by a learnt force."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills.rotation_reference import RotationReference
from imitarm.skills.spring import Gains, gains_named, propagator, roll_out
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_GRID = 512  # points of one period
_CLOSES = 0.1  # a period whose ends are further apart than this share of its extent is none


class RhythmState(NamedTuple):
    """Where a rhythmic primitive is.

    Attributes:
        motion: [x; P x'], shape (2, D): position [m], and the rotation vector [rad] where rotation was learnt.
        turns: periods since the start, phi / (2 pi).
        center: g, shape (D,).
        amplitude: r, a factor of the learnt motion.
        period: P [s].
    """

    motion: Array
    turns: float
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
    r"""Rhythmic movement primitive, for wiping, stirring, polishing.

    .. math::
        \tau \dot v = K (g - x) - D v + K r f(\phi), \quad \tau \dot x = v, \quad \tau \dot \phi = 2 \pi

        f(\phi) = \frac{\sum_i w_i \psi_i(\phi)}{\sum_i \psi_i(\phi)}, \quad
        \psi_i(\phi) = \exp(h (\cos(\phi - c_i) - 1))

    tau is the period, g the centre of the motion, r its amplitude. The weights come from ridge regression on the
    positions: the steady answer to each basis function is known exactly, its Fourier coefficient at the k-th harmonic
    times ``K / (K - (2 pi k)^2 + 2 pi k D i)``. Rotations are vectors about their mean rotation; they must stay within
    120 degrees of it.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.spring.Gains`.
        n_basis: number N of basis functions round the circle.
        regularisation: ridge, relative to the mean square response of a basis function.

    Attributes:
        gains_: stiffness and damping.
        weights_: shape (N, D), D = 3, or 6 with rotation.
        center_: g, shape (D,).
        period_: learnt [s].
        reference_: mean rotation; None when the demonstration had no quaternions.

    Raises:
        InputError: when an option is out of range.
        UnknownNameError: when there are no gains of that name.
    """

    weights_: Array
    center_: Array
    period_: float
    reference_: RotationReference | None

    def __init__(self, gains: str | Gains = "critical", *, n_basis: int = 30, regularisation: float = 1e-7) -> None:
        self.gains_ = gains_named(gains) if isinstance(gains, str) else Gains(*gains)
        if n_basis < 3:
            raise InputError(f"RhythmicDMP: n_basis must be at least 3, got {n_basis!r}")
        if not regularisation > 0.0:
            raise InputError(f"RhythmicDMP: regularisation must be above 0, got {regularisation!r}")
        self.n_basis = n_basis
        self.regularisation = regularisation

    def _basis(self, turns: Array) -> Array:
        """Return psi_i / sum psi at ``turns`` (n,), shape (n, N)."""
        angle = 2.0 * np.pi * (turns[:, None] - np.arange(self.n_basis) / self.n_basis)
        psi = np.exp(0.1 * self.n_basis**2 * (np.cos(angle) - 1.0))
        return np.asarray(psi / psi.sum(axis=1, keepdims=True))

    def _responses(self) -> tuple[CubicSpline, Array]:
        """Return the steady answer of the spring to each basis function over a period, and its rate at the start."""
        K, D = self.gains_
        omega = 2.0 * np.pi * np.arange(_GRID // 2 + 1)
        spectrum = np.fft.rfft(self._basis(np.arange(_GRID) / _GRID), axis=0)
        spectrum *= (K / (K - omega**2 + 1j * omega * D))[:, None]
        answers = np.fft.irfft(spectrum, _GRID, axis=0)
        rates = np.fft.irfft(1j * omega[:, None] * spectrum, _GRID, axis=0)
        closed = np.concatenate([answers, answers[:1]])
        return CubicSpline(np.linspace(0.0, 1.0, _GRID + 1), closed, bc_type="periodic"), rates[0]

    def fit(self, trajectory: Trajectory, period: float | None = None) -> Self:
        """Learn from one trajectory of one or more periods.

        Args:
            trajectory: its times may start anywhere.
            period: [s]; None: the trajectory is exactly one period.

        Raises:
            InputError: when the period is not above 0 or longer than the trajectory, when the motion does not come
                back to where it was, or turns too far.
        """
        t = trajectory.times - trajectory.times[0]
        P = trajectory.duration if period is None else float(period)
        if not (np.isfinite(P) and 0.0 < P <= trajectory.duration * (1.0 + 1e-9)):
            raise InputError(
                f"RhythmicDMP.fit: period must be above 0 and at most the recorded {trajectory.duration:g} s, got {P!r}"
            )
        later, _ = trajectory.at(np.minimum(trajectory.times + P, trajectory.times[-1]))
        overlap = t <= trajectory.duration - P + 1e-9 * P
        gap = float(np.linalg.norm((later - trajectory.positions)[overlap], axis=1).max())
        extent = float(np.linalg.norm(np.ptp(trajectory.positions, axis=0)))
        if gap > _CLOSES * extent:
            raise InputError(
                f"RhythmicDMP.fit: after {P:g} s the motion is {1e3 * gap:.0f} mm from where it was, of "
                f"{1e3 * extent:.0f} mm extent; give the right period, or record whole periods"
            )
        columns = trajectory.positions
        self.reference_ = None
        if trajectory.quaternions is not None:
            self.reference_ = RotationReference.among([(t, trajectory.quaternions)])
            if len(self.reference_.times) > 1:
                raise InputError("RhythmicDMP.fit: the motion turns more than 120 degrees from its mean rotation")
            columns = np.column_stack([columns, self.reference_.to_vectors(t, trajectory.quaternions)])
        self.period_ = P
        spline, self._rate_at_start = self._responses()
        R = spline((t / P) % 1.0)
        self.center_ = columns.mean(axis=0)
        normal = R.T @ R / len(R)
        normal[np.diag_indices(self.n_basis)] += self.regularisation * np.trace(normal) / self.n_basis
        weights = np.linalg.solve(normal, R.T @ (columns - self.center_) / len(R))
        self.center_ += weights.mean(axis=0)  # the mean over whole periods, whatever part of one was recorded twice
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
    ) -> RhythmState:
        """Return the state at phase 0.

        Args:
            start: where the tool is, at rest; it swings in from there. None: already in the rhythm.
            center: another centre of the positions (3,) [m]; None: as learnt.
            amplitude: factor of the learnt motion.
            period: [s]; None: as learnt.

        Raises:
            InputError: when not fitted, or an argument is out of range.
        """
        if not hasattr(self, "weights_"):
            raise InputError("RhythmicDMP: not fitted yet; call fit first")
        P = self.period_ if period is None else float(period)
        if not (np.isfinite(P) and P > 0.0 and np.isfinite(amplitude)):
            raise InputError(
                f"RhythmicDMP: period must be above 0 s and amplitude finite, got {period!r}, {amplitude!r}"
            )
        g = self.center_.copy()
        if center is not None:
            g[:3] = Pose(np.asarray(center), np.array([1.0, 0.0, 0.0, 0.0])).position
        swing = np.stack([self._value_at_start, self._rate_at_start]) @ self.weights_ * amplitude
        motion = np.stack([g + swing[0], swing[1]])
        if start is not None:
            motion[1] = 0.0
            motion[0, :3] = start.position
            if self.reference_ is not None:
                motion[0, 3:] = self.reference_.to_vectors(np.zeros(1), start.quaternion[None])[0]
        return RhythmState(motion, 0.0, g, float(amplitude), P)

    def _target(self, state: RhythmState, turns: Array) -> Array:
        return np.asarray(state.center + state.amplitude * (self._basis(turns) @ self.weights_))

    def step(
        self, state: RhythmState, dt: float, *, coupling: Callable[[Array, Array], ArrayLike] | None = None
    ) -> RhythmState:
        """Return the state ``dt`` seconds later.

        Args:
            state: from :meth:`begin` or the last step; replace ``amplitude``, ``center`` or ``period`` in it to change
                the rhythm on the way.
            dt: [s].
            coupling: from position and velocity to an acceleration (3,) [m/s^2] that is added during this step.
        """
        h = dt / state.period
        one = propagator(self.gains_, h)
        motion = one.transition @ state.motion + one.drive @ self._target(state, state.turns + one.instants)
        if coupling is not None:
            acceleration = np.asarray(coupling(state.position, state.velocity), dtype=float) * state.period**2
            motion[:, :3] += one.push[:, None] * acceleration
        return state._replace(motion=motion, turns=state.turns + h)

    def quaternion(self, state: RhythmState) -> Array | None:
        """Return the rotation wxyz (4,), or None when none was learnt."""
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
            duration: [s]; None: one period.
            dt: step [s], stretched so that a whole number of steps fills the duration.
            start: as in :meth:`begin`.
            center: as in :meth:`begin`.
            amplitude: as in :meth:`begin`.
            period: as in :meth:`begin`.

        Raises:
            InputError: as :meth:`begin`, and when ``duration`` or ``dt`` is out of range.
        """
        state = self.begin(start, center=center, amplitude=amplitude, period=period)
        T = state.period if duration is None else float(duration)
        n = round(T / dt) if np.isfinite(T) and np.isfinite(dt) and dt > 0.0 else 0
        if n < 1:
            raise InputError(f"RhythmicDMP.generate: dt must be above 0 and not above the duration {T:g} s, got {dt!r}")
        h = T / n / state.period
        one = propagator(self.gains_, h)
        target = self._target(state, np.linspace(0.0, n * h, 2 * n * one.n_parts + 1))
        x = roll_out(one, state.motion, target)[0]
        times = np.linspace(0.0, T, n + 1)
        if self.reference_ is None:
            return Trajectory(times, x)
        return Trajectory(times, x[:, :3], self.reference_.to_quaternions(times, x[:, 3:]))
