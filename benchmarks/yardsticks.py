"""What our times are compared with where no other library does the same job.

A yardstick is a call into another library whose cost grows with the machine's load as ours does: a step of mink for
what a control loop does at every tick, a fit of scikit-learn for what is done once per scene or skill, a forward pass
of MuJoCo for what is compiled code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose

Array = NDArray[np.float64]

DT = 0.01  # [s] control period


def named(distribution: str) -> str:
    """Return a distribution's name and version."""
    return f"{distribution} {version(distribution)}"


class MinkStep:
    """One step of mink's differential inverse kinematics: a frame task, limits of position and velocity, daqp.

    Args:
        arm: the arm with its tool.
        postures: joint angles that it will be called with, each of shape (n_joints,) [rad].
        target: pose of the tool in the base frame.
        limits: returns further limits of mink for its model.
        spec: the model; None: the arm's without its shapes, which would cost mink time and serve only collision limits.
    """

    def __init__(
        self,
        arm: ArmModel,
        postures: Sequence[Array],
        target: Pose,
        *,
        limits: Callable[[mujoco.MjModel], Sequence[Any]] = lambda model: (),
        spec: mujoco.MjSpec | None = None,
    ) -> None:
        import mink

        if spec is None:
            spec = arm.spec()
            for geom in [geom for geom in spec.geoms if geom.density == 0.0]:
                spec.delete(geom)
        model = spec.compile()
        self._solve = mink.solve_ik
        self._se3 = mink.SE3
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=0.3, gain=1.0)
        speeds = dict(zip(arm.joint_names, arm.max_velocity, strict=True))
        self._limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds), *limits(model)]
        self._whole = {posture.tobytes(): arm.posture(model, posture) for posture in postures}  # with the fingers
        self.aim(target)

    def aim(self, target: Pose) -> None:
        """Change the target pose of the tool."""
        self._task.set_target(self._se3(np.concatenate([target.quaternion, target.position])))

    def __call__(self, posture: Array) -> Array:
        """Return the velocity of all joints of the model [rad/s, m/s] at one of the postures."""
        self._configuration.update(self._whole[posture.tobytes()])
        found = self._solve(self._configuration, [self._task], DT, "daqp", damping=1e-5, limits=self._limits)
        return np.asarray(found)


@lru_cache(maxsize=1)
def mink_step() -> Callable[[], Array]:
    """Return a step of mink for the Sawyer with its gripper, near its home posture: the yardstick of a control tick."""
    arm = ArmModel.load("sawyer", tool="gripper")
    step = MinkStep(arm, [arm.home], arm.tool_pose(arm.home + 0.05))
    return lambda: step(arm.home)


def sklearn_fit() -> Callable[[], Any]:
    """Return a fit of scikit-learn's mixture, 1600 x 4, 8 components: the yardstick of what is done once per scene."""
    from sklearn.mixture import GaussianMixture

    X = np.random.default_rng(0).normal(size=(1600, 4))
    return lambda: GaussianMixture(8, random_state=0).fit(X)


def mj_forward() -> Callable[[], None]:
    """Return one forward pass of MuJoCo for the Sawyer with its gripper: the yardstick of compiled code."""
    arm = ArmModel.load("sawyer", tool="gripper")
    model = arm.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = arm.posture(model, arm.home)
    return lambda: mujoco.mj_forward(model, data)
