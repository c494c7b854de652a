"""DemonstratedMotion: the motion of a person's arm and of the robot, and a check for infeasible parts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_to_matrix, slerp
from imitarm.retarget.arm_estimator import ArmEstimate, ArmEstimator
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.engagement import Engagement, EngagementRule

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SINGULAR = 0.03  # smallest singular value of the tool's Jacobian, in m and rad, of a feasible posture
STRETCHED = 0.79 / 0.80  # largest distance of the wrist from the shoulder, as a fraction of the reach
ELBOW = 3  # index of the elbow joint; at zero the arm is straight
DILATION = 0.2  # [s] by which an infeasible segment is extended on both sides
_WITHIN = 1e-6  # [rad] tolerance of a position limit


@dataclass(frozen=True, eq=False)
class DemonstratedMotion:
    """The motion during one engagement (a time in which the robot follows the person), sampled at the control period.

    Attributes:
        shown_times: time at which the person showed each sample, on the clock of the recording, shape (n,) [s]. After a
            correction that slows the motion down, the times are closer together than the control period.
        points: shoulder, elbow and wrist in the base frame, with all corrections so far, shape (n, 3, 3) [m].
        hands: rotations of the hand, quaternions wxyz, shape (n, 4).
        shown: shoulder, elbow and wrist in the base frame, without corrections, shape (n, 3, 3) [m].
        closed: whether the hand was closed at each sample; None if this is not known.
        joints: joint positions of the robot, shape (n, n_joints) [rad]; shape (n, 0) before they are computed.
    """

    shown_times: Array
    points: Array
    hands: Array
    shown: Array
    closed: tuple[bool | None, ...]
    joints: Array

    @classmethod
    def through(cls, estimates: Sequence[ArmEstimate], dt: float) -> DemonstratedMotion:
        """Interpolate the estimates of one engagement (at least two) at intervals of ``dt`` [s], without overshoot."""
        times = np.array([e.time for e in estimates])
        shown_times = times[0] + dt * np.arange(int((times[-1] - times[0]) / dt + 1e-9) + 1)
        keys = np.array([(e.shoulder, e.elbow, e.wrist) for e in estimates])
        points = np.asarray(PchipInterpolator(times, keys)(np.clip(shown_times, times[0], times[-1])))
        hands = slerp(shown_times, times, np.array([e.hand for e in estimates]))
        last = np.searchsorted(times, shown_times + 1e-9, side="right") - 1
        closed = tuple(estimates[int(i)].closed for i in last)
        return cls(shown_times, points, hands, points, closed, np.empty((len(shown_times), 0)))

    def __len__(self) -> int:
        return len(self.shown_times)

    def estimate(self, i: int) -> ArmEstimate:
        """Return sample ``i`` as an estimate of the person's arm."""
        s, e, w = self.points[i]
        rest = np.zeros(3)
        return ArmEstimate(
            float(self.shown_times[i]), s, e, w, rest, self.hands[i], rest, (1.0, 1.0, 1.0), self.closed[i]
        )

    def estimates(self) -> Iterator[ArmEstimate]:
        """Yield all samples as estimates."""
        return map(self.estimate, range(len(self)))

    def at(self, where: Array) -> DemonstratedMotion:
        """Return the motion, interpolated at the sample numbers ``where``, which need not be whole, shape (m,).

        For example, the sample numbers 0, 0.5, 1, ... give the motion at half the speed.
        """
        n = np.arange(len(self))
        near = tuple(self.closed[int(i)] for i in np.clip(where.astype(int), 0, len(self) - 1))

        def read(columns: Array) -> Array:
            flat = columns.reshape(len(self), -1)
            values = [np.interp(where, n, column) for column in flat.T]
            return np.stack(values, axis=1).reshape(len(where), *columns.shape[1:])

        hands = slerp(where, n.astype(float), self.hands)
        shown_times = np.interp(where, n, self.shown_times)
        return DemonstratedMotion(shown_times, read(self.points), hands, read(self.shown), near, read(self.joints))

    def with_joints(self, joints: Array) -> DemonstratedMotion:
        """Return the motion with other joints, shape (n, n_joints) [rad]."""
        return replace(self, joints=joints)


def engagements(
    frames: Iterable[Skeleton], correspondence: Correspondence, rule: EngagementRule
) -> Iterator[tuple[ArmEstimate, ...]]:
    """Yield the estimates of the person's arm in each engagement of a recording.

    An engagement is a time in which the robot follows the person. Engagements with only one estimate are left out.

    Args:
        frames: frames in order of time.
        correspondence: how the person's motion maps to the robot: side, sensor pose, scale and orientation.
        rule: times at which the engagement changes its state.
    """
    estimator, engagement = ArmEstimator(correspondence), Engagement(correspondence, rule)
    collected: list[ArmEstimate] = []
    last = -np.inf
    for frame in frames:
        estimate = estimator.update(frame)
        if estimate is None:
            continue
        engagement.update(None, estimate.time - last)  # the time for which the arm was not seen
        if engagement.clutch is None:
            if len(collected) > 1:
                yield tuple(collected)
            collected = []
        last = estimate.time
        engagement.update(estimate, 0.0)
        if engagement.ready:
            engagement.engage(estimate.wrist, estimate.hand, Pose.identity())
        if engagement.clutch is not None:
            collected.append(estimate)
    if len(collected) > 1:
        yield tuple(collected)


class Constraint(Protocol):
    """A condition on the pose of the tool, for example from a teacher."""

    def __call__(self, positions: Array, rotations: Array, /) -> Mask:
        """Return whether the condition holds for each of n tool poses; positions (n, 3) [m], rotations (n, 3, 3)."""
        ...


def above(height: float) -> Constraint:
    """Return the constraint that the tool is higher than ``height`` [m], for example above a table."""

    def holds(positions: Array, _: Array) -> Mask:
        return np.asarray(positions[:, 2] > height)

    return holds


def upright(angle: float) -> Constraint:
    """Return the constraint that the z axis of the tool points down, with a tolerance of ``angle`` [rad]."""

    def holds(_: Array, rotations: Array) -> Mask:
        return np.asarray(-rotations[:, 2, 2] > np.cos(angle))

    return holds


class FeasibilityCheck:
    """Finds the infeasible samples of a joint motion (baseline M1).

    A sample is infeasible if the arm can't execute it well, for one of four reasons: a joint exceeds a position or
    velocity limit; the smallest singular value of the tool's Jacobian is below 0.03; the arm is almost straight
    (:func:`stretch` above 79/80); or an additional constraint is violated.

    Args:
        arm: the robot's arm with its tool.
        dt: sampling period [s].
        constraints: additional constraints by their names; None: no constraints.

    Raises:
        InputError: when a constraint has the name of a built-in condition.
    """

    def __init__(self, arm: ArmModel, dt: float, constraints: Mapping[str, Constraint] | None = None) -> None:
        self.arm, self.dt = arm, dt
        if constraints is not None and not isinstance(constraints, Mapping):
            raise InputError(
                f"FeasibilityCheck: constraints must be a dictionary of conditions by name, got {constraints!r}"
            )
        self.constraints = dict(constraints or {})
        taken = sorted({"limits", "speed", "singular", "stretched"} & set(self.constraints))
        if taken:
            raise InputError(
                f"FeasibilityCheck: constraint {taken[0]!r} has the name of a built-in condition; rename it"
            )

    def reasons(self, joints: Array) -> dict[str, Mask]:
        """Return, for each condition, which samples of ``joints`` (n, n_joints) [rad] violate it, shape (n,)."""
        return {"speed": self.too_fast(joints), **self.postures(joints)}

    def anywhere(self, joints: Array) -> Mask:
        """Return whether each sample of ``joints`` (n, n_joints) [rad] is infeasible for any reason, shape (n,)."""
        return np.asarray(np.any(list(self.reasons(joints).values()), axis=0))

    def too_fast(self, joints: Array) -> Mask:
        """Return whether a joint is too fast just before or after each sample, shape (n,)."""
        found = np.zeros(len(joints), dtype=bool)
        over = (self.speeds(joints) > 1.0 + 1e-9).any(axis=1)
        found[1:] |= over
        found[:-1] |= over
        return found

    def speeds(self, joints: Array) -> Array:
        """Return the joint speeds divided by the velocity limits, shape (n - 1, n_joints)."""
        return np.asarray(np.abs(np.diff(joints, axis=0)) / (self.dt * self.arm.max_velocity))

    def postures(self, joints: Array) -> dict[str, Mask]:
        """Return, for each condition except the speed, which samples violate it, shape (n,)."""
        jacobians = np.array([self.arm.tool_jacobian(q) for q in joints]).reshape(-1, 6, self.arm.n_joints)
        found: dict[str, Mask] = {
            "limits": self.outside(joints),
            "singular": np.linalg.svd(jacobians, compute_uv=False)[:, -1] < SINGULAR,
            "stretched": stretch(joints) > STRETCHED,
        }
        if self.constraints:
            positions, quaternions = self.arm.tool_path(joints)
            rotations = np.array([quaternion_to_matrix(q) for q in quaternions]).reshape(-1, 3, 3)
            found |= {name: ~holds(positions, rotations) for name, holds in self.constraints.items()}
        return found

    def clear(self, joints: Array) -> bool:
        """Return whether the whole motion is feasible."""
        return not (self.too_fast(joints).any() or self.outside(joints).any() or self._in_postures(joints))

    def allows(self, q: Array) -> bool:
        """Return whether a posture (n_joints,) [rad] is feasible at rest."""
        return not (self.outside(q[None])[0] or self._in_postures(q[None]))

    def _in_postures(self, joints: Array) -> bool:
        return any(found.any() for found in self.postures(joints).values())

    def outside(self, joints: Array) -> Mask:
        """Return whether a joint is outside its range at each sample, shape (n,)."""
        beyond = (joints < self.arm.lower - _WITHIN) | (joints > self.arm.upper + _WITHIN)
        return np.asarray(beyond.any(axis=1))


def stretch(joints: Array) -> Array:
    r"""Return how straight the robot's arm is, from 0 to 1 (straight), shape (n,).

    The argument ``joints`` contains the robot's joint positions, shape (n, n_joints) [rad]. The result is
    :math:`|\cos(q_3/2)|`, where :math:`q_3` is the angle of the elbow. For a human arm with upper arm and forearm of
    equal length, this is the distance from shoulder to wrist, divided by the length of the straight arm. The robot's
    own distance from shoulder to wrist is not used. Its links have offsets, so this distance is largest when the elbow
    is bent.
    """
    return np.asarray(np.abs(np.cos(0.5 * joints[:, ELBOW])))


def segments(found: Mask, dt: float) -> list[tuple[int, int]]:
    """Return segments (first sample, sample after the last) that contain all samples in ``found``.

    Each segment begins 0.2 s before its first sample in ``found``, and ends 0.2 s after its last one.

    Args:
        found: True for each sample that must be in a segment, shape (n,).
        dt: sampling period [s].
    """
    wide = round(DILATION / dt)
    dilated = np.convolve(found, np.ones(2 * wide + 1))[wide : wide + len(found)] > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dilated, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def blend(found: Mask, first: int, past: int, dt: float) -> Array:
    """Return the weight of a correction for each sample of a segment, shape (past - first,).

    The weight is 1 at the samples in ``found``, and falls to 0 within 0.2 s before and after these samples.
    """
    at = np.arange(first, past)
    needed = at[found[first:past]]
    away = np.abs(at[:, None] - needed).min(axis=1) * dt
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.minimum(away / DILATION, 1.0))))
