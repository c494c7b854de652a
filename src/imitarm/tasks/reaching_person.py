"""ReachingPerson: a person beside the table reaches across the path of the brush, and a skeleton camera sees it."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.capture.synthetic import SyntheticSource
from imitarm.control_loop.person_observer import PersonObserver
from imitarm.kinematics.pose import Pose
from imitarm.perception import PersonCapsules
from imitarm.perception.person_capsules import upright_camera
from imitarm.perception.person_motion import moving_arms
from imitarm.scene import MovingScene

Array = NDArray[np.float64]

LEAD = 1.0
"""Time for which the camera sees the person before the arm moves [s]."""
SIDE = "right"
"""Side of the arm that reaches. The other arm hangs down behind the table, and is not in the scene."""
LINKS = 0.03
"""Clearance that the safety filter keeps between the arm and the tracked capsules [m]; the camera's error is 1.2 cm."""
MAX_ACCELERATION = 4.0
"""Largest acceleration of the brush away from the learned path [m/s^2].

With a larger value, the brush follows the noise of the skeletons, tilts, and touches the table.
"""
BRUSH_AND_WRIST = np.array(
    [[0.0, 0.0, 0.0, 0.058], [0.0, 0.0, -0.12, 0.05], [0.0, 0.0, -0.23, 0.06], [0.0, 0.0, -0.31, 0.06]]
)
"""Spheres of the brush, its handle and the wrist of a Sawyer in the tool's frame, rows x, y, z, radius [m].

A person's forearm crosses the path above the table, so the policy must also keep the handle and the wrist clear.
"""
_DURATION = 50.0  # [s] longer than a sweep may take
_MOVES = 12.5  # [s] after this time, the person rests
_PERSON, _STANDS = 6, (1.2, -0.24)  # seed of the person; x and y of the person's feet [m]
_CAMERA = (-1.0, -1.0, 0.35)  # [m] behind the arm and beside it, at the height that the skeletons of a Person assume
_SIGMA = 0.012  # [m] error of the camera
_STEP = 0.02  # [s] between two samples of the true motion

# time [s], place of the right wrist x, y, z [m], distance by which the person leans forward [m]
_REACHES = np.array(
    [
        [0.0, 1.00, 0.00, 0.31, 0.00],
        [0.8, 1.00, 0.00, 0.31, 0.00],
        [3.0, 0.70, -0.18, 0.19, 0.20],
        [4.4, 0.70, -0.18, 0.19, 0.20],
        [6.4, 1.00, 0.06, 0.31, 0.00],
        [6.6, 1.00, 0.06, 0.31, 0.00],
        [8.6, 0.84, 0.22, 0.22, 0.12],
        [10.2, 0.84, 0.22, 0.22, 0.12],
        [12.0, 1.00, 0.06, 0.31, 0.00],
    ]
)


class ReachingPerson:
    """A simulated person who reaches over the table twice with the right hand while the arm sweeps.

    The person stands at the far side of the table and faces the arm. The first reach crosses the path of the brush
    before the dirt. The second reach ends beside the path behind the dirt, too near for the brush to pass without a
    displacement. Between two places, the hand moves on a straight line with the least jerk. If a place is out of reach,
    the arm stretches towards it. The body leans forward by shifting. The sizes of the limbs, tremor and sway are those
    of :class:`~imitarm.capture.person.Person`.

    A simulated skeleton camera sees the person at 30 Hz with errors of about 1.2 cm, dropouts and occlusions.
    """

    camera: ClassVar[Pose] = upright_camera(_CAMERA)
    """Pose ``sensor_to_base`` of the skeleton camera."""
    capsules: ClassVar[PersonCapsules] = PersonCapsules(camera, sides=[SIDE])
    """The object that converts skeletons to capsules."""

    @classmethod
    def truth(cls, time: float) -> Skeleton:
        """Return the true skeleton in the frame of the camera; the arm begins to move at the time 0 [s]."""
        moved = min(time, _MOVES)
        place = _eased(moved)
        to_sensor = cls.camera.inverse()
        feet = to_sensor.apply([_STANDS[0] - place[3], _STANDS[1], 0.0])
        person = replace(Person.from_seed(_PERSON), position=feet[[0, 2]])
        return replace(person.skeleton(moved, to_sensor.apply(place[:3])), time=time)

    @classmethod
    def scene(cls) -> MovingScene:
        """Return the true arm of the person as two moving capsules, without fixtures."""
        moving = _arm()
        return MovingScene(moving.at(0.0), moving.motions)

    @classmethod
    def observer(cls, seed: int = 0) -> PersonObserver:
        """Return the function ``observe`` of a control loop: camera, capsules and tracker.

        Args:
            seed: seed of the camera's errors.
        """
        source = SyntheticSource(
            lambda time: replace(cls.truth(time - LEAD), time=time),
            SkeletonCamera(seed, sigma=_SIGMA),
            _DURATION + LEAD,
            name="reaching person",
        )
        skeletons = (replace(skeleton, time=skeleton.time - LEAD) for skeleton in source)
        return PersonObserver(skeletons, cls.capsules, start=None)


@lru_cache(maxsize=1)
def _arm() -> MovingScene:
    times = np.arange(-LEAD, _MOVES + 0.5 * _STEP, _STEP)
    return moving_arms([ReachingPerson.truth(time) for time in times.tolist()], ReachingPerson.capsules)


def _eased(time: float) -> Array:
    """Return the place of the wrist and the lean at a time, on minimum-jerk lines between the rows of ``_REACHES``."""
    times, places = _REACHES[:, 0], _REACHES[:, 1:]
    k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
    u = float(np.clip((time - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0))
    share = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    return np.asarray(places[k] + share * (places[k + 1] - places[k]))
