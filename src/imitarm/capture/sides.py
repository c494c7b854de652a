"""Left and right kept apart: a camera that takes one for the other must not make a robot jump to the other arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, SIDES, Skeleton, SkeletonSource, Tracking

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
    period = abs(skeleton.time - before.time)
    order = np.arange(len(JOINTS))
    body = _nearer_exchanged(skeleton.positions, before.positions, _TRUNK, max(_LEAST, _TRUNK_SPEED * period))
    if body:
        order[_BODY.ravel()] = _BODY[::-1].ravel()
    hands, margin = body, max(_LEAST, _ARM_SPEED * period)
    for arms, judged in _ARMS:
        if _nearer_exchanged(skeleton.positions[order], before.positions, judged, margin, every=True):
            order[arms.ravel()] = order[arms[::-1].ravel()]
            hands = not hands
            break
    if not body and not hands:
        return skeleton
    left, right = skeleton.hand_states
    states = (right, left) if hands else (left, right)
    return Skeleton(skeleton.time, skeleton.positions[order], skeleton.tracking[order], states, skeleton.person)


def _nearer_exchanged(
    now: NDArray[np.float64], before: NDArray[np.float64], pairs: NDArray[np.int64], margin: float, every: bool = False
) -> bool:
    """Whether joints are nearer to where those of the other side were.

    Args:
        now: positions (25, 3) [m].
        before: likewise.
        pairs: joints of the left and the right side, shape (2, n).
        margin: for each joint [m].
        every: of each pair, not only of all together.
    """
    there, here = before[pairs], now[pairs]
    straight = np.sqrt(np.sum((here - there) ** 2, axis=2))
    crossed = np.sqrt(np.sum((here - there[::-1]) ** 2, axis=2))
    gain = straight - crossed - 0.5 * margin
    known = np.isfinite(gain)
    known &= np.isfinite(there).all(axis=(0, 2))  # a joint that was lost before on one side says nothing
    if not known.any():
        return False
    by_pair = np.where(known, gain, 0.0).sum(axis=0)
    if every:
        return bool((by_pair[known.any(axis=0)] > 0.0).all() and known.any(axis=0).all())
    return bool(by_pair.sum() > 0.0)


class SideMemory:
    """Keeps the sides of one person apart, frame by frame.

    Attributes:
        swaps: frames in which sides were exchanged back.
    """

    def __init__(self) -> None:
        self.swaps = 0
        self._before: Skeleton | None = None
        self._seen = np.full(len(JOINTS), -np.inf)

    def update(self, skeleton: Skeleton) -> Skeleton:
        """Return the next skeleton with its sides right."""
        right = skeleton
        if self._before is not None and abs(skeleton.time - self._before.time) <= MEMORY:
            right = unswapped(skeleton, self._before)
            self.swaps += right is not skeleton
        self._remember(right)
        return right

    def _remember(self, skeleton: Skeleton) -> None:
        """Keep where each joint was last, for as long as that counts."""
        lost = skeleton.tracking == Tracking.LOST
        self._seen[~lost] = skeleton.time
        recent = lost & (np.abs(skeleton.time - self._seen) <= MEMORY)
        if self._before is None or not recent.any():
            self._before = skeleton
            return
        positions, tracking = np.array(skeleton.positions), np.array(skeleton.tracking)
        positions[recent], tracking[recent] = self._before.positions[recent], Tracking.INFERRED
        self._before = Skeleton(skeleton.time, positions, tracking, skeleton.hand_states, skeleton.person)


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
