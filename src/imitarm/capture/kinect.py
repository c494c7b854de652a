"""Kinect v2 and Azure Kinect: cameras whose drivers track bodies."""

from __future__ import annotations

import contextlib
import importlib
import io
import time as clock
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from imitarm.capture.skeleton import JOINTS, SIDES, HandState, Skeleton, SkeletonSource, Tracking
from imitarm.errors import InputError, TaskFailedError

INSTEAD = (
    "alternatives: record a Kinect SDK table on another machine and open the file, receive skeletons from another "
    "machine with udp:PORT, or use webcam:NUMBER or video:FILE"
)
"""What a user can do when a camera can't be opened."""

_SILENT = 3.0  # [s] without a frame: the camera is gone, since it sends frames with or without a person
_LONGEST_WAIT = 0.5  # [s] for one call of the driver, so that Ctrl-C is noticed


class BodyCamera(SkeletonSource):
    """A camera whose driver computes the joint positions of every person in view.

    Attributes:
        name: name of the camera in messages.
    """

    live = True

    def __init__(self) -> None:
        self._waiting: deque[Skeleton] = deque()
        self._over, self._silent = False, 0.0
        self._numbers: dict[int, int] = {}

    @abstractmethod
    def _frame(self, timeout: float) -> list[Skeleton] | None:
        """Return all bodies of the next frame, or None when no frame arrived within ``timeout`` seconds.

        Raises:
            TaskFailedError: when the driver reports a failure.
        """

    def _release(self) -> None:
        """Release the device."""

    @property
    def over(self) -> bool:
        """Whether the source was closed, by :meth:`close` or because the camera failed."""
        return self._over

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        if not self._over:
            self._over = True
            self._release()

    def read(self, timeout: float = 1.0) -> Skeleton | None:
        """Return the next skeleton; None if none arrives within ``timeout`` seconds, or if the source was closed.

        Raises:
            TaskFailedError: when the driver fails, or when no frame arrives for 3 s, for example because the camera was
                unplugged.
        """
        until = clock.monotonic() + timeout
        while not self._over and not self._waiting:
            began = clock.monotonic()
            if not self._take(min(max(until - began, 0.0), _LONGEST_WAIT)):
                self._silent += clock.monotonic() - began
                if self._silent > _SILENT:
                    raise self._failed(f"no frames for {_SILENT:g} s; is the camera still plugged in?")
            if clock.monotonic() >= until:
                break
        return self._waiting.popleft() if self._waiting and not self._over else None

    def _take(self, timeout: float) -> bool:
        """Fetch the next frame; return whether a frame was available."""
        bodies = self._frame(timeout)
        if bodies is None:
            return False
        self._silent = 0.0
        self._waiting.extend(bodies)
        return True

    def _wait_for_first(self, seconds: float, missing: str) -> None:
        """Wait until the camera delivers its first frame.

        Raises:
            InputError: when no frame arrived within ``seconds``, or the driver fails; the camera is released first.
        """
        until = clock.monotonic() + seconds
        try:
            while not self._take(_LONGEST_WAIT):
                if clock.monotonic() >= until:
                    raise InputError(f"{self.name}: no frame within {seconds:g} s; {missing}; {INSTEAD}")
        except TaskFailedError as error:
            raise InputError(f"{error}; {missing}; {INSTEAD}") from error
        except BaseException:
            self.close()
            raise

    def _number(self, driver_id: int) -> int:
        """Return the person's number for the driver's body number; persons are numbered from 0 as they appear."""
        return self._numbers.setdefault(int(driver_id), len(self._numbers))

    def _failed(self, why: str) -> TaskFailedError:
        """Close the camera and return the error to raise."""
        self.close()
        return TaskFailedError(f"{self.name}: {why}")


# --- Kinect v2

_V2_NEEDS = (
    "a Kinect v2 needs 64-bit Windows, the Kinect for Windows SDK 2.0, a USB 3 port, and the package kinect-next "
    "(pip install kinect-next)"
)
_V2_START = 10.0  # [s] within which the first frame must come: a cold camera takes 1 to 3


class KinectV2Source(BodyCamera):
    """Skeletons of all persons in front of a Kinect v2, with the states of their hands.

    The coordinate frame and the joints of the SDK are those of :class:`~imitarm.capture.skeleton.Skeleton`. If the SDK
    does not report high confidence in a hand state, the hand state is unknown. The sensor's clock provides the times of
    the skeletons.

    This class was written from the documentation of `kinect-next` 3.0 and has not been tested with a real camera.

    Raises:
        InputError: when the driver or the camera is missing; the message names the missing part and says what to do.
        TaskFailedError: from :meth:`read`, when the camera is unplugged or the driver fails.
    """

    name = "kinect2"
    description = "all persons in front of a Kinect v2"

    def __init__(self) -> None:
        super().__init__()
        try:
            self._driver: Any = importlib.import_module("kinect_next")
        except ImportError as error:
            raise InputError(f"{self.name}: there is no driver ({error}); {_V2_NEEDS}; {INSTEAD}") from error
        try:
            self._sensor = self._driver.KinectSensor(self._driver.StreamType.BODY)
        except (self._driver.KinectError, OSError) as error:
            raise InputError(f"{self.name}: can't be opened ({error}); {_V2_NEEDS}; {INSTEAD}") from error
        self._wait_for_first(_V2_START, "is the camera connected to this computer and to its power supply")

    def _frame(self, timeout: float) -> list[Skeleton] | None:
        try:
            frames = self._sensor.wait_for_frames(max(int(1000.0 * timeout), 1))
        except self._driver.KinectTimeoutError:
            return None
        except (self._driver.KinectError, OSError) as error:
            raise self._failed(f"the driver fails: {error}") from error
        time = 1e-9 * frames.relative_time_ns
        return [self._skeleton(time, body) for body in frames.tracked_bodies]

    def _skeleton(self, time: float, body: Any) -> Skeleton:
        joints = [body.joints[i] for i in range(len(JOINTS))]  # in the order of JOINTS
        return Skeleton(
            time,
            np.array([(joint.position.x, joint.position.y, joint.position.z) for joint in joints]),
            np.array([int(joint.tracking_state) for joint in joints], dtype=np.int8),
            (self._hand(body.hand_left), self._hand(body.hand_right)),
            self._number(body.tracking_id),
        )

    def _hand(self, hand: Any) -> HandState:
        state = HandState(int(hand.state))
        sure = int(hand.confidence) == int(self._driver.TrackingConfidence.HIGH)
        return state if sure or state == HandState.NOT_TRACKED else HandState.UNKNOWN

    def _release(self) -> None:
        self._sensor.close()


# --- Azure Kinect

_AZURE_NEEDS = (
    "an Azure Kinect needs the Azure Kinect Sensor SDK 1.4, the Body Tracking SDK 1.1, and the package pykinect-azure "
    "(pip install pykinect-azure)"
)
_AZURE_START = 40.0  # [s] within which the first frame must come: the tracker loads its network first
_N_JOINTS = 32
_TRACKING = np.array([Tracking.LOST, Tracking.INFERRED, Tracking.TRACKED, Tracking.TRACKED], dtype=np.int8)


def _joint_indices() -> tuple[tuple[int, ...], ...]:
    """Return, for each of the 25 joints of a skeleton, the SDK joints whose mean position is the joint's position."""
    named: dict[str, tuple[int, ...]] = {"spine_base": (0,), "spine_mid": (1,), "spine_shoulder": (4, 11)}
    named |= {"neck": (3,), "head": (26,)}  # spine_shoulder: between the clavicles
    arm = ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")
    for side, first_arm, first_leg in zip(SIDES, (5, 12), (18, 22), strict=True):
        named |= {f"{part}_{side}": (first_arm + i,) for i, part in enumerate(arm)}
        named |= {f"{part}_{side}": (first_leg + i,) for i, part in enumerate(("hip", "knee", "ankle", "foot"))}
    return tuple(named[joint] for joint in JOINTS)


_FROM = _joint_indices()


class AzureKinectSource(BodyCamera):
    """Skeletons of all persons in front of an Azure Kinect.

    The SDK's 32 joints are converted to the 25 joints of the Kinect v2. The positions are converted from the depth
    camera's frame (x right, y down, millimetres) to the frame of :class:`~imitarm.capture.skeleton.Skeleton`. The SDK
    does not detect whether a hand is open or closed, so hand states are unknown. The camera's clock provides the times
    of the skeletons.

    When the SDK fails, this class raises an error, whereas `pykinect-azure` would end the program. This class fetches
    frames with the C functions of the SDK, because these functions distinguish a late frame from a failure.

    This class was written from the documentation of the SDKs and has not been tested with a real camera.

    Raises:
        InputError: when the driver, the SDK or the camera is missing; the message names the missing part and says what
            to do.
        TaskFailedError: from :meth:`read`, when the camera is unplugged or the driver fails.
    """

    name = "azure"
    description = "all persons in front of an Azure Kinect"

    def __init__(self) -> None:
        super().__init__()
        try:
            driver: Any = importlib.import_module("pykinect_azure")
            self._k4a: Any = importlib.import_module("pykinect_azure.k4a._k4a")
            self._k4abt: Any = importlib.import_module("pykinect_azure.k4abt._k4abt")
        except ImportError as error:
            raise InputError(f"{self.name}: there is no driver ({error}); {_AZURE_NEEDS}; {INSTEAD}") from error
        self._device: Any = None
        self._tracker: Any = None
        self._pending = False  # an image was given to the tracker, its bodies have not come yet
        try:
            self._opened(driver)
        except BaseException:
            self.close()
            raise
        self._wait_for_first(_AZURE_START, "can the body tracking SDK use a graphics card or, more slowly, the CPU")

    def _opened(self, driver: Any) -> None:
        self._call_driver("find the SDKs", lambda: driver.initialize_libraries(track_body=True))
        if self._k4a.k4a_device_get_installed_count() < 1:
            raise InputError(f"{self.name}: no Azure Kinect is plugged in; {_AZURE_NEEDS}; {INSTEAD}")
        settings = driver.Configuration()
        settings.color_resolution = driver.K4A_COLOR_RESOLUTION_OFF
        settings.depth_mode = driver.K4A_DEPTH_MODE_NFOV_UNBINNED
        settings.camera_fps = driver.K4A_FRAMES_PER_SECOND_30
        self._device = self._call_driver("open the camera", lambda: driver.start_device(config=settings))
        self._tracker = self._call_driver("start body tracking", driver.start_body_tracker)

    def _call_driver(self, what: str, call: Callable[[], Any]) -> Any:
        """Call the driver; where the driver would print a message and end the program, raise an error instead."""
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                return call()
        except (SystemExit, OSError, AttributeError) as error:
            lines = said.getvalue().strip().splitlines()
            why = lines[0] if lines else str(error)
            raise InputError(f"{self.name}: could not {what} ({why}); {_AZURE_NEEDS}; {INSTEAD}") from error

    def _frame(self, timeout: float) -> list[Skeleton] | None:
        wait = max(int(1000.0 * timeout), 1)
        if not self._pending and not self._give(wait):
            return None
        frame = self._k4abt.k4abt_frame_t()
        if not self._came(self._k4abt.k4abt_tracker_pop_result(self._tracker.handle(), frame, wait), "track bodies"):
            return None
        self._pending = False
        try:
            return self._bodies(frame)
        finally:
            self._k4abt.k4abt_frame_release(frame)

    def _give(self, wait: int) -> bool:
        """Pass the next image to the tracker; return whether an image arrived in time."""
        capture = self._k4a.k4a_capture_t()
        result = self._k4a.k4a_device_get_capture(self._device.handle(), capture, wait)
        if not self._came(result, "get an image; is the camera still plugged in?"):
            return False
        try:
            result = self._k4abt.k4abt_tracker_enqueue_capture(self._tracker.handle(), capture, wait)
        finally:
            self._k4a.k4a_capture_release(capture)
        self._pending = self._came(result, "pass an image to body tracking")
        return self._pending

    def _came(self, result: int, what: str) -> bool:
        """Return whether a call of the SDK succeeded; False when it timed out.

        Raises:
            TaskFailedError: when the driver reports a failure.
        """
        if result == self._k4a.K4A_WAIT_RESULT_TIMEOUT:
            return False
        if result != self._k4a.K4A_WAIT_RESULT_SUCCEEDED:
            raise self._failed(f"the SDK could not {what}")
        return True

    def _bodies(self, frame: Any) -> list[Skeleton]:
        time = 1e-6 * self._k4abt.k4abt_frame_get_device_timestamp_usec(frame)
        found = []
        for i in range(self._k4abt.k4abt_frame_get_num_bodies(frame)):
            body = self._k4abt.k4abt_skeleton_t()
            if self._k4abt.k4abt_frame_get_body_skeleton(frame, i, body) != self._k4a.K4A_WAIT_RESULT_SUCCEEDED:
                continue
            number = self._number(self._k4abt.k4abt_frame_get_body_id(frame, i))
            found.append(_skeleton(time, body, number))
        return found

    def _release(self) -> None:
        for part, end in ((self._tracker, "destroy"), (self._device, "close")):
            if part is not None:
                with contextlib.suppress(SystemExit, OSError):
                    getattr(part, end)()


def _skeleton(time: float, body: Any, person: int) -> Skeleton:
    """Return a body of the SDK as a skeleton."""
    joints = [body.joints[i] for i in range(_N_JOINTS)]
    points = np.array([(j.position.xyz.x, j.position.xyz.y, j.position.xyz.z) for j in joints])
    known = _TRACKING[np.clip([int(j.confidence_level) for j in joints], 0, 3)]
    points = points * (-0.001, -0.001, 0.001)  # from mm, x right and y down, to m, x left and y up
    return Skeleton(
        time,
        np.array([points[list(index)].mean(axis=0) for index in _FROM]),
        np.array([known[list(index)].min() for index in _FROM], dtype=np.int8),
        person=person,
    )
