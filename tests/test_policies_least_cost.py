"""The parts of RCAMO: the response of a deviation, the cost of obstacles, the choice among the candidates."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.policies import DistanceCost, GaussianCost
from imitarm.policies.headings import allowed_axes, frame, headings
from imitarm.policies.least_cost import LeastCost, Prediction, Response
from imitarm.policies.obstacle_cost import Groups, PredictedObstacles
from imitarm.scene import Box, Ellipsoid, Scene, Sphere
from imitarm.skills.dynamical_systems import GAINS, Gains

TIMES = 0.05 * np.arange(1.0, 13.0)


@pytest.mark.parametrize("gains", [GAINS["critical"], GAINS["thesis"], Gains(100.0, 5.0)])
@pytest.mark.parametrize("tau", [1.0, 1.7])
def test_the_closed_form_of_a_deviation_solves_its_equation(gains, tau):
    e, v, u = 0.03, -0.2, 4.0

    def slope(t, z):
        return [z[1], u - (gains.damping * tau * z[1] + gains.stiffness * z[0]) / tau**2]

    numeric = solve_ivp(slope, (0.0, 0.7), [e, v], t_eval=TIMES, rtol=1e-10, atol=1e-12).y
    one = Response.of(gains, tau, TIMES)
    np.testing.assert_allclose(one.A * e + one.B * v + one.G * u, numeric[0], atol=1e-8)
    np.testing.assert_allclose(one.a_rate * e + one.b_rate * v + one.g_rate * u, numeric[1], atol=1e-7)


def predicted(rng, margin=0.0):
    pose = Pose(rng.uniform(-0.1, 0.1, 3), quaternion_exp(rng.uniform(-1.0, 1.0, 3)))
    covariance = np.diag(rng.uniform(1e-4, 9e-4, 3))
    obstacles = [
        Sphere(rng.uniform(-0.1, 0.1, 3), 0.04, velocity=rng.uniform(-0.3, 0.3, 3), covariance=covariance),
        Box(pose, [0.06, 0.1, 0.04], velocity=rng.uniform(-0.3, 0.3, 3), covariance=covariance),
        Ellipsoid(pose, [0.06, 0.1, 0.04], velocity=rng.uniform(-0.3, 0.3, 3)),
    ]
    return PredictedObstacles(Scene(obstacles=obstacles).packed, TIMES, np.full((3, len(TIMES)), margin))


def some_groups(rng, k=40):
    return Groups(rng.integers(3, size=k), rng.integers(len(TIMES), size=k), rng.integers(2, size=k))


@pytest.mark.parametrize("cost", [DistanceCost, GaussianCost])
def test_the_gradient_of_the_cost_equals_finite_differences(cost):
    rng = np.random.default_rng(0)
    obstacles, groups, points = predicted(rng), some_groups(rng), rng.uniform(-0.25, 0.25, (40, 3))
    more = {"stiffness": 130.0} if cost is GaussianCost else {}
    one, h = cost(0.02, np.array([0.02, 0.03]), **more), 1e-6

    def value(at):
        still = at, np.zeros(40), np.zeros((1, 3))
        return one.values(obstacles, groups, *still, one.gaps(obstacles, groups, *still))[:, 0]

    numeric = np.stack(
        [(value(points + h * axis) - value(points - h * axis)) / (2.0 * h) for axis in np.eye(3)], axis=1
    )
    analytic = one.gradients(obstacles, groups, points)
    assert np.abs(analytic).max() > 1.0
    np.testing.assert_allclose(analytic, numeric, rtol=1e-4, atol=1e-4)


def test_the_gaussian_is_the_mean_over_the_uncertainty_of_the_position():
    """Eq 5.5 averages samples of the tracker; the mean has a closed form."""
    rng = np.random.default_rng(1)
    ball = Sphere([0.0, 0.0, 0.0], 0.05, covariance=np.diag([4e-4, 1e-4, 9e-4]))
    exact = PredictedObstacles(Scene(obstacles=[ball]).packed, np.zeros(1), np.zeros((1, 1)))
    sharp = PredictedObstacles(
        Scene(obstacles=[dataclasses.replace(ball, covariance=None)]).packed, np.zeros(1), np.zeros((1, 1))
    )
    cost, point = GaussianCost(0.02, np.array([0.03])), np.array([[0.06, 0.02, -0.03]])
    samples = point - rng.multivariate_normal(np.zeros(3), ball.covariance, size=200_000)

    def values(obstacles, points):
        groups = Groups(*[np.zeros(len(points), dtype=np.intp)] * 3)
        still = points, np.zeros(len(points)), np.zeros((1, 3))
        return cost.values(obstacles, groups, *still, np.zeros((len(points), 1)))

    np.testing.assert_allclose(values(exact, point)[0, 0], values(sharp, samples).mean(), rtol=0.01)


def test_the_cost_falls_with_the_distance_and_is_one_at_the_clearance():
    ball = PredictedObstacles(Scene(obstacles=[Sphere([0, 0, 0], 0.05)]).packed, np.zeros(1), np.zeros((1, 1)))
    distance = np.linspace(0.0, 0.4, 60)
    groups = Groups(*[np.zeros(60, dtype=np.intp)] * 3)
    still = np.outer(distance, [1.0, 0.0, 0.0]), np.zeros(60), np.zeros((1, 3))
    for cost in (DistanceCost(0.02, np.array([0.03])), GaussianCost(0.02, np.array([0.03]))):
        gaps = cost.gaps(ball, groups, *still)
        np.testing.assert_allclose(gaps[:, 0], distance - 0.08, atol=1e-12)
        values = cost.values(ball, groups, *still, gaps)[:, 0]
        assert (np.diff(values) <= 0.0).all() and values[-1] < 1e-6
        beyond = gaps[:, 0] > cost.influence(ball.packed)[0]
        assert values[beyond].max(initial=0.0) < 2e-6
    edge = Groups(*[np.zeros(1, dtype=np.intp)] * 3)
    still = np.array([[0.1, 0.0, 0.0]]), np.zeros(1), np.zeros((1, 3))
    cost = DistanceCost(0.02, np.array([0.03]))
    assert cost.values(ball, edge, *still, cost.gaps(ball, edge, *still))[0, 0] == pytest.approx(1.0)


def test_candidates_are_26_in_space_12_in_a_plane_and_2_on_a_line():
    for forbidden, n in (([], 26), ([[0, 0, 1], [0, 0, -1]], 12), (np.kron(np.eye(3)[:2], [[1], [-1]]), 2)):
        axes, rest = allowed_axes(np.reshape(forbidden, (-1, 3)).astype(float))
        units = headings(axes)
        assert units.shape == (n, axes.shape[1]) and not len(rest)
        np.testing.assert_allclose(np.linalg.norm(units, axis=1), 1.0)
    for tangent in np.random.default_rng(0).normal(size=(20, 3)):
        along = tangent / np.linalg.norm(tangent)
        R = frame(along, np.eye(3))
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(R[:, 0], along, atol=1e-12)
        assert R[2, 1] == 0.0 and R[2, 2] > 0.0 and np.linalg.det(R) > 0.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", [DistanceCost, GaussianCost])
def test_the_choice_equals_that_of_all_candidates_computed_one_by_one(seed, kind):
    """The search leaves out what can't be best; here every candidate at every speed is computed without a shortcut."""
    rng = np.random.default_rng(seed)
    radii, offsets = np.array([0.02, 0.03]), np.array([[0.0, 0.0, 0.0], [0.0, 0.03, -0.04]])
    cost = kind(0.02, radii) if kind is DistanceCost else kind(0.02, radii, stiffness=130.0)
    obstacles, axes = predicted(rng, margin=0.005), frame(np.array([0.6, 0.8, 0.0]), np.eye(3))
    chooser = LeastCost(TIMES, GAINS["critical"], 1.5, cost, 20.0, headings(np.eye(3)))
    deviation, previous = rng.uniform(-0.02, 0.02, (2, 3)), 0.3 * rng.uniform(-1, 1, 3)
    free, start = chooser.response.free(deviation), rng.uniform(-0.15, 0.05, 3)
    root = rng.normal(size=(3, 3))
    precision = root @ root.T / 3.0 + 0.3 * np.eye(3)

    def predict(rates):
        xi = start + 0.2 * rates[:, None, None] * TIMES[:, None] * np.array([0.6, 0.8, 0.0])
        arrived = np.zeros((len(rates), len(TIMES)), dtype=bool)
        return Prediction((xi + free)[:, :, None] + offsets, arrived, offsets)

    units = headings(np.eye(3)) @ axes.T
    pushes = [np.zeros(3), *[size * unit for size in chooser.sizes for unit in units]]
    best = (np.inf, None, None)
    for rate in chooser.rates:
        moved = predict(np.array([rate])).centers[0]
        for push in pushes:
            e = free + 20.0 * chooser.response.G[:, None] * push
            total = 0.02 * np.sum((push - previous) ** 2) + 0.02 * push @ push + 2.0 * (1.0 - rate) ** 2
            for m in range(len(TIMES)):
                total += 0.93 ** (m + 1) * 8.0 * e[m] @ precision @ e[m]
                for i in range(3):
                    groups = Groups(np.full(2, i), np.full(2, m), np.arange(2))
                    still = moved[m] + e[m] - free[m], np.zeros(2), np.zeros((1, 3))
                    values = cost.values(obstacles, groups, *still, cost.gaps(obstacles, groups, *still))
                    total += 0.93 ** (m + 1) * values.max()
            if total < best[0]:
                best = (total, push, rate)
    found = chooser.choose(axes, np.empty((0, 3)), previous, free, precision, predict, obstacles)
    assert found.cost == pytest.approx(best[0], rel=1e-4, abs=1e-4)
    assert found.rate == best[2]
    np.testing.assert_allclose(found.scaled, best[1], atol=1e-12)
    assert 0 <= found.nearest < 3


@pytest.mark.parametrize("seed", range(5))
def test_push_spring_and_damper_together_keep_the_acceleration_limit(seed):
    rng = np.random.default_rng(seed)
    cost, axes = DistanceCost(0.02, np.array([0.03])), frame(np.array([0.6, 0.8, 0.0]), np.eye(3))
    chooser = LeastCost(TIMES, GAINS["critical"], 1.5, cost, 20.0, headings(np.eye(3)), max_acceleration=10.0)
    free, start = chooser.response.free(rng.uniform(-0.02, 0.02, (2, 3))), rng.uniform(-0.1, 0.1, 3)

    def predict(rates):
        xi = start + 0.2 * rates[:, None, None] * TIMES[:, None] * np.array([0.6, 0.8, 0.0])
        return Prediction((xi + free)[:, :, None], np.zeros((len(rates), len(TIMES)), dtype=bool), np.zeros((1, 3)))

    given = axes, np.empty((0, 3)), np.zeros(3), free, np.eye(3), predict, predicted(rng, margin=0.005)
    pull = rng.uniform(-4.0, 4.0, 3)
    found = chooser.choose(*given, pull)
    assert not found.scaled.any() or np.linalg.norm(20.0 * found.scaled - pull) <= 10.0 + 1e-9
    unlimited = dataclasses.replace(chooser, max_acceleration=np.inf)
    np.testing.assert_array_equal(unlimited.choose(*given, pull).scaled, chooser.choose(*given).scaled)
