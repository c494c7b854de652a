r"""Fitting: where a robot should begin, and how much smaller it should move, so that a recorded motion is in its reach.

A motion that is still to come can't be fitted; a recording can. The tool will be at

.. math:: p(t) = p_0 + \rho\,(W(t) - W_0)

with W the person's wrist in the base's axes and :math:`W_0` where it is when the clutch engages. The middle of the
motion is put near where the robot's tool is at home, and the scale is made smaller until the arm reaches the six
outermost points of the motion and its start, with its tool turned as at home, well off its singularities and with its
links off each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.ik_problem import ROTATION_LENGTH
from imitarm.kinematics.limits import JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.posture import find_posture
from imitarm.kinematics.self_clearance import SelfClearance
from imitarm.kinematics.tasks import TwistTask

Array = NDArray[np.float64]

_SHRINK: Final = 0.85  # from one scale that is tried to the next
_SMALLEST: Final = 0.15
_EASY, _POSSIBLE = 0.1, 0.05  # [m/rad] least singular value where an arm begins; where it goes
_APART: Final = 0.02  # [m] to be kept between links
_STILL: Final = 1e-3  # [rad/s] faster is not standing
_GRID: Final = np.stack(
    np.meshgrid([0.0, 0.1, -0.1], [0.0, 0.15, -0.15], [0.0, 0.1, -0.1, 0.2], indexing="ij"), axis=-1
).reshape(-1, 3)
_MIDDLES: Final = _GRID[np.argsort(np.linalg.norm(_GRID, axis=1), kind="stable")]  # [m] from the tool at home


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the robot begins, ``q`` (n_joints,) [rad], and the ``scale`` of its motion."""

    q: Array
    scale: float


def fit_motion(arm: ArmModel, wrist: ArrayLike, start: ArrayLike, *, scale: float = 1.0) -> Fit:
    """Find a start and a scale with which a recorded motion is in the arm's reach.

    Args:
        arm: the robot's.
        wrist: the person's, along the axes of the base, shape (n, 3) [m].
        start: where it is when the clutch engages, shape (3,) [m].
        scale: the largest one to try.

    Returns:
        The largest scale that was found to do, and a start.

    Raises:
        InputError: when the wrist was never seen.
        UnreachableError: when the motion does not fit at a seventh of its size.
    """
    path, begin = np.asarray(wrist, dtype=float), np.asarray(start, dtype=float)
    path = path[np.isfinite(path).all(axis=1)]
    if not len(path) or not np.isfinite(begin).all():
        raise InputError("fit: the wrist was never seen, so nothing can be fitted")
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    outermost = path[np.unique(np.concatenate([path.argmin(axis=0), path.argmax(axis=0)]))]
    home, search = arm.tool_pose(arm.home), _Search(arm, SelfClearance(arm, _APART))
    tried = scale
    while tried >= _SMALLEST:
        for shift in _MIDDLES:
            centre = home.position + shift
            first = search.posture(Pose(centre + tried * (begin - middle), home.quaternion), arm.home, _EASY)
            if first is None or not search.stands(first):
                continue
            if all(
                search.posture(Pose(centre + tried * (point - middle), home.quaternion), first, _POSSIBLE) is not None
                for point in outermost
            ):
                return Fit(first, tried)
        tried *= _SHRINK
    span = np.ptp(path, axis=0)
    raise UnreachableError(
        f"fit: a motion of {span[0]:.2f} x {span[1]:.2f} x {span[2]:.2f} m is not in reach of {arm.name} even at a "
        f"scale of {_SMALLEST:g}; cut it, or choose another arm"
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """Looks for postures of an arm whose links stay off each other."""

    arm: ArmModel
    links: SelfClearance

    def posture(self, tool_to_base: Pose, near: Array, least: float) -> Array | None:
        """Return a posture near another one, shape (n_joints,); None if none is so far from a singularity."""
        try:
            q = find_posture(self.arm, tool_to_base, q0=near, restarts=2)
        except UnreachableError:
            return None
        jacobian = self.arm.tool_jacobian(q)
        jacobian[3:] *= ROTATION_LENGTH
        free = float(np.linalg.svd(jacobian, compute_uv=False)[-1]) >= least
        return q if free and self.links.distance(q) >= self.links.clearance else None

    def stands(self, q: Array) -> bool:
        """Whether an arm that keeps off its singularities stands still there, and does not move off by itself."""
        if self.arm.landmarks is None:
            return True
        still = np.zeros(self.arm.n_joints)
        velocity = IKSolver(self.arm, [JointLimits(self.arm), *singularity_limits(self.arm)]).solve(
            q, TwistTask(np.zeros(6)), velocity=still
        )
        return float(np.abs(velocity).max()) <= _STILL
