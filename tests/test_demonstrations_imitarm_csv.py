from __future__ import annotations

import pytest

from demonstration_samples import motion
from imitarm.demonstrations import read, read_raw
from imitarm.demonstrations.text_tables import ImitarmReader
from imitarm.errors import FileFormatError, InputError


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("first", ["", "# made by hand\n\n"])
def test_it_is_recognised_by_its_remark(tmp_path, newline, mark, first):
    file = tmp_path / "a.csv"
    motion(n=20, rotations=True).save(file)
    text = mark + first + file.read_text()
    file.write_bytes(text.replace("\n", newline).encode())
    assert ImitarmReader().recognises(file.read_bytes())
    assert len(read(file)) == 1


@pytest.mark.parametrize(
    "head", [b"", b"t,x,y,z\n0,0,0,0\n", b"0 0 0\n# format: imitarm-demonstration\n", b"\x93NUMPY"]
)
def test_other_files_are_not(head):
    assert not ImitarmReader().recognises(head)


def test_faults_of_rows_are_left_to_lint(tmp_path):
    file = tmp_path / "a.csv"
    motion(n=20).save(file)
    lines = file.read_text().splitlines()
    lines[10], lines[11] = lines[11], lines[10]
    file.write_text("\n".join(lines) + "\n")
    (raw,) = read_raw(file)
    assert raw.late().sum() == 1
    assert raw.where(3) == f"{file}, line 12"
    with pytest.raises(FileFormatError, match="line 12: the time is not later"):
        read(file)


def test_its_units_are_not_to_be_overruled(tmp_path):
    file = tmp_path / "a.csv"
    motion(n=20).save(file)
    assert len(read(file, units="m", time_units="s")) == 1
    with pytest.raises(InputError, match="its header states m and s"):
        read(file, units="cm")
    with pytest.raises(InputError, match="its own time stamps"):
        read(file, duration=3.0)


def test_a_cut_file_is_refused(tmp_path):
    file = tmp_path / "a.csv"
    motion(n=20).save(file)
    file.write_text("\n".join(file.read_text().splitlines()[:-3]) + "\n")
    with pytest.raises(FileFormatError, match="announces 20 samples, but the file holds 17"):
        read_raw(file)
