r"""Fitting: find a start posture and a scale that bring a recorded motion within the robot's reach.

Only a recording can be fitted, because a live motion is not known in advance. In the fitted motion, the position of the
tool at time t is

.. math:: p(t) = p_0 + \rho\,(W(t) - W_0)

where :math:`W` is the position of the person's wrist along the axes of the base, :math:`W_0` its position when the
robot begins to follow (the clutch engages), :math:`p_0` the start position of the tool, and :math:`\rho` the scale. For
each scale, the search places the middle of the motion at positions near the tool's home position, and then at positions
throughout the workspace. The search reduces the scale until the arm reaches seven points of the motion. They are the
start and the points with the smallest and the largest x, y and z. At these points, the tool must have the same
orientation as at home, and the arm must be away from singularities. The links must keep a minimum distance from each
other and from the fixtures (the objects on which the arm stands).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnreachableError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH, find_posture
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.limits import JointLimits, singularity_limits
from imitarm.kinematics.pose import Pose
from imitarm.kinematics.tasks import TwistTask
from imitarm.scene import Obstacle, Scene, standard_fixtures
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.distances import distances
from imitarm.validation import finite_number, instance, real_array

Array = NDArray[np.float64]

_SHRINK: Final = 0.85  # factor from one scale that is tried to the next
_SMALLEST: Final = 0.15
_EASY, _POSSIBLE = 0.1, 0.05  # [m/rad] smallest singular value: where an arm begins; where it passes
_APART: Final = 0.02  # [m] between two links, and between a link and a fixture
_STILL: Final = 1e-3  # [rad/s] slower is standing still
_GRID: Final = np.stack(
    np.meshgrid([0.0, 0.1, -0.1], [0.0, 0.15, -0.15], [0.0, 0.1, -0.1, 0.2], indexing="ij"), axis=-1
).reshape(-1, 3)
_NEAR_HOME: Final = _GRID[np.argsort(np.linalg.norm(_GRID, axis=1), kind="stable")]  # [m] from the tool at home
_SAMPLES: Final = 512  # postures that show how far the tool gets
_STEP: Final = 0.3  # spacing of the centres in the workspace, as a fraction of the reach
_MOST_CENTRES: Final = 60


@dataclass(frozen=True, eq=False)
class Fit:
    """The start posture of the robot, ``q`` (n_joints,) [rad], and the ``scale`` of its motion."""

    q: Array
    scale: float


def fit_motion(
    arm: ArmModel,
    wrist: ArrayLike,
    start: ArrayLike,
    *,
    scale: float = 1.0,
    fixtures: Sequence[Obstacle] | None = None,
) -> Fit:
    """Find a start and a scale that bring a recorded motion within the arm's reach.

    Args:
        arm: the robot's arm.
        wrist: positions of the person's wrist, shape (n, 3) [m]. The axes must be parallel to those of the robot's
            base; the origin is arbitrary. Rows with nan are skipped.
        start: position of the wrist when the robot begins to follow the person, in the same frame, shape (3,) [m].
        scale: the largest scale to try.
        fixtures: objects on which the arm stands or works, which it must not touch; None: a floor and a pedestal
            (:func:`~imitarm.scene.standard_fixtures`).

    Returns:
        The largest scale at which the arm reaches the motion, and the start posture for this scale.

    Raises:
        InputError: if all rows of ``wrist`` contain nan, ``start`` contains nan, or an argument is invalid.
        UnreachableError: if the arm can't reach the motion at any scale down to 0.15.
    """
    instance(arm, ArmModel, "arm")
    path, begin = real_array(wrist, (None, 3), "wrist", "m"), real_array(start, (3,), "start", "m")
    finite_number(scale, "scale", above=0.0)
    path = path[np.isfinite(path).all(axis=1)]
    if not len(path) or not np.isfinite(begin).all():
        raise InputError(
            "fit: the wrist was never seen, so nothing can be fitted; check which arm the camera has recorded"
        )
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    outermost = path[np.unique(np.concatenate([path.argmin(axis=0), path.argmax(axis=0)]))] - middle
    search = _Search(arm, standard_fixtures() if fixtures is None else fixtures)
    reach, span = search.reach(), np.ptp(path, axis=0)
    tried = scale
    while tried >= _SMALLEST:
        if tried * float(span.max()) <= 2.0 * reach:
            for centre, near in search.centres():
                q = search.start(centre, near, tried * (begin - middle), tried * outermost)
                if q is not None:
                    return Fit(q, tried)
        tried *= _SHRINK
    raise UnreachableError(
        f"fit: a motion of {span[0]:.2f} x {span[1]:.2f} x {span[2]:.2f} m is not within reach of {arm.name} even at a "
        f"scale of {_SMALLEST:g}; cut the recording (--trim), or choose a larger arm"
    )


class _Search:
    """Finds postures away from singularities and contacts, in which the tool has the same orientation as at home."""

    def __init__(self, arm: ArmModel, fixtures: Sequence[Obstacle]) -> None:
        self.arm, self.links, self.home = arm, SelfClearance(arm, _APART), arm.tool_pose(arm.home)
        self._fixtures = Scene(None, tuple(fixtures)).packed
        self._kept_off = self._room(arm.home) >= 0.0  # links beside the pedestal at home cannot leave it
        self._far: list[tuple[Array, Array]] | None = None

    def reach(self) -> float:
        """Return the largest distance of the tool from the middle of its workspace [m]."""
        low, high = np.maximum(self.arm.lower, -np.pi), np.minimum(self.arm.upper, np.pi)
        random = np.random.default_rng(0)
        self._tips = self.arm.tool_path(random.uniform(low, high, size=(_SAMPLES, self.arm.n_joints)))[0]
        return float(np.linalg.norm(self._tips - self._tips.mean(axis=0), axis=1).max())

    def centres(self) -> Iterator[tuple[Array, Array]]:
        """Yield positions (3,) [m] for the middle of the motion, nearest to home first, each with a posture near it."""
        for shift in _NEAR_HOME:
            yield self.home.position + shift, self.arm.home
        if self._far is None:  # the same for all scales
            self._far = list(self._reachable_centres())
        yield from self._far

    def start(self, centre: Array, near: Array, begin: Array, outermost: Array) -> Array | None:
        """Return a start posture of the motion, shape (n_joints,); None if part of the motion is out of reach.

        Args:
            centre: centre of the motion, shape (3,) [m].
            near: posture in which the tool is near the centre of the motion, shape (n_joints,) [rad].
            begin: start of the motion relative to its centre, shape (3,) [m].
            outermost: the outermost points relative to the centre, shape (k, 3) [m].
        """
        first = self._posture(centre + begin, near, _EASY)
        if first is None or not self._stands(first):
            return None
        passes = all(self._posture(centre + point, first, _POSSIBLE) is not None for point in outermost)
        return first if passes else None

    def _reachable_centres(self) -> Iterator[tuple[Array, Array]]:
        """Yield reachable positions throughout the workspace, nearest to home first, each with a posture."""
        low, high = self._tips.min(axis=0), self._tips.max(axis=0)
        step = _STEP * 0.5 * float((high - low).max())
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        # A place that no sampled posture comes near is outside the workspace.
        inside = np.linalg.norm(grid[:, None] - self._tips, axis=2).min(axis=1) <= step
        grid = grid[inside]
        order = np.argsort(np.linalg.norm(grid - self.home.position, axis=1), kind="stable")
        for centre in grid[order[:_MOST_CENTRES]]:
            q = self._posture(centre, self.arm.home, _POSSIBLE)
            if q is not None:
                yield centre, q

    def _posture(self, position: Array, near: Array, smallest: float) -> Array | None:
        """Return a posture near a given posture, shape (n_joints,).

        The result is None if no posture near the given one is far enough from singularities.
        """
        try:
            q = find_posture(self.arm, Pose(position, self.home.quaternion), q0=near, restarts=2)
        except UnreachableError:
            return None
        jacobian = self.arm.tool_jacobian(q)
        jacobian[3:] *= ROTATION_LENGTH
        regular = float(np.linalg.svd(jacobian, compute_uv=False)[-1]) >= smallest
        apart = regular and self.links.distance(q) >= self.links.clearance
        return q if apart and (self._room(q)[self._kept_off] >= 0.0).all() else None

    def _room(self, q: Array) -> Array:
        """Return each arm sphere's distance to each fixture minus the required distance, (n_fixtures, m) [m]."""
        centers, radii = self.arm.collision_spheres(q)
        return distances(self._fixtures, centers) - radii - _APART

    def _stands(self, q: Array) -> bool:
        """Return whether an arm that avoids its singularities stays at a posture and does not drift away."""
        if self.arm.landmarks is None:
            return True
        still = np.zeros(self.arm.n_joints)
        velocity = IKSolver(self.arm, [JointLimits(self.arm), *singularity_limits(self.arm)]).solve(
            q, TwistTask(np.zeros(6)), velocity=still
        )
        return float(np.abs(velocity).max()) <= _STILL
