from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.spheres import covering_spheres
from shapes import signed_distance, surface_points

sizes = st.floats(0.01, 0.3)
KINDS = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}


@settings(deadline=None, max_examples=150)
@given(st.sampled_from(list(KINDS)), st.lists(sizes, min_size=3, max_size=3), st.integers(0, 1000))
def test_every_point_of_a_shape_is_in_a_sphere(kind, size, seed):
    rng = np.random.default_rng(seed)
    pose = {"pos": rng.normal(size=3), "quat": rng.normal(size=4)}
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=size, **pose)
    model = spec.compile()
    centers, radius = covering_spheres(model, 0)
    points = surface_points(model, 0, 400, seed)
    distances = np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1)
    assert np.all(distances <= radius + 1e-9)
    if kind in {"sphere", "capsule"}:  # round bars are covered tightly
        assert radius <= 1.11 * size[0] + 1e-9


@pytest.mark.parametrize("name", ["sawyer", "panda"])
@pytest.mark.parametrize("tool", ["gripper", "brush"])
def test_the_spheres_hold_the_whole_moving_arm(name, tool):
    arm = ArmModel.load(name, tool=tool)
    model = arm.spec().compile()
    data = mujoco.MjData(model)
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper)
    data.qpos[:] = arm.posture(model, q)
    mujoco.mj_kinematics(model, data)
    centers, radii = arm.collision_spheres(q)
    for geom in np.flatnonzero((model.geom_group == 3) & (model.body_weldid[model.geom_bodyid] != 0)):
        local = surface_points(model, geom, 100, 0, in_body=False)
        points = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        gaps = np.linalg.norm(points[:, None] - centers, axis=2) - radii
        assert np.all(gaps.min(axis=1) <= 1e-9)
    assert len(radii) < 150  # few enough for a control loop
    assert radii.max() < 0.1


def test_distances_written_for_these_tests_agree_with_mujoco():
    rng = np.random.default_rng(0)
    for kind in ("sphere", "capsule", "cylinder", "box"):
        spec = mujoco.MjSpec()
        spec.worldbody.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=[0.1, 0.2, 0.15])
        body = spec.worldbody.add_body(name="probe")
        body.add_geom(size=[0.01, 0, 0])
        body.add_freejoint()
        model = spec.compile()
        data = mujoco.MjData(model)
        for point in rng.uniform(-0.6, 0.6, size=(20, 3)):
            data.qpos[:3] = point
            mujoco.mj_kinematics(model, data)
            distance = mujoco.mj_geomDistance(model, data, 0, 1, 5.0, None)
            ours = signed_distance(model, 0, point[None])[0] - 0.01
            if ours > 0.0:
                assert distance == pytest.approx(ours, abs=1e-5)
