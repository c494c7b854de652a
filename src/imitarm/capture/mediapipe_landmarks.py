r"""From MediaPipe's 33 landmarks to a Skeleton: the same joints, the sensor's axes, and where the person stands.

MediaPipe gives each landmark twice: in the picture, and in metres about the middle of the hips (x to the picture's
right, y down, z away), as seen by a camera that looks straight at the person. A camera's left is its picture's left, so
a sensor's axes (x to its left, y up, z away) are MediaPipe's turned by half a turn about z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import JOINTS, SIDES, Skeleton, Tracking
from imitarm.errors import InputError

Array = NDArray[np.float64]

N_LANDMARKS = 33
FIELD_OF_VIEW = 60.0  # [deg] of the longer side of the picture: phones and webcams have 55 to 70
TRACKED, INFERRED = 0.5, 0.1  # least visibility of a landmark for its joint to be tracked, inferred
DEPTH_MEMORY = 0.1  # [s] over which the distance is averaged
_GAP = 0.5  # [s] after which the distance before says nothing
_NEAREST, _FARTHEST = 0.3, 15.0  # [m] of a person whom a camera shows
_TIP = 1.8  # a finger tip is so much farther from the wrist than the knuckles are
_FITTED = np.array([11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28])  # shoulders to wrists, hips to ankles
_TURNS = 3  # place and line of sight depend on each other: after three rounds to a millimetre
_LEAST_WEIGHT = 2.0  # sum of the visibilities of the landmarks that place a person


def _joint_weights() -> Array:
    """Return what makes joints from landmarks: joints = weights @ landmarks, shape (25, 33)."""
    mixed: dict[str, dict[int, float]] = {
        "spine_base": {23: 0.5, 24: 0.5},
        "spine_mid": {11: 0.25, 12: 0.25, 23: 0.25, 24: 0.25},
        "spine_shoulder": {11: 0.5, 12: 0.5},
        "neck": {11: 1 / 3, 12: 1 / 3, 7: 1 / 6, 8: 1 / 6},  # a third of the way from the shoulders to the head
        "head": {7: 0.5, 8: 0.5},  # between the ears
    }
    for i, side in enumerate(SIDES):
        wrist, little, index = 15 + i, 17 + i, 19 + i
        named = {"shoulder": 11, "elbow": 13, "wrist": 15, "thumb": 21, "hip": 23, "knee": 25, "ankle": 27, "foot": 31}
        mixed |= {f"{part}_{side}": {first + i: 1.0} for part, first in named.items()}
        mixed[f"hand_{side}"] = {wrist: 0.2, little: 0.4, index: 0.4}  # the palm, short of the knuckles
        mixed[f"hand_tip_{side}"] = {wrist: 1.0 - _TIP, little: 0.5 * _TIP, index: 0.5 * _TIP}
    weights = np.zeros((len(JOINTS), N_LANDMARKS))
    for row, name in enumerate(JOINTS):
        for landmark, weight in mixed[name].items():
            weights[row, landmark] = weight
    return weights


_WEIGHTS = _joint_weights()
_USED = _WEIGHTS != 0.0
_TO_SENSOR = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Landmarks:
    """What MediaPipe found in one picture.

    Attributes:
        time: of the picture [s].
        world: about the middle of the hips, x to the picture's right, y down, z away, shape (33, 3) [m].
        image: in the picture, 0 to 1 from the left and from the top, shape (33, 2); outside when not in view.
        visibility: of each, 0 to 1, shape (33,).

    Raises:
        InputError: when a shape is wrong or a value is not finite.
    """

    time: float
    world: Array
    image: Array
    visibility: Array

    def __post_init__(self) -> None:
        n = N_LANDMARKS
        if self.world.shape != (n, 3) or self.image.shape != (n, 2) or self.visibility.shape != (n,):
            raise InputError(f"Landmarks: there must be {n} of them, with 3, 2 and 1 numbers each")
        finite = all(np.isfinite(part).all() for part in (self.time, self.world, self.image, self.visibility))
        if not finite:
            raise InputError("Landmarks: all numbers must be finite")


class LandmarkConverter:
    r"""Makes skeletons of landmarks.

    **Where the person stands.** MediaPipe's metres know no place: a hip that moves would move a hand that is at rest.
    The place is what makes landmarks and picture agree; with picture coordinates :math:`u, v` from the middle, in units
    of the focal length, and :math:`k` the visibility,

    .. math:: \min_t \sum_j k_j^2 \left( (X_j + t_x - u_j (Z_j + t_z))^2 + (Y_j + t_y - v_j (Z_j + t_z))^2 \right)

    which is linear in t. Across the line of sight it is good to centimetres. Along it, it is as good as MediaPipe's
    metres and the field of view, and trembles; so the distance is averaged over 0.1 s before x and y are fitted again.
    All joints move by the same t: what one joint is, seen from another, is not touched by it.

    **Perspective.** The metres are as if the camera looked straight at the person. They are turned by the angle between
    the line of sight to the hips and the camera's axis.

    Args:
        size: width and height of the picture [pixels]; only their ratio counts.
        field_of_view: of the longer side [deg].

    Raises:
        InputError: when the size or the field of view is that of no camera.
    """

    def __init__(self, size: tuple[int, int], field_of_view: float = FIELD_OF_VIEW) -> None:
        if not (min(size) > 0 and 10.0 <= field_of_view <= 150.0):
            raise InputError(
                f"LandmarkConverter: needs a picture and a field of view of 10 to 150 degrees, got {size} and "
                f"{field_of_view!r}"
            )
        focal = 0.5 * max(size) / math.tan(math.radians(0.5 * field_of_view))
        self._scale = np.array(size, dtype=float) / focal
        self._distance: tuple[float, float] | None = None  # time and t_z of the picture before

    def skeleton(self, landmarks: Landmarks) -> Skeleton | None:
        """Return the skeleton; None when the picture does not show enough of the person to tell where that is.

        A joint is tracked, inferred or lost by the least visibility of the landmarks that it is made of; one outside
        the picture is inferred at best. MediaPipe does not tell open hands from closed ones: both are unknown.
        """
        uv = (landmarks.image - 0.5) * self._scale
        world, place = landmarks.world, None
        for _ in range(_TURNS):
            place = self._fit(world, uv, landmarks.visibility)
            if place is None:
                self._distance = None
                return None
            world = landmarks.world @ _turn_towards(place).T
        assert place is not None
        depth = self._steadied(landmarks.time, place[2])
        weight = np.square(landmarks.visibility[_FITTED])[:, None]
        seen = uv[_FITTED] * (world[_FITTED, 2:] + depth) - world[_FITTED, :2]
        across = (weight * seen).sum(axis=0) / weight.sum()
        positions = _WEIGHTS @ (world + np.append(across, depth))
        return Skeleton(landmarks.time, positions * _TO_SENSOR, _tracking(landmarks))

    @staticmethod
    def _fit(world: Array, uv: Array, visibility: Array) -> Array | None:
        """Return the translation from the hips to the camera, shape (3,) [m]; None when there is none that fits."""
        weight = visibility[_FITTED]
        if weight.sum() < _LEAST_WEIGHT:
            return None
        u, x = uv[_FITTED], world[_FITTED]
        n = len(_FITTED)
        rows, sides = np.zeros((2, n, 3)), np.empty((2, n))
        for axis in (0, 1):
            rows[axis, :, axis] = weight
            rows[axis, :, 2] = -weight * u[:, axis]
            sides[axis] = weight * (u[:, axis] * x[:, 2] - x[:, axis])
        place = np.linalg.lstsq(rows.reshape(-1, 3), sides.ravel(), rcond=None)[0]
        if not _NEAREST <= place[2] <= _FARTHEST:
            return None
        return np.asarray(place)

    def _steadied(self, time: float, depth: float) -> float:
        """Return the distance averaged over the last pictures [m]."""
        if self._distance is not None and 0.0 < time - self._distance[0] <= _GAP:
            before, past = self._distance
            depth = past + (1.0 - math.exp(-(time - before) / DEPTH_MEMORY)) * (depth - past)
        self._distance = (time, depth)
        return depth


def _turn_towards(place: Array) -> Array:
    """Return the rotation that takes the camera's axis to the line of sight to a place, shape (3, 3)."""
    x, y, z = place / math.sqrt(float(place @ place))
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + z))


def _tracking(landmarks: Landmarks) -> NDArray[np.int8]:
    """Return how each joint is known, shape (25,)."""
    inside = ((landmarks.image >= 0.0) & (landmarks.image <= 1.0)).all(axis=1)
    known = (landmarks.visibility >= INFERRED).astype(np.int8)
    known += (landmarks.visibility >= TRACKED) & inside
    return np.asarray(np.where(_USED, known, Tracking.TRACKED).min(axis=1), dtype=np.int8)
