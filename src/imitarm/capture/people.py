"""PersonFilter: follows one person of all whom a source sees; a newcomer never takes over."""

from __future__ import annotations

import math
import time as clock

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, Skeleton, SkeletonSource
from imitarm.errors import InputError

Array = NDArray[np.float64]

PATIENCE = 2.0  # [s] so long the one who is followed may be out of sight
_FASTEST = 2.5  # [m/s] of a torso; what goes faster is another person under the same number
_SLACK = 0.3  # [m] and may jump so far by error
_TORSO = np.array([JOINT[name] for name in ("spine_shoulder", "spine_mid", "neck")])


class PersonFilter(SkeletonSource):
    """One person of all whom a source sees.

    The first who is seen is followed, and stays the one until gone for more than ``patience`` on the source's clock;
    everybody else is passed over. Only then may another one be followed: with a gap so long every retargeter has
    stopped, and begins anew. A source that sees one person only may give the next one the same number; whoever appears
    farther away than a person can have gone is passed over too.

    Args:
        source: what sees people.
        person: follow only this one, as the source counts them; None: the first who is seen.
        patience: [s].

    Attributes:
        followed: the number of the one who is followed; None: nobody yet.
        passed_over: skeletons of others so far.

    Raises:
        InputError: when the patience is negative.
    """

    def __init__(self, source: SkeletonSource, *, person: int | None = None, patience: float = PATIENCE) -> None:
        if not patience >= 0.0:
            raise InputError(f"PersonFilter: patience must be at least 0 s, got {patience!r}")
        self.name = source.name
        self.followed: int | None = None
        self.passed_over = 0
        self._source, self._only, self._patience = source, person, patience
        self._seen = -math.inf
        self._place: tuple[float, Array] | None = None  # when and where the torso was last
        self._stranger: Array | None = None  # where one was seen who bears the same number

    @property
    def over(self) -> bool:
        """Whether the source is over."""
        return self._source.over

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton of the one who is followed; None when none came within ``timeout`` seconds."""
        until = clock.monotonic() + timeout
        while not self._source.over:
            skeleton = self._source.read(max(until - clock.monotonic(), 0.0))
            if skeleton is not None and self._is_followed(skeleton):
                return skeleton
            if clock.monotonic() >= until:
                break
        return None

    def _is_followed(self, skeleton: Skeleton) -> bool:
        """Decide about a skeleton, and remember."""
        if self._only is not None and skeleton.person != self._only:
            self.passed_over += 1
            return False
        gone = skeleton.time - self._seen
        torso = _torso(skeleton)
        near = abs(gone) <= self._patience  # a clock that was set back is a gap too
        if self.followed is not None and near:
            same = skeleton.person == self.followed and self._can_be_there(skeleton.time, torso)
            if not same:
                self.passed_over += 1
                return False
        elif torso is None:  # nobody begins to be followed by a hand alone
            return False
        else:
            self._place = self._stranger = None
        self.followed = skeleton.person
        self._seen = max(self._seen, skeleton.time) if near else skeleton.time
        if torso is not None:
            self._place = (skeleton.time, torso)
        return True

    def _can_be_there(self, time: float, torso: Array | None) -> bool:
        """Whether the one who is followed can have gone there, and it is not a stranger who was seen elsewhere."""
        if torso is None or self._place is None:
            return self._stranger is None
        before, place = self._place
        way = _distance(torso, place)
        near = way <= _SLACK + _FASTEST * abs(time - before)
        if near and (self._stranger is None or way < _distance(torso, self._stranger)):
            self._stranger = None
            return True
        self._stranger = torso
        return False


def _distance(a: Array, b: Array) -> float:
    way = a - b
    return math.sqrt(float(way @ way))


def _torso(skeleton: Skeleton) -> Array | None:
    """Return where a person is: the first joint of the torso that is seen, else the middle of the shoulders."""
    for point in skeleton.positions[_TORSO]:
        if point[0] == point[0]:  # not nan
            return np.asarray(point)
    middle = 0.5 * (skeleton.joint("shoulder_left") + skeleton.joint("shoulder_right"))
    if middle[0] == middle[0]:
        return np.asarray(middle)
    return None
