r"""SimulatedOperator: a simulated person who stacks cubes with a teleoperated robot and watches gripper and cubes.

The operator (the simulated person) sees gripper and cubes with delay and noise, and reacts with a motion of the hand.
Operator and retargeter therefore form a closed loop. The operator behaves in the same way with every retargeter.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.retarget.correspondence import FACING
from imitarm.tasks.stack import N_CUBES, SIDE

Array = NDArray[np.float64]

# the hand
_AT_REST = 1e-3  # [m] smaller corrections are not made
_LONG = 0.03  # [m] a longer sub-movement covers the whole distance, a shorter one only a part of it
_SCATTER = 0.04  # standard deviation of a sub-movement relative to its length (signal-dependent noise)
_MEMORY = 3.0  # [s] after its end a sub-movement is only a constant displacement

# the plan
_HELD = 0.05  # [m] a cube farther than this from the gripper is not in it
_MISSED = 0.026  # [m] fingers closed to less than this hold nothing
_CLOSED, _OPENED = 0.036, 0.045  # [m] openings that look closed on a cube, and open again
_GRIP_ABOVE = 0.005  # [m] height of the grip above a cube's center, so that the finger tips stay off the table
_CLEAR = 0.03  # [m] height at which a cube is carried above the tower
_LOWEST_TRAVEL = 0.085  # [m] lowest height of the empty gripper between two cubes
_RELEASE_ABOVE = 0.0015  # [m] height above the tower at which a cube is released, so as not to press on it
_NEAR = 0.012  # [m] horizontal distance at which the descent starts
_FAST_ABOVE = 0.035  # [m] height above the goal down to which the descent is fast
_STEP_DOWN = 0.025  # [m] step of a careful descent
_IN_TOWER = 0.013  # [m] horizontal distance to the cube below at which a cube looks stacked
_REACHABLE = (0.35, 0.85, 0.40)  # [m] smallest x, largest x and largest |y| at which a fallen cube is fetched


@dataclass(frozen=True, eq=False)
class OperatorView:
    """What the operator sees at one time, in the robot's base frame.

    Attributes:
        time: time [s].
        tool: position of the point between the finger tips, shape (3,) [m].
        opening: distance between the fingers [m].
        cubes: centers of the cubes, shape (4, 3) [m].
        following: whether the robot indicates that it follows the hand.
    """

    time: float
    tool: Array
    opening: float
    cubes: Array
    following: bool = True


@dataclass(frozen=True)
class Habits:
    """Habits of one person in this task.

    Attributes:
        delay: reaction time (about 0.2 s) from seeing an error to the start of the corrective movement [s].
        look_every: mean time between two looks at the gripper [s]. Each look may lead to a correction.
        gain: fraction of a small error that one correction removes, below 1.
        noise: standard deviation of the random error of observed positions along each axis [m]. Each look has another
            error.
        bias: constant error of the observed position of the gripper, 3 values [m].
        speed: mean speed of the hand over long distances [m/s].
        fine_speed: mean speed of the hand near a contact [m/s].
        tolerance: largest position error at which the person considers the gripper aligned, and closes or opens the
            hand [m].
        sense_of_lag: lag that the person expects between hand and robot, the same for every retargeter [s].
        dwell: time for which the hand rests after it has closed or opened [s].
        height: additional height at which the person moves the gripper over long distances [m].
        begin: duration for which the person first holds the hand still, so that the robot can begin to follow [s].
    """

    delay: float
    look_every: float
    gain: float
    noise: float
    bias: tuple[float, float, float]
    speed: float
    fine_speed: float
    tolerance: float
    sense_of_lag: float
    dwell: float
    height: float
    begin: float

    @classmethod
    def from_seed(cls, seed: int) -> Habits:
        """Draw the habits of person number ``seed``."""
        rng = np.random.default_rng([30313, seed])
        across, along, up = rng.normal(0.0, 1.0, 3) * 1e-3
        return cls(
            delay=rng.uniform(0.17, 0.24),
            look_every=rng.uniform(0.11, 0.18),
            gain=rng.uniform(0.45, 0.7),
            noise=rng.uniform(0.5e-3, 1.2e-3),
            bias=(float(across), float(along), float(up)),
            speed=rng.uniform(0.20, 0.34),
            fine_speed=rng.uniform(0.045, 0.08),
            tolerance=rng.uniform(0.0045, 0.0065),
            sense_of_lag=rng.uniform(0.12, 0.22),
            dwell=rng.uniform(0.15, 0.35),
            height=rng.uniform(0.0, 0.02),
            begin=rng.uniform(1.2, 1.8),
        )


class Phase(StrEnum):
    """The phases of stacking one cube."""

    CHOOSE = "choose"
    """Choose the cube to fetch."""
    REACH = "reach"
    """Move above the cube."""
    DESCEND = "descend"
    """Lower the gripper around the cube; close the hand when the gripper looks aligned."""
    CLOSE = "close"
    """Wait until the fingers of the gripper look closed."""
    LIFT = "lift"
    """Raise the cube."""
    CARRY = "carry"
    """Move the cube above the tower."""
    LOWER = "lower"
    """Lower the cube; open the hand when the cube looks stacked."""
    OPEN = "open"
    """Wait until the fingers of the gripper look open."""
    RETREAT = "retreat"
    """Raise the gripper, then choose the next cube."""


class StackPlan:
    """Decides where the operator wants the gripper to go next, and when the hand closes or opens.

    Attributes:
        phase: current phase.
        cube: index of the cube to stack, from 0.
        closed: whether the hand is closed.
        finished: whether all cubes are stacked, or the operator has given up.
    """

    def __init__(self, habits: Habits) -> None:
        self.habits = habits
        self.phase, self.cube = Phase.CHOOSE, 1
        self.closed = self.finished = False
        self._phase_start = 0.0
        self._methods = {
            Phase.CHOOSE: self._choose,
            Phase.REACH: self._reach,
            Phase.DESCEND: self._descend,
            Phase.CLOSE: self._close,
            Phase.LIFT: self._lift,
            Phase.CARRY: self._carry,
            Phase.LOWER: self._lower,
            Phase.OPEN: self._open,
            Phase.RETREAT: self._retreat,
        }

    def step(self, view: OperatorView, now: float) -> tuple[Array | None, bool]:
        """Return the goal of the gripper (3,) [m], or None to keep the hand at rest, and whether to move carefully.

        Args:
            view: what the operator saw, with delay and noise.
            now: time at which the reaction starts [s].
        """
        self._view, self._now = view, now
        self._tool, self._target, self._below = view.tool, view.cubes[self.cube], view.cubes[self.cube - 1]
        impatience = max(self._elapsed() - 2.0, 0.0)
        self._tolerance = self.habits.tolerance * (1.0 + 0.12 * min(impatience, 5.0))
        return self._methods[self.phase]()

    # --- one method for each phase; each returns as step does

    def _choose(self) -> tuple[Array | None, bool]:
        n = self._n_stacked()  # the lowest number that is not in the tower is next
        if n == N_CUBES or not _reachable(self._view.cubes[max(n, 1)]):
            self.finished = True
            return None, False
        self.cube = max(n, 1)
        self._enter(Phase.REACH)
        return None, False

    def _reach(self) -> tuple[Array | None, bool]:
        away = self._horizontal_distance(self._target)
        if away < _NEAR and self._elapsed() > 0.3:
            self._enter(Phase.DESCEND)
        return self._above(self._target, self._travel_height(), away), False

    def _descend(self) -> tuple[Array | None, bool]:
        goal = self._target + [0.0, 0.0, _GRIP_ABOVE]
        away, high = self._horizontal_distance(goal), self._tool[2] - goal[2]
        if away < self._tolerance and abs(high) < max(self._tolerance, 0.006):
            self.closed = True
            self._enter(Phase.CLOSE)
            return None, True
        if away > 3.0 * _NEAR:
            self._enter(Phase.REACH)
        return self._descent(goal, away, 2.0 * self.habits.tolerance)

    def _close(self) -> tuple[Array | None, bool]:
        waited = self._elapsed()
        if self._view.opening < _MISSED or waited > 3.0:
            self.closed = False
            self._enter(Phase.RETREAT)
        elif self._view.opening < _CLOSED and waited > self.habits.delay + self.habits.dwell:
            self._enter(Phase.LIFT)
        return None, True

    def _lift(self) -> tuple[Array | None, bool]:
        if self._lost():
            return None, False
        height = self._carry_height()
        if self._tool[2] > height - 0.012:
            self._enter(Phase.CARRY)
        return np.array([self._tool[0], self._tool[1], height]), False

    def _carry(self) -> tuple[Array | None, bool]:
        if self._lost():
            return None, False
        goal = self._offset() + self._below  # the cube is aimed, not the gripper
        if self._horizontal_distance(goal) < _NEAR and self._elapsed() > 0.3:
            self._enter(Phase.LOWER)
        return np.array([goal[0], goal[1], self._carry_height()]), False

    def _lower(self) -> tuple[Array | None, bool]:
        if self._lost():
            return None, False
        goal = self._offset() + self._below + [0.0, 0.0, SIDE + _RELEASE_ABOVE]
        away = self._horizontal_distance(goal)
        if away < self._tolerance and self._target[2] - self._below[2] - SIDE < 3.0 * _RELEASE_ABOVE:
            self.closed = False
            self._enter(Phase.OPEN)
            return None, True
        if away > 3.0 * _NEAR:
            self._enter(Phase.CARRY)
        return self._descent(goal, away, 1.5 * self.habits.tolerance)

    def _open(self) -> tuple[Array | None, bool]:
        if self._view.opening > _OPENED:
            self._enter(Phase.RETREAT)
        return None, True

    def _retreat(self) -> tuple[Array | None, bool]:
        height = max(self._travel_height(), self._below[2] + 0.5 * SIDE + 0.055)
        if self._tool[2] > height - 0.015:
            self._enter(Phase.CHOOSE)
        # the cube stays centered between the fingers until they are above it
        around = self._tool[2] < self._target[2] + 0.03 and self._horizontal_distance(self._target) < 0.03
        x, y = self._target[:2] if around else self._tool[:2]
        return np.array([x, y, height]), False

    # --- what they share

    def _enter(self, phase: Phase) -> None:
        self.phase, self._phase_start = phase, self._now

    def _elapsed(self) -> float:
        """Return the time since the start of the phase [s]."""
        return self._now - self._phase_start

    def _horizontal_distance(self, goal: Array) -> float:
        return float(np.hypot(*(self._tool - goal)[:2]))

    def _above(self, place: Array, height: float, away: float) -> Array:
        """Return the next goal of a motion that ends above ``place``, at the height ``height`` [m].

        If the gripper is low and far away, the goal is straight above the gripper. Otherwise, the goal is the end of
        the motion.
        """
        if self._tool[2] < height - 0.03 and away > 0.03:
            return np.array([self._tool[0], self._tool[1], height])
        return np.array([place[0], place[1], height])

    def _descent(self, goal: Array, away: float, allowed: float) -> tuple[Array, bool]:
        """Return the next goal of a descent: a point above ``goal``, then ``goal`` itself if the gripper is aligned."""
        high = float(self._tool[2] - goal[2])
        if high > _FAST_ABOVE + 0.02:
            return goal + [0.0, 0.0, _FAST_ABOVE], False
        ahead = _STEP_DOWN if away < allowed else 0.0
        return np.array([goal[0], goal[1], max(float(goal[2]), float(self._tool[2]) - ahead)]), True

    def _offset(self) -> Array:
        """Return the displacement from the center of the held cube to the gripper."""
        return self._tool - self._target

    def _lost(self) -> bool:
        """Return whether the cube is no longer in the gripper; if so, the plan starts again and chooses a cube."""
        lost = float(np.linalg.norm(self._offset())) > _HELD
        if lost:
            self.closed = False
            self._enter(Phase.RETREAT)
        return lost

    def _tower_top(self) -> float:
        return float(self._below[2]) + 0.5 * SIDE

    def _travel_height(self) -> float:
        return max(_LOWEST_TRAVEL, self._tower_top() + 0.02 + _CLEAR) + self.habits.height

    def _carry_height(self) -> float:
        return self._tower_top() + _CLEAR + 0.5 * SIDE + float(self._offset()[2]) + self.habits.height

    def _n_stacked(self) -> int:
        """Return the number of cubes that look stacked; a cube below another cube counts even if badly placed."""
        cubes, n = self._view.cubes, 1
        while n < N_CUBES:
            away, up = _separation(cubes[n], cubes[n - 1])
            buried = n + 1 < N_CUBES and abs(_separation(cubes[n + 1], cubes[n])[1] - SIDE) < 0.008
            if (away > _IN_TOWER and not buried) or abs(up - SIDE) > 0.008:
                break
            n += 1
        return n


def _reachable(cube: Array) -> bool:
    nearest, farthest, aside = _REACHABLE
    return bool(nearest < cube[0] < farthest and abs(cube[1]) < aside and cube[2] > 0.0)


def _separation(upper: Array, lower: Array) -> tuple[float, float]:
    """Return the horizontal and the vertical distance between two cubes [m]."""
    x, y, z = upper - lower
    return math.hypot(x, y), float(z)


@dataclass(frozen=True, eq=False)
class _SubMovement:
    """A minimum-jerk displacement of the hand (Flash and Hogan 1985)."""

    start: float
    duration: float
    displacement: Array

    def at(self, time: float) -> Array:
        u = min(max((time - self.start) / self.duration, 0.0), 1.0)
        return self.displacement * (u * u * u * (10.0 - 15.0 * u + 6.0 * u * u))


class SimulatedOperator:
    r"""A simulated person who stacks cubes with a robot and watches the gripper, not the hand.

    *Hand.* The motion of the hand is a sum of sub-movements, :math:`h(t) = h_0 + \sum_i d_i\,\mu((t-t_i)/T_i)`, with
    the minimum-jerk profile :math:`\mu(u) = 10u^3-15u^4+6u^5` (intermittent control: Milner 1992, Burdet and Milner
    1998). The lengths of the sub-movements vary randomly by 4 %. A sub-movement over the distance :math:`|d|` lasts
    :math:`T = |d|/v + 0.25` s. The speed v is low near a contact. Tremor is added by
    :class:`~imitarm.capture.person.Person`.

    *Eye.* About 7 times per second, the person reacts to an :class:`OperatorView` that is ``delay`` old. The observed
    positions have a bias, and noise of about a millimetre. Since the time of the view, the hand has moved. The person
    therefore expects the gripper at :math:`\hat p = p(t-\delta) + \rho\,(h_{end} - h(t-\delta-\lambda))`. In this
    equation, p is the observed position, :math:`\delta` is ``delay``, and :math:`h_{end}` is the hand's position after
    all sub-movements that have begun. The person expects the scale :math:`\rho` and the lag :math:`\lambda` between
    hand and gripper. The next sub-movement of the hand is :math:`d = g\,(p_{goal}-\hat p)/\rho`. If the hand must move
    farther than 3 cm and no contact is near, the gain g is 1. Otherwise, g is 0.45 to 0.7, so the hand covers only a
    part of the distance.

    *Plan.* :class:`StackPlan` chooses the goals. The hand closes or opens when the error of the gripper appears to be
    within the person's tolerance. The tolerance grows with the time that the person needs for the current phase. If the
    gripper misses or loses a cube, or a cube falls, the person fetches the cube again.


    Args:
        seed: seed of the person and the habits.
        repeat: number of the run; it makes the runs of one person differ from each other.
        scale: ratio of robot motion to hand motion that the person expects.

    Attributes:
        person: model of the person's body and arm motion.
        habits: habits of this person.
        plan: plan of this person's next actions.
    """

    def __init__(self, seed: int, repeat: int = 0, *, scale: float = 1.0) -> None:
        self.person, self.habits = Person.from_seed(seed), Habits.from_seed(seed)
        self.plan = StackPlan(self.habits)
        self._rng = np.random.default_rng([30314, seed, repeat])
        self._scale, self._to_sensor = scale, FACING.rotation.T
        reach, shoulder = self.person.reach, self.person.shoulder()
        self._home = shoulder + np.array([0.02, -0.16 * reach, -0.60 * reach]) + self._rng.normal(0.0, 0.01, 3)
        self._swivel = self.person.swivel + float(self._rng.normal(0.0, 0.03))
        self._views: deque[OperatorView] = deque()
        self._completed = np.zeros(3)  # displacement by sub-movements that ended long ago
        self._sub_movements: list[_SubMovement] = []
        self._next_look, self._aimed_until = self.habits.begin, 0.0

    @property
    def finished(self) -> bool:
        """Whether all cubes are stacked, or the person has given up."""
        return self.plan.finished

    def see(self, view: OperatorView) -> None:
        """Show the current view to the person, who reacts to it after ``delay``."""
        self._views.append(view)

    def hand_displacement(self, time: float) -> Array:
        """Return the displacement of the hand since the start, in the robot's axes, shape (3,) [m]."""
        displacement = self._completed.copy()
        for movement in self._sub_movements:
            displacement += movement.at(time)
        return displacement

    def act(self, time: float) -> Skeleton:
        """Return the true skeleton of the person at ``time`` [s], in the sensor's frame.

        Times must not decrease from call to call.
        """
        while self._next_look <= time:
            self._look(self._next_look)
            self._next_look += self.habits.look_every * float(self._rng.uniform(0.8, 1.2))
        wrist = self._home + self._to_sensor @ self.hand_displacement(time)
        return self.person.skeleton(time, wrist, swivel=self._swivel, closed=self.plan.closed)

    def _look(self, now: float) -> None:
        """React to the view that is ``delay`` old."""
        seen = None
        while self._views and self._views[0].time <= now - self.habits.delay + 1e-9:
            seen = self._views.popleft()
        if seen is None or self.finished:
            return
        noise = self._rng.normal(0.0, self.habits.noise, (1 + N_CUBES, 3))
        view = OperatorView(seen.time, seen.tool + self.habits.bias + noise[0], seen.opening, seen.cubes + noise[1:])
        phase = self.plan.phase
        goal, fine = self.plan.step(view, now)
        if self.plan.phase is not phase:
            self._aimed_until = now
        if goal is not None and seen.following:
            self._start_sub_movement(now, view, goal, fine)

    def _start_sub_movement(self, now: float, view: OperatorView, goal: Array, fine: bool) -> None:
        habits = self.habits
        end = self.hand_displacement(math.inf)
        expected = view.tool + self._scale * (end - self.hand_displacement(view.time - habits.sense_of_lag))
        displacement = (goal - expected) / self._scale
        length = float(np.linalg.norm(displacement))
        gain = 1.0 if length > _LONG and not fine else habits.gain
        if length * gain < _AT_REST or now < self._aimed_until:
            return
        displacement = displacement * gain * (1.0 + _SCATTER * self._rng.normal(size=3))
        duration = gain * length / (habits.fine_speed if fine else habits.speed) + 0.25
        self._sub_movements.append(_SubMovement(now, duration, displacement))
        if gain == 1.0:
            self._aimed_until = now + duration
        for movement in [m for m in self._sub_movements if m.start + m.duration < now - _MEMORY]:
            self._completed += movement.displacement
            self._sub_movements.remove(movement)
