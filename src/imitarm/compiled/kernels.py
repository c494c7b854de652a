"""Build and load the library of compiled code."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent
LIBRARY = FOLDER / "kernels.compiled"
_COMPILERS = ("cc", "gcc", "clang")
# without contraction and reordering, the order of all roundings is that of the source
_OPTIONS = ("-O2", "-std=c11", "-ffp-contract=off", "-shared", "-fPIC")
_I, _P, _D = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double
_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "imitarm_sources": (),
    "least_cost_choice": (_P, _D, *[_P] * 6),
    "least_cost_scratch": (_P, _I),
    "least_cost_velocity": (_I, _I, _P, _P, _D, _D, _P, _P, _P, _I, _P, _P, _P),
    "obstacle_rows": (_P, _D, _D, *[_P] * 12),
    "sphere_centers": (_P, _P),
    "self_rows": (*[_P] * 3, _I, _D, _D, _I, _D, _D, _D, *[_P] * 6),
    "track_obstacles": (_I, _I, _D, _D, *[_P] * 3),
    "track_renew": (*[_I] * 6, _D, _D, *[_P] * 5),
    "track_update": (*[_I] * 4, *[_D] * 5, *[_P] * 3),
}


def build() -> str:
    """Compile all sources, and return a sentence that describes the result."""
    compiler = next((path for name in _COMPILERS if (path := shutil.which(name))), None)
    if compiler is None:
        return "no C compiler was found; NumPy is used"
    sources = [str(path) for path in sorted(FOLDER.glob("*.c"))]
    with tempfile.TemporaryDirectory(dir=LIBRARY.parent, prefix=".build") as folder:  # two builds do not meet
        made = Path(folder) / LIBRARY.name
        command = [compiler, *_OPTIONS, f"-DIMITARM_SOURCES={_of_the_sources()}", "-o", str(made), *sources, "-lm"]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode != 0:
            return f"{Path(compiler).name} failed; NumPy is used:\n{done.stderr}"
        made.replace(LIBRARY)
    library.cache_clear()
    return f"built {LIBRARY.name}"


@cache
def library() -> Any:
    """Return the compiled library; None if it was not built, or if its sources have changed since it was built."""
    try:
        found = ctypes.CDLL(str(LIBRARY))
        for name, arguments in _FUNCTIONS.items():
            function = getattr(found, name)
            function.argtypes, function.restype = arguments, _I
        return found if found.imitarm_sources() == _of_the_sources() else None
    except (OSError, AttributeError):
        return None


def address(array: NDArray[Any]) -> int:
    """Return the memory address of an array; the caller must keep the array as long as it uses the address.

    Raises:
        ValueError: when the array is not contiguous in memory.
    """
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]  # the fastest way
    except (TypeError, ValueError, BufferError):  # an array that is read-only, empty or not contiguous
        if not array.flags.c_contiguous:
            raise ValueError(f"compiled code needs contiguous arrays, got strides {array.strides}") from None
        place: int = array.__array_interface__["data"][0]
        return place


class Block:
    """An array of real numbers and its address, both of which compiled code needs in every step.

    Attributes:
        array: the numbers, which follow each other in memory.
        address: address of the array.
    """

    __slots__ = ("address", "array")

    def __init__(self, array: NDArray[np.float64]) -> None:
        self.array, self.address = array, address(array)

    def __reduce__(self) -> tuple[Any, ...]:
        return Block, (self.array,)


class Record:
    """A C structure of whole numbers (``int64_t``), real numbers (``double``), arrays, and lists of other structures.

    A field for an array holds the address of the array. A field for a list holds the address of a list. The list
    contains the address of each structure, and 0 for each None.

    The record keeps all its arrays in memory. If a record is sent to another process, it is rebuilt there with new
    addresses.

    Attributes:
        address: address of the structure.
    """

    def __init__(self, *fields: int | float | NDArray[Any] | Sequence[Record | None]) -> None:
        """Write the fields in order; each array must have the data type and memory layout that the C code expects."""
        self._fields = fields
        values: list[int] = []
        self._lists: list[NDArray[np.int64]] = []
        for field in fields:
            if isinstance(field, int):
                values.append(field)
            elif isinstance(field, float):
                values.append(int(np.float64(field).view(np.int64)))
            elif isinstance(field, np.ndarray):
                values.append(address(field))
            else:
                places = np.array([0 if record is None else record.address for record in field], dtype=np.int64)
                self._lists.append(places)
                values.append(address(places))
        self._memory = np.array(values, dtype=np.int64)
        self.address: int = address(self._memory)

    @classmethod
    def at(cls, place: int, *kept: object) -> Record:
        """Return a record that compiled code has written; the record keeps references to what the structure points to.

        Such a record can't be copied to another process.

        Args:
            place: address of the structure.
            kept: the memory of the structure, and other objects to which the structure points.
        """
        record = object.__new__(cls)
        record.address, record._memory = place, kept  # type: ignore[assignment]
        return record

    def __reduce__(self) -> tuple[Any, ...]:
        return Record, self._fields


def _of_the_sources() -> int:
    """Return a number that changes with every change of the sources and of the compiler's options."""
    known = hashlib.sha256(" ".join(_OPTIONS).encode())
    for path in sorted([*FOLDER.glob("*.c"), *FOLDER.glob("*.h")]):
        known.update(path.read_bytes())
    return int.from_bytes(known.digest()[:7], "big")
