from __future__ import annotations

import pytest

from imitarm.benchmark import real_motions as module
from imitarm.benchmark.real_motions import BEGIN, END, PACES, main, real_motions, tables
from imitarm.benchmark.tables import Table
from imitarm.retarget import RETARGETERS


@pytest.mark.slow
def test_the_tables_have_a_row_for_each_arm_pace_and_method(real_data):
    motions = list(real_motions(real_data))
    assert [motion.name for motion in motions] == [
        "wave hand",
        "balance hands",
        "draw lines",
        "come here",
        "motion capture",
    ]
    modern, methods = tables(motions[:1])
    assert len(modern.rows) == 2 * len(PACES) and len(methods.rows) == 2 * len(RETARGETERS)
    for table in (modern, methods):
        assert {len(row) for row in table.rows} == {len(table.columns)}
    broken = "frames beyond a limit>"
    assert {row[modern.columns.index(broken)] for row in modern.rows} == {"0"}
    assert any(row[methods.columns.index(broken)] != "0" for row in methods.rows)  # others do break limits


def test_the_tables_go_into_a_document_between_two_lines(tmp_path, monkeypatch, capsys):
    document = tmp_path / "page.md"
    document.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    monkeypatch.setattr(module, "real_motions", lambda *_: [])
    monkeypatch.setattr(module, "tables", lambda _: [Table("new", ("a", "b>"), (("1", "2"),))])
    assert main([str(tmp_path), "--fill", str(document)]) == 0
    text = document.read_text()
    assert text.startswith(f"before\n{BEGIN}\n") and text.endswith(f"{END}\nafter\n")
    assert "| 1 | 2 |" in text and "old" not in text and "| 1 | 2 |" in capsys.readouterr().out
    document.write_text("no place for tables\n")
    assert main([str(tmp_path), "--fill", str(document)]) == 2
    assert "the tables go between" in capsys.readouterr().err and document.read_text() == "no place for tables\n"
    assert main([str(tmp_path), "--fill", str(tmp_path / "nowhere.md")]) == 2


def test_a_folder_without_recordings_is_told(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "Ges01_wavehand.csv" in capsys.readouterr().err
