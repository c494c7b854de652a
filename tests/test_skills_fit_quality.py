"""The distance of a skill to its demonstrations is measured, and a poor fit is not passed over."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.typing import NDArray

from imitarm.kinematics.pose import quaternion_exp
from imitarm.skills import FitQuality, PoorFitWarning, SingleDemonstrationWarning, Skill
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import shown

Array = NDArray[np.float64]


def loops(number: float, n: int = 3, drift: float = 0.0, duration: float = 40.0) -> list[Demonstration]:
    """Loops of 100 mm diameter, the centre of which drifts along x by ``drift`` [m] in all."""
    t = np.linspace(0.0, duration, 400)
    angle = 2.0 * np.pi * number * t / duration
    x = np.column_stack([0.05 * np.cos(angle) + drift * t / duration, 0.05 * np.sin(angle), 0.01 * np.sin(angle)])
    return [Demonstration(Trajectory(t, x + [0.4, 0.001 * i, 0.2]), task="stir", source=f"file {i}") for i in range(n)]


def poor(components: int, motions: list[Demonstration]) -> Skill:
    with pytest.warns(PoorFitWarning, match="of the motion's extent"):
        return Skill(components).fit(motions)


def test_the_distance_to_each_demonstration_is_that_of_the_nominal_path() -> None:
    motions = shown(n=3, turn=None)
    skill = Skill(10).fit(motions)
    quality = skill.fit_quality_
    assert quality is not None
    assert [d.source for d in quality.distances] == ["file 0", "file 1", "file 2"]
    for d, motion in zip(quality.distances, motions, strict=True):
        path = skill.nominal(motion.trajectory.times - motion.trajectory.times[0])
        apart = np.linalg.norm(path.positions - motion.trajectory.positions, axis=1)
        assert d.rms == pytest.approx(np.sqrt(np.mean(apart**2)))
        assert (d.largest, d.start, d.goal) == pytest.approx((apart.max(), apart[0], apart[-1]))


def test_what_demonstrations_differ_by_is_no_bias() -> None:
    """The average of motions 20 mm apart is learned without a bias, although it is far from each of them."""
    motions = shown(n=4, turn=None)
    apart = [
        Demonstration(Trajectory(d.trajectory.times, d.trajectory.positions + [0.0, 0.02 * i, 0.0]))
        for i, d in enumerate(motions)
    ]
    quality = Skill(12).fit(apart).fit_quality_
    assert quality is not None
    assert quality.faithful
    assert quality.bias < 0.003
    assert max(d.rms for d in quality.distances) > 0.02


def test_many_loops_get_enough_components_and_a_suggestion() -> None:
    quality = Skill().fit(loops(12.0)).fit_quality_
    assert quality is not None
    assert quality.faithful
    assert quality.relative_bias < 0.03
    assert quality.n_components > 16
    assert quality.period == pytest.approx(40.0 / 12.0, rel=0.03)
    assert "RhythmicDMP().fit(trajectory, period=3.3" in quality.suggestion


def test_too_few_components_for_the_motion_are_a_problem_with_a_remedy() -> None:
    skill = poor(8, loops(12.0))
    quality = skill.fit_quality_
    assert quality is not None
    assert not quality.faithful
    assert quality.bias > 0.03
    assert "use more than 8 components" in quality.problem
    assert "the motion repeats every 3.3" in quality.problem
    assert quality.problem.count("of the motion's extent") == 1


def wave(bends: float, size: float, *, noise: float = 0.0) -> list[Demonstration]:
    """A straight motion over 0.6 m with small loops on it, as in sanding or sewing."""
    t, rng = np.linspace(0.0, 20.0, 1000), np.random.default_rng(3)
    angle = 2.0 * np.pi * bends * t / 20.0
    x = np.column_stack([0.6 * t / 20.0, size * np.sin(angle), size * np.cos(angle)]) + [0.4, 0.0, 0.2]
    return [Demonstration(Trajectory(t, x + noise * rng.normal(size=x.shape)), source=f"file {i}") for i in range(3)]


@pytest.mark.parametrize(("bends", "size"), [(20.0, 0.02), (12.0, 0.03), (25.0, 0.025)])
def test_small_loops_on_a_long_motion_are_learned(bends: float, size: float) -> None:
    quality = Skill().fit(wave(bends, size)).fit_quality_
    assert quality is not None and quality.faithful
    assert quality.length > 0.9
    assert quality.bias < 0.35 * size


def test_a_path_that_has_lost_the_bends_is_a_problem_although_it_is_near() -> None:
    with pytest.warns(PoorFitWarning, match=r"lost bends of the motion: it is \d+ % as long .*use more than 12 comp"):
        skill = Skill(12).fit(wave(20.0, 0.02))
    quality = skill.fit_quality_
    assert quality is not None and not quality.faithful
    assert quality.bias < 0.05 * quality.extent and quality.length < 0.6
    assert "root mean square" not in quality.problem and "at most 5 %" not in quality.problem


def test_noise_does_not_count_as_bends() -> None:
    quality = Skill(6).fit(wave(0.5, 0.02, noise=1e-3)).fit_quality_
    assert quality is not None and quality.faithful and 0.95 < quality.length < 1.05


@pytest.mark.parametrize("number", [6.0, 10.5])
def test_the_period_is_found_with_a_drift_and_a_broken_last_loop(number: float) -> None:
    quality = poor(4, loops(number, drift=0.3)).fit_quality_
    assert quality is not None
    assert quality.period == pytest.approx(40.0 / number, rel=0.05)


def test_a_motion_that_does_not_repeat_has_no_period() -> None:
    for motions in (shown(n=3, turn=None), loops(1.0), loops(2.0)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PoorFitWarning)
            quality = Skill(6).fit(motions).fit_quality_
        assert quality is not None
        assert quality.period is None
        assert quality.suggestion == ""


def test_the_primitive_of_many_loops_follows_them_too() -> None:
    """40 basis functions are too few for 12 loops; the skill takes more by itself."""
    skill = Skill(80).fit(loops(12.0))
    assert skill.dmp_.n_basis > 40
    nominal = skill.nominal(np.linspace(0.0, skill.duration_, 401))
    done = skill.generate(dt=skill.duration_ / 400)
    assert np.sqrt(np.mean(np.sum((done.positions - nominal.positions) ** 2, axis=1))) < 2e-3
    with pytest.warns(PoorFitWarning, match="the movement primitive is"):
        Skill(80, n_basis=8).fit(loops(12.0))


def test_a_rotation_that_is_learned_badly_is_named() -> None:
    t = np.linspace(0.0, 10.0, 200)
    swing = 0.8 * np.sin(2.0 * np.pi * t)[:, None] * np.array([0.0, 0.0, 1.0])
    line = np.column_stack([0.03 * t, 0.0 * t, 0.2 + 0.0 * t])
    motions = [
        Demonstration(Trajectory(t, line + [0.0, 0.001 * i, 0.001 * i], quaternion_exp(swing))) for i in range(3)
    ]
    with pytest.warns(PoorFitWarning, match="the rotation is .* degrees"):
        skill = Skill(3).fit(motions)
    assert skill.fit_quality_ is not None
    assert skill.fit_quality_.rotation_bias > np.deg2rad(10.0)
    assert skill.fit_quality_.bias < 0.001


def test_a_rotation_in_place_is_learned() -> None:
    t = np.linspace(0.0, 3.0, 120)
    p = (t / 3.0) ** 2 * (3.0 - 2.0 * t / 3.0)
    turned = quaternion_exp(np.deg2rad(60.0) * p[:, None] * np.array([0.0, 1.0, 0.0]))
    motions = [Demonstration(Trajectory(t, np.tile([0.3, 0.3, 0.3], (120, 1)), turned)) for _ in range(3)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        skill = Skill().fit(motions)
    assert skill.fit_quality_ is not None
    assert skill.fit_quality_.faithful
    assert 2.0 * np.arccos(abs(skill.start_.quaternion @ skill.goal_.quaternion)) == pytest.approx(np.deg2rad(60.0))
    assert skill.fit_quality_.relative_bias == 0.0


def test_motions_that_hardly_move_are_not_refused_for_rounding() -> None:
    quality = FitQuality((), 4, extent=0.002, bias=0.0004, primitive_bias=0.0004)
    assert quality.faithful
    assert not FitQuality((), 4, extent=0.002, bias=0.0006, primitive_bias=0.0004).faithful
    assert not FitQuality((), 4, extent=0.0, bias=0.001, primitive_bias=0.0).faithful


def test_one_demonstration_has_a_quality_too() -> None:
    with pytest.warns(SingleDemonstrationWarning):
        skill = Skill(10).fit(shown(n=1, turn=None))
    assert skill.fit_quality_ is not None
    (only,) = skill.fit_quality_.distances
    assert (only.start, only.goal) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert only.rms == pytest.approx(skill.fit_quality_.bias, rel=0.1)
