"""Fingerprints of code: which files decide a result, and whether they still do what they did when it was made."""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import imitarm

_PACKAGE = Path(imitarm.__file__).parent
_DATA = ("robots/models",)  # what the code reads besides itself
_RUNS, _TABLES = "imitarm.benchmark.experiment", "imitarm.benchmark.mapping"


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return a fingerprint of all files that decide the result of an experiment; with the same one it is kept."""
    return _version(_RUNS)


@lru_cache(maxsize=1)
def tables_version() -> str:
    """Return a fingerprint of all files that decide what the tables say: those of results, and statistics and texts."""
    return _version(_TABLES)


def deciding_files(module: str) -> list[Path]:
    """Return the files that a module does its work with: itself, what it imports, what that imports, and data.

    Found from the ``import`` statements, those in functions included. What a package's own ``__init__.py`` imports
    counts only where a name is taken from the package: a module beside those that are used decides nothing.

    Args:
        module: its full name, in this package.
    """
    found: set[Path] = set()
    todo = [module]
    while todo:
        path = _file(todo.pop())
        if path is not None and path not in found:
            found.add(path)
            todo += _imports(path)
    data = [path for folder in _DATA for path in (_PACKAGE / folder).rglob("*.xml")]
    return sorted([*found, *data])


def essence(source: str) -> str:
    """Return what a Python source does, not what it says of it: without comments, docstrings and empty lines."""
    lines = source.split("\n")
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            for row in range(node.lineno, (node.end_lineno or node.lineno) + 1):
                lines[row - 1] = ""
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _version(module: str) -> str:
    digest = hashlib.sha256()
    for path in deciding_files(module):
        text = path.read_text(encoding="utf-8")  # line ends as here, whatever the checkout has
        said = essence(text) if path.suffix == ".py" else text
        digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\0{said}\0".encode())
    return f"{imitarm.__version__}+{digest.hexdigest()[:12]}"


def _file(module: str) -> Path | None:
    """Return the file of a module; None when it is none, or the package itself, which only lists names."""
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    candidates = (place.with_suffix(".py"), place / "__init__.py") if place != _PACKAGE else ()
    return next((path for path in candidates if path.is_file()), None)


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "imitarm")
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "imitarm":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if _file(inner) is not None else str(node.module)
