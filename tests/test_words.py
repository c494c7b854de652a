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
from sample_sentences import PAGES, ROOT, sentences

from imitarm import cli

CODE = sorted(
    path
    for folder in ("src/imitarm", "examples", "benchmarks")
    for path in (ROOT / folder).rglob("*.py*")
    if path.suffix in {".py", ".pyi"}
)
EXAMPLES = sorted(path for path in (ROOT / "examples").rglob("*.yaml"))

# pattern in a text -> what to write
HOUSE_WORDS = {
    r"made[- ]up\b": "synthetic, simulated",
    r"rivals?\b": "baseline",
    r"learnt\b": "learned",
    r"mend(?:s|ed|ing)?\b": "fix, repair",
    r"asked[_ ]clearance|clearance (?:that was )?asked": "required clearance",
    r"(?:was|were|is|are|one) asked for\b": "required, requested, commanded",
    r"who wants?\b(?<!anyone who wants)": "anyone who wants",
    r"judg(?:e|es|ed|ing)\b": "evaluate",
    r"(?:is|are|was|were|been) told\b(?! to\b)|told apart\b": "reported, distinguished",
    r"moments?\b(?! of (?:inertia|the mixture|a Gaussian))": "time, instant",
    r"turn[_-]length|(?:a|the|one|each|its) turn (?:of|by|about)\b|(?:rate|speed|size) of turn\b": "rotation",
    r"(?:half|full|quarter|whole) a? ?turns?\b": "half a rotation, 180 degrees",
    r"the way (?:that|it is done)\b|way round\b|no way\b|(?:wrong|other) ways? round\b|on the way\b": "path, direction, meanwhile",
    r"shares? of\b": "fraction",
    r"(?-i:METHODS)(?: [A-Z]\.\d|\b[^:]{0,3}\d)|of (?-i:METHODS)\b|working notes\b": "the thesis equation, the paper or the page in docs/",
    r"advice\b(?<!teacher's advice)(?! operator)|lessons?\b": "hint, finding",
    r"what there is\b": "name it",
    r"for the price of\b": "at the cost of",
    r"[Tt]ells? of\b": "report",
    r"does it whole\b": "completely",
    r"came of (?:it|one|a)\b": "result",
    r"begotten|whence|thereof|therein|hitherto|lest\b|save for\b": "plain words",
    r"of use\b|of no use\b": "useful, useless",
    r"end[- ]effecter|manipulater|singularit[iy]e\b|jacobean|quarternions?|kinematik\w*|gausian|euklid\w*|covarience": "spelling",
    r"trajector(?:ys|ie\b)|demostrations?|retargetting|teleoperati?ng\b(?<!teleoperating)|accelaration|inertias?l\b(?<!inertial)": "spelling",
}
TEXT = re.compile("|".join(rf"(?P<g{i}>\b(?:{pattern}))" for i, pattern in enumerate(HOUSE_WORDS)), re.IGNORECASE)
REMEDY = dict(enumerate(HOUSE_WORDS.values()))

# a name that a stranger could not guess -> words in it, in CamelCase or between underscores
HOUSE_NAMES = {
    "merit", "sight", "moment", "moments", "tally", "gate", "quickest", "pace", "course", "dips", "advice", "lesson", "lessons",
    "rival", "rivals", "learnt", "mend", "mended", "judge", "judged", "told",
}  # fmt: skip
PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")

# folders that are being rewritten now; empty when they have landed
PENDING: tuple[str, ...] = ()


def pending(place: str) -> bool:
    """Whether another change owns this file for the time being."""
    return place.startswith(PENDING) if PENDING else False


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of every comment and string of a module."""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type in {tokenize.COMMENT, tokenize.STRING} or tokenize.tok_name[token.type] == "FSTRING_MIDDLE":
            yield token.start[0], token.string


def names(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line, name) of what a module defines: itself, classes, functions, arguments, variables and attributes."""
    yield 1, path.stem
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr


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


@pytest.mark.parametrize("path", [*PAGES, *EXAMPLES], ids=place)
def test_pages_use_the_words_of_the_field(path: Path) -> None:
    if pending(place(path)):
        pytest.skip("being rewritten")
    assert faults(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("path", CODE, ids=place)
def test_docstrings_comments_and_messages_use_the_words_of_the_field(path: Path) -> None:
    if pending(place(path)):
        pytest.skip("being rewritten")
    found = [f"{place(path)}:{line}: {fault}" for line, text in texts(path) for fault in faults(text)]
    assert found == []


@pytest.mark.parametrize("path", CODE, ids=place)
def test_names_can_be_guessed(path: Path) -> None:
    if pending(place(path)):
        pytest.skip("being rewritten")
    found = [
        f"{place(path)}:{line}: {name}"
        for line, name in names(path)
        if not HOUSE_NAMES.isdisjoint(part.lower() for part in PARTS.findall(name))
    ]
    assert found == []


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
