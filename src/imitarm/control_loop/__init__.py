"""The control loop: reproduce a skill on a robot, and what is known of its surroundings."""

from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.control_loop.reproduce import Step, reproduce

__all__ = ["SensorModel", "Step", "TrackedScene", "reproduce"]
