"""The skill file: JSON that a person can read, checked when it is read, and never executed.

Layout: ``format``, ``version``, what the numbers mean (``units``, ``frames``), where they come from (``task``,
``provenance``), the numbers (``gmr``, ``dmp``), and last a ``checksum``: SHA-256 of everything else in canonical
form (sorted keys, no spaces), so that layout may be changed but not one digit. Floats are written with all their
digits and come back exactly. Nothing in the file names a class or is run.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError

Array = NDArray[np.float64]

FORMAT = "imitarm skill"
VERSION = 1
_LARGEST = 64 * 2**20  # [bytes] a skill takes about 50 kB
_ABOUT = {
    "units": {"time": "s", "length": "m", "angle": "rad"},
    "frames": {
        "positions": "tool tip in the robot's base frame",
        "quaternions": "tool_to_base, in the order w, x, y, z",
        "rotation vectors": "base frame, from the reference rotation",
        "columns of gmr": "t, x, y, z, then the rotation vector where rotation was learnt",
    },
}


class Fields:
    """Part of a file that is being read; every answer has the type that was asked for.

    Args:
        values: the JSON object.
        place: where it is, for messages.

    Raises:
        FileFormatError: from every method, when a field is missing or of another kind.
    """

    def __init__(self, values: object, place: str) -> None:
        if not isinstance(values, Mapping):
            raise FileFormatError(f"{place}: should be a group of named fields, is {type(values).__name__}")
        self._values = values
        self._place = place

    def _get(self, name: str) -> Any:
        if name not in self._values:
            raise FileFormatError(f"{self._place}: field {name!r} is missing")
        return self._values[name]

    def has(self, name: str) -> bool:
        """Tell whether a field is there and not null."""
        return self._values.get(name) is not None

    def group(self, name: str) -> Fields:
        """Return a group of fields."""
        return Fields(self._get(name), f"{self._place}, {name}")

    def text(self, name: str) -> str:
        """Return a string."""
        value = self._get(name)
        if not isinstance(value, str):
            raise FileFormatError(f"{self._place}: {name!r} should be text, is {value!r:.80}")
        return value

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a list of strings."""
        value = self._get(name)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise FileFormatError(f"{self._place}: {name!r} should be a list of text")
        return tuple(value)

    def integer(self, name: str) -> int:
        """Return a whole number from 0 to 2^53."""
        value = self._get(name)
        if type(value) is not int or not 0 <= value <= 2**53:
            raise FileFormatError(f"{self._place}: {name!r} should be a whole number, is {value!r:.80}")
        return value

    def flag(self, name: str) -> bool:
        """Return true or false."""
        value = self._get(name)
        if not isinstance(value, bool):
            raise FileFormatError(f"{self._place}: {name!r} should be true or false, is {value!r:.80}")
        return value

    def number(self, name: str) -> float:
        """Return a finite number."""
        return float(self.array(name, 0))

    def array(self, name: str, n_dims: int) -> Array:
        """Return an array of finite numbers."""
        value = self._get(name)
        if not _all_numbers(value):
            raise FileFormatError(f"{self._place}: {name!r} should hold numbers and nothing else")
        try:
            array = np.array(value, dtype=float)
        except (ValueError, OverflowError) as error:
            raise FileFormatError(f"{self._place}: {name!r} is not a regular table of numbers ({error})") from error
        if array.ndim != n_dims or not np.all(np.isfinite(array)):
            raise FileFormatError(f"{self._place}: {name!r} should be a finite array with {n_dims} dimensions")
        return array


def _all_numbers(value: object) -> bool:
    if isinstance(value, list):
        return all(_all_numbers(v) for v in value)
    return type(value) in {int, float}


def write_skill(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write ``content`` (plain values and arrays), aside first and then renamed.

    Raises:
        InputError: when a number is not finite, or the file can't be written; what was there before stays as it was.
    """
    target = Path(path)
    whole = {"format": FORMAT, "version": VERSION, **_ABOUT, **{k: _plain(v) for k, v in content.items()}}
    try:
        whole["checksum"] = _checksum(whole)
    except ValueError as error:
        raise InputError(f"can't write skill file {target}: it holds a number that is not finite") from error
    text = "".join(_lines(whole, "")) + "\n"
    aside: Path | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w", dir=target.parent, prefix=f".{target.name}.", suffix=".part", delete=False, encoding="utf-8"
        ) as file:
            aside = Path(file.name)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        aside.chmod(0o666 & ~_umask())
        aside.replace(target)
    except OSError as error:
        if aside is not None:
            aside.unlink(missing_ok=True)
        raise InputError(f"can't write skill file {target}: {error.strerror or error}") from error


def read_skill(path: str | os.PathLike[str]) -> Fields:
    """Read and check a skill file.

    Raises:
        InputError: when there is no such file or it can't be read.
        FileFormatError: when it is no skill file, was cut or altered, or is of a version not known here.
    """
    source = Path(path)
    try:
        if source.stat().st_size > _LARGEST:
            raise FileFormatError(f"{source}: larger than {_LARGEST // 2**20} MB, so it is no skill file")
        data = source.read_bytes()
    except OSError as error:
        raise InputError(f"can't read skill file {source}: {error.strerror or error}") from error
    try:
        whole = json.loads(data.decode("utf-8"), object_pairs_hook=_without_repeats, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:  # bad UTF-8, bad JSON, a number of thousands of digits
        raise FileFormatError(
            f"{source}: not readable as JSON ({error}); the file was cut or altered, or is no skill file"
        ) from error
    if not isinstance(whole, dict) or whole.get("format") != FORMAT:
        raise FileFormatError(f"{source}: no skill file (its 'format' is not {FORMAT!r})")
    version = whole.get("version")
    if type(version) is not int or version < 1:
        raise FileFormatError(f"{source}: its 'version' should be a whole number, is {version!r:.80}")
    if version > VERSION:
        raise FileFormatError(
            f"{source}: written in version {version} of the format; this imitarm reads versions up to {VERSION}. "
            "Update imitarm"
        )
    checksum = whole.pop("checksum", None)
    try:
        expected = _checksum(whole)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: holds what no skill file holds ({error})") from error
    if checksum != expected:
        raise FileFormatError(
            f"{source}: the checksum does not fit the content, so the file was altered after it was written; "
            "use the original, or learn the skill again"
        )
    return Fields(whole, str(source))


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = dict(pairs)
    if len(names) < len(pairs):
        raise ValueError("a field stands there twice")
    return names


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _checksum(whole: Mapping[str, Any]) -> str:
    canonical = json.dumps(whole, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(canonical.encode("ascii")).hexdigest()


def _plain(value: Any) -> Any:
    """Return arrays and NumPy numbers as lists and Python numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _lines(value: Any, indent: str) -> Iterator[str]:
    """Write groups one field a line, and tables one row a line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [(f"{deeper}{json.dumps(k)}: ", v) for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, list | dict) for v in value):
        items = [(deeper, v) for v in value]
    else:
        yield json.dumps(value, allow_nan=False)
        return
    opening, closing = ("{", "}") if isinstance(value, dict) else ("[", "]")
    yield opening + "\n"
    for i, (head, v) in enumerate(items):
        yield head
        yield from _lines(v, deeper)
        yield ",\n" if i < len(items) - 1 else "\n"
    yield indent + closing


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
