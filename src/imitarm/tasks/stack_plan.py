"""StackPlan: what a person who stacks cubes is about, and when it is time for the next thing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from imitarm.tasks.stack import N_CUBES, SIDE

if TYPE_CHECKING:
    from imitarm.tasks.operator import Operator, Sight

Array = NDArray[np.float64]

_HELD = 0.05  # [m] a cube farther than this from the gripper is not in it
_MISSED = 0.026  # [m] fingers that closed farther than this hold nothing
_CLOSED, _OPENED = 0.036, 0.045  # [m] fingers that look closed on a cube, and open again
_GRIP_ABOVE = 0.005  # [m] above a cube's middle it is gripped: the finger tips stay off the table
_CLEAR = 0.03  # [m] what is carried keeps this much above what it passes over
_LOWEST_TRAVEL = 0.085  # [m] height of the empty gripper on its way
_LET_GO = 0.0015  # [m] so far above the tower a cube is meant to be let go, so as not to press on it
_NEAR = 0.012  # [m] across, that is near enough to begin to go down
_BRISK = 0.035  # [m] down to so far above where care is needed, a person goes briskly
_STEP_DOWN = 0.025  # [m] how far ahead a person who lowers something with care looks
_IN_TOWER = 0.013  # [m] across, from the cube below: looks right
_GIVES_UP = (0.35, 0.85, 0.40)  # [m] nearest x, farthest x, farthest y at which a fallen cube is fetched


class StackPlan:
    """What an operator does about what is seen: one method for each phase.

    Each returns the goal of the gripper, shape (3,) [m], or None to keep still, and whether care is needed.
    """

    def __init__(self, operator: Operator, view: Sight, now: float) -> None:
        """Take in what is seen.

        Args:
            operator: whose plan it is; its ``phase``, ``number``, ``closed`` and ``finished`` are kept here.
            view: what is seen, late and with noise.
            now: when the answer begins [s].
        """
        self.operator, self.view, self.now = operator, view, now
        self.habits = operator.habits
        self.tool, self.cube, self.below = view.tool, view.cubes[operator.number], view.cubes[operator.number - 1]
        patience = max(operator.in_phase(now) - 2.0, 0.0)
        self.tolerance = self.habits.tolerance * (1.0 + 0.12 * min(patience, 5.0))

    def next(self) -> tuple[Array | None, bool]:
        """Return the goal (3,) of the gripper or None to keep still, and whether care is needed."""
        return _PHASES[self.operator.phase](self)

    def begin(self) -> tuple[Array | None, bool]:
        """Choose the cube to fetch: the lowest number that is not in the tower."""
        n = self._in_tower()
        if n == N_CUBES or not self._in_reach(self.view.cubes[max(n, 1)]):
            self.operator.finished = True
            return None, False
        self.operator.number = max(n, 1)
        self._turn_to("reach")
        return None, False

    def reach(self) -> tuple[Array | None, bool]:
        """Go above the cube."""
        away = self._across(self.cube)
        if away < _NEAR and self.operator.in_phase(self.now) > 0.3:
            self._turn_to("down")
        return self._over(self.cube, self._travel_height(), away), False

    def down(self) -> tuple[Array | None, bool]:
        """Lower the gripper around the cube; close the hand when it looks right."""
        goal = self.cube + [0.0, 0.0, _GRIP_ABOVE]
        away, high = self._across(goal), self.tool[2] - goal[2]
        if away < self.tolerance and abs(high) < max(self.tolerance, 0.006):
            self.operator.closed = True
            self._turn_to("close")
            return None, True
        if away > 3.0 * _NEAR:
            self._turn_to("reach")
        return self._lowered(goal, away, 2.0 * self.habits.tolerance)

    def close(self) -> tuple[Array | None, bool]:
        """Wait until the fingers look closed."""
        waited = self.operator.in_phase(self.now)
        if self.view.opening < _MISSED or waited > 3.0:
            self.operator.closed = False
            self._turn_to("leave")
        elif self.view.opening < _CLOSED and waited > self.habits.delay + self.habits.dwell:
            self._turn_to("lift")
        return None, True

    def lift(self) -> tuple[Array | None, bool]:
        """Raise the cube, then carry it."""
        if self._lost():
            return None, False
        height = self._carry_height()
        if self.tool[2] > height - 0.012:
            self._turn_to("carry")
        return np.array([self.tool[0], self.tool[1], height]), False

    def carry(self) -> tuple[Array | None, bool]:
        """Go above the tower; the cube is aimed, not the gripper."""
        if self._lost():
            return None, False
        goal = self._offset() + self.below
        away = self._across(goal)
        if away < _NEAR and self.operator.in_phase(self.now) > 0.3:
            self._turn_to("lower")
        return np.array([goal[0], goal[1], self._carry_height()]), False

    def lower(self) -> tuple[Array | None, bool]:
        """Lower the cube; open the hand when it is seen to stand where it should."""
        if self._lost():
            return None, False
        goal = self._offset() + self.below + [0.0, 0.0, SIDE + _LET_GO]
        away = self._across(goal)
        if away < self.tolerance and self.cube[2] - self.below[2] - SIDE < 3.0 * _LET_GO:
            self.operator.closed = False
            self._turn_to("open")
            return None, True
        if away > 3.0 * _NEAR:
            self._turn_to("carry")
        return self._lowered(goal, away, 1.5 * self.habits.tolerance)

    def open(self) -> tuple[Array | None, bool]:
        """Wait until the fingers are seen to have let go."""
        if self.view.opening > _OPENED:
            self._turn_to("leave")
        return None, True

    def leave(self) -> tuple[Array | None, bool]:
        """Go up, the cube in the middle between the fingers until they are above it; then see what is next."""
        height = max(self._travel_height(), self.below[2] + 0.5 * SIDE + 0.055)
        if self.tool[2] > height - 0.015:
            self._turn_to("begin")
        around = self.tool[2] < self.cube[2] + 0.03 and self._across(self.cube) < 0.03
        x, y = self.cube[:2] if around else self.tool[:2]
        return np.array([x, y, height]), False

    def _turn_to(self, phase: str) -> None:
        self.operator.go_on(phase, self.now)

    def _across(self, goal: Array) -> float:
        return float(np.hypot(*(self.tool - goal)[:2]))

    def _over(self, place: Array, height: float, away: float) -> Array:
        """Return the goal above ``place``: up first, when the gripper is low and it is far."""
        if self.tool[2] < height - 0.03 and away > 0.03:
            return np.array([self.tool[0], self.tool[1], height])
        return np.array([place[0], place[1], height])

    def _lowered(self, goal: Array, away: float, allowed: float) -> tuple[Array, bool]:
        """Return the way down: briskly to a little above ``goal``, then with care while it looks well aligned."""
        high = float(self.tool[2] - goal[2])
        if high > _BRISK + 0.02:
            return goal + [0.0, 0.0, _BRISK], False
        ahead = _STEP_DOWN if away < allowed else 0.0
        return np.array([goal[0], goal[1], max(float(goal[2]), float(self.tool[2]) - ahead)]), True

    def _offset(self) -> Array:
        """Return from the middle of the cube in the gripper to the gripper."""
        return self.tool - self.cube

    def _lost(self) -> bool:
        """Begin anew when the cube is not in the gripper any more."""
        lost = float(np.linalg.norm(self._offset())) > _HELD
        if lost:
            self.operator.closed = False
            self._turn_to("leave")
        return lost

    def _tower_top(self) -> float:
        return float(self.below[2]) + 0.5 * SIDE

    def _travel_height(self) -> float:
        return max(_LOWEST_TRAVEL, self._tower_top() + 0.02 + _CLEAR) + self.habits.height

    def _carry_height(self) -> float:
        return self._tower_top() + _CLEAR + 0.5 * SIDE + float(self._offset()[2]) + self.habits.height

    def _in_tower(self) -> int:
        """Return how many cubes look right; one that has another on it is left as it is."""
        cubes, n = self.view.cubes, 1
        while n < N_CUBES:
            away, up = _apart(cubes[n], cubes[n - 1])
            buried = n + 1 < N_CUBES and abs(_apart(cubes[n + 1], cubes[n])[1] - SIDE) < 0.008
            if (away > _IN_TOWER and not buried) or abs(up - SIDE) > 0.008:
                break
            n += 1
        return n

    @staticmethod
    def _in_reach(cube: Array) -> bool:
        nearest, farthest, aside = _GIVES_UP
        return bool(nearest < cube[0] < farthest and abs(cube[1]) < aside and cube[2] > 0.0)


def _apart(upper: Array, lower: Array) -> tuple[float, float]:
    """Return how far two cubes are apart across and in height [m]."""
    x, y, z = upper - lower
    return math.hypot(x, y), float(z)


_PHASES = {
    "begin": StackPlan.begin,
    "reach": StackPlan.reach,
    "down": StackPlan.down,
    "close": StackPlan.close,
    "lift": StackPlan.lift,
    "carry": StackPlan.carry,
    "lower": StackPlan.lower,
    "open": StackPlan.open,
    "leave": StackPlan.leave,
}
