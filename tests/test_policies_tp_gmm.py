from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import TOOL_RADIUS, sparse_clutter
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.tp_gmm import TPGMM, FrameMixture, demonstrations_between_ends
from imitarm.scene import Scene
from imitarm.skills.gmr import GMR
from imitarm.trajectory import Trajectory

TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
LEARNED = {planar: learn(planar=planar) for planar in (True, False)}
TIMES = np.linspace(0.0, 2.0, 200)


def hooked(start, goal):
    """A motion that leaves the start upwards and reaches the goal from above, whatever is between."""
    u = TIMES / 2.0
    pace = 10 * u**3 - 15 * u**4 + 6 * u**5
    lift = 0.1 * np.clip(np.minimum(u, 1.0 - u) / 0.15, 0.0, 1.0)
    return Trajectory(TIMES, start + pace[:, None] * (np.asarray(goal) - start) + np.outer(lift, [0.0, 0.0, 1.0]))


@given(st.integers(0, 10_000))
def test_the_components_are_products_of_gaussians(seed):
    """The product of two densities, up to a factor, is the density of the result: Calinon 2016, equation 6."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(2, 1, 4, 4))
    covariances = factors @ np.swapaxes(factors, 2, 3) + 0.1 * np.eye(4)
    means = rng.normal(size=(2, 1, 4))
    mixture = FrameMixture(np.ones(1), means, covariances, 2.0)
    start, goal = rng.normal(size=(2, 3))
    found = mixture.between(start, goal)
    points = rng.normal(size=(50, 4))

    def log_density(mean, covariance):
        away = points - mean
        return -0.5 * np.einsum("ia,ab,ib->i", away, np.linalg.inv(covariance), away)

    both = sum(
        log_density(means[j, 0] + np.concatenate([[0.0], b]), covariances[j, 0]) for j, b in ((0, start), (1, goal))
    )
    constant = both - log_density(found.means_[0], found.covariances_[0])
    np.testing.assert_allclose(constant, constant[0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_between_other_ends_it_leaves_and_arrives_as_demonstrated(seed):
    """The published figure: each frame decides where the demonstrations agree in it, here near its end."""
    rng = np.random.default_rng(seed)
    ends = [(0.08 * rng.normal(size=3), [0.5, 0.0, 0.0] + 0.08 * rng.normal(size=3)) for _ in range(13)]
    shown = [hooked(*pair) for pair in ends[:-1]]
    truth = hooked(*ends[-1]).positions
    error = np.linalg.norm(FrameMixture.of(shown, 6).between(*ends[-1]).nominal(TIMES)[0] - truth, axis=1)
    assert error[:20].max() < 0.005 and error[-20:].max() < 0.005
    mean = GMR(6).fit(shown).nominal(TIMES)[0]
    one_frame = np.linalg.norm(mean + ends[-1][0] - mean[0] - truth, axis=1)  # the mean, moved to the start
    assert np.sqrt(np.mean(error**2)) < 0.25 * np.sqrt(np.mean(one_frame**2))


def test_demonstrations_from_a_skill_have_different_ends_and_its_mean():
    skill, _ = LEARNED[False]
    paths = demonstrations_between_ends(skill, 0.05)
    starts = np.stack([path.positions[0] for path in paths])
    goals = np.stack([path.positions[-1] for path in paths])
    assert len(paths) == 12 * 7
    assert np.ptp(starts, axis=0).min() >= 0.1 - 1e-9 and np.ptp(goals, axis=0).min() >= 0.1 - 1e-9
    mean = np.mean([path.positions for path in paths], axis=0)
    np.testing.assert_allclose(mean, skill.nominal(paths[0].times).positions, atol=1e-9)


@pytest.mark.parametrize("planar", [True, False])
def test_without_obstacles_it_reproduces_the_skill_between_learned_ends(planar):
    skill, path = LEARNED[planar]
    plan = TPGMM(skill, tool_spheres=TOOL).plan_motion(Scene(None, ()))
    apart = np.linalg.norm(plan.trajectory.positions[:, None] - path, axis=2).min(axis=1)
    assert apart.max() < 0.01
    assert np.linalg.norm(plan.trajectory.positions[-1] - path[-1]) < 2e-3


def test_the_force_avoids_and_without_it_nothing_is_avoided():
    skill, path = LEARNED[False]
    free = {1e-4: 0, 0.0: 0}
    for seed in range(5):
        case = sparse_clutter(seed, path, n_obstacles=1, planar=False)
        for force in free:
            plan = TPGMM(skill, tool_spheres=TOOL, force=force).plan_motion(case.scene)
            gaps = ToolGaps(case.scene, TOOL).gaps(plan.trajectory.positions, None)
            free[force] += bool(gaps.min() > 0.0)
    assert free[1e-4] == 5 and free[0.0] == 0


def test_it_takes_demonstrations_and_checks_its_options():
    skill, _ = LEARNED[False]
    shown = demonstrations_between_ends(skill, 0.03)[:20]
    assert TPGMM(skill, demonstrations=shown).mixture_.duration == pytest.approx(skill.duration_)
    with pytest.raises(ValueError, match="at least 2"):
        TPGMM(skill, demonstrations=shown[:1])
    for option in ("force", "influence", "spread"):
        with pytest.raises(ValueError, match=option):
            TPGMM(skill, **{option: -1.0})
