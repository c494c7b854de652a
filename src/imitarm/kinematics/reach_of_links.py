"""Which links of an arm can meet at all, within the limits of the joints between them."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.spheres import COLLISION_GROUP

_FEW = 3  # links with more joints between them are taken to meet: their postures are too many to try
_POSTURES = 512  # tried of the joints between two links


@lru_cache(maxsize=16)
def meeting_links(arm: ArmModel) -> NDArray[np.bool_]:
    """Tell of every two links whether they can meet, joints in between at any position within their limits.

    Link 0 is the base, link k is moved by k joints. Links joined by a joint are said not to meet. For links with two
    or three joints between them the exact distance of their shapes is measured in 512 postures that cover what these
    joints can do evenly (a Sobol sequence); those that never touch are said not to meet. Links with more joints
    between them are said to.

    Args:
        arm: the arm with its tool.

    Returns:
        shape (n_joints + 1, n_joints + 1); entry [outer, inner] for outer > inner, False elsewhere; read-only.
    """
    n = arm.n_joints
    meet = np.tril(np.ones((n + 1, n + 1), dtype=bool), -2)
    model = arm.spec().compile()
    data, shapes = mujoco.MjData(model), _shapes(arm, model)
    for outer in range(2, n + 1):
        for inner in range(max(outer - _FEW, 0), outer - 1):
            meet[outer, inner] = _touch(arm, model, data, (shapes[outer], shapes[inner]), slice(inner, outer))
    meet.setflags(write=False)
    return meet


def _shapes(arm: ArmModel, model: mujoco.MjModel) -> list[list[int]]:
    """Return the collision shapes of each link, the base's first."""
    joints = [model.joint(name).id for name in arm.joint_names]
    carriers = [int(model.jnt_bodyid[joint]) for joint in joints]
    shapes: list[list[int]] = [[] for _ in range(arm.n_joints + 1)]
    for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP).tolist():
        body, link = int(model.geom_bodyid[geom]), 0
        while body > 0 and link == 0:
            link = carriers.index(body) + 1 if body in carriers else 0
            body = int(model.body_parentid[body])
        shapes[link].append(geom)
    return shapes


def _touch(
    arm: ArmModel, model: mujoco.MjModel, data: mujoco.MjData, links: tuple[list[int], list[int]], between: slice
) -> bool:
    """Return whether two links touch in any of the postures that are tried."""
    low, high = np.maximum(arm.lower[between], -np.pi), np.minimum(arm.upper[between], np.pi)  # some turn for ever
    q = arm.home.copy()
    for share in qmc.Sobol(len(low), scramble=False).random(_POSTURES):
        q[between] = low + share * (high - low)
        data.qpos[:] = arm.posture(model, q)
        mujoco.mj_kinematics(model, data)
        for one in links[0]:
            for other in links[1]:
                if mujoco.mj_geomDistance(model, data, one, other, 0.01, None) <= 0.0:
                    return True
    return False
