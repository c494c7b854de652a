"""Measures how far an executed path of the tool departs from the demonstrations, regardless of its timing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.align import dtw
from imitarm.errors import InputError
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]

_SAMPLES = 200


@dataclass(frozen=True)
class PathStyle:
    r"""The difference between an executed path and the mean of the demonstrations, compared as curves.

    Both paths are resampled at 200 points that are evenly spaced along the arc, so timing does not matter. Dynamic time
    warping then matches the points x_i of the executed path with points m_j of the mean path. This matching keeps the
    order of the points and minimises the sum of squared distances. Let P be the set of matched pairs, and let
    :math:`\Sigma_j` be the covariance of the demonstrations at m_j. Then

    .. math:: \mathrm{rmse}^2 = \frac1{|P|} \sum_{(i,j) \in P} |x_i - m_j|^2, \qquad
              \mathrm{deviation} = \max_i \min_{j: (i,j) \in P} \sqrt{(x_i - m_j)^T \Sigma_j^{-1} (x_i - m_j)}

    Attributes:
        rmse: root mean square distance of the matched points [m].
        deviation: largest Mahalanobis distance along the executed path, in standard deviations of the demonstrations.
        tilt: largest angle between the tool's rotation and the rotation at the nearest point of the mean path [rad].
    """

    rmse: float
    deviation: float
    tilt: float


def path_style(executed: Trajectory, learned: Trajectory, covariances: Array) -> PathStyle:
    """Compare an executed path with the mean of the demonstrations.

    Args:
        executed: path of the tool, with rotations.
        learned: mean of the demonstrations: a trajectory of n samples with rotations.
        covariances: covariance of the demonstrated positions at each sample of ``learned``, shape (n, 3, 3) [m^2].

    Raises:
        InputError: when a path has no rotations.
    """
    if executed.quaternions is None:
        raise InputError("path_style: the executed path has no rotations; give it quaternions")
    x = _along(executed.positions, executed.positions)
    mean = _along(learned.positions, learned.positions)
    spread = _along(learned.positions, covariances.reshape(len(learned), 9)).reshape(-1, 3, 3)
    _, path = dtw(x[None], mean[None], band=_SAMPLES)
    i, j = np.unique(path[0], axis=0).T
    away = x[i] - mean[j]
    squares = np.einsum("ki,ki->k", away, np.linalg.solve(spread[j], away[:, :, None])[:, :, 0])
    least = np.full(len(x), np.inf)
    np.minimum.at(least, i, squares)
    rmse = float(np.sqrt(np.mean(np.einsum("ki,ki->k", away, away))))
    tilt, _ = tilts(learned, executed.positions, executed.quaternions)
    return PathStyle(rmse, float(np.sqrt(least.max())), float(tilt.max()))


def tilts(learned: Trajectory, positions: Array, quaternions: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the angle between the rotation of each pose and the rotation at the nearest sample of a learned path.

    Args:
        learned: the learned path with its rotations.
        positions: positions of the m poses, shape (m, 3) [m].
        quaternions: rotations of the poses, tool_to_base, wxyz, shape (m, 4).

    Returns:
        angles (m,) [rad], and index of the nearest sample of the learned path, shape (m,).

    Raises:
        InputError: when the learned path has no rotations.
    """
    if learned.quaternions is None:
        raise InputError("tilts: the learned path has no rotations; give it quaternions")
    away = positions[:, None] - learned.positions
    nearest = np.einsum("mni,mni->mn", away, away).argmin(axis=1)
    alike = np.abs(np.einsum("mi,mi->m", quaternions, learned.quaternions[nearest]))
    return 2.0 * np.arccos(np.minimum(alike, 1.0)), nearest


def _along(positions: Array, values: Array) -> Array:
    """Return rows of ``values`` (n, m) at points that are evenly spaced along a path (n, 3), shape (200, m)."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], _SAMPLES)
    return np.stack([np.interp(even, length, column) for column in values.T], axis=1)
