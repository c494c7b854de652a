"""What ``make bench`` times of retargeting: from a skeleton to a joint command."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.timing import Row
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.capture.synthetic import SyntheticSource
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import Correspondence, LimbLengths, ModernRetargeter

Array = NDArray[np.float64]


def skeleton_to_command() -> Row:
    """One step of the modern method with a new skeleton, while it follows."""
    arm, person = ArmModel.load("sawyer", tool="gripper"), Person.from_seed(0)
    lengths = LimbLengths(person.upper_arm, person.forearm)
    frames = list(SyntheticSource.from_seed(0, duration=12.0))
    retargeter = ModernRetargeter(arm, Correspondence(lengths=lengths, orientation="upright"))
    retargeter.run(frames)
    last, turns, reached = frames[-1].time, cycle(frames), [retargeter.command.q]
    count = 0

    def step() -> Array:
        nonlocal count
        count += 1
        frame = next(turns)  # the same people again, at times that go on
        skeleton = Skeleton(last + count / 30, frame.positions, frame.tracking, frame.hand_states)
        reached[0] = retargeter.step(skeleton, reached[0])
        return reached[0]

    def check() -> tuple[bool, str]:
        states = []
        for _ in range(100):
            step()
            states.append(retargeter.command.state)
        share = states.count("following") / len(states)
        return share > 0.5, f"following in {100 * share:.0f} % of the steps"

    return Row("skeleton to joint command, modern", step, most_seconds=200e-6, check=check, repeats=101)


ROWS: tuple[Callable[[], Row], ...] = (skeleton_to_command,)
"""All rows of retargeting."""
