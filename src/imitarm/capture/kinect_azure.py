"""AzureKinectSource: skeletons of an Azure Kinect, by Microsoft's sensor and body tracking SDKs."""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from imitarm.capture.body_camera import INSTEAD, BodyCamera
from imitarm.capture.skeleton import JOINTS, SIDES, Skeleton, Tracking
from imitarm.errors import InputError

_NEEDED = (
    "an Azure Kinect needs the Azure Kinect Sensor SDK 1.4, the Body Tracking SDK 1.1, and the package pykinect-azure "
    "(pip install pykinect-azure)"
)
_START = 40.0  # [s] in which the first frame must come: the tracker reads its network first
_N_JOINTS = 32
_TRACKING = np.array([Tracking.LOST, Tracking.INFERRED, Tracking.TRACKED, Tracking.TRACKED], dtype=np.int8)


def _joint_indices() -> tuple[tuple[int, ...], ...]:
    """Return of which of the 32 joints each of the 25 is the middle."""
    named: dict[str, tuple[int, ...]] = {"spine_base": (0,), "spine_mid": (1,), "spine_shoulder": (4, 11)}
    named |= {"neck": (3,), "head": (26,)}  # spine_shoulder: between the clavicles
    arm = ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")
    for side, first_arm, first_leg in zip(SIDES, (5, 12), (18, 22), strict=True):
        named |= {f"{part}_{side}": (first_arm + i,) for i, part in enumerate(arm)}
        named |= {f"{part}_{side}": (first_leg + i,) for i, part in enumerate(("hip", "knee", "ankle", "foot"))}
    return tuple(named[joint] for joint in JOINTS)


_FROM = _joint_indices()


class AzureKinectSource(BodyCamera):
    """All persons before an Azure Kinect.

    Its 32 joints become the 25 of the Kinect v2; its frame, that of the depth camera (x right, y down, millimetres),
    becomes ours. The SDK does not tell open hands from closed ones: both are unknown. Times are the device's clock.

    The camera is opened through `pykinect-azure`, which ends the program when the SDK fails; that is turned into an
    error here, and frames are fetched by the C functions it wraps, which tell a late frame from a failure.

    It follows the documentation of the SDKs and has not met a device yet.

    Raises:
        InputError: when driver, SDK or camera is missing; the message says what, and what else can be done.
        TaskFailedError: from :meth:`read`, when the camera goes.
    """

    name = "azure"

    def __init__(self) -> None:
        super().__init__()
        try:
            driver: Any = importlib.import_module("pykinect_azure")
            self._k4a: Any = importlib.import_module("pykinect_azure.k4a._k4a")
            self._k4abt: Any = importlib.import_module("pykinect_azure.k4abt._k4abt")
        except ImportError as error:
            raise InputError(f"{self.name}: there is no driver ({error}); {_NEEDED}; {INSTEAD}") from error
        self._device: Any = None
        self._tracker: Any = None
        self._pending = False  # a picture was given to the tracker, its bodies have not come yet
        try:
            self._opened(driver)
        except BaseException:
            self.close()
            raise
        self._wait_for_first(_START, "does the body tracking SDK find its graphics card or, slower, its CPU mode")

    def _opened(self, driver: Any) -> None:
        self._kept_alive("find the SDKs", lambda: driver.initialize_libraries(track_body=True))
        if self._k4a.k4a_device_get_installed_count() < 1:
            raise InputError(f"{self.name}: no Azure Kinect is plugged in; {_NEEDED}; {INSTEAD}")
        settings = driver.Configuration()
        settings.color_resolution = driver.K4A_COLOR_RESOLUTION_OFF
        settings.depth_mode = driver.K4A_DEPTH_MODE_NFOV_UNBINNED
        settings.camera_fps = driver.K4A_FRAMES_PER_SECOND_30
        self._device = self._kept_alive("open the camera", lambda: driver.start_device(config=settings))
        self._tracker = self._kept_alive("start body tracking", driver.start_body_tracker)

    def _kept_alive(self, what: str, call: Callable[[], Any]) -> Any:
        """Call the driver, which prints and ends the program when it fails; raise an error instead."""
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                return call()
        except (SystemExit, OSError, AttributeError) as error:
            lines = said.getvalue().strip().splitlines()
            why = lines[0] if lines else str(error)
            raise InputError(f"{self.name}: could not {what} ({why}); {_NEEDED}; {INSTEAD}") from error

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
        """Give the next picture to the tracker; return whether there was one in time."""
        capture = self._k4a.k4a_capture_t()
        result = self._k4a.k4a_device_get_capture(self._device.handle(), capture, wait)
        if not self._came(result, "get a picture; is the camera still plugged in?"):
            return False
        try:
            result = self._k4abt.k4abt_tracker_enqueue_capture(self._tracker.handle(), capture, wait)
        finally:
            self._k4a.k4a_capture_release(capture)
        self._pending = self._came(result, "hand a picture to body tracking")
        return self._pending

    def _came(self, result: int, what: str) -> bool:
        """Return whether it came, False when it did not in time.

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
