"""A simulated depth camera in the world of a simulated robot; it needs neither a display nor OpenGL."""

from __future__ import annotations

import mujoco
import numpy as np

from imitarm.kinematics.pose import Pose
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.robots.simulated import SimulatedRobot
from imitarm.validation import finite_number, flag, instance

_SEEN = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # groups of geoms that have a look; group 3 is for contact only


class DepthCamera:
    """Takes depth images by casting one ray through each pixel.

    The images are exact, without noise, and the same on every machine.

    Args:
        robot: robot; the camera sees the world of this robot, including the arm.
        intrinsics: the camera.
        pose: camera_to_base for a fixed camera; camera_to_tool for a camera that is mounted on the tool. The
            camera's frame has x to the right of the image, y down and z forward.
        on_tool: whether the camera moves with the tool.
        farthest: largest depth that is measured [m].

    Raises:
        InputError: when an argument is of a wrong type or ``farthest`` is not positive.
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        intrinsics: Intrinsics,
        pose: Pose,
        *,
        on_tool: bool = False,
        farthest: float = 10.0,
    ) -> None:
        self.robot = instance(robot, SimulatedRobot, "DepthCamera: robot")
        self.intrinsics = instance(intrinsics, Intrinsics, "DepthCamera: intrinsics")
        self._pose = instance(pose, Pose, "DepthCamera: pose")
        self._on_tool = flag(on_tool, "DepthCamera: on_tool")
        self.farthest = finite_number(farthest, "DepthCamera: farthest", "m", above=0.0)
        rays = intrinsics.rays().reshape(-1, 3)
        self._lengths = np.linalg.norm(rays, axis=1)  # of a ray over its depth
        self._directions = rays / self._lengths[:, None]

    @property
    def camera_to_base(self) -> Pose:
        """The current pose of the camera."""
        return self.robot.tool_to_base @ self._pose if self._on_tool else self._pose

    def frame(self) -> DepthFrame:
        """Return an image of the current scene."""
        camera_to_base = self.camera_to_base
        directions = self._directions @ camera_to_base.rotation.T
        n = len(directions)
        geoms, distances = np.empty(n, dtype=np.int32), np.empty(n)
        reach = self.farthest * float(self._lengths.max())
        mujoco.mj_multiRay(
            self.robot.model,
            self.robot.data,
            camera_to_base.position,
            np.ascontiguousarray(directions).ravel(),
            _SEEN,
            1,  # static geoms are seen too
            -1,  # no body is left out
            geoms,
            distances,
            None,
            n,
            reach,
        )
        depth = np.where(geoms >= 0, distances / self._lengths, np.nan)
        depth[depth > self.farthest] = np.nan
        shape = self.intrinsics.height, self.intrinsics.width
        return DepthFrame(self.robot.scene.stamp, depth.reshape(shape), self.intrinsics, camera_to_base)
