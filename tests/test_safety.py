"""The safety filter: limits always, clearances wherever a safe motion exists, and the truth where none does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.command import Command, Status
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.limits import JointLimits
from imitarm.safety import SafetyFilter
from imitarm.scene import HalfSpace, Scene, Sphere
from imitarm.scene.clearance import SelfClearance
from imitarm.scene.clearance_limit import ClearanceLimit

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
DT = 0.01
either = pytest.mark.parametrize("name", list(ARMS))
seeds = st.integers(0, 2**32 - 1)


def random_scene(arm, rng):
    tool = arm.tool_pose(arm.home).position
    spheres = [Sphere(tool + rng.normal(size=3) * 0.3, rng.uniform(0.02, 0.08)) for _ in range(rng.integers(1, 4))]
    return Scene(None, [s for s in spheres if clearance(arm, arm.home, Scene(None, [s])) > 0.03])


def clearance(arm, q, scene):
    centers, radii = arm.collision_spheres(q)
    distances = [float((o.signed_distance(centers) - radii).min()) for o in scene.obstacles]
    return min(distances, default=np.inf)


def random_command(rng, n):
    if rng.random() < 0.5:
        return Command(np.zeros(6), joint_velocity=rng.normal(size=n))
    return Command(0.5 * rng.normal(size=6))


@settings(deadline=None, max_examples=20)
@given(seeds, st.sampled_from(list(ARMS)))
def test_whatever_is_commanded_limits_hold_and_nothing_is_touched(seed, name):
    arm, rng = ARMS[name], np.random.default_rng(seed)
    scene, keeper, own = random_scene(arm, rng), SafetyFilter(arm, clearance=0.02), SelfClearance(arm, 0.01)
    limits, q, velocity = JointLimits(arm), arm.home.copy(), np.zeros(arm.n_joints)
    least = clearance(arm, q, scene)
    for step in range(150):
        if step % 30 == 0:
            command = random_command(rng, arm.n_joints)
        kept = keeper.step(command, q, velocity, scene)
        lower, upper = limits.box(q, DT, velocity)
        assert np.all(kept.velocity >= lower - 1e-9) and np.all(kept.velocity <= upper + 1e-9)
        assert kept.slack == 0.0 or not kept.safe or kept.slack <= 1e-6
        velocity, q = kept.velocity, q + DT * kept.velocity
        least = min(least, clearance(arm, q, scene))
    assert least > 0.02 - 1e-3 or least > 0.015  # half of the missing room is regained within 3 steps
    assert own.distance(q) > 0.0


@either
def test_a_command_that_is_safe_is_passed_on_unchanged(name):
    arm = ARMS[name]
    wanted = 0.05 * np.ones(arm.n_joints)
    kept = SafetyFilter(arm).step(Command(np.zeros(6), joint_velocity=wanted), arm.home, np.zeros(7), Scene())
    np.testing.assert_array_equal(kept.velocity, wanted)
    assert kept.safe and kept.changed == 0.0


@either
def test_an_arm_that_is_driven_into_itself_stops_short(name):
    """Without the rows the same command makes links meet."""
    arm = ARMS[name]
    fold = {"sawyer": [0, -1.0, 0, 2.9, 0, 1.4, 0], "panda": [0, -0.9, 0, -3.0, 0, 0.4, 0.8]}[name]
    own = SelfClearance(arm, 0.01)

    def nearest(keeper):
        q, velocity, least = arm.home.copy(), np.zeros(arm.n_joints), np.inf
        for _ in range(600):
            command = Command(np.zeros(6), joint_velocity=2.0 * (np.array(fold) - q))
            velocity = keeper.step(command, q, velocity, Scene()).velocity
            q = q + DT * velocity
            least = min(least, own.distance(q))
        return least

    assert nearest(SafetyFilter(arm, self_clearance=None)) < 0.0
    assert nearest(SafetyFilter(arm, self_clearance=0.01)) > 0.008


def test_where_no_safe_motion_exists_it_says_so_and_leaves_what_is_near():
    """A floor that is nearer than required: the acceleration limits let the arm retreat only slowly."""
    arm = ARMS["panda"]
    tool = arm.tool_pose(arm.home).position
    scene = Scene(None, [HalfSpace([0.0, 0.0, tool[2] - 0.05], [0.0, 0.0, 1.0])])
    keeper = SafetyFilter(arm, clearance=0.3)
    kept = keeper.step(Command(np.zeros(6)), arm.home, np.zeros(arm.n_joints), scene)
    assert not kept.safe and kept.slack > 0.0
    hand = arm.cover.links >= 5
    lowest = [
        (c[:, 2] - r)[hand].min() for c, r in map(arm.collision_spheres, (arm.home, arm.home + DT * kept.velocity))
    ]
    assert lowest[1] > lowest[0]


def test_clearances_need_the_quadratic_program_and_bad_numbers_are_refused():
    arm = ARMS["sawyer"]
    scene = Scene(None, [Sphere(arm.tool_pose(arm.home).position + [0.15, 0, 0], 0.05)])
    with pytest.raises(InputError, match="use method='qp'"):
        SafetyFilter(arm, method="dls").step(Command(np.zeros(6)), arm.home, None, scene)
    with pytest.raises(InputError, match="clearance"):
        SafetyFilter(arm, clearance=-0.1)
    with pytest.raises(InputError, match="velocity must be 7"):
        SafetyFilter(arm).step(Command(np.zeros(6)), arm.home, [0.0], Scene())


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_every_row_holds_whenever_a_safe_motion_is_reported(seed):
    arm, rng = ARMS["panda"], np.random.default_rng(seed)
    scene, velocity = random_scene(arm, rng), 0.1 * rng.normal(size=7)
    q = np.clip(arm.home + 0.2 * rng.normal(size=7), arm.lower, arm.upper)
    kept = SafetyFilter(arm, clearance=0.02).step(random_command(rng, 7), q, velocity, scene)
    for rows in (ClearanceLimit(arm, 0.021).rows(q, scene), SelfClearance(arm, 0.01).rows(q)):
        if rows is not None and kept.safe:
            assert np.all(rows.matrix @ kept.velocity >= rows.lower - 1e-5)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"twist": [0.0] * 5}, "twist"),
        ({"twist": [np.nan] * 6}, "twist"),
        ({"joint_velocity": [np.inf] * 7}, "joint_velocity"),
        ({"posture": "home"}, "posture"),
        ({"elbow": np.nan}, "elbow"),
        ({"status": "fine"}, "status"),
    ],
)
def test_a_command_that_can_not_be_used_is_refused(values, said):
    with pytest.raises(InputError, match=f"Command: {said}"):
        Command(**{"twist": np.zeros(6), **values})
    assert Command(np.zeros(6)).status is Status.NOMINAL
