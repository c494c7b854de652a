"""How an arm, human or robot, moves.

``pose`` has positions and rotations, ``arm`` the model of a robot arm, ``ik`` the way from a wanted motion of the tool
to the motion of the joints.
"""

from __future__ import annotations

from imitarm.kinematics.pose import Pose

__all__ = ["Pose"]
