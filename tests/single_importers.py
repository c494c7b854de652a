"""List the modules that only one other module imports: each of them may be a fragment of that other one.

``python tests/single_importers.py`` prints the rows of the table "Modules with a single importer, and why" in
docs/architecture.md. Imports by name count, and so do members of a registry, which are written ``"module:attribute"``.
Modules directly in the package are left out. The last line gives two counts: the modules that are separate on purpose
(members of a registry, or exported by their folder), and all others.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
HEADING = "## Modules with a single importer, and why"
ON_PURPOSE = ("member of a registry", "exported by its folder")
"""First words of the reasons of modules that have one importer on purpose."""


def modules(source: Path) -> dict[str, Path]:
    """Return the file of each module below ``source``."""
    found = {}
    for path in sorted(source.rglob("*.py")):
        parts = path.relative_to(source).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported_names(path: Path) -> Iterator[str]:
    """Yield every name with dots that a file may import."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):  # a member of a registry
            module, colon, _ = node.value.partition(":")
            if colon:
                yield module


def single_importers(source: Path = ROOT / "src") -> dict[str, str]:
    """Return the only importer of each module that has just one."""
    files = modules(source)
    importers: defaultdict[str, set[str]] = defaultdict(set)
    for module, path in files.items():
        for name in imported_names(path):
            if name in files and name != module:
                importers[name].add(module)
    return {
        module: next(iter(found))
        for module, found in sorted(importers.items())
        if len(found) == 1 and module.count(".") > 1
    }


def table_rows(page: Path = PAGE) -> dict[str, tuple[str, str]]:
    """Return importer and reason of each module in the table of the page."""
    section = page.read_text(encoding="utf-8").partition(HEADING)[2].partition("\n## ")[0]
    rows = {}
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if len(cells) == 3 and cells[0].startswith("`"):
            rows[cells[0].strip("`")] = (cells[1].strip("`"), cells[2])
    return rows


def fragments(page: Path = PAGE) -> list[str]:
    """Return the modules of the table that are neither members of a registry nor exported by their folder."""
    return [module for module, (_, reason) in table_rows(page).items() if not reason.startswith(ON_PURPOSE)]


def summary(page: Path = PAGE) -> str:
    """Return a sentence with the number of modules in the table of the page, of each of the two kinds."""
    n, others = len(table_rows(page)), len(fragments(page))
    return f"{n} modules: {n - others} are members of a registry or exported by their folder, {others} are not"


def main() -> None:
    """Print a row of the table for every such module, with the reason that the page gives, and the two counts."""
    reasons = {module: reason for module, (_, reason) in table_rows().items()}
    for module, importer in single_importers().items():
        short = (module.removeprefix("imitarm."), importer.removeprefix("imitarm."))
        print(f"| `{short[0]}` | `{short[1]}` | {reasons.get(short[0], 'not given yet')} |")
    print(summary())


if __name__ == "__main__":
    main()
