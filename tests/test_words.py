"""The words of this project are those of robotics: no house words in texts, names, pages and --help."""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from imitarm import cli
from sample_sentences import PAGES, ROOT, sentences

CODE = sorted(path for folder in ("src/imitarm", "examples", "benchmarks") for path in (ROOT / folder).rglob("*.py"))
CODE.append(ROOT / "src/imitarm/__init__.pyi")
TEMPLATES = sorted(path for kind in ("*.html", "*.js") for path in (ROOT / "src/imitarm").rglob(kind))
TEXTS = [*PAGES, *sorted((ROOT / "examples").rglob("*.yaml")), *TEMPLATES]

# pattern, at the beginning of a word -> what to write
HOUSE_WORDS = {
    r"made[- ]up\b(?! for)": "synthetic, simulated",
    r"rivals?\b": "baseline",
    r"learnt\b": "learned",
    r"mend(?:s|ed|ing)?\b": "fix, repair",
    r"asked[_ ]clearance|clearance (?:that was )?asked": "required clearance",
    r"(?:was|were|is|are|one) asked for\b": "required, requested, commanded",
    r"(?<!anyone )who wants?\b": "anyone who wants",
    r"judg(?:e|es|ed|ing)\b": "evaluate",
    r"(?:is|are|was|were|been) told\b(?! to\b)|told apart\b": "reported, distinguished",
    r"(?:at|in|every|each|that|this|the|one|a) moments?\b(?! of inertia)": "time, instant",
    r"turn[_-]length|(?:a|the|one|each|its) turn (?:of|by|about)\b|(?:rate|speed|size) of turn\b": "rotation",
    r"(?:half|full|quarter|whole)(?: a)? turns?\b": "180 degrees, full rotation",
    r"the way (?:that|it is done)\b|(?:other |wrong )?ways? round\b|no way\b|on the way\b": "path, direction, during",
    r"shares? of\b": "fraction",
    r"(?-i:METHODS) [A-Z]\.\d|of (?-i:METHODS)\b|working notes\b": "the equation, paper or docs page",
    r"(?<!teacher's )advice\b(?! operator)|lessons?\b": "hint, finding",
    r"what there is\b": "name it",
    r"for the price of\b": "at the cost of",
    r"tells? of\b": "report",
    r"does it whole\b": "completely",
    r"came of (?:it|one|a)\b": "result",
    r"(?:whence|thereof|therein|hitherto|lest)\b": "a plain word",
    r"anew\b": "again",
    r"(?:is|are) ours\b": "we chose",
    r"our reading\b": "our interpretation",
    r"own frames?\b": "local frame",
    r"made discrete\b": "in discrete form",
    r"None: none\b": "None: no obstacles, no tool, ...",
    r"blanks\b": "spaces",
    r"(?:is|are) not said\b": "not stated",
    r"present (?:pose|poses|scene|obstacles|phase|observation)\b": "current",
    r"(?:quarternion|jacobean|covarience|gausian|accelaration|trajectorys|demostration|effecter)": "its spelling",
}
TEXT = re.compile("|".join(rf"(?P<g{i}>\b(?:{pattern}))" for i, pattern in enumerate(HOUSE_WORDS)), re.IGNORECASE)
REMEDY = dict(enumerate(HOUSE_WORDS.values()))

# words that no name may contain, in CamelCase or between underscores; and those that no class or module may be called
_NAMES = "merit tally quickest dips advice lesson lessons rival rivals learnt mend mended judge judged told"
_CLASSES = "trial sight moment moments gate pace course"
HOUSE_NAMES = set(_NAMES.split())
HOUSE_CLASSES = HOUSE_NAMES | set(_CLASSES.split())
PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of every comment and string of a module."""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type in {tokenize.COMMENT, tokenize.STRING} or tokenize.tok_name[token.type] == "FSTRING_MIDDLE":
            yield token.start[0], token.string


def house_names(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, name) of modules, classes, functions, arguments, variables and attributes that can't be guessed."""
    found = [(1, path.stem, HOUSE_CLASSES - {"trial"})]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef):
            found.append((node.lineno, node.name, HOUSE_CLASSES))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found.append((node.lineno, node.name, HOUSE_NAMES))
        elif isinstance(node, ast.arg):
            found.append((node.lineno, node.arg, HOUSE_NAMES))
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.append((node.lineno, node.id, HOUSE_NAMES))
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.append((node.lineno, node.attr, HOUSE_NAMES))
    for line, name, words in found:
        if not words.isdisjoint(part.lower() for part in PARTS.findall(name)):
            yield line, name


# an argument or attribute in a docstring that is described without a noun: "seed: of the samples"
NO_NOUN = re.compile(r"^ +(\w+): of (?!each of)", re.MULTILINE)


def faults(text: str) -> list[str]:
    """Return the house words in a text, each with what to write instead."""
    found = []
    for match in TEXT.finditer(" ".join(text.split())):
        number = next(i for i in REMEDY if match[f"g{i}"])
        found.append(f"{match[0]!r} (write: {REMEDY[number]})")
    return found


def place(path: Path) -> str:
    """Return a path as it is written in messages."""
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", TEXTS, ids=place)
def test_pages_use_the_words_of_the_field(path: Path) -> None:
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", CODE, ids=place)
def test_docstrings_comments_and_messages_use_the_words_of_the_field(path: Path) -> None:
    found = [f"{place(path)}:{line}: {fault}" for line, text in texts(path) for fault in faults(text)]
    assert found == []


@pytest.mark.parametrize("path", CODE, ids=place)
def test_arguments_are_described_by_a_noun(path: Path) -> None:
    found = [
        (node, ast.get_docstring(node))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert [match[1] for _, text in found for match in NO_NOUN.finditer(text or "")] == []


@pytest.mark.parametrize("path", CODE, ids=place)
def test_names_can_be_guessed(path: Path) -> None:
    assert [f"{place(path)}:{line}: {name}" for line, name in house_names(path)] == []


def helps() -> Iterator[tuple[str, str]]:
    """Yield (command, its --help) for the command line and every command of it."""
    yield "imitarm", cli._parser([]).format_help()
    for command in cli.COMMANDS:
        actions = cli._parser([command])._actions
        action = next(action for action in actions if isinstance(action, argparse._SubParsersAction))
        yield command, action.choices[command].format_help()


def test_the_help_of_every_command_uses_the_words_of_the_field() -> None:
    assert {command: found for command, text in helps() if (found := faults(text))} == {}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("a made-up person with a learnt skill", 2),
        ("the moment of inertia, and the learned skill", 0),
        ("thesis Eq 3.1, see METHODS D.2.5", 1),
        ("the share of samples that was judged", 2),
        ("our reading of the law, made discrete; the gains are ours", 3),
        ("the arm is told to stop, then each of them turns", 0),
    ],
)
def test_a_house_word_is_found(text: str, count: int) -> None:
    assert len(faults(text)) == count


def test_sentences_are_drawn_from_pages_docstrings_and_messages() -> None:
    drawn = sentences()
    kinds = [sentence.place for sentence in drawn]
    assert any(kind.startswith("docs/") for kind in kinds)
    assert any(kind.endswith("(message)") for kind in kinds)
    assert any(kind.startswith("src/") and not kind.endswith("(message)") for kind in kinds)
    assert len({sentence.text for sentence in drawn}) == len(drawn) > 1000
