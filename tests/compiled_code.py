"""Run calls with another compiled library, or without one; the fixture ``compiled`` is in conftest.py."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import pytest

from imitarm.compiled import library


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
