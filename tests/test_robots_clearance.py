from __future__ import annotations

import coal
import mujoco
import numpy as np
import pytest

from imitarm.robots.world import ClearanceGauge, add_obstacles
from imitarm.scene import Scene
from scene_shapes import KINDS, coal_shape, random_obstacle


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


@pytest.mark.parametrize("kind", KINDS)
def test_the_measured_distance_agrees_with_coal(kind):
    """The judge of every run is judged by an independent library: arm shapes against every kind of obstacle."""
    rng = np.random.default_rng(1)
    probes = {"sphere": [0.05, 0, 0], "capsule": [0.04, 0.1, 0], "box": [0.05, 0.08, 0.03], "cylinder": [0.05, 0.09, 0]}
    types = {name: getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}") for name in probes}
    for _ in range(4):
        obstacle = random_obstacle(kind, rng)
        spec = mujoco.MjSpec()
        for name, size in probes.items():
            spec.worldbody.add_body(name=name, mocap=True).add_geom(name=name, type=types[name], size=size)
        add_obstacles(spec, Scene(None, [obstacle]))
        model = spec.compile()
        data = mujoco.MjData(model)
        target = model.geom("obstacle/0").id
        shape, placement = coal_shape(obstacle)
        for _ in range(25):
            places = [obstacle.solid().position + rng.normal(size=3) * 0.4 for _ in probes]
            for i, place in enumerate(places):
                turn = rng.normal(size=4)
                data.mocap_pos[i], data.mocap_quat[i] = place, turn / np.linalg.norm(turn)
            mujoco.mj_kinematics(model, data)
            gauge = ClearanceGauge(model, range(4), [target])
            expected = []
            for name, (a, b, c) in probes.items():
                ours = {
                    "sphere": lambda a=a: coal.Sphere(a),
                    "capsule": lambda a=a, b=b: coal.Capsule(a, 2 * b),
                    "box": lambda a=a, b=b, c=c: coal.Box(2 * a, 2 * b, 2 * c),
                    "cylinder": lambda a=a, b=b: coal.Cylinder(a, 2 * b),
                }[name]()
                body = data.body(name)
                where = coal.Transform3s(body.xmat.reshape(3, 3), body.xpos)
                expected.append(
                    coal.distance(shape, placement, ours, where, coal.DistanceRequest(), coal.DistanceResult())
                )
            distance, pair = gauge.measure(data)
            if min(expected) > 1e-3:
                # a cone is a hull of 96 sides and an ellipsoid's distance comes from an iteration
                assert distance == pytest.approx(min(expected), abs=5e-4), (kind, pair)
            else:
                assert distance < 2e-3
