"""Movement primitive of the rotation, for turns of any size."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from imitarm.errors import InputError
from imitarm.kinematics.pose import (
    checked_unit_quaternions,
    continuous_signs,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
)
from imitarm.skills.spring import Gains, gains_named, propagator
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_DEGREE = 3
_END_WEIGHT = 100.0  # the first and the last sample count so much more than the others


class Turn(NamedTuple):
    """Where the rotation is.

    Attributes:
        quaternion: wxyz, shape (4,).
        offset: [r; T r'], what has pushed the rotation off its target, rotation vector in the base frame,
            shape (2, 3) [rad].
        share: of the duration that is over.
        start_change: rotation vector (3,) [rad] from the learnt start to the one asked for, in the base frame.
        goal_change: likewise for the goal.
    """

    quaternion: Array
    offset: Array
    share: float
    start_change: Array
    goal_change: Array


class QuaternionDMP:
    r"""A spring and damper about a learnt, moving target rotation.

    The positional primitive is a spring to a moving target, ``tau^2 x'' = K (y(s) - x) - D tau x'``. A rotation does
    the same in the tangent space of its moving target ``R_y``:

    .. math::
        r = \log(R R_y(s)^T), \qquad \tau^2 \ddot r = -K r - D \tau \dot r + \tau^2 c

    Only ``r``, the distance from the target, goes through a logarithm, never the distance to the goal: a turn of 270
    degrees, or of three full turns, is reproduced as it was shown. (Forms that use log(q_goal conj(q)) take the
    other way round beyond 180 degrees.) The target is a cubic spline through sign-continuous quaternions, scaled to
    length one. Another start or goal turns the target in the base frame, blended by a minimum-jerk profile b:
    ``exp((1 - b) d_start) exp(b d_goal) R_y``; both changes take the short way.

    Args:
        gains: ``"critical"``, ``"thesis"`` or :class:`~imitarm.skills.spring.Gains`.
        n_pieces: number of pieces of the spline; fewer when there are few samples.

    Attributes:
        gains_: stiffness and damping.
        knots_: of the spline over the share of the duration, clamped at 0 and 1.
        coefficients_: of the spline, shape (len(knots_) - 4, 4).
    """

    knots_: Array
    coefficients_: Array

    def __init__(self, gains: str | Gains = "critical", *, n_pieces: int = 50) -> None:
        if n_pieces < 1:
            raise InputError(f"QuaternionDMP: n_pieces must be at least 1, got {n_pieces!r}")
        self.gains_ = gains_named(gains) if isinstance(gains, str) else Gains(*gains)
        self.n_pieces = n_pieces

    def fit(self, trajectory: Trajectory, *, exact_ends: bool = False) -> Self:
        """Learn from one trajectory with quaternions.

        Args:
            trajectory: the motion to reproduce.
            exact_ends: start and end exactly at the first and the last rotation, instead of smoothing them.

        Raises:
            InputError: when it has no quaternions, or neighbouring samples are so far apart that the way between
                them is not known.
        """
        if trajectory.quaternions is None:
            raise InputError("QuaternionDMP.fit: the trajectory has no quaternions")
        share = (trajectory.times - trajectory.times[0]) / trajectory.duration
        quaternions = trajectory.quaternions
        jumps = np.linalg.norm(
            quaternion_log(quaternion_multiply(quaternions[1:], quaternion_conjugate(quaternions[:-1]))), axis=1
        )
        if jumps.max() > 0.5 * np.pi:
            row = int(np.argmax(jumps)) + 1
            raise InputError(
                f"QuaternionDMP.fit: row {row} is turned by {np.rad2deg(jumps.max()):.0f} degrees from the row before; "
                "the way between them is not known. Record faster, or repair the row"
            )
        if len(share) <= _DEGREE + 1:  # too few for a spline of that degree: fill in along the shortest arcs
            dense = trajectory.resample(4 * (_DEGREE + 1))
            return self.fit(dense, exact_ends=exact_ends)
        pieces = max(1, min(self.n_pieces, (len(share) - _DEGREE) // 3))
        inner = np.quantile(share, np.linspace(0.0, 1.0, pieces + 1)[1:-1])  # as many samples in each piece
        knots = np.concatenate([np.zeros(_DEGREE + 1), inner, np.ones(_DEGREE + 1)])
        weights = np.ones(len(share))
        weights[[0, -1]] = _END_WEIGHT
        spline = make_lsq_spline(share, quaternions, knots, k=_DEGREE, w=weights)
        coefficients = np.array(spline.c)
        if exact_ends:  # a clamped spline passes through its first and its last coefficient
            coefficients[[0, -1]] = quaternions[[0, -1]]
        self._take(knots, coefficients)
        return self

    @classmethod
    def from_spline(cls, knots: ArrayLike, coefficients: ArrayLike, gains: Gains) -> QuaternionDMP:
        """Build from a spline that was learnt before.

        Raises:
            InputError: when the knots don't run from 0 to 1 in order, shapes disagree, or the spline passes near zero,
                where it is no rotation.
        """
        t, c = np.array(knots, dtype=float), np.array(coefficients, dtype=float)
        if t.ndim != 1 or c.shape != (len(t) - _DEGREE - 1, 4) or len(c) <= _DEGREE or not np.all(np.isfinite(c)):
            raise InputError(f"QuaternionDMP.from_spline: shapes {t.shape} and {c.shape} don't belong together")
        ends = np.all(t[: _DEGREE + 1] == 0.0) and np.all(t[-_DEGREE - 1 :] == 1.0)
        if not (ends and np.all(np.diff(t) >= 0.0)):
            raise InputError("QuaternionDMP.from_spline: knots must run from 0 to 1, four times at each end")
        dmp = cls(gains)
        dmp._take(t, c)
        if np.linalg.norm(dmp._spline(np.linspace(0.0, 1.0, 20 * len(c))), axis=1).min() < 0.5:
            raise InputError("QuaternionDMP.from_spline: the spline is far from unit length, so it is no rotation")
        return dmp

    def _take(self, knots: Array, coefficients: Array) -> None:
        self.knots_, self.coefficients_ = knots, coefficients
        self.__dict__.pop("_spline", None)

    @cached_property
    def _spline(self) -> BSpline:
        return BSpline(self.knots_, self.coefficients_, _DEGREE)

    def _learnt(self, share: Array) -> Array:
        """Return the target as learnt, shape (len(share), 4)."""
        q = self._spline(np.clip(share, 0.0, 1.0))
        return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))

    @property
    def start_(self) -> Array:
        """Learnt start rotation wxyz, shape (4,)."""
        return self._learnt(np.zeros(1))[0]

    @property
    def goal_(self) -> Array:
        """Learnt goal rotation wxyz, shape (4,)."""
        return self._learnt(np.ones(1))[0]

    def begin(self, start: Array | None = None, goal: Array | None = None) -> Turn:
        """Return the state at the start of a motion.

        Args:
            start: rotation wxyz (4,); None: as learnt.
            goal: likewise.

        Raises:
            InputError: when not fitted, or a quaternion is not of length one.
        """
        if not hasattr(self, "coefficients_"):
            raise InputError("QuaternionDMP: not fitted yet; call fit first")
        changes = []
        for asked, learnt, what in ((start, self.start_, "start"), (goal, self.goal_, "goal")):
            if asked is None:
                changes.append(np.zeros(3))
                continue
            q = checked_unit_quaternions(asked, f"QuaternionDMP {what}")
            changes.append(quaternion_log(quaternion_multiply(q, quaternion_conjugate(learnt))))
        turn = Turn(np.empty(4), np.zeros((2, 3)), 0.0, *changes)
        return turn._replace(quaternion=self.target(turn, np.zeros(1))[0])

    def target(self, turn: Turn, share: Array) -> Array:
        """Return the target rotations (n, 4) wxyz at shares (n,) of the duration, for the ends that ``turn`` has."""
        return with_other_ends(self._learnt(share), share, turn.start_change, turn.goal_change)

    def step(self, turn: Turn, step: float, acceleration: Array | None = None) -> Turn:
        """Return the state after ``step`` of the duration.

        Args:
            turn: from :meth:`begin` or the last step.
            step: share of the duration.
            acceleration: T^2 times an angular acceleration (3,) [rad] in the base frame, held during the step.
        """
        one = propagator(self.gains_, step)
        offset = one.transition @ turn.offset
        if acceleration is not None:
            offset = offset + one.push[:, None] * acceleration
        share = turn.share + step
        q = quaternion_multiply(quaternion_exp(offset[0]), self.target(turn, np.array([share]))[0])
        q = -q if q @ turn.quaternion < 0.0 else q
        return turn._replace(quaternion=q, offset=offset, share=share)


def with_other_ends(quaternions: Array, share: Array, start_change: Array, goal_change: Array) -> Array:
    """Return ``exp((1 - b) d_start) exp(b d_goal) R`` with b the minimum-jerk profile, quaternions wxyz (n, 4).

    Args:
        quaternions: R, the learned rotations wxyz, shape (n, 4).
        share: fraction of the duration at each of them, shape (n,).
        start_change: d_start, rotation vector in the base frame, shape (3,) [rad].
        goal_change: d_goal, likewise.
    """
    u = np.clip(share, 0.0, 1.0)[:, None]
    blend = u**3 * (10.0 + u * (6.0 * u - 15.0))
    q = quaternion_multiply(quaternion_exp(blend * goal_change), quaternions)
    return continuous_signs(quaternion_multiply(quaternion_exp((1.0 - blend) * start_change), q))
