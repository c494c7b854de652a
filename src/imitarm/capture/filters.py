"""Sources that filter another source: select one person, undo swaps of left and right, or replay in real time."""

from __future__ import annotations

import math
import time as clock

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, SkeletonSource, Tracking
from imitarm.validation import finite_number, instance

Array = NDArray[np.float64]

PATIENCE = 2.0  # [s] the followed person may be out of view for so long
_FASTEST = 2.5  # [m/s] speed of a torso; a faster one is another person with the same number
_SLACK = 0.3  # [m] measurement error of its position
_TORSO = np.array([JOINT[name] for name in ("spine_shoulder", "spine_mid", "neck")])


class PersonFilter(SkeletonSource):
    """Selects one person from a source that may deliver several persons.

    The filter follows the first person who appears, and ignores everybody else. It follows another person only after
    the first person has been out of view for more than ``patience``. By that time, the retargeter (which converts the
    person's motion to the robot's motion) has stopped the robot. It starts again with the new person. A camera that
    tracks only one person at a time may give two successive persons the same number. Therefore the filter also ignores
    a person at a position that the followed person cannot have reached by walking.

    Args:
        source: the source to filter.
        person: number of the person to follow, as the source numbers persons; None: follow the first person who
            appears.
        patience: time after which another person may be followed, if the followed person is out of view [s].

    Attributes:
        followed: number of the followed person; None before a person is followed.
        passed_over: number of skeletons of other persons that were ignored.

    Raises:
        InputError: when the patience is negative, or the source is not a SkeletonSource.
    """

    def __init__(self, source: SkeletonSource, *, person: int | None = None, patience: float = PATIENCE) -> None:
        patience = finite_number(patience, "PersonFilter: patience", "s", at_least=0.0)
        instance(source, SkeletonSource, "PersonFilter: source")  # type: ignore[type-abstract]
        self.name, self.live = source.name, source.live
        self.followed: int | None = None
        self.passed_over = 0
        self._source, self._only, self._patience = source, person, patience
        self._seen = -math.inf
        self._place: tuple[float, Array] | None = None  # time and place of the torso when last seen
        self._stranger: Array | None = None  # place of another person who has the same number

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return self._source.over

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton of the followed person; None if no skeleton arrived within ``timeout`` seconds."""
        until = clock.monotonic() + timeout
        while not self._source.over:
            skeleton = self._source.read(max(until - clock.monotonic(), 0.0))
            if skeleton is not None and self._is_followed(skeleton):
                return skeleton
            if clock.monotonic() >= until:
                break
        return None

    def _is_followed(self, skeleton: Skeleton) -> bool:
        """Return whether a skeleton shows the followed person, and store the position of that person."""
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
        elif torso is None:  # a hand alone is not enough to begin with
            return False
        else:
            self._place = self._stranger = None
        self.followed = skeleton.person
        self._seen = max(self._seen, skeleton.time) if near else skeleton.time
        if torso is not None:
            self._place = (skeleton.time, torso)
        return True

    def _can_be_there(self, time: float, torso: Array | None) -> bool:
        """Return whether a position can be that of the followed person.

        The followed person must be able to have walked there, and must have been closer to it than any other person.
        """
        if torso is None or self._place is None:
            return self._stranger is None
        before, place = self._place
        moved = _distance(torso, place)
        near = moved <= _SLACK + _FASTEST * abs(time - before)
        if near and (self._stranger is None or moved < _distance(torso, self._stranger)):
            self._stranger = None
            return True
        self._stranger = torso
        return False


def _distance(a: Array, b: Array) -> float:
    difference = a - b
    return math.sqrt(float(difference @ difference))


def _torso(skeleton: Skeleton) -> Array | None:
    """Return the position of a person: the first visible joint of the torso, or else the middle of the shoulders."""
    for point in skeleton.positions[_TORSO]:
        if point[0] == point[0]:  # not nan
            return np.asarray(point)
    middle = 0.5 * (skeleton.joint("shoulder_left") + skeleton.joint("shoulder_right"))
    if middle[0] == middle[0]:
        return np.asarray(middle)
    return None


MEMORY = 0.5  # [s] older positions of a joint are not used
_TRUNK_SPEED, _ARM_SPEED = 0.5, 4.0  # [m/s] joints that appear to move faster have exchanged sides
_LEAST = 0.15  # [m] sides closer than half of this can't be distinguished by their motion

_PAIRED = tuple(name.removesuffix("_left") for name in JOINTS if name.endswith("_left"))


def _pairs(parts: tuple[str, ...]) -> NDArray[np.int64]:
    return np.array([[JOINT[f"{part}_{side}"] for part in parts] for side in SIDES])


_BODY = _pairs(_PAIRED)
_TRUNK = _pairs(("shoulder", "hip"))
_ARMS = (  # joints that are exchanged together, and joints that decide it
    (_pairs(("elbow", "wrist", "hand", "hand_tip", "thumb")), _pairs(("elbow", "wrist"))),
    (_pairs(("wrist", "hand", "hand_tip", "thumb")), _pairs(("wrist",))),
)

_DECIDING = _pairs(("shoulder", "hip", "elbow", "wrist"))


def unswapped(skeleton: Skeleton, before: Skeleton) -> Skeleton:
    r"""Return the skeleton with left and right as in the previous frame, even if the camera has swapped them.

    If a camera swaps left and right, both sides seem to move far within one frame. Pair j consists of a left and a
    right joint, for example the two wrists. Let :math:`l_j, r_j` be their positions, and :math:`l'_j, r'_j` their
    positions in the previous frame, a time t earlier. Swapping the two joints back shortens their motion by

    .. math:: g_j = |l_j - l'_j| + |r_j - r'_j| - |l_j - r'_j| - |r_j - l'_j|

    The threshold for this length is :math:`m(v) = \max(0.15, v t)` [m]. Here v is the largest plausible speed of a
    joint: 0.5 m/s for shoulders and hips, 4 m/s for the joints of an arm. Three conditions are tested in this order:

    1. The whole body is swapped back if :math:`\sum_j g_j > \sum_j m(0.5)` over the pairs of shoulders and hips.
    2. Elbows, wrists and hands are swapped back if :math:`g_j > m(4)` for the elbows and for the wrists.
    3. Otherwise, wrists and hands alone are swapped back if :math:`g_j > m(4)` for the wrists.

    If condition 1 holds, the whole body is swapped back before conditions 2 and 3 are tested. A joint can be used if it
    is visible now and both joints of its pair were visible in the previous frame. If only one joint of a pair can be
    used, :math:`g_j` contains only the terms of this joint, and the threshold is halved. If no joint of a pair can be
    used, condition 1 leaves the pair out, and a condition 2 or 3 that needs the pair is false. Hands that touch each
    other are too close to satisfy a condition, so they are never swapped.

    Args:
        skeleton: skeleton as the camera reports it.
        before: skeleton of the previous frame, in which left and right are correct.

    Returns:
        The corrected skeleton; the same object if left and right were not swapped.
    """
    return _kept(skeleton, before.positions, abs(skeleton.time - before.time))


def _kept(skeleton: Skeleton, before: Array, period: float) -> Skeleton:
    """Return the skeleton with left and right as in ``before``.

    The positions ``before`` [m] were measured ``period`` seconds earlier than the skeleton.
    """
    if not (_gain(skeleton.positions, before, _DECIDING, _LEAST) > 0.0).any():  # nearly always
        return skeleton
    order = np.arange(len(JOINTS))
    trunk = np.nansum(_gain(skeleton.positions, before, _TRUNK, max(_LEAST, _TRUNK_SPEED * period)))
    hands = body = bool(trunk > 0.0)
    if body:
        order[_BODY.ravel()] = _BODY[::-1].ravel()
    for arms, deciding in _ARMS:
        gain = _gain(skeleton.positions[order], before, deciding, max(_LEAST, _ARM_SPEED * period))
        known = np.isfinite(gain)
        if known.any(axis=0).all() and (np.where(known, gain, 0.0).sum(axis=0) > 0.0).all():
            order[arms.ravel()] = order[arms[::-1].ravel()]
            hands = not hands
            break
    if (order == np.arange(len(JOINTS))).all():
        return skeleton
    left, right = skeleton.hand_states
    states = (right, left) if hands else (left, right)
    return Skeleton(skeleton.time, skeleton.positions[order], skeleton.tracking[order], states, skeleton.person)


def _gain(now: Array, before: Array, pairs: NDArray[np.int64], margin: float) -> Array:
    """Return the length by which a swap shortens each joint's motion since the previous frame, minus ``margin / 2``.

    Args:
        now: positions (25, 3) [m].
        before: positions in the previous frame, shape (25, 3) [m].
        pairs: indices of the joints of the left and the right side, shape (2, n).
        margin: length by which a swap must shorten the motions of the two joints of a pair, added together [m].

    Returns:
        The result for each joint, shape (2, n) [m]; nan for a joint that is lost in one of the two frames.
    """
    there, here = before[pairs], now[pairs]
    straight, crossed = here - there, here - there[::-1]
    straight *= straight
    crossed *= crossed
    return np.sqrt(straight.sum(axis=2)) - np.sqrt(crossed.sum(axis=2)) - 0.5 * margin


class SideMemory:
    """Undoes swaps of left and right for one person, frame by frame.

    Attributes:
        swaps: number of frames in which left and right were swapped back.
    """

    def __init__(self) -> None:
        self.swaps = 0
        self._time = -np.inf
        self._positions = np.full((len(JOINTS), 3), np.nan)  # last position of each joint, for MEMORY seconds
        self._seen = np.full(len(JOINTS), -np.inf)

    def update(self, skeleton: Skeleton) -> Skeleton:
        """Return ``skeleton`` with left and right as in the skeleton of the previous call."""
        right = skeleton
        period = abs(skeleton.time - self._time)
        if period <= MEMORY:
            right = _kept(skeleton, self._positions, period)
            self.swaps += right is not skeleton
        seen = right.tracking > Tracking.LOST
        self._positions[seen], self._seen[seen] = right.positions[seen], right.time
        self._positions[np.abs(right.time - self._seen) > MEMORY] = np.nan
        self._time = right.time
        return right


class SideFilter(SkeletonSource):
    """Undoes swaps of left and right in a source, for each person separately; see :func:`unswapped`.

    The filter compares successive frames, and assumes that left and right are correct in the first frame. After half a
    second without frames, it assumes this again for the next frame. By this time, every retargeter has stopped the
    robot.

    Args:
        source: a source that may swap left and right.
    """

    def __init__(self, source: SkeletonSource) -> None:
        self.name, self.live = source.name, source.live
        self._source = source
        self._memory: dict[int, SideMemory] = {}

    @property
    def swaps(self) -> int:
        """Number of frames in which left and right were swapped back."""
        return sum(memory.swaps for memory in self._memory.values())

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return self._source.over

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton, with swaps undone; None if no skeleton arrived within ``timeout`` seconds."""
        skeleton = self._source.read(timeout)
        if skeleton is None:
            return None
        return self._memory.setdefault(skeleton.person, SideMemory()).update(skeleton)


class RealtimeSource(SkeletonSource):
    """Delays the skeletons of a source, so that they arrive at the pace of their time stamps.

    The first call of :meth:`read` returns the first skeleton at once. If the time stamp of a later skeleton is t
    seconds after that of the first skeleton, it is returned t seconds after the first skeleton.

    Args:
        source: source that returns skeletons without waiting, such as a recording.
    """

    def __init__(self, source: SkeletonSource) -> None:
        self.name, self.live = source.name, source.live
        self._source = source
        self._waiting: Skeleton | None = None
        self._start: float | None = None  # on the monotonic clock, of time 0

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return self._waiting is None and self._source.over

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None if its time does not come within ``timeout`` seconds."""
        until = clock.monotonic() + timeout
        if self._waiting is None:
            self._waiting = self._source.read(timeout)
        skeleton = self._waiting
        if skeleton is None:
            return None
        if self._start is None:
            self._start = clock.monotonic() - skeleton.time
        due = self._start + skeleton.time
        clock.sleep(max(min(due, until) - clock.monotonic(), 0.0))
        if due > until:
            return None
        self._waiting = None
        return skeleton
