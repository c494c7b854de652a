from __future__ import annotations

import pytest

from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.tables import END, Place, Table
from imitarm.errors import InputError

BEGIN = "<!-- imitarm benchmark avoidance -->"
TABLE = Table("T", ("a", "b>"), (("x|y", "1"),), "note")


def test_tables_go_between_the_marks_and_nothing_else_changes(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\nbefore\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    for _ in range(2):
        Place(page, "avoidance").fill([TABLE], "imitarm benchmark avoidance", [code_version()])
        text = page.read_text()
        assert text.startswith(f"# Title\n\nbefore\n\n{BEGIN}\n")
        assert text.endswith(f"{END}\n\nafter\n")
        assert "old" not in text
        assert f"Printed by `imitarm benchmark avoidance`. Results of {code_version()}.\n" in text
        assert "| x\\|y | 1 |" in text
        assert text.count("**T**") == 1


def test_a_document_says_when_its_results_are_of_other_code(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"{BEGIN}\n{END}\n")
    Place(page, "avoidance").fill([TABLE], "imitarm benchmark avoidance", ["commit 0123456789"])
    assert "Results of commit 0123456789. Another version of the code made these tables" in page.read_text()


@pytest.mark.parametrize(
    "wrong", ["no marks\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{BEGIN}\n{END}\n", f"{BEGIN}\n", f"{BEGIN}\n{END}\n{END}\n"]
)
def test_a_document_without_a_place_for_the_tables_is_refused(tmp_path, wrong):
    page = tmp_path / "page.md"
    page.write_text(wrong)
    with pytest.raises(InputError, match="the tables belong between"):
        Place(page, "avoidance")
    assert page.read_text() == wrong
    with pytest.raises(InputError, match="can't be read"):
        Place(tmp_path / "nowhere.md", "avoidance")
