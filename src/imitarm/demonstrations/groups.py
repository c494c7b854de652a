"""Groups: find demonstrations that take different paths from the same start to the same goal.

The mean of two paths around an obstacle may lead through the obstacle. Each group of demonstrations therefore needs a
skill of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import barycentre_warps, compute_alignment, features, to_common_ends
from imitarm.errors import InputError
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import sequence

Array = NDArray[np.float64]

LEAST_GAP = 0.02  # [m] smallest difference between demonstrations that is reported
_PATHS_APART = 0.2  # of the size of the motion: paths that are farther apart are different ones
_CLEARLY_APART = 0.05  # of the size of the motion, likewise if both groups are large and compact
_LARGE_GROUP = 3  # demonstrations
_GROUP_RATIO = 2.5  # two groups are so many times farther apart than neighbours within a group
_COMPACT_RATIO = 5.0  # likewise for groups that are compact


def group_by_path(demonstrations: Sequence[Demonstration]) -> list[list[Demonstration]]:
    """Divide demonstrations of one task into groups that take the same path.

    The paths are aligned, and moved to a common start and goal. The size of a path is the diagonal of the smallest box
    around it, and the size of the motion is the median over all paths. Two demonstrations belong to different groups if
    the distance between their paths exceeds 20 % of the size of the motion. A distance of 5 % is enough if each group
    has at least 3 demonstrations and the distance is at least 5 times as large as the distances within the groups.

    Args:
        demonstrations: demonstrations that run in the same direction between similar ends; see
            :func:`~imitarm.demonstrations.lint`.

    Returns:
        The groups, the largest first; within a group, the demonstrations keep their order.

    Raises:
        InputError: when there are no demonstrations, or they can't be aligned.
    """
    shown = sequence(demonstrations, Demonstration, "group_by_path: demonstrations")
    if not shown:
        raise InputError("group_by_path: no demonstrations; read some first")
    if len(shown) == 1:
        return [list(shown)]
    aligned = compute_alignment(shown).demonstrations
    positions = np.stack([one.trajectory.positions for one in aligned])
    size = float(np.median(np.linalg.norm(np.ptp(positions, axis=1), axis=1)))
    distance = largest_distances(to_common_ends(positions))
    pending, groups = [np.arange(len(shown))], []
    while pending:
        members = pending.pop()
        found = split_paths(distance[np.ix_(members, members)], size) if len(members) > 1 else None
        if found is None:
            groups.append(members)
        else:
            pending += [members[found[0]], members[~found[0]]]
    groups.sort(key=lambda members: (-len(members), members[0]))
    return [[shown[i] for i in members] for members in groups]


def split_paths(distance: Array, size: float) -> tuple[NDArray[np.bool_], float] | None:
    """Divide demonstrations into two groups by the distances between their paths; None if there is only one group.

    Args:
        distance: largest distance between each pair of paths, shape (m, m) [m].
        size: size of the motion, see :func:`group_by_path` [m].

    Returns:
        A mask that is true for the demonstrations of one group, shape (m,), and the gap between the groups [m].
    """
    found = two_groups(distance, max(LEAST_GAP, _PATHS_APART * size))
    if found is None:
        floor = max(LEAST_GAP, _CLEARLY_APART * size)
        found = two_groups(distance, floor, ratio=_COMPACT_RATIO, others_too=False)
        if found is not None and min(found[0].sum(), (~found[0]).sum()) < _LARGE_GROUP:
            return None
    return found


def aligned_paths(trajectories: Sequence[Trajectory]) -> tuple[Array, Array | None]:
    """Return aligned positions (m, n, 3) [m] and quaternions (m, n, 4); None instead if a motion has no quaternions."""
    if any(one.quaternions is None for one in trajectories):
        trajectories = [Trajectory(one.times, one.positions) for one in trajectories]
    warps = barycentre_warps(features(trajectories), n_iterations=4)
    warped = [one.at(warp * one.duration) for one, warp in zip(trajectories, warps, strict=True)]
    rotations = [q for _, q in warped if q is not None]
    return np.stack([p for p, _ in warped]), np.stack(rotations) if rotations else None


def largest_distances(paths: Array) -> Array:
    """Return the largest distance between each pair of paths (m, n, 3) at equal times, shape (m, m) [m]."""
    return np.stack([np.linalg.norm(paths - path, axis=2).max(axis=1) for path in paths])


def two_groups(
    distance: Array, floor: float, *, ratio: float = _GROUP_RATIO, others_too: bool = True
) -> tuple[NDArray[np.bool_], float] | None:
    """Divide m demonstrations into two groups by their distances (m, m); return None when there is only one group.

    The gap between the two groups is the longest edge of the minimum spanning tree of the demonstrations. There are two
    groups only if the gap exceeds ``floor`` and is more than ``ratio`` times as long as the second longest edge.
    Demonstrations within a group are then much closer together than the groups.

    Args:
        distance: distances between the demonstrations, shape (m, m).
        floor: smallest gap between groups, in the unit of ``distance``.
        ratio: smallest ratio of the longest edge to the second longest.
        others_too: whether to ignore ``ratio`` if the second longest edge also exceeds ``floor``. In this case, there
            are more than two groups, and the longest edge separates one or more groups from the others.

    Returns:
        A mask that is true for the demonstrations of one group, shape (m,), and the gap, in the unit of ``distance``.
    """
    m = len(distance)
    nearest, inside, links = distance[0].copy(), np.arange(m) == 0, []
    while not inside.all():
        new = int(np.argmin(np.where(inside, np.inf, nearest)))
        links.append(float(nearest[new]))
        inside[new] = True
        nearest = np.minimum(nearest, distance[new])
    links.sort()
    if links[-1] <= floor:
        return None
    if m > 2 and links[-1] <= ratio * links[-2] and not (others_too and links[-2] > floor):
        return None
    group = np.arange(m) == 0
    for _ in range(m):
        group = (distance[group] < links[-1]).any(axis=0)
    return group, links[-1]
