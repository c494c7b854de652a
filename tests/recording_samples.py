"""Skeletons for the tests of recordings: a person who stands still but for the arms, and ways to spoil that."""

from __future__ import annotations

import numpy as np

from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINTS, SIDES, HandState, Skeleton, SkeletonSource


def skeletons(n=90, *, seed=3, rate=30.0, start=0.0, person=0, away=0.0):
    """The true motion of a synthetic person who reaches about; ``away`` moves the person aside [m]."""
    truth = reaching(Person.from_seed(seed), seed)
    frames = [truth(2.0 + i / rate) for i in range(n)]
    return [
        Skeleton(start + i / rate, one.positions + [away, 0.0, 0.0], one.tracking, one.hand_states, person)
        for i, one in enumerate(frames)
    ]


def exchanged(skeleton, parts=None):
    """The skeleton with left and right taken for each other, of the whole body or of some parts."""
    order = np.arange(len(JOINTS))
    for i, name in enumerate(JOINTS):
        part, _, side = name.rpartition("_")
        if side in SIDES and (parts is None or part in parts):
            order[i] = JOINTS.index(f"{part}_{'left' if side == 'right' else 'right'}")
    left, right = skeleton.hand_states
    states = (right, left) if parts is None or "hand" in parts else (left, right)
    return Skeleton(skeleton.time, skeleton.positions[order], skeleton.tracking[order], states, skeleton.person)


def changed(skeleton, **values):
    """The skeleton with other fields."""
    fields = {
        "time": skeleton.time,
        "positions": skeleton.positions,
        "tracking": skeleton.tracking,
        "hand_states": skeleton.hand_states,
        "person": skeleton.person,
    }
    return Skeleton(**(fields | values))


def same(a, b):
    """Whether two skeletons are equal to the last bit."""
    return (
        a.time == b.time
        and np.array_equal(a.positions, b.positions, equal_nan=True)
        and np.array_equal(a.tracking, b.tracking)
        and a.hand_states == b.hand_states
        and a.person == b.person
    )


class Listed(SkeletonSource):
    """A source that gives what is in a list; None: nothing came in time."""

    name = "a list"

    def __init__(self, items):
        self.items = list(items)
        self.closed = False

    @property
    def over(self):
        return not self.items

    def read(self, timeout=1.0):
        return self.items.pop(0) if self.items else None

    def close(self):
        self.closed = True


CLOSED = (HandState.OPEN, HandState.CLOSED)
