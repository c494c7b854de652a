"""RCAMO goes on along its path if the arm can't reach so far to the side as RCAMO wants to evade."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.demonstrations import align
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import RCAMO, Observation
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach

DT, TOOL = 0.01, 0.03  # [s], [m]
STATE = ArmState(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)


@pytest.fixture(scope="module")
def skill():
    return Skill(6).fit(align(demonstrations_by(s_shaped_reach(planar=False), 3)))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_motion_goes_on_if_the_arm_cannot_reach_far_to_the_side(skill, side):
    middle = skill.nominal([0.5 * skill.duration_ - 0.05, 0.5 * skill.duration_ + 0.05]).positions
    ahead = (middle[1] - middle[0]) / np.linalg.norm(middle[1] - middle[0])
    across = side * np.cross(ahead, [0.0, 0.0, 1.0])
    ball = Sphere(middle.mean(axis=0) - 0.055 * across, 0.03)
    policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, TOOL]], clearance=0.02)
    x, upright = skill.start_.position.copy(), np.array([1.0, 0.0, 0.0, 0.0])
    policy.reset(Observation(0.0, STATE, Pose(x, upright), Scene(None, [ball])))
    for k in range(round(4.0 * skill.duration_ / DT)):
        observation = Observation(k * DT, STATE, Pose(x, upright), Scene(None, [ball], k * DT))
        if policy.finished(observation):
            break
        x = x + DT * policy.step(observation, DT).twist[:3]
        too_far = (x - middle.mean(axis=0)) @ across - 0.012  # the arm reaches no farther
        if too_far > 0.0 and abs((x - middle.mean(axis=0)) @ ahead) < 0.1:
            x = x - too_far * across
        assert np.linalg.norm(x - ball.center) > 0.03 + TOOL
    assert policy.finished(observation), policy.phase
