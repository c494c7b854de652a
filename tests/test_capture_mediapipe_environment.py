from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from imitarm.capture import mediapipe_environment as environment
from imitarm.capture.mediapipe_environment import VARIABLE, find_python, folders, main, make, python_of, suitable_python
from imitarm.errors import InputError, TaskFailedError


@pytest.fixture
def apart(tmp_path, monkeypatch):
    """No environment but what the test makes."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(environment, "folders", lambda: [tmp_path / "one", tmp_path / "two"])
    return tmp_path


def test_the_variable_goes_before_folders_and_a_folder_counts_when_it_is_finished(apart, monkeypatch):
    with pytest.raises(
        InputError, match=r"create it once by '.* -m imitarm\.capture\.mediapipe_environment'.*IMITARM_M"
    ):
        find_python()
    for name in ("one", "two"):
        (apart / name).mkdir()
    (apart / "two" / environment._STAMP).touch()
    assert find_python() == python_of(apart / "two")
    (apart / "one" / environment._STAMP).touch()
    assert find_python() == python_of(apart / "one")
    monkeypatch.setenv(VARIABLE, sys.executable)
    assert find_python() == Path(sys.executable)
    monkeypatch.setenv(VARIABLE, "/nowhere/python")
    with pytest.raises(InputError, match="/nowhere/python is not a file"):
        find_python()


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {"XDG_DATA_HOME": "/data"}, "/data/imitarm/mediapipe"),
        ("linux", {"HOME": "/home/a"}, "/home/a/.local/share/imitarm/mediapipe"),
        ("darwin", {"HOME": "/Users/a"}, "/Users/a/Library/Application Support/imitarm/mediapipe"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/imitarm/mediapipe"),
    ],
)
def test_a_checkout_has_its_own_and_a_user_one_where_data_are_kept(platform, variables, expected, monkeypatch):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    beside, own = folders()
    assert beside == Path(__file__).resolve().parents[1] / ".venv-mediapipe"
    assert own.as_posix() == expected


def test_it_is_made_by_these_steps_and_marked_when_all_are_done(tmp_path, monkeypatch):
    done = []

    def run(command, **_):
        done.append([str(word) for word in command])
        failed = "--no-deps" in command and broken
        return subprocess.CompletedProcess(command, int(failed), "no such version" if failed else "")

    monkeypatch.setattr(subprocess, "run", run)
    folder, broken = tmp_path / "new", True
    with pytest.raises(TaskFailedError, match=r"could not fetch mediapipe \(exit status 1\): no such version"):
        make(folder)
    folder.mkdir()
    (folder / "pyvenv.cfg").touch()
    assert not (folder / environment._STAMP).exists()
    done.clear()
    broken = False
    assert make(folder) == python_of(folder) and (folder / environment._STAMP).is_file()
    assert done[0][1:] == ["-m", "venv", "--clear", str(folder)]
    assert done[1][-2:] == ["--no-deps", "mediapipe==0.10.21"] and "numpy<2" in done[2]
    assert not any("opencv-contrib" in word or word.startswith("jax") for step in done for word in step)


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").touch()
    assert main([str(tmp_path)]) == 2
    assert "is not a Python environment" in capsys.readouterr().err and (tmp_path / "thesis.tex").exists()


def test_a_python_that_fits_is_chosen(monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 12, 1))
    assert suitable_python() == sys.executable
    monkeypatch.setattr(sys, "version_info", (3, 14, 0))
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}" if name in {"python3.10", "python3.9"} else None)
    assert suitable_python() == "/bin/python3.10"
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(InputError, match=r"supports Python 3\.9 to 3\.12; this is Python 3\.14"):
        suitable_python()
