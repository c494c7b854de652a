r"""Operator: a made-up person who looks at the gripper and the cubes and moves a hand until they are where they belong.

The model is of the closed loop, not of one method: it is given what a person sees, late and not exactly, and answers
with a motion of the hand. It never learns what is between the hand and the gripper.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.retarget.correspondence import FACING
from imitarm.tasks.stack import N_CUBES
from imitarm.tasks.stack_plan import StackPlan

Array = NDArray[np.float64]

_AT_REST = 1e-3  # [m] corrections smaller than this are not made
_FAR = 0.03  # [m] a longer sub-movement is aimed once, a shorter one is a cautious part of what is missing
_SCATTER = 0.04  # standard deviation of a sub-movement over its length (signal-dependent noise)
_LONGEST_MEMORY = 3.0  # [s]


@dataclass(frozen=True, eq=False)
class Sight:
    """What there is to see at one instant, in the robot's base frame.

    Attributes:
        time: [s].
        tool: where the middle between the finger tips is, shape (3,) [m].
        opening: between the fingers [m].
        cubes: their middles, shape (4, 3) [m].
        lamp: whether the robot shows that it follows.
    """

    time: float
    tool: Array
    opening: float
    cubes: Array
    lamp: bool = True


@dataclass(frozen=True)
class Habits:
    """What makes people differ at this task.

    Attributes:
        delay: from seeing to the beginning of a movement that answers it [s]; about 0.2 s for a visual correction.
        look_every: time between two looks that may lead to a correction [s].
        gain: share of the seen error that a small correction makes up for, below 1.
        noise: standard deviation of what is seen on each axis, anew at each look [m].
        bias: of where this person sees the gripper, shape (3,) as a tuple [m].
        speed: of the hand on long ways, mean [m/s].
        fine_speed: near a contact, mean [m/s].
        tolerance: how exactly the gripper must look right before the hand closes or opens [m].
        sense_of_lag: how late the person has learnt the robot to be [s]; the same whatever the method is.
        dwell: rest after closing and opening the hand [s].
        height: extra height on long ways [m].
        begin: how long the hand is held still at first, so that the robot takes hold [s].
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
        """Make up the habits of person number ``seed``."""
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


@dataclass(frozen=True, eq=False)
class _Pulse:
    """A sub-movement: a minimum-jerk displacement (Flash and Hogan 1985)."""

    start: float
    duration: float
    way: Array

    def at(self, time: float) -> Array:
        u = min(max((time - self.start) / self.duration, 0.0), 1.0)
        return self.way * (u * u * u * (10.0 - 15.0 * u + 6.0 * u * u))


class Operator:
    r"""A person who stacks cubes with a robot, looking at the gripper and not at the own hand.

    *Hand.* Its motion is a sum of sub-movements, :math:`h(t) = h_0 + \sum_i d_i\,\mu((t-t_i)/T_i)` with the
    minimum-jerk course :math:`\mu(u) = 10u^3-15u^4+6u^5` (intermittent control: Milner 1992, Burdet and Milner 1998).
    Lengths scatter by 4 %. :math:`T = |d|/v + 0.25` s, with a small v near a contact. The tremor is the
    person's own (:class:`~imitarm.capture.person.Person`).

    *Eye.* At each look, about 7 a second, the person acts on the :class:`Sight` of ``delay`` ago, with noise of about a
    millimetre and a bias. What is expected of the gripper is what was seen of it, and what the hand has been
    told since and a little before: :math:`\hat p = p(t-\delta) + \rho\,(h_{end} - h(t-\delta-\lambda))`, with
    :math:`\lambda` the lag to which the person is used. The next sub-movement is
    :math:`d = g\,(p_{goal}-\hat p)/\rho`, g below 1 for what is short and 1 for long ways.

    *Plan.* For each cube: across above it, down while it looks well aligned, close the hand, up, across above
    the tower, down until it is seen to stand, open the hand, up. The hand closes or opens when the gripper looks
    right to within the person's tolerance, which grows with impatience. A cube that was missed, lost or
    fell down is fetched again.

    The answer at a time depends only on what was there to see ``delay`` before it.

    Attributes:
        person: whose arm it is.
        habits: how this person works.
        phase: what the person is about.
        number: which cube, from 0.
        finished: the person has stacked all cubes, or given up.
        closed: whether the hand is a fist.
    """

    def __init__(self, seed: int, repeat: int = 0, *, scale: float = 1.0) -> None:
        """Make up an operator.

        Args:
            seed: of the person and of the habits.
            repeat: which trial of this person: seeds what differs between trials.
            scale: robot's motion over the hand's, to which the person is used.
        """
        self.person, self.habits = Person.from_seed(seed), Habits.from_seed(seed)
        self._rng = np.random.default_rng([30314, seed, repeat])
        self._scale, self._to_sensor = scale, FACING.rotation.T
        reach, shoulder = self.person.reach, self.person.shoulder()
        self._home = shoulder + np.array([0.02, -0.16 * reach, -0.60 * reach]) + self._rng.normal(0.0, 0.01, 3)
        self._swivel = self.person.swivel + float(self._rng.normal(0.0, 0.03))
        self._seen: deque[Sight] = deque()
        self._settled = np.zeros(3)  # displacement of the hand by sub-movements that are forgotten
        self._pulses: list[_Pulse] = []
        self._next_look, self._aimed_until = self.habits.begin, 0.0
        self.phase, self.number, self._since = "begin", 1, 0.0
        self.closed = self.finished = False
        self._last = -math.inf

    def see(self, sight: Sight) -> None:
        """Show what there is to see now; it reaches the person ``delay`` later."""
        self._seen.append(sight)

    def hand(self, time: float) -> Array:
        """Return the displacement of the hand since the beginning in the robot's axes, shape (3,) [m]."""
        way = self._settled.copy()
        for pulse in self._pulses:
            way += pulse.at(time)
        return way

    def act(self, time: float) -> Skeleton:
        """Return where every joint of the person truly is at ``time`` [s], in the sensor's frame.

        Times must not go back.
        """
        while self._next_look <= time:
            self._look(self._next_look)
            self._next_look += self.habits.look_every * float(self._rng.uniform(0.8, 1.2))
        wrist = self._home + self._to_sensor @ self.hand(time)
        return self.person.skeleton(time, wrist, swivel=self._swivel, closed=self.closed)

    def _look(self, now: float) -> None:
        """Decide on what was there to see ``delay`` ago."""
        seen = None
        while self._seen and self._seen[0].time <= now - self.habits.delay + 1e-9:
            seen = self._seen.popleft()
        if seen is None or self.finished:
            return
        noise = self._rng.normal(0.0, self.habits.noise, (1 + N_CUBES, 3))
        view = Sight(seen.time, seen.tool + self.habits.bias + noise[0], seen.opening, seen.cubes + noise[1:])
        goal, fine = StackPlan(self, view, now).next()
        if goal is not None and seen.lamp:
            self._move(now, view, goal, fine)

    def _move(self, now: float, view: Sight, goal: Array, fine: bool) -> None:
        """Begin a sub-movement towards ``goal``."""
        habits = self.habits
        end = self.hand(math.inf)
        expected = view.tool + self._scale * (end - self.hand(view.time - habits.sense_of_lag))
        way = (goal - expected) / self._scale
        length = float(np.linalg.norm(way))
        share = 1.0 if length > _FAR and not fine else habits.gain
        if length * share < _AT_REST or now < self._aimed_until:
            return
        way = way * share * (1.0 + _SCATTER * self._rng.normal(size=3))
        duration = share * length / (habits.fine_speed if fine else habits.speed) + 0.25
        self._pulses.append(_Pulse(now, duration, way))
        if share == 1.0:
            self._aimed_until = now + duration
        for pulse in [p for p in self._pulses if p.start + p.duration < now - _LONGEST_MEMORY]:
            self._settled += pulse.way
            self._pulses.remove(pulse)

    def go_on(self, phase: str, now: float) -> None:
        """Turn to the next part of the plan."""
        self.phase, self._since, self._aimed_until = phase, now, now

    def in_phase(self, now: float) -> float:
        """Return for how long the person has been about the same [s]."""
        return now - self._since
