from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.files.part_file import PART, PartFile


@given(texts=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\r"))))
def test_all_of_it_is_there_at_any_moment_and_under_its_name_only_in_the_end(tmp_path_factory, texts):
    path = tmp_path_factory.mktemp("part") / "a.csv"
    file, so_far = PartFile(path, "head\n"), "head\n"
    for text in texts:
        file.write(text)
        so_far += text
        assert file.part.read_bytes() == so_far.encode() and not path.exists()
    file.finish(lambda part: bool(part.replace(path)), begin="HEAD\n")
    assert path.read_bytes() == b"HEAD\n" + so_far.encode()[5:] and not file.part.exists()


def test_what_is_not_taken_is_removed_and_a_finished_one_takes_no_more(tmp_path):
    file, taken = PartFile(tmp_path / "a.csv", ""), []
    for _ in range(2):
        file.finish(lambda part: bool(taken.append(part)))
    assert taken == [tmp_path / f"a.csv{PART}"] and list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="closed"):
        file.write("x")


def test_a_recording_that_another_has_begun_under_the_same_name_is_left_alone(tmp_path):
    """It may begin as soon as the first one has its name."""
    path, others = tmp_path / "a.csv", []

    def rename(part):
        part.replace(path)
        others.append(PartFile(path, "another", replace=True))
        return True

    PartFile(path, "first").finish(rename)
    assert path.read_text() == "first" and others[0].part.read_text() == "another"
    others[0].finish(lambda part: bool(part.replace(path)))


def test_when_it_can_not_be_taken_it_stays(tmp_path):
    def full(part):
        raise OSError(28, "No space left on device")

    file = PartFile(tmp_path / "a.csv", "kept")
    with pytest.raises(InputError, match=r"a\.csv: can't be written: No space left"):
        file.finish(full)
    assert file.part.read_text() == "kept"


def test_where_it_can_not_begin_is_told(tmp_path):
    for path, words in ((tmp_path, "is a folder"), (tmp_path / "no" / "a.csv", "can't be written")):
        with pytest.raises(InputError, match=words):
            PartFile(path, "")
