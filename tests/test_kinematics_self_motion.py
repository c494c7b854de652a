"""What the self-motion must be, against NumPy's pseudo-inverse and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.sew import sew_angle, sew_derivatives
from imitarm.kinematics.tasks import self_motion

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
WEIGHTS = np.array([[1], [1], [1], [0.3], [0.3], [0.3]])
DAMPING = 1e-7
some = settings(deadline=None, max_examples=60)
arms, seeds = st.sampled_from(list(ARMS)), st.integers(0, 2**32 - 1)


def drawn(name, seed):
    """A posture off the singular ones, the tool's Jacobian there, and the gradient of the elbow's angle."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    q = rng.uniform(arm.lower, arm.upper)
    jacobian = WEIGHTS * arm.tool_jacobian(q)
    state = sew_derivatives(*arm.sew_points(q))
    assume(state.bend > 0.05 and state.reference > 0.05)
    assume(np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.03)
    gradient = np.concatenate((state.shoulder, state.elbow, state.wrist)) @ arm.sew_jacobians(q).reshape(9, 7)
    assume(np.linalg.norm(gradient - np.linalg.pinv(jacobian) @ jacobian @ gradient) > 0.02)
    return arm, q, jacobian, gradient


@some
@given(arms, seeds)
def test_it_has_length_one_and_leaves_the_tool_where_it_is(name, seed):
    _, _, jacobian, gradient = drawn(name, seed)
    direction, turns, _ = self_motion(jacobian, gradient)
    assert np.linalg.norm(direction) == pytest.approx(1.0)
    least = np.linalg.svd(jacobian, compute_uv=False)[-1]
    allowed = DAMPING / least * np.linalg.norm(gradient) / turns  # what the damping may leave
    assert np.linalg.norm(jacobian @ direction) <= 1.01 * allowed + 1e-12


@some
@given(arms, seeds)
def test_it_changes_the_elbows_angle_as_fast_as_it_says(name, seed):
    arm, q, jacobian, gradient = drawn(name, seed)
    direction, turns, _ = self_motion(jacobian, gradient)
    h = 1e-5
    after, before = (sew_angle(*arm.sew_points(q + side * h * direction)) for side in (1.0, -1.0))
    assert turns > 0.0
    rate = (np.remainder(after - before + np.pi, 2 * np.pi) - np.pi) / (2 * h)
    least = np.linalg.svd(jacobian, compute_uv=False)[-1]
    damped = DAMPING / least**2 * (gradient @ gradient) / turns
    assert rate == pytest.approx(turns, rel=1e-3, abs=1.01 * damped)


@some
@given(arms, seeds)
def test_what_the_tool_does_to_the_angle_is_by_the_pseudo_inverse(name, seed):
    _, _, jacobian, gradient = drawn(name, seed)
    _, _, by_tool = self_motion(jacobian, gradient)
    wanted, least = gradient @ np.linalg.pinv(jacobian), np.linalg.svd(jacobian, compute_uv=False)[-1]
    assert np.linalg.norm(by_tool - wanted) <= 1.01 * DAMPING / least**2 * np.linalg.norm(wanted) + 1e-9


@some
@given(seeds, st.integers(8, 10))
def test_of_all_motions_that_leave_the_tool_none_changes_the_quantity_more(seed, n):
    """With more than one joint to spare there is a choice."""
    rng = np.random.default_rng(seed)
    jacobian, gradient = rng.normal(size=(6, n)), rng.normal(size=n)
    assume(np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.2)
    swing = self_motion(jacobian, gradient)
    assume(swing is not None and swing[1] > 0.1)
    direction, turns, _ = swing
    assert gradient @ direction == pytest.approx(turns, rel=1e-2)
    others = rng.normal(size=(200, n - 6)) @ np.linalg.svd(jacobian)[2][6:]
    others /= np.linalg.norm(others, axis=1)[:, None]
    assert (others @ gradient <= turns * (1.0 + 1e-2)).all()


@some
@given(arms, seeds, st.integers(0, 6))
def test_an_arm_of_six_joints_has_none(name, seed, missing):
    _, _, jacobian, gradient = drawn(name, seed)
    six = np.delete(jacobian, missing, axis=1)
    assume(np.linalg.svd(six, compute_uv=False)[-1] > 0.03)
    assert self_motion(six, np.delete(gradient, missing)) is None


@some
@given(arms, seeds)
def test_a_quantity_that_only_the_tool_changes_is_led_by_none(name, seed):
    _, _, jacobian, _ = drawn(name, seed)
    assert self_motion(jacobian, np.random.default_rng(seed).normal(size=6) @ jacobian) is None
