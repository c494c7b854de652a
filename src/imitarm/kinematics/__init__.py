"""Kinematics of arms: poses, Jacobians and inverse kinematics.

The module ``pose`` contains positions and rotations, and the module ``arm`` contains the model of a robot arm. The
module ``ik`` computes joint velocities for a desired motion of the tool.
"""

from __future__ import annotations

from imitarm.kinematics.pose import Pose

__all__ = ["Pose"]
