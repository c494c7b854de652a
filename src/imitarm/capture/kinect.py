"""KinectV2Source: skeletons of a Kinect v2, by its driver on Windows; AzureKinectSource is named here too."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from imitarm.capture.body_camera import INSTEAD, BodyCamera
from imitarm.capture.kinect_azure import AzureKinectSource
from imitarm.capture.skeleton import JOINTS, HandState, Skeleton
from imitarm.errors import InputError

__all__ = ["AzureKinectSource", "KinectV2Source"]

_NEEDED = (
    "a Kinect v2 needs 64-bit Windows, the Kinect for Windows SDK 2.0, a USB 3 port, and the package kinect-next "
    "(pip install kinect-next)"
)
_START = 10.0  # [s] in which the first frame must come: a cold camera takes 1 to 3


class KinectV2Source(BodyCamera):
    """All persons before a Kinect v2, with the states of their hands.

    The SDK's frame and its 25 joints are ours as they are. A hand's state counts when the SDK is sure of it. Times are
    the sensor's own clock.

    It follows the documentation of `kinect-next` 3.0 and has not met a device yet.

    Raises:
        InputError: when driver or camera is missing; the message says what, and what else can be done.
        TaskFailedError: from :meth:`read`, when the camera goes.
    """

    name = "kinect2"

    def __init__(self) -> None:
        super().__init__()
        try:
            self._driver: Any = importlib.import_module("kinect_next")
        except ImportError as error:
            raise InputError(f"{self.name}: there is no driver ({error}); {_NEEDED}; {INSTEAD}") from error
        try:
            self._sensor = self._driver.KinectSensor(self._driver.StreamType.BODY)
        except (self._driver.KinectError, OSError) as error:
            raise InputError(f"{self.name}: can't be opened ({error}); {_NEEDED}; {INSTEAD}") from error
        self._wait_for_first(_START, "is the camera plugged in, with its power supply")

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
        joints = [body.joints[i] for i in range(len(JOINTS))]  # the SDK's order is ours
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
