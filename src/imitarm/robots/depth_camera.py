"""DepthCamera: a simulated depth camera in the world of a simulated robot, without a display or OpenGL."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.depth_noise import DepthNoise
from imitarm.robots.simulated import SimulatedRobot
from imitarm.validation import finite_number, flag, instance, whole_number

_SEEN = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)  # groups of geoms that have a look; group 3 is for contact only


class DepthCamera:
    """Takes depth images by casting one ray through each pixel.

    The images are the same on every machine. For a camera like the Kinect v2 of the thesis, use ``nearest=0.5,
    farthest=5.0, noise=DepthNoise()``.

    Args:
        robot: simulated robot; the camera sees the world of this robot, including the arm.
        intrinsics: intrinsic parameters of the camera.
        pose: pose of the camera, relative to the robot's base if ``on_tool`` is false, otherwise relative to the tool.
            The camera's frame has x to the right of the image, y down and z forward.
        on_tool: whether the camera is mounted on the tool and moves with it.
        nearest: smallest depth that is measured [m].
        farthest: largest depth that is measured [m].
        noise: noise of the depths; None: the depths are exact.
        seed: seed of the noise.
        color: whether the images contain the colours of the simulated surfaces, without light and shade.

    Raises:
        InputError: when an argument is of a wrong type, ``nearest`` is negative, or ``farthest`` is not above
            ``nearest``.
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        intrinsics: Intrinsics,
        pose: Pose,
        *,
        on_tool: bool = False,
        nearest: float = 0.0,
        farthest: float = 10.0,
        noise: DepthNoise | None = None,
        seed: int = 0,
        color: bool = False,
    ) -> None:
        self.robot = instance(robot, SimulatedRobot, "DepthCamera: robot")
        self.intrinsics = instance(intrinsics, Intrinsics, "DepthCamera: intrinsics")
        self._pose = instance(pose, Pose, "DepthCamera: pose")
        self._on_tool = flag(on_tool, "DepthCamera: on_tool")
        self.nearest = finite_number(nearest, "DepthCamera: nearest", "m", at_least=0.0)
        self.farthest = finite_number(farthest, "DepthCamera: farthest", "m", above=self.nearest)
        self.noise = None if noise is None else instance(noise, DepthNoise, "DepthCamera: noise")
        self._rng = np.random.default_rng(whole_number(seed, "DepthCamera: seed", at_least=0))
        self._color = flag(color, "DepthCamera: color")
        rays = intrinsics.rays().reshape(-1, 3)
        self._lengths = np.linalg.norm(rays, axis=1)  # of a ray over its depth
        self._directions = rays / self._lengths[:, None]

    @property
    def camera_to_base(self) -> Pose:
        """The current pose of the camera in the robot's base frame."""
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
        depth[(depth > self.farthest) | (depth < self.nearest)] = np.nan
        shape = self.intrinsics.height, self.intrinsics.width
        color = self._colors(geoms).reshape(*shape, 3) if self._color else None
        stamp = self.robot.scene_at_start.stamp + self.robot.time
        frame = DepthFrame(stamp, depth.reshape(shape), self.intrinsics, camera_to_base, color)
        return frame if self.noise is None else self.noise.apply(frame, self._rng)

    def _colors(self, geoms: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the colour of each geom (n, 3); black where there is none."""
        model = self.robot.model
        material = model.geom_matid[geoms]
        own = model.geom_rgba[geoms, :3].astype(float)
        if model.nmat:
            own = np.where((material >= 0)[:, None], model.mat_rgba[material, :3], own)
        return np.where((geoms >= 0)[:, None], own, 0.0)
