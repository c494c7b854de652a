"""Draw sentences from the documentation, the docstrings and the messages, to be read as a newcomer would read them.

``python tests/sample_sentences.py --count 200 --seed 1`` prints each sentence with its place. Left out are code blocks,
formulas, and cells or strings that hold only numbers or code, such as names of tests.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = sorted((ROOT / "src" / "imitarm").rglob("*.py"))
EXAMPLES = sorted((ROOT / "examples").rglob("*.py"))

_BLOCK = re.compile(r"^[ \t]*```.*?^[ \t]*```|^[ \t]*\$\$.*?\$\$[ \t]*$|<!--.*?-->", re.MULTILINE | re.DOTALL)
# a list item, a heading, a table row, a quotation or a picture; in a docstring also a section or an argument
_ITEM = r"\s*(?:[-*]\s|\d+\.\s|#+\s|\||>|!\["
_START = re.compile(_ITEM + ")")
_ARGUMENT = re.compile(_ITEM + r"|[\w*, ().]+:$|\w[\w, *]*(?: \([^)]*\))?: )")
_END = re.compile(r"(?<=[.!?])[\"')*]*\s+(?=[\"'(*`$\[]*[A-Z0-9])")
_BEFORE, _AFTER = 14, 8  # lines that ``--context`` prints before the line of a sentence and after it
_ABBREVIATION = re.compile(r"\b(?:Eq|Eqs|Fig|Figs|e\.g|i\.e|et al|vs|cf|Trans|No|[A-Z])\.$")
_WORD = re.compile(r"(?<![\w\\])[A-Za-z]{2,}(?!\w)")
_REGULAR = re.compile(r"\(\?:|\[\^|\\[wd](?![A-Za-z])|\\\d")  # a string that is a regular expression
_CODE = re.compile(r"``?[^`]*``?|\$[^$]*\$|\S*[_/\\:]\S*\w")


@dataclass(frozen=True)
class Sentence:
    """One sentence and where it stands."""

    place: str
    text: str


def _sentences(paragraph: str) -> Iterator[str]:
    """Split a paragraph at the ends of its sentences."""
    parts: list[str] = []
    for part in _END.split(" ".join(paragraph.split())):
        if parts and _ABBREVIATION.search(parts[-1]):
            parts[-1] += " " + part
        else:
            parts.append(part)
    yield from parts


def _paragraphs(lines: list[str], first: int, begins: re.Pattern[str]) -> Iterator[tuple[int, str]]:
    """Yield (line number, paragraph); a blank line, and a line that ``begins`` matches, start a new one."""
    start, held = first, ""
    for number, line in enumerate([*lines, ""], first):
        if not line.strip() or begins.match(line):
            if held.strip():
                yield start, held
            start, held = number, ""
        held += line + "\n"
    if held.strip():
        yield start, held


def _prose(path: Path) -> Iterator[Sentence]:
    """Yield the sentences of a page; a table row gives one for each cell."""
    text = _BLOCK.sub(lambda match: "\n" * match[0].count("\n"), path.read_text(encoding="utf-8"))
    name = str(path.relative_to(ROOT))
    for line, paragraph in _paragraphs(text.splitlines(), 1, _START):
        row = paragraph.strip().startswith("|")
        cells = re.split(r"(?<!\\)\|", paragraph.strip().strip("|")) if row else [paragraph]
        for cell in cells:
            for sentence in _sentences(cell):
                yield Sentence(f"{name}:{line}", sentence)


def _text(node: ast.AST) -> str | None:
    """Return the text of a string or an f-string, with each inserted value written as ``{}``."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return None


def _docstring(node: ast.AST) -> ast.Constant | None:
    """Return the constant that holds a docstring, also that of a variable."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return node.value
    if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
        first = node.body[0]
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            return first.value
    return None


def _public(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a module and everything in it that is public: no name that begins with one underscore, nothing local."""
    yield node
    if isinstance(node, ast.Module | ast.ClassDef):
        for inner in node.body:
            name = getattr(inner, "name", "")
            if not name.startswith("_") or name.startswith("__"):
                yield from _public(inner)


def _code(path: Path, *, public: bool) -> Iterator[Sentence]:
    """Yield the sentences of a module's docstrings (or only of the public ones) and messages."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    name = str(path.relative_to(ROOT))
    docstrings = {id(held): held for node in ast.walk(tree) if (held := _docstring(node))}
    shown = {id(held) for node in _public(tree) if (held := _docstring(node))} if public else docstrings.keys()
    for held in (docstrings[key] for key in docstrings if key in shown):
        plain = _BLOCK.sub(lambda match: "\n" * match[0].count("\n"), str(held.value))
        for line, paragraph in _paragraphs(plain.splitlines(), held.lineno, _ARGUMENT):
            if not paragraph.lstrip().startswith((">>>", "...")):
                for sentence in _sentences(paragraph):
                    yield Sentence(f"{name}:{line}", sentence)
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if id(node) not in docstrings and id(node) not in inner and (text := _text(node)) and not _REGULAR.search(text):
            for paragraph in text.split("\n"):
                for sentence in _sentences(paragraph):
                    yield Sentence(f"{name}:{getattr(node, 'lineno', 0)} (message)", sentence)


def sentences(*, public: bool = False) -> list[Sentence]:
    """Return every sentence with at least four words that are not code, each text once.

    Args:
        public: whether to leave out the docstrings of private functions, classes and methods.
    """
    found = [sentence for path in PAGES for sentence in _prose(path)]
    found += [sentence for path in [*SOURCES, *EXAMPLES] for sentence in _code(path, public=public)]
    once = {sentence.text: sentence for sentence in found if len(_WORD.findall(_CODE.sub(" ", sentence.text))) >= 4}
    return list(once.values())


def _around(sentence: Sentence) -> list[str]:
    """Return the lines of the file in which a reader meets a sentence: some lines before it and after it."""
    name, _, place = sentence.place.partition(":")
    line = int(place.split()[0])
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    return lines[max(line - 1 - _BEFORE, 0) : line + _AFTER]


def main() -> None:
    """Print the sentences that were drawn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, metavar="N", help="number of sentences (default 200)")
    parser.add_argument("--context", action="store_true", help="also print the lines around each sentence")
    parser.add_argument("--public", action="store_true", help="leave out the docstrings of private functions")
    parser.add_argument("--seed", type=int, default=1, metavar="SEED", help="seed of the draw (default 1)")
    arguments = parser.parse_args()
    everything = sentences(public=arguments.public)
    drawn = random.Random(arguments.seed).sample(everything, min(arguments.count, len(everything)))
    for number, sentence in enumerate(drawn, 1):
        print(f"{number:3d}  {sentence.place}\n     {sentence.text}")
        if arguments.context:
            print(*(f"     | {line}" for line in _around(sentence)), sep="\n")
    print(f"{len(drawn)} of {len(everything)} sentences, seed {arguments.seed}")


if __name__ == "__main__":
    main()
