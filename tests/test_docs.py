"""What the documentation says exists: links, commands, names, tests; and every public thing says what it is."""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest

import imitarm
from imitarm import cli
from imitarm.demonstrations.reading import READERS
from imitarm.policies import ADAPTERS, POLICIES
from imitarm.retarget import RETARGETERS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").rglob("*.py")) + sorted((ROOT / "examples").rglob("*.yaml"))
SOURCES = sorted((ROOT / "src" / "imitarm").rglob("*.py"))

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
each_source = pytest.mark.parametrize("source", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "src")))

_FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)[^)]*\)")
_DOTTED = re.compile(r"`(imitarm(?:\.\w+)+)`")
_TEST = re.compile(r"`(tests/\w+\.py)::(\w+)`")
# where this or any other machine keeps things: no reader has them
_MACHINE_PATH = re.compile(r"(?<![\w.])/(?:home|root|work|opt|mnt|Users|tmp)/\w|[A-Z]:\\\\")


def prose(page: Path) -> str:
    """The page without its code blocks."""
    return _FENCE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """The anchors that a page's headings get, as code hosts make them."""
    headings = re.findall(r"^#+\s+(.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@each_page
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in _LINK.findall(prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = unquote(target).partition("#")
        goal = (page.parent / path).resolve() if path else page
        assert goal.exists(), f"{page.name} links to {target}, which is not there"
        assert goal.is_relative_to(ROOT), f"{page.name} links to {target}, outside the project"
        if anchor and goal.suffix == ".md":
            assert anchor in anchors(goal), f"{page.name} links to {target}; {goal.name} has no such heading"


def commands(page: Path) -> Iterator[list[str]]:
    """Every ``imitarm ...`` command in the page's code blocks, split as a shell does."""
    for language, block in _FENCE.findall(page.read_text(encoding="utf-8")):
        if language not in {"", "sh", "bash", "shell", "console", "text"}:
            continue
        for line in block.replace("\\\n", " ").splitlines():
            text = re.sub(r"^\$\s+", "", line.strip())
            text = re.sub(r"^(?:\w+=\S*\s+)*(?:\S*/bin/)?(?=imitarm\s)", "", text)
            if text.startswith("imitarm ") and not text.startswith("imitarm: "):
                words = shlex.split(re.split(r"\s(?:[|>;]|&&)\s?", text)[0], comments=True)
                yield words[1:]


def parsed(words: list[str]) -> argparse.Namespace:
    """Parse a command without running it."""
    return cli._parser(words).parse_args(words)


@each_page
def test_every_command_is_one(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in commands(page):
        try:
            arguments = parsed(words)
        except SystemExit as stop:
            assert stop.code == 0, f"{page.name}: 'imitarm {shlex.join(words)}': {capsys.readouterr().err}"
        else:
            assert callable(arguments.run)


def test_commands_are_found_and_wrong_ones_too(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```sh\n$ imitarm lint a.csv --units cm | less\nimitarm learn a.csv \\\n  --no-such\n```\n")
    first, second = commands(page)
    assert first == ["lint", "a.csv", "--units", "cm"]
    assert parsed(first).units == "cm"
    with pytest.raises(SystemExit):
        parsed(second)


@each_page
def test_every_block_of_python_is_python_and_imports_what_exists(page: Path) -> None:
    for language, block in _FENCE.findall(page.read_text(encoding="utf-8")):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(block, filename=page.name)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "imitarm":
                for alias in node.names:
                    assert resolved(f"{node.module}.{alias.name}") is not None, f"{page.name}: {ast.unparse(node)}"


ENTRY_POINT_GROUPS = {registry.group for registry in (ADAPTERS, POLICIES, READERS, RETARGETERS, imitarm.SOURCES)}


@each_page
def test_every_name_with_dots_exists(page: Path) -> None:
    for name in _DOTTED.findall(page.read_text(encoding="utf-8")):
        if not name.endswith(".py") and name not in ENTRY_POINT_GROUPS:
            assert resolved(name) is not None, f"{page.name} names {name}, which does not exist"


def resolved(name: str) -> object | None:
    """The module, class, function or attribute of that full name; None when there is none."""
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            thing: object = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        for i, part in enumerate(parts[n:]):
            if not hasattr(thing, part):
                last = i == len(parts[n:]) - 1
                return part if last and part in getattr(thing, "__annotations__", {}) else None
            thing = getattr(thing, part)
        return thing
    return None


def test_names_that_do_not_exist_are_noticed() -> None:
    assert resolved("imitarm.skills.gmr.GMR.predict") is not None
    assert resolved("imitarm.skills.gmr.GMR.time_means_") is not None
    assert resolved("imitarm.policies.adapted_path.Adaptation.certified_clearance") is not None
    for wrong in ("imitarm.skills.gmr.GMR.predicted", "imitarm.skills.gmx", "imitarm.skills.gmr.GMR.predict.x"):
        assert resolved(wrong) is None


def names_of_tests(path: Path) -> set[str]:
    """The test functions in a file, and the test methods of its test classes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.startswith("Test")]
    nodes = [*tree.body, *(node for owner in classes for node in owner.body)]
    return {node.name for node in nodes if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


@each_page
def test_every_test_that_is_named_exists(page: Path) -> None:
    for path, name in _TEST.findall(page.read_text(encoding="utf-8")):
        assert (ROOT / path).is_file(), f"{page.name} names {path}"
        assert name in names_of_tests(ROOT / path), f"{page.name} names {path}::{name}"


def test_the_thesis_map_names_a_function_and_a_test_for_each_equation() -> None:
    """Every row that is not planned for a later version has both, and all equations of the three parts are there."""
    lines = re.findall(r"^\| (.*) \|$", page_text("thesis_map.md"), re.MULTILINE)
    rows = [[cell.strip() for cell in line.split("|")] for line in lines]
    rows = [row for row in rows if len(row) == 5 and not row[0].startswith(("-", "equation", "place"))]
    covered: set[str] = set()
    for equation, _, reading, function, shown in rows:
        numbers = re.findall(r"(\d)\.(\d+)", equation)
        if " to " in equation and len(numbers) == 2:
            (chapter, first), (_, last) = numbers
            covered |= {f"{chapter}.{i}" for i in range(int(first), int(last) + 1)}
        else:
            covered |= {".".join(number) for number in numbers}
        later = "later version" in reading
        assert later or (_DOTTED.search(function) and _TEST.search(shown)), f"{equation}: no function or no test"
    wanted = {f"2.{i}" for i in range(1, 23)} | {f"3.{i}" for i in range(1, 10)} | {f"4.{i}" for i in range(1, 10)}
    assert wanted <= covered, f"missing: {sorted(wanted - covered)}"


def page_text(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("path", [*PAGES, *EXAMPLES], ids=lambda path: path.name)
def test_nothing_to_be_read_names_a_place_on_a_machine(path: Path) -> None:
    found = _MACHINE_PATH.search(path.read_text(encoding="utf-8"))
    assert found is None, f"{path.name}: {found}"


def test_every_page_can_be_reached() -> None:
    text = page_text("architecture.md") + (ROOT / "README.md").read_text(encoding="utf-8")
    linked = {Path(target.partition("#")[0]).name for target in _LINK.findall(text)}
    pages = {page.name for page in PAGES} - {"README.md", "architecture.md"}
    assert pages <= linked, f"neither README.md nor docs/architecture.md links to {sorted(pages - linked)}"


@pytest.mark.parametrize("name", imitarm.__all__)
def test_every_public_name_exists_and_says_what_it_is(name: str) -> None:
    thing = getattr(imitarm, name)
    assert callable(thing) or not isinstance(thing, ModuleType), f"imitarm.{name} is the module of that name"
    if inspect.isclass(thing) or inspect.isroutine(thing):
        assert (thing.__doc__ or "").strip(), f"imitarm.{name} has no docstring"


@each_source
def test_every_public_definition_has_a_docstring(source: Path) -> None:
    """Without a place on any machine in it; nor has anything else in the file one."""
    text = source.read_text(encoding="utf-8")
    assert _MACHINE_PATH.search(text) is None, f"{source}: {_MACHINE_PATH.search(text)}"
    tree = ast.parse(text)
    assert ast.get_docstring(tree), f"{source} says not what it is"
    for owner, node in definitions(tree):
        assert ast.get_docstring(node), f"{source}:{node.lineno} {owner}{node.name}"


def definitions(
    tree: ast.Module | ast.ClassDef, owner: str = ""
) -> Iterator[tuple[str, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Public classes and functions of a module, and public methods of its public classes."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            yield owner, node
            if isinstance(node, ast.ClassDef):
                yield from definitions(node, f"{owner}{node.name}.")
