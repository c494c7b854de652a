"""Distances of candidates: groups of points, each with an obstacle and a time, equal those of each obstacle."""

import numpy as np
import pytest

from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.scene import Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, HalfSpace, Scene, Sphere
from imitarm.scene.displacements import displaced_distances


def shapes(rng, kinds, angular):
    def pose():
        return Pose(rng.uniform(-0.3, 0.3, 3), quaternion_exp(rng.uniform(-2.0, 2.0, 3)))

    every = {
        "sphere": lambda **m: Sphere(rng.uniform(-0.3, 0.3, 3), 0.05, **m),
        "box": lambda **m: Box(pose(), [0.1, 0.05, 0.2], **m),
        "capsule": lambda **m: Capsule(rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.3, 0.3, 3), 0.03, **m),
        "cylinder": lambda **m: Cylinder(pose(), 0.04, 0.1, **m),
        "cone": lambda **m: Cone(pose(), 0.04, 0.1, **m),
        "ellipsoid": lambda **m: Ellipsoid(pose(), [0.05, 0.1, 0.02], **m),
        "hull": lambda **m: ConvexHull(rng.uniform(-0.1, 0.1, (12, 3)), **m),
        "half_space": lambda **m: HalfSpace(rng.uniform(-0.3, 0.3, 3), rng.normal(size=3), **m),
    }
    return [
        every[k](velocity=rng.uniform(-0.5, 0.5, 3), angular_velocity=angular * rng.uniform(-1, 1, 3)) for k in kinds
    ]


@pytest.mark.parametrize("angular", [0.0, 2.0])
@pytest.mark.parametrize(
    "kinds",
    [
        ["sphere"],
        ["sphere", "sphere", "sphere"],
        ["sphere", "capsule"],
        ["ellipsoid", "sphere", "hull", "cone", "box", "cylinder"],
        ["box", "half_space"],
    ],
)
def test_they_equal_the_distances_of_the_moved_obstacles(kinds, angular):
    rng = np.random.default_rng(3)
    obstacles = shapes(rng, kinds, angular)
    packed = Scene(obstacles=obstacles).packed
    k, m = 15, 7
    members, times = rng.integers(len(kinds), size=k), rng.choice([0.0, 0.1, 0.4], size=k)
    origins, scales, directions = rng.uniform(-0.5, 0.5, (k, 3)), rng.uniform(0.0, 0.3, k), rng.uniform(-1, 1, (m, 3))
    found = displaced_distances(packed, members, times, origins, scales, directions)
    for i in range(k):
        points = origins[i] + scales[i] * directions
        expected = obstacles[members[i]].after(times[i]).signed_distance(points)
        np.testing.assert_allclose(found[i], expected, atol=1e-12)


def test_some_of_the_obstacles():
    obstacles = shapes(np.random.default_rng(1), ["sphere", "hull", "box", "sphere"], 0.0)
    packed = Scene(obstacles=obstacles).packed
    some = packed.take(np.array([1, 3]))
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (20, 3))
    every = Scene(obstacles=obstacles).distances(points)
    np.testing.assert_allclose(Scene(obstacles=[obstacles[1], obstacles[3]]).distances(points), every[[1, 3]])
    assert some.kinds.tolist() == packed.kinds[[1, 3]].tolist() and some.polytopes[0] is packed.polytopes[1]
