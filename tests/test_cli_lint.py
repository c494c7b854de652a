"""``imitarm lint``: remedies are command-line options, and findings of one kind are counted."""

from __future__ import annotations

import re

import numpy as np
import pytest

from demonstration_samples import motion, motions
from imitarm.cli import main
from imitarm.cli.reading import as_options
from imitarm.kinematics.pose import quaternion_exp
from imitarm.skills import Skill


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")


def table(file, values, names="t,x,y,z"):
    np.savetxt(file, values, delimiter=",", header=names, comments="", fmt="%.9g")
    return str(file)


def plain(one):
    return np.column_stack([one.trajectory.times, one.trajectory.positions])


@pytest.mark.parametrize(
    ("python", "shell"),
    [
        ('read it with units="mm" (0.1 m)', "read it with --units mm (0.1 m)"),
        ("time_units='ms' or", "--time-units ms or"),
        ("read it with repair=True to drop", "read it with --repair to drop"),
        ("thin=True", "--thin"),
        ("duration=10.0 [s], or rate=100.0 [Hz]", "--duration 10.0 [s], or --rate 100.0 [Hz]"),
        ("arm=ArmModel.load('sawyer')", "--robot sawyer"),
        ("check duration, rate and time_units", "check duration, rate and --time-units"),
        ("contradicts quaternion_order='xyzw'; leave", "contradicts --quaternion-order xyzw; leave"),
    ],
)
def test_arguments_become_options(python, shell):
    assert as_options(python) == shell


def test_no_remedy_is_a_python_argument(tmp_path, capsys):
    files = [
        table(tmp_path / "mm.csv", plain(motion()) * [1, 1e3, 1e3, 1e3]),
        table(tmp_path / "ms.csv", plain(motion()) * [1e3, 1, 1, 1]),
        table(tmp_path / "none.csv", plain(motion())[:, 1:], "x,y,z"),
        table(tmp_path / "nan.csv", np.where(np.arange(300)[:, None] == 9, np.nan, plain(motion()))),
        table(tmp_path / "joints.csv", np.column_stack([np.arange(50.0), np.ones((50, 7))]), "t,j1,j2,j3,j4,j5,j6,j7"),
        table(tmp_path / "held.csv", plain(motion())[np.arange(300) // 5 * 5] + np.outer(np.arange(300), [1, 0, 0, 0])),
    ]
    assert main(["lint", *files]) == 2
    text = capsys.readouterr().out
    assert all(option in text for option in ("--units mm", "--time-units ms", "--duration", "--repair", "--robot"))
    assert "--thin" in text
    assert not re.search(r"\b\w+=\S", text), text


@pytest.mark.parametrize("n", [2, 9, 40])
def test_findings_of_one_kind_share_a_row(tmp_path, capsys, n):
    rows = plain(motion(n=40)) * [1, 1e3, 1e3, 1e3]
    files = [table(tmp_path / f"demo_{i}.csv", rows + [0, i, 0, 0]) for i in range(n)]
    assert main(["lint", *files]) == 2
    text = capsys.readouterr().out
    assert text.count("probably not the metre") == 1 and f"{n} findings of this kind; the first: " in text
    assert f"and {n - 1} other" in text and f"{n} errors" in text
    assert main(["lint", *files, "--all"]) == 2
    assert capsys.readouterr().out.count("probably not the metre") == n


def test_a_stack_of_matrices_is_one_finding(tmp_path, capsys):
    np.save(tmp_path / "poses.npy", np.tile(np.eye(4), (300, 1, 1)))
    assert main(["lint", str(tmp_path / "poses.npy"), "--duration", "3"]) == 2
    text = capsys.readouterr().out
    assert "(300, 4, 4)" in text and "0 demonstrations, 1 error, 0 warnings, 0 notes" in text


def test_held_values_are_thinned_and_learned(tmp_path, capsys):
    files = []
    for i, one in enumerate(motions(3)):
        values = plain(one)
        values[:, 1:] = values[np.arange(300) // 4 * 4, 1:]
        files.append(table(tmp_path / f"{i}.csv", values))
    assert main(["lint", *files]) == 0
    assert "held-values" in capsys.readouterr().out
    out = tmp_path / "s.json"
    assert main(["learn", *files, "--thin", "--components", "6", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "held-values" not in text and "rows only repeated the previous row and were dropped" in text
    assert Skill.load(out).n_demonstrations_ == 3


def test_learn_writes_nothing_when_demonstrations_do_not_belong_together(tmp_path, capsys):
    one = plain(motion())
    back = np.column_stack([one[:, 0], one[::-1, 1:]])
    files = [table(tmp_path / "a.csv", one), table(tmp_path / "b.csv", back)]
    assert main(["learn", *files, "--components", "3", "--out", str(tmp_path / "s.json")]) == 2
    captured = capsys.readouterr()
    assert "opposite direction" in captured.out and "fix the errors above" in captured.err
    assert not (tmp_path / "s.json").exists()


def test_motions_that_only_rotate_are_learned(tmp_path):
    phase = np.linspace(0.0, 1.0, 120)
    angle = np.radians(75.0) * phase**3 * (10 - 15 * phase + 6 * phase**2)
    files = []
    for i in range(3):
        q = quaternion_exp(np.outer(angle + 0.01 * i, [0.0, 0.6, 0.8]))
        values = np.column_stack([4.0 * phase, np.tile([0.4, 0.1, 0.3], (120, 1)), q])
        files.append(table(tmp_path / f"{i}.csv", values, "t,x,y,z,qw,qx,qy,qz"))
    out = tmp_path / "s.json"
    assert main(["learn", *files, "--out", str(out)]) == 0
    trajectory = Skill.load(out).generate()
    half = np.arccos(abs(trajectory.quaternions[0] @ trajectory.quaternions[-1]))
    assert np.degrees(2.0 * half) == pytest.approx(75.0, abs=1.0)
    assert np.ptp(trajectory.positions, axis=0).max() < 1e-6


@pytest.mark.parametrize("options", [[], ["--repair"]])
def test_learning_warns_of_a_rotation_that_is_not_read(tmp_path, capsys, options):
    files = [
        table(tmp_path / f"{i}.csv", np.column_stack([plain(one), np.zeros((len(plain(one)), 3))]), "t,x,y,z,rx,ry,rz")
        for i, one in enumerate(motions(3))
    ]
    assert main(["learn", *files, "--out", str(tmp_path / "skill.json"), *options]) == 0
    text = capsys.readouterr().out
    assert "rotation-not-read" in text and "rx, ry, rz" in text and "qw qx qy qz" in text
