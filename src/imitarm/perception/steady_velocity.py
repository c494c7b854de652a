r"""The mean velocity of a tracked obstacle over up to one second, which is less noisy than the tracker's velocity.

A tracker must follow sudden changes, so its velocities are noisy. A plan may look five seconds ahead; an error of 5
cm/s then becomes an error of 25 cm. If an obstacle moves at a constant velocity, its positions p at the times :math:`t`
and :math:`t - W` give a better velocity:

.. math:: v_W = \frac{p(t) - p(t - W)}{W}

If each position has an error of 5 mm and W is 1 s, the error of :math:`v_W` is 7 mm/s. An obstacle counts as steady
while :math:`v_W` and the tracker's velocity differ by at most 0.12 m/s, which is the tracker's usual error.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imitarm.scene.scene import Scene

Array = NDArray[np.float64]

_LONGEST, _SHORTEST = 1.0, 0.4  # [s] W at most; with less, the velocity of the tracker is better
_KEPT = 0.05  # [s] between two places that are remembered
_STEADY = 0.12  # [m/s] difference of the two velocities of an obstacle that moves steadily
_STANDS = 0.015  # [m/s] an obstacle that is slower than this counts as standing


class SteadyVelocities:
    """Replaces the velocities of steady tracked obstacles by their mean velocities over up to one second.

    Obstacles without a track number keep their velocities, because no tracker estimated these velocities.
    """

    def __init__(self) -> None:
        self._places: dict[int, deque[tuple[float, Array]]] = {}

    def improved(self, scene: Scene) -> Scene:
        """Return the scene with improved velocities, and store the positions of its obstacles for later calls.

        Args:
            scene: scene from a tracker. Its stamp must be later than the stamp of the previous call.
        """
        packed, time = scene.packed, scene.stamp
        tracks = np.asarray(packed.track_ids).tolist()
        self._places = {track: places for track, places in self._places.items() if track in tracks}
        changed = list(scene.obstacles)
        for i, track in enumerate(tracks):
            if track < 0:
                continue
            velocity = self._over_time(int(track), time, packed.positions[i])
            if velocity is None or np.linalg.norm(velocity - packed.velocities[i]) > _STEADY:
                continue
            if np.linalg.norm(velocity) < _STANDS:
                velocity = np.zeros(3)
            changed[i] = replace(changed[i], velocity=velocity)
        if all(new is old for new, old in zip(changed, scene.obstacles, strict=True)):
            return scene
        return Scene(scene.goal, tuple(changed), scene.stamp, scene.fixtures)

    def _over_time(self, track: int, time: float, position: Array) -> Array | None:
        """Return the velocity over up to a second; None if the track is too young."""
        places = self._places.setdefault(track, deque())
        if not places or time - places[-1][0] >= _KEPT:
            places.append((time, position.copy()))
        while len(places) > 1 and time - places[1][0] >= _LONGEST:
            places.popleft()
        before, there = places[0]
        return None if time - before < _SHORTEST else np.asarray((position - there) / (time - before))
