"""HTML tables in which notebooks display objects of imitarm (method ``_repr_html_``)."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


def html_table(title: str, rows: Mapping[str, object]) -> str:
    """Return an HTML table with one row for each name and value; all texts are escaped.

    Args:
        title: title above the table, for example the name of the class.
        rows: values by name, shown with ``str``. A row whose value is None or an empty text is left out.
    """
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows.items()
        if value is not None and value != ""
    )
    return f'<table><caption style="text-align:left"><b>{escape(title)}</b></caption>{cells}</table>'
