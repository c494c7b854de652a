"""``make quick``: the tests that a change touches, the nearest first, for at most a minute.

    python tests/quick.py [--against COMMIT] [--seconds 45] [--list]

Changed files are those that differ from ``--against``: by default from where this branch left ``main``; on ``main``
itself from the last commit. A test is the nearer to a change the fewer imports lie between: a test file that has
changed, a test that imports a changed module, a test that imports a module that imports one, and so on. Tests marked
``slow`` are left out, and what does not fit into the time is counted and named. If C code has changed, it is compiled
before the tests.
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

import pytest

from imitarm.compiled import build

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src", "tests", "benchmarks")
PAGES = {"docs": "tests/test_docs.py", "README.md": "tests/test_docs.py", "examples": "tests/test_examples.py"}
"""What reads files that nothing imports."""
_REGISTERED = re.compile(r"imitarm(\.\w+)+:\w+")  # a member of a registry


def module_of(path: Path, root: Path = ROOT) -> str:
    """Return the module that a Python file is, as it is imported."""
    parts = path.relative_to(root).with_suffix("").parts[1:]  # without src, tests or benchmarks
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@lru_cache
def public_names(root: Path = ROOT) -> dict[str, str]:
    """Return where the public names of ``imitarm`` are from: ``{"ArmModel": "imitarm.kinematics.arm"}``."""
    stub, found = root / "src" / "imitarm" / "__init__.pyi", {}
    if stub.exists():
        for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                found |= {alias.name: f"imitarm.{node.module}" for alias in node.names}
    return found


def imports(path: Path, root: Path = ROOT) -> Iterator[str]:
    """Give the names that a file imports: modules, and what may be one."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
                if node.module == "imitarm":
                    yield public_names(root).get(alias.name, "imitarm")
                else:
                    yield node.module
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "imitarm":
            yield public_names(root).get(node.attr, f"imitarm.{node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _REGISTERED.fullmatch(node.value):
            yield node.value.partition(":")[0]


@lru_cache
def users_of(root: Path = ROOT) -> dict[Path, set[Path]]:
    """Return for each Python file of a checkout the files that import it."""
    files = [path for folder in FOLDERS for path in (root / folder).rglob("*.py")]
    modules = {module_of(path, root): path for path in files}
    users: dict[Path, set[Path]] = {path: set() for path in files}
    for path in files:
        for name in imports(path, root):
            if name in modules and modules[name] != path:
                users[modules[name]].add(path)
        if path.name == "__init__.py" and "import_module(" in path.read_text(encoding="utf-8"):
            for other in path.parent.glob("*.py"):  # a package that loads its modules by name
                users[other].add(path)
    return users


def distances(changed: Iterable[Path], root: Path = ROOT) -> dict[Path, int]:
    """Return the test files that depend on changed files, with the number of imports between.

    Args:
        changed: files; those that are not Python stand for the package they are in.
        root: of the checkout.
    """
    users = users_of(root)
    found: dict[Path, int] = {}
    border = [one for path in changed for one in _standing_for(path, users, root)]
    distance = 0
    while border:
        found |= dict.fromkeys(border, distance)
        distance += 1
        border = sorted({user for path in border for user in users[path]} - found.keys())
    return {path: n for path, n in found.items() if path.name.startswith("test_")}


def _standing_for(path: Path, users: dict[Path, set[Path]], root: Path) -> list[Path]:
    """Return the files of the graph that a changed file is or belongs to."""
    reader = PAGES.get(path.relative_to(root).parts[0])
    if reader is not None:
        return [root / reader]
    if path in users:
        return [path]
    if path.name == "conftest.py" or path.suffix == ".pyi":
        return []
    folder = next((parent for parent in path.parents if parent / "__init__.py" in users), None)
    return [] if folder is None else [one for one in users if one.parent == folder]


def changed_files(against: str | None) -> list[Path]:
    """Return the files that differ from a commit, and those that Git does not know yet."""
    if against is None:
        base = _git("merge-base", "HEAD", "main") or "HEAD"
        same = base == _git("rev-parse", "HEAD")
        against = base if not same or _git("status", "--porcelain") else "HEAD~1"
    names = _git("diff", "--name-only", "--diff-filter=d", against, "--").split("\n")
    names += _git("ls-files", "--others", "--exclude-standard").split("\n")
    return [ROOT / name for name in names if name]


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=False)
    return done.stdout.strip()


class Nearest:
    """A pytest plugin: sorts tests by distance, and stops when the time is over."""

    def __init__(self, near: dict[Path, int], seconds: float) -> None:
        self.near, self.until, self.left = near, time.monotonic() + seconds, 0
        self.failed = self.stopped = False

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Run the nearest tests first, in the order of their files."""
        items.sort(key=lambda item: self.near[item.path])

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Count what is left after others, such as the option ``-m``, have taken tests out."""
        self.left = len(session.items)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember failures: a run that is stopped has a status of its own."""
        self.failed |= report.failed

    def pytest_runtest_logfinish(self) -> None:
        """Count."""
        self.left -= 1

    def pytest_runtest_teardown(self, item: pytest.Item) -> None:
        """Stop after this test when the time is over."""
        if time.monotonic() > self.until and self.left > 1:
            self.stopped = True
            item.session.shouldstop = "the time is over"

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say how many tests were left out."""
        if self.left:
            terminalreporter.write_line(f"{self.left} tests that are farther away were not run: make test runs all")


def main() -> int:
    """Run the tests and return pytest's exit status; 0 when nothing depends on what has changed."""
    parser = argparse.ArgumentParser(description="the tests that a change touches")
    parser.add_argument("--against", metavar="COMMIT", help="default: where this branch left main")
    parser.add_argument("--seconds", type=float, default=45.0, help="stop after so many; default: 45")
    parser.add_argument("--list", action="store_true", help="print the test files with their distances, and stop")
    arguments = parser.parse_args()
    changed = changed_files(arguments.against)
    near = distances(changed)
    files = sorted(near, key=lambda path: (near[path], path))
    if arguments.list:
        sys.stdout.write("".join(f"{near[path]} {path.relative_to(ROOT)}\n" for path in files))
        return 0
    if not files:
        sys.stdout.write("no test depends on what has changed\n")
        return 0
    if any(path.suffix in {".c", ".h"} for path in changed):  # a library of other sources is not used
        sys.stdout.write(f"{build()}\n")
    words = ["-q", "-m", "not slow", "--rootdir", str(ROOT), *(str(path) for path in files)]
    nearest = Nearest(near, arguments.seconds)
    status = pytest.main(words, plugins=[nearest])
    stopped = (
        status == pytest.ExitCode.INTERRUPTED and nearest.stopped
    ) or status == pytest.ExitCode.NO_TESTS_COLLECTED
    return int(nearest.failed) if stopped else int(status)


if __name__ == "__main__":
    sys.exit(main())
