"""Shoulder, elbow and wrist of a robot arm, and the joints that bend there."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

NAMES = ("shoulder", "elbow", "wrist")
"""Sites of an arm's file that mark the three points."""


@dataclass(frozen=True)
class Landmarks:
    """What the sites ``shoulder``, ``elbow`` and ``wrist`` of an arm's file say.

    The elbow's site stands on the link that the elbow's joint moves, the wrist's on the link moved by the joint that
    bends the wrist; so the file tells both joints too.

    Attributes:
        sites: indices of the three sites.
        elbow: index of the elbow's joint among the arm's.
        wrist: index of the joint that bends the wrist among the arm's.
        elbow_straight: position of the elbow's joint where the arm is stretched and singular [rad]; the file's
            ``<custom><numeric name="elbow_straight" data="..."/></custom>``, 0 when it says nothing.
    """

    sites: tuple[int, int, int]
    elbow: int
    wrist: int
    elbow_straight: float

    @classmethod
    def find(cls, model: mujoco.MjModel, joints: NDArray[np.int_]) -> Landmarks | None:
        """Return the landmarks of a model whose arm has ``joints``; None when a site or its joint is missing."""
        sites = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in NAMES]
        if min(sites) < 0:
            return None
        bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
        owners = [int(model.site_bodyid[site]) for site in sites]
        if owners[1] not in bodies or owners[2] not in bodies:
            return None
        numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "elbow_straight")
        straight = float(model.numeric_data[model.numeric_adr[numeric]]) if numeric >= 0 else 0.0
        return cls((sites[0], sites[1], sites[2]), bodies.index(owners[1]), bodies.index(owners[2]), straight)
