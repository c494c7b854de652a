"""Building and loading compiled code: nothing needs it, and a library of other sources is not used."""

from __future__ import annotations

import runpy
import shutil

import numpy as np
import pytest

import imitarm.compiled.__main__
from compiled_code import library_at
from imitarm.compiled import build, kernels, library
from imitarm.compiled.kernels import Record, address
from imitarm.perception import Detection, ObstacleTracker
from imitarm.scene import Sphere


def test_without_a_compiler_or_a_library_numpy_is_used(tmp_path, monkeypatch):
    with library_at(tmp_path / "kernels.compiled"):
        monkeypatch.setattr(shutil, "which", lambda _: None)
        assert "NumPy is used" in build()
        assert library() is None
        (tmp_path / "kernels.compiled").write_text("no library")
        library.cache_clear()
        assert library() is None
        tracker = ObstacleTracker()
        for k in range(3):
            tracker.update(k / 30.0, [Detection(Sphere(np.zeros(3), 0.1), 1e-4 * np.eye(3))])
        assert len(tracker.tracks) == 1


@pytest.mark.usefixtures("compiler")
def test_a_failing_compiler_is_reported(tmp_path, monkeypatch):
    (tmp_path / "wrong.c").write_text("this is not C")
    monkeypatch.setattr(kernels, "FOLDER", tmp_path)
    with library_at(tmp_path / "kernels.compiled"):
        assert "failed; NumPy is used" in build()
        assert library() is None
    assert not (tmp_path / "kernels.compiled").exists()


@pytest.mark.usefixtures("compiler")
def test_a_library_of_other_sources_is_not_used(tmp_path, monkeypatch):
    with library_at(tmp_path / "kernels.compiled"):
        assert build() == "built kernels.compiled"
        assert library() is not None
        monkeypatch.setattr(kernels, "_of_the_sources", lambda: 0)
        library.cache_clear()
        assert library() is None


@pytest.mark.usefixtures("compiler")
def test_the_sources_compile_without_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "_OPTIONS", (*kernels._OPTIONS, "-Wall", "-Wextra", "-Werror"))
    with library_at(tmp_path / "kernels.compiled"):
        assert build() == "built kernels.compiled"


def test_a_record_has_the_layout_of_a_structure():
    numbers, inner = np.arange(3.0), Record(7)
    record = Record(5, numbers, [inner, None])
    five, place, places = record._memory.tolist()
    assert (five, place) == (5, address(numbers))
    assert record._lists[0].tolist() == [inner.address, 0]
    assert places == address(record._lists[0])


def test_the_program_builds_only_when_it_is_run(monkeypatch, capsys):
    monkeypatch.setattr(kernels, "build", lambda: "built it")
    runpy.run_path(imitarm.compiled.__main__.__file__, run_name="imported")
    assert capsys.readouterr().out == ""
    runpy.run_path(imitarm.compiled.__main__.__file__, run_name="__main__")
    assert capsys.readouterr().out == "built it\n"


def test_an_array_that_is_not_contiguous_has_no_address():
    assert address(np.arange(4.0)[:0]) and address(np.arange(4.0))
    with pytest.raises(ValueError, match="contiguous"):
        address(np.arange(9.0).reshape(3, 3)[:, 1])


def test_the_compiler_options_count_as_sources(monkeypatch):
    before = kernels._of_the_sources()
    monkeypatch.setattr(kernels, "_OPTIONS", (*kernels._OPTIONS, "-O3"))
    assert kernels._of_the_sources() != before


def test_a_record_holds_real_numbers_only_where_they_are_floats():
    assert Record(1.0)._memory.view(np.float64)[0] == 1.0 and Record(1)._memory[0] == 1
