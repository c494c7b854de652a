"""Dynamic movement primitive: a spring and damper to the goal, shaped by a learnt force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose
from imitarm.skills.course import ADJUSTMENTS, Adjustment, Course, rotodilatation
from imitarm.skills.dmp_fit import imitate, progress_at
from imitarm.skills.dmp_state import DMPState
from imitarm.skills.phase_basis import DECAY, phase_basis
from imitarm.skills.quaternion_dmp import QuaternionDMP
from imitarm.skills.spring import Gains, gains_named, propagator, roll_out
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

Coupling = Callable[[Array, Array], ArrayLike]


class DMP:
    r"""Dynamic movement primitive in the form of Hoffmann and Pastor (METHODS C; replaces thesis Eqs 2.8 to 2.12).

    .. math::
        \tau \dot v &= K (g - x) - D v - K (g - x_0) s + K f(s), \quad \tau \dot x = v, \quad \tau \dot s = -\alpha s

        f(s) &= \frac{\sum_i w_i \psi_i(s) s}{\sum_i \psi_i(s)}, \quad \psi_i(s) = \exp(-h_i (s - c_i)^2)

    tau is the duration, so K and D have no unit; ``"critical"`` gains have D = 2 sqrt(K), the ``"thesis"`` gains
    K = 139.26, D = 28 a damping ratio of 1.186. The same in other words: the spring pulls to a moving target
    ``y(s) = g - (g - x_0) s + f(s)`` that ends at the goal.

    **Fitting** (:func:`~imitarm.skills.dmp_fit.imitate`) is ridge regression on the positions themselves: no noise is
    differentiated, any time stamps will do, and the motion arrives at the goal exactly when the duration is over.

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

    def fit(self, trajectory: Trajectory, *, exact_ends: bool = False) -> Self:
        """Learn from one trajectory; its times may start anywhere.

        Args:
            trajectory: the motion to reproduce.
            exact_ends: start and end exactly at the first and the last sample and rotation. Otherwise a noisy first or
                last sample is smoothed: where it lies more than 0.1 mm beside the path that fits all samples, the
                motion starts or ends on that path.

        Raises:
            InputError: when it has fewer than 3 samples.
        """
        if len(trajectory) < 3:
            raise InputError(f"DMP.fit: needs at least 3 samples, got {len(trajectory)}")
        share = (trajectory.times - trajectory.times[0]) / trajectory.duration
        learnt = imitate(
            share, trajectory.positions, self.gains_, self.n_basis, self.regularisation, exact_ends=exact_ends
        )
        self.weights_, self.progress_weights_ = learnt.weights, learnt.progress_weights
        self.start_, self.goal_, self.duration_ = learnt.start, learnt.goal, trajectory.duration
        self.start_velocity_, self.path_length_ = learnt.start_rate / self.duration_, learnt.path_length
        self.orientation_ = None
        if trajectory.quaternions is not None:
            self.orientation_ = QuaternionDMP(self.gains_).fit(trajectory, exact_ends=exact_ends)
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

    @property
    def centers_(self) -> Array:
        """Centres c_i of the basis functions, shape (N,)."""
        return phase_basis(self.n_basis).centers

    @property
    def widths_(self) -> Array:
        """Widths h_i of the basis functions, shape (N,)."""
        return phase_basis(self.n_basis).widths

    def progress(self, times: ArrayLike) -> Array:
        """Return p, the fraction of the learned path that is done at ``times`` (n,) [s] of the learned duration."""
        t = np.atleast_1d(np.asarray(times, dtype=float))
        return progress_at(t / self.duration_, self.progress_weights_, self.gains_)

    def _course(self, start: Array, goal: Array, duration: float, adjustment: Adjustment) -> Course:
        learnt, asked = self.goal_ - self.start_, goal - start
        weights = self.weights_
        if adjustment == "progress":
            weights = weights + self.progress_weights_[:, None] * (asked - learnt)
        elif adjustment == "rotodilatation":
            weights = weights @ rotodilatation(learnt, asked, self.path_length_).T
        return Course(start, goal, duration, adjustment, weights - asked)

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
        return DMPState(np.stack([x0, rate]), 0.0, course, turn)

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
        course, rhythm = state.course, state.rhythm
        if goal is not None and not np.array_equal(goal, course.goal):
            course = self._course(
                course.start, _position(goal, course.goal, "goal"), course.duration, course.adjustment
            )
            rhythm = None
        h = dt / course.duration
        if measured is not None:
            h /= 1.0 + float(np.linalg.norm(np.asarray(measured) - state.motion[0])) / patience
        done = 0
        if rhythm is not None:
            done = rhythm[1] if rhythm[0] == h else -1
        elif state.share > 0.0:
            done = -1
        plan = course.plan(self.gains_, h) if done >= 0 else None
        if plan is not None and done < len(plan.pushes):
            motion = plan.transition.dot(state.motion) + plan.pushes[done]  # dot: @ is slower on small arrays
        else:
            one = propagator(self.gains_, h)
            y = course.target(np.exp(-DECAY * (state.share + one.instants)))
            motion = one.transition.dot(state.motion) + one.drive.dot(y)
        turning = None
        if coupling is not None:
            T = course.duration
            acceleration = np.asarray(coupling(state.motion[0], state.motion[1] / T), dtype=float) * (T * T)
            motion += propagator(self.gains_, h).push[:, None] * acceleration[:3]
            turning = acceleration[3:] if len(acceleration) == 6 else None
        turn = state.turn
        if turn is not None and self.orientation_ is not None:
            turn = self.orientation_.step(turn, h, turning)
        if done < 0:
            return DMPState(motion, state.share + h, course, turn, None)
        return DMPState(motion, (done + 1) * h, course, turn, (h, done + 1))

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
        one = propagator(self.gains_, 1.0 / n)
        positions = roll_out(one, state.motion, state.course.target_on_grid(n * one.n_parts))[0]
        if self.orientation_ is None or state.turn is None:
            return Trajectory(times, positions)
        return Trajectory(times, positions, self.orientation_.target(state.turn, times / T))


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
