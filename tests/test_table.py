from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from imitarm.errors import FileFormatError, InputError
from imitarm.files.table import read_table, write_table

finite = st.floats(allow_nan=False, allow_infinity=False)


@given(values=arrays(float, st.tuples(st.integers(1, 5), st.just(3)), elements=finite))
def test_what_is_written_is_read_to_the_last_bit(tmp_path_factory, values):
    file = tmp_path_factory.mktemp("table") / "t.csv"
    write_table(file, {"task": "a: b", "note": "two\nlines"}, ["a", "b", "c"], values)
    table = read_table(file)
    assert np.array_equal(table.values, values)
    assert table.names == ("a", "b", "c")
    assert table.remarks == {"task": "a: b", "note": "two lines"}
    assert table.lines.tolist() == list(range(4, 4 + len(values)))
    assert table.ends_in_newline


@pytest.mark.parametrize(
    "text", ["1,2,3\n4,5,6\n", "1;2;3\n4;5;6\n", "1\t2\t3\n4\t5\t6\n", " 1  2 3\n4 5   6", "1, 2, 3\n4, 5, 6"]
)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_separators_newlines_and_byte_order_marks(tmp_path, text, newline, mark):
    file = tmp_path / "t.csv"
    file.write_bytes((mark + text.replace("\n", newline)).encode("utf-8"))
    assert read_table(file).values.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_names_in_a_row_or_in_a_remark(tmp_path):
    file = tmp_path / "t.txt"
    np.savetxt(file, np.eye(3), header="x y z")
    assert read_table(file).names == ("x", "y", "z")
    file.write_text('"x","y"\n1,2\n')
    assert read_table(file).names == ("x", "y")
    file.write_text("# just three words\n1 2\n")
    assert read_table(file).names is None


def test_a_separator_at_the_end_of_each_line_is_no_column(tmp_path):
    file = tmp_path / "t.csv"
    file.write_text("time,a,\n0.0,1,\n0.1,2,\n")
    table = read_table(file)
    assert table.names == ("time", "a")
    assert table.values.shape == (2, 2)


def test_lines_are_those_of_an_editor(tmp_path):
    file = tmp_path / "t.csv"
    file.write_text("# a\n\nx,y\n1,2\n# between\n\n3,4\n")
    assert read_table(file).lines.tolist() == [4, 7]
    file.write_text("1,2\x0c\n3,oops\n")  # a form feed is no new line
    with pytest.raises(FileFormatError, match="line 2"):
        read_table(file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"  \n\n", "is empty"),
        (b"# only a remark\n", "no rows"),
        (b"x,y,z\n", "column names but no rows"),
        (b"x,y,z\n1,2,3\n4,5\n", r"line 3: 2 values where 3 are expected; fix"),
        (b"x,y,z\n1,2,3\n4,5", r"line 3: 2 values .* cut off"),
        (b"1,2,3\n4,5,six\n", r"line 2, column 3: 'six' is not a number"),
        (b"1,2,3\n4,,6\n", r"line 2, column 2: a value is missing"),
        (b"1.5;2;3\n4;5,5;6\n", r"line 2: '5,5' .* decimal point"),
        (b"1,2,3\n4,1_000,6\n", r"line 2, column 2"),
        (b"x,2,z\n1,2,3\n", r"line 1, column 1: 'x' is not a number"),
        (b"1,2\n3,4 \xe9\n", r"line 2: byte 0xe9 is not UTF-8"),
        ("1,2\n3,4\n".encode("utf-16"), "text in UTF-16"),
        (b"1,2\n\x00\x01\x02", "binary data"),
        (b"\x89HDF\r\n\x1a\n0000", "an HDF5 file"),
        (b"PK\x03\x04xxxx", "zip archive"),
    ],
)
def test_every_bad_file_is_named_with_its_place(tmp_path, content, message):
    file = tmp_path / "bad.csv"
    file.write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_table(file)
    assert str(file) in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.csv: can't be read"):
        read_table(tmp_path / "nowhere.csv")
    with pytest.raises(InputError, match="can't be read"):
        read_table(tmp_path)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    file = tmp_path / "t.csv"
    write_table(file, {}, ["a"], np.array([[1.0]]))
    before = file.read_bytes()

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(InputError, match="No space left"):
        write_table(file, {}, ["a"], np.array([[2.0]]))
    assert file.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]
    with pytest.raises(InputError, match="can't be written"):
        write_table(tmp_path / "no" / "folder.csv", {}, ["a"], np.array([[2.0]]))
