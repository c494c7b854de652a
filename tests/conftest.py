"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# the same examples in every run, and no clock: a loaded machine fails nothing
settings.register_profile("imitarm", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("imitarm")

# pytest-xdist sets it for its workers: what commands print would be broken at 80 columns, theirs and their children's
os.environ.pop("COLUMNS", None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse names with an address in memory: they differ between processes, and pytest-xdist then runs nothing."""
    for item in items:
        if " at 0x" in item.nodeid:
            raise pytest.UsageError(f"{item.nodeid}: this name is another one in every process; give the values ids")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings: IMITARM_DATA, else ../shared/data beside the checkout.

    Where CI=true their absence is a failure, elsewhere the test is skipped.
    """
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("IMITARM_DATA") or beside)
    if not (root / "panda_kinesthetic" / "pouring.npy").is_file():
        message = f"no real recordings in {root}; set IMITARM_DATA to their folder"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return root
