"""Checks of arguments, shared by all public functions: numbers, vectors, arrays, counts, flags and types.

Each function returns the value in a form that is safe to compute with, or raises :class:`InputError`. The message names
the argument, its unit, the expected value and the given value. NaN, infinities, text, booleans, complex numbers,
``None`` and masked entries are not accepted as numbers. Arrays of float64 are returned without a copy.

:func:`finite_vector` takes less than a microsecond for an array of float64, so that it may be used in a control loop.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import EllipsisType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError, UnknownNameError

Array = NDArray[np.float64]
T = TypeVar("T")

_FLOAT64 = np.dtype(np.float64)
_LATEST = 1e12  # [s] largest time stamp; a stamp of the year 2020 in nanoseconds is 1.6e18
_LONGEST_SHOWN = 60  # characters of a refused value that a message repeats


def finite_vector(value: Any, n: int, what: str, unit: str = "") -> Array:
    """Return ``value`` as ``n`` finite numbers, shape (n,), float64.

    Args:
        value: the argument to check.
        n: required length.
        what: the name of the argument in messages, for example ``"q"``.
        unit: the unit of the numbers in messages, for example ``"rad"``.

    Raises:
        InputError: when the value is not ``n`` finite numbers.
    """
    array: Array = value if type(value) is np.ndarray and value.dtype is _FLOAT64 else _real(value, what, unit, n)
    # A plain sum of Python floats finds NaN and infinities in a third of the time that np.isfinite(...).all() takes.
    if array.shape != (n,) or not math.isfinite(sum(array.tolist())):
        _check_shape(array, (n,), what, unit)
        _check_finite(array, what, unit)
    return array


def finite_array(value: Any, shape: tuple[int | EllipsisType | None, ...], what: str, unit: str = "") -> Array:
    """Return ``value`` as an array of finite numbers of the given shape, float64.

    Args:
        value: the argument to check.
        shape: required length of each axis. The entry None allows any length. The first entry ``...`` allows any number
            of leading axes.
        what: the name of the argument in messages.
        unit: the unit of the numbers in messages.

    Raises:
        InputError: when the value is not an array of finite numbers, or has another shape.
    """
    array = _real(value, what, unit)
    _check_shape(array, shape, what, unit)
    _check_finite(array, what, unit)
    return array


def finite_points(points: Any) -> Array:
    """Return ``points`` as an array of finite numbers, shape (..., 3), float64.

    Raises:
        InputError: when the points are not numbers, the last axis does not have length 3, or a number is not finite.
    """
    if type(points) is np.ndarray and points.dtype is _FLOAT64 and points.shape[-1:] == (3,):
        flat = points.ravel()
        if math.isfinite(flat.dot(flat)):  # a sum of squares is finite only if every number is
            return points
    return finite_array(points, (..., 3), "points", "m")


def real_array(value: Any, shape: tuple[int | EllipsisType | None, ...], what: str, unit: str = "") -> Array:
    """Return ``value`` as an array of numbers of the given shape, float64; NaN and infinities are allowed.

    Use this function for measurements in which NaN marks a missing sample. The arguments are the same as in
    :func:`finite_array`.

    Raises:
        InputError: when the value is not an array of numbers, or has another shape.
    """
    array = _real(value, what, unit)
    _check_shape(array, shape, what, unit)
    return array


def finite_number(
    value: Any,
    what: str,
    unit: str = "",
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return ``value`` as one finite number within the given bounds.

    Args:
        value: the argument to check.
        what: the name of the argument in messages.
        unit: the unit of the number in messages.
        above: exclusive lower bound, for example 0 for a duration.
        at_least: inclusive lower bound, for example 0 for a radius.
        at_most: inclusive upper bound.

    Raises:
        InputError: when the value is not one finite number, or is out of bounds.
    """
    number = value if type(value) is float else _number(value, what, unit)
    if (
        not math.isfinite(number)
        or (above is not None and not number > above)
        or (at_least is not None and not number >= at_least)
        or (at_most is not None and not number <= at_most)
    ):
        bounds = _bounds(above, at_least, at_most)
        raise InputError(f"{what} must be a finite number{bounds}{_bracketed(unit)}, got {number}")
    return number


def time_stamp(value: Any, what: str) -> float:
    """Return ``value`` as a time stamp in seconds, at most 1e12 s from 0.

    Raises:
        InputError: when the value is not one finite number, or is larger. A stamp in nanoseconds is larger.
    """
    seconds = finite_number(value, what, "s")
    if not -_LATEST <= seconds <= _LATEST:
        raise InputError(f"{what} must be within {_LATEST:g} s of 0, got {seconds:g}; give it in seconds")
    return seconds


def whole_number(value: Any, what: str, *, at_least: int | None = None, at_most: int | None = None) -> int:
    """Return ``value`` as a whole number within the given bounds.

    Args:
        value: the argument to check; a float is rejected even if it has no fractional part.
        what: the name of the argument in messages.
        at_least: inclusive lower bound.
        at_most: inclusive upper bound.

    Raises:
        InputError: when the value is not a whole number, or is out of bounds.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool | np.bool_)
    if not whole or (at_least is not None and value < at_least) or (at_most is not None and value > at_most):
        raise InputError(f"{what} must be a whole number{_bounds(None, at_least, at_most)}, got {_shown(value)}")
    return int(value)


def flag(value: Any, what: str) -> bool:
    """Return ``value`` as True or False.

    Raises:
        InputError: when the value is not a boolean, for example ``"no"`` or ``0``.
    """
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{what} must be True or False, got {_shown(value)}")
    return bool(value)


def text(value: Any, what: str) -> str:
    """Return ``value`` as a string.

    Raises:
        InputError: when the value is not a string.
    """
    if not isinstance(value, str):
        raise InputError(f"{what} must be text, got {_shown(value)}")
    return value


def instance(value: Any, kind: type[T], what: str) -> T:
    """Return ``value`` unchanged if it is an object of the class ``kind``.

    Raises:
        InputError: when the value is of another class.
    """
    if not isinstance(value, kind):
        raise InputError(f"{what} must be a {kind.__name__}, got {_shown(value)}")
    return value


def finite_numbers(value: Any, what: str, unit: str = "") -> Array:
    """Return a finite number, or a sequence of finite numbers, as an array of shape (n,), float64.

    Raises:
        InputError: when the value is something else.
    """
    array = finite_array(value, (...,), what, unit)
    if array.ndim > 1:
        raise InputError(f"{what} must be one number or an array of shape (n,){_bracketed(unit)}, got {array.shape}")
    return array.reshape(-1)


def choice(value: Any, names: Iterable[str], what: str) -> str:
    """Return ``value`` unchanged if it is one of ``names``.

    Raises:
        UnknownNameError: when ``value`` is not one of ``names``; the message lists the names.
    """
    known = tuple(names)
    if not isinstance(value, str) or value not in known:
        shown = repr(value) if isinstance(value, str) else _shown(value)
        raise UnknownNameError(f"unknown {what} {shown}; known: {', '.join(sorted(known))}")
    return value


def sequence(value: Any, kind: type[T], what: str) -> tuple[T, ...]:
    """Return a sequence of objects of the class ``kind`` as a tuple; a string is not accepted as a sequence.

    Raises:
        InputError: when the value is something else.
    """
    if isinstance(value, str | bytes) or not isinstance(value, Sequence) or not all(isinstance(v, kind) for v in value):
        raise InputError(f"{what} must be a sequence of {kind.__name__}, got {_shown(value)}")
    return tuple(value)


def function(value: Any, what: str) -> Callable[..., Any]:
    """Return ``value`` unchanged if it is callable.

    Raises:
        InputError: when ``value`` is not callable.
    """
    if not callable(value):
        raise InputError(f"{what} must be a function, got {_shown(value)}")
    result: Callable[..., Any] = value
    return result


def file_path(value: Any, what: str) -> Path:
    """Return ``value`` as a path.

    Raises:
        InputError: when ``value`` is not text or a path, or contains a null character.
    """
    name = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(name, str) or "\0" in name:
        raise InputError(f"{what} must be text or a pathlib.Path, got {_shown(value)}")
    return Path(name)


def _real(value: Any, what: str, unit: str, n: int | None = None) -> Array:
    """Convert to float64; reject values that numpy would convert silently: text, booleans, None, masked entries."""
    if np.ma.is_masked(value):
        raise InputError(f"{what} has masked entries; fill them in or remove them first")
    try:
        array = np.asarray(value)
        kind = array.dtype.kind
        real = kind in "fiu" or (kind == "O" and array.size > 0 and all(map(_is_real, array.flat)))
        converted = array.astype(np.float64, copy=False) if real or array.size == 0 else None
    except (TypeError, ValueError, OverflowError, RecursionError):
        converted = None
    if converted is None:
        needed = "numbers" if n is None else f"{n} finite numbers"
        raise InputError(f"{what} must be {needed}{_bracketed(unit)}, got {_shown(value)}")
    return converted


def _is_real(item: Any) -> bool:
    return isinstance(item, Real) and not isinstance(item, bool)


def _number(value: Any, what: str, unit: str) -> float:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if not _is_real(value) or isinstance(value, np.bool_):
        raise InputError(f"{what} must be a finite number{_bracketed(unit)}, got {_shown(value)}")
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _check_shape(array: Array, shape: tuple[int | EllipsisType | None, ...], what: str, unit: str) -> None:
    lengths = shape[1:] if shape[:1] == (...,) else shape
    actual = array.shape[max(array.ndim - len(lengths), 0) :] if len(lengths) < len(shape) else array.shape
    if len(actual) == len(lengths) and all(
        length is None or length == found for length, found in zip(lengths, actual, strict=True)
    ):
        return
    if len(shape) == 1 and lengths == shape and shape[0] is not None:
        needed = f"{shape[0]} numbers"
    else:
        named = ", ".join("..." if length is ... else "n" if length is None else str(length) for length in shape)
        needed = f"an array of shape ({named}{',' if len(shape) == 1 else ''})"
    raise InputError(f"{what} must be {needed}{_bracketed(unit)}, got shape {array.shape}")


def _check_finite(array: Array, what: str, unit: str) -> None:
    finite = np.isfinite(array)
    if not finite.all():
        place = np.unravel_index(int(np.argmin(finite)), array.shape)
        name = what.rpartition(": ")[2]  # without the owner that stands before it
        entry = f"{name}[{', '.join(str(int(i)) for i in place)}]" if place else name
        raise InputError(f"{what} must be finite{_bracketed(unit)}, but {entry} is {array[place]}")


def _bounds(above: float | None, at_least: float | None, at_most: float | None) -> str:
    parts = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("of at least", at_least), ("of at most", at_most))
        if bound is not None
    ]
    return " " + " and ".join(parts) if parts else ""


def _bracketed(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _shown(value: Any) -> str:
    try:
        shown = " ".join(repr(value).split())
    except Exception:  # a value whose repr fails is still refused with a message
        shown = "a value that can't be shown"
    shown = shown if len(shown) <= _LONGEST_SHOWN else shown[: _LONGEST_SHOWN - 3] + "..."
    return f"{shown} ({type(value).__name__})"
