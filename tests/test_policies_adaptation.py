"""adapt(): options, errors, moved goals, tools wider than their tip."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import narrow_gap, sparse_clutter
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.pose import Pose, quaternion_exp, rotate
from imitarm.policies import ADAPTERS, HORIZONTAL_ONLY, PathAdapter, adapt
from imitarm.policies.baselines.potential_components import FORCES, component_distances, push_components
from imitarm.policies.component_path import ComponentPath, quintic_step
from imitarm.scene import Box, Scene, Sphere
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Trajectory


@pytest.fixture(scope="module")
def spatial():
    return learn(planar=False)


@pytest.fixture(scope="module")
def turning():
    """A skill that moves 0.6 m along x while the tool turns by 100 degrees about z."""
    rng = np.random.default_rng(3)
    times = np.linspace(0.0, 4.0, 150)
    u = quintic_step(times / 4.0)
    shown = []
    for i in range(5):
        positions = np.stack([0.6 * u, 0.01 * rng.normal() * np.sin(np.pi * u), 0.3 + 0.01 * rng.normal() * u], axis=1)
        turns = np.stack([0 * u, 0 * u, np.deg2rad(100) * u], axis=1) + 0.01 * rng.normal(size=3)
        shown.append(Demonstration(Trajectory(times, positions, quaternion_exp(turns)), source=str(i)))
    return Skill(n_components=7).fit(shown)


def test_unknown_method_lists_the_known_ones(spatial):
    with pytest.raises(UnknownNameError, match="certified, literal, mapf"):
        adapt(spatial[0], Scene(), "magic", tool_radius=0.0)


def test_a_refusal_names_both_clearances_so_that_they_differ(spatial):
    """Just under the required clearance, and a required clearance below one millimetre."""
    goal = spatial[0].goal_.position
    for required, short in ((0.02, 4e-4), (0.0004, 3e-4)):
        ball = Sphere(goal + [0.0, 0.0, 0.05 + required - short], 0.05)
        reason = adapt(spatial[0], Scene(None, [ball]), tool_radius=0.0, clearance=required).reason
        assert f"leaves {1e3 * (required - short):.1f} mm of clearance at the goal ({1e3 * required:g} mm req" in reason


def test_a_refusal_says_that_a_rotating_obstacle_counts_as_a_sphere(spatial):
    goal = spatial[0].goal_
    blade = Box(Pose(goal.position + [0.0, 0.0, 0.1], [1, 0, 0, 0]), [0.4, 0.02, 0.02], angular_velocity=[0, 0, 1.0])
    reason = adapt(spatial[0], Scene(None, [blade]), tool_radius=0.0).reason
    assert "box 1 (it rotates, so it counts as a sphere that contains it) covers the goal" in reason


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tool_radius": -0.01}, "tool_radius must be a finite number of at least 0"),
        ({"tool_radius": float("nan")}, "tool_radius must be a finite number"),
        ({"tool_radius": "wide"}, "tool_radius must be a finite number"),
        ({"clearance": float("nan")}, "clearance must be a finite number"),
        ({"clearance": -0.01}, "clearance must be a finite number of at least 0"),
        ({"forbidden": [[0, 0, 0]]}, "a direction is zero"),
        ({"forbidden": [1.0, 2.0]}, r"shape \(n, 3\)"),
        ({"forbidden": [[0, 0, np.inf]]}, "must be finite"),
        ({"start": [0, 0, 0]}, "start must be a Pose"),
        ({"n_samples": 100.0}, "whole number"),
        ({"pinned": [np.nan]}, "pinned must be finite"),
        ({"tool_radius": None}, "exactly one of tool_radius .* got none"),
        ({"tool_radius": None, "arm": "sawyer"}, "arm must be a ArmModel"),
        ({"n_samples": 3}, "at least 10"),
        ({"pinned": [99.0]}, "outside the motion"),
        ({"tool_radius": 0.1, "tool_spheres": [[0, 0, 0, 0.1]]}, "exactly one of"),
        ({"tool_spheres": [[0, 0, 0]]}, r"shape \(n, 4\)"),
        ({"tool_spheres": [[0, 0, 0, -1]]}, "r >= 0"),
        ({"tool_spheres": [[0, 0, 0.1, 0.02]]}, "orientation, which was not learned"),
    ],
)
def test_bad_options_say_what_is_wrong(spatial, options, message):
    with pytest.raises(InputError, match=message):
        spheres = "tool_spheres" in options
        adapt(spatial[0], Scene(), **({} if spheres else {"tool_radius": 0.0}) | options)


def test_without_obstacles_nothing_changes(spatial):
    adaptation = adapt(spatial[0], Scene(), tool_radius=0.0)
    assert adaptation.feasible and adaptation.reason == "" and adaptation.certified_clearance == np.inf
    assert not adaptation.moved.any() and adaptation.unmoved_fraction == 1.0 and adaptation.rmse_to_nominal == 0.0
    np.testing.assert_array_equal(adaptation.trajectory.positions, adaptation.nominal.positions)


def test_a_goal_that_moved_is_reached_and_the_components_ride_along(spatial):
    skill, _ = spatial
    goal = Pose(np.add(skill.goal_.position, [0.05, -0.08, 0.04]), [1, 0, 0, 0])
    adaptation = adapt(skill, Scene(goal, [Sphere([0.3, 0.0, 0.33], 0.03)]), tool_radius=0.03)
    assert adaptation.feasible
    np.testing.assert_allclose(adaptation.trajectory.positions[-1], goal.position, atol=2e-3)
    np.testing.assert_allclose(adaptation.trajectory.positions[0], skill.start_.position, atol=2e-3)
    learnt = ComponentPath.of_skill(skill)
    assert np.linalg.norm(adaptation.means[-1] - learnt.means[-1]) > 0.05
    assert np.linalg.norm(adaptation.means[0] - learnt.means[0]) < 0.01


def test_a_decomposed_path_is_adapted_as_the_skill_is(spatial):
    skill, path = spatial
    scene = Scene(None, [Sphere(path[len(path) // 2], 0.03)])
    whole = adapt(skill, scene, tool_radius=0.03, pinned=[1.0], n_samples=150)
    parts = ComponentPath.of_skill(skill, pinned=[1.0], n_samples=150)
    np.testing.assert_array_equal(
        adapt(parts, scene, tool_radius=0.03).trajectory.positions, whole.trajectory.positions
    )
    goal = Pose(np.add(skill.goal_.position, [0.05, -0.08, 0.04]), [1, 0, 0, 0])
    elsewhere = Scene(goal, scene.obstacles)
    moved = adapt(parts.between(skill, None, goal), elsewhere, tool_radius=0.03)
    np.testing.assert_allclose(moved.trajectory.positions[-1], goal.position, atol=1e-9)
    with pytest.raises(InputError, match="does not end at the scene's goal"):
        adapt(parts, elsewhere, tool_radius=0.03)
    for given in ({"start": skill.start_}, {"pinned": [1.0]}, {"n_samples": 150}):
        with pytest.raises(InputError, match="has its own start, pinned times and samples"):
            adapt(parts, scene, tool_radius=0.03, **given)


def test_fitting_again_forgets_the_path_that_was_kept():
    skill, _ = learn(planar=False)
    first = ComponentPath.of_skill(skill)
    assert ComponentPath.of_skill(skill).nominal is first.nominal  # kept: no scene changes it
    other = [
        Demonstration(Trajectory([0.0, 1.0, 2.0, 3.0], np.eye(3)[[0, 1, 2, 0]] * s), source="") for s in (1.0, 1.1)
    ]
    skill.gmr_.n_components = 2
    skill.gmr_.fit(other)
    again = ComponentPath.of_skill(skill)
    assert again.nominal is not first.nominal
    assert np.abs(again.nominal.positions - first.nominal.positions).max() > 0.1


def test_every_sphere_of_a_turning_tool_keeps_clear(turning):
    """A bar sticks out of the tool by 12 cm and turns with it; the tip alone would pass, the bar would not."""
    spheres = np.array([[0.12 * s, 0.0, 0.0, 0.02] for s in (0.0, 0.5, 1.0)])
    box = Box(Pose([0.42, 0.10, 0.3], [1, 0, 0, 0]), [0.05, 0.05, 0.3])
    scene = Scene(None, [box])
    tip_only = adapt(turning, scene, tool_radius=0.02, clearance=0.02)
    assert not tip_only.moved.any()
    whole = adapt(turning, scene, tool_spheres=spheres, clearance=0.02)
    assert whole.feasible and whole.moved.any()

    def measured(trajectory):
        times = np.linspace(0.0, turning.duration_, 3000)
        positions, quaternions = trajectory.at(times)
        centres = [positions + rotate(quaternions, s[:3]) for s in spheres]
        return min(box.signed_distance(c).min() - s[3] for c, s in zip(centres, spheres, strict=True))

    assert measured(tip_only.trajectory) < 0.0
    assert whole.certified_clearance <= measured(whole.trajectory) + 1e-9
    assert measured(whole.trajectory) >= 0.02


def test_one_sphere_at_the_tip_is_the_same_as_a_radius(spatial):
    skill, path = spatial
    scene = sparse_clutter(5, path, n_obstacles=2, planar=False).scene
    one, other = adapt(skill, scene, tool_radius=0.03), adapt(skill, scene, tool_spheres=[[0, 0, 0, 0.03]])
    np.testing.assert_array_equal(one.trajectory.positions, other.trajectory.positions)


def test_adaptation_is_deterministic(spatial):
    skill, path = spatial
    scene = sparse_clutter(8, path, n_obstacles=3, planar=False).scene
    runs = [adapt(skill, scene, method, tool_radius=0.03).trajectory.positions for method in ADAPTERS for _ in range(2)]
    for a, b in zip(runs[::2], runs[1::2], strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_said_is_what_was_measured(spatial):
    skill, path = spatial
    for seed in range(10):
        case = sparse_clutter(seed, path, n_obstacles=2, planar=False)
        for method in ADAPTERS:
            adaptation = adapt(skill, case.scene, method, tool_radius=0.03)
            at_samples = case.scene.clearance(adaptation.trajectory.positions).min() - 0.03
            assert adaptation.min_clearance == pytest.approx(at_samples, abs=1e-9)
            assert adaptation.certified_clearance <= adaptation.min_clearance + 1e-12
            assert adaptation.feasible == (adaptation.certified_clearance >= 0.02)
            assert bool(adaptation.reason) != adaptation.feasible


@pytest.mark.parametrize("method", sorted(FORCES))
def test_forces_are_minus_the_gradient_of_their_potential(method):
    """Central differences of the potential, with spread and influence distance frozen as the method freezes them."""
    reach = 0.05

    def potential(d, gain):
        d = max(d, 0.15 * reach)
        if d >= reach:
            return 0.0
        return 0.5 * (1 / d - 1 / reach) ** 2 if method == "literal" else 0.5 * gain * reach**2 * (reach / d - 1) ** 2

    normal = np.array([[[0.0, 0.6, 0.8]]])
    for d in np.linspace(0.009, 0.06, 25):
        force = FORCES[method](np.array([[d]]), normal, np.array([[0.01]]))[0, 0]
        slope = (potential(d + 1e-8, 1.0) - potential(d - 1e-8, 1.0)) / 2e-8
        np.testing.assert_allclose(force @ normal[0, 0], -slope, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(np.cross(force, normal[0, 0]), 0.0, atol=1e-9)


def test_the_spread_has_no_effect_on_the_literal_force_and_has_on_the_modified_one():
    distance, normal = np.full((1, 2), 0.02), np.tile([0.0, 0.0, 1.0], (1, 2, 1))
    tight, loose = np.array([[0.01, 0.01]]), np.array([[0.01, 0.03]])
    np.testing.assert_array_equal(
        FORCES["literal"](distance, normal, tight), FORCES["literal"](distance, normal, loose)
    )
    modified = FORCES["mapf"](distance, normal, loose)[0, :, 2]
    assert modified[1] > modified[0]  # loosely demonstrated components yield more


def test_component_distance_is_a_lower_bound_of_the_distance_to_the_ellipse(spatial):
    skill, path = spatial
    parts = ComponentPath.of_skill(skill)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for seed in range(10):
        scene = sparse_clutter(seed, path, n_obstacles=2, planar=False).scene
        still = np.zeros((parts.n_components, 3))
        bound, _, _ = component_distances(parts, still, scene.obstacles, 0.0)
        for k in range(parts.n_components):
            surface = parts.means[k] + directions @ np.linalg.cholesky(parts.covariances[k]).T
            for o, obstacle in enumerate(scene.obstacles):
                if obstacle.signed_distance(parts.means[k]) > 0:
                    assert bound[o, k] <= obstacle.signed_distance(surface).min() + 1e-9


def test_pushed_components_keep_forbidden_directions():
    skill, path = learn(planar=True)
    parts = ComponentPath.of_skill(skill)
    scene = Scene(None, [Sphere(path[200] + [0.0, 0.0, 0.02], 0.04)])
    for method in FORCES:
        pushed = push_components(parts, scene.obstacles, 0.05, method=method, forbidden=np.array(HORIZONTAL_ONLY))
        assert np.abs(pushed).max() > 0.0 and np.abs(pushed[:, 2]).max() == 0.0


def near_an_end(seed, path):
    """An obstacle just ahead of the start or the goal, which it leaves barely clear."""
    rng = np.random.default_rng([21, seed])
    end, inward = (path[0], path[45] - path[0]) if rng.random() < 0.5 else (path[-1], path[-45] - path[-1])
    direction = inward / np.linalg.norm(inward) + 0.1 * rng.normal(size=3)
    radius = rng.uniform(0.02, 0.05)
    gap = 0.03 + 0.02 + 10 ** rng.uniform(-6, -2.5)
    return Scene(None, [Sphere(end + direction / np.linalg.norm(direction) * (radius + gap), radius)])


def test_next_to_an_end_a_path_is_found_within_the_stated_limits(spatial):
    """No path leads absurdly far or jumps, although little can move next to a point that must not move."""
    skill, path = spatial
    for seed in range(40):
        adaptation = adapt(skill, near_an_end(seed, path), tool_radius=0.03)
        assert adaptation.feasible, (seed, adaptation.reason)
        nominal, done = adaptation.nominal.positions, adaptation.trajectory.positions
        steps = [np.linalg.norm(np.diff(p, axis=0), axis=1).max() for p in (done, nominal)]
        assert np.linalg.norm(done - nominal, axis=1).max() <= 0.5
        assert steps[0] <= 8.0 * steps[1]


def test_a_path_beyond_the_stated_limits_is_refused(spatial):
    """A wall whose ends are farther away than the largest displacement."""
    skill, path = spatial
    wall = Box(Pose(path[200], [1, 0, 0, 0]), [0.02, 1.2, 1.2], name="wall")
    adaptation = adapt(skill, Scene(None, [wall]), tool_radius=0.03)
    assert not adaptation.feasible and 'box "wall"' in adaptation.reason and "move" in adaptation.reason
    smaller = Box(Pose(path[200], [1, 0, 0, 0]), [0.02, 0.7, 0.7])
    assert adapt(skill, Scene(None, [smaller]), tool_radius=0.03).feasible


def test_what_a_refusal_says_of_its_best_attempt_is_proven():
    skill, path = learn(planar=True)
    for seed in range(15):
        case = narrow_gap(seed, path, solvable=False)
        adaptation = adapt(skill, case.scene, tool_radius=0.03, forbidden=case.forbidden)
        assert not adaptation.feasible
        times = np.linspace(0.0, skill.duration_, 4000)
        dense = case.scene.clearance(adaptation.trajectory.at(times)[0]).min() - 0.03
        assert adaptation.certified_clearance <= dense + 1e-9


def test_an_adaptation_is_shown_in_a_line_and_in_a_table(spatial):
    skill, path = spatial
    shown = adapt(skill, Scene(None, [Sphere(path[200], 0.03)]), tool_radius=0.03)
    assert "feasible, certified clearance 2" in repr(shown) and len(repr(shown)) < 160
    assert "certified clearance" in shown._repr_html_() and "not planned" in shown._repr_html_()
    refused = adapt(skill, Scene(None, [Sphere(path[0], 0.03, name="<jar>")]), tool_radius=0.03)
    assert "not feasible" in repr(refused) and "<jar>" not in refused._repr_html_()
    assert shown.joints is None


def test_another_package_can_add_a_method(spatial, monkeypatch):
    """One object: it moves nothing, so that its path is the nominal one."""

    class Still(PathAdapter):
        def detour(self, problem):
            return problem.evaluated(np.zeros((problem.path.n_components, 3)))

    monkeypatch.setitem(ADAPTERS._loaded, "still", Still())
    skill, path = spatial
    adaptation = adapt(skill, Scene(None, [Sphere(path[200], 0.03)]), "still", tool_radius=0.0)
    assert not adaptation.moved.any() and not adaptation.feasible
    assert "try method 'certified'" in adaptation.reason


@pytest.mark.parametrize("n_samples", [10, 37, 200])
def test_pinned_instants_between_samples_do_not_move(spatial, n_samples):
    skill, path = spatial
    pin = 0.4137 * skill.duration_
    scene = Scene(None, [Sphere(path[230], 0.03)])
    adaptation = adapt(skill, scene, tool_radius=0.02, pinned=[pin], n_samples=n_samples)
    assert adaptation.moved.any()
    at, _ = adaptation.trajectory.at([pin])
    np.testing.assert_allclose(at[0], adaptation.nominal.at([pin])[0][0], atol=1e-12)
    on_it = Scene(None, [Sphere(skill.gmr_.predict([pin])[0][0], 0.02, name="jar")])
    refused = adapt(skill, on_it, tool_radius=0.02, pinned=[pin], n_samples=n_samples)
    assert 'sphere "jar" covers the pinned point at' in refused.reason
