"""Directions in which a path may be displaced, in a frame whose first axis points along the motion."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])


def allowed_axes(forbidden: Array) -> tuple[Array, Array]:
    """Return the space in which a path may be displaced.

    Args:
        forbidden: directions in which the path must not be displaced, unit vectors, shape (m, 3).

    Returns:
        An orthonormal basis of the space in which the path may be displaced, as d columns, shape (3, d); and the
        forbidden directions whose opposites are allowed, in this basis, shape (m', d).
    """
    both = np.any(forbidden @ forbidden.T < -1.0 + 1e-9, axis=1)
    _, size, basis = np.linalg.svd(np.concatenate([np.zeros((1, 3)), forbidden[both]]))
    axes = basis[np.count_nonzero(size > 1e-9) :].T
    return axes, forbidden[~both] @ axes


def headings(axes: Array) -> Array:
    """Return candidate directions, in the frame of :func:`frame`: 26 in space, 12 in a plane, 2 on a line.

    Args:
        axes: orthonormal basis of the space in which the tool may deviate, as d columns, shape (3, d).
    """
    d = axes.shape[1]
    if d == 2:
        angles = np.arange(12) * (np.pi / 6.0)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    grid = np.array(list(itertools.product((1.0, 0.0, -1.0), repeat=d))).reshape(-1, d)
    grid = grid[grid.any(axis=1)] if d else grid[:0]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


def frame(tangent: Array, axes: Array) -> Array:
    """Return an orthonormal basis (3, d) of the space of ``axes`` (3, d): along the motion, to its left, and up.

    The frame depends only on the direction of the motion and on the vertical. If a scene is rotated about the vertical,
    the candidate directions are therefore rotated in the same way.
    """
    if axes.shape[1] == 3:
        return _frame_in_space(*tangent.tolist())
    along = axes @ (tangent @ axes)
    length = float(np.sqrt(along.dot(along)))
    if axes.shape[1] < 2 or length < 1e-6:
        return axes
    along = along / length
    for other in (_UP, axes[:, 0], axes[:, 1]):
        rest = axes @ (other @ axes)
        rest = rest - along * along.dot(rest)
        length = float(np.sqrt(rest.dot(rest)))
        if length > 1e-3:
            break
    return np.stack([along, rest / length], axis=1)


def _frame_in_space(x: float, y: float, z: float) -> Array:
    """Return the frame of a motion in the direction (x, y, z); that of the base if the direction is 0 or vertical."""
    across = math.hypot(x, y)
    if across < 1e-3:
        return np.eye(3)
    length = math.hypot(across, z)
    a, b, c = x / length, y / length, z / length
    d = across / length
    return np.array([[a, -b / d, -a * c / d], [b, a / d, -b * c / d], [c, 0.0, d]])
