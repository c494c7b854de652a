"""How much a rotation counts beside a displacement."""

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import IKSolver
from imitarm.kinematics.tasks import TwistTask


@pytest.fixture(scope="module")
def arm():
    return ArmModel.load("sawyer", tool="gripper")


def missing(arm, q, task, velocity=None):
    """What the tool lacks of its twist [m/s, rad/s]."""
    weights = np.array([1.0, 1.0, 1.0, *[task.rotation_length] * 3])
    return IKSolver(arm).step(q, task, velocity=velocity).missing[0] / weights


def test_where_the_joints_cannot_do_both_the_turn_goes_the_sooner_the_less_it_counts(arm):
    """From rest, no joint can be quick at once: what of the way and of the turn is done then depends on the weight."""
    rng = np.random.default_rng(0)
    missed: dict[float, list[tuple[float, float]]] = {0.1: [], 0.3: [], 1.0: []}
    for _ in range(40):
        q = arm.home + 0.3 * rng.normal(size=arm.n_joints)
        twist = np.concatenate([rng.normal(size=3), 3.0 * rng.normal(size=3)])
        for length, errors in missed.items():
            task = TwistTask(twist, rotation_length=length, max_speed=100.0)
            error = missing(arm, q, task, velocity=np.zeros(arm.n_joints))
            errors.append((float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))))
    ways, turns = zip(*(np.mean(errors, axis=0) for errors in missed.values()), strict=True)
    assert ways[0] < ways[1] < ways[2]
    assert turns[0] > turns[1] > turns[2]


def test_where_no_limit_is_near_it_changes_nothing(arm):
    """But for the effort that joints are spared, a hundredth."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = arm.home + 0.2 * rng.normal(size=arm.n_joints)
        twist = 0.05 * rng.normal(size=6)
        for length in (0.1, 0.3, 1.0):
            error = missing(arm, q, TwistTask(twist, rotation_length=length))
            np.testing.assert_allclose(error, 0.0, atol=1e-2 * np.linalg.norm(twist))


@pytest.mark.parametrize("length", [0.0, -0.1, np.nan, np.inf])
def test_a_length_that_can_not_weigh_is_refused(arm, length):
    with pytest.raises(InputError, match="rotation_length"):
        IKSolver(arm).solve(arm.home, TwistTask(np.zeros(6), rotation_length=length))


def test_a_turn_that_counts_less_is_left_no_sooner_while_no_limit_is_near(arm):
    """Anywhere the joints may be: the effort that they are spared counts less too."""
    rng, missed = np.random.default_rng(2), {0.1: [], 0.3: []}
    for _ in range(300):
        q, twist = rng.uniform(arm.lower, arm.upper), np.concatenate([np.zeros(3), 0.02 * rng.normal(size=3)])
        for length, shares in missed.items():
            step = IKSolver(arm).step(q, TwistTask(twist, rotation_length=length))
            if not step.limited.any():
                shares.append(np.linalg.norm(step.missing[0][3:] / length) / np.linalg.norm(twist[3:]))
    assert len(missed[0.1]) > 200
    assert np.percentile(missed[0.1], 90) < 1.2 * np.percentile(missed[0.3], 90)
