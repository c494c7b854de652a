"""A family's members, built in and added by installed packages."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from imitarm.errors import InputError, UnknownNameError
from imitarm.registry import Registry


def install(folder: Path, group: str, **places: str) -> None:
    """Write what pip would write for a package that has entry points."""
    info = folder / "theirs-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n", encoding="utf-8")
    lines = [f"[{group}]"] + [f"{name} = {place}" for name, place in places.items()]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def shapes() -> Registry[object]:
    return Registry("shape", "imitarm.test_shapes", {"decoder": "json:JSONDecoder"})


def test_members_are_imported_when_asked_for():
    import json  # noqa: PLC0415

    assert list(shapes()) == ["decoder"] and len(shapes()) == 1 and "decoder" in shapes()
    assert shapes()["decoder"] is json.JSONDecoder
    with pytest.raises(UnknownNameError, match="unknown shape 'ball'; known: decoder"):
        shapes()["ball"]


def test_an_installed_package_adds_members_and_replaces_none(tmp_path, monkeypatch):
    (tmp_path / "their_module.py").write_text("class Mine:\n    pass\n", encoding="utf-8")
    install(tmp_path, "imitarm.test_shapes", mine="their_module:Mine", decoder="their_module:Mine", broken="no_such:X")
    monkeypatch.syspath_prepend(str(tmp_path))
    registry = shapes()
    assert list(registry) == ["decoder", "broken", "mine"]
    assert registry["mine"] is sys.modules["their_module"].Mine
    assert registry["decoder"] is not registry["mine"]
    with pytest.raises(InputError, match=r"shape 'broken' is added by the entry point 'no_such:X'.*uninstall"):
        registry["broken"]
