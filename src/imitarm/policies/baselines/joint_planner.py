r"""RRT-Connect in joint space: find any joint path to the goal on which the whole arm is clear.

Two trees of joint postures grow: one from the start posture, the other from the goal postures. The trees grow towards
random postures and towards each other (Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path
planning", ICRA 2000). An edge is a straight line between two postures, :math:`q(s) = a + s (b - a)`. An edge may be
used if

.. math:: d(q(s)) \ge d_{req}, \qquad \angle\big(R(q(s)),\, R_0(q(s))\big) \le \tau

for all :math:`s` in [0, 1]. Here, d is any distance between the arm and an obstacle, or between two links.
:math:`d_{req}` is the required clearance. The module ``arm_certificate`` computes lower bounds of these distances on
the whole edge. R is the rotation of the tool, and :math:`R_0` is the learned rotation at the nearest point of the
learned path. The angle between the two, the tilt, is checked at samples of the edge against its limit :math:`\tau`. The
planner uses nothing else from the demonstrations. A comparison with this baseline shows the costs and the benefits of
following the demonstrated motion.

The library ompl grows the trees. The code that checks the edges is written in Python, with array operations over all
samples of an edge. Most of the planning time is spent in this code, not in ompl.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InfeasibleError, InputError, UnreachableError
from imitarm.evaluation.path_style import tilts
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.arm_path import ArmPath, track
from imitarm.kinematics.pose import Pose
from imitarm.policies.arm_certificate import ArmAmongObstacles
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.goal_postures import clear_postures
from imitarm.policies.path_policy import PathPlan, PathPolicy
from imitarm.policies.retiming import retimed, safe_rates
from imitarm.policies.whole_arm import links_apart
from imitarm.scene.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number, whole_number

Array = NDArray[np.float64]

_STEP = 0.1  # [rad] most that a joint moves between two samples of an edge
_TILT_STEP = 0.05  # [rad] the same, where the tilt is checked
_RANGE, _TILT_RANGE = 1.5, 0.5  # [rad] longest edge by which a tree grows: with any rotation, with a limited tilt
_ALLOWANCE = 5e-3  # [m] additional clearance for tracking errors, if a path is found with it
_LIMIT_MARGIN = 0.01  # [rad] from a joint's limit
_TILT_ERROR = 1e-3  # [rad] accepted excess of the tilt
_GOALS, _GOAL_STARTS, _DIFFERENT = (
    3,
    4,
    0.3,
)  # goal postures; random starts of a quick search; [rad] between two of them
_FINE, _SPEED = 0.02, 0.4  # [rad] between samples of the motion; fraction of the largest joint speed
_SMOOTHINGS = 3  # rounds of the B-spline that rounds off the corners
_SAME_POSTURE = 1e-4  # [m, rad] the joints are planned from exactly where the arm is


@dataclass(frozen=True, eq=False)
class TiltLimit:
    """Limit of the tool's tilt: its rotation away from the learned rotation at the nearest point of the learned path.

    Attributes:
        learned: the learned path with its rotations, with n samples.
        largest: largest permitted rotation at each sample, shape (n,) [rad].
    """

    learned: Trajectory
    largest: Array

    def excess(self, path: ArmPath) -> Array:
        """Return the tilt minus its limit in each posture of ``path``, shape (m,) [rad]."""
        tilt, nearest = tilts(self.learned, path.positions, path.quaternions)
        return np.asarray(tilt - self.largest[nearest])


class ClearMotions:
    """Checks whether postures and straight joint motions keep the arm's clearances and the limit of the tilt.

    Args:
        around: the arm, its obstacles (at rest) and the required clearances.
        tilt: limit of the tool's tilt; None: any rotation.
    """

    def __init__(self, around: ArmAmongObstacles, tilt: TiltLimit | None = None) -> None:
        self.around, self.tilt = around, tilt
        self._step = _STEP if tilt is None else _TILT_STEP

    def posture(self, joints: Array) -> bool:
        """Return whether a posture (n_joints,) [rad] keeps the clearances and the limit of the tilt."""
        path = ArmPath.of(self.around.arm, joints[None])
        return self._upright(path) and self.around.clearance_at(path, np.zeros(1), 0.0).room >= 0.0

    def motion(self, start: Array, end: Array) -> bool:
        """Return whether the whole straight line between two postures (n_joints,) [rad] keeps clearances and tilt."""
        n = 2 + int(np.abs(end - start).max() / self._step)
        path = ArmPath.of(self.around.arm, np.linspace(start, end, n))
        return self._upright(path) and self.around.clearance_of(path, np.zeros(n)).room >= 0.0

    def _upright(self, path: ArmPath) -> bool:
        return self.tilt is None or float(self.tilt.excess(path).max()) <= _TILT_ERROR


def find_joint_path(
    clear: ClearMotions, start: Array, goals: Sequence[Array], *, seconds: float = 10.0, seed: int = 1
) -> Array | None:
    """Find a clear joint path from one posture to one of several goal postures, then shorten and smooth the path.

    Args:
        clear: checks of postures and motions.
        start: first posture, shape (n_joints,) [rad].
        goals: goal postures, each of shape (n_joints,) [rad]; the path ends in one of these postures.
        seconds: limit of the search's computing time [s]; the time for shortening and smoothing is additional.
        seed: seed of the random postures, at least 1. If the search does not run out of time, the same seed gives the
            same path.

    Returns:
        Postures along the path, shape (m, n_joints) [rad], with straight lines in between; None when no path was found
        in time.

    Raises:
        InputError: when ompl is not installed.
    """
    base, geometric = _ompl(seed)
    n, ends = len(start), np.stack([start, *goals])
    arm = clear.around.arm
    low, high = np.maximum(arm.lower, -np.pi) + _LIMIT_MARGIN, np.minimum(arm.upper, np.pi) - _LIMIT_MARGIN
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for joint in range(n):
        bounds.setLow(joint, float(min(low[joint], ends[:, joint].min())))
        bounds.setHigh(joint, float(max(high[joint], ends[:, joint].max())))
    space.setBounds(bounds)
    info = base.SpaceInformation(space)

    class Edges(base.MotionValidator):  # type: ignore[misc, name-defined, unused-ignore]
        def checkMotion(self, one: Any, other: Any) -> bool:  # the name is that of ompl
            return clear.motion(np.array(one[0:n]), np.array(other[0:n]))

    edges = Edges(info)
    info.setMotionValidator(edges)
    info.setStateValidityChecker(lambda state: clear.posture(np.array(state[0:n])))
    info.setup()

    def state(joints: Array) -> Any:
        found = space.allocState()
        found[0:n] = joints.tolist()
        return found

    problem, wanted = base.ProblemDefinition(info), base.GoalStates(info)
    problem.addStartState(state(start))
    for goal in goals:
        wanted.addState(state(goal))
    problem.setGoal(wanted)
    planner = geometric.RRTConnect(info)
    planner.setRange(_RANGE if clear.tilt is None else _TILT_RANGE)
    planner.setProblemDefinition(problem)
    planner.setup()
    until = time.process_time() + seconds
    planner.solve(base.PlannerTerminationCondition(lambda: time.process_time() > until))
    if not problem.hasExactSolution():
        return None
    path, shorter = problem.getSolutionPath(), geometric.PathSimplifier(info)
    shorter.reduceVertices(path)
    shorter.partialShortcutPath(path)
    shorter.smoothBSpline(path, _SMOOTHINGS)
    return np.array([path.getState(i)[0:n] for i in range(path.getStateCount())])


def _ompl(seed: int) -> tuple[Any, Any]:
    """Return ompl's modules, with its random numbers seeded and its messages switched off."""
    try:
        from ompl import base, geometric, util  # noqa: PLC0415 (an extra)
    except ModuleNotFoundError as error:
        raise InputError("rrt-connect needs ompl: pip install 'imitarm[planner]'") from error
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed)
    return base, geometric


class RRTConnect(PathPolicy):
    """Move to the goal on the first clear joint path that a random search finds; the motion is not the learned one.

    The search starts in the measured posture and ends in a clear posture with the tool at the goal, see
    :func:`find_joint_path`. The execution times of the path keep the limits of the arm and of the safety filter.

    Args:
        skill: skill whose goal the tool reaches.
        max_tilt: largest rotation of the tool away from the learned rotation at the nearest point of the learned path
            [rad]; None: any rotation.
        seconds: limit of the computing time of the search [s].
        seed: seed of the search, at least 1.
        options: arguments of :class:`~imitarm.policies.path_policy.PathPolicy`; ``arm`` is required.

    Raises:
        InputError: when ompl is not installed, the arm is missing, or an argument is not valid.
    """

    def __init__(
        self, skill: Skill, *, max_tilt: float | None = None, seconds: float = 10.0, seed: int = 1, **options: Any
    ) -> None:
        super().__init__(skill, **options)
        name = type(self).__name__
        if self.arm is None:
            raise InputError(f"{name}: plans the joints of an arm, so it needs the argument arm")
        if np.size(self.forbidden):
            raise InputError(f"{name}: a search in joint space can't keep forbidden directions; leave them out")
        self._of_arm: ArmModel = self.arm
        self._max_tilt = None if max_tilt is None else finite_number(max_tilt, f"{name}: max_tilt", "rad", at_least=0.0)
        self._seconds = finite_number(seconds, f"{name}: seconds", "s", above=0.0)
        self._seed = whole_number(seed, f"{name}: seed", at_least=1)
        self._same_start = _SAME_POSTURE
        self._path = ComponentPath.of_skill(skill)
        _ompl(self._seed)

    def plan_motion(self, scene: Scene, start: Pose | None = None, state: ArmState | None = None) -> PathPlan:
        """Search for a clear joint path.

        Raises:
            InfeasibleError: when the start posture violates a clearance or the limit of the tilt, when no goal posture
                keeps the clearances, when no path was found in time, or when an obstacle moves.
        """
        if any(obstacle.velocity.any() or obstacle.angular_velocity.any() for obstacle in scene.obstacles):
            raise InfeasibleError("rrt-connect plans only among obstacles that stand still: use another policy")
        arm, components = self._of_arm, self._path.between(self.skill, start, scene.goal)
        nominal = components.nominal
        q = find_posture(arm, start or nominal.pose(0)) if state is None else state.q
        learned = nominal
        if nominal.quaternions is None:  # the tool keeps the rotation that it has at the start
            held = np.tile(arm.tool_pose(q).quaternion, (len(nominal), 1))
            learned = Trajectory(nominal.times, nominal.positions, held)
        limit = self._limits(components)
        tilt = None if limit is None else TiltLimit(learned, limit)
        until, reason = time.process_time() + self._seconds, ""
        for allowance in (_ALLOWANCE, 0.0):
            around = _surroundings(arm, scene, self.clearance + allowance, learned, q)
            clear = ClearMotions(around, tilt)
            if not clear.posture(q):
                reason = (
                    "in its start posture, the arm is too close to an obstacle or to itself, or the tool is tilted too "
                    "far: move the obstacle or the arm"
                )
                continue
            goals = _goal_postures(around, learned.pose(len(learned) - 1), q)
            left = until - time.process_time()
            if not goals:
                reason = "no posture was found in which the tool is at the goal and the whole arm is clear"
            elif left > 0.0:
                corners = find_joint_path(clear, q, goals, seconds=left, seed=self._seed)
                reason = f"no clear joint path was found in {self._seconds:g} s"
                if corners is not None:
                    return self._timed(around, corners, learned, allowance)
        raise InfeasibleError(reason)

    def _limits(self, components: ComponentPath) -> Array | None:
        """Return the largest tilt at each sample of the learned path, shape (n,) [rad]; None: any rotation."""
        return None if self._max_tilt is None else np.full(len(components.nominal), self._max_tilt)

    def _timed(self, around: ArmAmongObstacles, corners: Array, learned: Trajectory, allowance: float) -> PathPlan:
        """Return the motion along straight lines between corners, with its execution times."""
        arm = self._of_arm
        parts = np.maximum(np.ceil(np.abs(np.diff(corners, axis=0)).max(axis=1) / _FINE), 1.0).astype(int)
        places = np.concatenate([*(i + np.arange(k) / k for i, k in enumerate(parts)), [len(corners) - 1.0]])
        joints = np.stack([np.interp(places, np.arange(len(corners)), column) for column in corners.T], axis=1)
        moves = np.abs(np.diff(joints, axis=0)) / (_SPEED * arm.max_velocity)
        parameters = np.concatenate([[0.0], np.cumsum(np.maximum(moves.max(axis=1), 1e-6))])
        path = ArmPath.of(arm, joints)
        fastest = safe_rates(around, path, parameters, np.zeros(len(path)), allowance)
        timing = retimed(arm, joints, parameters, fastest)
        if timing.blocked >= 0:
            raise InfeasibleError("the joint path that was found needs more torque than a joint has")
        trajectory = Trajectory(timing.times, path.positions, path.quaternions)
        return replace(PathPlan.beside(learned, trajectory), joints=joints)


class TiltLimitedRRTConnect(RRTConnect):
    """:class:`RRTConnect` with ACFRA's default of ``max_tilt``: two standard deviations of the demonstrations.

    Each pose of the tool has its own limit. The planner computes this limit from the standard deviation at the point of
    the learned path that is nearest to the tool. If the skill has no learned orientation, pass ``max_tilt``: the
    default is then 0, which a random search can't keep, and planning raises an error.
    """

    def _limits(self, components: ComponentPath) -> Array | None:
        given = super()._limits(components)
        limit = components.rotation_tolerance if given is None else given
        if not limit.any():
            raise InfeasibleError("a random search can't keep the tool's rotation exactly: allow a tilt (max_tilt)")
        return limit


def _surroundings(
    arm: ArmModel, scene: Scene, clearance: float, learned: Trajectory, start: Array
) -> ArmAmongObstacles:
    """Return what the arm must be clear of; the learned motion may come near the fixtures as it does for ACFRA."""
    contacts = None
    if scene.fixtures and learned.quaternions is not None:
        contacts = track(arm, start, learned.positions, learned.quaternions)[::4]
    return ArmAmongObstacles(
        arm, scene.obstacles, clearance, fixtures=scene.fixtures, contacts=contacts, own=links_apart(arm)
    )


def _goal_postures(around: ArmAmongObstacles, goal: Pose, start: Array) -> list[Array]:
    """Return a few clear postures with the tool at the goal, the one nearest to the start first.

    A quick search tries few start postures. If it finds no clear posture, the search of ACFRA is used, which also
    varies the postures by the self-motion of the arm.
    """
    arm, random = around.arm, np.random.default_rng(0)
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    found: list[Array] = []
    for begin in (start, *random.uniform(low, high, size=(_GOAL_STARTS, arm.n_joints))):
        with contextlib.suppress(UnreachableError):
            q = find_posture(arm, goal, q0=begin, restarts=0)
            different = all(np.abs(q - other).max() > _DIFFERENT for other in found)
            if different and around.clearance_at(ArmPath.of(arm, q[None]), np.zeros(1), 0.0).room >= 0.0:
                found.append(q)
    if not found:
        found = [posture.joints for posture in clear_postures(around, goal, 0.0, start, 0.0).found]
    return sorted(found, key=lambda q: float(np.abs(q - start).max()))[:_GOALS]
