from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.robots.clearance import ClearanceGauge


@pytest.fixture(scope="module")
def clutter():
    """Two groups of moving geoms of several shapes, in random places."""
    spec = mujoco.MjSpec()
    shapes = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX]
    for i in range(16):
        body = spec.worldbody.add_body(name=f"b{i}", mocap=True)
        body.add_geom(name=f"g{i}", type=shapes[i % 3], size=[0.03, 0.05, 0.04])
    model = spec.compile()
    return model, mujoco.MjData(model)


def test_it_finds_the_smallest_of_all_pairs(clutter):
    model, data = clutter
    gauge = ClearanceGauge(model, range(10), range(10, 16))
    rng = np.random.default_rng(0)
    for _ in range(50):
        data.mocap_pos[:] = rng.uniform(-0.4, 0.4, (16, 3))
        mujoco.mj_kinematics(model, data)
        every = {
            (i, j): mujoco.mj_geomDistance(model, data, i, j, 10.0, None) for i in range(10) for j in range(10, 16)
        }
        distance, pair = gauge.measure(data)
        assert distance == pytest.approx(min(every.values()), abs=1e-9)
        assert every[pair] == pytest.approx(distance, abs=1e-9)


def test_without_obstacles_it_is_infinite(clutter):
    model, data = clutter
    gauge = ClearanceGauge(model, range(10), [])
    assert gauge.measure(data) == (np.inf, None)
    assert gauge.touching(data) == set()


def test_touching_tells_pairs_of_the_two_groups_only_arm_first():
    spec = mujoco.MjSpec()
    for i, x in enumerate((0.0, 0.05, 1.0, 1.05, 2.0)):  # 0 meets 1, 2 meets 3, 4 is alone
        body = spec.worldbody.add_body(pos=[x, 0, 0])
        body.add_freejoint()
        body.add_geom(name=f"g{i}", size=[0.04, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 2
    assert ClearanceGauge(model, [1, 4], [0, 2]).touching(data) == {(1, 0)}
    assert ClearanceGauge(model, [0, 1], [2, 3]).touching(data) == set()
