"""Search for a joint path on which the whole arm keeps its clearance and follows the demonstration closely.

The search tries the following plans in turn, until one keeps the clearance. The first ones change the demonstrated
motion least:

1. the path planned for the tool alone, with changes of the arm's posture and with the allowed tilt of the tool;
2. another posture of the arm at the goal;
3. narrower components, which can bend the path more sharply;
4. the path on another side of the obstacle, or farther away from it;
5. another posture at the start, if a collision-free motion leads to this posture first;
6. the failed plans with the largest clearance, again with narrower components.

If a plan takes much longer than the learned motion, the search makes a few more attempts and returns the fastest plan.
The plan may be slow because the tool passes close to an obstacle. Then other postures would not help, and the search
tries only other paths of the tool. If no attempt succeeds, the reason names the link and the obstacle that come too
close in the best attempt, and the time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_path import ArmPath, track
from imitarm.kinematics.pose import Pose
from imitarm.policies.approach import Approach, find_approach
from imitarm.policies.arm_certificate import ArmAmongObstacles, ArmClearance
from imitarm.policies.arm_pairs import SELF
from imitarm.policies.arm_planner import JOINT_LIMIT, TILT_LEVER, TILT_LIMIT, ArmPlan, ArmPlanner
from imitarm.policies.arm_task import ArmSolution, ArmTask
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.goal_postures import GoalPosture, GoalSearch, clear_postures
from imitarm.policies.least_detour import SMOOTHNESS
from imitarm.policies.retiming import SELF_CLEARANCE, Schedule, Timing, retimed, safe_rates, schedules
from imitarm.policies.tilts import Tilts
from imitarm.scene.clearance import SelfClearance

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_REACH = 0.15  # [m] largest clearance that is reported
_RETIMINGS = 6  # among moving obstacles
_SPARE = 2e-3  # [m] of clearance that is planned for, because new execution times change the distances
_AHEAD = 0.05  # of the duration: a place this close to the goal is the goal
_FOR_LATER = 2.0  # rounds of a limited search that are kept for attempts to execute the path later
_MOST_SCHEDULES, _FEW_SCHEDULES = 4, 2  # for which a plan is made: usually, when the time is limited
_DELAY_FOR_ROOM = 40.0  # [s/m] a schedule that lacks a centimetre is as good as one that takes 0.4 s longer
_LOOKED = 3  # every so many coarse samples are compared with a schedule
_SLOW, _KEPT_RATE = 0.02, 0.9  # rate of an arm that rests; fraction of the present rate with which a plan must begin
_SIDES = 8  # directions tried across the path
_AWAY = (0.1, 0.2)  # [m] by which the path is moved to another side
_MOST_SIDES = 5  # that are followed up
_GOALS = 3  # postures at the goal that are tried first
_LATE, _MORE = 1.45, 6  # times the learned duration: a plan that takes longer is kept, and so many more are tried
_NEARLY, _MOST_NEARLY = 0.02, 3  # [m] a failed attempt that lacks less is tried again; number of such attempts
_LEVER = 0.05  # squared influence of the components; a place with less is not moved


def solve(task: ArmTask, path: ComponentPath, displacement: Array) -> ArmSolution:
    """Find a joint path on which the tool follows a skill's path and the whole arm avoids the obstacles.

    Args:
        task: the arm, its obstacles and the limits of the plan.
        path: the path of the tool and its components.
        displacement: first guess of the components' displacements, for example from a plan of the tool alone, shape
            (n_components, 3) [m].
    """
    search = _Search(task, path, displacement)
    if search.start.room < 0.0:
        return ArmSolution(None, None, f"at the start, {search.named(search.start)}: move the obstacle or the arm")
    best: ArmPlan | None = None
    late: ArmSolution | None = None
    more = _MORE
    for tried, attempt in enumerate(islice(search.attempts(), task.max_attempts)):
        if late is not None:
            more -= 1
            if more < 0:
                break
        planner, moved, joints, tilt = attempt
        kept = _FOR_LATER if tried == 0 and search.moving else 0.0
        task.effort.left -= kept
        plan = planner.plan(moved, joints, tilt)
        task.effort.left = max(task.effort.left, 0.0) + kept
        if plan is not None and not plan.feasible:
            best = plan if best is None or _rank(plan) > _rank(best) else best
            search.failed(planner, plan)
        found = search.solution(planner, plan) if plan is not None and plan.feasible else None
        if found is None and tried == 0:
            found = search.later(attempt)
        if found is None:
            search.mistimed |= plan is not None and plan.feasible
            continue
        late = found if late is None or found.duration < late.duration else late
        if task.rest is not None or found.reason or late.duration <= _LATE * path.nominal.duration:
            return late
        search.slow(late)
    return ArmSolution(best, None, search.refusal(best)) if late is None else late


def _rank(plan: ArmPlan) -> tuple[bool, float]:
    return plan.complete, plan.clearance.room


class _Attempt(NamedTuple):
    """A first guess: the planner that improves it, displacements, joints at its coarse samples, tilt coefficients."""

    planner: ArmPlanner
    displacement: Array
    joints: Array
    tilt: Array


class _Search:
    """The attempts of one search, and the clearance of the best failed attempt."""

    def __init__(self, task: ArmTask, path: ComponentPath, displacement: Array) -> None:
        self.task, self._components, self._displacement = task, path, displacement
        nominal = self._components.nominal
        self._times = nominal.times
        start = task.arm.tool_pose(task.start)
        learned = nominal.quaternions
        self._quaternions = np.tile(start.quaternion, (len(nominal), 1)) if learned is None else learned
        fixtures = task.scene.fixtures
        contacts = track(task.arm, task.start, nominal.positions, self._quaternions)[::4] if fixtures else None
        own = links_apart(task.arm)
        self._around = ArmAmongObstacles(
            task.arm,
            task.scene.obstacles,
            task.clearance,
            fixtures=fixtures,
            contacts=contacts,
            own=own,
            margins=task.margins,
        )
        self.start = self._around.clearance_at(ArmPath.of(task.arm, task.start[None]), np.zeros(1), _REACH)
        self._tilts = Tilts.between_ends(self._times, tilted_goal=task.goal_tilt > 0.0, window=path.at_pins)
        self._margins = task.margins or (None,) * len(task.scene.obstacles)
        growing = any(margin is not None and margin.growth > 0.0 for margin in self._margins)
        self.moving = growing or any(obstacle.velocity.any() for obstacle in task.scene.obstacles)
        self._first: _Attempt | None = None
        self._worst: ArmClearance | None = None
        self._slow_tool = False
        self._failed: list[tuple[ArmPlanner, ArmPlan]] = []
        self._goals: GoalSearch | None = None
        self.mistimed = False  # whether a plan was clear at the learned times, but not at times within the limits

    def attempts(self) -> Iterator[_Attempt]:
        """Yield the first guesses with which the attempts begin.

        The order of the attempts is given at the beginning of this module.
        """
        learned, detour, rest = self._planner(self._components), self._displacement, self.task.rest
        if rest is None:
            begin = self._followed(learned, detour)
        else:
            begin = _Attempt(learned, detour, rest.joints[learned.coarse], rest.tilt)
        self._first = begin
        yield begin
        path = self._components.nominal
        if self._slow_tool:
            yield from self._other_paths(learned, detour)
            return
        goal, end = Pose(path.positions[-1], self._quaternions[-1]), float(self._times[-1])
        self._goals = clear_postures(self._around, goal, end, self.task.start, self.task.goal_tilt)
        if not self._goals.found:
            return
        if self._at_goal() or self._late:
            near, far = self._goals.found[:_GOALS], self._goals.found[_GOALS:]
            for posture in near:
                yield self._followed(learned, detour, posture)
            if self._at_goal():
                yield from self._other_starts(detour, near)
                for posture in far:
                    yield self._followed(learned, detour, posture)
                yield from self._other_starts(detour, far)
                yield from self._nearly()
                return
        yield from self._other_paths(learned, detour)
        yield from self._other_starts(detour, self._goals.found)
        yield from self._nearly()

    def _other_paths(self, learned: ArmPlanner, detour: Array) -> Iterator[_Attempt]:
        """Yield first guesses with narrower components, and on other sides of the obstacle."""
        narrow = self._planner(self._components.divided, smoothness=SMOOTHNESS)
        if not (self._slow_tool and narrow.components.n_components == learned.components.n_components):
            yield self._followed(narrow, self._narrowed(narrow, detour, learned.components))
        for planner in (learned, narrow):
            yield from self._sides(planner)

    def _nearly(self) -> Iterator[_Attempt]:
        """Yield the best failed attempts again, with narrower components."""
        failed = sorted(self._failed, key=lambda one: -one[1].clearance.room)
        for planner, plan in failed[:_MOST_NEARLY]:
            if plan.clearance.room < -_NEARLY:
                return
            narrow = self._planner(self._components.divided, smoothness=SMOOTHNESS, free_start=planner.free_start)
            coarse = narrow.coarse if plan.complete else slice(None)
            yield _Attempt(
                narrow, self._narrowed(narrow, plan.displacement, plan.components), plan.path.joints[coarse], plan.tilt
            )

    def _narrowed(self, narrow: ArmPlanner, displacement: Array, components: ComponentPath) -> Array:
        """Return displacements of narrower components that displace the path as those of other components do."""
        away = components.basis @ displacement
        return np.asarray(np.linalg.lstsq(narrow.components.basis, away, rcond=1e-6)[0], dtype=np.float64)

    def _other_starts(self, displacement: Array, goals: Sequence[GoalPosture]) -> Iterator[_Attempt]:
        """Yield first guesses for a joint path that ends in a clear posture; its start posture is not prescribed."""
        if self.moving or self.task.rest is not None:  # there is no time for an approach
            return
        planner = self._planner(self._components, free_start=True)
        for goal in goals:
            tilt = planner.tilt_at_goal(goal.tilt)
            positions, quaternions = planner.poses(displacement, tilt, planner.coarse)
            joints = track(self.task.arm, goal.joints, positions[::-1], quaternions[::-1])[::-1]
            yield _Attempt(planner, displacement, joints, tilt)

    def approach(self, end: Array) -> Approach | None:
        """Return a clear motion from the posture of the task to another posture; None if none was found."""
        return find_approach(self._around, self.task.start, end, self.task.allowance)

    def solution(self, planner: ArmPlanner, plan: ArmPlan) -> ArmSolution | None:
        """Return a feasible plan with its execution times and its approach; None if there is none of them."""
        approach = self.approach(plan.path.joints[0]) if planner.free_start else None
        if approach is None and planner.free_start:
            return None
        timed = self.timed(planner, plan)
        return None if timed is None else ArmSolution(*timed, self.overloaded(timed[1]), approach)

    def slow(self, found: ArmSolution) -> None:
        """Remember where a plan is slowest compared with the learned motion, to look for a faster one."""
        if self._worst is None and found.plan is not None and found.timing is not None:
            slowest = int(np.argmax(np.diff(found.timing.times) / np.diff(self._times)))
            self._worst = replace(found.plan.clearance, room=-np.inf, sample=slowest)
            detoured = np.array_equal(found.plan.displacement, self._displacement) and not found.plan.tilt.any()
            self._slow_tool = detoured and self._tool_is_late(found.plan.path, found.timing.times)

    def _tool_is_late(self, path: ArmPath, clock: Array) -> bool:
        """Return whether a motion takes too long in any posture, because the tool passes an obstacle so slowly."""
        rates = safe_rates(self._around, path, self._times, clock, self.task.allowance, tool_only=True)
        least = float(np.sum(2.0 * np.diff(self._times) / (rates[1:] + rates[:-1])))
        return least > _LATE * self._components.nominal.duration

    def failed(self, planner: ArmPlanner, plan: ArmPlan) -> None:
        """Remember where an attempt failed."""
        self._failed.append((planner, plan))
        if self._worst is None or plan.clearance.room > self._worst.room:
            self._worst = plan.clearance

    @property
    def _late(self) -> bool:
        return self._worst is not None and self._worst.room == -np.inf

    def _at_goal(self) -> bool:
        worst = self._worst
        last = len(self._times) - 1
        return (
            worst is not None
            and worst.obstacle not in (JOINT_LIMIT, TILT_LIMIT)
            and worst.sample >= (1.0 - _AHEAD) * last
        )

    def _planner(self, components: ComponentPath, *, smoothness: float = 0.0, free_start: bool = False) -> ArmPlanner:
        rest = self.task.rest
        tilts = self._tilts if rest is None else rest.tilts
        return ArmPlanner(
            self._around,
            components,
            self._quaternions,
            self.task.max_tilt,
            self.task.allowed,
            tilts=tilts,
            smoothness=smoothness,
            free_start=free_start,
            begun=rest is not None,
            spare=_SPARE if self.moving else 0.0,
            quick=self.task.max_attempts == 1,
            effort=self.task.effort,
        )

    def _followed(self, planner: ArmPlanner, displacement: Array, goal: GoalPosture | None = None) -> _Attempt:
        """Return a first guess that follows the tool's path from the start, towards a posture at the goal."""
        tilt = planner.tilt_at_goal(np.zeros(3) if goal is None else goal.tilt)
        poses = planner.poses(displacement, tilt, planner.coarse)
        joints = track(self.task.arm, self.task.start, *poses, None if goal is None else goal.joints)
        return _Attempt(planner, displacement, joints, tilt)

    def _sides(self, planner: ArmPlanner) -> list[_Attempt]:
        """Return displacements with which the tool passes the closest place on other sides, each with its joint path.

        The closest place is where the clearance of the best failed attempt was smallest. Of all displacements, those
        that violate the required clearances least are returned.
        """
        worst = self._worst
        if worst is None or not self.task.allowed.dimension:
            return []
        path, at = planner.components, worst.sample
        lever = float((path.basis[at] ** 2).sum())
        if lever < _LEVER:
            return []
        positions = path.nominal.positions
        tangent = positions[min(at + 2, len(positions) - 1)] - positions[max(at - 2, 0)]
        tangent = tangent / max(float(np.linalg.norm(tangent)), 1e-9)
        across = np.linalg.svd(tangent[None])[2][1:]
        angles = np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ across
        found: list[tuple[float, int, _Attempt]] = []
        for distance in _AWAY:
            for direction in self.task.allowed.unit_directions(ring):
                attempt = self._followed(planner, (distance / lever * path.basis[at])[:, None] * direction)
                arm = ArmPath.of(self.task.arm, attempt.joints)
                gaps = self._around.gaps(arm, self._times[planner.coarse], 0.0)
                found.append((float(-gaps.room.sum()), len(found), attempt))
        return [attempt for _, _, attempt in sorted(found, key=lambda one: one[:2])[:_MOST_SIDES]]

    def later(self, attempt: _Attempt) -> ArmSolution | None:
        """Return a plan that is executed later or more slowly, so that moving obstacles pass first; None without one.

        The first guess of the attempt is compared with all schedules, at a few samples. A plan is then made for the
        best schedules.
        """
        if not self.moving:
            return None
        planner, displacement, joints, tilt = attempt
        path = ArmPath.of(self.task.arm, joints)
        clock = self._timing(path, self._times[planner.coarse], self._times[planner.coarse], None).times
        clock = np.interp(self._times, self._times[planner.coarse], clock)
        possible = schedules(self._times, clock, at_rest=self.task.rest is None or self.task.rest.rate < _SLOW)
        rooms = self._rooms(joints, planner.coarse, possible)
        rated = [
            (schedule.delay + _DELAY_FOR_ROOM * -room, room, schedule)
            for schedule, room in zip(possible, rooms, strict=True)
        ]
        most = _MOST_SCHEDULES if self.task.max_attempts is None else _FEW_SCHEDULES
        rated.sort(key=lambda one: one[0])
        chosen = [schedule for _, _, schedule in rated[:most]]
        clear = [schedule for _, room, schedule in rated if room >= 0.0]
        if clear and clear[0] not in chosen:
            chosen[-1] = clear[0]
        if self.task.effort.left < np.inf:  # first one that needs no other path
            chosen.sort(key=lambda schedule: schedule not in clear)
        for schedule in chosen:
            if not self.task.effort.spend():
                break
            planner.clock = schedule.clock
            plan = planner.plan(displacement, joints, tilt)
            timed = None if plan is None or not plan.feasible else self.timed(planner, plan, schedule.fastest)
            if timed is not None and timed[1].blocked < 0:
                return ArmSolution(*timed, "")
        planner.clock = self._times
        return None

    def _rooms(self, joints: Array, coarse: Index, possible: list[Schedule]) -> list[float]:
        """Return the smallest clearance of joints at the coarse samples for each schedule, at most 0 [m].

        Some of the samples are looked at, and the goal also some time after the arrival.
        """
        looked = np.unique(np.append(np.arange(0, len(coarse), _LOOKED), len(coarse) - 1))
        after = self.task.hold * np.array([0.5, 1.0])
        clocks = np.array([schedule.clock[coarse[looked]] for schedule in possible])
        clocks = np.concatenate([clocks, clocks[:, -1:] + after], axis=1)
        postures = np.concatenate([joints[looked], np.tile(joints[-1], (len(after), 1))])
        return [float(room) for room in self._around.rooms_at(postures, clocks)]

    def _held(self, joints: Array, time: float) -> float:
        """Return the clearance of a posture that is held from a time on, at most 0 [m]."""
        if self.task.hold == 0.0:
            return 0.0
        path = ArmPath.of(self.task.arm, np.stack([joints, joints]))
        return min(self._around.clearance_of(path, np.array([time, time + self.task.hold])).room, 0.0)

    def timed(self, planner: ArmPlanner, plan: ArmPlan, fastest: Array | None = None) -> tuple[ArmPlan, Timing] | None:
        """Return a plan with execution times within the limits of the arm and of the safety filter.

        New execution times change the distances to moving obstacles. A new plan is then made for the new times, and it
        gets execution times of its own. This is repeated until a plan keeps its clearance at its own execution times.
        If this does not succeed, the result is None.

        Args:
            planner: the planner of the plan.
            plan: the plan.
            fastest: largest rate ds/dt at each sample, shape (n,); None: 1.
        """
        for tried in range(_RETIMINGS):
            if tried and not self.task.effort.spend():
                break
            timing = self._timing(plan.path, self._times, planner.clock, fastest)
            if timing.blocked >= 0 or not self.moving:
                return plan, timing
            if fastest is not None and self.task.rest is not None and timing.rate < _KEPT_RATE * self.task.rest.rate:
                return None  # the arm is too fast to brake in time
            planner.clock = timing.times
            if self._held(plan.path.joints[-1], float(timing.times[-1])) < 0.0:
                return None
            clearance = self._around.clearance_of(plan.path, timing.times)
            if clearance.room >= 0.0:
                return replace(plan, clearance=clearance), timing
            again = planner.plan(plan.displacement, plan.path.joints[planner.coarse], plan.tilt)
            if again is None or not again.feasible:
                return None
            plan = again
        return None

    def _timing(self, path: ArmPath, times: Array, clock: Array, limit: Array | None) -> Timing:
        """Return execution times for a path whose samples have the parameters ``times``.

        Each sample is compared with the places of the obstacles at its time in ``clock``. The rates are at most
        ``limit``, if it is given.
        """
        fastest = safe_rates(self._around, path, times, clock, self.task.allowance)
        fastest = fastest if limit is None else np.minimum(fastest, limit)
        rate = 0.0 if self.task.rest is None else self.task.rest.rate
        return retimed(self.task.arm, path.joints, times, fastest, path=path, rate=rate)

    def named(self, found: ArmClearance) -> str:
        """Return a text that names the two objects that are too close and their distance, or a joint at its limit."""
        arm = self.task.arm
        if found.obstacle == JOINT_LIMIT:
            return f"joint {arm.joint_names[found.sphere]} would exceed its limit by {-found.room:.2f} rad"
        if found.obstacle == TILT_LIMIT:
            return f"the tool would be tilted by {np.degrees(-found.room / TILT_LEVER):.1f} degrees more than allowed"
        link = arm.cover.bodies[found.sphere]
        if found.obstacle == SELF:
            bodies = arm.cover.bodies
            other = bodies[found.other] if found.other < len(bodies) else "the base"
            left = 1e3 * (found.room + SELF_CLEARANCE)
            return f"{link} is {left:.0f} mm from {other} ({1e3 * SELF_CLEARANCE:.0f} mm required)"
        left, scene = 1e3 * (found.room + self.task.clearance), self.task.scene
        n = len(scene.obstacles)
        if found.obstacle < n:
            name = scene.name_of(found.obstacle)
        else:
            fixture = scene.fixtures[found.obstacle - n]
            name = fixture.name or fixture.kind
        if found.obstacle < n and self._margins[found.obstacle] is not None:
            name += ", beyond the margin for its prediction"
        return f"{link} is {left:.0f} mm from {name} ({1e3 * self.task.clearance:.0f} mm required)"

    def refusal(self, best: ArmPlan | None) -> str:
        """Return why no plan was found."""
        if self.mistimed and (best is None or self._goals is None or self._goals.found):
            return (
                "a joint path was found on which the whole arm is clear of the moving obstacles at the learned times, "
                "but not at times within the limits of the arm: wait until an obstacle has passed, or show the motion "
                "more slowly"
            )
        if best is None:
            return f"{self.task.arm.name} can't move its tool along the path: move the path nearer to the arm"
        first = ""
        if self.task.rest is None:
            first = f"on the path planned for the tool alone, {self._placed(self._on_first_path())}; "
        if self._goals is not None and not self._goals.found:
            best_posture = self._goals.best
            nearest = "" if best_posture is None else f" (in the best posture, {self.named(best_posture)})"
            return (
                f"no posture was found in which the tool is at the goal and the whole arm is clear{nearest}: move the "
                "obstacle or the goal, or allow the tool to tilt at the goal (goal_tilt)"
            )
        return (
            "no joint path was found on which the whole arm keeps its clearance "
            f"({first}in the best attempt, {self._placed(best.clearance)}): move the obstacle, "
            "allow a larger tilt of the tool (max_tilt), or require a smaller clearance"
        )

    def _on_first_path(self) -> ArmClearance:
        """Return the smallest clearance on the path that was planned for the tool alone."""
        assert self._first is not None
        planner, path = self._first.planner, ArmPath.of(self.task.arm, self._first.joints)
        found = self._around.clearance_at(path, self._times[planner.coarse], _REACH)
        return replace(found, sample=int(planner.coarse[found.sample]))

    def _placed(self, found: ArmClearance) -> str:
        return f"{self.named(found)} at {self._times[min(found.sample, len(self._times) - 1)]:.2f} s"

    def overloaded(self, timing: Timing) -> str:
        """Return why a plan can't be executed at any speed; empty if it can."""
        if timing.blocked < 0:
            return ""
        joint = f"joint {self.task.arm.joint_names[timing.joint]}" if timing.joint >= 0 else "a joint"
        return (
            f"at {self._times[timing.blocked]:.2f} s, {joint} has too little torque to hold the weight of the arm: "
            "move the path nearer to the arm, or use a lighter tool"
        )


@lru_cache(maxsize=16)
def links_apart(arm: ArmModel) -> SelfClearance:
    """Return the pairs of links of an arm that must stay apart, with the clearance that plans keep between them."""
    return SelfClearance(arm, SELF_CLEARANCE)
