"""Table: what a benchmark found, as texts in rows, for a terminal, a page or a document."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """Texts in rows: ``title``, ``columns`` (one that ends in ``>`` is a number), ``rows``, a ``note`` below."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Return it as Markdown."""
        lines = [f"**{self.title}**", "", f"| {' | '.join(c.removesuffix('>') for c in self.columns)} |"]
        lines.append(f"|{'|'.join('--:' if c.endswith('>') else '---' for c in self.columns)}|")
        lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else []), ""])
