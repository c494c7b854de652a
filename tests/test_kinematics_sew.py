from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.sew import CONVENTIONS, one_angle, sew_angle, sew_derivatives, sew_jacobian

ARMS = {name: ArmModel.load(name, tool="brush") for name in ("sawyer", "panda")}
seeds = st.integers(0, 2**32 - 1)
both = pytest.mark.parametrize("convention", list(CONVENTIONS))


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def arm_with_elbow_at(angle, wrist, *, reach=0.4):
    """Put the elbow on its circle by a rotation about the line to the wrist, from where it is highest."""
    along = wrist / np.linalg.norm(wrist)
    up = np.array([0, 0, 1.0]) - along * along[2]
    up /= np.linalg.norm(up)
    half = 0.5 * np.linalg.norm(wrist)
    radius = np.sqrt(reach**2 - half**2)
    return half * along + radius * (np.cos(angle) * up + np.sin(angle) * np.cross(along, up))


@both
@settings(deadline=None, max_examples=100)
@given(seed=seeds)
def test_derivatives_are_those_of_finite_differences(convention, seed):
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (3, 3))
    found = sew_derivatives(*points, convention=convention)
    assume(found.bend > 0.01 and found.reference > 0.01 and np.linalg.norm(points[2] - points[0]) > 0.05)
    h = 1e-6
    for which, gradient in enumerate((found.shoulder, found.elbow, found.wrist)):
        for axis in range(3):
            moved = points.copy()
            moved[which, axis] += h
            ahead = sew_angle(*moved, convention=convention)
            moved[which, axis] -= 2 * h
            slope = wrapped(ahead - sew_angle(*moved, convention=convention)) / (2 * h)
            assert gradient[axis] == pytest.approx(slope, abs=1e-5 * (1 + np.linalg.norm(gradient)))


@both
@settings(deadline=None, max_examples=50)
@given(seed=seeds, name=st.sampled_from(list(ARMS)))
def test_the_jacobian_of_an_arm_is_that_of_finite_differences(convention, seed, name):
    arm = ARMS[name]
    q = np.random.default_rng(seed).uniform(arm.lower, arm.upper)
    state = sew_derivatives(*arm.sew_points(q), convention=convention)
    assume(state.bend > 0.01 and state.reference > 0.01)
    angle, jacobian = sew_jacobian(arm.sew_points(q), arm.sew_jacobians(q), convention=convention)
    assert angle == pytest.approx(sew_angle(*arm.sew_points(q), convention=convention), abs=1e-12)
    h = 1e-6
    for joint, step in enumerate(h * np.eye(7)):
        ahead, back = (sew_angle(*arm.sew_points(q + s * step), convention=convention) for s in (1, -1))
        assert jacobian[joint] == pytest.approx(
            wrapped(ahead - back) / (2 * h), abs=2e-6 * (1 + np.abs(jacobian).max())
        )


@settings(deadline=None, max_examples=50)
@given(seeds, st.floats(-3.1, 3.1))
def test_a_turn_of_the_elbow_is_a_turn_of_the_angle(seed, turn):
    """With either reference the angle counts the elbow's way round the circle."""
    wrist = np.random.default_rng(seed).uniform([0.1, -0.4, -0.4], [0.5, 0.4, 0.4])
    for convention in CONVENTIONS:
        start, end = (
            sew_angle(np.zeros(3), arm_with_elbow_at(a, wrist), wrist, convention=convention) for a in (0, turn)
        )
        assert wrapped(end - start - turn) == pytest.approx(0.0, abs=1e-9)
    assert sew_angle(np.zeros(3), arm_with_elbow_at(turn, wrist), wrist, convention="conventional") == pytest.approx(
        turn
    )


def test_up_is_nought_down_is_pi_and_a_wrist_ahead_makes_both_angles_one():
    wrist = np.array([0.5, 0.0, 0.0])
    for convention in CONVENTIONS:
        for turn in (0.0, 0.7, -2.0):
            elbow = arm_with_elbow_at(turn, wrist)
            assert sew_angle(np.zeros(3), elbow, wrist, convention=convention) == pytest.approx(turn)
        assert abs(sew_angle(np.zeros(3), arm_with_elbow_at(np.pi, wrist), wrist)) == pytest.approx(np.pi)


def test_place_and_size_do_not_matter():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(3, 3))
    assert sew_angle(*(2.5 * points + [1, 2, 3])) == pytest.approx(sew_angle(*points))


def test_only_the_conventional_angle_is_lost_when_the_arm_points_straight_up():
    """Elias and Wen: the stereographic one is lost on one half line only, behind the base."""

    def jump(convention, centre, across):
        """How far the angle turns when the wrist circles about ``centre`` at 2 cm."""
        turns = np.linspace(0, 2 * np.pi, 400)
        wrists = centre + 0.02 * (np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1])
        elbows = np.broadcast_to(0.5 * centre + 0.2 * across[0], wrists.shape)
        return np.abs(wrapped(np.diff(sew_angle(np.zeros(3), elbows, wrists, convention=convention)))).sum()

    axes = np.eye(3)
    assert jump("conventional", 0.5 * axes[2], axes[:2]) > 6.0
    assert jump("stereographic", 0.5 * axes[2], axes[:2]) < 1.0
    assert jump("stereographic", -0.5 * axes[0], axes[1:]) > 6.0


def test_many_arms_at_once_are_each_arm_alone():
    points = np.random.default_rng(0).normal(size=(4, 5, 3, 3))
    angles = sew_angle(points[..., 0, :], points[..., 1, :], points[..., 2, :])
    assert angles.shape == (4, 5)
    for index in np.ndindex(4, 5):
        assert angles[index] == pytest.approx(one_angle(*points[index].tolist()).angle, abs=1e-12)


def test_a_straight_arm_has_no_angle():
    straight = np.array([[0, 0, 0], [0.3, 0, 0], [0.6, 0, 0.0]])
    assert np.isnan(sew_angle(*straight)) and one_angle(*straight.tolist()) is None
    angle, jacobian = sew_jacobian(straight, np.zeros((3, 3, 7)))
    assert np.isnan(angle) and np.isnan(jacobian).all()
    lost = np.full(3, np.nan)
    assert np.isnan(sew_angle(straight[0], lost, straight[2]))


def test_both_arms_say_where_the_three_points_are():
    """The link lengths of the arms' makers; Panda's elbow axis stands 82.5 mm beside upper arm and forearm."""
    for name, upper, forearm in (
        ("sawyer", 0.4124, 0.4112),
        ("panda", np.hypot(0.316, 0.0825), np.hypot(0.384, 0.0825)),
    ):
        arm = ARMS[name]
        s, e, w = arm.sew_points(arm.home)
        assert np.linalg.norm(e - s) == pytest.approx(upper, abs=1e-4)
        assert np.linalg.norm(w - e) == pytest.approx(forearm, abs=1e-4)
        jacobians, h = arm.sew_jacobians(arm.home), 1e-6
        for joint, step in enumerate(h * np.eye(7)):
            slope = (arm.sew_points(arm.home + step) - arm.sew_points(arm.home - step)) / (2 * h)
            assert np.allclose(jacobians[:, :, joint], slope, atol=1e-8)
        assert (arm.joint_names[arm.landmarks.elbow][-1], arm.joint_names[arm.landmarks.wrist][-1]) == {
            "sawyer": ("3", "5"),
            "panda": ("4", "6"),
        }[name]


def test_what_can_not_be_used_is_refused(tmp_path):
    file = tmp_path / "two.xml"
    file.write_text(
        "<mujoco><worldbody><body><joint/><geom size='.1'/><body pos='0 0 .3'><joint axis='0 1 0'/><geom size='.1'/>"
        "</body></body></worldbody></mujoco>"
    )
    arm = ArmModel.load(file)
    assert arm.landmarks is None
    with pytest.raises(InputError, match="add sites named 'shoulder', 'elbow' and 'wrist'"):
        arm.sew_points([0, 0])
    with pytest.raises(UnknownNameError, match="conventional, stereographic"):
        sew_angle(*np.eye(3), convention="polar")
    with pytest.raises(InputError, match="3 coordinates"):
        sew_angle(np.zeros(2), np.zeros(3), np.zeros(3))


def test_an_arm_whose_joints_are_not_side_by_side_is_right_too(tmp_path):
    """A fan on the first link has a joint of its own, which stands between the arm's."""
    file = tmp_path / "fan.xml"
    link = "<body pos='0 0 .3'><joint name='j{0}' axis='0 1 0'/><geom size='.1'/><site name='{1}'/>{2}</body>"
    arm_xml = link.format(2, "shoulder", link.format(3, "elbow", link.format(4, "wrist", "")))
    fan = "<body pos='0 .2 0'><joint name='fan'/><geom size='.05'/></body>"
    file.write_text(
        f"<mujoco><worldbody><body><joint name='j1'/><geom size='.1'/>{fan}{arm_xml}</body></worldbody></mujoco>"
    )
    arm, q, h = ArmModel.load(file), np.array([0.1, 0.2, 0.5, 0.3]), 1e-6
    assert arm.joint_names == ("j1", "j2", "j3", "j4")
    jacobians = arm.sew_jacobians(q)
    for joint, step in enumerate(h * np.eye(4)):
        slope = (arm.sew_points(q + step) - arm.sew_points(q - step)) / (2 * h)
        assert np.allclose(jacobians[:, :, joint], slope, atol=1e-8)
