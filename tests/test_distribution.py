"""What is installed elsewhere contains the sources of the compiled code."""

from __future__ import annotations

import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(path for path in (ROOT / "src/imitarm/compiled").iterdir() if path.suffix in {".c", ".h"})


def test_the_build_takes_every_file_of_the_package():
    """Hatchling leaves out what a setting excludes, and what Git ignores."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert settings["build-system"]["build-backend"] == "hatchling.build"
    assert settings["tool"]["hatch"] == {"build": {"targets": {"wheel": {"packages": ["src/imitarm"]}}}}
    assert {path.suffix for path in SOURCES} == {".c", ".h"}
    words = ["git", "-C", str(ROOT), "check-ignore", *map(str, SOURCES)]
    assert subprocess.run(words, capture_output=True, text=True, check=False).stdout == ""


def test_wheel_and_sdist_contain_the_sources(tmp_path):
    (made,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    (packed,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path))
    with zipfile.ZipFile(made) as archive:
        assert {f"imitarm/compiled/{path.name}" for path in SOURCES} <= set(archive.namelist())
    with tarfile.open(packed) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"src/imitarm/compiled/{path.name}" for path in SOURCES} <= names
    assert not any(name.endswith(".compiled") for name in names)
