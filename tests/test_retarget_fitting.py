from __future__ import annotations

import numpy as np
import pytest

from imitarm import ArmModel, HalfSpace, InputError, Pose, SimulatedRobot, UnreachableError, find_posture
from imitarm.retarget.fitting import fit_motion

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}

each_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)


def circle(radius: float) -> np.ndarray:
    """A circle in a plane that leans, about a point that is nowhere near the robot."""
    angles = np.linspace(0.0, 2.0 * np.pi, 60)
    return [7.0, -3.0, 2.0] + radius * np.stack([0.5 * np.cos(angles), np.cos(angles), np.sin(angles)], axis=1)


@each_arm
@pytest.mark.parametrize("radius", [0.05, 0.15, 0.6])
def test_every_point_of_the_motion_is_in_reach(arm, radius):
    path = circle(radius)
    fit = fit_motion(arm, path, path[0])
    arm.check_limits(fit.q)
    start = arm.tool_pose(fit.q)
    np.testing.assert_allclose(start.rotation, arm.tool_pose(arm.home).rotation, atol=1e-4)
    q = fit.q
    for point in path[::6]:
        q = find_posture(arm, Pose(start.position + fit.scale * (point - path[0]), start.quaternion), q0=q)
    assert (fit.scale == 1.0) == (radius < 0.5)


@each_arm
def test_a_larger_motion_never_gets_a_larger_scale(arm):
    scales = [fit_motion(arm, circle(radius), circle(radius)[0]).scale for radius in (0.1, 0.3, 0.6, 1.0)]
    assert scales == sorted(scales, reverse=True)
    assert fit_motion(arm, circle(0.1), circle(0.1)[0], scale=0.4).scale == 0.4  # never more than was asked for


def test_what_was_not_seen_is_left_out_and_nothing_seen_is_told():
    arm, path = ARMS["sawyer"], circle(0.1)
    with_gap = path.copy()
    with_gap[5:9] = np.nan
    assert fit_motion(arm, with_gap, path[0]).scale == 1.0
    with pytest.raises(InputError, match="never seen"):
        fit_motion(arm, np.full((4, 3), np.nan), path[0])
    with pytest.raises(InputError, match="never seen"):
        fit_motion(arm, path, np.full(3, np.nan))


def test_a_motion_that_fits_at_no_scale_is_told_with_its_size():
    with pytest.raises(UnreachableError, match=r"19\.99 x 39\.97 x"):
        fit_motion(ARMS["panda"], circle(20.0), circle(20.0)[0])


LINKS = ("0 0 1", 0.2), ("0 1 0", 0.15), ("0 1 0", 0.35), ("0 0 1", 0.3), ("0 1 0", 0.1), ("0 0 1", 0.1)
STRETCHED = (
    '<mujoco><compiler angle="radian"/><worldbody>'
    + "".join(
        f'<body pos="0 0 {height}"><joint axis="{axis}" range="-3 3"/><geom size=".02"/>' for axis, height in LINKS
    )
    + "</body>" * len(LINKS)
    + '</worldbody><keyframe><key name="home" qpos="{}"/></keyframe></mujoco>'
)


@pytest.mark.parametrize("home", ["0 0 0 0 0 0", "0 1.57 0 0 0 0", "0.3 0.02 0.02 0 0 0"])
def test_the_whole_workspace_is_searched_if_home_is_a_poor_place(tmp_path, home):
    """The tool can't move in every direction at a stretched home, but the motion fits elsewhere."""
    path = tmp_path / "stretched.xml"
    path.write_text(STRETCHED.format(home))
    arm = ArmModel.load(path)
    motion = circle(0.1)
    fit = fit_motion(arm, motion, motion[0])
    assert fit.scale == 1.0
    start = arm.tool_pose(fit.q)
    for point in motion[::6]:
        find_posture(arm, Pose(start.position + (point - motion[0]), start.quaternion), q0=fit.q)


@pytest.mark.parametrize(
    ("wrist", "start", "scale"),
    [
        (np.zeros((4, 2)), np.zeros(3), 1.0),
        (None, np.zeros(3), 1.0),
        (np.zeros((4, 3)), "x", 1.0),
        (np.zeros((4, 3)), np.zeros(3), np.nan),
        (np.zeros((4, 3)), np.zeros(3), 0.0),
    ],
)
def test_what_is_no_motion_is_refused(wrist, start, scale):
    with pytest.raises(InputError):
        fit_motion(ARMS["panda"], wrist, start, scale=scale)


# the outermost points and the start of a real swing of an arm, seen by a camera (second view of the video)
SWING = np.array(
    [
        [-0.24, 0.09, -0.3],
        [-0.04, 0.09, -0.38],
        [-0.3, 0.1, -0.33],
        [0.3, 0.03, -0.23],
        [0.26, -0.3, 0.01],
        [0.22, 0.3, 0.11],
        [0.26, 0.17, 0.38],
    ]
)


@each_arm
@pytest.mark.parametrize("path", [circle(0.6), SWING], ids=["circle", "swing"])
def test_an_arm_that_starts_in_the_fitted_posture_touches_neither_itself_nor_its_pedestal(arm, path):
    robot = SimulatedRobot(arm, q=fit_motion(arm, path, path[0]).q)
    for _ in range(30):
        robot.move(np.zeros(7), 0.01)
    assert (robot.fault, robot.contacts) == ("", set())


def test_a_table_in_the_way_moves_the_start_or_shrinks_the_motion():
    arm, path = ARMS["panda"], circle(0.3)
    free, table = fit_motion(arm, path, path[0]), HalfSpace([0.0, 0.0, 0.25])
    above = fit_motion(arm, path, path[0], fixtures=[table])
    tool = arm.tool_pose(above.q).position + above.scale * (path - path[0])
    assert tool[:, 2].min() > 0.25
    assert not np.array_equal(free.q, above.q)
