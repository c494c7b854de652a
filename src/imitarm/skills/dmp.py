"""Dynamic movement primitive: a spring and damper to the goal, shaped by a learnt force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose
from imitarm.skills.quaternion_dmp import QuaternionDMP, Turn
from imitarm.skills.spring import Gains, gains_named, propagator, roll_out
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Coupling = Callable[[Array, Array], ArrayLike]
Adjustment = Literal["progress", "hoffmann", "rotodilatation"]

ADJUSTMENTS = ("progress", "hoffmann", "rotodilatation")
_DECAY = float(np.log(100.0))  # alpha: the phase is 0.01 at the end
_FINE = 512  # steps of the grid on which responses are computed when fitting
_TINY = 1e-300  # far past the end all basis functions underflow to 0
_CLOSED = 0.1  # net motion below this share of the path length gives no direction to turn and stretch by


class DMPState(NamedTuple):
    """Where a primitive is. Made by :meth:`DMP.begin`, carried on by :meth:`DMP.step`.

    Attributes:
        motion: [x; T x'], shape (2, 3) [m].
        phase: s, from 1 at the start to 0.01 at the end and on towards 0.
        course: what start, goal and duration were asked for.
        turn: the state of the rotation; None when none was learnt.
    """

    motion: Array
    phase: float
    course: Course
    turn: Turn | None

    @property
    def position(self) -> Array:
        """Position (3,) [m]."""
        return self.motion[0]

    @property
    def velocity(self) -> Array:
        """Velocity (3,) [m/s]."""
        return self.motion[1] / self.course.duration

    @property
    def time(self) -> float:
        """Time of the primitive's own clock [s]; it stands behind the wall clock when the robot lagged."""
        return float(-np.log(self.phase) / _DECAY * self.course.duration)

    @property
    def quaternion(self) -> Array | None:
        """Rotation wxyz (4,), or None when none was learnt."""
        return None if self.turn is None else self.turn.quaternion


@dataclass(frozen=True, eq=False)
class Course:
    """One use of a primitive: from where, to where, how long.

    Attributes:
        start: position (3,) [m].
        goal: position (3,) [m].
        duration: [s].
        adjustment: how the learnt motion gives way to another start and goal.
        drive: [w_i - (g - x_0), 1], shape (N, 4): the weights made ready for these ends.
    """

    start: Array
    goal: Array
    duration: float
    adjustment: Adjustment
    drive: Array


class DMP:
    r"""Dynamic movement primitive in the form of Hoffmann and Pastor (METHODS C; replaces thesis Eqs 2.8 to 2.12).

    .. math::
        \tau \dot v &= K (g - x) - D v - K (g - x_0) s + K f(s), \quad \tau \dot x = v, \quad \tau \dot s = -\alpha s

        f(s) &= \frac{\sum_i w_i \psi_i(s) s}{\sum_i \psi_i(s)}, \quad \psi_i(s) = \exp(-h_i (s - c_i)^2)

    tau is the duration, so K and D have no unit; ``"critical"`` gains have D = 2 sqrt(K), the ``"thesis"`` gains
    K = 139.26, D = 28 a damping ratio of 1.186. The same in other words: the spring pulls to a moving target
    ``y(s) = g - (g - x_0) s + f(s)`` that ends at the goal.

    **Fitting.** The weights come from ridge regression on the force that the demonstration needs. Both sides of that
    equation are filtered by the spring itself, which turns the unknown accelerations into the measured positions:
    ``x(t) - x_base(t) = sum_i w_i R_i(t)`` with ``R_i`` the response to basis function i. No noise is differentiated,
    any time stamps will do, and the end is an equality: the motion arrives at the goal when the duration is over.

    **Other ends.** With ``p`` the share of the path that is done (itself a primitive from 0 to 1 with weights w_p),

    * ``"progress"``: w + (change of g - x_0) w_p, so the change enters as the path is travelled: nothing moves when
      the demonstration did not, half the distance never goes backwards, a still axis is no special case;
    * ``"hoffmann"``: w as learnt, the printed form: the change enters as fast as the spring allows;
    * ``"rotodilatation"``: w turned and stretched like g - x_0 was (Ginesi et al. 2019), for a shape that scales.

    **Integration.** Steps are exact for a target that is a parabola within the step (:mod:`imitarm.skills.spring`), so
    ``step`` and ``generate`` agree, and a motion does not depend on the step chosen nor lead its demonstration.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.spring.Gains`.
        n_basis: number N of basis functions.
        regularisation: ridge, relative to the mean square response of a basis function.

    Attributes:
        gains_: stiffness and damping.
        centers_: c_i, shape (N,).
        widths_: h_i, shape (N,).
        weights_: w, shape (N, 3) [m].
        progress_weights_: w_p, shape (N,).
        start_: learnt start x_0, shape (3,) [m].
        goal_: learnt goal g, shape (3,) [m].
        start_velocity_: learnt, shape (3,) [m/s].
        duration_: learnt [s].
        path_length_: of the learnt motion [m].
        orientation_: primitive of the rotation; None when the demonstration had no quaternions.

    Raises:
        InputError: when an option is out of range.
        UnknownNameError: when there are no gains of that name.
    """

    centers_: Array
    widths_: Array
    weights_: Array
    progress_weights_: Array
    start_: Array
    goal_: Array
    start_velocity_: Array
    duration_: float
    path_length_: float
    orientation_: QuaternionDMP | None

    def __init__(self, gains: str | Gains = "critical", *, n_basis: int = 40, regularisation: float = 1e-7) -> None:
        self.gains_ = gains_named(gains) if isinstance(gains, str) else Gains(*gains)
        if not (self.gains_.stiffness > 0.0 and self.gains_.damping > 0.0):
            raise InputError(f"DMP: stiffness and damping must be above 0, got {self.gains_}")
        if not isinstance(n_basis, int | np.integer) or n_basis < 2:
            raise InputError(f"DMP: n_basis must be a whole number of at least 2, got {n_basis!r}")
        if not regularisation > 0.0:
            raise InputError(f"DMP: regularisation must be above 0, got {regularisation!r}")
        self.n_basis = int(n_basis)
        self.regularisation = regularisation
        self._place_basis()

    def _place_basis(self) -> None:
        """Spread the centres equally in time; neighbours meet where both are 0.6."""
        self.centers_ = np.exp(-_DECAY * np.linspace(0.0, 1.0, self.n_basis))
        gaps = -np.diff(self.centers_)
        self.widths_ = 2.0 / np.concatenate([gaps, gaps[-1:]]) ** 2
        self._exponents = -self.widths_

    # ------------------------------------------------------------------------------------------------ learning

    def fit(self, trajectory: Trajectory) -> Self:
        """Learn from one trajectory; its times may start anywhere.

        Raises:
            InputError: when it has fewer than 3 samples.
        """
        if len(trajectory) < 3:
            raise InputError(f"DMP.fit: needs at least 3 samples, got {len(trajectory)}")
        share = (trajectory.times - trajectory.times[0]) / trajectory.duration
        x = trajectory.positions
        self.start_, self.goal_, self.duration_ = x[0].copy(), x[-1].copy(), trajectory.duration
        responses, rates = self._responses()
        spline = CubicHermiteSpline(np.linspace(0.0, 1.0, _FINE + 1), responses, rates)
        at_samples = spline(share)
        rate = _start_rate(share, x)
        ends = np.stack([self.start_, self.goal_ - self.start_, rate])
        base = at_samples[:, :3] @ ends
        self.start_velocity_ = rate / self.duration_
        self.weights_ = self._ridge(at_samples[:, 3:], x - base, self.goal_ - base[-1])
        self._learn_progress(responses, rates @ np.concatenate([ends, self.weights_]))
        self.orientation_ = None
        if trajectory.quaternions is not None:
            self.orientation_ = QuaternionDMP(self.gains_).fit(trajectory)
        return self

    @classmethod
    def from_weights(
        cls,
        weights: ArrayLike,
        progress_weights: ArrayLike,
        *,
        gains: Gains,
        start: ArrayLike,
        goal: ArrayLike,
        start_velocity: ArrayLike,
        duration: float,
        path_length: float,
        orientation: QuaternionDMP | None = None,
    ) -> DMP:
        """Build from weights that were learnt before; the arguments are the attributes of the class.

        Raises:
            InputError: when shapes disagree, a number is not finite, or duration or gains are not above 0.
        """
        w, p = np.array(weights, dtype=float), np.array(progress_weights, dtype=float)
        if w.ndim != 2 or w.shape[1] != 3 or p.shape != (len(w),) or not np.all(np.isfinite(w)):
            raise InputError(f"DMP.from_weights: shapes (N, 3) and (N,) of numbers needed, got {w.shape} and {p.shape}")
        if not (np.all(np.isfinite(p)) and np.isfinite(duration) and duration > 0.0 and path_length >= 0.0):
            raise InputError(f"DMP.from_weights: duration must be above 0 s and all finite, got {duration!r}")
        dmp = cls(gains, n_basis=len(w))
        dmp.weights_, dmp.progress_weights_, dmp.orientation_ = w, p, orientation
        dmp.start_, dmp.goal_ = _position(start, w[0], "start"), _position(goal, w[0], "goal")
        dmp.start_velocity_ = _position(start_velocity, w[0], "start_velocity")
        dmp.duration_, dmp.path_length_ = float(duration), float(path_length)
        return dmp

    def _basis(self, s: Array) -> Array:
        """Return psi_i(s) s / sum psi, shape (len(s), N)."""
        psi = np.exp(-self.widths_ * (s[:, None] - self.centers_) ** 2)
        return np.asarray(psi * (s / (psi.sum(axis=1) + _TINY))[:, None])

    def _responses(self) -> tuple[Array, Array]:
        """Return what the spring answers to each input on the fine grid, and its rate, each shape (_FINE + 1, 3 + N).

        Columns: start at 1 and goal at 1; goal term from 0 to 1; initial rate of 1; each basis function.
        """
        s = np.exp(-_DECAY * np.linspace(0.0, 1.0, 2 * _FINE + 1))
        inputs = np.column_stack([np.ones_like(s), 1.0 - s, np.zeros_like(s), self._basis(s)])
        start = np.zeros((2, inputs.shape[1]))
        start[0, 0] = start[1, 2] = 1.0
        z = roll_out(propagator(self.gains_, 1.0 / _FINE), start, inputs)
        return z[:, 0], z[:, 1]

    def _ridge(self, R: Array, y: Array, end: Array) -> Array:
        """Return weights with ``R w = y`` in the sense of ridge regression, and exactly ``R[-1] w = end``.

        Late basis functions carry the factor s = 0.01, so each weight is punished by the force it makes.
        """
        S = R / self.centers_
        n = self.n_basis
        kkt = np.zeros((n + 1, n + 1))
        kkt[:n, :n] = S.T @ S / len(S)
        kkt[np.arange(n), np.arange(n)] += self.regularisation * np.trace(kkt) / n
        kkt[n, :n] = kkt[:n, n] = S[-1]
        right = np.concatenate([S.T @ y / len(S), end[None]])
        return np.asarray(np.linalg.solve(kkt, right)[:n] / self.centers_[:, None])

    def _learn_progress(self, responses: Array, rate: Array) -> None:
        """Learn p from the rate of the fitted motion, which is smooth; a motion of no length gets a minimum jerk."""
        speed = np.linalg.norm(rate, axis=1)
        done = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))]) / _FINE
        self.path_length_ = float(done[-1])
        u = np.linspace(0.0, 1.0, _FINE + 1)
        progress = done / done[-1] if done[-1] > 1e-9 else u**3 * (10.0 + u * (6.0 * u - 15.0))
        base = responses[:, 1]
        y, end = (progress - base)[:, None], np.array([1.0 - base[-1]])
        self.progress_weights_ = self._ridge(responses[:, 3:], y, end)[:, 0]

    # ------------------------------------------------------------------------------------------------ reproducing

    def _course(self, start: Array, goal: Array, duration: float, adjustment: Adjustment) -> Course:
        learnt, asked = self.goal_ - self.start_, goal - start
        weights = self.weights_
        if adjustment == "progress":
            weights = weights + self.progress_weights_[:, None] * (asked - learnt)
        elif adjustment == "rotodilatation":
            weights = weights @ _rotodilatation(learnt, asked, self.path_length_).T
        drive = np.column_stack([weights - asked, np.ones(self.n_basis)])
        return Course(start, goal, duration, adjustment, drive)

    def _target(self, course: Course, s: Array) -> Array:
        """Return where the spring pulls to, y(s), shape (n, 3), at phases s (n, 1)."""
        distance = s - self.centers_
        parts = np.exp(distance * distance * self._exponents) @ course.drive
        return course.goal + parts[:, :3] * (s / (parts[:, 3:] + _TINY))

    def begin(
        self,
        start: Pose | ArrayLike | None = None,
        goal: Pose | ArrayLike | None = None,
        duration: float | None = None,
        *,
        start_velocity: ArrayLike | None = None,
        adjustment: Adjustment = "progress",
    ) -> DMPState:
        """Return the state at the start of a motion.

        Args:
            start: a Pose, or a position (3,) [m] with the learnt rotation; None: as learnt.
            goal: likewise.
            duration: [s]; None: as learnt.
            start_velocity: (3,) [m/s]; None: as learnt, sped up or slowed down with the duration.
            adjustment: how the motion gives way to other ends, see the class.

        Raises:
            InputError: when not fitted, a shape is wrong, or the duration is not above 0.
            UnknownNameError: when ``adjustment`` is none of the three.
        """
        if not hasattr(self, "weights_"):
            raise InputError("DMP: not fitted yet; call fit first")
        if adjustment not in ADJUSTMENTS:
            raise UnknownNameError.among("adjustment", adjustment, ADJUSTMENTS)
        T = self.duration_ if duration is None else float(duration)
        if not (np.isfinite(T) and T > 0.0):
            raise InputError(f"DMP: duration must be above 0 s, got {duration!r}")
        x0 = _position(start, self.start_, "start")
        course = self._course(x0, _position(goal, self.goal_, "goal"), T, adjustment)
        rate = self.start_velocity_ * self.duration_
        if start_velocity is not None:
            rate = _position(start_velocity, rate, "start_velocity") * T
        turn = None
        if self.orientation_ is not None:
            ends = [end.quaternion if isinstance(end, Pose) else None for end in (start, goal)]
            turn = self.orientation_.begin(*ends)
        return DMPState(np.stack([x0, rate]), 1.0, course, turn)

    def step(
        self,
        state: DMPState,
        dt: float,
        *,
        goal: ArrayLike | None = None,
        coupling: Coupling | None = None,
        measured: ArrayLike | None = None,
        patience: float = 0.01,
    ) -> DMPState:
        """Return the state ``dt`` seconds later.

        Args:
            state: from :meth:`begin` or the last step.
            dt: [s].
            goal: another goal position (3,) [m] from now on, for a goal that moves.
            coupling: from position (3,) [m] and velocity (3,) [m/s] to an acceleration (3,) [m/s^2] that is added
                during this step, for example away from an obstacle; with (6,) the last three turn [rad/s^2].
            measured: where the robot really is (3,) [m]: the clock slows down by ``1 / (1 + |lag| / patience)``
                (phase stopping), so that the primitive waits instead of running ahead.
            patience: the lag [m] that halves the pace.
        """
        course, T = state.course, state.course.duration
        if goal is not None and not np.array_equal(goal, course.goal):
            course = self._course(course.start, _position(goal, course.goal, "goal"), T, course.adjustment)
        h = dt / T
        if measured is not None:
            h /= 1.0 + float(np.linalg.norm(np.asarray(measured) - state.motion[0])) / patience
        s = state.phase * _phases(h)
        y = self._target(course, s)
        turning = None
        if coupling is not None:
            acceleration = np.asarray(coupling(state.motion[0], state.motion[1] / T), dtype=float)
            y += acceleration[:3] * (T * T / self.gains_.stiffness)
            turning = acceleration[3:] * (T * T) if len(acceleration) == 6 else None
        E, G = propagator(self.gains_, h)
        turn = state.turn
        if turn is not None and self.orientation_ is not None:
            turn = self.orientation_.step(turn, h, turning)
        return DMPState(E @ state.motion + G @ y, float(s[2, 0]), course, turn)

    def generate(
        self,
        start: Pose | ArrayLike | None = None,
        goal: Pose | ArrayLike | None = None,
        duration: float | None = None,
        dt: float = 0.01,
        *,
        start_velocity: ArrayLike | None = None,
        adjustment: Adjustment = "progress",
        coupling: Coupling | None = None,
    ) -> Trajectory:
        """Return the whole motion, ``round(duration / dt) + 1`` samples from 0 s to ``duration``.

        The step is ``dt``, stretched so that a whole number of steps fills the duration. Without ``coupling`` all
        samples are computed at once.

        Args:
            start: as in :meth:`begin`.
            goal: as in :meth:`begin`.
            duration: as in :meth:`begin`.
            dt: step [s].
            start_velocity: as in :meth:`begin`.
            adjustment: as in :meth:`begin`.
            coupling: as in :meth:`step`.

        Raises:
            InputError: as :meth:`begin`, and when ``dt`` is not above 0 or longer than twice the duration.
        """
        state = self.begin(start, goal, duration, start_velocity=start_velocity, adjustment=adjustment)
        T = state.course.duration
        n = round(T / dt) if np.isfinite(dt) and dt > 0.0 else 0
        if n < 1:
            raise InputError(f"DMP.generate: dt must be above 0 and not above the duration {T:g} s, got {dt!r}")
        times = np.linspace(0.0, T, n + 1)
        if coupling is not None:
            states = [state]
            for _ in range(n):
                states.append(self.step(states[-1], T / n, coupling=coupling))
            quaternions = None if state.turn is None else np.stack([s.turn.quaternion for s in states if s.turn])
            return Trajectory(times, np.stack([s.position for s in states]), quaternions)
        target = self._target(state.course, np.exp(-_DECAY * np.linspace(0.0, 1.0, 2 * n + 1))[:, None])
        positions = roll_out(propagator(self.gains_, 1.0 / n), state.motion, target)[:, 0]
        if self.orientation_ is None or state.turn is None:
            return Trajectory(times, positions)
        return Trajectory(times, positions, self.orientation_.target(state.turn, times / T))


@lru_cache(maxsize=256)
def _phases(step: float) -> Array:
    """Return by what the phase shrinks until the begin, the middle and the end of a step, shape (3, 1)."""
    return np.exp(-_DECAY * step * np.array([[0.0], [0.5], [1.0]]))


def _start_rate(share: Array, x: Array) -> Array:
    """Return how fast the motion is under way at its first sample, shape (3,), in m a duration.

    The slope of a parabola through the first twentieth. It counts only when it stands out of the noise and is more than
    a tenth of the mean speed: a motion that begins at rest begins exactly at rest.
    """
    n = max(6, int(np.searchsorted(share, 0.05, side="right")))
    if len(share) < n:
        return np.zeros(3)
    table = share[:n, None] ** np.arange(3)
    solution, *_ = np.linalg.lstsq(table, x[:n], rcond=None)
    variance = np.sum((x[:n] - table @ solution) ** 2, axis=0) / (n - 3)
    error = np.sqrt(variance.sum() * np.linalg.inv(table.T @ table)[1, 1])
    mean_speed = np.linalg.norm(np.diff(x, axis=0), axis=1).sum()
    slope = np.linalg.norm(solution[1])
    return solution[1] if slope > max(3.0 * error, 0.1 * mean_speed) else np.zeros(3)


def _position(value: Pose | ArrayLike | None, default: Array, what: str) -> Array:
    """Return a position of its own, (3,)."""
    if value is None:
        return default.copy()
    if isinstance(value, Pose):
        return value.position
    position = np.array(value, dtype=float)
    if position.shape != (3,) or not np.all(np.isfinite(position)):
        raise InputError(f"DMP: {what} must be a Pose or 3 finite numbers, got {value!r}")
    return position


def _rotodilatation(learnt: Array, asked: Array, path_length: float) -> Array:
    """Return the (3, 3) turn (the shortest) and stretch that takes ``learnt`` to ``asked``.

    A motion that comes back to near where it began gives no direction to turn and no length to stretch by: identity.
    """
    a, b = float(np.linalg.norm(learnt)), float(np.linalg.norm(asked))
    if a <= _CLOSED * path_length or a == 0.0 or b == 0.0:
        return np.eye(3) if b > 0.0 or a <= _CLOSED * path_length else np.zeros((3, 3))
    u, v = learnt / a, asked / b
    cosine = float(u @ v)
    if cosine < -1.0 + 1e-9:  # straight back: half a turn about any axis across
        axis = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        axis /= np.linalg.norm(axis)
        return np.asarray((b / a) * (2.0 * np.outer(axis, axis) - np.eye(3)))
    w = np.cross(u, v)
    cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray((b / a) * (np.eye(3) + cross + cross @ cross / (1.0 + cosine)))
