"""open_source: open a source of skeletons by a name such as ``webcam:0``."""

from __future__ import annotations

from pathlib import Path

from imitarm.capture import SOURCES
from imitarm.capture.filters import PersonFilter, RealtimeSource, SideFilter
from imitarm.capture.skeleton import SkeletonSource
from imitarm.errors import InputError, UnknownNameError
from imitarm.files.part_file import PART


def open_source(word: str | Path, *, realtime: bool = False) -> SkeletonSource:
    """Open a source of skeletons by name.

    Args:
        word: path of a recording; or the name of a source in :data:`~imitarm.capture.SOURCES`, written ``NAME`` or
            ``NAME:ARGUMENT``. If ``word`` is the path of an existing file, the file is opened.
        realtime: for sources that are not live. True: replay at the recorded speed. False: replay as fast as the
            skeletons are read.

    Raises:
        UnknownNameError: when the name is neither the path of a file nor the name of a source.
        InputError: when the argument after the colon is wrong, a recording can't be read, or a required device or
            program is missing.
    """
    kind, argument = find_source(word)
    source = kind.open(argument, realtime=realtime)
    return RealtimeSource(source) if realtime and not (kind.live or kind.has_realtime) else source


def find_source(word: str | Path) -> tuple[type[SkeletonSource], str]:
    """Return the class of the source that ``word`` names, and the text after the colon; the source is not opened.

    Raises:
        UnknownNameError: when the name is neither the path of a file nor the name of a source.
        InputError: when the source's argument is missing or not allowed, or the package that provides the source is
            faulty.
    """
    text = str(word)
    name, colon, argument = text.partition(":")
    if Path(text).exists():
        return SOURCES["file"], text
    if name in SOURCES:
        source = _class_of(name)
        if source.argument and not argument:
            raise InputError(f"source {text!r}: {source.argument} is missing; write {name}:{source.argument}")
        if colon and not source.argument:
            raise InputError(f"source {text!r}: takes nothing after a colon; write {name}")
        return source, argument
    path = Path(text)
    if (colon and len(name) > 1) or not (path.suffix or path.parent != Path() or Path(text + PART).exists()):
        raise UnknownNameError.among("source", text, source_words())
    return SOURCES["file"], text  # whose reader says that it is not there, and perhaps what is


def _class_of(name: str) -> type[SkeletonSource]:
    """Import the class of a source and check it.

    Raises:
        InputError: when the class is not derived from SkeletonSource.
    """
    source = SOURCES[name]
    if not (isinstance(source, type) and issubclass(source, SkeletonSource)):
        raise InputError(
            f"source {name!r}: {source!r} (entry point in {SOURCES.group}) is not a class derived from "
            "imitarm.SkeletonSource; fix or uninstall that package"
        )
    return source


def source_words() -> dict[str, str]:
    """Return the description of each source, by the word that selects the source.

    The modules of all sources are imported.
    """
    words = {}
    for name in SOURCES:
        try:
            source = _class_of(name)
        except InputError as error:
            words[name] = f"not usable: {error}"
            continue
        word = f"{name}:{source.argument}" if source.argument else name
        words["FILE" if name == "file" else word] = source.description
    return words


def is_live(word: str | Path) -> bool:
    """Return whether a source is live, which means that the source runs until it is stopped; the source is not opened.

    Raises:
        InputError: for the same reasons as :func:`find_source`.
    """
    return find_source(word)[0].live


def followed(source: SkeletonSource, *, person: int | None = None) -> PersonFilter:
    """Return a source that delivers only one person of ``source``, and undoes swaps of the person's left and right.

    Args:
        source: opened source.
        person: number of the person to follow; None: the first person who is seen.
    """
    return PersonFilter(SideFilter(source), person=person)
