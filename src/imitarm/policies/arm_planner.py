r"""Joint paths on which the whole arm keeps its clearance, found by repeated quadratic programs.

Three vectors of coefficients describe the motion. The displacements :math:`\Delta` move the components of the learned
path. The *tilt* :math:`\tau` rotates the tool away from the learned rotation. The self-motion :math:`\psi` moves the
arm but not its tool. The matrices :math:`B(t)` contain smooth functions of time, which the coefficients multiply. Near
a joint path q(t), small changes of the coefficients change the joint positions by :math:`\delta q`:

.. math:: \delta q(t) = J^+(t) \begin{bmatrix} B_\Delta(t)\,\delta\Delta \\ B_\tau(t)\,\delta\tau \end{bmatrix}
          + N(t)\,B_\psi(t)\,\delta\psi

Here :math:`J^+` is the right inverse of the tool's Jacobian, and N is a basis of its null space. To first order, every
distance between a part of the arm and an obstacle is a linear function of these changes. In each round, a quadratic
program finds the smallest displacement and tilt for which all linearised distances are at least the required clearance.
The joints stay within their limits. Inverse kinematics then corrects the joint path, so that the tool has exactly the
displaced and tilted poses. The next round begins with this joint path. The rounds end when all distances are at least
the required clearance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from imitarm.kinematics.arm_path import ArmPath, right_inverses, self_motions
from imitarm.policies.arm_certificate import ArmAmongObstacles, ArmClearance, lowest_of
from imitarm.policies.arm_pairs import SELF, Gaps
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import UNBOUNDED, AllowedDirections, style_scale
from imitarm.policies.tilts import Tilts, splines

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_STRIDE = 4  # the rounds look at every fourth sample, the last ones at all
_ROUNDS = 24
_FINAL_ROUNDS = 10  # with all samples
_QUICK_ROUNDS = 8, 4  # of both, when the time is limited
_ALL_SAMPLES = 2.0  # rounds that a round with all samples counts as
_PATIENCE, _LESS_PATIENCE = 7, 3  # rounds without progress, then this attempt is given up: usually, and far from clear
_FAR = 0.02  # [m] an attempt that lacks more is far from clear
_PROGRESS, _NEARLY = 1e-3, 0.2  # progress that counts: of the smallest distance [m], or as a fraction of what it lacks
_SELF_MOTIONS = 10  # knots of the splines
_TILT_SIGMA = 0.15  # [rad] a tilt of this size costs as much as a displacement by one demonstrated sigma
_TILT_USED, _TILT_TOLERANCE = 0.995, 1e-3  # fraction of the limit of the tilt that is used; accepted excess [rad]
_REACH = 0.06  # [m] pairs farther apart than the clearance and this have no row
_NEAR = 0.01  # [m] every pair nearer than the clearance and this has a row; of the others, the nearest of each link
_MARGIN = 5e-4  # [m] the rows ask for this much more, because distances are not linear
_LONGEST_STEP = 0.5  # [rad] of a joint in one round
_NEAR_LIMIT, _LIMIT_MARGIN = 0.3, 0.01  # [rad] from a joint's limit: it has a row there; it stays this far away
_FAST = 0.7  # times its limit: a joint that is faster has a row that keeps it within the limit, if possible
_CALM, _CALMING = 1.05, 4  # speed that is fast enough; rounds in which a clear plan is made slower
_NEGLIGIBLE = 2e-4  # [m] a component that would move less than this stays exactly where it is
_SLACK_SCALE = 1e-4  # [m] of missing clearance costs as much as one demonstrated sigma, where rows contradict
_MOST_ROWS = 500
_SOLVED = 1  # daqp's exit flag of an optimal solution
_ACCURATE = 1e-5  # [m, rad] error of the tool's pose that is accepted
_GRID = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
_FACETS = _GRID[_GRID.any(axis=1)] / np.linalg.norm(_GRID[_GRID.any(axis=1)], axis=1, keepdims=True)  # 26 directions
_AXES = np.abs(_FACETS).max(axis=1) == 1.0  # which of them are along an axis


@dataclass
class Effort:
    """The number of rounds that a search may still use, so that a plan does not take too long.

    In each round, the planner improves a joint path once. The limit is a number of rounds instead of a time, so that
    the result does not depend on the speed of the computer.
    """

    left: float

    def spend(self, rounds: float = 1.0) -> bool:
        """Subtract ``rounds`` from the number of rounds left; return whether there were enough."""
        self.left -= rounds
        return self.left >= 0.0


@dataclass(frozen=True, eq=False)
class ArmPlan:
    """A joint path for a displaced and tilted path of the tool.

    Attributes:
        components: the learned path and its components, before they were displaced.
        displacement: displacement of each component's mean, shape (n_components, 3) [m].
        tilts: smooth functions of time for the tool's rotation away from the learned rotation.
        tilt: the chosen coefficients of ``tilts``, shape (n_tilts, 3) [rad].
        path: postures of the arm at the samples.
        clearance: the smallest clearance and where on the path it occurs. If its room is at least 0 and ``complete`` is
            True, the clearance is guaranteed on the whole path.
        complete: whether ``path`` has all samples of ``components``; False: it has only every fourth sample.
        cost: sum of the squares of displacement and tilt, both in standard deviations of the demonstrations.
        largest_tilt: largest rotation of the tool away from the learned rotation [rad].
        speed: largest joint speed at the learned times, divided by the joint's velocity limit.
    """

    components: ComponentPath
    displacement: Array
    tilts: Tilts
    tilt: Array
    path: ArmPath
    clearance: ArmClearance
    complete: bool
    cost: float
    largest_tilt: float
    speed: float

    @property
    def feasible(self) -> bool:
        """Whether the whole arm keeps its clearance on the whole path."""
        return self.complete and self.clearance.room >= 0.0


class ArmPlanner:
    """Plans joint paths for one decomposed path of the tool among one set of obstacles.

    Args:
        around: the arm, its obstacles and the required clearances.
        components: the path of the tool and its components.
        quaternions: learned rotations of the tool at the samples, tool_to_base, shape (n, 4).
        max_tilt: largest rotation away from the learned rotation at each sample, shape (n,) [rad].
        allowed: directions in which components may move.
        smoothness: weight of the squared jerk in the cost of a displacement (see ``style_scale``).
        free_start: whether the plan may start in another posture with the same tool pose.
        tilts: smooth functions of time for the tool's rotation away from the learned rotation.
        begun: whether the arm is already moving; if so, the self-motion of the plan does not change the joint
            velocities at the start.
        spare: additional clearance that the planner tries to reach; a plan without it is also feasible [m].
        quick: whether the planner gives up after fewer rounds than usual.
        effort: number of rounds that the whole search may still use; None: no limit.

    Attributes:
        coarse: indices of every fourth sample, shape (k,). The first rounds use only these samples; the last rounds use
            all.
        clock: time at which the arm reaches each sample, shape (n,) [s]. It determines the positions of moving
            obstacles. At first, these are the learned times.
    """

    def __init__(
        self,
        around: ArmAmongObstacles,
        components: ComponentPath,
        quaternions: Array,
        max_tilt: Array,
        allowed: AllowedDirections,
        *,
        smoothness: float = 0.0,
        tilts: Tilts,
        free_start: bool = False,
        begun: bool = False,
        spare: float = 0.0,
        quick: bool = False,
        effort: Effort | None = None,
    ) -> None:
        self.around, self.arm, self.components, self.free_start, self.begun = (
            around,
            around.arm,
            components,
            free_start,
            begun,
        )
        self.quaternions, self.max_tilt, self.allowed = quaternions, max_tilt, allowed
        self.spare, self.times = spare, components.nominal.times
        self._rounds = _QUICK_ROUNDS if quick else (_ROUNDS, _FINAL_ROUNDS)
        self._effort = Effort(np.inf) if effort is None else effort
        self.clock = self.times
        n = len(self.times)
        self.coarse = np.unique(np.append(np.arange(0, n, _STRIDE), n - 1))
        self.tilts = tilts
        self._selves = splines(self.times, _SELF_MOTIONS, first=free_start, last=True)[:, 1 if begun else 0 :]
        self._scale = style_scale(components, allowed, np.arange(components.n_components), smoothness)

    def poses(self, displacement: Array, tilt: Array, samples: Index) -> tuple[Array, Array]:
        """Return the poses of the tool at samples: positions (k, 3) [m] and quaternions (k, 4)."""
        positions = self.components.nominal.positions[samples] + self.components.basis[samples] @ displacement
        return positions, self.tilts.turned(self.quaternions, tilt, samples)

    def tilt_at_goal(self, rotation: Array) -> Array:
        """Return coefficients (n_tilts, 3) [rad] with which the tool is rotated by ``rotation`` (3,) [rad] at the goal.

        If no rotation is allowed at the goal, ``rotation`` must be zero.
        """
        tilt = np.zeros((self.tilts.n_tilts, 3))
        tilt[-1] = rotation
        return tilt

    def plan(self, displacement: Array, joints: Array, tilt: Array | None = None) -> ArmPlan | None:
        """Improve a first guess of the joint path until the whole arm keeps its clearance.

        Args:
            displacement: first guess of the displacement of each component's mean, shape (n_components, 3) [m].
            joints: first guess of the joint positions at the samples ``coarse``, shape (k, n_joints) [rad].
            tilt: first guess of the coefficients of the tilt, shape (n_tilts, 3) [rad]; None: no tilt.

        Returns:
            A feasible plan, or the best attempt; None when the arm can't follow the tool's path.
        """
        tilt = np.zeros((self.tilts.n_tilts, 3)) if tilt is None else tilt
        state = self._closed(joints, displacement, tilt, self.coarse)
        if state is None:
            return None
        best = self._improved(state, displacement, tilt, self.coarse, self._rounds[0])
        if best.clearance.room < 0.0:
            return best
        samples = np.arange(len(self.times))
        spline = make_interp_spline(self.times[self.coarse], best.path.joints, 3)
        state = self._closed(spline(self.times), best.displacement, best.tilt, samples)
        if state is None:
            return best
        return self._improved(state, best.displacement, best.tilt, samples, self._rounds[1])

    def _closed(self, joints: Array, displacement: Array, tilt: Array, samples: Index) -> ArmPath | None:
        """Return the joint path that moves the tool exactly to its poses; None when a pose is out of reach."""
        path, error = ArmPath.of(self.arm, joints).moved_to(*self.poses(displacement, tilt, samples))
        return path if error < _ACCURATE else None

    def _improved(self, path: ArmPath, displacement: Array, tilt: Array, samples: Index, rounds: int) -> ArmPlan:
        """Return the first plan that keeps all clearances (see :meth:`_evaluated`), or else the best attempt."""
        best: ArmPlan | None = None
        since, margin, calmed = 0, _MARGIN + self.spare, 0
        for _ in range(rounds + 1):
            gaps = None
            if len(samples) < len(self.times):
                gaps = self.around.gaps(path, self.clock[samples], _REACH)
            plan = self._evaluated(path, displacement, tilt, samples, gaps)
            since = 0 if best is None or plan.clearance.room > _progress(best.clearance.room) else since + 1
            if best is None or _rank(plan) > _rank(best):
                best = plan
            if plan.clearance.room >= 0.0:
                calmed += 1
            calm = plan.speed <= _CALM or calmed > _CALMING or self.begun
            patience = _PATIENCE if best.clearance.room > -_FAR else _LESS_PATIENCE
            if (plan.clearance.room >= 0.0 and calm) or since > patience:
                break
            if not self._effort.spend(1.0 if len(samples) < len(self.times) else _ALL_SAMPLES):
                break
            gaps = self.around.gaps(path, self.clock[samples], _REACH) if gaps is None else gaps
            if plan.complete and plan.clearance.room < 0.0 and gaps.room.min(initial=1.0) >= 0.0:
                margin += _MARGIN - plan.clearance.room  # only between the samples the arm is too near
            step = self._step(path, gaps, displacement, tilt, samples, margin)
            moved = None if step is None else self._moved(path, displacement, tilt, samples, *step)
            if moved is None:
                break
            path, displacement, tilt = moved
        assert best is not None
        return best

    def _evaluated(self, path: ArmPath, displacement: Array, tilt: Array, samples: Index, gaps: Gaps | None) -> ArmPlan:
        """Return a plan with its smallest clearance: at the samples (``gaps``), or on the whole path (None)."""
        complete = gaps is None
        beyond = np.minimum(path.joints - self.arm.lower, self.arm.upper - path.joints)
        sample, joint = np.unravel_index(int(np.argmin(beyond)), beyond.shape)
        if gaps is None:
            lowest = self.around.clearance_of(path, self.clock)
        else:
            lowest = lowest_of(gaps, _REACH)
            lowest = replace(lowest, sample=int(samples[lowest.sample]))
        if beyond[sample, joint] < min(lowest.room, 0.0):
            lowest = ArmClearance(float(beyond[sample, joint]), JOINT_LIMIT, int(joint), -1, int(samples[sample]))
        turned = np.linalg.norm(self.tilts.vectors(tilt), axis=1)
        tilted = int(np.argmax(turned - self.max_tilt))
        excess = float(turned[tilted] - self.max_tilt[tilted])
        if excess > _TILT_TOLERANCE and -TILT_LEVER * excess < lowest.room:
            lowest = ArmClearance(-TILT_LEVER * excess, TILT_LIMIT, -1, -1, tilted)
        cost = self._cost(displacement, tilt)
        speed = float((np.abs(np.diff(path.joints, axis=0)) / self._longest_steps(samples)).max(initial=0.0))
        return ArmPlan(
            self.components, displacement, self.tilts, tilt, path, lowest, complete, cost, float(turned.max()), speed
        )

    def _longest_steps(self, samples: Index) -> Array:
        """Return how far each joint can move from sample to sample at the learned times, (k - 1, n_joints) [rad]."""
        return np.asarray(np.diff(self.times[samples])[:, None] * self.arm.max_velocity)

    def _cost(self, displacement: Array, tilt: Array) -> float:
        style = np.einsum("kd,kde,ke->", displacement, self.components.precisions, displacement)
        return float(style + np.sum((tilt / _TILT_SIGMA) ** 2))

    def _moved(
        self, path: ArmPath, displacement: Array, tilt: Array, samples: Index, new: Array, turned: Array, change: Array
    ) -> tuple[ArmPath, Array, Array] | None:
        """Take a step, and halve it up to three times until the arm can follow; None if the arm still can't follow."""
        fraction = min(1.0, _LONGEST_STEP / max(float(np.abs(change).max()), 1e-9))
        for _ in range(4):
            there = displacement + fraction * (new - displacement), tilt + fraction * (turned - tilt)
            state = self._closed(path.joints + fraction * change, *there, samples)
            if state is not None:
                return state, *there
            fraction *= 0.5
        return None

    def _step(
        self, path: ArmPath, gaps: Gaps, displacement: Array, tilt: Array, samples: Index, margin: float
    ) -> tuple[Array, Array, Array] | None:
        """Solve one quadratic program.

        Returns:
            The new displacement (n_components, 3) [m] and tilt (n_tilts, 3) [rad], and the change of the joints at the
            samples (k, n_joints) [rad]; None when there is no solution.
        """
        jacobians = path.tool_jacobians()
        local = _Local(self, samples, right_inverses(jacobians), self_motions(jacobians))
        now = np.concatenate([displacement.ravel(), tilt.ravel(), np.zeros(local.n_self)])
        chosen = _chosen(gaps)
        rows = local.rows(gaps.sample[chosen], gaps.rates(chosen)[0])
        parts, lower = [rows], [margin - gaps.room[chosen] + rows @ now]
        for sign, away in ((1.0, path.joints - self.arm.lower), (-1.0, self.arm.upper - path.joints)):
            at, joint = np.nonzero(away < _NEAR_LIMIT)
            rows = local.rows(at, sign * np.eye(path.joints.shape[1])[joint])
            parts.append(rows)
            lower.append(_LIMIT_MARGIN - away[at, joint] + rows @ now)
        steps, longest = np.diff(path.joints, axis=0), self._longest_steps(samples)
        at, joint = np.nonzero(np.abs(steps) > _FAST * longest)
        outward = -np.sign(steps[at, joint])[:, None] * np.eye(path.joints.shape[1])[joint]
        rows = local.rows(at + 1, outward) - local.rows(at, outward)
        parts.append(rows)
        lower.append(np.abs(steps[at, joint]) - longest[at, joint] + rows @ now)
        soft = len(lower[0]), sum(map(len, lower))
        rows, low = self._limits(local.n_self, tilt)
        matrix, bounds = np.concatenate([*parts, rows]), np.concatenate([*lower, low])
        y = _least(local.scaled(matrix, self._scale), bounds, soft)
        if y is None:
            return None
        new, turned, selves = local.unscaled(y, self._scale, self.allowed)
        twist = np.concatenate(
            [self.components.basis[samples] @ (new - displacement), self.tilts.basis[samples] @ (turned - tilt)], axis=1
        )
        change = np.einsum("nji,ni->nj", local.inverse, twist)
        change += np.einsum("nje,ne->nj", local.null, self._selves[samples] @ selves)
        return new, turned, change

    def _limits(self, n_self: int, tilt: Array) -> tuple[Array, Array]:
        """Return rows that limit the tilt, and rows that prevent displacements in forbidden directions."""
        n_moved, n_tilts = 3 * self.components.n_components, self.tilts.n_tilts
        at = self.coarse
        limit, now = _TILT_USED * self.max_tilt[at], self.tilts.vectors(tilt, at)
        length = np.linalg.norm(now, axis=1)
        own = now / np.maximum(length, 1e-9)[:, None]
        # A polyhedron about the sphere of the allowed tilts, and a plane that touches the sphere where the tilt is now.
        sample, facet = np.nonzero((now @ _FACETS.T > 0.3 * limit[:, None]) | _AXES)
        far = np.flatnonzero(length > 0.8 * limit)
        sample, direction = np.append(sample, far), np.concatenate([_FACETS[facet], own[far]])
        turning = self.tilts.basis[at[sample]][:, :, None] * direction[:, None, :]
        part = np.zeros((len(sample), n_moved + 3 * n_tilts + n_self))
        part[:, n_moved : n_moved + 3 * n_tilts] = -turning.reshape(len(sample), -1)
        fixed = np.einsum("rd,rd->r", self.tilts.fixed[at[sample]], direction)
        rows, low = [part], [fixed - limit[sample]]
        for forbidden in self.allowed.forbidden:
            part = np.zeros((self.components.n_components, n_moved + 3 * n_tilts + n_self))
            part[:, :n_moved] = np.kron(np.eye(self.components.n_components), -forbidden)
            rows.append(part)
            low.append(np.zeros(len(part)))
        return np.concatenate(rows), np.concatenate(low)


JOINT_LIMIT = SELF - 1
"""Value used instead of an obstacle's index for a joint limit; ``sphere`` is then the index of the joint."""
TILT_LIMIT = SELF - 2
"""Value used instead of an obstacle's index for the limit of the tool's tilt."""
TILT_LEVER = 0.05
"""[m/rad] Missing clearance that counts as much as a tilt that is 1 rad above its limit."""


@dataclass(frozen=True, eq=False)
class _Local:
    """Linear model of how displacement, tilt and self-motion change the joint positions at chosen samples."""

    planner: ArmPlanner
    samples: Index
    inverse: Array
    null: Array

    @property
    def n_self(self) -> int:
        return self.planner._selves.shape[1] * self.null.shape[2]

    def rows(self, at: Index, rates: Array) -> Array:
        """Return the rows of r quantities at samples ``at``; ``rates`` (r, n_joints) are derivatives by the joints."""
        planner, sample = self.planner, self.samples[at]
        of_tool = np.einsum("rj,rji->ri", rates, self.inverse[at])
        of_self = np.einsum("rj,rje->re", rates, self.null[at])
        parts = (
            (planner.components.basis, of_tool[:, :3]),
            (planner.tilts.basis, of_tool[:, 3:]),
            (planner._selves, of_self),
        )
        columns = [
            (basis[sample][:, :, None] * own[:, None, :]).reshape(len(at), basis.shape[1] * own.shape[1])
            for basis, own in parts
        ]
        return np.concatenate(columns, axis=1)

    def scaled(self, matrix: Array, scale: Array) -> Array:
        """Return the rows of ``matrix`` for variables whose cost is the sum of their squares.

        ``scale`` times such variables gives the displacements along the allowed axes.
        """
        k, axes = self.planner.components.n_components, self.planner.allowed.axes
        moved = (matrix[:, : 3 * k].reshape(-1, k, 3) @ axes).reshape(len(matrix), -1) @ scale
        n_tilts = 3 * self.planner.tilts.n_tilts
        tilted = _TILT_SIGMA * matrix[:, 3 * k : 3 * k + n_tilts]
        return np.concatenate([moved, tilted, matrix[:, 3 * k + n_tilts :]], axis=1)

    def unscaled(self, y: Array, scale: Array, allowed: AllowedDirections) -> tuple[Array, Array, Array]:
        """Return displacement, tilt and self-motion for a solution."""
        n, n_tilts = scale.shape[1], 3 * self.planner.tilts.n_tilts
        moved = allowed.enforced((scale @ y[:n]).reshape(-1, allowed.dimension))
        moved[np.einsum("kd,kd->k", moved, moved) < _NEGLIGIBLE**2] = 0.0
        tilt = (_TILT_SIGMA * y[n : n + n_tilts]).reshape(-1, 3)
        return moved, tilt, y[n + n_tilts :].reshape(self.planner._selves.shape[1], self.null.shape[2])


def _rank(plan: ArmPlan) -> tuple[float, float]:
    """Return a key that compares plans by their speed if they have enough clearance, otherwise by their clearance."""
    return min(plan.clearance.room, 0.0), -max(plan.speed, _CALM)


def _progress(room: float) -> float:
    """Return the room [m] beyond which a plan is better than one with the given room by so much that it counts."""
    return room + (min(_PROGRESS, -_NEARLY * room) if room < 0.0 else _PROGRESS)


def _chosen(gaps: Gaps) -> Index:
    """Return the pairs that get a row in the quadratic program: all near pairs, and the nearest pair of each link."""
    links = gaps.path.arm.cover.links
    kinds = np.stack([gaps.obstacle, gaps.sample, links[gaps.sphere], gaps.first])
    order = np.lexsort((gaps.room, *kinds))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(kinds[:, order], axis=1) != 0).any(axis=0)
    chosen = np.union1d(order[first], np.flatnonzero(gaps.room < _NEAR))
    if len(chosen) > _MOST_ROWS:
        chosen = chosen[np.argpartition(gaps.room[chosen], _MOST_ROWS)[:_MOST_ROWS]]
    return chosen


def _least(rows: Array, lower: Array, soft: tuple[int, int]) -> Array | None:
    """Return the smallest y with ``rows @ y >= lower``, shape (n,); None when there is none.

    Where the rows contradict each other, the first ``soft[0]`` rows (clearances) are relaxed by one common distance, as
    small as possible. If that is not enough, limits of joints are relaxed too (the first ``soft[1]`` rows).
    """
    n, upper = rows.shape[1], np.full(len(rows), UNBOUNDED)
    y, _, flag, _ = daqp.solve(np.eye(n), np.zeros(n), np.ascontiguousarray(rows), upper, lower)
    for relaxed in soft:
        if flag == _SOLVED:
            return np.asarray(y[:n])
        slack = np.where(np.arange(len(rows)) < relaxed, _SLACK_SCALE, 0.0)[:, None]
        y, _, flag, _ = daqp.solve(np.eye(n + 1), np.zeros(n + 1), np.hstack([rows, slack]), upper, lower)
    return np.asarray(y[:n]) if flag == _SOLVED else None
