"""A retargeting as a recording for the 3-D playback: the robot at its joints' positions, gripper and scene included."""

from __future__ import annotations

import mujoco
import numpy as np

from imitarm.retarget import Retargeting
from imitarm.robots.world import add_obstacles, arm_world
from imitarm.scene import Scene
from imitarm.viewer.recording import FrameRecorder, Recording

FLOOR = -0.75  # [m] of the floor in the base frame: the robot stands on a pedestal
_CLOSES = 0.25  # [s] the fingers take to open or close


def retargeting_frames(run: Retargeting, scene: Scene | None = None, *, rate: float = 25.0) -> Recording:
    """Return where every body of the robot was: kinematics only, the robot does what it is told.

    Args:
        run: of a method.
        scene: obstacles to draw, as they stand at first.
        rate: frames a second [1/s].
    """
    spec = arm_world(run.arm, floor=FLOOR)
    add_obstacles(spec, Scene() if scene is None else scene)
    model = spec.compile()
    data = mujoco.MjData(model)
    frames = FrameRecorder(model, rate=rate)
    fingers = [j for j in range(model.njnt) if model.joint(j).name.startswith("tool/")]
    addresses, ranges = model.jnt_qposadr[fingers], model.jnt_range[fingers]
    share, dt = 1.0 - float(run.closed[0]), float(run.times[1] - run.times[0])  # of being open
    for time, q, closed in zip(run.times, run.joints, run.closed, strict=True):
        data.qpos[:] = run.arm.posture(model, q)
        share = float(np.clip(share + (-dt if closed else dt) / _CLOSES, 0.0, 1.0))
        data.qpos[addresses] = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        mujoco.mj_kinematics(model, data)
        frames.note(data, float(time))
    return frames.recording()
