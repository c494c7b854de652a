"""What ``make bench`` times of retargeting: from a skeleton to a joint command."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

from imitarm.capture.person import Person
from imitarm.capture.synthetic import SyntheticSource
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter
from imitarm.retarget.retargeter import ticks
from timing import Row, seconds_of
from yardsticks import DT, mink_step, named

_TICKS = 20  # timed ticks in each of our measurements, and calls of the yardstick in each of its own


def skeleton_to_command() -> Row:
    """One control tick of the modern method with a new skeleton; ticks without one are not timed.

    A simulated person reaches about before a camera of 30 frames per second, as in use: a robot that is commanded more
    than it can do takes longer.
    """
    arm, person = ArmModel.load("sawyer", tool="gripper"), Person.from_seed(0)
    lengths = LimbLengths(person.upper_arm, person.forearm)
    retargeter = ModernRetargeter(arm, Correspondence(lengths=lengths, orientation="upright"), dt=DT)
    frames = list(ticks(list(SyntheticSource.from_seed(0, duration=30.0)), DT))
    states: list[str] = []
    endless = cycle(frames)
    steps = 0

    def tick() -> float:
        """Go on to the next tick with a skeleton while following, and return how long it took [s]."""
        nonlocal steps
        while True:
            if steps % len(frames) == 0:  # the recording begins again
                retargeter.start(arm.home)
            steps += 1
            skeleton, q = next(endless), retargeter.latest.q
            seconds = seconds_of(lambda skeleton=skeleton, q=q: retargeter.step(skeleton, q), 1)
            if skeleton is not None:
                states.append(retargeter.latest.state)
                if states[-1] == "following":
                    return seconds

    def check() -> tuple[bool, str]:
        for _ in range(100):
            tick()
        fraction = states.count("following") / len(states)
        return fraction > 0.5, f"{len(states)} frames, followed in {100 * fraction:.0f} % of them"

    yardstick = mink_step()
    return Row(
        "skeleton to joint command, modern",
        lambda: sum(tick() for _ in range(_TICKS)) / _TICKS,
        lambda: seconds_of(yardstick, _TICKS),
        f"{named('mink')}, step",
        cost=2.0,
        check=check,
        repeats=41,
        self_timed=True,
    )


ROWS: tuple[Callable[[], Row], ...] = (skeleton_to_command,)
