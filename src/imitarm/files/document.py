"""Documents on disk: write text files atomically, and check the content of documents against a schema."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any, TypeVar

from imitarm.errors import FileFormatError, InputError

Document = TypeVar("Document")


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text to a temporary file, then rename the file to ``path``; until then, an existing file stays intact.

    Args:
        path: file to write; an existing file is replaced.
        text: content of the file, written as UTF-8.

    Raises:
        InputError: when the file can't be written; an existing file is then unchanged.
    """
    target = Path(path)
    aside: Path | None = None
    try:
        prefix = f".{target.name}."
        with tempfile.NamedTemporaryFile(
            "w", dir=target.parent, prefix=prefix, suffix=".part", delete=False, encoding="utf-8", newline="\n"
        ) as file:
            aside = Path(file.name)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        aside.chmod(0o666 & ~_umask())
        aside.replace(target)
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        if aside is not None:
            aside.unlink(missing_ok=True)
        raise InputError(f"{target}: can't be written: {getattr(error, 'strerror', None) or error}") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def as_document(content: Any, kind: type[Document], path: str | os.PathLike[str], remedy: str) -> Document:
    """Convert plain values (dictionaries, lists, numbers, texts) to an object of the class ``kind``.

    Args:
        content: result of a JSON or YAML reader.
        kind: subclass of ``msgspec.Struct`` that describes the fields and their types.
        path: path of the file, for messages.
        remedy: what the user should do about a wrong field; it is added to the message.

    Raises:
        FileFormatError: when a field is missing or of another type; the message names the field.
    """
    import msgspec  # noqa: PLC0415  slow to import, and only documents with a schema need it

    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        where = place.rstrip("`").lstrip(".") or "top level"
        raise FileFormatError(f"{os.fspath(path)}, {where}: {problem[:1].lower()}{problem[1:]}; {remedy}") from error
