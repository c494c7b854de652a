"""Reader of NumPy files (.npy, .npz). The columns have no names, so their number determines their meaning.

Python objects stored in the files (pickles) are never loaded.
"""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.demonstrations.columns import COUNTS, UNNAMED, in_space, order_notes, unnamed_columns, with_units
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.reading import Reader, ReadOptions
from imitarm.errors import FileFormatError
from imitarm.files.table import read_bytes

Array = NDArray[np.float64]

_NPY, _NPZ = b"\x93NUMPY", b"PK\x03\x04"
_FEWEST_ROWS = 20  # of a demonstration; a stack with fewer rows than this and than demonstrations is transposed
_FIELDS = ("times", "positions", "quaternions", "joints")


class NumpyReader(Reader):
    """Reads arrays of numbers.

    An array of shape (n, columns) is one motion of n samples. An array of shape (n_demonstrations, n, columns) is
    several motions. The columns have the same meaning as in a text table without column names. An .npz file with an
    array ``positions`` holds one set of motions, and may also hold the arrays ``times``, ``quaternions`` and
    ``joints``. In any other .npz file, each array holds one or several motions.
    """

    suffixes = (".npy", ".npz")

    def recognises(self, head: bytes) -> bool:
        """Return whether the first bytes of the file are those of an .npy or .npz file."""
        return head.startswith((_NPY, _NPZ))

    def read(self, path: str, options: ReadOptions) -> list[RawDemonstration]:
        """Return every motion of the file, in order."""
        content = read_bytes(path)
        if content.startswith(_NPY):
            return _stack(path, _numbers(path, _load(path, content)), options)
        arrays = _load(path, content)
        if not arrays:
            raise FileFormatError(f"{path}: the archive holds no arrays; save it again with numpy.savez")
        arrays = {name: _numbers(f"{path}:{name}", array) for name, array in arrays.items()}
        if "positions" in arrays:
            return _by_field(path, arrays, options)
        return [raw for name, array in arrays.items() for raw in _stack(f"{path}:{name}", array, options)]


def _damaged(path: str, error: BaseException) -> FileFormatError:
    if "pickle" in str(error):
        return FileFormatError(
            f"{path}: holds Python objects (a pickle), which are never opened; save numbers as one float array"
        )
    return FileFormatError(f"{path}: damaged or cut off ({str(error).splitlines()[0] or type(error).__name__})")


def _load(path: str, content: bytes) -> Any:
    """Return the array of an .npy file, or the arrays of an .npz file by name, from the bytes of the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns about headers that old versions wrote
            if content.startswith(_NPY):
                _check_size(content)
                return np.load(io.BytesIO(content), allow_pickle=False)
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
    except Exception as error:  # damaged headers raise errors of zipfile, zlib and Python's tokenizer
        raise _damaged(path, error) from error


def _check_size(content: bytes) -> None:
    """Reject a file whose header states more data than the file contains, before memory is allocated for the data."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(stream)
    if not dtype.hasobject and np.prod(shape, dtype=float) * dtype.itemsize > len(content):
        raise ValueError(f"its header states the shape {shape}, but the file is too short for this shape")


def _numbers(source: str, array: Any) -> Array:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        held = array.dtype if isinstance(array, np.ndarray) else "no array"
        raise FileFormatError(f"{source}: holds {held}, not real numbers; save a float array")
    if array.size == 0:
        raise FileFormatError(f"{source}: the array is empty, shape {array.shape}")
    return array.astype(float)


def _stack(source: str, array: Array, options: ReadOptions) -> list[RawDemonstration]:
    _check_matrices(source, array)
    if array.ndim not in (2, 3) or array.shape[-1] not in UNNAMED:
        raise FileFormatError(
            f"{source}: shape {array.shape}, must be (n, columns) or (n_demonstrations, n, columns); {COUNTS}"
        )
    if array.ndim == 2:
        return [unnamed_columns(source, array, options)]
    if array.shape[1] < min(_FEWEST_ROWS, array.shape[0]):
        raise FileFormatError(
            f"{source}: shape {array.shape} would be {array.shape[0]} demonstrations of {array.shape[1]} rows each; "
            "the order must be (n_demonstrations, n, columns): swap the first two axes, or save one motion as "
            "(n, columns)"
        )
    return [unnamed_columns(f"{source}[{i}]", motion, options) for i, motion in enumerate(array)]


def _check_matrices(source: str, array: Array) -> None:
    """Reject stacks of rotation or transformation matrices, because their rows are not samples of a motion."""
    square = array.ndim >= 3 and array.shape[-2:] in ((4, 4), (3, 4), (3, 3))
    flat = array.ndim == 2 and array.shape[1] in (9, 12, 16) and len(array) > 1
    if not square and not flat:
        return
    matrices = f"{array.shape[-2]} x {array.shape[-1]}" if square else f"{array.shape[1]} numbers each"
    raise FileFormatError(
        f"{source}: shape {array.shape} looks like a stack of matrices ({matrices}), not like rows of samples; save "
        "positions T[:, :3, 3] and quaternions as the columns x y z qw qx qy qz"
    )


def _by_field(path: str, arrays: dict[str, Array], options: ReadOptions) -> list[RawDemonstration]:
    """Combine the arrays ``positions``, ``times``, ``quaternions`` and ``joints`` of one archive."""
    shape = arrays["positions"].shape
    if len(shape) not in (2, 3) or shape[-1] not in (2, 3):
        raise FileFormatError(f"{path}:positions: shape {shape}, must be (n, 3) or (n_demonstrations, n, 3)")
    lead = shape[:-1]
    wanted: dict[str, tuple[tuple[int, ...], ...]] = {
        "times": (lead, lead[-1:]),  # all motions may share one time axis
        "quaternions": ((*lead, 4),),
        "joints": ((*lead, arrays["joints"].shape[-1]),) if "joints" in arrays else (),
    }
    for name, shapes in wanted.items():
        if name in arrays and arrays[name].shape not in shapes:
            raise FileFormatError(
                f"{path}:{name}: shape {arrays[name].shape}, must be {shapes[0]} to match the array 'positions'"
            )
    if len(shape) == 2:
        return [_of_fields(path, arrays, options)]
    fields = [name for name in _FIELDS if name in arrays]
    each = [
        {name: arrays[name] if arrays[name].shape == lead[-1:] else arrays[name][i] for name in fields}
        for i in range(shape[0])
    ]
    return [_of_fields(f"{path}[{i}]", motion, options) for i, motion in enumerate(each)]


def _of_fields(source: str, fields: dict[str, Array], options: ReadOptions) -> RawDemonstration:
    positions, times, joints = fields["positions"], fields.get("times"), fields.get("joints")
    unused = sorted(set(fields) - set(_FIELDS))
    notes = (f"arrays not used: {', '.join(unused)}",) if unused else ()
    raw = RawDemonstration(
        source,
        options.even_times(source, len(positions)) if times is None else options.seconds(source, times),
        in_space(options.metres(source, positions)),
        options.wxyz(source, fields["quaternions"]) if "quaternions" in fields else None,
        joints,
        () if joints is None else tuple(f"joint_{i + 1}" for i in range(joints.shape[1])),
        options.task,
        notes=notes + (order_notes(options) if "quaternions" in fields else ()),
    )
    return with_units(raw, options, None, None)
