"""Kinematics of arms: poses, Jacobians and inverse kinematics.

``pose`` contains positions and rotations, ``arm`` the model of a robot arm, and ``ik`` the inverse kinematics, which
computes joint velocities for a desired motion of the tool.
"""

from __future__ import annotations

from imitarm.kinematics.pose import Pose

__all__ = ["Pose"]
