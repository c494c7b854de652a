"""Arguments are checked once, here: what is no number, no count and no flag is refused with a message."""

from __future__ import annotations

from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imitarm.errors import InputError, UnknownNameError
from imitarm.validation import (
    choice,
    file_path,
    finite_array,
    finite_number,
    finite_numbers,
    finite_vector,
    flag,
    function,
    instance,
    real_array,
    sequence,
    text,
    whole_number,
)

NOT_NUMBERS: list[Any] = [
    None,
    "1.0",
    ["1", "2", "3"],
    [True, False, True],
    [1.0, None, 2.0],
    [1.0, 2.0j, 3.0],
    {1.0, 2.0, 3.0},
    {"a": 1.0},
    [[1.0], [2.0, 3.0], [4.0]],
    object(),
    np.array([datetime(2020, 1, 1)] * 3, dtype="datetime64[s]"),
    np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]),
    (x for x in (1.0, 2.0, 3.0)),
    [10**400, 1.0, 2.0],
]


@pytest.mark.parametrize("value", NOT_NUMBERS, ids=lambda v: repr(v).split(" at 0x")[0][:30])
def test_what_is_no_number_is_refused_as_vector_array_and_number(value: Any) -> None:
    with pytest.raises(InputError, match="q"):
        finite_vector(value, 3, "q", "rad")
    with pytest.raises(InputError, match="q"):
        finite_array(value, (3,), "q")
    with pytest.raises(InputError, match="q"):
        real_array(value, (3,), "q")
    with pytest.raises(InputError, match="q"):
        finite_number(value, "q")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_nan_and_infinities_are_refused_and_their_place_is_named(bad: float, place: int) -> None:
    value = np.array([0.1, 0.2, 0.3])
    value[place] = bad
    for check in (lambda: finite_vector(value, 3, "q"), lambda: finite_array(value, (3,), "q")):
        with pytest.raises(InputError, match=rf"q\[{place}\] is {bad}"):
            check()
    assert real_array(value, (None,), "q") is value
    with pytest.raises(InputError):
        finite_number(bad, "dt", "s")


def test_infinities_that_cancel_are_found_and_large_numbers_are_none() -> None:
    with pytest.raises(InputError):
        finite_vector([np.inf, -np.inf], 2, "q")
    assert finite_vector([1e308, 1e308], 2, "q").tolist() == [1e308, 1e308]


@pytest.mark.parametrize(
    "value", [[1, 2, 3], (1.0, 2.0, 3.0), np.arange(1, 4), np.float32([1, 2, 3]), [Fraction(1), 2, 3], range(1, 4)]
)
def test_numbers_of_any_kind_become_float64(value: Any) -> None:
    for array in (finite_vector(value, 3, "q"), finite_array(value, (None,), "q")):
        assert array.dtype == np.float64
        assert array.tolist() == [1.0, 2.0, 3.0]


def test_a_float64_array_is_not_copied() -> None:
    value = np.ones(3)
    assert finite_vector(value, 3, "q") is value
    assert finite_array(value, (3,), "q") is value


@pytest.mark.parametrize(
    ("shape", "good", "wrong"),
    [
        ((None, 3), (5, 3), (5, 4)),
        ((None, 3), (0, 3), (3,)),
        ((..., 3), (3,), ()),
        ((..., 3), (2, 5, 3), (2, 3, 5)),
        ((..., 4, 4), (7, 4, 4), (4,)),
        ((2, None), (2, 9), (3, 9)),
        ((), (), (1,)),
    ],
)
def test_shapes_with_free_lengths_and_leading_axes(shape: Any, good: tuple[int, ...], wrong: tuple[int, ...]) -> None:
    assert finite_array(np.zeros(good), shape, "p").shape == good
    with pytest.raises(InputError, match="got shape"):
        finite_array(np.zeros(wrong), shape, "p")


def test_messages_say_what_was_needed_with_its_unit_and_what_was_given() -> None:
    with pytest.raises(InputError, match=r"q must be 7 numbers \[rad\], got shape \(6,\)"):
        finite_vector(np.zeros(6), 7, "q", "rad")
    with pytest.raises(InputError, match=r"points must be an array of shape \(n, 3\) \[m\], got shape \(2,\)"):
        finite_array(np.zeros(2), (None, 3), "points", "m")
    with pytest.raises(InputError, match=r"dt must be a finite number above 0 \[s\], got 0.0"):
        finite_number(0.0, "dt", "s", above=0.0)
    with pytest.raises(InputError, match=r"q must be 7 finite numbers \[rad\], got None \(NoneType\)"):
        finite_vector(None, 7, "q", "rad")


def test_bounds_of_numbers() -> None:
    assert finite_number(0, "r", at_least=0.0) == 0.0
    assert finite_number(np.float32(2.0), "r", above=1.0, at_most=2.0) == 2.0
    assert finite_number(np.array(2.0), "r") == 2.0
    for value, bounds in ((-1e-9, {"at_least": 0.0}), (0.0, {"above": 0.0}), (2.1, {"at_most": 2.0})):
        with pytest.raises(InputError):
            finite_number(value, "r", **bounds)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [1.0, "1", None, True, np.nan, [1], np.array([1])])
def test_counts_are_whole_numbers(value: Any) -> None:
    with pytest.raises(InputError, match="n_samples must be a whole number"):
        whole_number(value, "n_samples", at_least=1)


def test_bounds_of_counts() -> None:
    assert whole_number(np.int64(3), "n", at_least=3, at_most=3) == 3
    for value in (2, 4):
        with pytest.raises(InputError, match="at least 3 and of at most 3"):
            whole_number(value, "n", at_least=3, at_most=3)


@pytest.mark.parametrize("value", [0, 1, "no", None, np.array([True])])
def test_flags_are_true_or_false(value: Any) -> None:
    assert flag(True, "x") is True
    assert flag(np.False_, "x") is False
    with pytest.raises(InputError, match="True or False"):
        flag(value, "x")


def test_text_and_types() -> None:
    assert text("a", "name") == "a"
    assert instance(Path(), Path, "path") == Path()
    with pytest.raises(InputError, match="name must be text"):
        text(3, "name")
    with pytest.raises(InputError, match="path must be a Path, got 'a' \\(str\\)"):
        instance("a", Path, "path")


def test_a_long_value_is_cut_in_the_message() -> None:
    with pytest.raises(InputError) as caught:
        finite_number("x" * 10_000, "dt")
    assert len(str(caught.value)) < 150


def test_one_number_or_a_vector():
    assert finite_numbers(3, "t").tolist() == [3.0]
    assert finite_numbers([1, 2.5], "t").tolist() == [1.0, 2.5]
    for bad in (np.zeros((2, 2)), [[1.0], [2.0, 3.0]], "1", None, np.nan):
        with pytest.raises(InputError, match="t must be"):
            finite_numbers(bad, "t")


def test_a_choice_lists_the_names():
    assert choice("a", ("b", "a"), "method") == "a"
    for bad in ("c", 1, None, np.zeros(3), ["a"]):
        with pytest.raises(UnknownNameError, match=r"unknown method .*known: a, b"):
            choice(bad, ("b", "a"), "method")


def test_sequences_functions_and_paths():
    assert sequence(["a", "b"], str, "names") == ("a", "b")
    for bad in ("ab", 3, ["a", 1], {"a"}):
        with pytest.raises(InputError, match="names must be a sequence of str"):
            sequence(bad, str, "names")
    assert function(len, "f") is len
    with pytest.raises(InputError, match="f must be a function"):
        function(3, "f")
    assert file_path("a/b", "path") == Path("a/b") == file_path(Path("a/b"), "path")
    for bad in (b"a", 3, None, "a\0b"):
        with pytest.raises(InputError, match="path must be text"):
            file_path(bad, "path")
