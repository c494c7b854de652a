from __future__ import annotations

import pytest

from imitarm.benchmark.real_motions import PACES, main, real_motions, tables
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
    lines = list(tables(motions[:1]))
    cut = lines.index("")
    modern, methods = lines[2:cut], lines[cut + 3 :]
    assert len(modern) == 2 * len(PACES) and len(methods) == 2 * len(RETARGETERS)
    assert len({line.count("|") for line in lines[:cut]}) == 1
    column = [cell.strip() for cell in lines[0].split("|")].index("frames beyond a limit")
    assert {line.split("|")[column].strip() for line in modern} == {"0"}
    assert any(line.split("|")[column + 1].strip() != "0" for line in methods)  # others do break limits


def test_a_folder_without_recordings_is_told(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "Ges01_wavehand.csv" in capsys.readouterr().err
