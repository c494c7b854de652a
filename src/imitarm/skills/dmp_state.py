"""Where a movement primitive is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.skills.course import Course
from imitarm.skills.phase_basis import DECAY
from imitarm.skills.quaternion_dmp import Turn

Array = NDArray[np.float64]


class DMPState(NamedTuple):
    """Where a primitive is. Made by ``DMP.begin``, carried on by ``DMP.step``.

    Attributes:
        motion: [x; T x'], shape (2, 3) [m].
        share: of the duration that is over by the primitive's own clock; the phase is ``exp(-alpha share)``.
        course: what start, goal and duration were asked for.
        turn: the state of the rotation; None when none was learnt.
        rhythm: length of the steps so far, as a share of the duration, and their number; None after a change.
    """

    motion: Array
    share: float
    course: Course
    turn: Turn | None = None
    rhythm: tuple[float, int] | None = None

    @property
    def position(self) -> Array:
        """Position (3,) [m]."""
        return self.motion[0]

    @property
    def velocity(self) -> Array:
        """Velocity (3,) [m/s]."""
        return self.motion[1] / self.course.duration

    @property
    def phase(self) -> float:
        """Phase s, from 1 at the start to 0.01 at the end and on towards 0."""
        return float(np.exp(-DECAY * self.share))

    @property
    def time(self) -> float:
        """Time of the primitive's own clock [s]; it stands behind the wall clock when the robot lagged."""
        return self.share * self.course.duration

    @property
    def quaternion(self) -> Array | None:
        """Rotation wxyz (4,), or None when none was learnt."""
        return None if self.turn is None else self.turn.quaternion
