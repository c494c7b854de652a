"""No Kinect is here: the drivers are played by stand-ins with the names and habits of the real packages."""

from __future__ import annotations

import sys
from enum import IntEnum, IntFlag
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from imitarm.capture import kinect
from imitarm.capture.filters import SideFilter
from imitarm.capture.kinect import AzureKinectSource, KinectV2Source
from imitarm.capture.skeleton import JOINT, JOINTS, HandState, Tracking
from imitarm.capture.sources import is_live, open_source
from imitarm.errors import InputError, TaskFailedError
from recording_samples import skeletons

TRUTH = skeletons(40)


# ---- kinect-next 3.0


class KinectError(Exception):
    pass


class KinectTimeoutError(KinectError):
    pass


class KinectNotAvailableError(KinectError):
    pass


class StreamType(IntFlag):
    COLOR = 1
    BODY = 32


class TrackingConfidence(IntEnum):
    LOW = 0
    HIGH = 1


def v2_body(skeleton, number, *, hands=(HandState.OPEN, HandState.CLOSED), sure=(1, 1)):
    joints = [
        SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z), tracking_state=state)
        for (x, y, z), state in zip(np.nan_to_num(skeleton.positions), skeleton.tracking, strict=True)
    ]
    left, right = (SimpleNamespace(state=h, confidence=TrackingConfidence(s)) for h, s in zip(hands, sure, strict=True))
    return SimpleNamespace(joints=joints, hand_left=left, hand_right=right, tracking_id=72057594037928000 + number)


@pytest.fixture
def kinect_next(monkeypatch):
    """The driver; what the camera does is in ``frames``: a list of bodies, or an error to raise."""
    driver = ModuleType("kinect_next")
    driver.frames, driver.closed = [], 0

    class KinectSensor:
        def __init__(self, streams):
            assert streams == StreamType.BODY
            self.tick = 0

        def wait_for_frames(self, timeout_ms=5000):
            assert isinstance(timeout_ms, int) and timeout_ms > 0
            self.tick += 1
            what = driver.frames.pop(0) if driver.frames else KinectTimeoutError("Timed out waiting for a frame")
            if isinstance(what, Exception):
                raise what
            return SimpleNamespace(tracked_bodies=what, relative_time_ns=self.tick * 33_333_333)

        def close(self):
            driver.closed += 1

    names = (KinectError, KinectTimeoutError, KinectNotAvailableError, StreamType, TrackingConfidence, KinectSensor)
    for name in names:
        setattr(driver, name.__name__, name)
    monkeypatch.setitem(sys.modules, "kinect_next", driver)
    monkeypatch.setattr(kinect, "_V2_START", 0.05)
    monkeypatch.setattr(kinect, "_SILENT", 0.05)
    return driver


def test_a_kinect_v2_gives_the_joints_hands_and_times_of_its_sdk(kinect_next):
    kinect_next.frames = [[], *([v2_body(s, 5)] for s in TRUTH)]
    with open_source("kinect2") as source:
        got = [source.read() for _ in TRUTH]
        for seen, truth in zip(got, TRUTH, strict=True):
            assert np.array_equal(seen.positions, truth.positions, equal_nan=True)
            assert np.array_equal(seen.tracking, truth.tracking)
        assert {s.person for s in got} == {0} and got[0].hand_states == (HandState.OPEN, HandState.CLOSED)
        assert np.diff([s.time for s in got]) == pytest.approx(1 / 30, abs=1e-6)
    assert kinect_next.closed == 1 and source.over and source.read(0.0) is None and is_live("kinect2")


def test_a_hand_that_the_sdk_is_not_sure_of_is_unknown(kinect_next):
    hands = (HandState.CLOSED, HandState.NOT_TRACKED)
    kinect_next.frames = [[v2_body(TRUTH[0], 1, hands=hands, sure=(0, 0))]]
    assert KinectV2Source().read().hand_states == (HandState.UNKNOWN, HandState.NOT_TRACKED)


def test_persons_keep_their_numbers_and_a_late_or_empty_frame_is_nothing(kinect_next):
    late = KinectTimeoutError("late")
    kinect_next.frames = [[], [v2_body(TRUTH[0], 9), v2_body(TRUTH[1], 2)], late, [], [v2_body(TRUTH[2], 2)]]
    source = KinectV2Source()
    assert [source.read(5.0).person for _ in range(3)] == [0, 1, 1]
    assert source.read(0.0) is None and not source.over


def test_an_unplugged_kinect_v2_is_told(kinect_next):
    kinect_next.frames = [[v2_body(TRUTH[0], 1)]]
    source = KinectV2Source()
    assert source.read() is not None
    with pytest.raises(TaskFailedError, match=r"kinect2: no frames for .* still plugged in"):
        while True:
            source.read(0.01)
    assert source.over and kinect_next.closed == 1
    kinect_next.frames = [[], KinectError("Win32 wait on the frame event failed")]
    source = KinectV2Source()
    with pytest.raises(TaskFailedError, match="the driver fails: Win32 wait"):
        source.read()
    assert kinect_next.closed == 2


def test_a_kinect_v2_that_is_not_there_is_told_with_what_else_can_be_done(kinect_next, monkeypatch):
    alternatives = r"Kinect for Windows SDK 2\.0.*Kinect SDK table.*udp:PORT.*webcam:NUMBER.*video:FILE"
    with pytest.raises(InputError, match="no frame within"):
        KinectV2Source()
    assert kinect_next.closed == 1

    def refuse(_):
        raise KinectNotAvailableError("Kinect20.dll is not there")

    monkeypatch.setattr(kinect_next, "KinectSensor", refuse)
    with pytest.raises(InputError, match=r"can't be opened \(Kinect20\.dll is not there\).*" + alternatives):
        KinectV2Source()
    monkeypatch.setitem(sys.modules, "kinect_next", None)
    with pytest.raises(InputError, match="there is no driver.*" + alternatives):
        open_source("kinect2")


# ---- pykinect-azure 0.0.4 over the C interface of the two SDKs

_AZURE = (  # k4abt_joint_id_t
    "pelvis spine_navel spine_chest neck clavicle_left shoulder_left elbow_left wrist_left hand_left handtip_left "
    "thumb_left clavicle_right shoulder_right elbow_right wrist_right hand_right handtip_right thumb_right hip_left "
    "knee_left ankle_left foot_left hip_right knee_right ankle_right foot_right head nose eye_left ear_left eye_right "
    "ear_right"
)
AZURE = _AZURE.split(" ")


def azure_body(skeleton):
    """The 32 joints of the SDK for a skeleton of ours: depth camera's axes, millimetres."""
    ours = {"pelvis": "spine_base", "spine_navel": "spine_mid", "clavicle_left": "spine_shoulder"}
    ours |= {"clavicle_right": "spine_shoulder", "handtip_left": "hand_tip_left", "handtip_right": "hand_tip_right"}
    points = np.full((32, 3), 1e6)  # what we have no joint for is far away
    levels = np.full(32, 2)
    for i, name in enumerate(AZURE):
        joint = ours.get(name, name)
        if joint in JOINT:
            x, y, z = np.nan_to_num(skeleton.joint(joint))
            points[i], levels[i] = (-1000.0 * x, -1000.0 * y, 1000.0 * z), skeleton.tracking[JOINT[joint]]
    return points, levels


@pytest.fixture
def azure(monkeypatch):
    """The driver; each of ``frames`` is a list of (number, skeleton), or the C functions' result."""
    driver, k4a, k4abt = (ModuleType(f"pykinect_azure{end}") for end in ("", ".k4a._k4a", ".k4abt._k4abt"))
    sdk = SimpleNamespace(frames=[], devices=1, missing=False, live=set(), given=[], slow=0)
    driver.K4A_COLOR_RESOLUTION_OFF, driver.K4A_DEPTH_MODE_NFOV_UNBINNED, driver.K4A_FRAMES_PER_SECOND_30 = 0, 2, 2
    driver.Configuration = SimpleNamespace
    k4a.K4A_WAIT_RESULT_SUCCEEDED, k4a.K4A_WAIT_RESULT_FAILED, k4a.K4A_WAIT_RESULT_TIMEOUT = 0, 1, 2

    def initialize_libraries(track_body=False):
        assert track_body
        if sdk.missing:
            print("Failed to load library libk4a.so")
            sys.exit(1)

    class Device:
        def __init__(self, config):
            assert (config.color_resolution, config.depth_mode, config.camera_fps) == (0, 2, 2)
            if sdk.devices == "busy":
                print("Open K4A Device failed!")
                sys.exit(1)
            sdk.live.add("device")

        def handle(self):
            return "device"

        def close(self):
            sdk.live.discard("device")

    class Tracker:
        def __init__(self):
            sdk.live.add("tracker")

        def handle(self):
            return "tracker"

        def destroy(self):
            sdk.live.discard("tracker")

    def get_capture(device, capture, wait):
        assert device == "device" and wait > 0
        what = sdk.frames.pop(0) if sdk.frames else 2
        if isinstance(what, int):
            return what
        sdk.live.add("capture")
        capture.bodies = what
        return 0

    def enqueue(tracker, capture, wait):
        sdk.given.append(capture.bodies)
        return 0

    def pop(tracker, frame, wait):
        if sdk.slow:
            sdk.slow -= 1
            return 2
        frame.bodies = sdk.given.pop(0)
        frame.time = 33333 * (len(sdk.popped) + 1)
        sdk.popped.append(frame)
        sdk.live.add("frame")
        return 0

    def get_skeleton(frame, i, skeleton):
        for joint, (x, y, z), level in zip(skeleton.joints, *azure_body(frame.bodies[i][1]), strict=True):
            joint.position = SimpleNamespace(xyz=SimpleNamespace(x=x, y=y, z=z))
            joint.confidence_level = int(level)
        return 0

    sdk.popped = []
    driver.initialize_libraries = initialize_libraries
    driver.start_device, driver.start_body_tracker = Device, Tracker
    k4a.k4a_device_get_installed_count = lambda: 0 if sdk.devices == 0 else 1
    k4a.k4a_capture_t = k4abt.k4abt_frame_t = SimpleNamespace
    k4a.k4a_device_get_capture, k4abt.k4abt_tracker_enqueue_capture = get_capture, enqueue
    k4a.k4a_capture_release = lambda _: sdk.live.discard("capture")
    k4abt.k4abt_tracker_pop_result, k4abt.k4abt_frame_get_body_skeleton = pop, get_skeleton
    k4abt.k4abt_frame_release = lambda _: sdk.live.discard("frame")
    k4abt.k4abt_skeleton_t = lambda: SimpleNamespace(joints=[SimpleNamespace() for _ in range(32)])
    k4abt.k4abt_frame_get_num_bodies = lambda frame: len(frame.bodies)
    k4abt.k4abt_frame_get_body_id = lambda frame, i: frame.bodies[i][0]
    k4abt.k4abt_frame_get_device_timestamp_usec = lambda frame: frame.time
    for module in (driver, k4a, k4abt):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "pykinect_azure.k4a", ModuleType("pykinect_azure.k4a"))
    monkeypatch.setitem(sys.modules, "pykinect_azure.k4abt", ModuleType("pykinect_azure.k4abt"))
    monkeypatch.setattr(kinect, "_AZURE_START", 0.05)
    monkeypatch.setattr(kinect, "_SILENT", 0.05)
    return sdk


def test_an_azure_kinect_gives_our_joints_axes_and_metres(azure):
    azure.frames = [[], *([(4, s)] for s in TRUTH)]
    with open_source("azure") as source:
        got = [source.read() for _ in TRUTH]
        assert azure.live == {"device", "tracker"}  # every picture and every frame was let go
    assert azure.live == set() and is_live("azure")
    for seen, truth in zip(got, TRUTH, strict=True):
        assert np.allclose(seen.positions, truth.positions, atol=1e-9, equal_nan=True)
        assert np.array_equal(seen.tracking, truth.tracking)
        assert seen.hand_states == (HandState.UNKNOWN, HandState.UNKNOWN) and seen.person == 0
    assert np.diff([s.time for s in got]) == pytest.approx(1 / 30, abs=1e-6)
    first = got[0]
    assert first.joint("hand_right")[0] > first.joint("hand_left")[0]  # faces the sensor
    assert first.joint("head")[1] > first.joint("spine_base")[1]


def test_confidence_becomes_tracking(azure, monkeypatch):
    levels = np.arange(32) % 4
    module = sys.modules["pykinect_azure.k4abt._k4abt"]
    whole = module.k4abt_frame_get_body_skeleton

    def with_levels(frame, i, skeleton):
        whole(frame, i, skeleton)
        for joint, level in zip(skeleton.joints, levels, strict=True):
            joint.confidence_level = int(level)
        return 0

    monkeypatch.setattr(module, "k4abt_frame_get_body_skeleton", with_levels)
    azure.frames = [[(1, TRUTH[0])]]
    seen = AzureKinectSource().read()
    expected = {0: Tracking.LOST, 1: Tracking.INFERRED, 2: Tracking.TRACKED, 3: Tracking.TRACKED}
    for name in ("elbow_left", "wrist_right", "thumb_left", "knee_right", "head"):
        assert seen.tracking[JOINT[name]] == expected[int(levels[AZURE.index(name)])]
    both = [levels[AZURE.index(f"clavicle_{side}")] for side in ("left", "right")]
    assert seen.tracking[JOINT["spine_shoulder"]] == expected[int(min(both))]


def test_several_persons_late_pictures_and_a_slow_tracker(azure):
    azure.frames = [[], [(7, TRUTH[0]), (3, TRUTH[1])], 2, [], [(3, TRUTH[2])]]
    azure.slow = 1
    source = AzureKinectSource()
    persons = [source.read(5.0).person for _ in range(3)]
    assert persons == [0, 1, 1] and azure.given == []  # no picture waits in the tracker
    guarded = SideFilter(source)
    assert guarded.read(0.0) is None and not guarded.over


def test_an_unplugged_azure_kinect_is_told_and_let_go(azure):
    for after in ([1], []):
        azure.frames = [[(1, TRUTH[0])], *after]
        source = AzureKinectSource()
        assert source.read() is not None
        with pytest.raises(TaskFailedError, match=r"azure: .*still plugged in"):
            for _ in range(1000):
                source.read(0.01)
        assert source.over and azure.live == set()


def test_an_azure_kinect_that_is_not_there_is_told_and_does_not_end_the_program(azure, monkeypatch, capsys):
    with pytest.raises(InputError, match="no frame within"):
        AzureKinectSource()
    assert azure.live == set()
    azure.devices = 0
    with pytest.raises(InputError, match=r"no Azure Kinect is plugged in.*Body Tracking SDK 1\.1.*udp:PORT"):
        AzureKinectSource()
    azure.devices = "busy"
    with pytest.raises(InputError, match=r"could not open the camera \(Open K4A Device failed!\)"):
        AzureKinectSource()
    azure.missing = True
    with pytest.raises(InputError, match=r"could not find the SDKs \(Failed to load library libk4a\.so\).*video:FILE"):
        AzureKinectSource()
    azure.missing, azure.devices, azure.frames = False, 1, [1]
    with pytest.raises(InputError, match=r"could not get an image.*graphics card"):
        AzureKinectSource()
    assert azure.live == set()
    monkeypatch.setitem(sys.modules, "pykinect_azure", None)
    with pytest.raises(InputError, match=r"there is no driver.*pip install pykinect-azure"):
        open_source("azure")
    assert capsys.readouterr().out == ""


def test_the_joints_of_the_kinect_v2_sdk_are_in_our_order():
    order = (
        "SPINE_BASE SPINE_MID NECK HEAD SHOULDER_LEFT ELBOW_LEFT WRIST_LEFT HAND_LEFT SHOULDER_RIGHT ELBOW_RIGHT "
        "WRIST_RIGHT HAND_RIGHT HIP_LEFT KNEE_LEFT ANKLE_LEFT FOOT_LEFT HIP_RIGHT KNEE_RIGHT ANKLE_RIGHT FOOT_RIGHT "
        "SPINE_SHOULDER HAND_TIP_LEFT THUMB_LEFT HAND_TIP_RIGHT THUMB_RIGHT"
    )  # kinect_next.JointType
    assert order.lower().split() == list(JOINTS)
