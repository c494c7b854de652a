"""A reader of another package: one class and one line, and it works in lint, in learn and among the known formats."""

from __future__ import annotations

import numpy as np
import pytest

from demonstration_samples import motions
from imitarm.cli import main
from imitarm.demonstrations import READERS, files_of, read
from imitarm.demonstrations import reading as reading_module
from imitarm.errors import FileFormatError, InputError
from imitarm.registry import Registry
from imitarm.skills import Skill
from test_registry import install

READER = '''
import numpy as np

from imitarm.demonstrations import RawDemonstration, Reader


class LoggerReader(Reader):
    """Lines of a logger: milliseconds, then millimetres."""

    suffixes = (".log",)

    def recognises(self, head):
        return head.startswith(b"OUR LOGGER")

    def read(self, path, options):
        table = np.loadtxt(path, skiprows=1)
        return [RawDemonstration(path, table[:, 0] / 1e3, table[:, 1:] / 1e3, task=options.task)]
'''


def log(file, demonstration):
    trajectory = demonstration.trajectory
    table = 1e3 * np.column_stack([trajectory.times, trajectory.positions])
    np.savetxt(file, table, header="OUR LOGGER 7", comments="")


@pytest.fixture
def readers(tmp_path, monkeypatch):
    """The registry as it is when a package with a reader is installed; a folder of its files."""
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "their_logger.py").write_text(READER, encoding="utf-8")
    install(packages, "imitarm.readers", logger="their_logger:LoggerReader")
    monkeypatch.syspath_prepend(str(packages))
    fresh = Registry("reader", READERS.group, reading_module._BUILT_IN)
    for module in ("imitarm.demonstrations", "imitarm.demonstrations.reading", "imitarm.cli.reading"):
        monkeypatch.setattr(f"{module}.READERS", fresh)
    folder = tmp_path / "logs"
    folder.mkdir()
    for i, one in enumerate(motions(4)):
        log(folder / f"demo_{i}.log", one)
    monkeypatch.setenv("COLUMNS", "200")
    return fresh, folder


def test_it_is_listed_and_read(readers):
    registry, folder = readers
    assert list(registry) == ["imitarm CSV", "NumPy arrays", "text table", "logger"]
    assert len(files_of(folder)) == 4
    expected = motions(4)[2].trajectory
    one = read(folder / "demo_2.log")[0].trajectory
    assert np.allclose(one.positions, expected.positions) and np.allclose(one.times, expected.times)


def test_it_works_in_lint_and_learn(readers, tmp_path, capsys):
    _, folder = readers
    assert main(["lint", str(folder)]) == 0
    assert "4 demonstrations, 0 errors, 0 warnings" in capsys.readouterr().out
    out = tmp_path / "skill.json"
    assert main(["learn", str(folder), "--components", "4", "--out", str(out)]) == 0
    assert Skill.load(out).n_demonstrations_ == 4


def test_it_is_among_the_known_formats(readers, tmp_path, capsys):
    (tmp_path / "x.bag").write_bytes(b"#ROSBAG V2.0\n\x00")
    assert main(["lint", str(tmp_path / "x.bag")]) == 2
    assert "logger (.log)" in " ".join(capsys.readouterr().out.split())
    assert main(["lint", "--help"]) == 0
    assert "logger" in capsys.readouterr().out


def test_its_content_decides(readers, tmp_path):
    _, folder = readers
    (folder / "demo_0.log").rename(tmp_path / "renamed")
    assert len(read(tmp_path / "renamed")) == 1
    (folder / "demo_1.log").rename(tmp_path / "demo.csv")  # text, as .csv says
    assert len(read(tmp_path / "demo.csv")) == 1
    (folder / "demo_2.log").rename(tmp_path / "demo.npy")
    with pytest.raises(FileFormatError, match=r"named \.npy \(NumPy arrays\), but its content is text \(logger\)"):
        read(tmp_path / "demo.npy")
    (tmp_path / "other.log").write_text("0 1 2 3\n1 1 2 3\n")
    with pytest.raises(FileFormatError, match=r"named \.log \(logger\), but its content is text \(text table\)"):
        read(tmp_path / "other.log")


def test_a_reader_that_can_not_be_imported_is_named(tmp_path, monkeypatch):
    install(tmp_path, "imitarm.readers", broken="no_such_package:X")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(reading_module, "READERS", Registry("reader", READERS.group, reading_module._BUILT_IN))
    with pytest.raises(InputError, match=r"reader 'broken' is added by .*no_such_package.*uninstall"):
        files_of(tmp_path)
