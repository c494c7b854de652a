"""What an arm can't do of a motion of its joints: predicates that say where a demonstration must be changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import quaternion_to_matrix

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SINGULAR = 0.03  # least singular value of the tool's Jacobian, in m and rad, below which a posture is singular
STRETCHED = 0.79 / 0.80  # share of the reach beyond which the wrist is too far from the shoulder
ELBOW = 3  # index of the joint that bends the elbow; at zero the arm is straight
DILATION = 0.2  # [s] by which what is infeasible is widened on both sides
_WITHIN = 1e-6  # [rad] a joint may be so far beyond its limit


class Constraint(Protocol):
    """A condition on the tool, as a teacher annotates it."""

    def __call__(self, positions: Array, rotations: Array, /) -> Mask:
        """Return where it holds, shape (n,), for positions (n, 3) [m] and rotations (n, 3, 3) in the base frame."""
        ...


def above(height: float) -> Constraint:
    """Return the constraint that the tool is higher than ``height`` [m], as a table."""

    def holds(positions: Array, _: Array) -> Mask:
        return np.asarray(positions[:, 2] > height)

    return holds


def upright(angle: float) -> Constraint:
    """Return the constraint that the tool's axis is within ``angle`` [rad] of looking straight down."""

    def holds(_: Array, rotations: Array) -> Mask:
        return np.asarray(-rotations[:, 2, 2] > np.cos(angle))

    return holds


class Infeasible:
    r"""The predicate F of M1 (METHODS B).

    It is true where a joint is beyond a limit of position or velocity, where the arm is singular
    (:math:`s_{min} < 0.03`) or stretched (:func:`stretch` above 79/80), or a constraint does not hold.

    Args:
        arm: the robot's arm with its tool.
        dt: sampling period [s].
        constraints: more of them, by name.

    Raises:
        InputError: when a constraint has the name of one of the predicates above.
    """

    def __init__(self, arm: ArmModel, dt: float, constraints: Mapping[str, Constraint] | None = None) -> None:
        self.arm, self.dt = arm, dt
        self.constraints = {} if constraints is None else dict(constraints)
        taken = sorted({"limits", "speed", "singular", "stretched"} & set(self.constraints))
        if taken:
            raise InputError(f"Infeasible: a constraint can't be called {taken[0]!r}: that is built in; rename it")

    def reasons(self, joints: Array) -> dict[str, Mask]:
        """Return for each predicate where it finds something, shape (n,), for joints (n, n_joints) [rad]."""
        return {"speed": self.too_fast(joints), **self.postures(joints)}

    def anywhere(self, joints: Array) -> Mask:
        """Return F itself, shape (n,)."""
        return np.asarray(np.any(list(self.reasons(joints).values()), axis=0))

    def too_fast(self, joints: Array) -> Mask:
        """Return the samples on both sides of a step that a joint can't make in time, shape (n,)."""
        found = np.zeros(len(joints), dtype=bool)
        over = (self.speeds(joints) > 1.0 + 1e-9).any(axis=1)
        found[1:] |= over
        found[:-1] |= over
        return found

    def speeds(self, joints: Array) -> Array:
        """Return speeds as shares of the joints' limits, shape (n - 1, n_joints)."""
        return np.asarray(np.abs(np.diff(joints, axis=0)) / (self.dt * self.arm.max_velocity))

    def postures(self, joints: Array) -> dict[str, Mask]:
        """Return what can be told from one posture at a time, for each where it finds something, shape (n,)."""
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
        """Return whether F is nowhere true; what is quick to tell comes first."""
        return not (self.too_fast(joints).any() or self.outside(joints).any() or self._in_postures(joints))

    def allows(self, q: Array) -> bool:
        """Return whether nothing is wrong with a posture (n_joints,) [rad]."""
        return not (self.outside(q[None])[0] or self._in_postures(q[None]))

    def _in_postures(self, joints: Array) -> bool:
        return any(found.any() for found in self.postures(joints).values())

    def outside(self, joints: Array) -> Mask:
        """Return where a joint is beyond a limit of position, shape (n,)."""
        beyond = (joints < self.arm.lower - _WITHIN) | (joints > self.arm.upper + _WITHIN)
        return np.asarray(beyond.any(axis=1))


def stretch(joints: Array) -> Array:
    r"""Return how far the arm is stretched, shoulder to wrist over the reach, shape (n,), for joints (n, n_joints).

    It is that of the person's chain, on which the joints were mapped: upper arm and forearm in line with the joints'
    axes and equally long (Sawyer's are 0.412 and 0.411 m), so :math:`|\cos(q_3/2)|`. The offsets between a robot's
    links would let its own distance from shoulder to wrist be largest where the elbow is bent.
    """
    return np.asarray(np.abs(np.cos(0.5 * joints[:, ELBOW])))


def segments(found: Mask, dt: float) -> list[tuple[int, int]]:
    """Return the runs of True, widened by 0.2 s on both sides and joined where they touch, as (first, past the last).

    Args:
        found: shape (n,).
        dt: sampling period [s].
    """
    wide = round(DILATION / dt)
    dilated = np.convolve(found, np.ones(2 * wide + 1))[wide : wide + len(found)] > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dilated, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def blend(found: Mask, first: int, past: int, dt: float) -> Array:
    """Return how far to change a segment: 1 where needed, falling to 0 within 0.2 s, shape (past - first,)."""
    at = np.arange(first, past)
    needed = at[found[first:past]]
    away = np.abs(at[:, None] - needed).min(axis=1) * dt
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.minimum(away / DILATION, 1.0))))
