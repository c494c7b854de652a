from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.robots.world import OBSTACLE, add_obstacles, arm_world
from imitarm.scene import OBSTACLES, Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, HalfSpace, Scene, Sphere

PROBE = 0.001


def one_of_each(rng: np.random.Generator) -> list:
    def pose():
        return Pose(rng.uniform(-0.3, 0.3, 3), quaternion_exp(rng.normal(0.0, 1.5, 3)))

    return [
        Sphere(rng.uniform(-0.3, 0.3, 3), 0.07),
        Box(pose(), size=rng.uniform(0.05, 0.2, 3)),
        Capsule(rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.3, 0.3, 3), 0.04),
        Cylinder(pose(), radius=0.06, length=0.15),
        Cone(pose(), radius=0.06, height=0.15),
        Ellipsoid(pose(), semi_axes=rng.uniform(0.04, 0.12, 3)),
        ConvexHull(rng.uniform(-0.1, 0.1, (12, 3)) + rng.uniform(-0.2, 0.2, 3)),
        HalfSpace([0.0, 0.0, -0.4], rng.normal(size=3) * [0.3, 0.3, 0.0] + [0.0, 0.0, 1.0]),
    ]


def world_with_probe(obstacles: list) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="probe", mocap=True).add_geom(name="probe", size=[PROBE, 0, 0])
    add_obstacles(spec, Scene(None, tuple(obstacles)))
    model = spec.compile()
    return model, mujoco.MjData(model)


def test_every_known_shape_is_tried():
    assert {type(o) for o in one_of_each(np.random.default_rng(0))} == set(OBSTACLES.values())


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_solid_is_where_and_what_the_obstacle_is(seed):
    rng = np.random.default_rng(seed)
    obstacles = one_of_each(rng)
    model, data = world_with_probe(obstacles)
    for point in rng.uniform(-0.5, 0.5, (12, 3)):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        for i, obstacle in enumerate(obstacles):
            distance = obstacle.signed_distance(point)
            if distance > 0.005:  # the simulator's depth inside is not exact for all shapes
                ids = model.geom("probe").id, model.geom(f"{OBSTACLE}{i}").id
                measured = mujoco.mj_geomDistance(model, data, *ids, 10.0, None) + PROBE
                # an ellipsoid's distance is found by an iteration, a cone is a polygon of 96 sides
                assert measured == pytest.approx(distance, abs=1e-4), obstacle.kind


def test_a_capsule_of_no_length_and_upright_ones_are_built():
    obstacles = [
        Capsule([0.1, 0, 0], [0.1, 0, 0], 0.05),
        Capsule([0, 0, 0], [0, 0, -0.2], 0.05),
        Capsule([0, 0.3, 0], [0.2, 0.3, 0], 0.05),
    ]
    model, data = world_with_probe(obstacles)
    data.mocap_pos[0] = point = np.array([0.3, 0.2, -0.4])
    mujoco.mj_kinematics(model, data)
    for i, obstacle in enumerate(obstacles):
        measured = mujoco.mj_geomDistance(model, data, 0, model.geom(f"{OBSTACLE}{i}").id, 10.0, None)
        assert measured + PROBE == pytest.approx(obstacle.signed_distance(point), abs=1e-5)


def test_the_arm_stands_on_a_pedestal_or_on_the_floor():
    arm = ArmModel.load("sawyer")
    high, low = arm_world(arm, floor=-0.75).compile(), arm_world(arm, floor=0.0).compile()
    assert high.geom("floor").pos[2] == -0.75
    np.testing.assert_allclose(high.geom("pedestal").size[1], 0.375)
    assert "pedestal" not in [low.geom(i).name for i in range(low.ngeom)]
