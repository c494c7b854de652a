"""The control loop: reproduce a skill on a robot, and observe the obstacles around the robot."""

from imitarm.control_loop.camera_observer import CameraObserver
from imitarm.control_loop.contact import Contact, ContactDetector
from imitarm.control_loop.interventions import Intervention
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.control_loop.person_observer import CombinedObserver, PersonObserver
from imitarm.control_loop.reproduce import Step, reproduce
from imitarm.control_loop.watchdog import Watchdog

__all__ = [
    "CameraObserver",
    "CombinedObserver",
    "Contact",
    "ContactDetector",
    "Intervention",
    "PersonObserver",
    "SensorModel",
    "Step",
    "TrackedScene",
    "Watchdog",
    "reproduce",
]
