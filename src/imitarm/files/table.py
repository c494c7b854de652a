"""Tables of numbers in text files. Error messages name the line, and writing never leaves an incomplete file.

A table consists of lines of numbers that are separated by commas, semicolons, tabs or spaces. A row of column names may
come first, with a row of units below it. If the separator is a semicolon or a tab, numbers may have decimal commas.
Lines that start with ``#`` or ``%`` are remarks. Remarks may hold ``key: value`` pairs or the column names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import write_text

Array = NDArray[np.float64]

# the first bytes of files of other kinds, so that the message can name the kind
SIGNATURES = {
    b"\x93NUMPY": "a NumPy array (.npy)",
    b"PK\x03\x04": "a zip archive (.npz, .xlsx or other)",
    b"\x89HDF": "an HDF5 file",
    b"#ROSBAG": "a ROS 1 bag",
    b"\x89MCAP": "an MCAP recording",
    b"SQLite format 3": "a SQLite database (a ROS 2 bag?)",
    b"PAR1": "a Parquet file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80": "a Python pickle, which is never opened",
    b"\xff\xfe": "text in UTF-16",
    b"\xfe\xff": "text in UTF-16",
}


_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
_NAME = re.compile(r"\"[^\"]*\"|[^\s\[(]*(?:\s*[\[(][^\])]*[\])])|[^\s\[(]+")


@dataclass(frozen=True, eq=False)
class Table:
    """The content of a text file.

    Attributes:
        path: path of the file as given by the caller.
        remarks: the ``key: value`` remarks before the numbers, keys in lower case.
        names: column names. They come from a separate row. Without this row, they come from the last remark before the
            numbers that has one word for each column. Units from a row of units are added in brackets (``x [mm]``). The
            value None means that the file has no column names.
        values: the numbers, shape (n, columns). The caller must check for nan and inf.
        lines: line number of each row in the file, from 1, shape (n,).
        ends_in_newline: whether the file ends with a line break; if not, the last line may have been cut off.
        names_line: line number of the column names, from 1; None when there are no names.
        remark_lines: line number and text of each remark in the file, without the ``#``.
    """

    path: str
    remarks: Mapping[str, str]
    names: tuple[str, ...] | None
    values: Array
    lines: NDArray[np.int64]
    ends_in_newline: bool
    names_line: int | None = None
    remark_lines: tuple[tuple[int, str], ...] = ()

    @property
    def named_by_row(self) -> bool:
        """Whether the column names are in a separate row, not in a remark."""
        return self.names is not None and self.names_line not in {number for number, _ in self.remark_lines}


def read_bytes(path: str | Path) -> bytes:
    """Return the bytes of a file.

    Raises:
        InputError: when the file can't be opened.
        FileFormatError: when the file is empty.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error}); check the path") from error
    if not content.strip():
        raise FileFormatError(f"{path}: the file is empty; record or copy it again")
    return content


def kind_of(content: bytes) -> str | None:
    """Return the kind of a binary file, from the first bytes of ``content``; None when these bytes look like text."""
    for signature, kind in SIGNATURES.items():
        if content.startswith(signature):
            return kind
    return "binary data" if b"\0" in content[:4096] else None


def _text_of(path: str | Path, content: bytes) -> str:
    kind = kind_of(content)
    if kind is not None:
        raise FileFormatError(
            f"{path}: this is {kind}, not a text table; correct its file name, or export it as UTF-8 CSV"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise FileFormatError(
            f"{path}, line {line}: byte 0x{content[error.start]:02x} is not UTF-8; save the file as UTF-8"
        ) from error
    # not splitlines(): it also breaks at form feeds and the like, and line numbers would differ from an editor's
    return text.replace("\r\n", "\n").replace("\r", "\n")


def split_names(text: str) -> tuple[str, ...]:
    """Split a line of column names.

    A unit in brackets belongs to the name before the unit, so ``t (s) x (m)`` gives two names.
    """
    separator = _separator(text)
    if separator is not None:
        return tuple(_fields(text, separator))
    return tuple(word.strip('"') for word in _NAME.findall(text))


def _separator(line: str) -> str | None:
    """Return the character that separates the fields of ``line``; None means spaces."""
    return next((s for s in ";\t," if s in line), None)


def _fields(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    fields = [field.strip().strip('"') for field in line.split(separator)]
    return fields[:-1] if fields[-1] == "" else fields  # some recorders end each line with a separator


def _number(field: str) -> float | None:
    try:
        return None if "_" in field else float(field)  # float() alone reads 1_0 as ten
    except ValueError:
        return None


def _row(path: str | Path, number: int, fields: Sequence[str], width: int, last: bool) -> list[float]:
    if len(fields) != width:
        remedy = "the file was cut off: record it again or remove its last line" if last else "fix that line"
        if len(fields) == 2 * width:
            remedy = "if the commas are decimal commas, replace them by decimal points"
        raise FileFormatError(f"{path}, line {number}: {len(fields)} values where {width} are expected; {remedy}")
    numbers = [_number(field) for field in fields]
    values = [value for value in numbers if value is not None]
    if len(values) < width:
        column = numbers.index(None)
        field = fields[column]
        what = f"{field[:40]!r} is not a number" if field else "a value is missing"
        hint = "use a decimal point" if re.fullmatch(r"[-+]?[\d.]*,[\d.,]*", field) else "fix or remove that line"
        raise FileFormatError(f"{path}, line {number}, column {column + 1}: {what}; {hint}")
    return values


def _units_row(names: Sequence[str], line: str) -> list[str] | None:
    """Return the units in the line below the column names; None when that line does not consist of units."""
    units = [unit.strip("[]()") for unit in _fields(line, _separator(line))]
    if len(units) != len(names) or any(_number(unit) is not None or "," in unit for unit in units) or not any(units):
        return None
    return None if any("[" in name or "(" in name for name in names) else units


def _with_units(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return the column names with their units in brackets; a column whose unit is ``-`` or empty keeps its name."""
    return tuple(f"{name} [{unit}]" if unit not in ("", "-") else name for name, unit in zip(names, units, strict=True))


def _with_decimal_points(path: str | Path, body: Sequence[tuple[int, str]], separator: str) -> list[tuple[int, str]]:
    """Replace decimal commas by decimal points in the rows; rows without decimal commas are returned unchanged.

    Raises:
        FileFormatError: when the commas could also be separators of thousands.
    """
    fields = {field: number for number, line in body for field in _fields(line, separator)}
    commas = [field for field in fields if _DECIMAL_COMMA.fullmatch(field)]
    if not commas:
        return list(body)
    first = commas[0]
    points = next((field for field in fields if "." in field and _number(field.replace(",", "")) is not None), None)
    if points is not None or all(_THOUSANDS.fullmatch(field) for field in commas):
        why = f" ({points!r} has a decimal point)" if points else ""
        raise FileFormatError(
            f"{path}, line {fields[first]}: {first!r} has a decimal comma or a comma between thousands{why}; write all "
            "numbers with decimal points and without other commas"
        )
    return [(number, line.replace(",", ".")) for number, line in body]


def _names_in_remarks(remarks: Sequence[tuple[int, str]], width: int) -> tuple[int | None, tuple[str, ...] | None]:
    """Return the line number and the words of the last remark that has exactly ``width`` words and no number."""
    for number, text in reversed(remarks):
        for part in (text, text.partition(":")[2]):  # "t x y z" as well as "columns: t x y z"
            names = split_names(part)
            if len(names) == width and ":" not in part and all(_number(name) is None for name in names):
                return number, names
    return None, None


def read_table(path: str | Path) -> Table:
    """Read a table of numbers.

    Raises:
        InputError: when the file can't be opened.
        FileFormatError: when the file is empty, binary or not UTF-8, when it has no rows or rows of different lengths,
            or when an entry is not a number. The message names file and line.
    """
    return parse_table(path, read_bytes(path))


def parse_table(path: str | Path, content: bytes) -> Table:
    """Read a table of numbers from bytes; :func:`read_table` does the same with a file.

    Args:
        path: the name of the file, for messages.
        content: bytes of the file, or of the part that is to be read.

    Raises:
        FileFormatError: for the same reasons as :func:`read_table`.
    """
    text = _text_of(path, content)
    stripped = [(number, line.strip(" \f\v")) for number, line in enumerate(text.split("\n"), start=1)]
    written = [(number, line) for number, line in stripped if line.strip()]
    body = [(number, line) for number, line in written if line[0] not in "#%"]
    if not body:
        raise FileFormatError(f"{path}: holds no rows of numbers; record or export it again")
    remark_lines = tuple((number, line.lstrip("#% \t")) for number, line in written if line[0] in "#%")
    before = [(number, text) for number, text in remark_lines if number < body[0][0]]
    pairs = [text.partition(":") for _, text in before]
    remarks = {key.strip().lower(): value.strip() for key, colon, value in pairs if colon}
    names_line: int | None
    names: tuple[str, ...] | None
    names_line, names = body[0][0], split_names(body[0][1])
    if all(_number(name) is None and _DECIMAL_COMMA.fullmatch(name) is None for name in names):
        width, body = len(names), body[1:]
        if not body:
            raise FileFormatError(f"{path}: has column names but no rows; record or export it again")
    else:
        width = len(_fields(body[0][1], _separator(body[0][1])))
        names_line, names = _names_in_remarks(before, width)
    units = _units_row(names, body[0][1]) if names is not None and names_line not in dict(remark_lines) else None
    if names is not None and units is not None:
        names, body = _with_units(names, units), body[1:]
        if not body:
            raise FileFormatError(f"{path}: has column names and units but no rows; record or export it again")
    separator = _separator(body[0][1])
    if separator in (";", "\t"):
        body = _with_decimal_points(path, body, separator)
    rows = [_row(path, number, _fields(line, separator), width, number == len(stripped)) for number, line in body]
    lines = np.array([number for number, _ in body], dtype=np.int64)
    return Table(str(path), remarks, names, np.array(rows), lines, text.endswith("\n"), names_line, remark_lines)


def write_table(
    path: str | Path, remarks: Mapping[str, str], names: Sequence[str], values: NDArray[np.float64]
) -> None:
    """Write a table; :func:`read_table` reads exactly the same numbers back.

    The table is written to a temporary file, which is then renamed. An existing file therefore stays intact until the
    new file is complete.

    Args:
        path: file to write; an existing file is replaced.
        remarks: remarks to write before the numbers, each as a line ``# key: value``; line breaks in values become
            spaces.
        names: the column names.
        values: the numbers, shape (n, len(names)).

    Raises:
        InputError: when the file can't be written.
    """
    head = [f"# {key}: {' '.join(str(value).split())}" for key, value in remarks.items()]
    body = [",".join(map(repr, row)) for row in np.asarray(values, dtype=float).tolist()]
    write_text(path, "\n".join([*head, ",".join(names), *body, ""]))
