"""Which links of an arm can touch each other at all, found once for each arm by trying many postures."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.spheres import COLLISION_GROUP

_FEW = 3  # links with more joints between them are assumed to meet: there are too many postures to try
_POSTURES = 512  # tried for each pair of links


_known: dict[bytes, NDArray[np.bool_]] = {}  # by the content of the model: an arm that is loaded again is the same
_MOST_KNOWN = 64


@lru_cache(maxsize=16)
def meeting_links(arm: ArmModel) -> NDArray[np.bool_]:
    """Return for every pair of links whether they can touch within the limits of the joints between them.

    Link 0 is the base; link k is moved by k joints. Neighbouring links are always reported as not meeting. For links
    with two or three joints between them, the distance of their exact shapes is measured in 512 postures that fill the
    ranges of these joints evenly (a Sobol sequence). Links that touch in none of these postures are reported as not
    meeting. Links with four or more joints between them are always reported as meeting.

    Args:
        arm: the arm with its tool.

    Returns:
        A read-only array of shape (n_joints + 1, n_joints + 1). The answer for two links is at [outer, inner] with
        outer > inner; all other entries are False.
    """
    model = arm.spec().compile()
    content = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, content)
    key = hashlib.sha256(content.tobytes() + arm.home.tobytes() + repr(arm.joint_names).encode()).digest()
    if key not in _known:
        while len(_known) >= _MOST_KNOWN:
            _known.pop(next(iter(_known)))
        _known[key] = _measured(arm, model)
    return _known[key]


def _measured(arm: ArmModel, model: mujoco.MjModel) -> NDArray[np.bool_]:
    n = arm.n_joints
    meet = np.tril(np.ones((n + 1, n + 1), dtype=bool), -2)
    data, shapes = mujoco.MjData(model), _shapes(arm, model)
    for outer in range(2, n + 1):
        for inner in range(max(outer - _FEW, 0), outer - 1):
            meet[outer, inner] = _touch(arm, model, data, (shapes[outer], shapes[inner]), slice(inner, outer))
    meet.setflags(write=False)
    return meet


def _shapes(arm: ArmModel, model: mujoco.MjModel) -> list[list[int]]:
    """Return the collision shapes of each link, beginning with the base."""
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
    low, high = (
        np.maximum(arm.lower[between], -np.pi),
        np.minimum(arm.upper[between], np.pi),
    )  # continuous joints have no limits
    from scipy.stats import qmc  # noqa: PLC0415  takes half a second to import

    addresses = [int(model.jnt_qposadr[model.joint(name).id]) for name in arm.joint_names[between]]
    data.qpos[:] = arm.posture(model)
    for fraction in qmc.Sobol(len(low), scramble=False).random(_POSTURES):
        data.qpos[addresses] = low + fraction * (high - low)
        mujoco.mj_kinematics(model, data)
        for one in links[0]:
            for other in links[1]:
                if mujoco.mj_geomDistance(model, data, one, other, 0.01, None) <= 0.0:
                    return True
    return False
