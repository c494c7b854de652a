"""What ``make bench`` times of retargeting: from a skeleton to a joint command."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import cycle

from imitarm.benchmark.timing import Row
from imitarm.capture.person import Person
from imitarm.capture.synthetic import SyntheticSource
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter
from imitarm.retarget.retargeter import ticks

DT = 0.01  # [s] control period
_REPEATS = 401


def skeleton_to_command() -> Row:
    """One control step of the modern method that has a new skeleton; those between, which have none, are not timed.

    A made-up person reaches about before a camera of 30 frames a second, as in use: a robot that is asked for more
    than it can do takes longer.
    """
    arm, person = ArmModel.load("sawyer", tool="gripper"), Person.from_seed(0)
    lengths = LimbLengths(person.upper_arm, person.forearm)
    retargeter = ModernRetargeter(arm, Correspondence(lengths=lengths, orientation="upright"), dt=DT)
    frames = list(ticks(list(SyntheticSource.from_seed(0, duration=30.0)), DT))
    states: list[str] = []
    turns = cycle(frames)
    steps = 0

    def step() -> float:
        """Go on to the next step with a skeleton and return how long it took [s]."""
        nonlocal steps
        while True:
            if steps % len(frames) == 0:  # from the beginning: the person takes hold anew
                retargeter.start(arm.home)
            steps += 1
            skeleton, q = next(turns), retargeter.latest.q
            begin = time.perf_counter()
            retargeter.step(skeleton, q)
            seconds = time.perf_counter() - begin
            if skeleton is not None:
                states.append(retargeter.latest.state)
                if states[-1] == "following":
                    return seconds

    def check() -> tuple[bool, str]:
        for _ in range(100):
            step()
        share = states.count("following") / len(states)
        return share > 0.5, f"{len(states)} frames, {100 * share:.0f} % of them followed"

    name = "skeleton to joint command, modern"
    return Row(name, step, most_seconds=200e-6, check=check, repeats=_REPEATS, self_timed=True)


ROWS: tuple[Callable[[], Row], ...] = (skeleton_to_command,)
"""All rows of retargeting."""
