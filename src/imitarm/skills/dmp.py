"""Dynamic movement primitive: a spring and damper that reaches the goal along a learned path."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills.dynamical_systems import (
    ADJUSTMENTS,
    DECAY,
    Adjustment,
    Gains,
    MovingTarget,
    fit_weights,
    phase_basis,
    progress_at,
    propagator,
    roll_out,
)
from imitarm.skills.rotations import QuaternionDMP, RotationState, rotodilatation
from imitarm.trajectory import Trajectory
from imitarm.validation import (
    choice,
    finite_array,
    finite_number,
    finite_numbers,
    finite_vector,
    flag,
    function,
    instance,
    whole_number,
)

Array = NDArray[np.float64]
Coupling = Callable[[Array, Array], ArrayLike]

MOST_STEPS = 10_000_000  # of a generated motion
_ROUNDING = 1e-9  # of a duration: ``dt`` may exceed the duration by no more
_SHORTEST_STEP, _LONGEST_STEP = 1e-100, 100.0  # in durations: the spring's numbers stay finite, and the time to compute
_state = tuple.__new__  # makes a named tuple without its slower constructor


class DMPState(NamedTuple):
    """State of a movement primitive during a motion; ``DMP.begin`` creates a state and ``DMP.step`` advances it.

    Attributes:
        motion: [x; T x'], where T is the duration, shape (2, 3) [m].
        fraction: time on the primitive's own clock, divided by the duration. The phase is ``exp(-alpha fraction)``.
        target: start, goal and duration of the motion.
        rotation: state of the rotation; None when no rotation was learned.
        steps: length of the steps (as a fraction of the duration) and number of steps so far; None if the steps had
            different lengths.
        checked: the array ``motion`` that was last checked for finite numbers; None before the first check.
            ``DMP.step`` checks ``motion`` only if it is another array.
    """

    motion: Array
    fraction: float
    target: MovingTarget
    rotation: RotationState | None = None
    steps: tuple[float, int] | None = None
    checked: Array | None = None

    @property
    def position(self) -> Array:
        """Position (3,) [m]."""
        return self.motion[0]

    @property
    def velocity(self) -> Array:
        """Velocity (3,) [m/s]."""
        return self.motion[1] / self.target.duration

    @property
    def phase(self) -> float:
        """Phase s: 1 at the start and 0.01 at the end; afterwards, it decays to 0."""
        return float(np.exp(-DECAY * self.fraction))

    @property
    def time(self) -> float:
        """Time of the primitive's own clock [s]; it falls behind the wall clock when the robot lags."""
        return self.fraction * self.target.duration

    @property
    def quaternion(self) -> Array | None:
        """Rotation wxyz (4,), or None when no rotation was learned."""
        return None if self.rotation is None else self.rotation.quaternion


class DMP:
    r"""Dynamic movement primitive in the form of Hoffmann et al. (2009) and Pastor et al. (2009).

    .. math::
        \tau \dot v &= K (g - x) - D v - K (g - x_0) s + K f(s), \quad \tau \dot x = v, \quad \tau \dot s = -\alpha s

        f(s) &= \frac{\sum_i w_i \psi_i(s) s}{\sum_i \psi_i(s)}, \quad \psi_i(s) = \exp(-h_i (s - c_i)^2)

    Here, x is the position, x_0 the start, g the goal and s the phase. The time constant tau is the duration, so K and
    D have no unit. This form replaces thesis Eqs 2.8 to 2.12. Those equations scale the force by g - x_0, and therefore
    fail for an axis that does not move. The ``"critical"`` gains have D = 2 sqrt(K). The ``"thesis"`` gains K = 139.26,
    D = 28 have a damping ratio of 1.186. The first equation also describes a spring and damper that follow the moving
    target ``y(s) = g + f(s) + (x_0 - g) s``, which ends at the goal.

    **Fitting** (:func:`~imitarm.skills.dynamical_systems.fit_weights`) is ridge regression on the positions. Measured
    positions are not differentiated, and the samples need not be evenly spaced in time. The motion reaches the goal at
    the end of the duration.

    **Another start or goal**: let ``p`` be the fraction of the path that has been travelled. A second primitive with
    the weights w_p, which moves from 0 to 1, computes ``p``. The argument ``adjustment`` has three values:

    * ``"progress"``: the weights are w + delta w_p, where delta is the change of g - x_0. The change of start and goal
      is thus added in proportion to ``p``. The motion therefore rests where the demonstration rests. If the distance
      between start and goal is halved, the motion does not reverse. An axis without motion needs no special treatment.
    * ``"hoffmann"``: the weights are the learned w, as in the published method. The change of start and goal then takes
      effect as fast as the spring allows.
    * ``"rotodilatation"``: the weights w are rotated and scaled in the same way as g - x_0 (Ginesi et al. 2019), so the
      whole shape of the path is rotated and scaled.

    **Integration.** The integration is exact if the target is a parabola within each interval of 1/200 of the duration.
    Therefore ``step`` and ``generate`` give the same path, and the path does not depend on the step length.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.dynamical_systems.Gains`.
        n_basis: number N of basis functions.
        regularisation: weight of the penalty in the ridge regression, relative to the mean square response of a basis
            function.

    Attributes:
        gains_: stiffness and damping.
        weights_: w, shape (N, 3) [m].
        progress_weights_: w_p, shape (N,).
        start_: learned start x_0, shape (3,) [m].
        goal_: learned goal g, shape (3,) [m].
        start_velocity_: learned start velocity, shape (3,) [m/s].
        duration_: learned duration [s].
        path_length_: path length of the learned motion [m].
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
        self.gains_ = Gains.of(gains, "DMP")
        self.n_basis = whole_number(n_basis, "DMP: n_basis", at_least=2, at_most=2000)
        self.regularisation = finite_number(regularisation, "DMP: regularisation", above=0.0)

    def fit(self, trajectory: Trajectory, *, exact_ends: bool = False) -> Self:
        """Learn from one trajectory; its first time need not be 0.

        Args:
            trajectory: the motion to reproduce.
            exact_ends: whether the motion must start exactly at the first sample and end exactly at the last. If False,
                a first or last sample that is more than 0.1 mm away from the path fitted to all samples may count as
                noise. The motion then starts or ends on the fitted path.

        Raises:
            InputError: when the trajectory has fewer than 3 samples.
        """
        instance(trajectory, Trajectory, "DMP.fit: trajectory")
        flag(exact_ends, "DMP.fit: exact_ends")
        if len(trajectory) < 3:
            raise InputError(f"DMP.fit: needs at least 3 samples, got {len(trajectory)}")
        fraction = (trajectory.times - trajectory.times[0]) / trajectory.duration
        learned = fit_weights(
            fraction, trajectory.positions, self.gains_, self.n_basis, self.regularisation, exact_ends=exact_ends
        )
        self.weights_, self.progress_weights_ = learned.weights, learned.progress_weights
        self.start_, self.goal_, self.duration_ = learned.start, learned.goal, trajectory.duration
        self.start_velocity_, self.path_length_ = learned.start_rate / self.duration_, learned.path_length
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
        """Build a primitive from learned weights; the arguments become the attributes of the same names.

        Raises:
            InputError: when shapes disagree, a number is not finite, or the duration or a gain is not above 0.
        """
        what = "DMP.from_weights:"
        w = finite_array(weights, (None, 3), f"{what} weights", "m").copy()
        dmp = cls(gains, n_basis=len(w))
        dmp.weights_ = w
        dmp.progress_weights_ = finite_vector(progress_weights, len(w), f"{what} progress_weights").copy()
        dmp.start_ = finite_vector(start, 3, f"{what} start", "m").copy()
        dmp.goal_ = finite_vector(goal, 3, f"{what} goal", "m").copy()
        dmp.start_velocity_ = finite_vector(start_velocity, 3, f"{what} start_velocity", "m/s").copy()
        dmp.duration_ = finite_number(duration, f"{what} duration", "s", above=0.0)
        dmp.path_length_ = finite_number(path_length, f"{what} path_length", "m", at_least=0.0)
        if orientation is not None:
            instance(orientation, QuaternionDMP, f"{what} orientation")
        dmp.orientation_ = orientation
        return dmp

    @property
    def centers_(self) -> Array:
        """Centres c_i of the basis functions, shape (N,)."""
        return phase_basis(self.n_basis).centers

    @property
    def widths_(self) -> Array:
        """Widths h_i of the basis functions, shape (N,)."""
        return phase_basis(self.n_basis).widths

    def _check_fitted(self) -> None:
        if not hasattr(self, "weights_"):
            raise InputError("DMP: not fitted yet; call fit first")

    def progress(self, times: ArrayLike) -> Array:
        """Return p, the fraction of the learned path that has been travelled at ``times`` (n,) [s].

        Raises:
            InputError: when not fitted, or the times are not finite numbers.
        """
        self._check_fitted()
        t = finite_numbers(times, "DMP.progress: times", "s")
        return progress_at(t / self.duration_, self.progress_weights_, self.gains_)

    def _target(self, start: Array, goal: Array, duration: float, adjustment: Adjustment) -> MovingTarget:
        learned, asked = self.goal_ - self.start_, goal - start
        weights = self.weights_
        if adjustment == "progress":
            weights = weights + self.progress_weights_[:, None] * (asked - learned)
        elif adjustment == "rotodilatation":
            weights = weights @ rotodilatation(learned, asked, self.path_length_).T
        return MovingTarget(start, goal, duration, adjustment, weights - asked)

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
            start: a Pose, or a position (3,) [m] with the learned start rotation; None: the learned start.
            goal: a Pose, or a position (3,) [m] with the learned goal rotation; None: the learned goal.
            duration: duration of the motion [s]; None: the learned duration.
            start_velocity: start velocity (3,) [m/s]; None: the learned start velocity, scaled with the duration.
            adjustment: name of the method that changes the motion for another start and goal; the class describes the
                methods.

        Raises:
            InputError: when not fitted, a shape is wrong, or the duration is not above 0.
            UnknownNameError: when ``adjustment`` is not one of the three names.
        """
        self._check_fitted()
        choice(adjustment, ADJUSTMENTS, "adjustment")
        T = self.duration_ if duration is None else finite_number(duration, "DMP: duration", "s", above=0.0)
        x0 = _position(start, self.start_, "start")
        target = self._target(x0, _position(goal, self.goal_, "goal"), T, adjustment)
        rate = self.start_velocity_ * self.duration_
        if start_velocity is not None:
            rate = finite_vector(start_velocity, 3, "DMP: start_velocity", "m/s") * T
        rotation = None
        if self.orientation_ is not None:
            ends = [end.quaternion if isinstance(end, Pose) else None for end in (start, goal)]
            rotation = self.orientation_.begin(*ends)
        return DMPState(np.stack([x0, rate]), 0.0, target, rotation)

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
            state: state returned by :meth:`begin` or by the last step.
            dt: length of the step [s], above 0.
            goal: new goal position (3,) [m], which applies from this step on; None: the goal stays.
            coupling: function from position (3,) [m] and velocity (3,) [m/s] to an acceleration (3,) [m/s^2] that is
                added during this step, for example away from an obstacle. If ``coupling`` returns six numbers, the last
                three are an angular acceleration [rad/s^2].
            measured: measured position of the robot (3,) [m]. The lag is the distance between this position and the
                primitive's own position. The primitive's clock slows down by the factor ``1 / (1 + lag / patience)``
                (phase stopping), so the primitive waits for a robot that lags behind.
            patience: lag at which the primitive's clock runs at half speed [m].

        Raises:
            InputError: when an argument is not finite or has a wrong shape, when ``dt`` is 0, negative or longer than
                100 durations, or when ``patience`` is not above 0.
        """
        if type(state) is not DMPState:
            instance(state, DMPState, "DMP.step: state")
        before, fraction, target, rotation, steps, checked = state
        if checked is not before:
            self._check_fitted()
            finite_array(before, (2, 3), "DMP.step: motion of the state")
        if goal is not None:
            asked = finite_vector(goal, 3, "DMP.step: goal", "m")
            if not np.array_equal(asked, target.goal):
                target = self._target(target.start, asked.copy(), target.duration, target.adjustment)
                steps = None
        h = dt / target.duration if type(dt) is float else 0.0
        if not _SHORTEST_STEP < h <= 1.0 or measured is not None:
            h = _step_length(dt, target.duration, before[0], measured, patience)
        done = 0
        if steps is not None:
            done = steps[1] if steps[0] == h else -1
        elif fraction > 0.0:
            done = -1
        plan = target.plan(self.gains_, h) if done >= 0 else None
        if plan is not None and done < len(plan.pushes):
            motion = plan.transition.dot(before) + plan.pushes[done]  # dot: @ is slower on small arrays
        else:
            one = propagator(self.gains_, h, self.n_basis)
            y = target.at(np.exp(-DECAY * (fraction + one.instants)))
            motion = one.transition.dot(before) + one.drive.dot(y)
        angular = None
        if coupling is not None:
            T = target.duration
            acceleration = _acceleration(coupling, before[0], before[1] / T) * (T * T)
            motion += propagator(self.gains_, h, self.n_basis).push[:, None] * acceleration[:3]
            angular = acceleration[3:] if len(acceleration) == 6 else None
        if rotation is not None and self.orientation_ is not None:
            rotation = self.orientation_.step(rotation, h, angular)
        if done < 0:
            return _state(DMPState, (motion, fraction + h, target, rotation, None, motion))
        return _state(DMPState, (motion, (done + 1) * h, target, rotation, (h, done + 1), motion))

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

        The time between two samples is approximately ``dt``: the duration divided by the nearest whole number of steps.

        Args:
            start: see :meth:`begin`.
            goal: see :meth:`begin`.
            duration: see :meth:`begin`.
            dt: step [s].
            start_velocity: see :meth:`begin`.
            adjustment: see :meth:`begin`.
            coupling: see :meth:`step`.

        Raises:
            InputError: for the same reasons as :meth:`begin`, and when ``dt`` is 0, negative or longer than the
                duration.
        """
        state = self.begin(start, goal, duration, start_velocity=start_velocity, adjustment=adjustment)
        T = state.target.duration
        n = number_of_steps(T, dt, "DMP.generate")
        times = np.linspace(0.0, T, n + 1)
        if coupling is not None:
            states = [state]
            for _ in range(n):
                states.append(self.step(states[-1], T / n, coupling=coupling))
            quaternions = None
            if state.rotation is not None:
                quaternions = np.stack([s.rotation.quaternion for s in states if s.rotation is not None])
            return Trajectory(times, np.stack([s.position for s in states]), quaternions)
        one = propagator(self.gains_, 1.0 / n, self.n_basis)
        positions = roll_out(one, state.motion, state.target.on_grid(n * one.n_parts))[0]
        if self.orientation_ is None or state.rotation is None:
            return Trajectory(times, positions)
        return Trajectory(times, positions, self.orientation_.target(state.rotation, times / T))


def number_of_steps(duration: float, dt: float, what: str) -> int:
    """Return ``round(duration / dt)``.

    Raises:
        InputError: when ``dt`` [s] is 0, negative or longer than the duration, or when there are more than 10 million
            steps.
    """
    steps = duration / finite_number(dt, f"{what}: dt", "s", above=0.0)
    if not 1.0 - _ROUNDING <= steps <= MOST_STEPS:
        raise InputError(
            f"{what}: dt must be at most the duration {duration:g} s and give at most {MOST_STEPS:,} steps, "
            f"got {dt!r} s"
        )
    return round(steps)


def _position(value: Pose | ArrayLike | None, default: Array, what: str) -> Array:
    """Return a position that shares no memory with ``value``, shape (3,)."""
    if value is None:
        return default.copy()
    if isinstance(value, Pose):
        return value.position
    return finite_vector(value, 3, f"DMP: {what} (a Pose or a position)", "m").copy()


def _step_length(dt: float, duration: float, position: Array, measured: ArrayLike | None, patience: float) -> float:
    """Return the length of a step as a fraction of the duration; if the robot lags, the step is shorter."""
    h = finite_number(dt, "DMP.step: dt", "s", above=0.0, at_most=_LONGEST_STEP * duration) / duration
    if measured is not None:
        lag = finite_vector(measured, 3, "DMP.step: measured", "m") - position
        h /= 1.0 + math.hypot(*lag) / finite_number(patience, "DMP.step: patience", "m", above=0.0)
    return max(h, _SHORTEST_STEP)


def _acceleration(coupling: Coupling, position: Array, velocity: Array) -> Array:
    added = function(coupling, "DMP: coupling")(position, velocity)
    acceleration = finite_array(added, (None,), "DMP: acceleration that coupling returns", "m/s^2, rad/s^2")
    if len(acceleration) not in (3, 6):
        raise InputError(f"DMP: coupling must return 3 or 6 numbers, got {len(acceleration)}")
    return acceleration
