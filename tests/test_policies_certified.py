"""Certified ACFRA: rates over seeded scenes, judged by geometry that the method did not compute."""

from __future__ import annotations

import copy
from dataclasses import replace

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from imitarm.benchmark import families
from imitarm.benchmark.avoidance import SLACK, evaluate, learn, run_family, wilson_interval
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS
from imitarm.benchmark.static_scenes import static_case
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN, adapt
from imitarm.policies.certificate import ToolAmongObstacles
from imitarm.policies.certified import CERTIFIED, _SideSearch
from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import UNBOUNDED, AllowedDirections, AvoidanceProblem, least_norm
from imitarm.scene import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Scene, Sphere

OPTIONS = {"tool_radius": TOOL_RADIUS, "clearance": CLEARANCE}


@pytest.fixture(scope="module", params=[True, False], ids=["2-D", "3-D"])
def learnt(request):
    planar = request.param
    return planar, *learn(planar=planar)


@pytest.mark.slow
def test_a_thousand_scenes_keep_the_clearance(learnt):
    planar, skill, path = learnt
    for n_obstacles, first, last in ((1, 0, 334), (2, 334, 667), (3, 667, 1000)):
        cases = [
            families.sparse_clutter(seed, path, n_obstacles=n_obstacles, planar=planar) for seed in range(first, last)
        ]
        outcomes = run_family(skill, cases)
        refused = [first + i for i, o in enumerate(outcomes) if not o.accepted]
        near = [(first + i, o.clearance) for i, o in enumerate(outcomes) if o.accepted and not o.kept]
        assert not refused, f"{n_obstacles} obstacles: refused although solvable: seeds {refused}"
        assert not near, f"{n_obstacles} obstacles: accepted but nearer than asked: {near}"


@pytest.mark.parametrize(
    ("planar", "seed"),
    [
        pytest.param(False, 906, id="the bound of two tangents is far below the true distance"),
        pytest.param(True, 2325, id="long steps cut a corner between samples"),
        pytest.param(True, 803, id="a detour of 40 cm whose corner is cut by several segments"),
    ],
)
def test_the_answer_does_not_hang_on_rounding(planar, seed):
    """Scenes that were solved or refused as the CPU happened to round."""
    skill, path = learn(planar=planar)
    case = families.sparse_clutter(seed, path, n_obstacles=3, planar=planar)
    rng = np.random.default_rng(seed)
    lengths = []
    for size in (0.0, *[1e-12] * 5, *[1e-9] * 15):
        shaken = [replace(o, velocity=rng.uniform(-size, size, 3)).after(1.0) for o in case.scene.obstacles]
        adaptation = adapt(skill, Scene(None, shaken), forbidden=case.forbidden, **OPTIONS)
        assert adaptation.feasible, adaptation.reason
        assert evaluate(case, adaptation).kept
        lengths.append(adaptation.rmse_to_nominal)
    assert np.ptp(lengths) < 1e-4  # one and the same detour, not another way round


def test_no_place_is_tried_twice(monkeypatch):
    """Where there is no path, no choice of a side leads back to a displacement that was already tried."""
    skill, path = learn(planar=True)
    case = families.narrow_gap(0, path, solvable=False)
    places, children = [], _SideSearch._children

    def recorded(self, displacement, *rest):
        places.append(displacement)
        return children(self, displacement, *rest)

    monkeypatch.setattr(_SideSearch, "_children", recorded)
    monkeypatch.setattr("imitarm.policies.certified._HARDLY_CHEAPER", np.inf)  # try further sides before the roadmap
    assert not adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS).feasible
    assert len(places) > 1
    for i, place in enumerate(places):
        assert all(np.abs(place - other).max() >= 1e-5 for other in places[:i])


def test_in_a_plane_a_hopeless_roadmap_ends_the_search_over_sides(monkeypatch):
    """The roadmap refuses a gap that is too narrow before the other sides are tried, and the answer stays the same."""
    skill, path = learn(planar=True)
    cases = [families.narrow_gap(seed, path, solvable=seed % 2 == 0) for seed in range(20)]
    expanded, children = [], _SideSearch._children
    monkeypatch.setattr(_SideSearch, "_children", lambda *given: expanded.append(0) or children(*given))

    def answers():
        expanded.clear()
        return [adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS).feasible for case in cases]

    early, n_early = answers(), len(expanded)
    monkeypatch.setattr("imitarm.policies.certified._HARDLY_CHEAPER", np.inf)
    assert early == answers() == [case.solvable for case in cases]
    assert n_early < len(expanded)


def test_the_scenes_are_not_void(learnt):
    """Without avoidance nearly every scene collides, so keeping the clearance means something."""
    planar, _, path = learnt
    cases = [families.sparse_clutter(seed, path, n_obstacles=2, planar=planar) for seed in range(100)]
    free = [case.scene.clearance(path).min() > TOOL_RADIUS for case in cases]
    assert np.mean(free) < 0.05


def test_the_potential_fields_do_worse(learnt):
    planar, skill, path = learnt
    cases = [families.sparse_clutter(seed, path, n_obstacles=2, planar=planar) for seed in range(30)]
    for method in ("literal", "mapf"):
        outcomes = run_family(skill, cases, method)
        assert sum(o.kept for o in outcomes) < 30
        assert all(o.kept for o in outcomes if o.accepted), "accepted although it does not keep the clearance"


def test_covered_ends_are_refused_by_name(learnt):
    planar, skill, path = learnt
    for seed in range(60):
        case = families.covered_end(seed, path, planar=planar)
        adaptation = adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS)
        assert not adaptation.feasible
        assert "sphere" in adaptation.reason
        assert "start" in adaptation.reason or "goal" in adaptation.reason
        assert "move the obstacle" in adaptation.reason


def test_gaps_are_taken_when_wide_enough_and_refused_when_not():
    skill, path = learn(planar=True)
    for seed in range(60):
        wide = families.narrow_gap(seed, path, solvable=True)
        outcome = evaluate(wide, adapt(skill, wide.scene, forbidden=wide.forbidden, **OPTIONS))
        assert outcome.accepted and outcome.kept, seed
        narrow = families.narrow_gap(seed, path, solvable=False)
        adaptation = adapt(skill, narrow.scene, forbidden=narrow.forbidden, **OPTIONS)
        assert not adaptation.feasible, seed
        assert "wall" in adaptation.reason and "forbidden direction" in adaptation.reason


def test_a_wall_is_passed_above_where_that_is_allowed():
    skill, path = learn(planar=True)
    middle = path[len(path) // 2]
    wall = Box(Pose(middle, [1, 0, 0, 0]), [0.04, 3.0, 0.08], name="wall")
    scene = Scene(None, [wall])
    assert not adapt(skill, scene, forbidden=HORIZONTAL_ONLY, **OPTIONS).feasible
    over = adapt(skill, scene, forbidden=NOT_DOWN, **OPTIONS)
    assert over.feasible
    assert np.all(over.displacement[:, 2] >= -1e-9)
    assert over.trajectory.positions[:, 2].max() > middle[2] + 0.08


def test_forbidden_directions_are_kept_exactly():
    skill, path = learn(planar=True)
    for seed in range(40):
        case = families.sparse_clutter(seed, path, n_obstacles=2, planar=True)
        adaptation = adapt(skill, case.scene, forbidden=HORIZONTAL_ONLY, **OPTIONS)
        assert np.abs(adaptation.displacement[:, 2]).max() < 1e-9
        np.testing.assert_allclose(adaptation.trajectory.positions[:, 2], adaptation.nominal.positions[:, 2], atol=1e-9)


def test_only_affected_components_move_and_the_rest_is_bit_identical(learnt):
    planar, skill, path = learnt
    still = 0
    for seed in range(40):
        case = families.sparse_clutter(seed, path, n_obstacles=1, planar=planar)
        adaptation = adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS)
        untouched = adaptation.responsibilities[:, adaptation.moved].max(axis=1, initial=0.0) < 1e-6
        np.testing.assert_array_equal(
            adaptation.trajectory.positions[untouched], adaptation.nominal.positions[untouched]
        )
        still += int(untouched.sum())
        assert adaptation.unmoved_fraction > 0.0
    assert still > 0


def test_start_and_goal_stay(learnt):
    planar, skill, path = learnt
    for seed in range(20):
        case = families.sparse_clutter(seed, path, n_obstacles=3, planar=planar)
        adaptation = adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS)
        for end in (0, -1):
            np.testing.assert_array_equal(adaptation.trajectory.positions[end], adaptation.nominal.positions[end])


def test_an_obstacle_far_away_bends_nothing(learnt):
    _, skill, _ = learnt
    adaptation = adapt(skill, Scene(None, [Sphere([50.0, 0, 0], 0.1)]), **OPTIONS)
    assert adaptation.feasible and not adaptation.moved.any()
    np.testing.assert_array_equal(adaptation.trajectory.positions, adaptation.nominal.positions)


def test_a_head_on_obstacle_is_passed_with_the_asked_clearance(learnt):
    """Where steering-angle terms vanish: the obstacle's centre is exactly on the path."""
    planar, skill, path = learnt
    scene = Scene(None, [Sphere(path[len(path) // 2], 0.04)])
    adaptation = adapt(skill, scene, forbidden=HORIZONTAL_ONLY if planar else (), **OPTIONS)
    assert adaptation.feasible
    assert adaptation.min_clearance >= CLEARANCE


def test_pinned_instants_stay_and_covered_ones_are_refused():
    skill, path = learn(planar=True)
    pin = 0.5 * skill.duration_
    beside = Scene(None, [Sphere(path[120], 0.03)])
    adaptation = adapt(skill, beside, forbidden=HORIZONTAL_ONLY, pinned=[pin], n_samples=201, **OPTIONS)
    np.testing.assert_array_equal(adaptation.trajectory.positions[100], adaptation.nominal.positions[100])
    assert adaptation.feasible
    on_it = Scene(None, [Sphere(path[200], 0.03, name="cup")])
    refused = adapt(skill, on_it, forbidden=HORIZONTAL_ONLY, pinned=[pin], n_samples=201, **OPTIONS)
    assert not refused.feasible and "pinned point" in refused.reason and "cup" in refused.reason


def test_the_path_stays_smooth(learnt):
    """The jerk of the detour is of the size that its extent and width explain, with no kinks at samples."""
    planar, skill, path = learnt
    for seed in range(20):
        case = families.sparse_clutter(seed, path, n_obstacles=1, planar=planar)
        positions = adapt(skill, case.scene, forbidden=case.forbidden, n_samples=801, **OPTIONS).trajectory.positions
        fine, coarse = (np.abs(np.diff(positions[::s], n=3, axis=0)).max() / s**3 for s in (2, 4))
        assert fine < 2.0 * coarse  # a kink in the velocity would grow fourfold


def _coal_distance(obstacle, points):
    """Smallest distance from ``points`` to the obstacle, by a distance library that shares no code with ours."""
    pose = Pose([0, 0, 0], [1, 0, 0, 0])
    match obstacle:
        case Sphere():
            shape, pose = coal.Sphere(obstacle.radius), Pose(obstacle.center, [1, 0, 0, 0])
        case Box():
            shape, pose = coal.Box(*map(float, obstacle.size)), obstacle.pose
        case Cylinder():
            shape, pose = coal.Cylinder(obstacle.radius, obstacle.length), obstacle.pose
        case Ellipsoid():
            shape, pose = coal.Ellipsoid(*map(float, obstacle.semi_axes)), obstacle.pose
        case Capsule():
            axis = obstacle.end - obstacle.start
            length = float(np.linalg.norm(axis))
            turn = np.cross([0, 0, 1], axis / length)
            angle = np.arctan2(np.linalg.norm(turn), axis[2] / length)
            vector = turn / max(np.linalg.norm(turn), 1e-12) * angle
            shape = coal.Capsule(obstacle.radius, length)
            pose = Pose(0.5 * (obstacle.start + obstacle.end), quaternion_exp(vector))
        case ConvexHull():
            vertices = coal.StdVec_Vec3s()
            vertices.extend([np.asarray(p, dtype=float) for p in obstacle.points])
            shape = coal.Convex.convexHull(vertices, False, "Qt")
    at = coal.Transform3s(pose.rotation, pose.position)
    ball = coal.Sphere(1e-6)
    request, best = coal.DistanceRequest(), np.inf
    for point in points:
        result = coal.DistanceResult()
        coal.distance(shape, at, ball, coal.Transform3s(np.eye(3), point), request, result)
        best = min(best, result.min_distance + 1e-6)
    return best


def test_an_independent_distance_library_agrees(learnt):
    planar, skill, path = learnt
    for seed in range(1000, 1025):
        case = families.sparse_clutter(seed, path, n_obstacles=3, planar=planar)
        adaptation = adapt(skill, case.scene, forbidden=case.forbidden, **OPTIONS)
        points, _ = adaptation.trajectory.at(np.linspace(0.0, skill.duration_, 700))
        for obstacle in case.scene.obstacles:
            assert _coal_distance(obstacle, points) - TOOL_RADIUS >= CLEARANCE - SLACK


def clearance_of(obstacles, polyline, *, radius=0.0, offset=None, bow=0.0):
    """Distances of one sphere to obstacles along a polyline, with any offsets of its centre."""
    n = len(polyline)
    offsets = tuple(None if offset is None else offset[None] for _ in obstacles)
    spheres = np.array([[0.0, 0.0, 0.0, radius]])
    bows, none = np.full((1, n - 1), bow), (None,) * len(obstacles)
    tool = ToolAmongObstacles(tuple(obstacles), spheres, spheres[:, 3], offsets, bows, np.arange(float(n)), none)
    return tool.clearance_of(polyline)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_the_certificate_is_a_lower_bound_on_the_whole_polyline(seed):
    rng = np.random.default_rng(seed)
    polyline = np.cumsum(rng.normal(size=(8, 3)) * 0.1, axis=0)
    obstacles = [families.random_obstacle(rng, rng.normal(size=3) * 0.1, planar=False) for _ in range(3)]
    along = clearance_of(obstacles, polyline)
    bounds = along.segment_bounds()
    u = np.linspace(0.0, 1.0, 200)[:, None, None]
    dense = polyline[:-1] * (1 - u) + polyline[1:] * u  # (200, 7, 3)
    for i, obstacle in enumerate(obstacles):
        assert np.all(bounds[i] <= obstacle.signed_distance(dense).min(axis=0) + 1e-9)
        assert np.all(bounds[i] <= along.distance[i, :-1] + 1e-12)
        assert np.all(bounds[i] <= along.distance[i, 1:] + 1e-12)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.003]))
def test_a_closer_look_proves_the_clearance_or_finds_where_it_is_missing(seed, bow):
    """Nothing in between: each segment whose samples are clear is proven, or has a point that is truly closer."""
    rng = np.random.default_rng(seed)
    polyline = np.cumsum(rng.normal(size=(30, 3)) * 0.03, axis=0)
    offset = None if bow == 0.0 else rng.normal(size=(30, 3)) * 0.01
    obstacles = [families.random_obstacle(rng, polyline[10] + rng.normal(size=3) * 0.1, planar=False) for _ in range(3)]
    along = clearance_of(obstacles, polyline, radius=0.01, offset=offset, bow=bow)
    rough, distance = along.segment_bounds(), along.distance
    clearance = float(np.quantile(rough, 0.3))
    bounds, close = along.certified(clearance)
    assert np.all(bounds >= rough)
    short = (bounds < clearance) & (distance[:, :-1] >= clearance) & (distance[:, 1:] >= clearance)
    assert sorted(zip(close.pair, close.segment, strict=True)) == [tuple(at) for at in np.argwhere(short)]
    u = np.linspace(0.0, 1.0, 200)[:, None, None]
    centres = polyline if offset is None else polyline + offset
    for i, obstacle in enumerate(obstacles):
        dense = obstacle.signed_distance(centres[:-1] * (1 - u) + centres[1:] * u) - 0.01 - bow
        assert np.all(bounds[i] <= dense.min(axis=0) + 1e-9)
    measured, _ = along.at(close)
    assert np.all(measured < clearance + 1e-7)
    for i, j, s in zip(close.pair, close.segment, close.fraction, strict=True):
        assert obstacles[i].signed_distance(centres[j] * (1 - s) + centres[j + 1] * s) - 0.01 - bow < clearance + 1e-7


def test_moving_means_moves_the_path_by_the_affine_identity(learnt):
    """GMR whose means were moved equals x0 + H Delta: the regression itself is asked."""
    _, skill, _ = learnt
    gmr = skill.gmr_
    times = np.linspace(0.0, skill.duration_, 50)
    before, _ = gmr.predict(times)
    for seed in range(20):
        displacement = np.random.default_rng(seed).normal(size=(gmr.n_components_, 3)) * 0.05
        means = gmr.means_.copy()
        means[:, 1:4] += displacement
        moved = copy.copy(gmr)
        moved._learn(gmr.weights_, means, gmr.covariances_)
        after, _ = moved.predict(times)
        np.testing.assert_allclose(after, before + gmr.responsibilities(times) @ displacement, atol=1e-13)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
def test_least_norm_equals_an_independent_solver(seed):
    rng = np.random.default_rng(seed)
    n, m = 4, 6
    rows, lower = rng.normal(size=(m, n)), rng.normal(size=m) * 0.5 - 0.5
    y = least_norm(rows, lower, np.full(m, UNBOUNDED))
    peer = minimize(
        lambda v: v @ v,
        np.zeros(n),
        jac=lambda v: 2 * v,
        constraints={"type": "ineq", "fun": lambda v: rows @ v - lower, "jac": lambda v: rows},
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    if y is None:
        assert not peer.success
    else:
        assert np.all(rows @ y >= lower - 1e-6)
        assert not peer.success or y @ y <= peer.fun + 1e-6


def test_wilson_interval():
    low, high = wilson_interval(1000, 1000)
    assert 0.995 < low < 0.9965 and high == 1.0
    low, high = wilson_interval(50, 100)
    assert low == pytest.approx(0.4038, abs=1e-4) and high == pytest.approx(0.5962, abs=1e-4)


@pytest.mark.parametrize("seed", [2000, 2008])
def test_a_window_between_the_rays_of_the_roadmap_is_found(seed):
    case = static_case("S4", 3, seed)  # four walls around a window, a little wider than the tool with its clearance
    found = adapt(case.skill, case.scene, tool_spheres=case.tool_spheres, clearance=case.clearance)
    assert found.feasible, found.reason
    dense = found.trajectory.resample(4000).positions
    assert case.scene.clearance(dense).min() - case.tool_spheres[0, 3] >= case.clearance - 1e-5


@pytest.mark.parametrize(("dimension", "seed"), [(2, 2000), (3, 2006)])
def test_a_path_does_not_stray_where_the_components_are_wide(dimension, seed):
    case = static_case("S7", dimension, seed)  # before and after the dirt, at which the path must not move
    found = adapt(
        case.skill,
        case.scene,
        tool_spheres=case.tool_spheres,
        clearance=case.clearance,
        forbidden=case.forbidden,
        pinned=case.pinned,
    )
    away = np.linalg.norm(found.trajectory.positions - found.nominal.positions, axis=1)
    depth = case.clearance + case.tool_spheres[0, 3] - case.scene.clearance(found.nominal.positions).min()
    assert found.feasible and found.divided
    assert away.max() < 1.5 * depth  # 5 times with the learned components
    assert found.trajectory.path_length < 1.15 * found.nominal.path_length


def test_a_path_that_is_clear_needs_no_roadmap(learnt, monkeypatch):
    _, skill, path = learnt
    components, sphere = ComponentPath.of_skill(skill), np.array([[0.0, 0.0, 0.0, TOOL_RADIUS]])
    tool = ToolAmongObstacles.along(components.nominal, sphere, [Sphere(path[0] + 1.0, 0.1)])
    nominal = tool.clearance_of(components.nominal.positions)
    problem = AvoidanceProblem(components, nominal, CLEARANCE, AllowedDirections.without(np.empty((0, 3))))
    monkeypatch.setattr("imitarm.policies.certified.Roadmap", lambda *_, **__: pytest.fail("a roadmap was made"))
    found = CERTIFIED.detour(problem)
    assert found.feasible and not found.displacement.any()
