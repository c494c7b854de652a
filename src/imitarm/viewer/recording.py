"""Recording of a simulation for the 3-D playback: the poses of all bodies, and the predictions of a tracker.

:class:`FrameRecorder` records poses and predictions at a fixed rate while the simulation runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene import Scene

Array = NDArray[np.float64]

AHEAD = 0.3
"""Time from an observation to the instant for which the playback shows the obstacle's predicted position [s]."""
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Prediction:
    """Positions of one obstacle that a tracker predicted, in each frame for :data:`AHEAD` seconds later.

    Attributes:
        name: name of the obstacle in the scenes that the tracker returned.
        positions: predicted positions of the obstacle's local frame, shape (n_frames, 3) [m]; nan in frames without the
            obstacle.
        covariances: covariances of these positions, shape (n_frames, 3, 3) [m^2].
        extent: half extents of the obstacle along the axes of its local frame, shape (3,) [m].
        quaternions: predicted rotations wxyz of the local frame, shape (n_frames, 4); None: the obstacle does not
            rotate.
    """

    name: str
    positions: Array
    covariances: Array
    extent: Array
    quaternions: Array | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """The poses of all bodies of a model, frame by frame.

    Attributes:
        model: the MuJoCo model that contains the bodies.
        times: times of the frames, strictly increasing, shape (n_frames,) [s].
        positions: body positions in the world frame, shape (n_frames, n_bodies, 3) [m].
        quaternions: body rotations wxyz in the world frame, shape (n_frames, n_bodies, 4).
        predictions: predicted positions of the tracked obstacles, one :class:`Prediction` for each obstacle.

    Raises:
        InputError: when shapes disagree, a number is not finite or the times do not increase.
    """

    model: mujoco.MjModel
    times: Array
    positions: Array
    quaternions: Array
    predictions: tuple[Prediction, ...] = ()

    def __post_init__(self) -> None:
        n, bodies = len(np.atleast_1d(self.times)), self.model.nbody
        for name, shape in (("times", (n,)), ("positions", (n, bodies, 3)), ("quaternions", (n, bodies, 4))):
            array = np.array(getattr(self, name), dtype=float)
            if array.shape != shape or not np.isfinite(array).all():
                raise InputError(f"Recording {name}: needs finite numbers of shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for prediction in self.predictions:
            if len(prediction.positions) != n:
                raise InputError(
                    f"Recording predictions: {prediction.name} has {len(prediction.positions)} positions, but needs "
                    f"{n}, one for each frame"
                )
        if n < 1 or np.any(np.diff(self.times) <= 0.0):
            raise InputError(
                "Recording times: needs at least one frame, and each frame must be later than the previous one"
            )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return float(self.times[-1] - self.times[0])


class FrameRecorder:
    """Records the poses of all bodies while a simulation runs, at most ``rate`` times per second."""

    def __init__(self, model: mujoco.MjModel, *, rate: float = 25.0) -> None:
        """Create a recorder that contains no frames yet.

        Args:
            model: the model that will be simulated.
            rate: frames per second of simulated time [1/s].

        Raises:
            InputError: when ``rate`` is not positive.
        """
        if not rate > 0.0:
            raise InputError(f"FrameRecorder: rate must be positive [1/s], got {rate!r}")
        self.model = model
        self._period = 1.0 / rate
        self._frames: list[tuple[float, Array, Array]] = []
        self._seen: list[Scene | None] = []

    def note(self, data: mujoco.MjData, time: float | None = None, *, scene: Scene | None = None) -> None:
        """Record the current poses if the next frame is due; call this method after every simulated step.

        Args:
            data: the state of the simulation, in which the body poses are up to date.
            time: simulated time [s]; None: ``data.time``.
            scene: the scene that a tracker returned; the playback shows the predicted positions of its obstacles.
        """
        now = float(data.time if time is None else time)
        if not self._frames or now >= self._frames[-1][0] + self._period - 1e-9:
            self._frames.append((now, np.array(data.xpos), np.array(data.xquat)))
            self._seen.append(scene)

    def recording(self) -> Recording:
        """Return the recorded frames.

        Raises:
            InputError: when no frame was recorded.
        """
        if not self._frames:
            raise InputError("FrameRecorder: no frame was recorded; call note(data) after every simulated step")
        times, positions, quaternions = zip(*self._frames, strict=True)
        return Recording(
            self.model, np.array(times), np.array(positions), np.array(quaternions), _predictions(self._seen)
        )


def _predictions(seen: list[Scene | None]) -> tuple[Prediction, ...]:
    """Return the predictions of all tracks in the observed scenes, one scene or None for each frame."""
    found: dict[int, Prediction] = {}
    for frame, scene in enumerate(seen):
        if scene is None:
            continue
        ahead, rotations = scene.poses(scene.stamp + AHEAD)
        for i, number in enumerate(scene.packed.track_ids.tolist()):
            if number < 0:
                continue
            if number not in found:
                upright = scene.obstacles[i].placed(np.zeros(3), _NO_ROTATION, np.zeros(3), np.zeros(3))
                extent = 0.5 * np.ptp(upright.bounds(), axis=0)
                positions, covariances = np.full((len(seen), 3), np.nan), np.zeros((len(seen), 3, 3))
                quaternions = np.tile(_NO_ROTATION, (len(seen), 1))
                found[number] = Prediction(scene.name_of(i), positions, covariances, extent, quaternions)
            found[number].positions[frame] = ahead[i]
            turned = found[number].quaternions
            assert turned is not None
            turned[frame] = rotations[i]
            found[number].covariances[frame] = scene.packed.covariances[i]
    return tuple(found.values())
