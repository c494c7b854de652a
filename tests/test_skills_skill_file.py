from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imitarm.errors import FileFormatError, InputError
from imitarm.skills import DMP, GMR, Skill
from imitarm.skills.skill_file import VERSION, _checksum, dmp_fields, dmp_of, gmr_fields, gmr_of, read_skill
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
    with pytest.raises(FileFormatError, match="checksum does not match"):
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
    with pytest.raises(InputError, match="can't be written"):
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


def test_numbers_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    skill = Skill(3, n_basis=6).fit(shown(n=2))
    skill.dmp_.goal_[0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        skill.save(tmp_path / "s.json")
    assert list(tmp_path.iterdir()) == []


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.json"
    with path.open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(FileFormatError, match="larger than 64 MB"):
        read_skill(path)


@pytest.mark.parametrize("turn", [None, 1.0, 6.0])
def test_a_regression_comes_back_to_the_last_bit(turn: float | None) -> None:
    gmr = GMR(candidates=[3, 4]).fit(shown(n=3, turn=turn))
    again = gmr_of(gmr_fields(gmr))
    t = np.linspace(0.0, 2.0, 17)
    np.testing.assert_array_equal(again.predict(t)[0], gmr.predict(t)[0])
    np.testing.assert_array_equal(again.predict(t)[1], gmr.predict(t)[1])
    if turn is not None:
        np.testing.assert_array_equal(again.predict_orientation(t)[0], gmr.predict_orientation(t)[0])
    assert again.selection_ == gmr.selection_
    assert (again.n_demonstrations_, again.degenerate_axes_, again.converged_, again.lower_bound_) == (
        gmr.n_demonstrations_,
        gmr.degenerate_axes_,
        gmr.converged_,
        gmr.lower_bound_,
    )


@pytest.mark.parametrize("turn", [None, 6.0])
def test_a_primitive_comes_back_to_the_last_bit(turn: float | None) -> None:
    dmp = DMP("thesis", n_basis=15).fit(shown(n=1, turn=turn)[0].trajectory)
    again = dmp_of(dmp_fields(dmp))
    a, b = dmp.generate(goal=[0.1, 0.2, 0.3]), again.generate(goal=[0.1, 0.2, 0.3])
    np.testing.assert_array_equal(a.positions, b.positions)
    if turn is not None:
        assert a.quaternions is not None
        assert b.quaternions is not None
        np.testing.assert_array_equal(a.quaternions, b.quaternions)


def rewritten(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A file with other content and a checksum that fits it, in the same folder."""
    whole = json.loads(path.read_text())
    del whole["checksum"]
    change(whole)
    whole["checksum"] = _checksum(whole)
    other = path.with_name("rewritten.json")
    other.write_text(json.dumps(whole))
    return other


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("dmp.duration", None, r"dmp\.duration: expected `float`, got `null`"),
        ("dmp.duration", -1.0, "duration must be a finite number above 0"),
        ("dmp.damping", 0.0, "stiffness and damping"),
        ("dmp.start_velocity", [0.0], "start_velocity must be 3 numbers"),
        ("dmp.weights", [[1.0, 2.0], [3.0]], "weights must be"),
        ("dmp.weights.0.1", "1", r"dmp\.weights\[0\]\[1\]: expected `float`, got `str`"),
        ("gmr.weights.0", True, r"gmr\.weights\[0\]: expected `float`, got `bool`"),
        ("gmr.n_demonstrations", 2.5, r"gmr\.n_demonstrations: expected `int`, got `float`"),
        ("gmr.n_demonstrations", -1, r"gmr\.n_demonstrations: expected `int` >= 0"),
        ("gmr.converged", 1, r"gmr\.converged: expected `bool`, got `int`"),
        ("gmr.ends", [[0.0]], "ends must be an array of shape"),
        ("provenance.notes", "a", r"provenance\.notes: expected `array`, got `str`"),
        ("task", 3, "task: expected `str`, got `int`"),
        ("fit.distances", 3, "fit: object missing required field"),
        ("fit.bias", [], r"fit\.bias: expected `float`, got `array`"),
    ],
)
def test_a_wrong_field_is_named_with_its_place_and_a_remedy(
    path: Path, where: str, value: object, message: str
) -> None:
    def change(whole: dict[str, Any]) -> None:
        *groups, last = where.split(".")
        group: Any = whole
        for name in groups:
            group = group[int(name) if name.isdigit() else name]
        if where == "fit.distances":
            del group["rms, largest, start, goal"]
        else:
            group[int(last) if last.isdigit() else last] = value

    with pytest.raises(FileFormatError, match=rf"rewritten\.json.*{message}") as caught:
        Skill.load(rewritten(path, change))
    assert "\n" not in str(caught.value)


def test_every_missing_field_is_named(path: Path) -> None:
    whole = json.loads(path.read_text())
    for group in ("gmr", "dmp", "provenance"):
        for name in set(whole[group]) - {"orientation", "reference", "selection", "ends", "log_likelihood"}:
            with pytest.raises(FileFormatError, match=f"{group}: object missing required field `{name}`"):
                Skill.load(rewritten(path, lambda w, g=group, n=name: w[g].pop(n)))


def test_a_file_of_version_1_is_read(skill: Skill, path: Path) -> None:
    """Version 1 knew neither the mean ends nor the quality of the fit: the path then ends where the primitive does."""

    def older(whole: dict[str, Any]) -> None:
        whole["version"] = 1
        del whole["fit"], whole["gmr"]["ends"]

    again = Skill.load(rewritten(path, older))
    assert again.fit_quality_ is None
    assert same(skill, again)
    times = np.linspace(0.0, skill.duration_, 20)
    np.testing.assert_allclose(again.nominal(times).positions, skill.nominal(times).positions, rtol=0, atol=1e-12)


def test_the_quality_of_the_fit_comes_back(skill: Skill, path: Path) -> None:
    assert Skill.load(path).fit_quality_ == skill.fit_quality_
