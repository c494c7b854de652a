from __future__ import annotations

import pytest

from imitarm import cli
from imitarm.benchmark import real_motions as module
from imitarm.benchmark.real_motions import SPEEDS, Motion, real_motions, tables
from imitarm.benchmark.tables import Table
from imitarm.retarget import RETARGETERS


@pytest.mark.slow
def test_the_tables_have_a_row_for_each_arm_speed_and_method(real_data):
    motions = list(real_motions(real_data))
    assert [motion.name for motion in motions] == [
        "wave hand",
        "balance hands",
        "draw lines",
        "come here",
        "motion capture",
    ]
    name, skeletons, side = motions[0]
    begin = skeletons[0].time
    modern, methods = tables([Motion(name, [s for s in skeletons if s.time < begin + 3.0], side)])
    assert len(modern.rows) == 2 * len(SPEEDS) and len(methods.rows) == 2 * len(RETARGETERS)
    for table in (modern, methods):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    broken = "frames beyond a limit>"
    assert {row[modern.columns.index(broken)] for row in modern.rows} == {"0"}
    assert any(row[methods.columns.index(broken)] != "0" for row in methods.rows)  # others do break limits


def test_the_command_prints_the_tables_and_fills_a_document(tmp_path, monkeypatch, capsys):
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- imitarm benchmark people -->\nold\n<!-- end -->\nafter\n")
    monkeypatch.setattr(module, "real_motions", lambda *_: [])
    monkeypatch.setattr(module, "tables", lambda _: [Table("new", ("a", "b>"), (("1", "2"),))])
    assert cli.main(["benchmark", "people", str(tmp_path), "--fill", str(document)]) == 0
    text = document.read_text()
    assert "| 1 | 2 |" in text and "old" not in text and "new" in capsys.readouterr().out
    assert cli.main(["benchmark", "people", str(tmp_path), "--fill", str(tmp_path / "nowhere.md")]) == 2
    assert "can't be read" in capsys.readouterr().err


def test_a_folder_without_recordings_is_reported(tmp_path, capsys):
    assert cli.main(["benchmark", "people", str(tmp_path)]) == 2
    assert "Ges01_wavehand.csv" in capsys.readouterr().err
