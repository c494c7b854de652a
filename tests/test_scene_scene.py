"""Scene: clearance to the nearest obstacle, names, motion, a goal that is in the way."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, MovingScene, Scene, Sphere
from scene_shapes import KINDS, random_obstacle

GOAL = Pose([0.5, 0.0, 0.3], [0, 1, 0, 0])


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    return Scene(GOAL, [random_obstacle(kind, rng, velocity=rng.normal(size=3) * 0.1) for kind in KINDS])


@pytest.mark.parametrize("shape", [(), (40,), (4, 10), (0,)])
def test_distances_clearance_and_nearest_belong_together(scene, shape):
    points = np.random.default_rng(1).normal(size=(*shape, 3)) * 0.5
    distances = scene.distances(points)
    assert distances.shape == (len(scene.obstacles), *shape)
    for row, obstacle in zip(distances, scene.obstacles, strict=True):
        np.testing.assert_allclose(row, obstacle.signed_distance(points), atol=1e-14)
    assert scene.clearance(points).shape == shape
    assert scene.nearest(points).shape == shape
    np.testing.assert_array_equal(scene.clearance(points), distances.min(axis=0))
    np.testing.assert_array_equal(
        np.take_along_axis(distances, scene.nearest(points)[None], axis=0)[0], scene.clearance(points)
    )


def test_without_obstacles_everything_is_clear():
    empty = Scene()
    assert empty.goal is None
    np.testing.assert_array_equal(empty.clearance(np.zeros((2, 5, 3))), np.full((2, 5), np.inf))
    np.testing.assert_array_equal(empty.nearest(np.zeros((5, 3))), np.full(5, -1))
    assert empty.distances(np.zeros((5, 3))).shape == (0, 5)
    assert empty.at(1.0).obstacles == ()
    empty.check(0.1)


def test_at_moves_the_obstacles_and_not_the_goal(scene):
    points = np.random.default_rng(2).normal(size=(30, 3))
    later = scene.at(2.0)
    assert later.goal is scene.goal
    for before, after in zip(scene.obstacles, later.obstacles, strict=True):
        np.testing.assert_allclose(
            after.signed_distance(points + 2.0 * before.velocity), before.signed_distance(points), atol=1e-12
        )


def test_names():
    ball = Sphere([0, 0, 0], 0.1)
    box = Box(Pose.identity(), [0.1, 0.1, 0.1])
    tin = Box(Pose.identity(), [0.1, 0.1, 0.1], name="tin")
    scene = Scene(None, (box, ball, tin, box, ball))
    assert [scene.name_of(i) for i in range(5)] == ["box 1", "sphere 1", 'box "tin"', "box 2", "sphere 2"]
    assert scene.name_of(scene.nearest([[9.0, 0, 0]])[0]) == "sphere 1"
    for wrong in (5, -1):
        with pytest.raises(InputError, match=f"obstacle {wrong} does not exist; the scene has 5"):
            scene.name_of(wrong)


def test_check_tells_a_goal_that_is_in_the_way():
    scene = Scene(GOAL, [Sphere([0, 0, 0], 0.1), Sphere([0.55, 0.0, 0.3], 0.06, name="post")])
    with pytest.raises(InputError, match=r'the goal \[0\.5, 0\.0, 0\.3\] overlaps sphere "post" by 10\.0 mm') as caught:
        scene.check()
    assert "move the goal or the obstacle" in str(caught.value)
    free = Scene(GOAL, [Sphere([0.6, 0.0, 0.3], 0.06)])
    free.check()
    free.check(0.04 - 1e-9)
    with pytest.raises(InputError, match=r"overlaps sphere 1 by 10\.0 mm"):
        free.check(0.05)
    Scene(None, scene.obstacles).check(1.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Scene([0, 0, 0]), r"goal must be a Pose or None, got \[0, 0, 0\]"),
        (lambda: Scene(None, 3), "obstacles must be a list of obstacles, got 3"),
        (lambda: Scene(None, [Sphere([0, 0, 0], 1), "box"]), r"obstacles\[1\] must be an obstacle .* got 'box'"),
        (lambda: Scene(None, Sphere([0, 0, 0], 1)), "obstacles must be a list"),
        (lambda: Scene().clearance([0, 0]), r"points must be an array of shape \(\.\.\., 3\) \[m\], got shape \(2,\)"),
        (lambda: Scene().nearest(np.zeros((3, 2))), "points must be an array of shape"),
    ],
)
def test_bad_input_is_refused(build, message):
    with pytest.raises(InputError, match=message):
        build()


def test_list_becomes_a_tuple():
    obstacles = [Sphere([0, 0, 0], 1)]
    scene = Scene(None, obstacles)
    obstacles.clear()
    assert len(scene.obstacles) == 1
    assert isinstance(scene.obstacles, tuple)


def test_what_a_tracker_knows_is_kept():
    covariance = np.diag([1e-4, 2e-4, 3e-4])
    seen = Sphere([0.5, 0, 0], 0.1, velocity=[1.0, 0, 0], covariance=covariance, track_id=7)
    scene = Scene(None, [seen, Sphere([0, 0, 0], 0.1)], stamp=2.0)
    later = scene.at(2.5)
    assert later.stamp == 2.5
    np.testing.assert_array_equal(later.packed.stamps, [2.0, 2.0])  # when they were seen
    np.testing.assert_array_equal(later.packed.track_ids, [7, -1])
    np.testing.assert_array_equal(later.packed.covariances, [covariance, np.zeros((3, 3))])
    np.testing.assert_allclose(later.packed.positions[0], [1.0, 0, 0])
    assert later.obstacles[0].track_id == 7
    np.testing.assert_array_equal(later.obstacles[0].covariance, covariance)
    assert later.obstacles[1] is scene.obstacles[1]  # it stands
    np.testing.assert_allclose(later.at(3.0).obstacles[0].center, [1.5, 0, 0])
    np.testing.assert_allclose(later.at(2.0).obstacles[0].center, [0.5, 0, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"covariance": np.diag([1.0, -1.0, 1.0])}, "covariance must be symmetric and positive"),
        ({"covariance": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "covariance must be symmetric"),
        ({"covariance": np.eye(2)}, "covariance must be an array of shape"),
        ({"covariance": np.full((3, 3), np.nan)}, "covariance must be finite"),
        ({"track_id": -1}, "track_id must be a whole number"),
        ({"track_id": 1.5}, "track_id must be a whole number"),
        ({"angular_velocity": [0, 0, np.inf]}, "angular_velocity must be finite"),
        ({"angular_velocity": 3.0}, "angular_velocity must be 3 numbers"),
    ],
)
def test_what_no_tracker_can_know_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        Sphere([0, 0, 0], 0.1, **change)


def test_a_predicted_scene_can_be_copied_and_sent(scene):
    later = scene.at(0.7)
    points = np.random.default_rng(3).normal(size=(20, 3))
    for twin in (pickle.loads(pickle.dumps(later)), copy.deepcopy(later)):
        np.testing.assert_allclose(twin.distances(points), later.distances(points), atol=1e-12)
        assert [type(o) for o in twin.obstacles] == [type(o) for o in scene.obstacles]
    assert not hasattr(later, "no such thing")


def test_repr_names_the_obstacles():
    scene = Scene(
        GOAL, [Sphere([0, 0, 0.5], 0.1, name="<ball>", velocity=[0.1, 0, 0])] * 6, fixtures=[Box(GOAL, [1, 1, 1])]
    )
    four = ", ".join(['sphere "<ball>"'] * 4)
    assert repr(scene) == f"Scene({four}, 2 more, goal [0.5, 0.0, 0.3], stamp 0 s)"
    assert repr(Scene()) == "Scene(no obstacles, stamp 0 s)"
    table = scene._repr_html_()
    assert "&lt;ball&gt;" in table
    assert "0.1 m/s" in table
    assert "fixtures" in table


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.01, "5 mm", None, [0.1, 0.2]])
def test_check_refuses_a_radius_that_is_none(scene, bad):
    with pytest.raises(InputError, match="tool_radius must be a finite number"):
        scene.check(bad)


@pytest.mark.parametrize("bad", [np.nan, None, "now", [1.0]])
def test_a_time_that_is_none_is_refused(bad):
    with pytest.raises(InputError, match="stamp must be a finite number"):
        Scene(stamp=bad)
    with pytest.raises(InputError, match="time must be a finite number"):
        Scene().at(bad)
    with pytest.raises(InputError, match="index must be a whole number"):
        Scene().name_of(bad)
    with pytest.raises(InputError, match=r"fixtures"):
        Scene(fixtures=[bad])


def test_a_motion_of_a_name_that_two_obstacles_have_is_refused():
    scene = Scene(None, [Sphere([0.5, 0.0, z], 0.1, name="ball") for z in (0.1, 0.4)])
    with pytest.raises(InputError, match="2 obstacles are named 'ball'; give the index"):
        MovingScene(scene, {"ball": lambda t: [0.5, 0.0, t]})
    assert MovingScene(scene, {1: lambda t: [0.5, 0.0, t]}).poses(2.0)[0][1, 2] == 2.0
