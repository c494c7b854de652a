"""Rotations in skills: rotation vectors relative to a reference (for mixtures), and a rotation primitive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, CubicSpline, make_lsq_spline

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    checked_unit_quaternions,
    continuous_signs,
    mean_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    slerp,
)
from imitarm.skills.dynamical_systems import Gains, propagator
from imitarm.trajectory import Trajectory
from imitarm.validation import (
    finite_array,
    finite_number,
    finite_numbers,
    finite_vector,
    flag,
    instance,
    whole_number,
)

Array = NDArray[np.float64]

_CLOSED = 0.1  # net motion below this fraction of the path length gives no direction to rotate and stretch by
_FARTHEST = np.deg2rad(120.0)  # from the reference; beyond 180 degrees the logarithm reverses its direction
_KEYS = (1, 5, 9, 17, 33)  # numbers of key rotations that are tried
_DEGREE = 3
_END_WEIGHT = 100.0  # the first and the last sample count so much more than the others


@dataclass(frozen=True, eq=False)
class RotationReference:
    """A fixed or moving reference rotation; other rotations are represented as rotation vectors relative to it.

    A rotation ``R`` near the reference ``R_ref(t)`` has the rotation vector ``r = log(R R_ref(t)^T)`` [rad] in the base
    frame. A fixed reference suffices if all rotations differ from it by clearly less than 180 degrees. Otherwise, the
    reference moves along a normalised cubic spline through a few quaternions (the keys).

    Attributes:
        times: times of the keys [s], strictly increasing, shape (m,); a single key is a fixed reference.
        quaternions: keys wxyz with continuous signs, shape (m, 4).

    Raises:
        InputError: when shapes disagree, a number is not finite, a quaternion is not of length one, or the times do not
            increase.
    """

    times: Array
    quaternions: Array

    def __post_init__(self) -> None:
        times = finite_array(self.times, (None,), "RotationReference: times", "s").copy()
        given = finite_array(self.quaternions, (len(times), 4), "RotationReference: quaternions")
        quaternions = checked_unit_quaternions(given, "RotationReference: quaternions")
        if np.allclose(quaternions, given, rtol=0.0, atol=1e-12):
            quaternions = given.copy()  # normalising again would change the last bit
        quaternions = continuous_signs(quaternions)
        if len(times) < 1 or np.any(np.diff(times) <= 0.0):
            raise InputError(
                "RotationReference: times must contain at least one number, each later than the one before [s]"
            )
        times.setflags(write=False)
        quaternions.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "quaternions", quaternions)

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, self.quaternions)

    def at(self, times: ArrayLike) -> Array:
        """Return the reference (n, 4) wxyz at ``times`` (n,) [s]; outside the keys' time span, the nearest key."""
        t = finite_numbers(times, "RotationReference: times", "s")
        if len(self.times) == 1:
            return np.repeat(self.quaternions, len(t), axis=0)
        q = self._spline(np.clip(t, self.times[0], self.times[-1]))
        return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))

    def to_vectors(self, times: ArrayLike, quaternions: ArrayLike) -> Array:
        """Return rotation vectors (n, 3) [rad] of rotations (n, 4) wxyz at ``times`` (n,); q and -q give the same."""
        reference = self.at(times)
        q = finite_array(quaternions, (len(reference), 4), "RotationReference: quaternions")
        return quaternion_log(quaternion_multiply(q, quaternion_conjugate(reference)))

    def to_quaternions(self, times: ArrayLike, vectors: ArrayLike) -> Array:
        """Return rotations (n, 4) wxyz, with continuous signs, of rotation vectors (n, 3) [rad] at ``times`` (n,)."""
        reference = self.at(times)
        r = finite_array(vectors, (len(reference), 3), "RotationReference: vectors", "rad")
        return continuous_signs(quaternion_multiply(quaternion_exp(r), reference))

    @classmethod
    def among(cls, demonstrations: Sequence[tuple[Array, Array]]) -> RotationReference:
        """Return the simplest reference that is within 120 degrees of all demonstrated rotations.

        If possible, the reference is the mean rotation. Otherwise, it is a spline through the mean rotations at 5, 9,
        17 or 33 instants.

        Args:
            demonstrations: one pair for each demonstration: times (n,) [s] on a common clock, and quaternions (n, 4)
                wxyz.

        Raises:
            InputError: when no such reference exists, because the rotations of the demonstrations differ too much at
                the same time.
        """
        end = min(float(times[-1]) for times, _ in demonstrations)
        farthest = np.inf
        for m in _KEYS:
            keys = np.linspace(0.0, end, m) if m > 1 else np.zeros(1)
            if m == 1:
                quaternions = mean_quaternion(np.concatenate([q for _, q in demonstrations]))[None]
            else:
                at_keys = np.stack([slerp(keys, times, q) for times, q in demonstrations])
                quaternions = np.stack([mean_quaternion(at_keys[:, k]) for k in range(m)])
            reference = cls(keys, quaternions)
            angles = [np.linalg.norm(reference.to_vectors(t, q), axis=1).max() for t, q in demonstrations]
            if max(angles) <= _FARTHEST:
                return reference
            farthest = min(farthest, float(max(angles)))
        worst = int(np.argmax(angles))
        raise InputError(
            f"orientations differ by up to {np.rad2deg(farthest):.0f} degrees at the same time, most in demonstration "
            f"{worst}: the demonstrations do not rotate in the same way. Align them first, learn them as separate "
            "skills, or show them with a tool that keeps its orientation (imitarm retarget --orientation fixed)"
        )


def left_jacobian(vectors: Array) -> Array:
    """Return J (n, 3, 3) of rotation vectors r (n, 3) [rad], with ``exp(r + d) = exp(J d) exp(r)`` for small d.

    If ``Sigma`` is the covariance of r, then ``J Sigma J^T`` is the covariance of the small rotation in the base frame.
    """
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross))


class RotationState(NamedTuple):
    """State of the rotation during a motion.

    Attributes:
        quaternion: rotation wxyz, shape (4,).
        offset: [r; T r'], shape (2, 3) [rad]. T is the duration, and r is the rotation vector from the target to the
            actual rotation, in the base frame. Without a coupling, the offset is 0.
        fraction: elapsed fraction of the duration.
        start_change: rotation vector (3,) [rad] from the learned start to the new start, in the base frame.
        goal_change: rotation vector (3,) [rad] from the learned goal to the new goal, in the base frame.
    """

    quaternion: Array
    offset: Array
    fraction: float
    start_change: Array
    goal_change: Array


class QuaternionDMP:
    r"""A spring and damper that follows a learned, moving target rotation.

    The primitive of the position is a spring to a moving target, ``tau^2 x'' = K (y(s) - x) - D tau x'``. A rotation
    follows its moving target ``R_y`` in the same way, in the tangent space at ``R_y``:

    .. math::
        r = \log(R R_y(s)^T), \qquad \tau^2 \ddot r = -K r - D \tau \dot r + \tau^2 c

    Here, c is an external angular acceleration. The logarithm is applied only to ``R R_y^T``, the rotation from the
    target to ``R``, and not to the rotation from ``R`` to the goal rotation. Therefore, the primitive can reproduce a
    rotation by 270 degrees, or by three full revolutions. (Formulations that use log(q_goal conj(q)) rotate in the
    opposite direction beyond 180 degrees.) The target is a normalised cubic spline through quaternions with continuous
    signs. For another start or goal, the target is rotated in the base frame by ``d_start`` at the start and by
    ``d_goal`` at the goal. A minimum-jerk profile b, from 0 to 1, blends these two rotations: ``exp((1 - b) d_start)
    exp(b d_goal) R_y``. Both ``d_start`` and ``d_goal`` are rotations by at most 180 degrees.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.dynamical_systems.Gains`.
        n_pieces: largest number of pieces of the spline; if there are few samples, the spline has fewer pieces.

    Attributes:
        gains_: stiffness and damping.
        knots_: knots of the spline, as fractions of the duration; 0 and 1 occur four times each.
        coefficients_: coefficients of the spline, shape (len(knots_) - 4, 4).
    """

    knots_: Array
    coefficients_: Array

    def __init__(self, gains: str | Gains = "critical", *, n_pieces: int = 50) -> None:
        self.gains_ = Gains.of(gains, "QuaternionDMP")
        self.n_pieces = whole_number(n_pieces, "QuaternionDMP: n_pieces", at_least=1, at_most=10_000)

    def fit(self, trajectory: Trajectory, *, exact_ends: bool = False) -> Self:
        """Learn from one trajectory with quaternions.

        Args:
            trajectory: the motion to reproduce.
            exact_ends: whether the motion must start and end exactly at the first and the last rotation. If False,
                these rotations are smoothed too, but less than the others.

        Raises:
            InputError: when ``trajectory`` has no quaternions, or two neighbouring rotations are more than 90 degrees
                apart, so that the rotation between them is ambiguous.
        """
        instance(trajectory, Trajectory, "QuaternionDMP.fit: trajectory")
        flag(exact_ends, "QuaternionDMP.fit: exact_ends")
        if trajectory.quaternions is None:
            raise InputError("QuaternionDMP.fit: the trajectory has no quaternions")
        fraction = (trajectory.times - trajectory.times[0]) / trajectory.duration
        quaternions = trajectory.quaternions
        jumps = np.linalg.norm(
            quaternion_log(quaternion_multiply(quaternions[1:], quaternion_conjugate(quaternions[:-1]))), axis=1
        )
        if jumps.max() > 0.5 * np.pi:
            row = int(np.argmax(jumps)) + 1
            raise InputError(
                f"QuaternionDMP.fit: row {row} is rotated by {np.rad2deg(jumps.max()):.0f} degrees from the row "
                "before, so the rotation between them is ambiguous. Record at a higher rate, or repair the row"
            )
        if len(fraction) <= _DEGREE + 1:  # too few for a cubic spline: interpolate along the shortest arcs
            dense = trajectory.resample(4 * (_DEGREE + 1))
            return self.fit(dense, exact_ends=exact_ends)
        pieces = max(1, min(self.n_pieces, (len(fraction) - _DEGREE) // 3))
        inner = np.quantile(fraction, np.linspace(0.0, 1.0, pieces + 1)[1:-1])  # as many samples in each piece
        knots = np.concatenate([np.zeros(_DEGREE + 1), inner, np.ones(_DEGREE + 1)])
        weights = np.ones(len(fraction))
        weights[[0, -1]] = _END_WEIGHT
        spline = make_lsq_spline(fraction, quaternions, knots, k=_DEGREE, w=weights)
        coefficients = np.array(spline.c)
        if exact_ends:  # a clamped spline passes through its first and its last coefficient
            coefficients[[0, -1]] = quaternions[[0, -1]]
        self._take(knots, coefficients)
        return self

    @classmethod
    def from_spline(cls, knots: ArrayLike, coefficients: ArrayLike, gains: Gains) -> QuaternionDMP:
        """Build a primitive from a learned spline; the arguments become the attributes of the same names.

        Raises:
            InputError: when the knots don't increase from 0 to 1, shapes disagree, or the spline comes near the zero
                quaternion, which is not a rotation.
        """
        t = finite_array(knots, (None,), "QuaternionDMP.from_spline: knots").copy()
        c = finite_array(coefficients, (None, 4), "QuaternionDMP.from_spline: coefficients").copy()
        if len(c) != len(t) - _DEGREE - 1 or len(c) <= _DEGREE:
            raise InputError(
                f"QuaternionDMP.from_spline: {len(t)} knots need {len(t) - _DEGREE - 1} coefficients, and at least "
                f"{_DEGREE + 1} are needed; got {len(c)}"
            )
        ends = np.all(t[: _DEGREE + 1] == 0.0) and np.all(t[-_DEGREE - 1 :] == 1.0)
        if not (ends and np.all(np.diff(t) >= 0.0)):
            raise InputError(
                "QuaternionDMP.from_spline: knots must increase from 0 to 1, and contain 0 and 1 four times each"
            )
        dmp = cls(gains)
        dmp._take(t, c)
        if np.linalg.norm(dmp._spline(np.linspace(0.0, 1.0, 20 * len(c))), axis=1).min() < 0.5:
            raise InputError("QuaternionDMP.from_spline: the spline is far from unit length, so it is not a rotation")
        return dmp

    def _take(self, knots: Array, coefficients: Array) -> None:
        self.knots_, self.coefficients_ = knots, coefficients
        self.__dict__.pop("_spline", None)

    @cached_property
    def _spline(self) -> BSpline:
        return BSpline(self.knots_, self.coefficients_, _DEGREE)

    def _learned(self, fraction: Array) -> Array:
        """Return the learned target, shape (len(fraction), 4)."""
        self._check_fitted()
        q = self._spline(np.clip(fraction, 0.0, 1.0))
        return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))

    @property
    def start_(self) -> Array:
        """Learned start rotation wxyz, shape (4,)."""
        return self._learned(np.zeros(1))[0]

    @property
    def goal_(self) -> Array:
        """Learned goal rotation wxyz, shape (4,)."""
        return self._learned(np.ones(1))[0]

    def _check_fitted(self) -> None:
        if not hasattr(self, "coefficients_"):
            raise InputError("QuaternionDMP: not fitted yet; call fit first")

    def begin(self, start: ArrayLike | None = None, goal: ArrayLike | None = None) -> RotationState:
        """Return the state at the start of a motion.

        Args:
            start: rotation wxyz (4,); None: the learned start.
            goal: rotation wxyz (4,); None: the learned goal.

        Raises:
            InputError: when not fitted, or a quaternion is not of length one.
        """
        self._check_fitted()
        changes = []
        for asked, learned, what in ((start, self.start_, "start"), (goal, self.goal_, "goal")):
            if asked is None:
                changes.append(np.zeros(3))
                continue
            q = finite_vector(asked, 4, f"QuaternionDMP: {what}")
            q = checked_unit_quaternions(q, f"QuaternionDMP: {what}")
            changes.append(quaternion_log(quaternion_multiply(q, quaternion_conjugate(learned))))
        state = RotationState(np.empty(4), np.zeros((2, 3)), 0.0, *changes)
        return state._replace(quaternion=self.target(state, np.zeros(1))[0])

    def target(self, state: RotationState, fraction: ArrayLike) -> Array:
        """Return the target rotations (n, 4) wxyz of ``state``'s motion at fractions (n,) of the duration.

        Raises:
            InputError: when not fitted, or an argument is not valid.
        """
        instance(state, RotationState, "QuaternionDMP.target: state")
        f = finite_array(fraction, (None,), "QuaternionDMP.target: fraction")
        return with_other_ends(self._learned(f), f, state.start_change, state.goal_change)

    def step(self, state: RotationState, step: float, acceleration: ArrayLike | None = None) -> RotationState:
        """Return the state one step later.

        Args:
            state: state returned by :meth:`begin` or by the last step.
            step: length of the step as a fraction of the duration, above 0.
            acceleration: T^2 times an angular acceleration (3,) [rad] in the base frame, constant during the step; T is
                the duration.

        Raises:
            InputError: when not fitted, or an argument is not valid.
        """
        instance(state, RotationState, "QuaternionDMP.step: state")
        self._check_fitted()
        one = propagator(self.gains_, finite_number(step, "QuaternionDMP.step: step", at_least=1e-100, at_most=100.0))
        offset = one.transition @ state.offset
        if acceleration is not None:
            offset = offset + one.push[:, None] * finite_vector(acceleration, 3, "QuaternionDMP.step: acceleration")
        fraction = state.fraction + step
        q = quaternion_multiply(quaternion_exp(offset[0]), self.target(state, np.array([fraction]))[0])
        q = -q if q @ state.quaternion < 0.0 else q
        return state._replace(quaternion=q, offset=offset, fraction=fraction)


def with_other_ends(quaternions: Array, fraction: Array, start_change: Array, goal_change: Array) -> Array:
    """Return ``exp((1 - b) d_start) exp(b d_goal) R`` as quaternions wxyz (n, 4); b is the minimum-jerk profile.

    Args:
        quaternions: R, the learned rotations wxyz, shape (n, 4).
        fraction: time of each rotation, as a fraction of the duration, shape (n,).
        start_change: d_start, rotation vector in the base frame, shape (3,) [rad].
        goal_change: d_goal, rotation vector in the base frame, shape (3,) [rad].
    """
    u = np.clip(fraction, 0.0, 1.0)[:, None]
    blend = u**3 * (10.0 + u * (6.0 * u - 15.0))
    q = quaternion_multiply(quaternion_exp(blend * goal_change), quaternions)
    return continuous_signs(quaternion_multiply(quaternion_exp((1.0 - blend) * start_change), q))


def rotodilatation(learned: Array, asked: Array, path_length: float) -> Array:
    """Return the matrix (3, 3) that maps ``learned`` to ``asked`` by the smallest possible rotation and a scaling.

    The method follows Ginesi, Sansonetto and Fiorini (2019), "DMP++". If the learned motion ends near its start, the
    vector between them is not meaningful, and the result is the identity.

    Args:
        learned: vector from the learned start to the learned goal, shape (3,) [m].
        asked: vector from the start to the goal of the new motion, shape (3,) [m].
        path_length: path length of the learned motion [m].
    """
    a, b = float(np.linalg.norm(learned)), float(np.linalg.norm(asked))
    if a <= _CLOSED * path_length or a == 0.0:
        return np.eye(3)
    if b == 0.0:
        return np.zeros((3, 3))
    u, v = learned / a, asked / b
    cosine = float(u @ v)
    if cosine < -1.0 + 1e-9:  # straight back: 180 degrees about any perpendicular axis
        axis = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
        axis /= np.linalg.norm(axis)
        return np.asarray((b / a) * (2.0 * np.outer(axis, axis) - np.eye(3)))
    w = np.cross(u, v)
    cross = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray((b / a) * (np.eye(3) + cross + cross @ cross / (1.0 + cosine)))
