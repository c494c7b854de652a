"""What all tests share."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from compiled_code import library_at
from imitarm.compiled import kernels

# the same examples in every run, and no clock: a loaded machine fails nothing
settings.register_profile("imitarm", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("imitarm")

# pytest-xdist sets it for its workers: what commands print would be broken at 80 columns, theirs and their children's
os.environ.pop("COLUMNS", None)


@pytest.fixture(scope="module")
def compiler():
    """Require a C compiler; without one, the test is skipped, but in CI it fails."""
    if not any(shutil.which(name) for name in kernels._COMPILERS):
        if os.environ.get("CI") == "true":
            pytest.fail("no C compiler; in CI the compiled code must be tested")
        pytest.skip("no C compiler")


@pytest.fixture(scope="module")
def compiled(compiler, tmp_path_factory):
    """Use compiled code that was built for these tests."""
    with library_at(tmp_path_factory.mktemp("kernels") / "kernels.compiled"):
        assert kernels.build() == "built kernels.compiled"
        assert kernels.library() is not None
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse names with an address in memory: they differ between processes, and pytest-xdist then runs nothing."""
    for item in items:
        if " at 0x" in item.nodeid:
            raise pytest.UsageError(f"{item.nodeid}: this name is another one in every process; give the values ids")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--cpu-times``."""
    parser.addoption(
        "--cpu-times", type=int, default=0, metavar="N", help="at the end print the N tests that take most CPU time"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Measure where it is asked for; in each worker of pytest-xdist too."""
    if config.getoption("--cpu-times"):
        config.pluginmanager.register(CpuTimes(config.getoption("--cpu-times")))


class CpuTimes:
    """A pytest plugin that measures the CPU time (s) of each test, including its fixtures and its child processes.

    CPU time hardly depends on what else the machine does. What several tests share, such as a session fixture or the
    first import of a library, counts for the first test that needs it.
    """

    PROPERTY = "CPU time"

    def __init__(self, count: int) -> None:
        self.count, self.mark = count, 0.0
        self.seconds: Counter[str] = Counter()

    def spent(self) -> float:
        """Return the CPU time (s) since it was last asked for: of this process and of its children that ended."""
        times = os.times()
        now = time.process_time() + times.children_user + times.children_system
        self.mark, before = now, self.mark
        return now - before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Iterator[None]:
        """Add the CPU time of set-up, call and tear-down to their reports; workers of pytest-xdist send them."""
        report = yield
        report.user_properties.append((self.PROPERTY, self.spent()))
        return report

    def pytest_collection_finish(self) -> None:
        """Leave out the time before the first test."""
        self.spent()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add up the reports of each test."""
        self.seconds[report.nodeid] += dict(report.user_properties)[self.PROPERTY]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the tests that take most, and the sum of all."""
        terminalreporter.section(f"CPU time: {self.seconds.total():.1f} s in {len(self.seconds)} tests")
        for name, seconds in self.seconds.most_common(self.count):
            terminalreporter.write_line(f"{seconds:8.2f} s  {name}")


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
