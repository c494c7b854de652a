"""A target is recognised by its colour, its shape or both, and gives its name to the detection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import DepthNoise, Intrinsics, ObstacleDetector, Target
from imitarm.robots import DepthCamera, SimulatedRobot
from imitarm.scene import Box, Cylinder, HalfSpace, Scene, Sphere
from seen_scenes import image, looking

RED, BLUE = np.array([0.78, 0.22, 0.20]), np.array([0.20, 0.42, 0.70])
EYE = looking([1.6, 0.2, 0.9], [0.4, 0.0, 0.1])
TABLE = HalfSpace([0.0, 0.0, 0.0], name="table")
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def test_brightness_matters_little_and_black_has_no_colour():
    target = Target("tin", color=RED)
    colors = np.array([RED, 0.7 * RED, np.minimum(1.25 * RED, 1.0), BLUE, [0.5, 0.5, 0.5], [0.02, 0.0, 0.0]])
    np.testing.assert_array_equal(target.has_color(colors), [True, True, True, False, False, False])
    assert Target("any", shape=Sphere([0, 0, 0], 0.1)).has_color(colors).all()


def test_shapes_are_compared_by_kind_and_size():
    bottle = Target("bottle", shape=Cylinder(Pose([0, 0, 0], UPRIGHT), 0.04, 0.24))
    assert bottle.has_shape(Cylinder(Pose([1, 2, 3], UPRIGHT), 0.05, 0.22))
    assert not bottle.has_shape(Cylinder(Pose([0, 0, 0], UPRIGHT), 0.04, 0.35))
    assert not bottle.has_shape(Sphere([0, 0, 0], 0.04))
    box = Target("box", shape=Box(Pose([0, 0, 0], UPRIGHT), [0.1, 0.2, 0.3]))
    assert box.has_shape(Box(Pose([0, 0, 0], UPRIGHT), [0.3, 0.1, 0.2]))  # however it is turned


def test_the_simulated_camera_sees_colours_and_the_detector_names_the_target():
    arm = ArmModel.load("sawyer", tool="gripper")
    scene = Scene(
        None, [Sphere([0.8, -0.5, 0.4], 0.08), Sphere([0.8, -0.34, 0.4], 0.08), Sphere([0.8, 0.5, 0.4], 0.08)]
    )
    robot = SimulatedRobot(arm, scene=scene)
    rgb = [robot.model.geom(f"obstacle/{i}").rgba[:3] for i in range(3)]
    camera = DepthCamera(
        robot, Intrinsics.from_field_of_view(160, 120, 1.0), looking([2.4, 0.0, 0.8], [0.7, 0.0, 0.3]), color=True
    )
    finder = ObstacleDetector(
        arm,
        surfaces=robot.scene.fixtures,
        noise=DepthNoise.none(),
        targets=[
            Target("second", color=rgb[1]),
            Target("tin", color=rgb[2], shape=Box(Pose.identity(), [0.1, 0.1, 0.1])),
        ],
    )
    found = finder.detect(camera.frame(), robot.state().q)
    assert sorted(one.label for one in found) == ["", "", "second"]
    (target,) = [one for one in found if one.label]
    np.testing.assert_allclose(target.position, scene.obstacles[1].center, atol=0.01)  # though it touches the first
    grey = replace(camera.frame(), color=None)
    assert {one.label for one in finder.detect(grey)} == {""}


def test_a_shape_is_enough_without_colours():
    bottle = Cylinder(Pose([0.4, 0.2, 0.12], UPRIGHT), 0.05, 0.24)
    frame = image([bottle, Sphere([0.4, -0.2, 0.2], 0.08), TABLE], EYE)
    finder = ObstacleDetector(surfaces=[TABLE], noise=DepthNoise.none(), targets=[Target("bottle", shape=bottle)])
    found = finder.detect(frame)
    assert sorted((one.label, one.obstacle.kind) for one in found) == [("", "sphere"), ("bottle", "cylinder")]
    assert all(one.camera_to_base is EYE for one in found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": ""}, "name must not be empty"),
        ({}, "give a color, a shape, or both"),
        ({"color": [0, 0, 0]}, "not black"),
        ({"color": [0, 0, 255]}, "from 0 to 1"),
        ({"shape": "box"}, "must be an obstacle"),
        ({"color": RED, "color_tolerance": 0.0}, "color_tolerance"),
        ({"color": RED, "size_tolerance": -1.0}, "size_tolerance"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        Target(**{"name": "tin", **arguments})
    with pytest.raises(InputError, match="targets"):
        ObstacleDetector(targets=["tin"])
