from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import sparse_clutter
from imitarm.errors import InfeasibleError, InputError
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN, POLICIES
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.coupled_motion import CoupledMotion, Surroundings
from imitarm.policies.baselines.dmp_potential import DMPPotential, dynamic_force, dynamic_potential
from imitarm.policies.baselines.dmp_steering import DMPSteering, steering_rate
from imitarm.scene import Scene, Sphere
from imitarm.skills.gmm import DegenerateAxisWarning
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory

SKILL, PATH = learn(planar=False)
PLANAR, PLANAR_PATH = learn(planar=True)
TOOL = [[0.0, 0.0, 0.0, 0.03]]
METHODS = pytest.mark.parametrize("method", [DMPSteering, DMPPotential])
seeds = st.integers(0, 10_000)


def straight_skill() -> Skill:
    u = np.linspace(0.0, 1.0, 200)
    pace = 10 * u**3 - 15 * u**4 + 6 * u**5
    line = Trajectory(u, pace[:, None] * [1.0, 0.0, 0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateAxisWarning)
        return Skill(n_components=4).fit([line] * 2)


class Push(CoupledMotion):
    """A coupling term that is a constant."""

    push = np.zeros(3)

    def term(self, state):
        return self.push


def moving_state(rng, *, spin=(0.0, 0.0, 0.0)):
    """Return a state among two random spheres, one of which moves, and the scene."""
    obstacles = [
        Sphere(rng.normal(size=3), 0.1),
        Sphere(rng.normal(size=3), 0.2, velocity=rng.normal(size=3), angular_velocity=spin),
    ]
    scene = Scene(None, obstacles)
    surroundings = Surroundings(ToolGaps(scene, TOOL), scene.packed, 0.02, 2.0)
    return surroundings.state(np.stack([1.5 * rng.normal(size=3), rng.normal(size=3)]), 0.3, np.zeros(3)), scene


def test_without_a_term_it_is_the_motion_of_the_primitive():
    times, positions = DMPSteering(SKILL).tool_path(
        SKILL.gmr_.trajectory(200), ToolGaps(Scene(None, []), None), Scene()
    )
    assert times[-1] == pytest.approx(SKILL.duration_) and len(times) == 401
    np.testing.assert_allclose(positions, SKILL.generate(dt=0.01).positions, atol=1e-9)


def test_a_constant_term_displaces_the_spring_as_far_as_its_stiffness_allows():
    """The closed form of a spring: K x = Phi; and the term is limited to the largest acceleration."""
    nominal = SKILL.gmr_.trajectory(200)
    free, bound = Push(SKILL, max_acceleration=100.0), Push(SKILL, max_acceleration=0.5)
    free.push = bound.push = np.array([0.0, 0.0, 30.0])
    ends = []
    for policy in (free, bound):
        with pytest.raises(InfeasibleError, match=r"Push: the tool is still \d+ mm from the goal") as error:
            policy.tool_path(nominal, ToolGaps(Scene(None, []), None), Scene())
        ends.append(float(str(error.value).split("still ")[1].split(" mm")[0]) / 1e3)
    K = SKILL.dmp_.gains_.stiffness
    np.testing.assert_allclose(ends, [30.0 / K, 0.5 * SKILL.duration_**2 / K], atol=6e-4)


@given(seeds)
def test_the_state_sees_the_closest_point_and_its_velocity(seed):
    rng = np.random.default_rng(seed)
    spin = rng.normal(size=3)
    state, scene = moving_state(rng, spin=spin)
    later = scene.at(0.6)
    distance, normal = later.distances_and_gradients(state.position)
    np.testing.assert_allclose(state.distance, np.maximum(distance - 0.05, 0.005), atol=1e-9)
    np.testing.assert_allclose(state.normal, normal, atol=1e-9)
    still, turning = later.obstacles
    np.testing.assert_allclose(state.relative[0], state.velocity, atol=1e-12)
    arm = state.position - distance[1] * normal[1] - turning.center
    np.testing.assert_allclose(
        state.relative[1], state.velocity - 2.0 * (turning.velocity + np.cross(spin, arm)), atol=1e-9
    )
    assert np.linalg.norm(still.velocity) == 0.0


def test_steering_rate_has_the_published_closed_form():
    """Hoffmann et al. 2009: the rate is largest at pi / 20 = 9 degrees for their beta = 20 / pi, and 0 head on."""
    angle = np.linspace(0.0, np.pi, 20001)
    rate = steering_rate(angle, 1000.0, 20.0 / np.pi)
    assert rate[0] == 0.0
    assert np.degrees(angle[rate.argmax()]) == pytest.approx(9.0, abs=0.01)
    assert rate.max() == pytest.approx(1000.0 * np.pi / 20.0 / np.e, rel=1e-6)


@given(seeds)
def test_steering_rotates_the_velocity_away_at_that_rate_and_does_not_change_its_length(seed):
    rng = np.random.default_rng(seed)
    state, _ = moving_state(rng)
    policy = DMPSteering(SKILL, gain=50.0, decay=3.0, distance_decay=4.0)
    one = state._replace(distance=state.distance[1:], normal=state.normal[1:], relative=state.relative[1:])
    phi, v, towards = policy.term(one), one.relative[0], -one.normal[0]
    angle = np.arccos(np.clip(towards @ v / np.linalg.norm(v), -1.0, 1.0))
    if angle >= np.pi / 2:
        assert not phi.any()
        return
    assert abs(phi @ v) < 1e-9 * np.linalg.norm(v) * (1.0 + np.linalg.norm(phi))
    size = steering_rate(angle, 50.0, 3.0) * np.exp(-4.0 * one.distance[0])
    assert np.linalg.norm(phi) == pytest.approx(size * np.linalg.norm(v), rel=1e-6)
    assert phi @ towards <= 1e-12


def test_steering_passes_a_point_on_both_sides_symmetrically_and_runs_into_it_head_on():
    """Hoffmann et al. 2009: paths around a point beside a straight path are mirror images of each other."""
    skill = straight_skill()
    policy = DMPSteering(skill, distance_decay=0.0, clearance=0.0)
    paths, gaps = [], []
    for y in (0.01, -0.01, 0.0):
        scene = Scene(None, [Sphere([0.5, y, 0.0], 1e-3)])
        path = policy.plan_motion(scene).trajectory.positions
        paths.append(path)
        gaps.append(scene.clearance(path).min())
    np.testing.assert_allclose(paths[0], paths[1] * [1.0, -1.0, 1.0], atol=1e-9)
    assert paths[0][:, 1].min() < -0.03 and min(gaps[:2]) > 0.02
    assert gaps[2] < 0.0
    np.testing.assert_allclose(paths[2][:, 1:], 0.0, atol=1e-9)


@given(seeds)
def test_the_dynamic_force_is_minus_the_gradient_of_its_potential(seed):
    """Park et al. 2008, with the closest point and the velocity held fixed, and a tool of some radius."""
    rng = np.random.default_rng(seed)
    v, closest, x = rng.normal(size=(1, 3)), rng.normal(size=(1, 3)), rng.normal(size=3)
    gain, exponent, radius = 0.3, rng.uniform(1.5, 4.0), 0.02

    def seen(position):
        away = position - closest
        reach = np.linalg.norm(away, axis=1)
        return away / reach[:, None], reach - radius, reach

    normal, distance, reach = seen(x)
    if distance[0] < 0.1:
        return
    force = dynamic_force(v, normal, distance, reach, gain, exponent)[0]
    h = 1e-6
    slope = [
        (
            dynamic_potential(v, *seen(x + h * axis)[:2], gain, exponent)
            - dynamic_potential(v, *seen(x - h * axis)[:2], gain, exponent)
        )[0]
        / (2.0 * h)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(force, -np.asarray(slope), atol=1e-5 * (1.0 + np.abs(force).max()))


def test_the_dynamic_potential_has_the_published_shape():
    """Park et al. 2008: 0 when leaving or passing; on the approach, proportional to the speed and to 1 / distance."""
    n = np.array([[1.0, 0.0, 0.0]])
    one = np.ones(1)
    for angle in np.radians([0.0, 45.0, 90.0]):
        v = np.array([[np.cos(angle), np.sin(angle), 0.0]])
        assert dynamic_potential(v, n, one, 2.0, 2.0)[0] == pytest.approx(0.0, abs=1e-15)
        assert np.linalg.norm(dynamic_force(v, n, one, one, 2.0, 2.0)) == pytest.approx(0.0, abs=1e-12)
    v = np.array([[np.cos(np.radians(120.0)), np.sin(np.radians(120.0)), 0.0]])
    assert dynamic_potential(v, n, one, 2.0, 2.0)[0] == pytest.approx(2.0 * 0.25)
    assert dynamic_potential(3.0 * v, n, 0.5 * one, 2.0, 2.0)[0] == pytest.approx(2.0 * 0.25 * 6.0)
    head_on = dynamic_force(-n, n, one, one, 2.0, 2.0)[0]
    np.testing.assert_allclose(head_on, [2.0, 0.0, 0.0], atol=1e-12)  # only slowed down: lambda v / p^2


@METHODS
@settings(max_examples=10)
@given(st.integers(0, 999))
def test_they_pass_one_obstacle_that_the_learned_motion_hits(method, seed):
    case = sparse_clutter(seed, PATH, n_obstacles=1, planar=False)
    options = {"decay": 2.0, "distance_decay": 30.0} if method is DMPSteering else {}
    plan = method(SKILL, tool_spheres=TOOL, **options).plan_motion(case.scene).trajectory
    gaps = ToolGaps(case.scene, TOOL)
    assert gaps.gaps(plan.positions).min() > max(0.0, gaps.gaps(PATH).min())
    np.testing.assert_allclose(plan.positions[[0, -1]], PATH[[0, -1]], atol=1e-3)


@METHODS
def test_with_a_gain_of_zero_or_an_obstacle_far_away_nothing_changes(method):
    near, far = Scene(None, [Sphere(PATH[200], 0.03)]), Scene(None, [Sphere(PATH[200] + [50.0, 0.0, 0.0], 0.03)])
    learned = SKILL.generate(dt=0.01).positions
    np.testing.assert_allclose(method(SKILL, gain=0.0).plan_motion(near).trajectory.positions, learned, atol=1e-9)
    np.testing.assert_allclose(method(SKILL).plan_motion(far).trajectory.positions, learned, atol=2e-4)


@METHODS
@settings(max_examples=5)
@given(st.integers(0, 999))
def test_no_part_of_the_path_is_displaced_in_a_forbidden_direction(method, seed):
    case = sparse_clutter(seed, PLANAR_PATH, n_obstacles=1, planar=True)
    plan = method(PLANAR, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(case.scene).trajectory
    np.testing.assert_allclose(plan.positions[:, 2], PLANAR_PATH[0, 2], atol=1e-6)
    case = sparse_clutter(seed, PATH, n_obstacles=1, planar=False)
    plan = method(SKILL, tool_spheres=TOOL, forbidden=NOT_DOWN).plan_motion(case.scene).trajectory
    learned = SKILL.generate(dt=0.01).positions
    learned = np.concatenate([learned, np.repeat(learned[-1:], len(plan), axis=0)])[: len(plan)]
    assert (plan.positions - learned)[:401, 2].min() > -1e-6


@METHODS
def test_a_mirrored_velocity_of_an_obstacle_gives_a_mirrored_path(method):
    skill = straight_skill()
    paths = []
    for side in (1.0, -1.0):
        velocity = np.array([0.0, 0.5 * side, 0.1])
        obstacle = Sphere(np.array([0.5, 0.01 * side, 0.0]) - 0.5 * velocity, 0.05)
        scene = Scene(None, [replace(obstacle, velocity=velocity)])
        policy = method(skill, tool_spheres=TOOL)
        paths.append(policy.plan_motion(scene).trajectory.positions)
    np.testing.assert_allclose(paths[0], paths[1] * [1.0, -1.0, 1.0], atol=1e-9)
    assert np.abs(paths[0][:, 1:]).max() > 0.002


@METHODS
def test_zero_velocity_is_the_same_as_an_obstacle_at_rest(method):
    at_rest = Sphere(PATH[200] + [0.0, 0.02, 0.0], 0.03)
    slow = replace(at_rest, velocity=[0.0, 0.0, 1e-12])
    paths = [
        method(SKILL, tool_spheres=TOOL).plan_motion(Scene(None, [o])).trajectory.positions for o in (at_rest, slow)
    ]
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-8)


def test_they_are_registered_with_options_to_search_and_check_their_options():
    for name, method in (("dmp-steering", DMPSteering), ("dmp-potential", DMPPotential)):
        assert POLICIES[name] is method
        for option, (low, high) in method.search_space.items():
            assert 0.0 < low < high and getattr(method(SKILL, **{option: high}), option) == high
    with pytest.raises(InputError, match="DMPPotential: exponent"):
        DMPPotential(SKILL, exponent=0.5)
    with pytest.raises(InputError, match="DMPSteering: max_acceleration"):
        DMPSteering(SKILL, max_acceleration=0.0)
