"""How an arm, human or robot, moves.

``pose`` has positions and rotations, ``arm`` the model of a robot arm, ``ik`` the inverse kinematics: the joint
velocities for a desired motion of the tool.
"""

from __future__ import annotations

from imitarm.kinematics.pose import Pose

__all__ = ["Pose"]
