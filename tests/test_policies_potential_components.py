"""The thesis's potential fields: each force is minus the gradient of its potential, as printed and as corrected."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.benchmark.avoidance import learn
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.policies import HORIZONTAL_ONLY
from imitarm.policies.baselines.potential_components import (
    FORCES,
    INFLUENCE_DISTANCE,
    component_distances,
    literal_force,
    modified_force,
    push_components,
)
from imitarm.policies.component_path import ComponentPath
from imitarm.scene import Box, Sphere

BALL = Sphere([0.1, -0.2, 0.3], 0.06)
SIGMA = np.array([0.004, 0.01, 0.02])  # [m] of three round components


def components(means: np.ndarray) -> SimpleNamespace:
    """Round components, whose spread is the same in all directions."""
    return SimpleNamespace(means=means, covariances=SIGMA[:, None, None] ** 2 * np.eye(3))


def measured(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances, normals and spreads of round components at ``means``, as the forces take them."""
    return component_distances(components(means), np.zeros((3, 3)), [BALL], 0.0)


def beside_the_ball(rng: np.random.Generator, gap: np.ndarray) -> np.ndarray:
    """Means whose ellipses are ``gap`` (3,) [m] from the ball."""
    direction = rng.normal(size=(3, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return BALL.center + (BALL.radius + SIGMA + gap)[:, None] * direction


def literal_potential(distance: np.ndarray) -> np.ndarray:
    """Eq 4.7 as printed, with k = 1 and d_th the influence distance."""
    return 0.5 * (1.0 / distance - 1.0 / INFLUENCE_DISTANCE) ** 2 - np.exp(SIGMA**2)


def modified_potential(distance: np.ndarray) -> np.ndarray:
    """The corrected potential with eta = 1 (docs/avoidance.md, section 10)."""
    variance = SIGMA**2
    gain = np.clip(np.exp((variance - np.median(variance)) / variance.max()), 0.25, 4.0)
    return 0.5 * gain * INFLUENCE_DISTANCE**2 * (INFLUENCE_DISTANCE / distance - 1.0) ** 2


@pytest.mark.parametrize(
    ("force", "potential"), [(literal_force, literal_potential), (modified_force, modified_potential)]
)
@given(seed=st.integers(0, 2**31))
def test_the_force_is_minus_the_gradient_of_the_potential(force, potential, seed):
    rng = np.random.default_rng(seed)
    means = beside_the_ball(rng, rng.uniform(0.2, 0.95, 3) * INFLUENCE_DISTANCE)
    expected = np.empty((3, 3))
    for axis in range(3):
        shift = 1e-7 * np.eye(3)[axis]
        ends = [potential(measured(means + sign * shift)[0][0]) for sign in (1.0, -1.0)]
        expected[:, axis] = -(ends[0] - ends[1]) / 2e-7
    got = force(*measured(means))[0]
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("method", list(FORCES))
def test_nothing_is_pushed_from_afar_and_the_push_sets_in_gently(method):
    rng = np.random.default_rng(0)
    sizes = []
    for share in (1.0, 0.999, 0.5, 0.2):
        means = beside_the_ball(rng, np.full(3, share * INFLUENCE_DISTANCE))
        sizes.append(np.linalg.norm(FORCES[method](*measured(means))[0], axis=1))
    np.testing.assert_allclose(sizes[0], 0.0, atol=1e-9)
    assert np.all(sizes[1] < 0.01 * sizes[2])
    assert np.all(sizes[2] < sizes[3])


def test_the_printed_sigma_has_no_effect_and_the_corrected_one_lets_loose_components_yield_more():
    rng = np.random.default_rng(1)
    near = measured(beside_the_ball(rng, np.full(3, 0.02)))
    printed, corrected = (np.linalg.norm(force(*near)[0], axis=1) for force in (literal_force, modified_force))
    np.testing.assert_allclose(printed, printed[0], rtol=1e-9)
    assert corrected[0] < corrected[1] < corrected[2]


def test_the_force_stays_finite_inside_an_obstacle():
    means = np.tile(BALL.center + np.array([0.001, 0.0, 0.0]), (3, 1))
    for force in FORCES.values():
        assert np.isfinite(force(*measured(means))).all()


@given(seed=st.integers(0, 2**31))
def test_the_distance_of_an_ellipse_is_never_overestimated_and_exact_when_it_is_round(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3, 3)) * 0.02
    box = Box(Pose(rng.normal(size=3) * 0.1, quaternion_exp(rng.normal(size=3))), rng.uniform(0.05, 0.2, 3))
    directions = rng.normal(size=(3, 2000))
    directions /= np.linalg.norm(directions, axis=0)
    mean = box.pose.position + rng.normal(size=3) * 0.3
    for covariance in (factor @ factor.T + 1e-8 * np.eye(3), 0.03**2 * np.eye(3)):
        round_one = covariance[0, 1] == 0.0
        surface = mean + (np.linalg.cholesky(covariance) @ directions).T
        path = SimpleNamespace(means=mean[None], covariances=covariance[None])
        bound = component_distances(path, np.zeros((1, 3)), [box], 0.01)[0].item()
        if box.signed_distance(mean) > 0.0:
            nearest = float(box.signed_distance(surface).min()) - 0.01
            assert bound <= nearest + 1e-9
            if round_one and nearest + 0.01 > 0.0:
                assert bound == pytest.approx(nearest, abs=1e-3)  # 2000 points of the surface


def test_forbidden_directions_are_kept():
    skill, path = learn(planar=True)
    taken_apart = ComponentPath.of_skill(skill)
    ball = Sphere(path[200] + np.array([0.0, 0.0, 0.02]), 0.05)
    for method in FORCES:
        free = push_components(taken_apart, [ball], 0.05, method=method, forbidden=np.empty((0, 3)))
        held = push_components(taken_apart, [ball], 0.05, method=method, forbidden=np.array(HORIZONTAL_ONLY))
        assert np.abs(free[:, 2]).max() > 1e-3
        np.testing.assert_array_equal(held[:, 2], 0.0)
        assert np.abs(held).max() > 1e-3
