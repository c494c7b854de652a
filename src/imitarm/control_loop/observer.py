"""Simulated observation of a moving scene by a camera and a tracker: noisy, late, and with gaps.

:class:`SensorModel` simulates the camera. :class:`TrackedScene` passes the detections to a tracker, and returns the
scene that the tracker estimates. A :class:`TrackedScene` can be the argument ``observe`` of
:func:`~imitarm.control_loop.reproduce`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.perception import Detection
from imitarm.scene import MovingScene, Obstacle, Scene
from imitarm.validation import finite_number, instance, sequence, whole_number

Array = NDArray[np.float64]

HIDDEN = 0.5
"""Duration of one occlusion [s]."""
_FASTEST = 1e4  # [Hz] rate of a sensor; more frames would take too long to simulate
_RAREST = 0.01  # [1/s] occlusions
_LEAST_SIGMA = 1e-3  # [m] a covariance of 0 would make a tracker follow every rounding error
_FRAME, _HIDING = 0, 1  # streams of random numbers
_ROUNDING = 1e-9  # [s] a frame that arrives so much later than now has arrived


class Frame(NamedTuple):
    """The obstacles that the sensor measured at one instant.

    Attributes:
        stamp: time of the measurement [s].
        arrival: time at which the measurement is available [s]; ``stamp`` plus the latency.
        detections: the visible obstacles, in random order and without names.
    """

    stamp: float
    arrival: float
    detections: tuple[Detection, ...]


@dataclass(frozen=True)
class SensorModel:
    r"""A sensor that measures the positions of obstacles with errors, at a fixed rate, and reports them late.

    Frame ``k`` is measured at ``t_k = k / rate`` and arrives at ``t_k + latency``. Obstacles farther than ``reach``
    from the arm's base are never detected. In each frame, each of the other obstacles is missed with the probability
    ``dropout``. If the true position is :math:`p(t_k)`, the measured position of a detected obstacle is

    .. math:: z = p(t_k) + \epsilon, \qquad \epsilon \sim N(0, \sigma^2 I)

    The shape, its size and its rotation are measured without error. Velocities are not measured. During an occlusion,
    which lasts 0.5 s, an obstacle is missed in all frames. Every obstacle has one occlusion in each interval of ``1 /
    occlusions`` seconds, at a random time.

    The seed, the frame's number k and the obstacle's index determine all random numbers. Repeated requests for one
    frame therefore return the same measurements.

    Attributes:
        noise: sigma, the standard deviation of the measured position along each axis [m].
        rate: frames per second, at most 10 000 [Hz].
        latency: delay of each frame [s].
        dropout: probability from 0 to below 1 that an obstacle is missed in a frame.
        occlusions: occlusions of each obstacle per second, from 0.01 to 1 [1/s]; 0: none.
        reach: largest distance from the arm's base to the obstacle's centre [m].
        seed: seed of the random numbers.

    Raises:
        InputError: when a number is out of range.
    """

    noise: float = 0.005
    rate: float = 30.0
    latency: float = 0.033
    dropout: float = 0.0
    occlusions: float = 0.0
    reach: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        name = type(self).__name__
        finite_number(self.noise, f"{name}: noise", "m", at_least=0.0)
        finite_number(self.rate, f"{name}: rate", "Hz", above=0.0, at_most=_FASTEST)
        finite_number(self.latency, f"{name}: latency", "s", at_least=0.0)
        if not 0.0 <= finite_number(self.dropout, f"{name}: dropout") < 1.0:
            raise InputError(f"{name}: dropout must be a probability from 0 to below 1, got {self.dropout!r}")
        occlusions = finite_number(self.occlusions, f"{name}: occlusions", "1/s")
        if occlusions != 0.0 and not _RAREST <= occlusions <= 1.0:
            raise InputError(f"{name}: occlusions must be 0 or from {_RAREST:g} to 1 per second, got {occlusions:g}")
        finite_number(self.reach, f"{name}: reach", "m", above=0.0)
        whole_number(self.seed, f"{name}: seed", at_least=0)

    def frame(self, truth: Scene | MovingScene, k: int) -> Frame:
        """Return frame ``k`` of a scene; negative frames were measured before time 0.

        Args:
            truth: the true obstacles over time.
            k: number of the frame.

        Raises:
            InputError: when ``truth`` is not a scene, or ``k`` is not a whole number.
        """
        k = whole_number(k, "SensorModel.frame: k")
        if not isinstance(truth, Scene | MovingScene):
            raise InputError(f"SensorModel.frame: truth must be a Scene or a MovingScene, got {truth!r}")
        stamp = k / self.rate
        shapes = truth.obstacles if isinstance(truth, Scene) else truth.scene.obstacles
        rng = np.random.default_rng([self.seed, _FRAME, int(k < 0), abs(k)])
        errors, missed = self.noise * rng.normal(size=(len(shapes), 3)), rng.random(len(shapes)) < self.dropout
        positions, quaternions = truth.poses(stamp)
        covariance = max(self.noise, _LEAST_SIGMA) ** 2 * np.eye(3)
        seen = []
        for i in rng.permutation(len(shapes)):
            if missed[i] or np.linalg.norm(positions[i]) > self.reach or self._hidden(int(i), stamp):
                continue
            measured = _anonymous(shapes[i]).placed(positions[i] + errors[i], quaternions[i], np.zeros(3), np.zeros(3))
            seen.append(Detection(measured, covariance))
        return Frame(stamp, stamp + self.latency, tuple(seen))

    def arrived(self, truth: Scene | MovingScene, since: float, until: float) -> Iterator[Frame]:
        """Yield the frames that arrive after ``since`` [s] and up to ``until`` [s], in the order of their stamps."""
        first = math.floor((since - self.latency + _ROUNDING) * self.rate) + 1 if math.isfinite(since) else 0
        last = math.floor((until - self.latency + _ROUNDING) * self.rate)
        for k in range(first, last + 1):
            yield self.frame(truth, k)

    def _hidden(self, obstacle: int, stamp: float) -> bool:
        """Return whether an obstacle is occluded."""
        if self.occlusions == 0.0:
            return False
        interval = 1.0 / self.occlusions
        n = math.floor(stamp / interval)
        begin = np.random.default_rng([self.seed, _HIDING, obstacle, int(n < 0), abs(n)]).uniform(
            0.0, interval - HIDDEN
        )
        return bool(0.0 <= stamp - n * interval - begin < HIDDEN)


@lru_cache(maxsize=256)
def _anonymous(obstacle: Obstacle) -> Obstacle:
    """Return a copy of an obstacle without the attributes that a sensor can't measure, such as name and velocity."""
    zero = np.zeros(3)
    return replace(obstacle, name="", track_id=None, covariance=None, velocity=zero, angular_velocity=zero)


class Tracker(Protocol):
    """The methods of an :class:`~imitarm.perception.ObstacleTracker` that :class:`TrackedScene` uses."""

    def update(self, stamp: float, detections: Sequence[Detection], /) -> object:
        """Update the tracks with the detections of one frame."""

    def scene(self, time: float, *, goal: Pose | None = None, fixtures: Sequence[Obstacle] = ()) -> Scene:
        """Return the scene at ``time``, predicted from all frames received so far."""

    def reset(self) -> None:
        """Delete all tracks."""


def checked_tracker(tracker: Tracker, what: str) -> Tracker:
    """Return ``tracker`` unchanged if it has the methods of :class:`Tracker`.

    Raises:
        InputError: when a method is missing.
    """
    if not all(callable(getattr(tracker, name, None)) for name in ("update", "scene", "reset")):
        raise InputError(f"{what} must be an ObstacleTracker, or have its methods update, scene and reset: {tracker!r}")
    return tracker


class TrackedScene:
    """Tracks a scene from the frames that have arrived; call it as ``observe(t)``.

    The sensor starts ``lead`` seconds before time 0, like a camera that is switched on before the arm moves. The result
    of ``observe(t)`` depends only on ``t``, not on previous calls. If ``t`` is earlier than in the last call, the
    tracker is reset and all frames are replayed.

    Args:
        truth: the true obstacles over time.
        sensor: simulated sensor that measures these obstacles.
        tracker: :class:`~imitarm.perception.ObstacleTracker`, or an object with the methods of :class:`Tracker`.
        goal: goal of the returned scenes.
        fixtures: fixtures (known obstacles that do not move) of the returned scenes.
        lead: time between the start of the sensor and time 0 [s].

    Raises:
        InputError: when an argument has the wrong type, or ``lead`` is negative.
    """

    def __init__(
        self,
        truth: Scene | MovingScene,
        sensor: SensorModel,
        tracker: Tracker,
        *,
        goal: Pose | None = None,
        fixtures: Sequence[Obstacle] = (),
        lead: float = 1.0,
    ) -> None:
        if not isinstance(truth, Scene | MovingScene):
            raise InputError(f"TrackedScene: truth must be a Scene or a MovingScene, got {truth!r}")
        self.truth, self.sensor = truth, instance(sensor, SensorModel, "TrackedScene: sensor")
        self.tracker = checked_tracker(tracker, "TrackedScene: tracker")
        known = Scene(goal, (), 0.0, sequence(fixtures, Obstacle, "TrackedScene: fixtures"))  # type: ignore[type-abstract]
        self._goal, self._fixtures = known.goal, known.fixtures
        self._lead = finite_number(lead, "TrackedScene: lead", "s", at_least=0.0)
        self._until = 0.0
        self._restart()

    def __call__(self, time: float) -> Scene:
        """Return the scene predicted to ``time`` [s] from the frames that have arrived until then."""
        time = finite_number(time, "TrackedScene: time", "s")
        if time < self._until:
            self._restart()
        for frame in self.sensor.arrived(self.truth, self._until, time):
            self.tracker.update(frame.stamp, frame.detections)
        self._until = time
        return self.tracker.scene(time, goal=self._goal, fixtures=self._fixtures)

    def _restart(self) -> None:
        self.tracker.reset()
        self._until = self.sensor.latency - self._lead
