"""What ``make bench`` times of tracking: ten obstacles, against ten filters of FilterPy."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import numpy as np
from numpy.typing import NDArray

from imitarm.perception import Detection, ObstacleTracker
from imitarm.scene import Sphere
from timing import Row
from yardsticks import named

Array = NDArray[np.float64]

_OBSTACLES = 10
_PERIOD = 1.0 / 30.0  # [s]
_SIGMA = 0.005  # [m]
_FRAMES = 300


def _positions() -> Array:
    """Return detected positions of ten obstacles at rest, shape (n_frames, 10, 3) [m]."""
    rng = np.random.default_rng(0)
    return rng.uniform(-1.0, 1.0, (_OBSTACLES, 3)) + rng.normal(0.0, _SIGMA, (_FRAMES, _OBSTACLES, 3))


def tracker_update() -> Row:
    """An update of ten tracks with assignment, births and deaths, against ten Kalman filters that do not assign."""
    from filterpy.kalman import KalmanFilter

    detected = _positions()
    noise = _SIGMA**2 * np.eye(3)
    frames = [[Detection(Sphere(z, 0.05), noise) for z in frame] for frame in detected]
    tracker, ours, theirs = ObstacleTracker(), count(), count()
    (q,) = tracker.filter.noise
    dt, eye = _PERIOD, np.eye(3)
    filters = []
    for z in detected[0]:
        one = KalmanFilter(dim_x=6, dim_z=3)
        one.x, one.H, one.R = np.r_[z, np.zeros(3)][:, None], np.eye(3, 6), noise
        one.P = np.diag([_SIGMA**2] * 3 + [0.25] * 3)
        one.F = np.block([[eye, dt * eye], [0.0 * eye, eye]])
        one.Q = q * np.block([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
        filters.append(one)

    def update() -> None:
        k = next(ours)
        tracker.update(k * _PERIOD, frames[k % _FRAMES])

    def reference() -> None:
        frame = detected[next(theirs) % _FRAMES]
        for one, z in zip(filters, frame, strict=True):
            one.predict()
            one.update(z)

    def check() -> tuple[bool, str]:
        tracker.reset()
        for k in range(60):
            tracks = tracker.update(k * _PERIOD, frames[k])
        for one, z in zip(filters, detected[0], strict=True):
            one.x, one.P = np.r_[z, np.zeros(3)][:, None], np.diag([_SIGMA**2] * 3 + [0.25] * 3)
        for k in range(1, 60):
            for one, z in zip(filters, detected[k], strict=True):
                one.predict()
                one.update(z)
        estimates = np.array([one.x.ravel()[:3] for one in filters])
        furthest = max(float(np.linalg.norm(estimates - t.position, axis=1).min()) for t in tracks)
        return len(tracks) == _OBSTACLES and furthest < 1e-9, f"same estimates, to {furthest:.0e} m"

    return Row(
        "tracker update, ten obstacles",
        update,
        reference,
        f"ten filters of {named('filterpy')}",
        faster=5.0,
        check=check,
    )


ROWS: tuple[Callable[[], Row], ...] = (tracker_update,)
