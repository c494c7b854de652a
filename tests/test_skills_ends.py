"""A skill starts and ends exactly at the mean of the demonstrated starts and goals."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, mean_quaternion, quaternion_exp, quaternion_multiply
from imitarm.policies import adapt
from imitarm.scene import Scene
from imitarm.skills import GMR, PoorFitWarning, SingleDemonstrationWarning, Skill
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import shown

N_SAMPLES = (10, 11, 25, 50, 137, 200, 1000)


def demonstrations(n: int = 4, seed: int = 0, *, turns: bool = True) -> list[Demonstration]:
    """Motions that begin and end under way, which blended straight pieces miss by millimetres."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3.0, 160)
    answer = []
    for _ in range(n):
        offset = 0.01 * rng.standard_normal(3)
        x = np.column_stack([0.1 * t, 0.1 * np.cos(4.0 * t), 0.05 * np.sin(3.0 * t)]) + offset
        r = (0.7 * t[:, None] + 0.1 * rng.standard_normal(3)) * np.array([0.3, 0.0, 0.9])
        answer.append(Demonstration(Trajectory(t, x, quaternion_exp(r) if turns else None), task="curve"))
    return answer


def angle(p: np.ndarray, q: np.ndarray) -> float:
    return float(2.0 * np.arcsin(min(1.0, min(np.linalg.norm(p - q), np.linalg.norm(p + q)) / 2.0)))


def ends(motions: list[Demonstration]) -> list[Pose]:
    return [
        Pose(
            np.mean([m.trajectory.positions[i] for m in motions], axis=0),
            mean_quaternion(np.stack([m.trajectory.quaternions[i] for m in motions])),  # type: ignore[index]
        )
        for i in (0, -1)
    ]


def assert_ends(path: Trajectory, start: Pose, goal: Pose, atol: float = 1e-7) -> None:
    assert path.quaternions is not None
    for i, end in ((0, start), (-1, goal)):
        np.testing.assert_allclose(path.positions[i], end.position, rtol=0.0, atol=atol)
        assert angle(path.quaternions[i], end.quaternion) < atol


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 5), seed=st.integers(0, 1000), components=st.integers(1, 9), samples=st.integers(2, 400))
def test_every_path_of_a_skill_ends_at_the_mean_ends(n: int, seed: int, components: int, samples: int) -> None:
    motions = demonstrations(n, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SingleDemonstrationWarning)
        warnings.simplefilter("ignore", PoorFitWarning)  # one component can't follow a curve
        skill = Skill(components).fit(motions)
    start, goal = ends(motions)
    assert_ends(skill.nominal(np.linspace(0.0, skill.duration_, samples)), start, goal, 1e-12)
    assert_ends(skill.generate(dt=skill.duration_ / samples), start, goal)
    for pose, end in ((skill.start_, start), (skill.goal_, goal)):
        np.testing.assert_allclose(pose.position, end.position, rtol=0.0, atol=1e-12)
        assert angle(pose.quaternion, end.quaternion) < 1e-12


@pytest.mark.parametrize("n_samples", N_SAMPLES)
@pytest.mark.parametrize("moved", [False, True])
def test_an_adaptation_ends_at_start_and_goal_for_every_number_of_samples(n_samples: int, moved: bool) -> None:
    skill = Skill(8).fit(demonstrations())
    goal = skill.goal_
    if moved:
        turned = quaternion_multiply(quaternion_exp(np.array([0.2, -0.1, 0.3])), goal.quaternion)
        goal = Pose(goal.position + [0.1, -0.05, 0.03], turned)
    adaptation = adapt(skill, Scene(goal if moved else None), tool_radius=0.01, n_samples=n_samples)
    assert_ends(adaptation.trajectory, skill.start_, goal, 1e-12)


def test_only_a_gaussian_s_span_at_each_end_is_corrected_and_predict_stays_the_closed_form() -> None:
    gmr = GMR(8).fit(demonstrations())
    times = np.linspace(0.0, gmr.duration_, 300)
    nominal, (mean, _) = gmr.nominal(times)[0], gmr.predict(times)
    margin = max(0.05 * gmr.duration_, gmr.time_means_[0], gmr.duration_ - gmr.time_means_[-1])
    middle = (times > margin) & (times < gmr.duration_ - margin)
    np.testing.assert_allclose(nominal[middle], mean[middle], rtol=0.0, atol=1e-15)
    again = GMR.from_mixture(
        gmr.weights_, gmr.means_, gmr.covariances_, duration=gmr.duration_, reference=gmr.reference_
    )
    np.testing.assert_array_equal(again.predict(times)[0], mean)
    np.testing.assert_allclose(again.nominal(times)[0], mean, rtol=0.0, atol=1e-15)


def test_moved_means_move_the_nominal_path_by_their_responsibilities() -> None:
    gmr = GMR(6).fit(shown(turn=None))
    times = np.linspace(0.0, gmr.duration_, 200)
    displacement = 0.05 * np.random.default_rng(0).standard_normal((6, 3))
    moved = GMR.from_mixture(
        gmr.weights_,
        gmr.means_ + np.column_stack([np.zeros(6), displacement]),
        gmr.covariances_,
        duration=gmr.duration_,
        ends=gmr.ends_ + gmr.responsibilities([0.0, gmr.duration_]) @ displacement,
    )
    expected = gmr.nominal(times)[0] + gmr.responsibilities(times) @ displacement
    np.testing.assert_allclose(moved.nominal(times)[0], expected, rtol=0.0, atol=1e-14)


def test_the_correction_is_smooth() -> None:
    """The third difference of the nominal path is no larger than that of the regression's mean."""
    gmr = GMR(8).fit(demonstrations())
    times = np.linspace(0.0, gmr.duration_, 400)
    rough = [np.abs(np.diff(x, 3, axis=0)).max() for x in (gmr.nominal(times)[0], gmr.predict(times)[0])]
    assert rough[0] < 1.5 * rough[1]


def test_nominal_refuses_other_times() -> None:
    skill = Skill(8).fit(demonstrations())
    for times in ([0.0], [1.0, 0.5], [0.0, np.nan], "abc", None):
        with pytest.raises(InputError):
            skill.nominal(times)


def test_other_ends_of_positions_alone_keep_the_learned_rotation() -> None:
    skill = Skill(6).fit(demonstrations())
    path = skill.nominal(np.linspace(0.0, skill.duration_, 20), [0.1, 0.2, 0.3], [0.3, 0.2, 0.1])
    start, goal = Pose([0.1, 0.2, 0.3], skill.start_.quaternion), Pose([0.3, 0.2, 0.1], skill.goal_.quaternion)
    assert_ends(path, start, goal, 1e-12)
