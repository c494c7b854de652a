from __future__ import annotations

import inspect

import numpy as np
import pytest

from imitarm.capture.skeleton import JOINT, HandState
from imitarm.retarget.correspondence import FACING
from imitarm.tasks.stack import SIDE, StackTask
from imitarm.tasks.stacking_operator import Habits, OperatorView, Phase, SimulatedOperator

CUBES = np.column_stack([StackTask(0).places()[0], np.full(4, 0.5 * SIDE)])
START = StackTask.start.position
RATE = 100.0


class Toy:
    """A gripper that follows the hand a little late, in a world without weight: what is held moves along."""

    def __init__(self, operator, lag=0.15, wind=None):
        self.operator, self.lag = operator, lag
        self.tool, self.cubes, self.opening = START.copy(), CUBES.copy(), 0.08
        self.held, self.wind = None, wind
        self.truths = []

    def step(self, k):
        time = k / RATE
        self.operator.see(OperatorView(time, self.tool.copy(), self.opening, self.cubes.copy()))
        truth = self.operator.act(time)
        self.truths.append(truth)
        hand = FACING.rotation @ truth.joint("wrist_right")
        if k == 0:
            self.first = hand
        wanted = START + hand - self.first
        before, self.tool = self.tool, self.tool + (wanted - self.tool) * (1.0 / (1.0 + self.lag * RATE))
        if self.wind is not None:
            self.tool = self.tool + self.wind(time)
        goal = 0.0 if truth.hand_states[1] == HandState.CLOSED else 0.08
        near = np.linalg.norm(self.cubes - self.tool, axis=1) < 0.015
        if goal == 0.0 and self.held is None and near.any() and self.opening < 0.035:
            self.held = int(np.argmax(near))
        if goal > 0.0 and self.held is not None:
            self.cubes[self.held, 2] = self.support(self.held)
            self.held = None
        if self.held is not None:
            self.cubes[self.held] += self.tool - before
        least = 0.031 if self.held is not None else 0.0
        self.opening = float(np.clip(goal, max(self.opening - 0.0012, least), self.opening + 0.0012))

    def support(self, i):
        below = [c[2] + 0.5 * SIDE for j, c in enumerate(self.cubes) if j != i and self.under(c, i)]
        return max(below, default=0.0) + 0.5 * SIDE

    def under(self, cube, i):
        return np.hypot(*(cube - self.cubes[i])[:2]) < 0.7 * SIDE and cube[2] < self.cubes[i, 2] - 0.5 * SIDE

    def run(self, seconds):
        for k in range(round(seconds * RATE)):
            if self.operator.finished:
                return k / RATE
            self.step(k)
        return seconds


def wrists(truths):
    return np.array([truth.joint("wrist_right") for truth in truths])


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_people_stack_with_a_gripper_that_obeys(seed):
    toy = Toy(SimulatedOperator(seed))
    seconds = toy.run(90.0)
    assert toy.operator.finished
    assert seconds < 80.0
    apart = np.diff(toy.cubes, axis=0)
    assert np.hypot(*apart[:, :2].T).max() < 0.014
    np.testing.assert_allclose(apart[:, 2], SIDE, atol=1e-9)


def test_the_same_seeds_give_the_same_person_and_others_give_others():
    def motion(seed, repeat):
        toy = Toy(SimulatedOperator(seed, repeat))
        toy.run(6.0)
        return wrists(toy.truths)

    first = motion(3, 0)
    np.testing.assert_array_equal(first, motion(3, 0))
    assert np.abs(first - motion(3, 1)).max() > 1e-3
    assert np.abs(first - motion(4, 0)).max() > 1e-2


def test_an_answer_depends_only_on_what_was_seen_a_reaction_time_ago():
    """Two worlds that part at 4 s: until a reaction time later nobody can tell them apart by the hand."""
    parted = 4.0
    calm, windy = Toy(SimulatedOperator(5)), Toy(SimulatedOperator(5))
    windy.wind = lambda time: np.array([0.0, 0.004, 0.0]) if time >= parted else np.zeros(3)
    calm.run(7.0)
    windy.run(7.0)
    away = np.linalg.norm(wrists(calm.truths) - wrists(windy.truths), axis=1)
    seen = parted + 1.0 / RATE  # the wind of a step is seen in the next
    parts = np.flatnonzero(away > 0.0)[0] / RATE
    assert parts >= seen + calm.operator.habits.delay - 1e-9
    assert parts < seen + calm.operator.habits.delay + 3.0 * calm.operator.habits.look_every
    assert away.max() > 0.01  # and then the difference is large


def test_the_hand_is_still_at_first_so_that_a_robot_can_take_hold():
    operator = SimulatedOperator(6)
    toy = Toy(operator)
    toy.run(operator.habits.begin)
    assert np.linalg.norm(wrists(toy.truths) - wrists(toy.truths)[0], axis=1).max() < 0.005  # tremor alone
    assert operator.plan.phase is Phase.CHOOSE


def test_nobody_moves_a_robot_that_shows_it_does_not_follow():
    operator = SimulatedOperator(7)
    for k in range(600):
        operator.see(OperatorView(k / RATE, START, 0.08, CUBES, following=False))
        operator.act(k / RATE)
    np.testing.assert_array_equal(operator.hand_displacement(6.0), np.zeros(3))


def test_the_hand_moves_smoothly_and_within_reach():
    toy = Toy(SimulatedOperator(2))
    toy.run(40.0)
    way = np.array([t.joint("wrist_right") - t.joint("shoulder_right") for t in toy.truths])
    assert np.linalg.norm(way, axis=1).max() < 0.97 * toy.operator.person.reach  # no one needs to take hold anew
    speed = np.linalg.norm(np.diff(wrists(toy.truths), axis=0), axis=1) * RATE
    assert 0.2 < speed.max() < 1.5


def test_a_missed_cube_is_fetched_again():
    operator = SimulatedOperator(1)
    toy = Toy(operator)
    missed = []

    def wind(time):  # the first cube slips out of the closing fingers
        if operator.plan.phase is Phase.CLOSE and not missed:
            missed.append(time)
            toy.cubes[1] += [0.0, 0.03, 0.0]
        return np.zeros(3)

    toy.wind = wind
    toy.run(90.0)
    assert missed
    assert operator.finished
    assert toy.cubes[3, 2] == pytest.approx(3.5 * SIDE, abs=1e-6)


def test_who_cannot_reach_a_cube_gives_up():
    operator = SimulatedOperator(1)
    toy = Toy(operator)
    toy.cubes[1] = [0.6, 0.1, -0.7]
    assert toy.run(10.0) < 5.0
    assert operator.finished


def test_the_gripper_is_looked_at_and_not_the_hand():
    """A gripper that goes only half of the way is brought to the cube nevertheless."""
    operator = SimulatedOperator(4)
    toy = Toy(operator)
    push = -0.03 / RATE
    toy.wind = lambda time: np.array([0.0, push, 0.0]) if 1.0 < time < 6.0 else np.zeros(3)
    toy.run(90.0)
    assert operator.finished
    assert toy.cubes[3, 2] == pytest.approx(3.5 * SIDE, abs=1e-6)


def test_an_operator_is_not_told_which_method_is_driven():
    assert set(inspect.signature(SimulatedOperator.__init__).parameters) == {"self", "seed", "repeat", "scale"}
    assert set(OperatorView.__dataclass_fields__) == {"time", "tool", "opening", "cubes", "following"}


def test_habits_are_those_of_people():
    habits = [Habits.from_seed(seed) for seed in range(40)]
    assert all(0.15 <= h.delay <= 0.3 and 0.0 < h.gain < 1.0 for h in habits)
    assert len({h.speed for h in habits}) == 40
    assert all(np.linalg.norm(h.bias) < 0.006 for h in habits)


def test_fist_and_open_hand_are_shown():
    toy = Toy(SimulatedOperator(0))
    toy.run(20.0)
    states = {truth.hand_states[1] for truth in toy.truths}
    assert states == {HandState.OPEN, HandState.CLOSED}
    assert all(np.isfinite(truth.positions[JOINT["thumb_right"]]).all() for truth in toy.truths)
