from __future__ import annotations

import numpy as np
import pytest

from imitarm.demonstrations import files_of, lint, read
from imitarm.errors import TaskFailedError
from imitarm.tasks import teacher
from imitarm.tasks.sweep import DEMONSTRATIONS, SweepTask
from imitarm.tasks.teacher import SEEDS, Teacher
from imitarm.trajectory import Demonstration

ARM = SweepTask.arm()


@pytest.fixture(scope="module")
def packaged():
    return [Demonstration.load(DEMONSTRATIONS / f"sweep_{seed}.csv") for seed in SEEDS]


@pytest.mark.slow
def test_a_teacher_sweeps_and_the_packaged_file_is_what_the_same_seed_gives(packaged):
    demonstration, robot = Teacher.from_seed(SEEDS[3]).demonstrate(ARM)
    assert SweepTask(seed=SEEDS[3]).swept(robot).all()
    kept = packaged[3]
    np.testing.assert_array_equal(demonstration.trajectory.times, kept.trajectory.times)
    away = np.linalg.norm(demonstration.trajectory.positions - kept.trajectory.positions, axis=1)
    assert away.max() < 1e-3
    np.testing.assert_allclose(demonstration.joints, kept.joints, atol=2e-3)
    assert demonstration.joint_names == kept.joint_names == ARM.joint_names
    assert demonstration.task == kept.task == "sweep"


def test_the_same_seed_is_the_same_person_to_the_last_bit(monkeypatch):
    monkeypatch.setattr(SweepTask, "swept", lambda self, robot: np.ones(self.n_crumbs, bool))  # two seconds are enough

    def briefly(seed):
        person = Teacher.from_seed(seed)
        object.__setattr__(person, "rest", np.array([0.0, 2.0 - person.duration]))
        return person.demonstrate(ARM)[0]

    first, again, other = briefly(4), briefly(4), briefly(5)
    np.testing.assert_array_equal(first.joints, again.joints)
    np.testing.assert_array_equal(first.trajectory.positions, again.trajectory.positions)
    assert not np.array_equal(first.joints, other.joints)


def test_a_teacher_who_loses_dirt_is_no_teacher(monkeypatch):
    monkeypatch.setattr(SweepTask, "swept", lambda self, robot: np.zeros(self.n_crumbs, bool))
    person = Teacher.from_seed(0)
    object.__setattr__(person, "rest", np.array([0.0, 0.1 - person.duration]))
    with pytest.raises(TaskFailedError, match="lost 6 crumbs"):
        person.demonstrate(ARM)


def test_every_packaged_demonstration_goes_from_start_by_the_dirt_to_the_goal(packaged):
    for demonstration in packaged:
        path = demonstration.trajectory.positions
        assert np.linalg.norm(path[0] - SweepTask.start.position) < 2e-3
        assert np.linalg.norm(path - SweepTask.dirt.position, axis=1).min() < 0.015
        assert np.linalg.norm(path[-1] - SweepTask.goal.position) < 0.015
        assert np.all((path[:, 2] > 0.0) & (path[:, 2] < 0.008))  # lower than a crumb is high
        assert 8.0 < demonstration.trajectory.duration < 14.0


def test_the_joints_are_those_of_the_poses(packaged):
    positions, _ = ARM.tool_path(packaged[2].joints)
    np.testing.assert_allclose(positions, packaged[2].trajectory.positions, atol=1e-4)


def test_the_teachers_are_different_people(packaged):
    assert len({round(d.trajectory.duration, 2) for d in packaged}) == len(packaged)
    crossing = np.array(
        [np.interp(-0.28, d.trajectory.positions[:, 1], d.trajectory.positions[:, 0]) for d in packaged]
    )
    assert 0.003 < crossing.std() < 0.03  # sideways, halfway to the dirt


def test_the_reader_takes_the_folder_and_lint_finds_nothing_wrong():
    demonstrations = read(DEMONSTRATIONS)
    assert len(demonstrations) == len(SEEDS)
    assert all(finding.severity == "note" for finding in lint(demonstrations, arm=ARM))
    assert sum((DEMONSTRATIONS / name).stat().st_size for name in files_of(DEMONSTRATIONS)) < 600_000


def test_hand_and_velocity_belong_together():
    person = Teacher.from_seed(1)
    for time in np.linspace(1.0, 9.0, 9):
        before, after = person._path(time - 1e-5), person._path(time + 1e-5)
        _, twist = person.hand(time + person.rest[0])
        np.testing.assert_allclose(twist[:3], (after - before) / 2e-5, atol=1e-6)
    np.testing.assert_allclose(person.hand(0.0)[1], 0.0, atol=1e-9)  # before and after: at rest
    np.testing.assert_allclose(person.hand(60.0)[1], 0.0, atol=1e-9)


def test_the_command_writes_one_file_a_seed(tmp_path, monkeypatch, packaged):
    monkeypatch.setattr(teacher, "SEEDS", (1, 2))
    monkeypatch.setattr(Teacher, "demonstrate", lambda self, arm: (packaged[self.seed], None))
    teacher.main(["--out", str(tmp_path / "new" / "folder")])
    written = sorted((tmp_path / "new" / "folder").iterdir())
    assert [path.name for path in written] == ["sweep_1.csv", "sweep_2.csv"]
    again = Demonstration.load(written[0])
    np.testing.assert_allclose(again.trajectory.positions, packaged[1].trajectory.positions, atol=1e-12)
    np.testing.assert_allclose(again.joints, packaged[1].joints, atol=1e-12)
