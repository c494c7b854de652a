"""Slowing: a recorded motion done more slowly, for a robot whose joints are not as quick as a person's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from imitarm.capture.skeleton import Skeleton, Tracking
from imitarm.errors import InputError

SLOWEST: Final = 0.05
_GAP: Final = 0.25  # [s] of the recording; what happened in a longer one is not guessed


def slowed(skeletons: Sequence[Skeleton], pace: float) -> list[Skeleton]:
    """Return a recording at a share of its pace, with frames put in between so that there are as many a second.

    Between two frames joints go straight; one that is lost in either stays as it was. Gaps stay gaps, and grow.

    Args:
        skeletons: in the order of their times.
        pace: share of the recorded one, 0.05 to 1.

    Raises:
        InputError: when the pace is out of range.
    """
    if not SLOWEST <= pace <= 1.0:
        raise InputError(f"pace must be between {SLOWEST:g} and 1, got {pace!r}: a recording can only be slowed")
    if pace == 1.0 or not skeletons:
        return list(skeletons)
    start, parts = skeletons[0].time, int(np.ceil(1.0 / pace))
    slow = [replace(skeleton, time=start + (skeleton.time - start) / pace) for skeleton in skeletons]
    done: list[Skeleton] = []
    for before, after in pairwise(slow):
        done.append(before)
        if after.time - before.time <= _GAP / pace:
            done += [_between(before, after, k / parts) for k in range(1, parts)]
    return [*done, slow[-1]]


def _between(before: Skeleton, after: Skeleton, share: float) -> Skeleton:
    """Return the person a share of the way from one frame to the next."""
    tracking = np.minimum(before.tracking, after.tracking)
    lost = tracking == Tracking.LOST
    positions = before.positions + share * (after.positions - before.positions)
    positions[lost], tracking[lost] = before.positions[lost], before.tracking[lost]
    return Skeleton(
        before.time + share * (after.time - before.time), positions, tracking, before.hand_states, before.person
    )
