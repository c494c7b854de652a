"""The control loop: reproduce a skill on a robot."""

from imitarm.control_loop.reproduce import Step, reproduce

__all__ = ["Step", "reproduce"]
