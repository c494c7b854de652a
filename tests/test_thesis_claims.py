"""What docs/thesis_map.md says of the thesis's equations and figures, computed anew from what is printed there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import ttest_rel, wilcoxon

from imitarm.benchmark.avoidance import learn
from imitarm.policies import adapt
from imitarm.scene import Scene, Sphere
from imitarm.skills import DMP
from imitarm.skills.dynamical_systems import DECAY, GAINS
from imitarm.trajectory import Trajectory

# Table 4.1, tasks T1 to T8 in rows. Its unit is not stated.
METHODS = ("DMP+AT", "DMP+ANN", "GMM+DMP", "GMM+IRL", "ACFRA")
TABLE_4_1 = np.array(
    [
        [0.0121, 0.0107, 0.0125, 0.0123, 0.0128],
        [0.0230, 0.0258, 0.0250, 0.0242, 0.0215],
        [0.0223, 0.0212, 0.0225, 0.0226, 0.0210],
        [0.0130, 0.0110, 0.0130, 0.0180, 0.0100],
        [0.0316, 0.0310, 0.0332, 0.0318, 0.0330],
        [0.0321, 0.0312, 0.0311, 0.0312, 0.0286],
        [0.0270, 0.0283, 0.0280, 0.0265, 0.0262],
        [0.0169, 0.0200, 0.0172, 0.0170, 0.0200],
    ]
)


def test_table_4_1_has_a_misprinted_mean() -> None:
    np.testing.assert_allclose(TABLE_4_1.mean(axis=0), [0.0223, 0.0224, 0.0228, 0.0230, 0.0216], atol=6e-5)  # not 0.224


def test_table_4_1_acfra_is_best_in_five_tasks_of_eight_and_worst_in_two() -> None:
    ranks = TABLE_4_1.argsort(axis=1)
    assert [f"T{i + 1}" for i in np.flatnonzero(ranks[:, 0] == 4)] == ["T2", "T3", "T4", "T6", "T7"]
    worst = TABLE_4_1[:, 4] == TABLE_4_1.max(axis=1)
    assert [f"T{i + 1}" for i in np.flatnonzero(worst)] == ["T1", "T8"]


@pytest.mark.parametrize(
    ("peer", "t", "w"),
    [("DMP+AT", 0.46, 0.46), ("DMP+ANN", 0.36, 0.38), ("GMM+DMP", 0.15, 0.20), ("GMM+IRL", 0.30, 0.46)],
)
def test_table_4_1_shows_no_significant_difference(peer: str, t: float, w: float) -> None:
    """Paired tests over the eight tasks; the claim would need p < 0.05, before any correction for four comparisons."""
    table = np.rint(1e4 * TABLE_4_1)  # whole numbers: rounding must not break ties
    acfra, other = table[:, 4], table[:, METHODS.index(peer)]
    assert ttest_rel(acfra, other).pvalue == pytest.approx(t, abs=0.005)
    assert wilcoxon(acfra, other, method="exact").pvalue == pytest.approx(w, abs=0.0051)


def test_the_gains_of_chapter_5_are_overdamped() -> None:
    K, D = GAINS["thesis"]
    assert 2.0 * np.sqrt(K) < D
    np.testing.assert_allclose(sorted(np.roots([1.0, D, K])), [-21.53, -6.47], atol=0.01)  # two poles: not critical


def wave() -> Trajectory:
    t = np.linspace(0.0, 3.0, 301)
    p = (t / 3.0) ** 3 * (10.0 + t / 3.0 * (6.0 * t / 3.0 - 15.0))
    return Trajectory(t, np.column_stack([0.4 * p, 0.1 * np.sin(3 * np.pi * p), 0.05 * np.sin(2 * np.pi * p) + 0.2]))


@pytest.mark.parametrize("gains", ["critical", "thesis"])
@pytest.mark.parametrize("shift", [0.0, 0.07])
def test_a_primitive_is_the_solution_of_the_corrected_equations(gains: str, shift: float) -> None:
    """Eqs 2.8 to 2.11 as the map reads them, integrated by another hand with the weights that were learnt."""
    dmp = DMP(gains, n_basis=25).fit(wave())
    K, D = dmp.gains_
    goal, tau = dmp.goal_ + shift, dmp.duration_

    def force(s: float) -> np.ndarray:
        psi = np.exp(-dmp.widths_ * (s - dmp.centers_) ** 2)
        return psi @ dmp.weights_ * s / psi.sum()

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        x, v, s = state[:3], state[3:6], state[6]
        pull = K * (goal - x) - D * v - K * (goal - dmp.start_) * s + K * force(s)
        return np.concatenate([v, pull, [-DECAY * s]]) / tau

    begin = np.concatenate([dmp.start_, dmp.start_velocity_ * tau, [1.0]])
    times = np.linspace(0.0, tau, 31)
    expected = solve_ivp(rate, (0.0, tau), begin, t_eval=times, rtol=1e-9, atol=1e-11).y[:3].T
    done = dmp.generate(goal=goal, dt=tau / 600, adjustment="hoffmann")
    np.testing.assert_allclose(done.at(times)[0], expected, atol=2e-6)


@pytest.mark.parametrize("net", [0.1, 1e-3])
def test_equations_2_8_and_2_12_as_printed_blow_up_where_an_axis_hardly_moves(net: float) -> None:
    """The sweep of the thesis keeps z = 0.23 m: g - x_0 = 0 there. Here it is 1 mm, and the goal moves by 5 cm."""
    t = np.linspace(0.0, 1.0, 1001)
    K, D = GAINS["thesis"]
    z = 0.23 + net * t + 0.01 * np.sin(np.pi * t) ** 2
    v = net + 0.01 * np.pi * np.sin(2.0 * np.pi * t)
    force = (-K * (z[-1] - z) + D * v + 0.02 * np.pi**2 * np.cos(2.0 * np.pi * t)) / (z[-1] - z[0])
    goal = z[-1] + 0.05

    def rate(at: float, state: np.ndarray) -> list[float]:
        push = (goal - z[0]) * np.interp(at, t, force)
        return [state[1], K * (goal - state[0]) - D * state[1] + push]

    def excursion(path: np.ndarray) -> float:
        return float(max(z[0] - path.min(), path.max() - goal))

    printed = solve_ivp(rate, (0.0, 1.0), [z[0], v[0]], max_step=0.01).y[0]
    ours = DMP("thesis").fit(Trajectory(t, np.column_stack([t, t, z]))).generate(goal=[1.0, 1.0, goal])
    assert excursion(ours.positions[:, 2]) < 1e-3
    if net == 0.1:
        assert excursion(printed) < 1e-3
    else:
        assert excursion(printed) > 0.4  # [m] of a motion of 1 cm


def test_equations_4_4_to_4_6_have_more_than_one_stationary_point_and_a_misprinted_one_is_off_the_ellipse() -> None:
    a, b = 0.06, 0.02
    point = np.array([0.01, 0.005])  # inside the ellipse's evolute: two minima, two maxima
    phi = np.linspace(0.0, 2.0 * np.pi, 100_000, endpoint=False)
    distance = np.hypot(point[0] - a * np.cos(phi), point[1] - b * np.sin(phi))
    slope = np.sign(np.roll(distance, -1) - distance)
    assert np.count_nonzero(slope != np.roll(slope, 1)) == 4
    printed = np.stack([a * np.cos(phi), a * np.sin(phi)])  # y_e = a sin(phi), as it stands before Eq 4.6
    assert np.abs((printed[0] / a) ** 2 + (printed[1] / b) ** 2 - 1.0).max() > 1.0


def test_equation_4_9_has_its_root() -> None:
    skill, path = learn(planar=False)
    adapted = adapt(skill, Scene(None, [Sphere(path[200], 0.04)]), tool_radius=0.02)
    squares = [
        np.sum((a - b) ** 2) for a, b in zip(adapted.trajectory.positions, adapted.nominal.positions, strict=True)
    ]
    assert adapted.rmse_to_nominal == pytest.approx(np.sqrt(sum(squares) / len(squares)))
    assert adapted.rmse_to_nominal > 0.005  # [m], where its square would be a hundred times less
