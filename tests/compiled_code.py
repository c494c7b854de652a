"""Tests compare compiled code, built once for a module of tests, with NumPy."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from imitarm.compiled import build, library


@pytest.fixture(scope="module")
def compiler():
    """Require a C compiler; without one, the test is skipped, but in CI it fails."""
    if not any(shutil.which(name) for name in ("cc", "gcc", "clang")):
        if os.environ.get("CI") == "true":
            pytest.fail("no C compiler; in CI the compiled code must be tested")
        pytest.skip("no C compiler")


@pytest.fixture(scope="module")
def compiled(compiler, tmp_path_factory):
    """Use compiled code that was built for these tests."""
    with library_at(tmp_path_factory.mktemp("kernels") / "kernels.compiled"):
        assert build() == "built kernels.compiled"
        assert library() is not None
        yield


@contextmanager
def library_at(path: Path):
    """Load the library from another file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("imitarm.compiled.kernels.LIBRARY", path)
        library.cache_clear()
        yield
    library.cache_clear()


def by_numpy(call, *arguments, **options):
    """Return the result of a call without compiled code."""
    with library_at(Path("missing")):
        return call(*arguments, **options)
