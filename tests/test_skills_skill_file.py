from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imitarm.errors import FileFormatError, InputError
from imitarm.skills import Skill
from imitarm.skills.skill_file import VERSION, Fields, read_skill, write_skill
from skill_samples import same, shown


@pytest.fixture(scope="module")
def skill() -> Skill:
    return Skill(3, n_basis=6).fit(shown(n=2))


@pytest.fixture(scope="module")
def path(skill: Skill, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("skills") / "sweep.json"
    skill.save(path)
    return path


fuzz = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def try_bytes(data: bytes, skill: Skill, path: Path) -> None:
    """A changed file either says so or holds the same skill."""
    altered = path.with_name("altered.json")
    altered.write_bytes(data)
    try:
        again = Skill.load(altered)
    except FileFormatError as error:
        assert "altered.json" in str(error)
    else:
        assert same(skill, again)


@fuzz
@given(share=st.floats(0.0, 1.0))
def test_a_cut_file_is_refused(skill: Skill, path: Path, share: float) -> None:
    data = path.read_bytes()
    try_bytes(data[: int(share * len(data))], skill, path)


@fuzz
@given(where=st.floats(0.0, 1.0), byte=st.integers(0, 255))
def test_a_changed_byte_is_noticed(skill: Skill, path: Path, where: float, byte: int) -> None:
    data = bytearray(path.read_bytes())
    data[min(int(where * len(data)), len(data) - 1)] = byte
    try_bytes(bytes(data), skill, path)


@fuzz
@given(a=st.floats(0.0, 1.0), b=st.floats(0.0, 1.0), inserted=st.binary(max_size=12))
def test_a_replaced_piece_is_noticed(skill: Skill, path: Path, a: float, b: float, inserted: bytes) -> None:
    data = path.read_bytes()
    low, high = sorted((int(a * len(data)), int(b * len(data))))
    try_bytes(data[:low] + inserted + data[min(high, low + 40) :], skill, path)


@fuzz
@given(data=st.one_of(st.binary(max_size=200), st.text(max_size=200).map(lambda s: s.encode("utf-8", "surrogatepass"))))
def test_anything_else_is_refused(skill: Skill, path: Path, data: bytes) -> None:
    try_bytes(data, skill, path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{}",
        "[" * 100_000,
        '{"a":' * 100_000,
        "1" * 10_000,
        '{"format": "imitarm skill", "format": "imitarm skill"}',
        '{"format": "imitarm skill", "version": true}',
        '{"format": "imitarm skill", "version": 0}',
        '{"format": "imitarm skill", "version": 1}',
        '{"format": "imitarm skill", "version": 1, "x": 1e999}',
        '{"format": "imitarm skill", "version": 1, "x": NaN}',
        '{"format": "imitarm skill", "version": 1, "x": "\\ud800", "checksum": 3}',
        '{"format": "another", "version": 1}',
        "\ufeff{}",
    ],
)
def test_what_is_no_skill_file_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=r"odd\.json"):
        Skill.load(path)


def test_a_pickle_is_not_run(tmp_path: Path) -> None:
    touched = tmp_path / "touched"

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(touched),)

    path = tmp_path / "trap.json"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FileFormatError):
        Skill.load(path)
    assert not touched.exists()


def test_a_digit_changed_by_hand_is_refused(path: Path) -> None:
    text = path.read_text()
    altered = path.with_name("by_hand.json")
    altered.write_text(text.replace('"duration": 2.0', '"duration": 3.0', 1))
    with pytest.raises(FileFormatError, match="checksum does not fit"):
        Skill.load(altered)


def test_layout_may_change(skill: Skill, path: Path) -> None:
    compact = path.with_name("compact.json")
    compact.write_text(json.dumps(json.loads(path.read_text())))
    assert same(skill, Skill.load(compact))


def test_a_future_version_says_what_can_be_read(path: Path) -> None:
    whole = json.loads(path.read_text())
    whole["version"] = VERSION + 1
    future = path.with_name("future.json")
    future.write_text(json.dumps(whole))
    with pytest.raises(FileFormatError, match=rf"version {VERSION + 1} .* reads versions up to {VERSION}"):
        Skill.load(future)


def test_a_person_can_read_it(path: Path) -> None:
    lines = path.read_text().splitlines()
    whole = json.loads(path.read_text())
    assert list(whole)[:2] == ["format", "version"]
    assert whole["units"] == {"time": "s", "length": "m", "angle": "rad"}
    assert "w, x, y, z" in whole["frames"]["quaternions"]
    rows = [line for line in lines if line.strip().startswith("[") and line.strip(" ,").endswith("]")]
    assert len(rows) >= sum(len(whole["gmr"]["means"]) for _ in range(2))  # tables have one row a line


def test_no_such_file_and_no_such_folder(skill: Skill, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't read"):
        Skill.load(tmp_path / "missing.json")
    with pytest.raises(InputError, match="can't read"):
        Skill.load(tmp_path)
    with pytest.raises(InputError, match="can't write"):
        skill.save(tmp_path / "missing" / "s.json")


def test_a_failed_write_leaves_the_old_file_and_no_litter(
    skill: Skill, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.json"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        skill.save(path)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["s.json"]


def test_numbers_that_are_none_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not finite"):
        write_skill(tmp_path / "s.json", {"x": np.array([1.0, np.nan])})
    assert list(tmp_path.iterdir()) == []


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.json"
    with path.open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(FileFormatError, match="larger than 64 MB"):
        read_skill(path)


def test_fields_answer_with_the_type_asked_for() -> None:
    fields = Fields({"n": 3, "x": 1.5, "t": [[1, 2.0]], "s": "a", "l": ["a"], "b": True, "g": {"k": 1}}, "here")
    assert fields.integer("n") == 3
    assert fields.number("x") == 1.5
    assert fields.number("n") == 3.0
    np.testing.assert_array_equal(fields.array("t", 2), [[1.0, 2.0]])
    assert (fields.text("s"), fields.texts("l"), fields.flag("b")) == ("a", ("a",), True)
    assert fields.group("g").integer("k") == 1
    assert not fields.has("nothing")
    for wrong in (
        lambda: fields.integer("x"),
        lambda: fields.integer("b"),
        lambda: fields.number("b"),
        lambda: fields.number("s"),
        lambda: fields.array("x", 1),
        lambda: fields.text("n"),
        lambda: fields.texts("s"),
        lambda: fields.flag("n"),
        lambda: fields.group("s"),
        lambda: fields.text("nothing"),
    ):
        with pytest.raises(FileFormatError, match="here"):
            wrong()
