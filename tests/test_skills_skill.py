from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import Pose, quaternion_conjugate, quaternion_exp, quaternion_log, quaternion_multiply
from imitarm.skills import DegenerateAxisWarning, Skill
from imitarm.skills.skill_file import _checksum
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import same, shown

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def skill() -> Skill:
    return Skill(6).fit(shown(), notes=["trimmed 3 rows"], date="2024-05-01")


def test_it_reproduces_the_nominal_path(skill: Skill) -> None:
    done = skill.generate()
    nominal = skill.nominal(done.times)
    assert np.abs(done.positions - nominal.positions).max() < 1e-3
    assert done.quaternions is not None
    quaternions = nominal.quaternions
    assert quaternions is not None
    away = quaternion_log(quaternion_multiply(done.quaternions, quaternion_conjugate(quaternions)))
    assert np.linalg.norm(away, axis=1).max() < np.deg2rad(0.5)


def test_what_it_knows_about_itself(skill: Skill) -> None:
    assert skill.task_ == "sweep"
    assert skill.n_demonstrations_ == 5
    assert skill.duration_ == pytest.approx(2.0)
    assert skill.provenance_["sources"] == [f"file {i}" for i in range(5)]
    assert skill.provenance_["notes"] == ["trimmed 3 rows"]
    assert skill.provenance_["date"] == "2024-05-01"
    assert repr(skill) == "Skill('sweep', 5 demonstrations, 2 s, 6 components, with orientation)"
    np.testing.assert_allclose(skill.start_.position, [0.0, 0.0, 0.23], atol=5e-3)
    np.testing.assert_allclose(skill.goal_.position, [0.4, 0.0, 0.28], atol=1e-2)
    done = skill.generate()
    assert done.quaternions is not None
    assert abs(done.quaternions[-1] @ skill.goal_.quaternion) == pytest.approx(1.0)


def test_another_start_goal_and_duration(skill: Skill) -> None:
    goal = Pose(np.array([0.5, 0.1, 0.3]), quaternion_multiply(quaternion_exp([0.2, 0, 0]), skill.goal_.quaternion))
    done = skill.generate(start=[0.0, 0.05, 0.25], goal=goal, duration=4.0, dt=0.02)
    assert len(done) == 201
    np.testing.assert_allclose(done.positions[0], [0.0, 0.05, 0.25])
    np.testing.assert_allclose(done.positions[-1], goal.position, atol=1e-6)
    assert done.quaternions is not None
    assert abs(done.quaternions[-1] @ goal.quaternion) == pytest.approx(1.0)


def test_tolerance_goes_with_the_duration(skill: Skill) -> None:
    t = np.linspace(0.0, 2.0, 9)
    tolerance = skill.tolerance(t)
    assert tolerance.shape == (9, 3, 3)
    assert np.linalg.eigvalsh(tolerance).min() > 0.0
    np.testing.assert_allclose(skill.tolerance(3.0 * t, duration=6.0), tolerance)


def test_without_orientation() -> None:
    skill = Skill(5).fit(shown(turn=None))
    assert skill.generate().quaternions is None
    np.testing.assert_array_equal(skill.start_.quaternion, [1.0, 0.0, 0.0, 0.0])
    assert "without orientation" in repr(skill)
    done = skill.generate(goal=Pose(np.array([0.4, 0.0, 0.3]), quaternion_exp([1.0, 0.0, 0.0])))
    np.testing.assert_allclose(done.positions[-1], [0.4, 0.0, 0.3], atol=1e-6)


def test_bare_trajectories_are_welcome() -> None:
    skill = Skill(4).fit([d.trajectory for d in shown(n=2)])  # type: ignore[misc]
    assert skill.task_ == ""
    assert skill.provenance_["sources"] == ["", ""]


def test_use_before_fit() -> None:
    assert repr(Skill()) == "Skill(not fitted)"
    for use in (lambda s: s.generate(), lambda s: s.duration_, lambda s: s.start_, lambda s: s.save("x.json")):
        with pytest.raises(InputError, match="not learned yet"):
            use(Skill())


@pytest.mark.parametrize("kind", ["turning", "flat", "planar", "auto", "single"])
def test_saved_and_loaded_it_is_the_same_to_the_last_bit(kind: str, tmp_path: Path) -> None:
    demonstrations = shown(
        n=1 if kind == "single" else 3, turn=None if kind == "flat" else 4.7, planar=kind == "planar"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        skill = Skill("auto" if kind in {"auto", "single"} else 4, gains="thesis").fit(demonstrations)
    path = tmp_path / "sweep.skill.json"
    skill.save(path)
    again = Skill.load(path)
    assert same(skill, again)
    again.save(tmp_path / "again.json")
    assert path.read_bytes() == (tmp_path / "again.json").read_bytes()
    assert again.dmp_.gains_ == skill.dmp_.gains_


def test_a_planar_skill_stays_in_its_plane() -> None:
    with pytest.warns(DegenerateAxisWarning, match="in z"):
        skill = Skill(5).fit(shown(planar=True))
    np.testing.assert_allclose(skill.generate().positions[:, 2], 0.23, atol=1e-9)


def test_the_same_demonstrations_give_the_same_file(tmp_path: Path) -> None:
    for name in ("a.json", "b.json"):
        Skill(4).fit(shown(n=3)).save(tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_a_file_with_a_right_checksum_and_wrong_content_is_refused(skill: Skill, tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    skill.save(path)
    plain = {k: v for k, v in json.loads(path.read_text()).items() if k != "checksum"}
    gmr, dmp = plain["gmr"], plain["dmp"]
    negative = [[[-v for v in row] for row in table] for table in gmr["covariances"]]
    changes = [
        {"task": 7},
        {"gmr": None},
        {"gmr": {**gmr, "weights": gmr["weights"][:-1]}},
        {"gmr": {**gmr, "weights": "many"}},
        {"gmr": {**gmr, "covariances": negative}},
        {"gmr": {**gmr, "means": [[1.0], [1.0, 2.0]]}},
        {"gmr": {**gmr, "duration": 0.0}},
        {"gmr": {**gmr, "duration": True}},
        {"gmr": {**gmr, "converged": 1}},
        {"gmr": {**gmr, "n_demonstrations": -2}},
        {"gmr": {**gmr, "n_demonstrations": 10**400}},
        {"gmr": {**gmr, "duration": 10**400}},
        {"gmr": {**gmr, "reference": {"times": [0.0], "quaternions": [[0.0, 0.0, 0.0, 0.0]]}}},
        {"gmr": {**gmr, "selection": {"n_components, bic, aic, bias_rmse_mm": [[1.0, 2.0]]}}},
        {"dmp": {**dmp, "stiffness": -1.0}},
        {"dmp": {**dmp, "weights": dmp["weights"][:1], "progress_weights": dmp["progress_weights"][:1]}},
        {"dmp": {**dmp, "start": [0.0, 1.0]}},
        {"dmp": {k: v for k, v in dmp.items() if k != "goal"}},
        {"dmp": {k: v for k, v in dmp.items() if k != "orientation"}},
        {"dmp": {**dmp, "orientation": {"knots": [0.0, 1.0], "coefficients": [[1.0]]}}},
        {"provenance": {"imitarm": "0", "sources": [1], "notes": []}},
        {"provenance": []},
    ]
    for change in changes:
        whole = {**plain, **change}
        path.write_text(json.dumps({**whole, "checksum": _checksum(whole)}))
        with pytest.raises(FileFormatError):
            Skill.load(path)


@pytest.mark.parametrize("name", ["bottle2shelf", "pouring"])
def test_real_recordings_of_a_panda_are_learnt_with_orientation(real_data: Path, name: str) -> None:
    rows = np.load(real_data / "panda_kinesthetic" / f"{name}.npy", allow_pickle=False)[:, ::5]
    demonstrations = []
    for i, row in enumerate(rows):
        q = row[:, 3:] / np.linalg.norm(row[:, 3:], axis=1, keepdims=True)
        demonstrations.append(
            Demonstration(Trajectory(np.linspace(0.0, 10.0, len(row)), row[:, :3] / 100.0, q), None, name, f"row {i}")
        )
    skill = Skill(8).fit(demonstrations)
    done = skill.generate(dt=0.05)
    plain = rows[:, :, :3].mean(axis=0) / 100.0
    assert np.sqrt(np.mean(np.sum((done.positions[:-1] - plain) ** 2, axis=1))) < 0.012
    assert done.quaternions is not None
    at_start = [d.trajectory.quaternions[0] for d in demonstrations if d.trajectory.quaternions is not None]
    away = [2.0 * np.arccos(min(1.0, abs(done.quaternions[0] @ q))) for q in at_start]
    assert np.median(away) < np.deg2rad(15.0)
