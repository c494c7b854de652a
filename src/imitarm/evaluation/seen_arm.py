"""Where a person's arm was as far as a camera saw it, and how late a tool is: where nobody knows the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import TaskFailedError
from imitarm.evaluation.tracking import LAGS, TrueArm, rms
from imitarm.kinematics.pose import matrix_to_quaternion
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.human_arm import hand_rotation

Array = NDArray[np.float64]

_STILL = 1e-3  # [m] a target that moves less has no lag
_FOLLOWS = 0.5  # share of a target's own motion


def seen_arm(skeletons: Sequence[Skeleton], times: ArrayLike, correspondence: Correspondence) -> TrueArm:
    """Return a person's arm as a recording shows it, noise and all, between its frames by straight lines.

    Measured against it a method can't be better than the camera, and a smooth one looks a little worse than it is.

    Args:
        skeletons: in the order of their times.
        times: since the first skeleton, shape (n,) [s].
        correspondence: which arm, and how the sensor stands.

    Raises:
        TaskFailedError: when shoulder, elbow and wrist are never seen together.
    """
    arms = [arm for arm in (skeleton.arm(correspondence.side) for skeleton in skeletons) if arm.seen]
    if not arms:
        raise TaskFailedError(f"the {correspondence.side} arm is never seen; choose the other by --side")
    t = np.asarray(times, dtype=float)
    at = np.array([arm.time for arm in arms]) - skeletons[0].time
    points = correspondence.sensor_to_base.apply(np.array([arm.points for arm in arms]).reshape(-1, 3))
    points = points.reshape(len(arms), -1, 3)
    between = np.stack(
        [np.column_stack([np.interp(t, at, points[:, joint, i]) for i in range(3)]) for joint in range(3)], axis=1
    )
    hands, hand = np.empty((len(arms), 3, 3)), np.eye(3)
    for i, (wrist, tip, thumb) in enumerate(points[:, [2, 4, 5]]):
        found = hand_rotation(wrist, tip, thumb)
        hand = hand if found is None else found
        hands[i] = hand
    newest = np.maximum(np.searchsorted(at, t + 1e-9, side="right") - 1, 0)
    return TrueArm(t, between[:, 0], between[:, 1], between[:, 2], matrix_to_quaternion(hands)[newest])


def target_lag(times: ArrayLike, tool: ArrayLike, targets: ArrayLike) -> float:
    """Return the constant lag with which a tool follows its target best [s], among those from 0 to 0.8 s.

    Args:
        times: evenly spaced, shape (n,) [s].
        tool: positions, shape (n, 3) [m].
        targets: shape (n, 3) [m]; nan where there is none.

    Returns:
        nan when there is no target, it does not move, or the tool is so far from it at any lag that it does not
        follow: farther than half of what the target goes about its middle (RMS).
    """
    t, p, aim = (np.asarray(values, dtype=float) for values in (times, tool, targets))
    known = np.isfinite(aim).all(axis=1)
    if not known.any() or not np.ptp(aim[known], axis=0).max() > _STILL:
        return float("nan")
    goes = rms(aim[known] - aim[known].mean(axis=0))
    dt, errors = float(t[1] - t[0]), {}
    for lag in np.abs(LAGS[LAGS >= 0.0]):  # there is a -0.0 among them
        steps = round(float(lag) / dt)
        both = known[: len(p) - steps]  # the target then, the tool now
        if both.any():
            errors[float(lag)] = rms((p[steps:] - aim[: len(p) - steps])[both])
    best = min(errors, key=errors.__getitem__)
    return best if errors[best] < _FOLLOWS * goes else float("nan")
