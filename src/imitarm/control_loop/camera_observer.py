"""CameraObserver: combines cameras, a detector and a tracker into the function ``observe`` of a control loop."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from imitarm.control_loop.observer import Tracker, checked_tracker
from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.pose import Pose
from imitarm.perception import DepthFrame, ObstacleDetector, PointCloud
from imitarm.scene import Obstacle, Scene
from imitarm.validation import finite_number, function, instance, sequence

Frame = DepthFrame | PointCloud

_ROUNDING = 1e-9  # [s]
_OTHER_CLOCK = 10.0  # [s] age at which the first image of a camera must come from another clock


class _Waiting(NamedTuple):
    """An image on its way: when it arrives [s], and which camera took it."""

    arrival: float
    frame: Frame
    camera: int


class CameraObserver:
    """Observes a scene with cameras and a tracker; call it as ``observe(t)``.

    At each period of the cameras, every camera takes an image. The image arrives after the latency. Then the detector
    finds the obstacles in the image, and the tracker is updated with these obstacles and the time stamp of the image.
    ``observe(t)`` returns the tracked obstacles, predicted to the time ``t``. A camera may be fixed or on the wrist,
    because each image contains its own pose. The joint positions are recorded at every call. The detector removes the
    arm from each image, and needs the joint positions of the time at which the image was taken.

    **A frozen camera.** Only an image with a later time stamp than the previous image is used. If the newest image is
    older than ``max_age``, the obstacles are no longer predicted, and the scene keeps the stamp of the newest image.
    From this stamp, a watchdog can compute the age of the scene. Before the first image arrives, the scene is empty,
    and its stamp is the time of the first call. With ``Watchdog(from_start=True)``, the arm stops if no image arrives
    within the watchdog's ``stop_after``.

    **Wrong clocks.** An image from the future would hide that a camera is frozen. Therefore, ``observe(t)`` raises
    InputError if the stamp of an image is later than the call by more than ``max_age``. It also does so if the first
    image of a camera is more than 10 s old.

    **A camera that was moved.** Once per second, the surfaces in an image are compared with the known places of these
    surfaces (:meth:`~imitarm.perception.ObstacleDetector.camera_error`). If they are not at their known places in two
    successive comparisons of one camera, ``observe(t)`` raises TaskFailedError. The control loop then brakes the robot.

    The time must not decrease from one call to the next, because a camera can't take images of the past.

    Args:
        cameras: one function for each camera, for example ``DepthCamera.frame``. The function returns a new image, or
            None if there is no new image.
        detector: detector that finds the obstacles in an image.
        tracker: :class:`~imitarm.perception.ObstacleTracker` that receives these obstacles.
        joints: function that returns the current joint positions (n_joints,) [rad]; required if the detector removes an
            arm.
        rate: images per second of each camera [Hz].
        latency: time from the exposure to the arrival of an image [s].
        max_age: age of the newest image at which the cameras count as frozen [s].
        clock: difference between the clocks of images and of calls [s]: the stamp of an image minus the time ``t`` at
            the same instant. For a simulated robot, the difference is the stamp of the scene in which the robot
            started.
        goal: goal of the returned scenes.
        fixtures: fixtures (known obstacles that do not move) of the returned scenes.

    Attributes:
        n_frames: number of images that were used.

    Raises:
        InputError: when an argument can't be used.
    """

    def __init__(
        self,
        cameras: Callable[[], Frame | None] | Sequence[Callable[[], Frame | None]],
        detector: ObstacleDetector,
        tracker: Tracker,
        *,
        joints: Callable[[], ArrayLike] | None = None,
        rate: float = 30.0,
        latency: float = 0.033,
        max_age: float = 0.25,
        clock: float = 0.0,
        goal: Pose | None = None,
        fixtures: Sequence[Obstacle] = (),
    ) -> None:
        name = type(self).__name__
        several = tuple(cameras) if isinstance(cameras, Sequence) else (cameras,)
        self._cameras = tuple(function(camera, f"{name}: camera") for camera in several)
        if not self._cameras:
            raise InputError(f"{name}: cameras must contain at least one camera")
        self.detector = instance(detector, ObstacleDetector, f"{name}: detector")
        if joints is None and detector.arm is not None:
            raise InputError(f"{name}: joints is required, because the detector removes the arm from the images")
        self._joints = None if joints is None else function(joints, f"{name}: joints")
        self.tracker = checked_tracker(tracker, f"{name}: tracker")
        self.rate = finite_number(rate, f"{name}: rate", "Hz", above=0.0)
        self.latency = finite_number(latency, f"{name}: latency", "s", at_least=0.0)
        self.max_age = finite_number(max_age, f"{name}: max_age", "s", above=self.latency)
        self.clock = finite_number(clock, f"{name}: clock", "s")
        known = Scene(goal, (), 0.0, sequence(fixtures, Obstacle, f"{name}: fixtures"))  # type: ignore[type-abstract]
        self._goal, self._fixtures = known.goal, known.fixtures
        self.reset()

    def reset(self) -> None:
        """Forget all images, tracks and joint positions."""
        self.tracker.reset()
        if self.detector.self_filter is not None:
            self.detector.self_filter.reset()
        self.n_frames = 0
        self._waiting: deque[_Waiting] = deque()
        self._taken = [-math.inf] * len(self._cameras)  # stamp of the newest image of each camera
        self._checked = [-math.inf] * len(self._cameras)
        self._doubted = [False] * len(self._cameras)
        self._next, self._now = -math.inf, -math.inf
        self._stamp: float | None = None
        self._first: float | None = None  # time of the first call [s]

    @property
    def stamp(self) -> float | None:
        """Time of the newest image that was used, on the clock of the calls [s]; None before the first image."""
        return self._stamp

    def __call__(self, time: float) -> Scene:
        """Return the scene at ``time`` [s], from the images that have arrived until then.

        Raises:
            InputError: when ``time`` is not a finite number, or is earlier than in the last call.
                Also when a camera returns something else than an image, or an image has the stamp of another clock.
            TaskFailedError: when a camera was moved.
        """
        time = finite_number(time, "CameraObserver: time", "s")
        if time < self._now:
            raise InputError(
                f"CameraObserver: time {time:g} s is earlier than in the last call ({self._now:g} s), but times must "
                "not decrease. Call reset() before a new run"
            )
        self._now = time
        if self._first is None:
            self._first = time
        if self._joints is not None:
            self.detector.record(time + self.clock, self._joints())
        if time >= self._next - _ROUNDING:
            self._take(time)
        while self._waiting and self._waiting[0].arrival <= time + _ROUNDING:
            self._use(self._waiting.popleft())
        newest = self._first if self._stamp is None else self._stamp
        fresh = self._stamp is not None and time - self._stamp <= self.max_age
        return self.tracker.scene(time if fresh else newest, goal=self._goal, fixtures=self._fixtures)

    def _take(self, time: float) -> None:
        """Let every camera take an image, and plan the next."""
        start = time if math.isinf(self._next) else self._next
        periods = np.floor((time - start) * self.rate + _ROUNDING) + 1.0
        self._next = start + float(periods) / self.rate
        for i, camera in enumerate(self._cameras):
            frame = camera()
            if frame is None:
                continue
            if not isinstance(frame, DepthFrame | PointCloud):
                raise InputError(
                    f"CameraObserver: camera {i + 1} must return a DepthFrame, a PointCloud or None, got {frame!r}"
                )
            if frame.stamp > self._taken[i]:
                self._check_clock(time, frame, i)
                self._taken[i] = frame.stamp
                self._waiting.append(_Waiting(time + self.latency, frame, i))

    def _check_clock(self, time: float, frame: Frame, camera: int) -> None:
        """Reject an image from the future, and a first image that is too old: their clock differs from the calls'."""
        age = time + self.clock - frame.stamp
        first = math.isinf(self._taken[camera])
        if age < -self.max_age or (first and age > _OTHER_CLOCK):
            raise InputError(
                f"CameraObserver: an image of camera {camera + 1} has the stamp {frame.stamp:.3f} s, {abs(age):.3g} s "
                f"{'after' if age < 0.0 else 'before'} the time of the call; set clock to the difference between the "
                "clocks of images and of calls, or correct the camera's clock"
            )

    def _use(self, waiting: _Waiting) -> None:
        """Find the obstacles in an image that has arrived, and give them to the tracker."""
        frame, camera = waiting.frame, waiting.camera
        self._check(frame, camera)
        stamp = frame.stamp - self.clock
        self.tracker.update(stamp, self.detector.detect(frame))
        self._stamp = stamp if self._stamp is None else max(stamp, self._stamp)
        self.n_frames += 1

    def _check(self, frame: Frame, camera: int) -> None:
        """Check once per second that the camera is at its place."""
        if frame.stamp < self._checked[camera] + 1.0:
            return
        self._checked[camera] = frame.stamp
        error = self.detector.camera_error(frame)
        if error and self._doubted[camera]:
            raise TaskFailedError(f"camera {camera + 1}: {error}")
        self._doubted[camera] = bool(error)
