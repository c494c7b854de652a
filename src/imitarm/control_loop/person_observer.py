"""PersonObserver: a person's arms as obstacles of a control loop. CombinedObserver: several observers as one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from imitarm.capture.skeleton import Skeleton
from imitarm.control_loop.observer import Tracker, checked_tracker
from imitarm.errors import InputError
from imitarm.perception import ObstacleTracker, PersonCapsules
from imitarm.scene import Scene
from imitarm.validation import finite_number, function, instance

PERSON_NOISE = 2.0
"""Process noise of a tracker for a person's arms [m^2/s^3]. The value is larger than for objects, because hands
accelerate more. With this value, the tracker loses no arm in the Kinect recordings of gestures."""

_ROUNDING = 1e-9  # [s]


class PersonObserver:
    """Observes the arms of a person with a skeleton camera and a tracker; call it as ``observe(t)``.

    A skeleton that was measured at time ``s`` arrives at ``s + latency``. Then the tracker is updated with the capsules
    of the skeleton and the stamp ``s``. ``observe(t)`` returns the tracked capsules, predicted to the time ``t``. If
    the newest skeleton is older than ``max_age``, the scene keeps the stamp of this skeleton. From this stamp, a
    watchdog can compute the age of the scene. The time must not decrease from one call to the next.

    Args:
        skeletons: skeletons in the order of their times: a :class:`~imitarm.capture.skeleton.SkeletonSource` or any
            other iterable. Each call of ``observe(t)`` reads skeletons until it finds one that has not yet arrived.
        capsules: object that converts each skeleton to capsules that enclose the person's arms.
        tracker: :class:`~imitarm.perception.ObstacleTracker` that no other observer uses; None: a new tracker with
            :data:`PERSON_NOISE`.
        latency: time from the exposure to the arrival of a skeleton [s].
        max_age: age of the newest skeleton at which the camera counts as frozen [s].
        start: time of the first skeleton on the clock of ``observe(t)`` [s]; the times of all skeletons are shifted
            accordingly. None: the times are not shifted.

    Attributes:
        n_skeletons: number of skeletons that were used.

    Raises:
        InputError: when an argument can't be used.
    """

    def __init__(
        self,
        skeletons: Iterable[Skeleton],
        capsules: PersonCapsules,
        tracker: Tracker | None = None,
        *,
        latency: float = 0.033,
        max_age: float = 0.25,
        start: float | None = 0.0,
    ) -> None:
        name = type(self).__name__
        self.capsules = instance(capsules, PersonCapsules, f"{name}: capsules")
        given = ObstacleTracker(process_noise=PERSON_NOISE) if tracker is None else tracker
        self.tracker = checked_tracker(given, f"{name}: tracker")
        self.latency = finite_number(latency, f"{name}: latency", "s", at_least=0.0)
        self.max_age = finite_number(max_age, f"{name}: max_age", "s", above=self.latency)
        try:
            self._skeletons: Iterator[Skeleton] = iter(skeletons)
        except TypeError as error:
            raise InputError(f"{name}: skeletons must be an iterable of skeletons, got {skeletons!r}") from error
        self._start = None if start is None else finite_number(start, f"{name}: start", "s")
        self._shift: float | None = 0.0 if start is None else None
        self._waiting: Skeleton | None = None
        self._stamp: float | None = None
        self._now = -math.inf
        self.n_skeletons = 0
        self.tracker.reset()

    def __call__(self, time: float) -> Scene:
        """Return the scene at ``time`` [s], from the skeletons that have arrived until then.

        Raises:
            InputError: when ``time`` is not a finite number, or is earlier than in the last call. Also when an item of
                ``skeletons`` is not a Skeleton.
        """
        time = finite_number(time, "PersonObserver: time", "s")
        if time < self._now:
            raise InputError(
                f"PersonObserver: time {time:g} s is earlier than in the last call ({self._now:g} s), but times must "
                "not decrease. Make a new PersonObserver for a new run"
            )
        self._now = time
        while (stamp := self._next_stamp()) is not None and stamp + self.latency <= time + _ROUNDING:
            assert self._waiting is not None
            self.tracker.update(stamp, self.capsules.detections(self._waiting))
            self._waiting, self._stamp = None, stamp if self._stamp is None else max(stamp, self._stamp)
            self.n_skeletons += 1
        fresh = self._stamp is None or time - self._stamp <= self.max_age
        return self.tracker.scene(time if fresh or self._stamp is None else self._stamp)

    def _next_stamp(self) -> float | None:
        """Return the time of the next skeleton on the clock of the calls; None at the end."""
        if self._waiting is None:
            self._waiting = next(self._skeletons, None)
            if self._waiting is None:
                return None
            instance(self._waiting, Skeleton, "PersonObserver: an item of skeletons")
        if self._shift is None:
            self._shift = (self._start or 0.0) - self._waiting.time
        return self._waiting.time + self._shift


class CombinedObserver:
    """Combines several observers, for example a depth camera for objects and a skeleton camera for people.

    The scene contains the obstacles of all observers. The stamp of the scene is the oldest stamp of all observers, so
    that a watchdog notices even a single frozen camera. With n observers, track ``id`` of observer ``i`` gets the
    unique number ``n * id + i``.

    Args:
        observers: functions ``observe(t)``; the first function determines the goal and the fixtures of the scene.

    Raises:
        InputError: when there is no observer, or one is not a function.
    """

    def __init__(self, *observers: Callable[[float], Scene]) -> None:
        if not observers:
            raise InputError("CombinedObserver: give at least one observer")
        self._observers = tuple(function(observer, "CombinedObserver: observer") for observer in observers)

    def __call__(self, time: float) -> Scene:
        """Return the obstacles of all observers at ``time`` [s].

        Raises:
            InputError: when ``time`` is not a finite number, or an observer does not return a Scene.
        """
        time = finite_number(time, "CombinedObserver: time", "s")
        scenes = [
            instance(observe(time), Scene, "CombinedObserver: an observer's scene") for observe in self._observers
        ]
        stamp = min(scene.stamp for scene in scenes)
        n, obstacles = len(scenes), []
        for i, scene in enumerate(scenes):
            for obstacle in scene.now(stamp).obstacles:
                number = obstacle.track_id
                obstacles.append(obstacle if number is None else replace(obstacle, track_id=n * number + i))
        return Scene(scenes[0].goal, tuple(obstacles), stamp, scenes[0].fixtures)
