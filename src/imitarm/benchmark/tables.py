"""Tables of results as rows of text, for a terminal, a report page or a Markdown document."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imitarm.benchmark.experiment import write_text
from imitarm.benchmark.provenance import origin
from imitarm.errors import InputError

END = "<!-- end -->"


@dataclass(frozen=True)
class Table:
    """A table of text with a title, columns, rows and a note. A column contains numbers if its name ends in ``>``."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [f"**{self.title}**", "", f"| {' | '.join(c.removesuffix('>') for c in self.columns)} |"]
        lines.append(f"|{'|'.join('--:' if c.endswith('>') else '---' for c in self.columns)}|")
        lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else []), ""])

    def for_page(self) -> dict[str, Any]:
        """Return the table for the template of a report page.

        ``kind`` says whether a column contains words, numbers or symbols.
        """
        columns = [
            {
                "title": column.removesuffix(">"),
                "kind": "words" if not column.endswith(">") else "" if column[:1].isascii() else "symbol",
            }
            for column in self.columns
        ]
        return {"title": self.title, "note": self.note, "columns": columns, "rows": self.rows}


@dataclass(frozen=True)
class Place:
    """The place in a Markdown document where the tables of a benchmark stand.

    Attributes:
        document: path of the Markdown document.
        benchmark: name of the benchmark. The tables stand between two comment lines of the document. The first line is
            :attr:`begin`, which contains this name. The second line is :data:`END`.

    Raises:
        InputError: when the document can't be read, or does not contain each of the two comment lines once, in this
            order.
    """

    document: Path
    benchmark: str

    def __post_init__(self) -> None:
        self._parts()

    @property
    def begin(self) -> str:
        """The comment line above the tables in the document."""
        return f"<!-- imitarm benchmark {self.benchmark} -->"

    def fill(self, found: Sequence[Table], command: str, versions: Iterable[str]) -> None:
        """Replace the tables in the document. The rest of the document stays unchanged.

        Args:
            found: the tables.
            command: the command that printed the tables.
            versions: version of the code for each result. If the running code has another version, the document says
                so.
        """
        head, tail = self._parts()
        body = "\n".join(table.markdown() for table in found)
        said = f"Printed by `{command}`. {origin(versions)}"
        write_text(self.document, f"{head}{self.begin}\n{said}\n\n{body}\n{END}\n{tail}")

    def _parts(self) -> tuple[str, str]:
        """Return two parts of the document: the text before the tables, and the text after them."""
        try:
            text = self.document.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self.document}: can't be read as a document ({error})") from error
        head, found, rest = text.partition(f"{self.begin}\n")
        _, ended, tail = rest.partition(f"{END}\n")
        others = (head + tail).count("<!-- imitarm benchmark ")  # each has an end of its own
        if not found or not ended or self.begin in rest or (head + tail).count(f"{END}\n") != others:
            raise InputError(
                f"{self.document}: the tables belong between a line {self.begin!r} and a line {END!r} after it; write "
                "both lines, once each"
            )
        return head, tail
