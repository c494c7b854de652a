"""Capture of a person: skeletons, and the sources that deliver skeletons.

``SOURCES`` lists all sources by name. To add a source, write one class, and register the class in ``SOURCES`` or by an
entry point of another package (group ``imitarm.sources``). The source then appears in the ``--help`` of every command
that takes a source.
"""

from imitarm.capture.skeleton import Arm, HandState, Skeleton, SkeletonSource, Tracking
from imitarm.registry import Registry

SOURCES: Registry[type[SkeletonSource]] = Registry(
    "source",
    "imitarm.sources",
    {
        "file": "imitarm.capture.recording:SkeletonRecording",
        "synthetic": "imitarm.capture.synthetic:SyntheticSource",
        "udp": "imitarm.capture.stream:UdpSource",
        "video": "imitarm.capture.mediapipe:VideoSource",
        "webcam": "imitarm.capture.mediapipe:WebcamSource",
        "kinect2": "imitarm.capture.kinect:KinectV2Source",
        "azure": "imitarm.capture.kinect:AzureKinectSource",
    },
)
"""All sources by name. A user selects a source by ``NAME`` or ``NAME:ARGUMENT``. To select a file, the name of the file
is enough."""

__all__ = ["SOURCES", "Arm", "HandState", "Skeleton", "SkeletonSource", "Tracking"]
