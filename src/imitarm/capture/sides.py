"""Left and right kept apart: a camera that takes one for the other must not make a robot jump to the other arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, SkeletonSource, Tracking

Array = NDArray[np.float64]

MEMORY = 0.5  # [s] where a joint was longer ago says nothing about where it is
_TRUNK_SPEED, _ARM_SPEED = 0.5, 4.0  # [m/s] exchanged sides appear faster
_LEAST = 0.15  # [m] sides nearer to each other than half of this can't be told apart by their motion

_PAIRED = tuple(name.removesuffix("_left") for name in JOINTS if name.endswith("_left"))


def _pairs(parts: tuple[str, ...]) -> NDArray[np.int64]:
    return np.array([[JOINT[f"{part}_{side}"] for part in parts] for side in SIDES])


_BODY = _pairs(_PAIRED)
_TRUNK = _pairs(("shoulder", "hip"))
_ARMS = (  # what is exchanged together, and what decides it
    (_pairs(("elbow", "wrist", "hand", "hand_tip", "thumb")), _pairs(("elbow", "wrist"))),
    (_pairs(("wrist", "hand", "hand_tip", "thumb")), _pairs(("wrist",))),
)

_JUDGED = _pairs(("shoulder", "hip", "elbow", "wrist"))


def unswapped(skeleton: Skeleton, before: Skeleton) -> Skeleton:
    r"""Return the skeleton with its sides as they were in the frame before.

    Sides are exchanged back when that makes the motion since the frame before less by more than limbs move in the
    time t between them:

    .. math:: \sum_j |l_j - l'_j| + |r_j - r'_j| > \sum_j |l_j - r'_j| + |r_j - l'_j| + n\,\max(0.15, v t)

    over n pairs of joints that are seen in both frames; first shoulders and hips (v = 0.5 m/s), for the whole body;
    then hands, with or without elbows (v = 4 m/s), for arms that were taken for each other while the body was not.
    Hands that meet are nearer to each other than that and are left alone. Where one joint of a pair is lost, the
    other one decides.

    Args:
        skeleton: as the camera has it.
        before: the frame before, with its sides right.

    Returns:
        the same skeleton when nothing was exchanged.
    """
    return _kept(skeleton, before.positions, abs(skeleton.time - before.time))


def _kept(skeleton: Skeleton, before: Array, period: float) -> Skeleton:
    """Return the skeleton with its sides as they were at ``before``, positions (25, 3) [m], a ``period`` [s] ago."""
    if not (_gain(skeleton.positions, before, _JUDGED, _LEAST) > 0.0).any():  # nearly always
        return skeleton
    order = np.arange(len(JOINTS))
    trunk = np.nansum(_gain(skeleton.positions, before, _TRUNK, max(_LEAST, _TRUNK_SPEED * period)))
    hands = body = bool(trunk > 0.0)
    if body:
        order[_BODY.ravel()] = _BODY[::-1].ravel()
    for arms, judged in _ARMS:
        gain = _gain(skeleton.positions[order], before, judged, max(_LEAST, _ARM_SPEED * period))
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
    """Return by how much more joints are nearer to where those of the other side were than ``margin`` / 2 [m].

    Args:
        now: positions (25, 3) [m].
        before: likewise.
        pairs: joints of the left and the right side, shape (2, n).
        margin: for each pair [m].

    Returns:
        shape (2, n); nan where a joint is lost, or one of its pair was.
    """
    there, here = before[pairs], now[pairs]
    straight, crossed = here - there, here - there[::-1]
    straight *= straight
    crossed *= crossed
    return np.sqrt(straight.sum(axis=2)) - np.sqrt(crossed.sum(axis=2)) - 0.5 * margin


class SideMemory:
    """Keeps the sides of one person apart, frame by frame.

    Attributes:
        swaps: frames in which sides were exchanged back.
    """

    def __init__(self) -> None:
        self.swaps = 0
        self._time = -np.inf
        self._positions = np.full((len(JOINTS), 3), np.nan)  # where each joint was last, for as long as that counts
        self._seen = np.full(len(JOINTS), -np.inf)

    def update(self, skeleton: Skeleton) -> Skeleton:
        """Return the next skeleton with its sides right."""
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


class SwapGuard(SkeletonSource):
    """A source whose left and right stay what they were, person by person; see :func:`unswapped`.

    It goes by motion alone: the sides of the first frame are believed. After half a second without frames it begins
    anew, by which time every retargeter has let go.

    Args:
        source: what may take left for right.
    """

    def __init__(self, source: SkeletonSource) -> None:
        self.name = source.name
        self._source = source
        self._memory: dict[int, SideMemory] = {}

    @property
    def swaps(self) -> int:
        """Frames in which sides were exchanged back."""
        return sum(memory.swaps for memory in self._memory.values())

    @property
    def over(self) -> bool:
        """Whether the source is over."""
        return self._source.over

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton with its sides right; None when none came within ``timeout`` seconds."""
        skeleton = self._source.read(timeout)
        if skeleton is None:
            return None
        return self._memory.setdefault(skeleton.person, SideMemory()).update(skeleton)
